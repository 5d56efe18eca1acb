#!/usr/bin/env python3
"""Compares the forecast of the fused area (`area` of the manifest's clusters) with what OpenMVS fuses of the first key views.

    benches/fused.py PROJECT WORK_FOLDER [--image-scale 0.5] [--openmvs FOLDER] [--viewrank viewrank]

Matches all key views once, then fuses the shortest prefixes of the plan with a forecast area of 20, 30 ... 90 %. The reference is the cloud of all
maps, whole, and where at least three of them agree:

    share      forecast by the pixels that show it, %
    area       forecast by area, %
    covered    cells of the reference (benches/sizes.py) with a point within 3 g_d, by number, which is about by pixels, and by area, %

Needs numpy, scipy and pycolmap, and resumes as benches/sizes.py does, whose folder of maps it shares.
"""

import argparse
import json
import os
from pathlib import Path

from scipy.spatial import cKDTree
from sizes import OpenMvs, Reference, one_per_cell


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/")
    parser.add_argument("work", type=Path, help="folder for maps and clouds")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--viewrank", default="viewrank")
    bench = OpenMvs(parser.parse_args())
    every = bench.plan("--budget", "100%", "--target", "100%")
    bench.match(every, 1.0)
    references = [Reference(bench.fuse(every, 1.0, agreeing=maps), bench) for maps in (1, 3)]
    print("maps  share %  area %  covered %  by area %  where three agree %  by area %")
    lengths = {next(c["rank"] for c in every["clusters"] if c["area"] >= tenth / 10) for tenth in range(2, 10)}
    for length in sorted(lengths):
        bench.plan("--budget", str(length), "--target", "100%")
        cloud, last = bench.fuse(every, 1.0), every["clusters"][length - 1]
        tree = cKDTree(one_per_cell(cloud, references[0].gsd.min() / 2))
        shares = [100 * last["share"], 100 * last["area"]] + [share for reference in references for share in reference.covered(tree, 3)]
        print(f"{length:4}  " + "  ".join(f"{share:{width}.1f}" for share, width in zip(shares, (7, 6, 9, 9, 19, 9))), flush=True)


if __name__ == "__main__":
    main()
