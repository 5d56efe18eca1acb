#!/bin/sh
# Measures plans on COLMAP's CUDA matcher, where an NVIDIA card can be had for ten minutes only: what is measured, and what is needed, is at the head of colmap_cuda.py.
#
#     benches/colmap_cuda.sh pack PROJECT REFERENCE PACK.tar.xz [--image-scale 0.5] [--wheels FOLDER]    anywhere: all that is to be carried, at most 60 MB
#     benches/colmap_cuda.sh run PACK.tar.xz WORK_FOLDER [--seconds 540]                                 where the card is: WORK_FOLDER/colmap_cuda.json
#
# PYTHON=/path/to/python takes another Python. Exit code 3: this machine, or its pycolmap, has no CUDA.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
if [ "${1:-}" = run ] && [ $# -ge 3 ]; then
    mkdir -p -- "$3"
    tar -xJf "$2" -C "$3"
    site=$(cd "$3" && pwd)/site
    export PYTHONPATH="$site${PYTHONPATH:+:$PYTHONPATH}"
    export LD_LIBRARY_PATH="$site/lib:$site/nvidia/cuda_runtime/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
fi
exec "${PYTHON:-python3}" "$here/colmap_cuda.py" "$@"
