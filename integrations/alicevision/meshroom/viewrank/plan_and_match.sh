#!/bin/sh
# Work of the node ViewrankDepthMap: plans the model and matches its clusters below the node's folder.
#
#   plan_and_match.sh MODEL.sfm IMAGES FOLDER PARTNERS TARGET MATCH
set -eu
model=$1 images=$2 project=$3/project partners=$4 target=$5 match=$6

# The folder of a node may come from a stranger: nothing is written through a link, or into a folder in the place of one.
refuse() {
    echo "plan_and_match.sh: $1 is in the way; clear the cache of this node" >&2
    exit 1
}
[ ! -L "$project" ] || refuse "the link project"
mkdir -p "$project"
rm -f "$project/cameras.sfm" || refuse project/cameras.sfm
cp "$model" "$project/cameras.sfm"
if [ -n "$images" ]; then
    rm -f "$project/images" || refuse project/images
    ln -s "$images" "$project/images"
fi
viewrank plan "$project" --backend alicevision -k "$partners" --target "$target%"
viewrank report "$project" --quiet
case $match in
    [Tt]rue | 1) exec viewrank run "$project" --backend alicevision ;;
esac
