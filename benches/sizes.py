#!/usr/bin/env python3
"""Compares plans with key views at two sizes (method 5.8) with plans at one, by the clouds that OpenMVS or integrations/sgm fuses.

    benches/sizes.py PROJECT WORK_FOLDER [--matcher openmvs|sgm] [--image-scale 0.5] [--gsd G] [--worth 0.8] [--openmvs FOLDER] [--viewrank viewrank]

Matches all key views at full and at half size once (CPU seconds of each are printed), then fuses, for half, one and one and a half times the
work of the default plan: the plan at full size, mixed plans, the whole plan at half size, and every n-th view at full size; and once what OpenMVS makes
by itself of all images at half size, with its own partners, passes and fusion. The reference is the cloud of all maps at full
size; OpenMVS's without points that fewer than three of them agree on (sgm keeps a depth only where two of its own pairs agree). It is divided into cells of 2 g_d, where g_d is that of the place (method 3.6): 1.25 times the finest GSD of the
images in which it lies, in steps of octaves; so cells are about equally many pixels. With --gsd, plans are made for that wanted GSD, which is g_d
everywhere:

    covered    share of its cells with a point within 2 g_d
    right      share of its cells where the median offset of the points from its local plane is at most g_d
    precision  share of the points within 3 g_d of the reference
    error      median of those offsets over the cells, in g_d
    work       CPU seconds of the maps over those of all maps at full size

Needs numpy, scipy and pycolmap, with sgm its requirements. Runs resume: each matcher, size and wanted GSD has a folder in WORK_FOLDER, where maps are kept; its
rows.json is for sizes_curves.py.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

TIMES = (0.5, 1.0, 1.5)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/")
    parser.add_argument("work", type=Path, metavar="work_folder", help="folder for maps and clouds")
    parser.add_argument("--matcher", choices=("openmvs", "sgm"), default="openmvs")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--gsd", type=float, help="wanted GSD, scene units")
    parser.add_argument("--worth", type=float, nargs="*", default=[0.8])
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--viewrank", default="viewrank")
    args = parser.parse_args()
    bench = {"openmvs": OpenMvs, "sgm": Sgm}[args.matcher](args)
    every = bench.plan("--budget", "100%", "--target", "100%")
    cost = {scale: bench.match(every, scale) for scale in (1.0, 0.5)}
    print(f"CPU seconds per map: {cost[1.0]:.2f} at full, {cost[0.5]:.2f} at half size")
    maps = len(every["clusters"])
    reference = Reference(bench.reference(every), bench)
    default = bench.plan()["cut"]["clusters"]
    print("plan                     times  full  half  work %  covered %  right %  precision %  error")

    rows = []

    def show(name, times, maps, work, scores):
        rows.append({"plan": name, "times": times, "maps": maps, "work": work, **dict(zip(("covered", "right", "precision", "error"), scores))})
        covered, right, precision, error = scores
        print(f"{name:24} {times:5}  {maps[0]:4}  {maps[1]:4}  {work:6.1f}  {covered:9.1f}  {right:7.1f}  {precision:11.1f}  {error:5.3f}", flush=True)

    def row(name, times, plan, scales=None):
        chosen = plan["clusters"][: plan["cut"]["clusters"]]
        sizes = [scales or cluster["scale"] for cluster in chosen]
        full, half = sizes.count(1.0), sizes.count(0.5)
        work = 100 * (full * cost[1.0] + half * cost[0.5]) / (maps * cost[1.0])
        show(name, times, (full, half), work, reference.score(bench.fuse(plan, scales)))

    for times in TIMES:
        at_full = max(2, round(default * times))
        row("full size", times, bench.plan("--budget", str(at_full), "--target", "100%"))
        for worth in bench.args.worth:
            budget = f"{100 * default * times / maps:.2f}%"
            row(f"two sizes, worth {worth:g}", times, bench.plan("--budget", budget, "--target", "100%", "--scales", "1,0.5", worth=worth))
        number = min(maps, int(default * times * cost[1.0] / cost[0.5]))
        row("half size", times, bench.plan("--budget", str(number), "--target", "100%"), 0.5)
        names = sorted(cluster["key"] for cluster in every["clusters"])
        keys = {names[i * maps // at_full] for i in range(at_full)}
        whole = bench.plan("--budget", "100%", "--target", "100%")
        row("every n-th", times, {**whole, "clusters": [cluster for cluster in whole["clusters"] if cluster["key"] in keys]})
    if args.matcher == "openmvs":
        seconds, cloud = bench.alone()
        show("OpenMVS alone, half size", "", (0, maps), 100 * seconds / (maps * cost[1.0]), reference.score(cloud))
    (bench.work / "rows.json").write_text(json.dumps(rows, indent=1))


class Bench:
    """A project whose key views a matcher matches at both sizes."""

    def __init__(self, args):
        self.args = args
        self.work = args.work / "-".join([args.matcher, f"{args.image_scale:g}", *([f"gsd-{args.gsd:g}"] if args.gsd else [])])
        self.project = self.work / "project"
        if not self.project.exists():
            self.project.mkdir(parents=True)
            shutil.copytree(args.project / "sparse", self.project / "sparse")
            (self.project / "images").symlink_to((args.project / "images").resolve())
        self.model = pycolmap.Reconstruction(next((self.project / "sparse").rglob("cameras.*")).parent)

    def plan(self, *options, worth=0.8):
        """The manifest of a plan whose export is in the project."""
        settings = f"image_scale = {self.args.image_scale}\n[ranking]\nhalf_worth = {float(worth)}\n"
        (self.project / "viewrank.toml").write_text(settings)
        command = [self.args.viewrank, "plan", self.project, "--backend", self.args.matcher, "--quiet", *options]
        command += ["--gsd", str(self.args.gsd)] if self.args.gsd else []
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return json.loads((self.project / "viewrank/manifest.json").read_text())

    def maps(self, scale):
        return self.work / f"maps-{scale:g}"

    def names(self):
        """Paths in the folder of all maps by which `viewrank evaluate` knows whose they are, if their own do not say it."""
        return []

    def match(self, plan, scale):
        """CPU seconds per map of the size; matches all of them once."""
        note = self.work / f"seconds-{scale:g}.json"
        if not note.exists():
            before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
            self.match_all(plan, scale)
            seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
            note.write_text(json.dumps(seconds / len(plan["clusters"])))
        return json.loads(note.read_text())

    def wanted_gsd(self, points):
        """g_d at each point: 1.25 times the finest GSD of the images in which it lies, in pixels of the full size; infinite in none."""
        if self.args.gsd:
            return np.full(len(points), self.args.gsd)
        finest = np.full(len(points), np.inf)
        for image in self.model.images.values():
            camera, pose = self.model.cameras[image.camera_id], image.cam_from_world()
            seen = points @ pose.rotation.matrix().T + pose.translation
            matrix = camera.calibration_matrix()
            with np.errstate(all="ignore"):
                pixels = seen @ matrix.T[:, :2] / seen[:, 2:]
            inside = (seen[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
            finest = np.where(inside, np.minimum(finest, seen[:, 2] / matrix[0, 0]), finest)
        return 1.25 * finest / self.args.image_scale


class OpenMvs(Bench):
    def __init__(self, args):
        super().__init__(args)
        self.programs = args.openmvs.resolve()

    def export(self, folder, scales=None):
        """A copy of the export, with all key views at one size if given."""
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.project / "viewrank/openmvs", folder, symlinks=True)
        if scales:
            run = json.loads((folder / "run.json").read_text())
            for cluster in run["clusters"]:
                cluster["resolution"] = round(scales * run["resolution"])
            (folder / "run.json").write_text(json.dumps(run))

    def match_all(self, plan, scale):
        folder = self.maps(scale)
        if not folder.exists():
            self.export(folder, scale)
        command = [sys.executable, "run.py", "--stop-at", str(len(plan["clusters"])), "--threads", "1", "--densify", self.programs / "DensifyPointCloud"]
        subprocess.run(command, cwd=folder, check=False, stdout=subprocess.DEVNULL)

    def map_of(self, key):
        """Path of a map in the folder of all."""
        run = json.loads((self.maps(1.0) / "run.json").read_text())
        return next(cluster["map"] for cluster in run["clusters"] if cluster["key"] == key)

    def alone(self):
        """CPU seconds and the cloud of OpenMVS alone on all images at half size."""
        folder = self.work / "plain"
        note = folder / "seconds.json"
        if not note.exists():
            shutil.rmtree(folder, ignore_errors=True)
            (folder / "colmap").mkdir(parents=True)
            model = next((self.project / "sparse").rglob("cameras.*")).parent
            (folder / "colmap/sparse").symlink_to(model.resolve())
            (folder / "images").symlink_to((self.project / "images").resolve())
            own = {"cwd": folder, "check": True, "stdout": subprocess.DEVNULL}
            subprocess.run([self.programs / "InterfaceCOLMAP", "-i", "colmap", "-o", "scene.mvs", "--image-folder", "images/"], **own)
            level = round(-np.log2(self.args.image_scale / 2))
            sizes = ["--resolution-level", str(level), "--min-resolution", "0", "--max-resolution", "100000", "--max-threads", "1"]
            before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
            subprocess.run([self.programs / "DensifyPointCloud", "scene.mvs", *sizes], **own)
            note.write_text(json.dumps(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before))
        return json.loads(note.read_text()), read_cloud(folder / "scene_dense.ply")

    def references(self, every):
        """The cloud of all maps, and that where three agree."""
        return [self.fuse(every, 1.0, agreeing=maps) for maps in (1, 3)]

    def reference(self, every):
        return self.fuse(every, 1.0, agreeing=3)

    def cloud(self):
        return self.work / "fused/fused.ply"

    def fuse(self, plan, scale=None, agreeing=1):
        """Points of the cloud of the plan's maps, n x 3, of those that were matched above; where so many of them agree."""
        home, marks = self.project / "viewrank/openmvs", self.project / "viewrank/dispatch/openmvs"
        run, keys = json.loads((home / "run.json").read_text()), {cluster["key"] for cluster in plan["clusters"]}
        (marks / "done").mkdir(parents=True, exist_ok=True)
        for row in run["clusters"]:
            made = self.maps(scale or (1.0 if row["resolution"] == run["resolution"] else 0.5)) / row["map"]
            if row["key"] in keys and made.exists():
                shutil.copy(made, home)
                (marks / "done" / row["mark"]).write_text(row["id"])
        command = [self.args.viewrank, "run", self.project, "--backend", "openmvs", "--program", self.programs / "DensifyPointCloud", "--threads", "1", "--fuse"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.cloud().parent.mkdir(exist_ok=True)
        (home / "fused.ply").replace(self.cloud())
        # The next plan is not to keep these maps.
        shutil.rmtree(marks)
        for path in home.glob("depth*.dmap"):
            path.unlink()
        return read_cloud(self.cloud(), agreeing)


class Sgm(Bench):
    def run(self, verb, out, plan, scale, *options):
        """One verb of sgm.py on the clusters of the plan, all at one size if given."""
        clusters = [{**cluster, "scale": scale or cluster["scale"]} for cluster in plan["clusters"]]
        manifest = self.work / "clusters.json"
        manifest.write_text(json.dumps({**plan, "clusters": clusters, "cut": {**plan["cut"], "clusters": min(plan["cut"]["clusters"], len(clusters))}}))
        script = Path(__file__).resolve().parents[1] / "integrations/sgm/sgm.py"
        command = [sys.executable, script, verb, self.project, "--clusters", manifest, "--out", out, "--image-scale", str(self.args.image_scale), *options]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(done.stderr)

    def map_of(self, key):
        return f"depth_maps/{key}.npy"

    def match_all(self, plan, scale):
        self.run("match", self.maps(scale), plan, scale)

    def reference(self, every):
        return self.fuse(every, 1.0)

    def fuse(self, plan, scale=None):
        """Points of the cloud of the plan's maps, n x 3, of those that were matched above."""
        folder = self.work / "fused"
        shutil.rmtree(folder, ignore_errors=True)
        for cluster in plan["clusters"][: plan["cut"]["clusters"]]:
            path = folder / f"depth_maps/{cluster['key']}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to((self.maps(scale or cluster["scale"]) / f"depth_maps/{cluster['key']}.npy").resolve())
        self.run("fuse", folder, plan, scale)
        data = (folder / "fused.ply").read_bytes()
        record = np.dtype([("position", "<f8", 3), ("colour", "u1", 3)])
        return np.frombuffer(data[data.index(b"end_header\n") + 11 :], record)["position"].copy()


def read_cloud(path, agreeing=1):
    """Positions of OpenMVS's fused.ply where so many maps agree; its records end with two lists: views and their weights."""
    data = path.read_bytes()
    start = data.index(b"end_header\n") + 11
    count = int(re.search(rb"element vertex (\d+)", data[:start])[1])
    offsets, at = np.empty(count, np.int64), start
    for i in range(count):
        offsets[i] = at
        at += 29 + 8 * data[at + 27]
    assert at == len(data), "x, y, z, red, green, blue, nx, ny, nz and two lists"
    data = np.frombuffer(data, np.uint8)
    records = data[offsets[data[offsets + 27] >= agreeing, None] + np.arange(12)]
    return np.ascontiguousarray(records).view("<f4").astype(float)


def one_per_cell(points, size):
    _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
    return points[first]


class Reference:
    """Cells of a cloud, each with its g_d."""

    def __init__(self, points, bench):
        self.number = len(points)
        gsd = bench.wanted_gsd(points)
        points, gsd = points[np.isfinite(gsd)], gsd[np.isfinite(gsd)]
        octaves = np.round(np.log2(gsd)).astype(int)
        levels = [(2.0**octave, points[octaves == octave]) for octave in np.unique(octaves)]
        thinned = [(size, one_per_cell(part, size)) for size, part in levels]
        cells = [(size, one_per_cell(part, 2 * size)) for size, part in thinned]
        self.points, self.points_gsd = joined(thinned)
        self.cells, self.gsd = joined(cells)
        self.tree = cKDTree(self.points)
        near = self.points[self.tree.query(self.cells, k=12)[1]]
        self.middles = near.mean(1)
        self.normals = np.linalg.svd(near - self.middles[:, None], full_matrices=False)[2][:, 2]

    def covered(self, tree, times):
        """Cells with a point within so many g_d over all of them, by number and by area, %."""
        near = tree.query(self.cells)[0] <= times * self.gsd
        return 100 * near.mean(), 100 * (self.gsd**2)[near].sum() / (self.gsd**2).sum()

    def score(self, cloud):
        """Cells covered, cells right, precision in per cent, and the error in g_d."""
        cloud = one_per_cell(cloud, self.gsd.min() / 2)
        tree = cKDTree(cloud)
        sample = cloud[np.random.default_rng(0).permutation(len(cloud))[:200_000]]
        distance, nearest = self.tree.query(sample)
        precision = 100 * (distance <= 3 * self.points_gsd[nearest]).mean()
        around = tree.query_ball_point(self.cells, 2 * self.gsd)
        offset = lambda i, near: abs(np.median((cloud[near] - self.middles[i]) @ self.normals[i])) if near else np.inf  # noqa: E731
        offsets = np.array([offset(i, near) for i, near in enumerate(around)]) / self.gsd
        return self.covered(tree, 2)[0], 100 * (offsets <= 1).mean(), precision, np.median(offsets[np.isfinite(offsets)])


def joined(levels):
    """Points of all levels, and the size of each one's level."""
    return np.concatenate([points for _, points in levels]), np.concatenate([np.full(len(points), size) for size, points in levels])


if __name__ == "__main__":
    main()
