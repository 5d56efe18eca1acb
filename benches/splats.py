#!/usr/bin/env python3
"""Trains Gaussian splats on the images that viewrank chooses, and on as many by other rules; measures them on held-out views.

    benches/splats.py PROJECT WORK_FOLDER [--share 0.25] [--side 128] [--seeds 1] [--orders viewrank,every n-th,...] [--viewrank viewrank]

PROJECT is an undistorted COLMAP project with images/ and sparse/0. Every eighth view, by the numbers in the names, is held out before anything is chosen. The others
are ranked by `viewrank plan --backend splat`, spread evenly, taken at random, or each farthest from those before it (distance of the cameras over the largest one, plus
the angle between their axes over pi). splat_train.py trains 1,200 iterations at images of this long side with at most 3,000 Gaussians, on one core (ten seconds or more).
Writes WORK_FOLDER/splats.json, whose rows resume. Needs numpy, numba, opencv-python-headless and pycolmap.
"""

import argparse
import csv
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from splat_train import Scene, measure, train

ITERATIONS, GAUSSIANS = 1200, 3000
HELD_OUT = 8
ORDERS = ("viewrank", "every n-th", "farthest view", "random")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("work", type=Path, metavar="work_folder")
    parser.add_argument("--share", type=float, default=0.25, help="part of the images that train")
    parser.add_argument("--side", type=int, default=128, help="long side of the images, pixels")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each")
    parser.add_argument("--orders", default=",".join(ORDERS))
    parser.add_argument("--viewrank", default="viewrank")
    args = parser.parse_args()
    model = pycolmap.Reconstruction(args.project / "sparse/0")
    views = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: natural(image.name))
    scene = read_scene(args.project, model, views, args.side)
    candidates = np.flatnonzero(~scene.held_out)
    number = max(2, round(args.share * len(candidates)))
    path = args.work / "splats.json"
    rows = json.loads(path.read_text()) if path.exists() else []
    for name in args.orders.split(","):
        for seed in range(args.seeds):
            if any((row["order"], row["images"], row["seed"]) == (name, number, seed) for row in rows):
                continue
            order = ranked(name, args, scene, candidates, number, seed)
            renderer, splat = train(scene, np.array(order), ITERATIONS, GAUSSIANS, seed)
            found = measure(scene, renderer, splat)
            rows.append({"order": name, "share": args.share, "images": number, "seed": seed, "psnr": float(found["psnr"]), "ssim": float(found["ssim"])})
            path.write_text(json.dumps(rows, indent=1) + "\n")
    for row in rows:
        print(f"{row['order']:14} {row['images']:4} images, seed {row['seed']}: {row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}")


def natural(name):
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def read_scene(project, model, views, side):
    """Small images, poses and sparse points; every eighth view held out. What is transparent is white."""
    cameras = [model.cameras[view.camera_id] for view in views]
    scale = side / max(max(camera.width, camera.height) for camera in cameras)
    size = [round(scale * max(getattr(camera, of) for camera in cameras)) for of in ("height", "width")]
    images, inside = np.zeros((len(views), 3, *size), np.float32), np.zeros((len(views), *size), np.float32)
    intrinsics = []
    for i, (view, camera) in enumerate(zip(views, cameras)):
        if camera.model.name != "PINHOLE":
            sys.exit(f"error: {view.name}: a {camera.model.name} camera; undistort the images (viewrank undistort)")
        width, height = round(scale * camera.width), round(scale * camera.height)
        picture = cv2.imread(str(project / "images" / view.name), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255
        if picture.shape[2] == 4:
            picture = picture[:, :, :3] * picture[:, :, 3:] + 1 - picture[:, :, 3:]
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        images[i, :, :height, :width] = picture[:, :, ::-1].transpose(2, 0, 1)
        inside[i, :height, :width] = 1
        fx, fy, cx, cy = camera.params
        # Centres of pixels at whole numbers.
        intrinsics.append([fx * width / camera.width, fy * height / camera.height, cx * width / camera.width - 0.5, cy * height / camera.height - 0.5])
    poses = [view.cam_from_world() for view in views]
    points = {number: i for i, number in enumerate(sorted(model.points3D))}
    tracks = {(i, points[at.point3D_id]) for i, view in enumerate(views) for at in view.points2D if at.has_point3D()}
    of_points = [model.points3D[number] for number in points]
    return Scene(
        names=[view.name for view in views],
        images=images,
        inside=inside,
        intrinsics=np.array(intrinsics, np.float32),
        rotations=np.array([pose.rotation.matrix() for pose in poses], np.float32),
        translations=np.array([pose.translation for pose in poses], np.float32),
        held_out=np.arange(len(views)) % HELD_OUT == HELD_OUT // 2,
        points=np.array([point.xyz for point in of_points], np.float32),
        colours=np.array([point.color for point in of_points], np.float32) / 255,
        tracks=np.array(sorted(tracks)),
        background=background(images),
    )


def background(images):
    """Colour of what nothing is drawn on: that of the corners if all have one, as rendered images do, else black."""
    corners = images[:, :, [0, 0, -1, -1], [0, -1, 0, -1]].transpose(0, 2, 1).reshape(-1, 3)
    return corners[0] if np.ptp(corners, axis=0).max() < 2 / 255 else np.zeros(3, np.float32)


def ranked(name, args, scene, candidates, number, seed):
    """Indices of the first images of an order; only the random one depends on the seed."""
    if name == "every n-th":
        return [candidates[int((i + 0.5) * len(candidates) / number)] for i in range(number)]
    if name == "random":
        return list(np.random.default_rng(100 + seed).permutation(candidates)[:number])
    if name == "farthest view":
        return [candidates[i] for i in farthest(scene, candidates, number)]
    return [scene.names.index(key) for key in planned(args, scene)[:number]]


def farthest(scene, candidates, number):
    rotations, translations = scene.rotations[candidates], scene.translations[candidates]
    centres, axes = -np.einsum("nji,nj->ni", rotations, translations), rotations[:, 2]
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    apart = apart / apart.max() + np.arccos(np.clip(axes @ axes.T, -1, 1)) / np.pi
    chosen = [int(apart.sum(1).argmin())]
    while len(chosen) < number:
        nearest = apart[chosen].min(0)
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return chosen


def planned(args, scene):
    """Names in viewrank's order, planned without the held-out views."""
    project = args.work / "project"
    shutil.rmtree(project, ignore_errors=True)
    (project / "sparse/0").mkdir(parents=True)
    (project / "images").symlink_to((args.project / "images").resolve())
    model = pycolmap.Reconstruction(args.project / "sparse/0")
    held_out = {name for name, held in zip(scene.names, scene.held_out) if held}
    for image in list(model.images.values()):
        if image.name in held_out:
            model.deregister_frame(image.frame_id)
    model.write_binary(project / "sparse/0")
    subprocess.run([args.viewrank, "plan", project, "--backend", "splat", "--budget", "100%", "--target", "100%", "--quiet"], check=True)
    with open(project / "viewrank/manifest.csv", newline="", encoding="utf-8") as file:
        return [row["key"] for row in csv.DictReader(file)]


if __name__ == "__main__":
    main()
