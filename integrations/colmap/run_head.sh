#!/bin/sh
# Computes and fuses the depth maps of viewrank's plan. Maps that are there already are kept; with --replace, those that were made
# with other partners are removed first. --fuse only fuses. COLMAP=/path/to/colmap run.sh takes another program.
set -eu
cd "$(dirname "$0")/../.."
if [ "${1:-}" = --replace ]; then
    while IFS= read -r map; do
        rm -f -- "stereo/depth_maps/$map" "stereo/normal_maps/$map" "stereo/consistency_graphs/$map"
    done < stereo/viewrank/replace.txt
fi
