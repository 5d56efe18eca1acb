#!/usr/bin/env python3
"""Compares the forecast of prefixes of a plan (`share` and `area` of the manifest's clusters) with what OpenMVS or MVE makes of the first key views.

    benches/fused.py PROJECT WORK_FOLDER [--matcher openmvs|mve] [--image-scale 0.5] [--openmvs FOLDER] [--mve FOLDER] [--viewrank viewrank]

Matches all key views once, then joins the shortest prefixes of the plan with a forecast area of 20, 30 ... 90 %. The reference is the cloud of all
maps, whole, and, with OpenMVS, where at least three of them agree (MVE joins all depths):

    share      forecast by the pixels that show it, %
    area       forecast by area, %
    covered    cells of the reference (benches/sizes.py) with a point within 3 g_d, by number, which is about by pixels, and by area, %

Needs numpy, scipy and pycolmap, and resumes as benches/sizes.py does, whose folder of maps it shares.
"""

import argparse
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from sizes import Bench, OpenMvs, Reference, one_per_cell


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/")
    parser.add_argument("work", type=Path, help="folder for maps and clouds")
    parser.add_argument("--matcher", choices=("openmvs", "mve"), default="openmvs")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--mve", type=Path, default=Path(os.environ.get("MVE_BIN", ".")), help="folder of its programs")
    parser.add_argument("--viewrank", default="viewrank")
    args = parser.parse_args()
    args.gsd = None
    bench = {"openmvs": OpenMvs, "mve": Mve}[args.matcher](args)
    every = bench.plan("--budget", "100%", "--target", "100%")
    bench.match(every, 1.0)
    references = [Reference(cloud, bench) for cloud in bench.references(every)]
    print("maps  share %  area %  covered %  by area %" + "  where three agree %  by area %" * (len(references) - 1))
    lengths = {next(c["rank"] for c in every["clusters"] if c["area"] >= tenth / 10) for tenth in range(2, 10)}
    for length in sorted(lengths):
        bench.plan("--budget", str(length), "--target", "100%")
        cloud, last = bench.fuse({**every, "cut": {**every["cut"], "clusters": length}}, 1.0), every["clusters"][length - 1]
        tree = cKDTree(one_per_cell(cloud, references[0].gsd.min() / 2))
        shares = [100 * last["share"], 100 * last["area"]] + [share for reference in references for share in reference.covered(tree, 3)]
        print(f"{length:4}  " + "  ".join(f"{share:{width}.1f}" for share, width in zip(shares, (7, 6, 9, 9, 19, 9))), flush=True)


class Mve(Bench):
    """Maps of dmrecon, of which the first ones are joined by scene2pset."""

    def match_all(self, plan, scale):
        folder = self.maps(scale)
        if not folder.exists():
            shutil.copytree(self.project / "viewrank/mve", folder, symlinks=True)
        environment = {**os.environ, "PATH": f"{self.args.mve.resolve()}:{os.environ['PATH']}"}
        subprocess.run(["./run.sh"], cwd=folder, env=environment, stdout=subprocess.DEVNULL)

    def references(self, every):
        return [self.fuse(every, 1.0)]

    def fuse(self, plan, scale):
        """Points of the first maps, n x 3. Key views have the ids 0, 1, ... in the order of the plan that was matched."""
        folder, cloud = self.maps(scale), (self.work / "joined.ply").resolve()
        (level,) = [command.split()[1] for command in json.loads((folder / "export.json").read_text())["commands"] if command.startswith("scene2pset")]
        ids = ",".join(map(str, range(plan["cut"]["clusters"])))
        command = [self.args.mve.resolve() / "scene2pset", level, f"-v{ids}", ".", cloud]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        return positions(cloud.read_bytes())


def positions(data):
    """x, y and z of the vertices of a PLY of numbers."""
    head, kinds = data[: data.index(b"end_header\n") + 11], {"float": "<f4", "uchar": "u1"}
    vertex = head.decode().split("element vertex ")[1].split("element ")[0].splitlines()
    record = np.dtype([(name, kinds[kind]) for _, kind, name in (line.split() for line in vertex[1:] if line.startswith("property"))])
    rows = np.frombuffer(data, record, int(vertex[0]), len(head))
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(float)


if __name__ == "__main__":
    main()
