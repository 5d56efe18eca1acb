#!/bin/sh
# Makes the depth maps and the cloud. Stopped, the last two commands join the maps that are there.
set -eu
cd "$(dirname "$0")"
@REFUSE_STRANGERS@
refuse_strangers links.txt .
# The program writes into the files that are there, and so under all of their names: each gets a file of its own first.
find depths fuse/fused.ply -type f -links +1 2> /dev/null | while IFS= read -r map; do
    own=$(mktemp "${map%/*}/XXXXXX")
    cp -p "$map" "$own"
    mv "$own" "$map"
done
