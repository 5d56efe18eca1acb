#!/usr/bin/env python3
"""Judges orders of depth maps by the cloud that OpenMVS fuses: which share of its cells do the first maps of an order cover?

    benches/cells.py PROJECT WORK_FOLDER --openmvs FOLDER [--image-scale 0.5] [--check] [--viewrank viewrank]
    benches/cells.py TABLE

Matches all key views once, fuses all maps, and writes WORK_FOLDER/.../cells.tsv, the incidence table: the first line names the maps in the plan's order, each other
line has the number of cells in which the same maps take part, the number of those in which three maps agree on one point, and these maps as a
hexadecimal mask (bit 0: rank 1). From then on the table alone, a few hundred kB, judges any order within seconds:

    cells      cubes of 2 g_d, where g_d is that of the place (benches/sizes.py); a map takes part in a cell if it agrees on a point within 2 g_d of it
    covered    cells in which two of the first maps take part, in per cent of all cells, and of those in which three maps agree
    way        0 for every n-th view (mean of two offsets), 1 for the oracle
    oracle     the map next that covers most cells, known only afterwards: a cell with one map counts 0.2 (or a third, whatever covers more)

--check also fuses the first maps of three orders at 10 and 30 %, and compares their clouds with what the table says. Needs numpy, scipy and pycolmap; runs resume as those of
benches/sizes.py, whose folder of maps this shares.
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree
from sizes import OpenMvs, Reference, read_cloud

TENTHS = (0.1, 0.2, 0.3, 0.5)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/, or a table")
    parser.add_argument("work", type=Path, nargs="?", metavar="work_folder", help="folder for maps, clouds and the table")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--check", action="store_true", help="compare the table with real fusions of the first maps")
    parser.add_argument("--viewrank", default="viewrank")
    args = parser.parse_args()
    if args.project.is_file():
        return show(Incidence.read(args.project), {})
    if args.work is None:
        parser.error("a project needs a work folder")
    args.matcher, args.gsd = "openmvs", None
    bench = OpenMvs(args)
    every = bench.plan("--budget", "100%", "--target", "100%")
    bench.match(every, 1.0)
    path, cells = bench.work / "cells.tsv", None
    if not path.exists():
        bench.fuse(every, 1.0)
        cells, table = incidence(bench.work / "fused/fused.ply", every, bench)
        table.write(path)
    table = Incidence.read(path)
    others = orders_of_the_model(table.names, bench.model)
    show(table, others)
    if args.check:
        if cells is None:
            bench.fuse(every, 1.0)
            cells, _ = incidence(bench.work / "fused/fused.ply", every, bench)
        check(table, cells, others, every, bench)


class Incidence:
    """Which maps take part in which cells: rows of the same maps, `maps` (rows x maps), with their numbers of cells and of cells where three agree."""

    def __init__(self, names, maps, cells, agreeing):
        self.names, self.maps, self.cells, self.agreeing = names, maps, cells, agreeing

    @classmethod
    def read(cls, path):
        head, *lines = path.read_text(encoding="utf-8").splitlines()
        names, rows = head.split("\t"), [line.split("\t") for line in lines]
        masks = [int(mask, 16) for _, _, mask in rows]
        maps = np.array([[mask >> i & 1 for i in range(len(names))] for mask in masks], bool)
        return cls(names, maps, *(np.array([int(row[column]) for row in rows]) for column in (0, 1)))

    def write(self, path):
        mask = lambda row: sum(1 << int(i) for i in np.flatnonzero(row))  # noqa: E731
        lines = [f"{cells}\t{agreeing}\t{mask(row):x}" for row, cells, agreeing in zip(self.maps, self.cells, self.agreeing)]
        path.write_text("\n".join(["\t".join(self.names), *lines]) + "\n", encoding="utf-8")

    def covered(self, chosen):
        """Share of the cells, and of those where three agree, in which two of the chosen maps take part, %."""
        hit = self.maps[:, list(chosen)].sum(1) >= 2
        return [100 * weight[hit].sum() / weight.sum() for weight in (self.cells, self.agreeing)]

    def usable(self):
        """Maps that take part somewhere; OpenMVS may refuse a map."""
        return [int(i) for i in np.flatnonzero(self.maps.any(0))]

    def oracle(self, credit, weight):
        """The map next that adds most cells; one with a single map counts `credit`."""
        left, order, value = self.usable(), [], np.array([0, credit, 1, 1])
        number, maps = np.zeros(len(self.maps), int), self.maps.astype(np.float32)
        while left:
            gain = (weight * (value[number + 1] - value[number])) @ maps[:, left]
            order.append(left.pop(int(np.argmax(gain))))
            number = np.minimum(number + self.maps[:, order[-1]], 2)
        return order


def incidence(cloud, every, bench):
    """Cells of a fused cloud, and which of the maps (in the plan's order) take part in them."""
    xyz, number, points, views = cloud_with_views(cloud)
    cells = Reference(xyz, bench)
    names = [cluster["key"] for cluster in every["clusters"]]
    takes_part, agreeing = np.zeros((len(cells.cells), len(names)), bool), np.zeros(len(cells.cells), bool)
    distance, nearest = cKDTree(cells.cells).query(xyz, k=6, distance_upper_bound=2 * cells.gsd.max())
    for neighbour, far in zip(nearest.T, distance.T):
        near = np.flatnonzero(np.isfinite(far))
        near = near[far[near] <= 2 * cells.gsd[neighbour[near]]]
        agreeing[neighbour[near[number[near] >= 3]]] = True
        is_near = np.zeros(len(xyz), bool)
        is_near[near] = True
        kept = is_near[points]
        takes_part[neighbour[points[kept]], views[kept]] = True
    rows, which = np.unique(np.packbits(takes_part, axis=1), axis=0, return_inverse=True)
    which = which.ravel()
    maps = np.unpackbits(rows, axis=1)[:, : len(names)].astype(bool)
    table = Incidence(names, maps, np.bincount(which), np.bincount(which, weights=agreeing).astype(int))
    return (cells, agreeing), table


def cloud_with_views(path):
    """Positions of OpenMVS's fused.ply, how many maps agree on each point, and which: a point and a map (its place in fuse.mvs) per entry."""
    data = path.read_bytes()
    at = data.index(b"end_header\n") + 11
    number, views, all_views = [], [], np.frombuffer(data, np.uint8)
    while at < len(data):
        number.append(data[at + 27])
        views.append(at + 28)
        at += 29 + 8 * number[-1]
    number = np.array(number)
    points = np.repeat(np.arange(len(number)), number)
    first = np.repeat(np.cumsum(number) - number, number)
    starts = np.repeat(np.array(views), number) + 4 * (np.arange(len(points)) - first)
    return read_cloud(path), number, points, all_views[starts[:, None] + np.arange(4)].copy().view("<u4").ravel().astype(int)


def every_nth(table, number, offset):
    """So many maps, evenly spread over the names."""
    by_name = sorted(table.usable(), key=lambda i: table.names[i])
    return [by_name[int((i + offset) * len(by_name) / number) % len(by_name)] for i in range(number)]


def orders_of_the_model(names, model):
    """maxpts: the view with most sparse points that no earlier one observes; farthest: the camera farthest from all earlier ones."""
    images = {image.name: image for image in model.images.values()}
    seen = [{point.point3D_id for point in images[name].points2D if point.has_point3D()} for name in names]
    left, before, maxpts = sorted(range(len(names)), key=lambda i: names[i]), set(), []
    while left:
        best = max(left, key=lambda i: len(seen[i] - before))
        left.remove(best)
        maxpts.append(best)
        before |= seen[best]
    centres = np.array([images[name].projection_center() for name in names])
    farthest = [int(np.argmin(np.linalg.norm(centres - centres.mean(0), axis=1)))]
    while len(farthest) < len(names):
        distance = np.linalg.norm(centres[:, None] - centres[farthest], axis=2).min(1)
        distance[farthest] = -1
        farthest.append(int(np.argmax(distance)))
    return {"maxpts": maxpts, "farthest view": farthest}


def show(table, others):
    usable = table.usable()
    only = lambda order: [i for i in order if i in set(usable)]  # noqa: E731
    numbers = [max(2, round(tenth * len(usable))) for tenth in TENTHS]
    print(f"{len(usable)} maps, {table.cells.sum()} cells, {table.agreeing.sum()} where three maps agree; at {numbers} maps")
    generator = np.random.default_rng(1)
    randoms = [list(generator.permutation(usable)) for _ in range(10)]
    orders = {"ours": only(range(len(table.names))), **{name: only(order) for name, order in others.items()}}
    mean = lambda choices: np.mean([table.covered(chosen) for chosen in choices], axis=0)  # noqa: E731
    rows = {name: [table.covered(order[:n]) for n in numbers] for name, order in orders.items()}
    rows["every n-th"] = [mean([every_nth(table, n, offset) for offset in (0, 0.5)]) for n in numbers]
    rows["random"] = [mean([order[:n] for order in randoms]) for n in numbers]
    # The oracle of each column is greedy by its own cells.
    best = [[table.oracle(credit, weight) for credit in (0.2, 1 / 3)] for weight in (table.cells, table.agreeing)]
    rows["oracle"] = [[max(table.covered(order[:n])[column] for order in best[column]) for column in (0, 1)] for n in numbers]
    print(f"{'':14} {'all cells':28}  three agree")
    for name, row in rows.items():
        print(f"{name:14} " + "   ".join(" ".join(f"{value[column]:6.1f}" for value in row) for column in (0, 1)))
    way = lambda column: [(o[column] - n[column]) / (t[column] - n[column]) for o, n, t in zip(rows["ours"], rows["every n-th"], rows["oracle"])]  # noqa: E731
    print(f"{'way of ours':14} " + "   ".join(" ".join(f"{value:6.2f}" for value in way(column)) for column in (0, 1)))
    for column, what in enumerate(("all cells", "three agree")):
        needed = {name: [least(lambda n: table.covered(order[:n])[column], len(usable), share) for share in (50, 70, 80, 90)] for name, order in orders.items()}
        needed["every n-th"] = [least(lambda n: mean([every_nth(table, n, offset) for offset in (0, 0.5)])[column], len(usable), share) for share in (50, 70, 80, 90)]
        needed["oracle"] = [min(least(lambda n: table.covered(order[:n])[column], len(usable), share) for order in best[column]) for share in (50, 70, 80, 90)]
        print(f"maps for 50, 70, 80, 90 % ({what}): " + "; ".join(f"{name} {', '.join(map(str, counts))}" for name, counts in needed.items()))


def least(covered, most, share):
    return next((n for n in range(2, most + 1) if covered(n) >= share), most)


def check(table, cells, others, every, bench):
    """Real fusions of the first maps against the table."""
    (reference, agreeing), usable = cells, set(table.usable())
    print(f"{'real, table':24} all cells        three agree")
    for tenth in (TENTHS[0], TENTHS[2]):
        number = max(2, round(tenth * len(usable)))
        choices = {"ours": [i for i in range(len(table.names)) if i in usable][:number], "every n-th": every_nth(table, number, 0)}
        choices["maxpts"] = [i for i in others["maxpts"] if i in usable][:number]
        for name, chosen in choices.items():
            cloud = bench.fuse({**every, "clusters": [every["clusters"][i] for i in chosen]}, 1.0)
            near = cKDTree(cloud).query(reference.cells)[0] <= 2 * reference.gsd
            real, said = [100 * near.mean(), 100 * near[agreeing].mean()], table.covered(chosen)
            print(f"{number:4} {name:19} " + "    ".join(f"{a:5.1f}, {b:5.1f}" for a, b in zip(real, said)), flush=True)


if __name__ == "__main__":
    sys.exit(main())
