#!/usr/bin/env python3
"""How good the maps of sgm.py are, and which pairs it can match.

    measure.py maps OUT --workspace WORKSPACE --reference ../shared/data/valley/truth/depth
    measure.py pairs CACHE --workspace WORKSPACE --image-scale 0.5 --reference DIR

A reference is a folder with exact depth as the rendered sets have it (NAME.npz with lo, hi, mask) or with maps of sgm.py (OUT).
Errors are distances along the pixel's ray; an outlier is off by more than 3 g_d, g_d being 1.25 times the median GSD of the model in full
images, or --gsd.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from pairs import Pairs
from workspace import Workspace

RIGHT_PX = 2  # a single match is right when it is off by less, in disparity
WORKED = 0.5  # a pair works when it gets this share of what both views show right


def read_reference(folder, name):
    """z-depth (0 = none) at the size it has, or None."""
    for path in (folder / "depth_maps" / (name + ".npy"), folder / (name + ".npy")):
        if path.is_file():
            return np.load(path)
    path = folder / Path(name).with_suffix(".npz")
    return read_rendered(path) if path.is_file() else None


def read_rendered(path):
    """Exact depth of a rendered set: steps of 3 mm, second differences, zigzag coded (its README says how)."""
    with np.load(path) as file:
        zigzag, mask = file["hi"].astype(np.uint16) * 256 + file["lo"], file["mask"]
    differences = (zigzag >> 1) ^ (0 - (zigzag & 1)).astype(np.uint16)
    steps = np.cumsum(np.cumsum(differences, axis=0, dtype=np.uint16), axis=1, dtype=np.uint16)
    return np.where((mask == 1) | (mask == 3), steps * np.float32(0.003), 0).astype(np.float32)


def resized(depth, size):
    """Depth at another size: inverse depth between pixels where neighbours are within 2 %, else the nearest."""
    if depth.shape[::-1] == size:
        return depth
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), np.nan).astype(np.float32)
    nearest, smooth = (cv2.resize(inverse, size, interpolation=how) for how in (cv2.INTER_NEAREST_EXACT, cv2.INTER_LINEAR))
    with np.errstate(invalid="ignore"):
        inverse = np.where(np.abs(smooth - nearest) < 0.02 * nearest, smooth, nearest)
    return np.nan_to_num(1 / inverse, nan=0).astype(np.float32)


def ray_lengths(view):
    """Distance along the ray per unit of z-depth."""
    w, h = view.size
    x = (np.arange(w)[None, :] - view.K[0, 2]) / view.K[0, 0]
    y = (np.arange(h)[:, None] - view.K[1, 2]) / view.K[1, 1]
    return np.sqrt(1 + x * x + y * y)


def measure_maps(args):
    report = json.loads((args.out / "report.json").read_text(encoding="utf-8"))
    workspace = Workspace(args.workspace, report["settings"]["image_scale"])
    limit = 3 * (args.gsd or 1.25 * Workspace(args.workspace).gsd())
    rows = []
    for row in report["clusters"]:
        depth, reference = np.load(args.out / "depth_maps" / (row["key"] + ".npy")), read_reference(args.reference, row["key"])
        if reference is None:
            continue
        reference = resized(reference, depth.shape[::-1])
        error = np.abs(depth - reference) * ray_lengths(workspace.views[row["key"]])
        both = (depth > 0) & (reference > 0)
        right = both & (error <= limit)
        rows.append([(reference > 0).sum(), both.sum(), right.sum(), (error[right] ** 2).sum()])
        if args.each:
            print(f"{row['key']:<30} completeness {right.sum() / max((reference > 0).sum(), 1):.3f} outliers {1 - right.sum() / max(both.sum(), 1):.4f}")
    pixels, both, right, squares = np.sum(rows, axis=0)
    seconds = np.mean([p["seconds"] for row in report["clusters"] for p in row["partners"] if p["matched"]])
    print(f"{len(rows)} maps: completeness {right / pixels:.4f}, outliers {1 - right / both:.4f}, RMSE {np.sqrt(squares / right):.4f} (limit {limit:.4f}); {seconds:.3f} s per pair")


def measure_pairs(args):
    workspace = Workspace(args.workspace, args.image_scale)
    pairs = Pairs(workspace, args.cache)
    rows = []
    for key in workspace.views:
        if args.every > 1 and len(rows) and list(workspace.views).index(key) % args.every:
            continue
        for partner, _ in workspace.connected(key)[: args.connected]:
            rows.append(pair_row(workspace, pairs.get(key, partner), key, partner, args.reference))
    rows = [row for row in rows if row]
    print(f"{len(rows)} pairs; worked: at least {WORKED:.0%} of what both views show is within {RIGHT_PX} px")
    for name, edges in BINS.items():
        table(name, edges, rows)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


def pair_row(workspace, pair, key, partner, folder):
    """Geometry of a pair and what it got right of the surface that both views show."""
    a, b = workspace.views[key], workspace.views[partner]
    here, there = (read_reference(folder, v.name) for v in (a, b))
    if here is None or there is None or not np.isfinite(pair.angle):
        return None
    here, there = resized(here, a.size), resized(there, b.size)
    common = seen_by_both(a, b, here, there)
    row = {"key": key, "partner": partner, "angle": pair.angle, "octaves": pair.octaves, "epipole": epipole_distance(a, b), "common": float(common.mean()), "refused": pair.refused,
           "complete": 0.0, "wrong": 0.0, "error": 0.0}
    if common.sum() < 500:
        return None
    if pair.inverse is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.abs(pair.inverse - 1 / here) / pair.parallax.deviation(pair.inverse)
        found = np.isfinite(pair.inverse) & (here > 0)
        right = found & (error < RIGHT_PX)
        row |= {"complete": float(right[common].mean()), "wrong": float(1 - right.sum() / max(found.sum(), 1)), "error": float(np.median(error[right])) if right.any() else 0.0}
    return row


def seen_by_both(a, b, here, there):
    """Key pixels whose surface point the partner's reference shows too, within 2 % of its depth."""
    w, h = a.size
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(a.K).T
    xyz = (rays * here.reshape(-1, 1) - a.t) @ a.R
    pixels, depth = b.project(xyz)
    x, y = np.rint(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).clip(-9, 1e6).astype(int).T
    ok = (here.ravel() > 0) & (depth > 0) & (x >= 0) & (y >= 0) & (x < b.size[0]) & (y < b.size[1])
    shown = there[y.clip(0, b.size[1] - 1), x.clip(0, b.size[0] - 1)]
    return (ok & (np.abs(shown - depth) < 0.02 * depth)).reshape(h, w)


def epipole_distance(a, b):
    """Distance of the nearer epipole from its image's border in image widths; negative inside."""
    distances = []
    for v, other in ((a, b), (b, a)):
        e = v.K @ (v.R @ other.centre + v.t)
        x, y = e[:2] / (e[2] if abs(e[2]) > 1e-12 else 1e-12)
        dx, dy = max(-x, x - v.size[0]), max(-y, y - v.size[1])
        distances.append((np.hypot(max(dx, 0), max(dy, 0)) if max(dx, dy) > 0 else max(dx, dy)) / v.size[0])
    return float(min(distances))


BINS = {
    "angle": [0, 1, 2, 3, 5, 8, 12, 20, 30, 40, 50, 60, 75, 90],
    "octaves": [-3, -1.2, -0.8, -0.5, -0.2, 0.2, 0.5, 0.8, 1.2, 1.6, 3],
    "epipole": [-1, -0.25, -0.1, 0, 0.1, 0.25, 0.5, 1, 1e9],
}


def table(name, edges, rows):
    print(f"{name:>16} pairs refused worked complete wrong error_px")
    for low, high in zip(edges, edges[1:], strict=False):
        part = [r for r in rows if low <= r[name] < high]
        if not part:
            continue
        made = [r for r in part if not r["refused"]]
        mean = lambda field, of: np.mean([r[field] for r in of]) if of else float("nan")
        print(f"{low:>7g}..{high:<7g} {len(part):5} {len(part) - len(made):7} {np.mean([r['complete'] >= WORKED for r in part]):6.2f} {mean('complete', part):8.2f} {mean('wrong', made):5.2f} {mean('error', made):8.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    maps = commands.add_parser("maps", help="completeness, outliers and RMSE of depth maps")
    maps.add_argument("out", type=Path)
    maps.add_argument("--gsd", type=float, help="g_d in scene units")
    maps.add_argument("--each", action="store_true", help="a line per map")
    pairs = commands.add_parser("pairs", help="success of single pairs by angle, scale ratio and epipole")
    pairs.add_argument("cache", type=Path)
    pairs.add_argument("--image-scale", type=float, default=1.0)
    pairs.add_argument("--connected", type=int, default=22)
    pairs.add_argument("--every", type=int, default=1, help="only every N-th key view")
    pairs.add_argument("--json", type=Path, help="write the rows here")
    for p in (maps, pairs):
        p.add_argument("--workspace", type=Path, required=True)
        p.add_argument("--reference", type=Path, required=True)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    measure_maps(args) if args.command == "maps" else measure_pairs(args)


if __name__ == "__main__":
    main()
