#!/usr/bin/env python3
"""Compares numbers of partners per key view by the clouds that OpenMVS or integrations/sgm makes, over the work.

    benches/partners.py PROJECT WORK_FOLDER --openmvs FOLDER [-k 3 5 8 12 16] [--image-scale 0.5] [--viewrank viewrank]
    benches/partners.py PROJECT WORK_FOLDER --matcher sgm

For each k, matches all key views with the partners of `viewrank plan -k K` and fuses their maps as `viewrank run` does; then, for a quarter, a half and all of the CPU time of all maps with
k = 5, the first maps of that k's plan that fit in it. g_d and cells as in benches/sizes.py. In a set with exact depth (PROJECT/truth):

    complete   cells of the true surface that two photographs show with a point within 2 g_d, %
    accurate   points (one per cell of half the finest g_d) within 2 g_d of the true surface, %
    F1         harmonic mean of the two

In other sets:

    complete   cells of the union of the clouds of all k with a point within 2 g_d, %
    agreed     the same of those cells that the clouds of three k (of two, if fewer than three were run) have, %

Writes WORK_FOLDER/partners.json, from which benches/tables.py makes the table in docs/benchmarks.md. Needs numpy, scipy and pycolmap, with sgm its requirements; maps that are there are kept.
"""

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np
import pycolmap
from render import depth_file
from scipy.spatial import cKDTree
from sizes import OpenMvs, Reference, Sgm, one_per_cell

BASE = 5
WORK = (0.25, 0.5, 1.0)
TOLERANCE = 2  # g_d
STEP = 2  # every second pixel of the exact depth, about g_d


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/, and truth/ if it is rendered")
    parser.add_argument("work", type=Path, metavar="work_folder", help="folder for maps, clouds and the result")
    parser.add_argument("-k", type=int, nargs="+", default=[3, 5, 8, 12, 16])
    parser.add_argument("--matcher", choices=("openmvs", "sgm"), default="openmvs")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--viewrank", default="viewrank")
    args = parser.parse_args()
    if BASE not in args.k:
        parser.error(f"-k: {BASE} is missing, whose work is that of the others")
    args.gsd = None
    runs = [Run(args, k) for k in sorted(set(args.k))]
    base = next(run for run in runs if run.k == BASE)
    score = Exact(args.project / "truth", base.bench) if (args.project / "truth/depth").is_dir() else Union([run.cloud() for run in runs], base.bench)
    rows = [row_of(run, base, score) for run in runs]
    result = {"set": args.project.resolve().name, "matcher": args.matcher, "image_scale": args.image_scale, "exact": isinstance(score, Exact), "cells": len(score.cells), "rows": rows}
    (args.work / "partners.json").write_text(json.dumps(result, indent=1) + "\n")


class Run:
    """All key views matched with k partners each."""

    def __init__(self, args, k):
        self.k = k
        self.bench = {"openmvs": OpenMvs, "sgm": Sgm}[args.matcher](argparse.Namespace(**{**vars(args), "work": args.work / f"k-{k}"}))
        self.every = self.bench.plan("-k", str(k), "--budget", "100%", "--target", "100%")
        self.clusters = self.every["clusters"]
        self.seconds = self.bench.match(self.every, 1.0) * len(self.clusters)

    def cloud(self, number=None):
        return self.bench.fuse({**self.every, "clusters": self.clusters[:number]}, 1.0)

    def fitting(self, seconds):
        """Number of the first maps that take this long."""
        return min(len(self.clusters), max(2, round(seconds / self.seconds * len(self.clusters))))


def row_of(run, base, score):
    cloud = run.cloud()
    partners = sum(len(cluster["partners"]) for cluster in run.clusters) / len(run.clusters)
    row = {"k": run.k, "partners": partners, "maps": len(run.clusters), "seconds": run.seconds, "points": len(cloud), **score.of(cloud), "at": []}
    print(f"k {run.k}: {partners:.1f} partners, {run.seconds:.0f} CPU s, {len(cloud)} points, {text(row)}", flush=True)
    for share in WORK:
        number = run.fitting(share * base.seconds)
        row["at"].append({"work": share, "maps": number, **score.of(run.cloud(number))})
        print(f"    in {share:4.0%} of the time of k = {BASE}: {number:3} maps, {text(row['at'][-1])}", flush=True)
    return row


def text(scores):
    return ", ".join(f"{name} {100 * scores[name]:.1f}" for name in ("complete", "accurate", "F1", "agreed") if name in scores)


class Exact:
    """The true surface, as far as two photographs show it."""

    def __init__(self, truth, bench):
        views = list(true_views(truth, {image.name for image in bench.model.images.values()}))
        self.reference = Reference(np.concatenate([view.points() for view in views]), bench)
        shown = sum(view.shows(self.reference.cells).astype(int) for view in views) >= 2
        self.cells, self.gsd = self.reference.cells[shown], self.reference.gsd[shown]

    def of(self, cloud):
        thinned = one_per_cell(cloud, self.gsd.min() / 2)
        complete = (cKDTree(thinned).query(self.cells)[0] <= TOLERANCE * self.gsd).mean()
        distance, nearest = self.reference.tree.query(thinned)
        accurate = (distance <= TOLERANCE * self.reference.points_gsd[nearest]).mean()
        return {"complete": complete, "accurate": accurate, "F1": f1(complete, accurate)}


def f1(complete, accurate):
    return 2 * complete * accurate / (complete + accurate) if complete + accurate else 0.0


class Union:
    """What the clouds of all k have together."""

    def __init__(self, clouds, bench):
        reference = Reference(np.concatenate(clouds), bench)
        self.cells, self.gsd = reference.cells, reference.gsd
        self.agreed = sum(self.has(cloud).astype(int) for cloud in clouds) >= min(3, max(1, len(clouds) - 1))

    def has(self, cloud):
        return cKDTree(cloud).query(self.cells)[0] <= TOLERANCE * self.gsd

    def of(self, cloud):
        has = self.has(cloud)
        return {"complete": has.mean(), "agreed": has[self.agreed].mean()}


class TrueView:
    """Exact depth of a view, with its true pose."""

    def __init__(self, depth, matrix, pose):
        self.depth, self.matrix, self.pose = depth, matrix, pose

    def points(self):
        y, x = (STEP * index for index in np.nonzero(self.depth[::STEP, ::STEP]))
        rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1) @ np.linalg.inv(self.matrix).T
        return (rays * self.depth[y, x, None] - self.pose.translation) @ self.pose.rotation.matrix()

    def shows(self, points):
        """Is nothing before the points, within 2 % of their depth?"""
        seen = points @ self.pose.rotation.matrix().T + self.pose.translation
        front = seen[:, 2] > 0
        projected = seen @ self.matrix.T / np.where(front, seen[:, 2], 1)[:, None]
        x, y = np.floor(np.clip(projected[:, :2], -1, 1e6)).astype(int).T
        height, width = self.depth.shape
        inside = front & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        depth = self.depth[y.clip(0, height - 1), x.clip(0, width - 1)]
        return inside & (np.abs(depth - seen[:, 2]) <= 0.02 * seen[:, 2])


def true_views(truth, names):
    model = pycolmap.Reconstruction(truth / "sparse/0")
    for image in model.images.values():
        path = truth / "depth" / Path(image.name).with_suffix(".npz")
        if image.name not in names or not path.is_file():
            continue
        depth, _ = depth_file.read(path)
        camera = model.cameras[image.camera_id]
        scale = np.diag([depth.shape[1] / camera.width, depth.shape[0] / camera.height, 1])
        yield TrueView(depth, scale @ camera.calibration_matrix(), image.cam_from_world())


if __name__ == "__main__":
    sys.exit(main())
