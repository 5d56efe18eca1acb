"""From our lists to a cloud, without a card: the run.sh of an export for COLMAP, whose patch_match_stereo is played by integrations/sgm, and whose stereo_fusion is COLMAP's own
(pycolmap). Its maps and its cloud are then read by viewrank."""

import json
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

pytestmark = pytest.mark.usefixtures("without_pilot")

ROOT = Path(__file__).resolve().parents[2]
SCALE = "0.25"
FIRST = 6  # key views of the prefix that is matched

# Takes the two command lines of run.sh. The maps of a list: depths as integrations/sgm left them, and the normals of their surface.
STAND_IN = '''#!{python}
import os, sys
from pathlib import Path
import numpy as np
import pycolmap

command, words = sys.argv[1], sys.argv[2:]
given = dict(zip(words[::2], words[1::2]))
with open(os.environ["CALLS"], "a") as log:
    print(*sys.argv[1:], file=log)
workspace = Path(given["--workspace_path"])
if command == "stereo_fusion":
    options = pycolmap.StereoFusionOptions()
    for name in ("min_num_pixels", "check_num_images"):
        setattr(options, name, int(given["--StereoFusion." + name]))
    pycolmap.stereo_fusion(given["--output_path"], workspace, input_type=given["--input_type"], options=options, output_type="ply")
    sys.exit()
assert command == "patch_match_stereo" and given["--PatchMatchStereo.geom_consistency"] == "0"
lines = [line.strip() for line in Path(workspace, given["--config_path"]).read_text().splitlines()]
lines = [line for line in lines if line and not line.startswith("#")]
model = pycolmap.Reconstruction(workspace / "sparse")
for key, partners in zip(lines[::2], lines[1::2]):
    assert all(model.find_image_with_name(name.strip()) for name in partners.split(","))
    path = Path(os.environ["MAPS"], key + ".npy")
    if not path.exists():
        continue
    depth = np.load(path)
    camera = model.cameras[model.find_image_with_name(key).camera_id]
    height, width = depth.shape
    (fx, fy, cx, cy), (sx, sy) = camera.params, (width / camera.width, height / camera.height)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    place = np.stack([(x + 0.5 - cx * sx) / (fx * sx), (y + 0.5 - cy * sy) / (fy * sy), np.ones_like(depth)], -1) * depth[..., None]
    normal = np.cross(np.gradient(place, axis=1), np.gradient(place, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    normal[normal[..., 2] > 0] *= -1
    for kind, planes in (("depth_maps", depth[None]), ("normal_maps", np.where(depth[..., None] > 0, normal, 0).transpose(2, 0, 1))):
        head = f"{{width}}&{{height}}&{{len(planes)}}&".encode()
        (workspace / "stereo" / kind / f"{{key}}.photometric.bin").write_bytes(head + np.ascontiguousarray(planes, "<f4").tobytes())
'''


@pytest.fixture(scope="module")
def fused(viewrank, fixtures, tmp_path_factory):
    """A project with a plan for COLMAP, the workspace of its export with the maps of the first key views, and what run.sh called."""
    place = tmp_path_factory.mktemp("colmap")
    project = place / "valley"
    shutil.copytree(fixtures / "valley", project)
    (project / "viewrank.toml").write_text(f"image_scale = {SCALE}\n")
    viewrank("plan", project, "--backend", "colmap", "-k", "4", "--budget", "8", "--quiet")
    sgm = [sys.executable, ROOT / "integrations/sgm/sgm.py", "match", project, "--out", place / "sgm", "--image-scale", SCALE, "--stop-at", str(FIRST)]
    subprocess.run([*map(str, sgm)], check=True, capture_output=True)
    viewrank("export", project, "--backend", "colmap")
    stand_in = place / "colmap"
    stand_in.write_text(STAND_IN.format(python=sys.executable))
    stand_in.chmod(0o755)
    workspace = project / "viewrank/colmap"
    environment = {**os.environ, "COLMAP": str(stand_in), "MAPS": str(place / "sgm/depth_maps"), "CALLS": str(place / "calls")}
    done = subprocess.run(["sh", workspace / "stereo/viewrank/run.sh"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return project, workspace, (place / "calls").read_text().splitlines()


def test_colmaps_fusion_joins_the_maps_of_the_first_key_views(fused):
    project, workspace, calls = fused
    assert [call.split()[0] for call in calls] == ["patch_match_stereo", "stereo_fusion"]
    clusters = json.loads((project / "viewrank/manifest.json").read_text())["clusters"]
    keys = [cluster["key"] for cluster in clusters][:FIRST]
    maps = {path.name for path in (workspace / "stereo/depth_maps").rglob("*.photometric.bin")}
    assert maps == {f"{key}.photometric.bin" for key in keys}
    xyz = points(workspace / "stereo/viewrank/fused.ply")
    assert len(xyz) > 2000
    model = pycolmap.Reconstruction(workspace / "sparse")
    sparse = np.array([point.xyz for point in model.points3D.values()])
    low, high = np.quantile(sparse, [0.01, 0.99], axis=0)
    assert np.mean(np.all((xyz > low - 5) & (xyz < high + 5), axis=1)) > 0.99, "in the scene"
    # Each point is near the depths of the views that .vis names for it, by their place in images.bin.
    depths = {key: np.load(project.parent / f"sgm/depth_maps/{key}.npy") for key in keys}
    names = [image.name for _, image in sorted(model.images.items())]
    views = visibility(workspace / "stereo/viewrank/fused.ply.vis")
    assert len(views) == len(xyz) and all(len(of_point) >= 2 for of_point in views)
    checked = near = 0
    for point, of_point in list(zip(xyz, views))[::50]:
        for name in (names[view] for view in of_point):
            image = model.find_image_with_name(name)
            camera, depth = model.cameras[image.camera_id], depths[name]
            x, y, z = image.cam_from_world() * point
            column, row = camera.img_from_cam([x / z, y / z, 1.0]) * (depth.shape[1] / camera.width)
            found = depth[min(max(int(row), 0), depth.shape[0] - 1), min(max(int(column), 0), depth.shape[1] - 1)]
            checked, near = checked + 1, near + (abs(found / z - 1) < 0.02)
    assert checked > 50 and near > 0.9 * checked


def test_viewrank_fuses_the_same_from_links(viewrank, fused):
    """In a workspace of its own, the maps that the script has made."""
    project, workspace, calls = fused
    before = len(points(workspace / "stereo/viewrank/fused.ply"))
    log = project.parent / "calls of viewrank"
    command = [viewrank.program, "run", project, "--backend", "colmap", "--program", project.parent / "colmap", "--fuse"]
    done = subprocess.run([*map(str, command)], env={**os.environ, "CALLS": str(log)}, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and f"{FIRST} of 8 depth maps are there" in done.stderr, done.stderr
    words = [line.split(" --workspace_path ")[1].split()[1:-1] for line in (calls[-1], log.read_text())]
    assert words[0] == words[1] and "unfinished" in log.read_text()
    cloud = workspace / "stereo/viewrank/fused.ply"
    assert abs(len(points(cloud)) / before - 1) < 0.02 and len(visibility(cloud.with_name("fused.ply.vis"))) == len(points(cloud))


def test_viewrank_reads_these_maps_and_this_cloud(viewrank, fused):
    project, workspace, _ = fused
    maps = workspace / "stereo/depth_maps"
    viewrank("evaluate", project, "--depth-maps", maps, "--cloud", workspace / "stereo/viewrank/fused.ply")
    evaluation = json.loads((project / "viewrank/evaluation/evaluation.json").read_text())
    assert len(evaluation["key_views"]) == FIRST
    table = (project / "viewrank/evaluation/cells.tsv").read_text()
    cells = [int(line.split("\t")[0]) for line in table.splitlines()[1:]]
    assert sum(cells) > 500
    viewrank("evaluate", project, "--depth-maps", maps)
    assert (project / "viewrank/evaluation/cells.tsv").read_text() == table, "the cloud of run.sh is found where it is"
    viewrank("plan", project, "--backend", "colmap", "-k", "4", "--budget", "8", "--quiet", "--finished", maps)
    again = json.loads((project / "viewrank/manifest.json").read_text())
    assert sum(cluster["finished"] for cluster in again["clusters"]) == FIRST and not again["outdated"]


def points(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    return np.frombuffer(body, np.dtype([("x", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)]), count)["x"].astype(float)


def visibility(path):
    data = path.read_bytes()
    (count,), at, views = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        (number,) = struct.unpack_from("<I", data, at)
        views.append(struct.unpack_from(f"<{number}I", data, at + 4))
        at += 4 + 4 * number
    assert at == len(data)
    return views


@pytest.fixture
def of_two_widths(fixtures, tmp_path):
    """A project in which one camera more is 40 pixels wider."""
    project = tmp_path / "valley"
    shutil.copytree(fixtures / "valley", project)
    model = pycolmap.Reconstruction(project / "sparse/0")
    shutil.rmtree(project / "sparse/0")
    (project / "sparse/0").mkdir()
    model.write_text(project / "sparse/0")
    cameras, images = project / "sparse/0/cameras.txt", project / "sparse/0/images.txt"
    for name in ("rigs.txt", "frames.txt"):
        (project / "sparse/0" / name).unlink(missing_ok=True)
    first = next(line for line in cameras.read_text().splitlines() if not line.startswith("#")).split()
    width, height = map(int, first[2:4])
    wide = [str(int(first[0]) + 1), *first[1:2], str(width + 40), str(height + 30), *first[4:]]
    cameras.write_text(cameras.read_text() + " ".join(wide) + "\n")
    lines = images.read_text().splitlines()
    heads = [i for i, line in enumerate(lines) if line.endswith(".jpg")]
    for i in heads[::3]:
        words = lines[i].split()
        words[8] = wide[0]
        lines[i] = " ".join(words)
        picture = project / "images" / words[9]
        cv2.imwrite(str(picture), cv2.resize(cv2.imread(str(picture)), (width + 40, height + 30)))
    images.write_text("\n".join(lines) + "\n")
    return project


@pytest.mark.parametrize("version, fault", [("3.8", False), ("4.0.4", True), ("4.1.1", True), ("4.2.0", False), (None, True)])
def test_colmap_4x_mixed_width_sources(viewrank, of_two_widths, tmp_path, version, fault):
    """The fault is said of versions that have it, once, and not of others."""
    program = viewrank("--version").args[0]
    colmap = tmp_path / "bin/colmap"
    colmap.parent.mkdir()
    colmap.write_text(f"#!/bin/sh\necho 'COLMAP {version} (Commit 0 on 2026-01-01 with CUDA)'\n")
    colmap.chmod(0o755)
    environment = {**os.environ, "PATH": str(tmp_path), "COLMAP": str(colmap if version else tmp_path / "none")}

    def said(*words):
        done = subprocess.run([program, *map(str, words)], env=environment, capture_output=True, text=True, check=False)
        return " ".join((done.stdout + done.stderr).split())

    said("plan", of_two_widths, "--backend", "colmap", "-k", "4", "--budget", "8", "--quiet")
    exported = said("export", of_two_widths, "--backend", "colmap")
    (record,) = of_two_widths.rglob("export.json")
    warnings = [line for line in json.loads(record.read_text())["warnings"] if "wrongly to the GPU" in line]
    assert len(warnings) == fault and ("wrongly to the GPU" in exported) == fault
    examined = said("doctor", of_two_widths, "--backend", "colmap")
    assert ("wrongly to the GPU" in examined) == fault
    if fault:
        words = f"COLMAP {version}, which is installed" if version else "COLMAP 4.0.0 to 4.1.1"
        assert words in warnings[0] and words in examined
