#!/bin/sh
# Work of the node ViewrankDepthMap: plans the model and matches its clusters below the node's folder.
#
#   plan_and_match.sh MODEL.sfm IMAGES FOLDER PARTNERS TARGET MATCH
set -eu
model=$1 images=$2 project=$3/project partners=$4 target=$5 match=$6

mkdir -p "$project"
cp "$model" "$project/cameras.sfm"
if [ -n "$images" ]; then
    rm -f "$project/images"
    ln -s "$images" "$project/images"
fi
viewrank plan "$project" --backend alicevision -k "$partners" --target "$target%"
viewrank report "$project" --quiet
case $match in
    [Tt]rue | 1) cd "$project/viewrank/alicevision" && exec ./run.sh ;;
esac
