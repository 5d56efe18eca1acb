"""benches/colmap_cuda.py up to the first call of CUDA: the pack, the lists, the fusion by COLMAP and the F-score. The card is played by maps of a plane."""

import json
import os
import shutil
import struct
import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest

from conftest import ROOT

sys.path[:0] = [str(ROOT / "benches")]

import colmap_cuda  # noqa: E402

pytestmark = pytest.mark.usefixtures("without_pilot")

SCALE = 0.5
SENSOR = 1000.0  # millimetres per unit of the model


@pytest.fixture(scope="module")
def plane(fixtures):
    """Depth and normals of each view of fixtures/valley, were the ground a plane."""
    model = pycolmap.Reconstruction(fixtures / "valley/sparse/0")
    points = np.array([point.xyz for point in model.points3D.values()])
    middle = np.median(points, axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]

    def of(image, scale):
        camera = model.cameras[image.camera_id]
        width, height = int(camera.width * scale), int(camera.height * scale)
        x, y = np.meshgrid((np.arange(width) + 0.5) / width * camera.width, (np.arange(height) + 0.5) / height * camera.height)
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.calibration_matrix()).T
        pose = image.cam_from_world()
        inside = pose.rotation.matrix() @ normal
        depth = (inside @ (pose * middle)) / (rays @ inside)
        depth[(depth < 0) | (depth > 60)] = 0
        facing = np.where((rays @ inside > 0)[..., None], -inside, inside)
        return depth.astype("<f4"), facing.astype("<f4")

    return model, of


@pytest.fixture(scope="module")
def packed(fixtures, plane, tmp_path_factory):
    place = tmp_path_factory.mktemp("card")
    shutil.copytree(fixtures / "valley", place / "valley")
    model, of = plane
    (place / "sensor").mkdir()
    for image in model.images.values():
        millimetres = (of(image, 0.25)[0] * SENSOR).clip(0, 65535).astype(np.uint16)
        cv2.imwrite(str(place / "sensor" / image.name.replace(".jpg", ".png")), millimetres)
    command = ["sh", ROOT / "benches/colmap_cuda.sh", "pack", place / "valley", place / "sensor", place / "pack.tar.xz", "--image-scale", str(SCALE), "--viewrank", os.environ.get("VIEWRANK", ROOT / "target/debug/viewrank")]
    subprocess.run([*map(str, command)], check=True, env={"PATH": "/usr/bin:/bin", "PYTHON": sys.executable})
    return place / "pack.tar.xz"


def test_without_a_card_it_ends_at_the_first_map(packed, tmp_path):
    command = ["sh", ROOT / "benches/colmap_cuda.sh", "run", packed, tmp_path / "work"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, env={"PATH": "/usr/bin:/bin", "PYTHON": sys.executable})
    assert done.returncode == colmap_cuda.NO_CUDA and done.stderr.startswith("error: COLMAP's matcher needs an NVIDIA card"), done.stderr
    assert done.stderr.count("\n") == 1


def test_lists_are_the_plan_and_the_clouds_are_scored(packed, plane, tmp_path, monkeypatch):
    shutil.unpack_archive(packed, tmp_path)
    plan = json.loads((tmp_path / "plan.json").read_text())
    model, of = plane

    def match(workspace, seconds):
        assert seconds > 0
        lines = colmap_cuda.listed(workspace.folder / "stereo/patch-match.cfg")
        assert lines[::2] == workspace.keys
        for image in model.images.values():
            if image.name in workspace.keys:
                depth, normals = of(image, SCALE)
                for kind, planes in (("depth_maps", depth[None]), ("normal_maps", normals.transpose(2, 0, 1))):
                    head = f"{depth.shape[1]}&{depth.shape[0]}&{len(planes)}&".encode()
                    (workspace.folder / "stereo" / kind / f"{image.name}.{workspace.kind}.bin").write_bytes(head + np.ascontiguousarray(planes).tobytes())
        return {"seconds": 10.0 * len(lines[1].split(",")), "finished": True}

    monkeypatch.setattr(colmap_cuda.Workspace, "match", match)
    colmap_cuda.run(SimpleNamespace(work=tmp_path, seconds=500, at_once=2))
    ours = colmap_cuda.listed(tmp_path / "ours/stereo/patch-match.cfg")
    assert ours[::2] == plan["keys"] and ours[1::2] == plan["partners"]
    assert set(colmap_cuda.listed(tmp_path / "defaults/stereo/patch-match.cfg")[1::2]) == {colmap_cuda.AUTO}
    result = json.loads((tmp_path / "colmap_cuda.json").read_text())
    rows = {row["name"]: row for row in result["clouds"]}
    assert result["left_out"] == [] and len(rows) == 2 * len(colmap_cuda.PREFIXES)
    # The sensor's scale was found, and the fused plane is the reference; what two maps agree on is less exact than what five do.
    assert rows["ours, 100%"]["F"] > 0.85 and rows["COLMAP's defaults"]["F"] > 0.9
    assert rows["ours, 10%"]["recall"] < rows["ours, 30%"]["recall"] < rows["ours, 100%"]["recall"]
    assert 0 < result["aim"]["seconds"] and result["aim"]["F"] >= colmap_cuda.AIM


def test_what_the_card_did_not_finish_is_left_out(packed, tmp_path, monkeypatch):
    shutil.unpack_archive(packed, tmp_path)
    monkeypatch.setattr(colmap_cuda.Workspace, "match", lambda *_: {"seconds": 1.0, "finished": False})
    colmap_cuda.run(SimpleNamespace(work=tmp_path, seconds=500, at_once=1))
    result = json.loads((tmp_path / "colmap_cuda.json").read_text())
    assert result["clouds"] == [] and result["aim"] is None and len(result["left_out"]) == 2 * len(colmap_cuda.PREFIXES)


def test_f_score_is_that_of_two_grids():
    x, y = np.meshgrid(np.arange(100.0), np.arange(100.0))
    grid = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    half = grid[grid[:, 0] < 50]
    off = np.concatenate([half, half + [0, 0, 5]])
    score = colmap_cuda.f_score(off, grid, 0.5)
    assert score["precision"] == 0.5 and score["recall"] == 0.5 and score["F"] == 0.5 and score["points"] == len(off)
    assert colmap_cuda.f_score(np.zeros((0, 3)), grid, 0.5)["F"] == 0


def test_every_nth_and_the_aim():
    keys = [f"{i:03}.jpg" for i in reversed(range(10))]
    assert colmap_cuda.every_nth(keys, 5) == [f"{i:03}.jpg" for i in (0, 2, 4, 6, 8)]
    row = lambda name, seconds, f: {"name": name, "seconds": seconds, "F": f, "maps": seconds}  # noqa: E731
    rows = [row("ours, 10%", 1, 0.5), row("ours, 30%", 3, 0.77), row("ours, 100%", 10, 0.82)]
    assert colmap_cuda.aim(rows) is None
    assert colmap_cuda.aim([*rows, row("COLMAP's defaults", 40, 0.8)]) == {"F": 0.77 / 0.8, "seconds": 3 / 40, "maps": 3}


def test_code_of_one_architecture_is_kept():
    def entry(kind, arch, payload):
        return struct.pack("<HHIQ12xI", kind, 0x101, 64, len(payload), arch).ljust(64, b"h") + payload

    entries = entry(2, 80, b"a" * 40) + entry(2, 90, b"b" * 24) + entry(1, 90, b"p" * 16)
    binary = struct.pack("<IHHQ", 0xBA55ED50, 1, 16, len(entries)) + entries
    library = b"ELF" + binary + b"tail" + binary
    kept = colmap_cuda.without_other_code(library, 90)
    assert kept == library.replace(b"a" * 40, bytes(40)).replace(b"p" * 16, bytes(16))
    # One that is cut off, or not what it looks like, is left alone.
    assert colmap_cuda.without_other_code(binary[:100], 90) == binary[:100]
