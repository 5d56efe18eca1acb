#!/bin/sh
# Makes the depth maps and the cloud. Stopped, the last two commands join the maps that are there.
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
# The program writes into the files that are there, and so under all of their names: each gets a file of its own first.
find depths fuse/fused.ply -type f -links +1 2> /dev/null | while IFS= read -r map; do
    own=$(mktemp "${map%/*}/XXXXXX")
    cp -p "$map" "$own"
    mv "$own" "$map"
done
