#!/usr/bin/env python3
"""Measures plans on COLMAP's CUDA matcher and fusion: clouds of our order, of every n-th view and of COLMAP's defaults, their F-scores and the seconds of the card. colmap_cuda.sh starts it.

REFERENCE is the folder truth/ of a rendered set (exact depth), or a folder with a picture NAME.png of each view NAME.* by a depth camera: 16 bits, millimetres, 0 or 65535 where it has none, of
the shape of the image. Its depths are taken with the poses of the model, whose scale follows from the sparse points.

`pack` plans (viewrank), thins the reference, and carries images, lists and, with --wheels, pycolmap itself: FOLDER has the wheels of pycolmap-cuda12 for the Python of the card's machine and
nvidia-cuda-runtime-cu12 (pip download --no-deps). Of their machine code that of one architecture is kept (--arch 90: H100, H200). Needs numpy, opencv, scipy, pycolmap, with --wheels ldd and cc.

`run` needs numpy and scipy, and pycolmap with CUDA if the pack has none. It matches all key views with the partners of the plan, once (photometric, as run.sh does); then all images with
`__auto__, 20` and geometric consistency, COLMAP's defaults, at the same size. Then stereo_fusion fuses the first maps of our order, every n-th of ours, and all of COLMAP's. What doesn't fit into
--seconds is left out, and said. Written are, for each cloud: maps, seconds of the matcher, points, and

    precision   points (one per cell of half the distance) within the distance of the reference
    recall      points of the reference within the distance of the cloud
    F           harmonic mean of the two

The distance is 2 g_d, g_d = 1.25 times the median GSD of the matched images, or --distance.
"""

import argparse
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np

MOST_BYTES = 60_000_000
MOST_POINTS = 2_000_000
PREFIXES = (0.1, 0.2, 0.3, 0.5, 1.0)
AUTO = "__auto__, 20"
FOR_FUSION = 120  # seconds that are kept free for fusing and scoring
AIM = 0.95
NO_CUDA = 3
PHOTOMETRIC = {"geom_consistency": False, "filter": True}
# Libraries that every Linux has.
BASIC = re.compile(r"(libc|libm|libdl|librt|libpthread|libstdc\+\+|libgcc_s|ld-linux.*)\.so")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    packing = verbs.add_parser("pack", help="plan, and pack what is to be carried")
    packing.add_argument("project", type=Path, help="undistorted COLMAP project with images/ and sparse/")
    packing.add_argument("reference", type=Path)
    packing.add_argument("pack", type=Path, help="archive to write, .tar.xz")
    packing.add_argument("--image-scale", type=float, default=1.0)
    packing.add_argument("--distance", type=float, help="in scene units")
    packing.add_argument("--wheels", type=Path, help="folder of wheels to carry")
    packing.add_argument("--arch", type=int, default=90)
    packing.add_argument("--viewrank", default="viewrank")
    running = verbs.add_parser("run", help="match, fuse and score, where the card is")
    running.add_argument("pack", type=Path)
    running.add_argument("work", type=Path, help="folder into which colmap_cuda.sh unpacked it")
    running.add_argument("--seconds", type=float, default=540)
    running.add_argument("--at-once", type=int, default=4, help="maps that the card computes side by side")
    matching = verbs.add_parser("match", help="one list of a workspace (run calls it)")
    matching.add_argument("workspace", type=Path)
    matching.add_argument("options")
    args = parser.parse_args()
    {"pack": pack, "run": run, "match": match}[args.verb](args)


# --------------------------------------------------------------------------------------------------------------- pack


def pack(args):
    with tempfile.TemporaryDirectory() as folder:
        content = Path(folder) / "content"
        project = copied(args.project, Path(folder) / "project", args.image_scale)
        plan = planned(project, args.viewrank)
        (content / "images").mkdir(parents=True)
        shutil.copytree(project / "viewrank/colmap/sparse", content / "sparse")
        for name in plan["views"]:
            (content / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(args.project / "images" / name, content / "images" / name)
        points, distance = reference(args.project, args.reference, args.image_scale, args.distance)
        np.save(content / "reference.npy", points.astype(np.float32))
        (content / "plan.json").write_text(json.dumps({**plan, "set": args.project.resolve().name, "image_scale": args.image_scale, "distance": distance}))
        if args.wheels:
            carry(args.wheels, content / "site", args.arch)
        with tarfile.open(args.pack, "w:xz") as archive:
            for path in sorted(content.iterdir()):
                archive.add(path, path.name)
    size = args.pack.stat().st_size
    print(f"{args.pack}: {size / 1e6:.1f} MB, {len(plan['views'])} views, {len(plan['keys'])} key views, {len(points)} points of the reference, distance {distance:.4g}")
    if size > MOST_BYTES:
        sys.exit(f"error: more than {MOST_BYTES / 1e6:.0f} MB: take fewer or smaller images")


def copied(project, folder, image_scale):
    """The project without its plan."""
    folder.mkdir(parents=True)
    for part in ("images", "sparse"):
        (folder / part).symlink_to((project / part).resolve())
    (folder / "viewrank.toml").write_text(f"image_scale = {image_scale}\n")
    return folder


def planned(project, viewrank):
    """All key views in rank order with their partners, size of the images, and for each prefix how many pixels its fusion wants."""
    subprocess.run([viewrank, "plan", project, "--backend", "colmap", "--budget", "100%", "--target", "100%", "--quiet"], check=True, stdout=subprocess.DEVNULL)
    lines = listed(project / "viewrank/colmap/stereo/patch-match.cfg")
    keys, partners = lines[::2], lines[1::2]
    matching, _ = commands(project / "viewrank/colmap")
    pixels = {}
    for number in sorted({prefix(keys, share) for share in PREFIXES}):
        out = project / f"first-{number}"
        subprocess.run([viewrank, "export", project, "--backend", "colmap", "--budget", str(number), "--out", out], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        pixels[number] = int(commands(out)[1]["StereoFusion.min_num_pixels"])
    import pycolmap

    views = sorted(image.name for image in pycolmap.Reconstruction(project / "viewrank/colmap/sparse").images.values())
    return {"keys": keys, "partners": partners, "views": views, "max_image_size": int(matching["PatchMatchStereo.max_image_size"]), "min_num_pixels": pixels}


def listed(path):
    return [line.strip() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]


def commands(workspace):
    """Options of the two commands of an export."""
    words = [command.split() for command in json.loads((workspace / "stereo/viewrank/export.json").read_text())["commands"]]
    return [{name.removeprefix("--"): value for name, value in zip(command[2::2], command[3::2])} for command in (words[0], words[-1])]


def prefix(keys, share):
    return max(2, round(share * len(keys)))


def every_nth(keys, number):
    """As many of the keys, evenly by name."""
    names = sorted(keys)
    return [names[i * len(names) // number] for i in range(number)]


def reference(project, folder, image_scale, distance):
    """Points of the true surface, one per cell of half the distance, and the distance."""
    import pycolmap
    from partners import true_views
    from sizes import one_per_cell

    model = pycolmap.Reconstruction(next((project / "sparse").rglob("cameras.*")).parent)
    distance = distance or 2 * 1.25 * median_gsd(model) / image_scale
    names = {image.name for image in model.images.values()}
    views = true_views(folder, names) if (folder / "sparse").is_dir() else camera_views(folder, model)
    points = np.zeros((0, 3))
    for view in views:
        points = one_per_cell(np.concatenate([points, view.points()]), distance / 2)
    if not 0 < len(points) <= MOST_POINTS:
        sys.exit(f"error: {len(points)} points of the reference {folder}: " + ("take a larger --distance" if len(points) else "no depth of a view of the model"))
    return points, distance


def seen_points(model, image):
    """Pixels and depths of the sparse points that an image observes."""
    observed = [point for point in image.points2D if point.has_point3D()]
    pose = image.cam_from_world().matrix()
    places = np.array([model.points3D[point.point3D_id].xyz for point in observed]).reshape(-1, 3)
    return np.array([point.xy for point in observed]).reshape(-1, 2), places @ pose[2, :3] + pose[2, 3]


def median_gsd(model):
    return float(np.median(np.concatenate([seen_points(model, image)[1] / model.cameras[image.camera_id].mean_focal_length() for image in model.images.values()])))


def camera_views(folder, model):
    """Views of a depth camera: millimetres in 16 bits, brought to the scale of the model."""
    import cv2
    from partners import TrueView

    found, ratios = [], []
    for image in model.images.values():
        path = folder / Path(image.name).with_suffix(".png")
        if not path.is_file():
            continue
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32)
        depth[depth >= 65535] = 0
        camera = model.cameras[image.camera_id]
        size = np.array([depth.shape[1] / camera.width, depth.shape[0] / camera.height])
        at, z = seen_points(model, image)
        column, row = (at * size).astype(int).clip(0, np.array(depth.shape[::-1]) - 1).T
        there = depth[row, column]
        ratios.append(z[there > 0] / there[there > 0])
        found.append((depth, np.diag([*size, 1]) @ camera.calibration_matrix(), image.cam_from_world()))
    scale = np.median(np.concatenate(ratios)) if ratios else 1
    return [TrueView(depth * np.float32(scale), matrix, pose) for depth, matrix, pose in found]


def carry(wheels, site, arch):
    """Unpacks the wheels, and adds the libraries that another machine may lack."""
    for wheel in sorted(wheels.glob("*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
    (library,) = site.glob("pycolmap/_core*.so")
    library.write_bytes(without_other_code(library.read_bytes(), arch))
    (site / "lib").mkdir()
    # It is named, but no function of it is called.
    subprocess.run(["cc", "-shared", "-Wl,-soname,libcurand.so.10", "-x", "c", "/dev/null", "-o", site / "lib/libcurand.so.10"], check=True)
    for name, path in re.findall(r"(\S+) => (/\S+)", subprocess.run(["ldd", library], capture_output=True, text=True, check=True).stdout):
        if not BASIC.match(name) and not Path(path).is_relative_to(site):
            shutil.copy(path, site / "lib" / name)


def without_other_code(library, arch):
    """A library with zeros in place of the machine code (kind 2) of other architectures and of all intermediate code (kind 1) in its fat binaries."""
    kept, at = bytearray(library), -1
    head = struct.pack("<IHH", 0xBA55ED50, 1, 16)
    while (at := library.find(head, at + 1)) >= 0:
        entry, end = at + 16, at + 16 + struct.unpack_from("<Q", library, at + 8)[0]
        while entry + 32 <= min(end, len(library)):
            kind, _, length, payload = struct.unpack_from("<HHIQ", library, entry)
            if kind not in (1, 2) or length < 32 or entry + length + payload > len(library):
                break
            if (kind, struct.unpack_from("<I", library, entry + 28)[0]) != (2, arch):
                kept[entry + length : entry + length + payload] = bytes(payload)
            entry += length + payload
    return bytes(kept)


# ---------------------------------------------------------------------------------------------------------------- run


def run(args):
    end = time.monotonic() + args.seconds
    plan = json.loads((args.work / "plan.json").read_text())
    points = np.load(args.work / "reference.npy")
    result = {"set": plan["set"], "card": card(), "image_scale": plan["image_scale"], "distance": plan["distance"], "views": len(plan["views"]), "matched": {}, "clouds": [], "left_out": []}
    at_once = {"gpu_index": ",".join(["0"] * args.at_once)}
    matches = {name: work(args.work / name, plan, lines, {**options, **at_once}) for name, (lines, options) in lists(plan).items()}
    for name, matching in matches.items():
        left = end - time.monotonic() - FOR_FUSION
        result["matched"][name] = matching.match(left)
        for cloud in clouds(plan, name):
            missing = [key for key in cloud["views"] if key not in matching.made()]
            if missing:
                result["left_out"].append(f"{cloud['name']}: {len(missing)} of {len(cloud['views'])} maps are missing")
                continue
            fused = matching.fuse(cloud["views"], cloud["min_num_pixels"], len(plan["views"]))
            share = len(cloud["views"]) / len(matching.keys)
            row = {"name": cloud["name"], "maps": len(cloud["views"]), "seconds": share * result["matched"][name]["seconds"], **f_score(fused, points, plan["distance"])}
            result["clouds"].append(row)
            print("{name:24} {maps:4} maps {seconds:7.1f} s {points:9} points, precision {precision:.3f}, recall {recall:.3f}, F {F:.3f}".format(**row), flush=True)
            write(args.work / "colmap_cuda.json", {**result, "aim": aim(result["clouds"])})
    write(args.work / "colmap_cuda.json", {**result, "aim": aim(result["clouds"])})
    print("\n".join([f"left out: {words}" for words in result["left_out"]] + [f"{args.work / 'colmap_cuda.json'}: {aim(result['clouds'])}"]))


def card():
    """Name of the card as its driver says, and the driver's version."""
    try:
        done = subprocess.run(["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"], capture_output=True, text=True, check=True)
        return done.stdout.strip().split("\n")[0]
    except (OSError, subprocess.CalledProcessError):
        return None


def lists(plan):
    """Names of the two runs, with the lines of their lists and the options of the matcher."""
    size = {"max_image_size": plan["max_image_size"]}
    ours = [line for pair in zip(plan["keys"], plan["partners"]) for line in pair]
    return {"ours": (ours, {**size, **PHOTOMETRIC}), "defaults": ([line for view in plan["views"] for line in (view, AUTO)], size)}


def clouds(plan, name):
    """Clouds that are fused of a run's maps: their views, and how many pixels must agree."""
    if name == "defaults":
        return [{"name": "COLMAP's defaults", "views": plan["views"], "min_num_pixels": 5}]
    keys = plan["keys"]
    found = []
    for share in PREFIXES:
        number = prefix(keys, share)
        pixels = plan["min_num_pixels"][str(number)]
        found.append({"name": f"ours, {share:.0%}", "views": keys[:number], "min_num_pixels": pixels})
        if number < len(keys):
            found.append({"name": f"every n-th, {share:.0%}", "views": every_nth(keys, number), "min_num_pixels": pixels})
    return found


def aim(rows):
    """Seconds of the shortest prefix of ours with AIM of the F-score of COLMAP's defaults, over those of the defaults; None where either is missing."""
    defaults = next((row for row in rows if row["name"] == "COLMAP's defaults"), None)
    enough = [row for row in rows if defaults and row["name"].startswith("ours") and row["F"] >= AIM * defaults["F"]]
    if not enough:
        return None
    first = min(enough, key=lambda row: row["seconds"])
    return {"F": first["F"] / defaults["F"], "seconds": first["seconds"] / defaults["seconds"], "maps": first["maps"]}


def work(folder, plan, lines, options):
    """A workspace of COLMAP with the lists of a run."""
    for part in ("sparse", "images"):
        folder.mkdir(exist_ok=True)
        if not (folder / part).is_symlink():
            (folder / part).symlink_to((folder.parent / part).resolve())
    for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
        for name in plan["views"]:
            (folder / "stereo" / kind / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / "stereo/patch-match.cfg").write_text("\n".join(lines) + "\n")
    return Workspace(folder, lines[::2], options)


class Workspace:
    def __init__(self, folder, keys, options):
        self.folder, self.keys, self.options = folder, keys, options
        self.kind = "photometric" if options.get("geom_consistency") is False else "geometric"

    def match(self, seconds):
        """Runs the matcher in a process of its own, which may be ended: seconds, also of one map, and how many there are."""
        start, finished = time.monotonic(), True
        try:
            done = subprocess.run([sys.executable, __file__, "match", self.folder, json.dumps(self.options)], capture_output=True, text=True, errors="replace", timeout=max(1, seconds))
        except subprocess.TimeoutExpired:
            finished, done = False, None
        made = self.made()
        if done is not None and done.returncode and not made:
            print(f"error: COLMAP's matcher needs an NVIDIA card and a pycolmap with CUDA (pycolmap-cuda12), and made no map here: {reason(done)}", file=sys.stderr)
            sys.exit(NO_CUDA)
        took = time.monotonic() - start
        return {"seconds": took, "maps": len(made), "seconds_per_map": took / max(1, len(made)), "finished": finished and done.returncode == 0, "kind": self.kind, "options": self.options}

    def made(self):
        return {key for key in self.keys if all((self.folder / "stereo" / kind / f"{key}.{self.kind}.bin").is_file() for kind in ("depth_maps", "normal_maps"))}

    def fuse(self, views, min_num_pixels, check_num_images):
        """Points of the cloud of these views, n x 3."""
        import pycolmap

        (self.folder / "stereo/fusion.cfg").write_text("\n".join(views) + "\n")
        options = pycolmap.StereoFusionOptions()
        options.min_num_pixels = min(min_num_pixels, len(views))
        options.check_num_images = check_num_images
        path = self.folder / "fused.ply"
        pycolmap.stereo_fusion(path, self.folder, input_type=self.kind, options=options, output_type="ply")
        return read_cloud(path)


def reason(done):
    """The line of an output that says why a program ended: COLMAP writes a trace of its calls behind it."""
    lines = [line.strip() for line in (done.stdout + done.stderr).split("\n") if line.strip()]
    telling = [line for line in lines if "Check failed" in line or "rror" in line or "CUDA" in line]
    return (telling or lines[-1:] or [f"it ended with {done.returncode}"])[0]


def match(args):
    import pycolmap

    if not pycolmap.has_cuda:
        sys.exit(f"pycolmap {pycolmap.__version__} has no CUDA")
    options = pycolmap.PatchMatchOptions()
    for name, value in json.loads(args.options).items():
        setattr(options, name, value)
    pycolmap.patch_match_stereo(args.workspace, options=options)


def read_cloud(path):
    """Positions of COLMAP's fused.ply: three floats first, then normals and colours."""
    data = path.read_bytes()
    start = data.index(b"end_header\n") + 11
    count = int(re.search(rb"element vertex (\d+)", data[:start])[1])
    record = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
    return np.frombuffer(data, record, count, start)["position"].astype(float)


def f_score(cloud, points, distance):
    from scipy.spatial import cKDTree

    if not len(cloud):
        return {"points": 0, "precision": 0.0, "recall": 0.0, "F": 0.0}
    _, first = np.unique(np.floor(cloud / (distance / 2)).astype(np.int64), axis=0, return_index=True)
    thinned = cloud[first]
    precision = float((cKDTree(points).query(thinned, workers=-1)[0] <= distance).mean())
    recall = float((cKDTree(thinned).query(points, workers=-1)[0] <= distance).mean())
    return {"points": len(cloud), "precision": precision, "recall": recall, "F": 2 * precision * recall / (precision + recall) if precision + recall else 0.0}


def write(path, result):
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(result, indent=1) + "\n")
    os.replace(draft, path)


if __name__ == "__main__":
    main()
