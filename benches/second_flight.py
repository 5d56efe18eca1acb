#!/usr/bin/env python3
"""Renders the images that a report plans and measures how much of the holes they fill, compared with a full second flight.

    python3 benches/second_flight.py SET WORK_FOLDER [--every 3] [--viewrank target/release/viewrank]

SET is one that benches.render made with a grid flight (benches/sets.py valley). The first flight is every n-th image of that grid. Its holes
are the triangles that no view cluster fulfils to a tenth (`reason` in surface.ply). The images of viewrank/flight/waypoints.ply are rendered, added with the
sparse points that they see, planned and matched whole by integrations/sgm; beginnings of them and the rest of the grid likewise. A place in a hole is
filled where a depth map is within 3 g_d of the exact depth there.

Needs benches/render/requirements.txt and integrations/sgm/requirements.txt.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "integrations/sgm")]

from benches.render import colmap_model, depth_file, pictures  # noqa: E402
from benches.render.camera import View, look  # noqa: E402
from benches.render.rays import bake_sky  # noqa: E402
from benches.render.scenes import scene as scene_of  # noqa: E402
from workspace import Workspace  # noqa: E402

SCALE = 0.5
# Places per hole triangle, and how near the surface must be to the exact depth to be the same place.
PLACES, SAME = 12, 0.05
KINDS = {"float": "<f4", "double": "<f8", "uchar": "u1", "uint": "<u4", "int": "<i4"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--every", type=int, default=3, help="the first flight has every n-th image of the grid")
    parser.add_argument("--viewrank", default=str(ROOT / "target/release/viewrank"))
    args = parser.parse_args()
    experiment = Experiment(args)
    grid = sorted(name for name in experiment.poses if name.startswith("grid"))
    first = grid[:: args.every]
    project = experiment.project("first", first)
    experiment.viewrank("report", project)
    places = holes(project / "viewrank/surface.ply")
    planned = experiment.render(waypoints(project / "viewrank/flight/waypoints.ply"))
    rest = [name for name in grid if name not in first]
    # Beginnings of the planned images, the most useful first.
    parts = [n for n in (len(rest) * eighths // 8 for eighths in (2, 3, 4)) if n < len(planned)]
    flights = [("first", []), ("full second", rest), *(("planned", planned[:n]) for n in [*parts, len(planned)])]
    print("flight       images   filled %")
    for what, names in flights:
        filled = experiment.filled(f"{what} {len(names)}".replace(" ", "-"), first + names, places)
        print(f"{what:12} {len(names):6}  {100 * filled:9.1f}", flush=True)


class Experiment:
    def __init__(self, args):
        self.args, self.set = args, args.set
        self.camera, poses = colmap_model.read_poses(args.set / "truth/sparse/0")
        self.poses = {name: pose for name, pose in poses.items() if (args.set / "images" / name).is_file()}
        self.points = Workspace(args.set).xyz
        self.rendered = args.work / "rendered"

    def viewrank(self, *command):
        subprocess.run([self.args.viewrank, *map(str, command)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def folder_of(self, name):
        return self.set if (self.set / "images" / name).is_file() else self.rendered

    def depth(self, name):
        return depth_file.read(pictures.depth_path(self.folder_of(name), Path(name).stem))[0]

    def project(self, name, images):
        """A planned project with the true poses of these images, and the set's sparse points as far as two of them see them."""
        folder = self.args.work / name
        (folder / "images").mkdir(parents=True, exist_ok=True)
        seen = [self.observed(image) for image in images]
        count = np.bincount(np.concatenate([points for points, _ in seen]), minlength=len(self.points))
        records, tracks = [], {int(p): [] for p in np.flatnonzero(count >= 2)}
        for i, (image, (points, pixels)) in enumerate(zip(images, seen, strict=True)):
            kept = count[points] >= 2
            link = folder / "images" / image
            link.unlink(missing_ok=True)
            link.symlink_to((self.folder_of(image) / "images" / image).resolve())
            rotation, centre = self.poses[image]
            records.append(colmap_model.Image(i + 1, image, rotation, -rotation @ centre, pixels[kept], points[kept] + 1))
            for j, p in enumerate(points[kept]):
                tracks[int(p)].append((i + 1, j))
        points = [colmap_model.Point(p + 1, self.points[p], (128, 128, 128), 0.4, track) for p, track in tracks.items()]
        colmap_model.write(folder / "sparse/0", self.camera, records, points)
        (folder / "viewrank.toml").write_text(f"image_scale = {SCALE}\n")
        self.viewrank("plan", folder, "--backend", "sgm", "--target", "100%", "--budget", "100%")
        return folder

    def observed(self, name):
        """Indices of the sparse points that an image sees, and their pixels."""
        (rotation, centre), depth = self.poses[name], self.depth(name)
        local = (self.points - centre) @ rotation.T
        pixels = local[:, :2] / local[:, 2:] * self.camera.focal + [self.camera.cx, self.camera.cy]
        inside = (local[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < [self.camera.width, self.camera.height]).all(1)
        index = np.flatnonzero(inside)
        column, row = (pixels[index] / [self.camera.width, self.camera.height] * depth.shape[::-1]).astype(int).T
        exact = depth[row, column]
        index = index[(exact > 0) & (np.abs(exact - local[index, 2]) < 0.01 * exact)]
        return index, pixels[index]

    def render(self, views):
        """Pictures and exact depth of new views; their names."""
        stats, out = json.loads((self.set / "stats.json").read_text()), self.rendered
        self.poses |= {f"{view.name}.jpg": (view.rotation, view.centre) for view in views}
        for folder in ("png", "truth/depth"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        jobs = [(i, view) for i, view in enumerate(views) if not (out / "images" / f"{view.name}.jpg").is_file()]
        if jobs:
            seed = stats.get("seed", 1)
            scene = scene_of(stats.get("scene", self.set.name)).build(seed)
            bake_sky(scene.surface, scene.leaves.triangles, 40, 6.0)
            pictures.render_views((scene, self.camera, out, seed, len(views)), jobs, 2)
            pictures.encode(out, 76, 0)
        return [f"{view.name}.jpg" for view in views]

    def filled(self, name, images, places):
        """Share of the places that a depth map of all clusters gets right."""
        folder = self.project(name, images)
        match = [sys.executable, ROOT / "integrations/sgm/sgm.py", "match", folder, "--out", folder / "sgm", "--image-scale", SCALE, "--jobs", "2"]
        subprocess.run(list(map(str, match)), check=False, stderr=subprocess.DEVNULL)
        workspace, right = Workspace(folder, SCALE), np.zeros(len(places), bool)
        g_d = 1.25 * workspace.gsd()
        for image in images:
            path = folder / "sgm/depth_maps" / f"{image}.npy"
            if path.is_file():
                right |= self.is_right(workspace.views[image], np.load(path), places, 3 * g_d)
        return right.mean()

    def is_right(self, view, depth, places, most):
        pixels, z = view.project(places)
        inside = (z > 0) & (pixels > -0.5).all(1) & (pixels < np.array(view.size) - 0.5).all(1)
        column, row = np.rint(np.where(inside[:, None], pixels, 0)).astype(int).T
        exact, found = self.depth(view.name)[row, column], depth[row, column]
        return inside & (found > 0) & (exact > 0) & (np.abs(found - exact) < most) & (np.abs(exact - z) < SAME * z)


def waypoints(path):
    """Views in order of `rank`, the last column."""
    rows = np.loadtxt(path.read_text().split("end_header\n")[1].splitlines(), ndmin=2)
    rows = rows[np.argsort(rows[:, -1])]
    views = []
    for i, row in enumerate(rows):
        centre, ahead = row[:3], row[3:6]
        up = (0, 0, 1) if abs(ahead[2]) < 0.999 else (0, 1, 0)
        views.append(View(f"planned_{i + 1:03}", look(centre, centre + ahead, up), centre))
    return views


def holes(path):
    """Places on the triangles of surface.ply that no view cluster fulfils, evenly spread by area."""
    data = path.read_bytes()
    start = data.index(b"end_header\n") + 11
    header = data[:start].decode()
    vertex, face = header[header.index("element vertex") : header.index("element face")], header[header.index("element face") :]
    fields = [(line.split()[2], KINDS[line.split()[1]]) for line in vertex.splitlines() if line.startswith("property")]
    vertices = np.frombuffer(data, fields, int(vertex.split()[2]), start)
    listed = [(line.split()[2], KINDS[line.split()[1]]) for line in face.splitlines() if line.startswith("property") and "list" not in line]
    faces = np.frombuffer(data, [("count", "u1"), ("corners", "<u4", 3), *listed], int(face.split()[2]), start + vertices.nbytes)
    corners = np.stack([vertices[axis] for axis in "xyz"], 1).astype(float)[faces["corners"]]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    areas[faces["reason"] == 0] = 0
    rng = np.random.default_rng(0)
    chosen = corners[rng.choice(len(corners), PLACES * int((areas > 0).sum()), p=areas / areas.sum())]
    return (chosen * rng.dirichlet([1, 1, 1], len(chosen))[:, :, None]).sum(1)


if __name__ == "__main__":
    main()
