#!/usr/bin/env python3
"""Compares the forecast of the fused area (`area` of the manifest's clusters) with what OpenMVS fuses of the first key views.

    benches/fused.py PROJECT WORK_FOLDER [--image-scale 0.5] [--openmvs FOLDER] [--viewrank viewrank]

Matches all key views once, then fuses the shortest prefixes of the plan with a forecast area of 20, 30 ... 90 %. The reference is the cloud of all
maps, whole, and where at least three of them agree:

    share      forecast by the pixels that show it, %
    area       forecast by area, %
    covered    share of the cells of 2 g_d of the reference with a point within 2 and within 3 g_d, %

Needs numpy and scipy, and resumes as benches/sizes.py does, whose folder of maps it shares.
"""

import argparse
import json
import os
from pathlib import Path

from scipy.spatial import cKDTree
from sizes import Bench, Reference, one_per_cell


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/")
    parser.add_argument("work", type=Path, help="folder for maps and clouds")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--viewrank", default="viewrank")
    bench = Bench(parser.parse_args())
    every = bench.plan("--budget", "100%", "--target", "100%")
    bench.match(every, 1.0)
    gsd = every["settings"]["target"]["gsd"]
    whole, agreed = [Reference(bench.fuse(every, {1.0}, agreeing=maps), gsd) for maps in (1, 3)]
    print("maps  share %  area %  covered 2 g_d %  3 g_d %  where three agree 2 g_d %  3 g_d %")
    lengths = {next(c["rank"] for c in every["clusters"] if c["area"] >= tenth / 10) for tenth in range(2, 10)}
    for length in sorted(lengths):
        bench.plan("--budget", str(length), "--target", "100%")
        tree, last = cKDTree(one_per_cell(bench.fuse(every, {1.0}), gsd / 2)), every["clusters"][length - 1]
        shares = [last["share"], last["area"]]
        for reference in (whole, agreed):
            near, _ = tree.query(reference.cells, distance_upper_bound=3 * gsd)
            shares += [(near <= 2 * gsd).mean(), (near <= 3 * gsd).mean()]
        print(f"{length:4}  " + "  ".join(f"{100 * share:{width}.1f}" for share, width in zip(shares, (7, 6, 15, 7, 25, 7))), flush=True)


if __name__ == "__main__":
    main()
