#!/bin/sh
# usage: run.sh PROJECT, the folder of the engine's project, whole path
# Puts viewrank's scene in the place of the engine's own, and runs ODX; ENGINE=opendronemap/odm run.sh PROJECT runs ODM.
set -eu
@RESTART@
@REFUSE_STRANGERS@
refuse_strangers . << 'LINKS' || exit 1
@LINKS@
LINKS
# A link on the way to the folder that is replaced would lead out of the project.
PROJECT=${1:?folder of the project of ODX or ODM, whole path}
case $PROJECT in
/*) ;;
*)
    echo "run.sh: the project's folder must be a whole path, that begins with /" >&2
    exit 1
    ;;
esac
if [ ! -d "$PROJECT/opensfm/undistorted" ]; then
    echo "run.sh: $PROJECT/opensfm/undistorted: no such folder; is that the project of ODX or ODM?" >&2
    exit 1
fi
# As the engine is told it: the name of a folder, not of an option, in a folder that docker can mount.
PROJECT=$(cd "$PROJECT" && pwd -P && echo .) && PROJECT=${PROJECT%??}
case ${PROJECT##*/}:$PROJECT in
-* | *:*:* | *[[:cntrl:]]*)
    refuse "$PROJECT"
    ;;
esac
for folder in "$PROJECT/opensfm" "$PROJECT/opensfm/undistorted"; do
    if [ -L "$folder" ]; then
        refuse "$folder"
    fi
done
