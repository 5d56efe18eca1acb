#!/bin/sh
# Puts viewrank's scene in the place of the engine's own, and runs ODX; ENGINE=opendronemap/odm run.sh runs ODM.
set -eu
# sh names the script in its own messages, and the folders above it may have a stranger's names: it is started again as a name of our own.
case $0 in
.//run.sh) ;;
*)
    cd "$(dirname "$0")" && export OLDPWD && exec sh .//run.sh "$@"
    exit 1
    ;;
esac
@REFUSE_STRANGERS@
refuse_strangers links.txt .
# A link on the way to the folder that is replaced would lead out of the project.
project=${DATASETS:?folder of the projects, whole path}/${NAME:?name of the project}
for folder in "$project/opensfm" "$project/opensfm/undistorted"; do
    if [ -L "$folder" ]; then
        refuse "$folder"
    fi
done
