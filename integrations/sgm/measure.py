#!/usr/bin/env python3
"""Measures the maps of sgm.py, and the pairs that it can match.

    measure.py maps OUT --workspace WORKSPACE --reference target/data/valley/truth/depth
    measure.py pairs CACHE --workspace WORKSPACE --image-scale 0.5 --reference DIR     which pairs can be matched
    measure.py pixels CACHE --workspace WORKSPACE --image-scale 0.5 --reference DIR    where in a pair, and by how many partners

A reference is a folder with exact depth as the rendered sets have it (NAME.npz with lo, hi, mask) or with maps of sgm.py (OUT).
Errors are distances along the pixel's ray; an outlier is off by more than 3 g_d, g_d being 1.25 times the median GSD of the model in full
images, or --gsd.
"""

import errno
import os
import sys


def explain(kind, error, _):
    """One line in place of a trace: files and paths may be a stranger's."""
    what = getattr(error, "strerror", None) or " ".join(f"{kind.__name__}: {error}".split())
    cure = "move the project to a shorter path" if getattr(error, "errno", None) == errno.ENAMETOOLONG else "check the files that it reads, or export again"
    print("interrupted" if kind is KeyboardInterrupt else f"error: {getattr(error, 'filename', None) or __file__}: {what}; {cure}", file=sys.stderr)


if __name__ == "__main__":
    sys.excepthook = explain
    # The current folder may be a stranger's: a json.py that he put there is not imported.
    sys.path[1:] = [path for path in sys.path[1:] if os.path.realpath(path) != os.path.realpath(os.curdir)]

import argparse
import functools
import itertools
import json
from pathlib import Path

import cv2
import numpy as np

from merge import merge
from pairs import Pairs
from workspace import Workspace, read_record

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
    report = json.loads(read_record(args.out / "report.json"))
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
    for key in list(workspace.views)[:: args.every]:
        for partner, _ in workspace.connected(key)[: args.connected]:
            rows.append(pair_row(workspace, pairs.get(key, partner), key, partner, args.reference))
    rows = [row for row in rows if row]
    print(f"{len(rows)} pairs; worked: at least {WORKED:.0%} of what both views show is within {RIGHT_PX} px")
    for name, edges in BINS.items():
        table(name, edges, rows)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


def pair_row(workspace, pair, key, partner, folder):
    """Returns the geometry of a pair, and the share of the surface shown by both views that it measured right."""
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
    if pair.matched:
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.abs(pair.inverse() - 1 / here) / pair.deviation()
        found = (pair.code > 0) & (here > 0)
        right = found & (error < RIGHT_PX)
        row |= {"complete": float(right[common].mean()), "wrong": float(1 - right.sum() / max(found.sum(), 1)), "error": float(np.median(error[right])) if right.any() else 0.0}
    return row


def surface(view, depth):
    """World points (h x w x 3) of a depth map, and their unit normals towards the camera (nan beside gaps and at depth edges)."""
    w, h = view.size
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.K).T
    z = np.where(depth > 0, depth, np.nan)
    xyz = (rays * z[..., None] - view.t) @ view.R
    along, across = np.full_like(xyz, np.nan), np.full_like(xyz, np.nan)
    along[:, 2:-2], across[2:-2] = xyz[:, 4:] - xyz[:, :-4], xyz[4:] - xyz[:-4]
    normal = np.cross(across, along)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    jump = np.abs(cv2.Laplacian(z, cv2.CV_64F, ksize=5)) / 16 > 0.02 * z
    normal[jump] = np.nan
    return xyz, np.where(((view.centre - xyz) * normal).sum(-1, keepdims=True) < 0, -normal, normal)


def seen_by_both(a, b, here, there):
    """Key pixels whose surface point the partner's reference shows too, within 2 % of its depth."""
    pixels, depth = b.project(surface(a, here)[0].reshape(-1, 3))
    x, y = np.rint(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).clip(-9, 1e6).astype(int).T
    ok = (depth > 0) & (x >= 0) & (y >= 0) & (x < b.size[0]) & (y < b.size[1])
    shown = there[y.clip(0, b.size[1] - 1), x.clip(0, b.size[0] - 1)]
    return (ok & (np.abs(shown - depth) < 0.02 * depth)).reshape(here.shape)


def epipole_distance(a, b):
    """Distance of the nearer epipole from its image's border in image widths; negative inside."""
    distances = []
    for v, other in ((a, b), (b, a)):
        e = v.K @ (v.R @ other.centre + v.t)
        x, y = e[:2] / (e[2] if abs(e[2]) > 1e-12 else 1e-12)
        dx, dy = max(-x, x - v.size[0]), max(-y, y - v.size[1])
        distances.append((np.hypot(max(dx, 0), max(dy, 0)) if max(dx, dy) > 0 else max(dx, dy)) / v.size[0])
    return float(min(distances))


# ------------------------------------------------------------------------------------------------------ within a pair


def measure_pixels(args):
    """Success of single matches by incidence, scale and angle at the pixel; of merged maps by partners that see it and by incidence."""
    workspace = Workspace(args.workspace, args.image_scale)
    pairs, limit = Pairs(workspace, args.cache), 3 * (args.gsd or 1.25 * Workspace(args.workspace).gsd())
    rng, single, merged = np.random.default_rng(0), [], []
    for key in list(workspace.views)[:: args.every]:
        here = read_reference(args.reference, key)
        if here is None:
            continue
        here = resized(here, workspace.views[key].size)
        partners = [p for p, _ in workspace.connected(key)[: args.connected]]
        chosen = [(p, pairs.get(key, p)) for p in partners]
        sample = rng.choice(here.size, 3000, replace=False)
        columns = [pixel_columns(workspace, pair, key, p, here, args.reference, sample) for p, pair in chosen]
        single += [c[c[:, 0] > 0, 1:] for c in columns if c is not None]
        merged += merged_rows(workspace.views[key], chosen, columns, here, sample, limit, rng)
    single, merged = np.concatenate(single), np.concatenate(merged)
    for name, column, edges in (("key incidence", 1, INCIDENCES), ("worse incidence", 2, INCIDENCES), ("octaves", 3, BINS["octaves"]), ("angle", 4, BINS["angle"])):
        shares(f"single matches within {RIGHT_PX} px, by {name}", single[:, 0], single[:, column], edges)
    shares(f"merged within {limit:.3g}, by partners that see the pixel", merged[:, 0], merged[:, 1], range(8))
    shares("merged where 3 to 5 see it, by incidence in the key view", *merged[(merged[:, 1] >= 3) & (merged[:, 1] <= 5)][:, [0, 2]].T, INCIDENCES)
    print(fitted(single))


INCIDENCES = [0, 30, 45, 60, 75, 85]


def pixel_columns(workspace, pair, key, partner, here, folder, sample):
    """Arrays over the sampled pixels: seen by the partner, right, incidence in the key view, the worse of both, octaves, triangulation angle."""
    a, b = workspace.views[key], workspace.views[partner]
    there = read_reference(folder, partner)
    if there is None:
        return None
    seen = seen_by_both(a, b, here, resized(there, b.size)).ravel()[sample]
    xyz, normal = (x.reshape(-1, 3)[sample] for x in surface(a, here))
    to_a, to_b = a.centre - xyz, b.centre - xyz
    length_a, length_b = np.linalg.norm(to_a, axis=1), np.linalg.norm(to_b, axis=1)
    degrees = lambda cosine: np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    at_a, at_b = degrees((to_a * normal).sum(1) / length_a), degrees((to_b * normal).sum(1) / length_b)
    right = np.zeros(len(sample))
    if pair.matched:
        with np.errstate(invalid="ignore", divide="ignore"):
            right = np.abs(pair.inverse() - 1 / here).ravel()[sample] / pair.deviation().ravel()[sample] < RIGHT_PX
    octaves = np.log2(length_b / length_a * a.K[0, 0] / b.K[0, 0])
    columns = np.c_[seen & np.isfinite(at_a), right, at_a, np.maximum(at_a, at_b), octaves, degrees((to_a * to_b).sum(1) / (length_a * length_b))]
    return np.nan_to_num(columns)


def merged_rows(view, chosen, columns, here, sample, limit, rng):
    """(right, partners that see the pixel, incidence in the key view) for three random choices of five partners."""
    there = [i for i, c in enumerate(columns) if c is not None]
    rows = []
    for _ in range(3 if len(there) >= 5 else 0):
        five = rng.choice(there, 5, replace=False)
        usable = [chosen[i][1] for i in five if chosen[i][1].matched]
        if len(usable) < 2:
            continue
        depth, _ = merge([p.inverse() for p in usable], [p.deviation() for p in usable])
        right = ((depth > 0) & (np.abs(depth - here) * ray_lengths(view) <= limit)).ravel()[sample]
        incidence = columns[five[0]][:, 2]
        known = incidence > 0
        rows.append(np.c_[right, sum(columns[i][:, 0] for i in five), incidence][known])
    return rows


def shares(title, right, value, edges):
    edges = list(edges)
    print(title)
    for low, high in zip(edges, edges[1:], strict=False):
        part = right[(value >= low) & (value < high)]
        if len(part):
            print(f"{low:>8g}..{high:<8g} {len(part):8} {part.mean():.3f}")


def fitted(single):
    """p0, cosine power, octaves s and angle w of p = p0 cos(worse incidence)^power exp(-(octaves / s)^2 / 2 - (angle / w)^2 / 2), by likelihood on a grid."""
    right, _, worst, octaves, angle = single[np.random.default_rng(1).choice(len(single), min(len(single), 40000), replace=False)].T
    cosine = np.maximum(np.cos(np.radians(worst)), 0.01)
    likelihood = lambda p: np.mean(right * np.log(p) + (1 - right) * np.log(1 - p))
    grid = itertools.product((0, 0.25, 0.5, 0.75, 1, 1.5), (0.7, 1, 1.5, 2, 3, np.inf), (30, 45, 60, 75, 100, np.inf), np.arange(0.7, 1, 0.025))
    shape = functools.lru_cache(1)(lambda power, s, w: cosine**power * np.exp(-0.5 * (octaves / s) ** 2 - 0.5 * (angle / w) ** 2))
    best = max((likelihood(np.clip(p0 * shape(power, s, w), 1e-3, 1 - 1e-3)), p0, power, s, w) for power, s, w, p0 in grid)
    return f"fit: p0 {best[1]:.3f}, cosine power {best[2]:g}, octaves {best[3]:g}, angle {best[4]:g}; log likelihood {best[0]:.4f}, of a constant {likelihood(right.mean()):.4f}"


# ------------------------------------------------------------------------------------------------------------- tables


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
    maps.add_argument("--each", action="store_true", help="a line per map")
    pairs = commands.add_parser("pairs", help="success of single pairs by angle, scale ratio and epipole")
    pairs.add_argument("--json", type=Path, help="write the rows here")
    pixels = commands.add_parser("pixels", help="success within pairs, and of merged maps by partners that see the pixel")
    for p in (pairs, pixels):
        p.add_argument("cache", type=Path)
        p.add_argument("--image-scale", type=float, default=1.0)
        p.add_argument("--connected", type=int, default=22, help="partners per key view (default 22)")
        p.add_argument("--every", type=int, default=1, help="only every N-th key view")
    for p in (maps, pairs, pixels):
        p.add_argument("--workspace", type=Path, required=True)
        p.add_argument("--reference", type=Path, required=True)
        p.add_argument("--gsd", type=float, help="g_d in scene units")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    {"maps": measure_maps, "pairs": measure_pairs, "pixels": measure_pixels}[args.command](args)


if __name__ == "__main__":
    main()
