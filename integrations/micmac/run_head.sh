#!/bin/sh
# usage: run.sh PATH/TO/Ori-NAME
# Computes the chosen view clusters with mm3d ($MM3D). A copy of the orientations, Ori-viewrank, takes the ImSec files: the folder that is named stays as it is.
set -eu
usage="usage: run.sh PATH/TO/Ori-NAME"
ori=$(cd "${1:?$usage}" && pwd -P)
cd "$(dirname "$0")"
copy="$(pwd -P)/Ori-viewrank"
case "$copy/" in
"${ori%/}"/*)
    echo "error: $ori is the copy that this script makes, or holds it; $usage, of the MicMac project that the model comes from" >&2
    exit 1
    ;;
esac
case "$ori" in
"$copy"/*)
    echo "error: $ori is in the copy that this script makes; $usage, of the MicMac project that the model comes from" >&2
    exit 1
    ;;
esac
if [ -e Ori-viewrank ] && [ ! -e Ori-viewrank/made-by-viewrank ]; then
    echo "error: $copy is there and not made by this script; move it away" >&2
    exit 1
fi
rm -rf Ori-viewrank
mkdir Ori-viewrank
: >Ori-viewrank/made-by-viewrank
cp -R "$ori"/. Ori-viewrank/
cp ImSec/*.xml Ori-viewrank/
