"""Run with: python -m pytest integrations/sgm

What measure.py says of maps and pairs whose errors are known.
"""

import json
import sys

import numpy as np
import pytest

import measure
from test_sgm import CAMERAS, HEIGHT, SIDES, WIDTH, plane_depth, write_workspace
from workspace import Workspace


def write_rendered(path, depth, mask):
    """The inverse of read_rendered, after the format's description."""
    steps = np.rint(depth / 0.003).astype(np.uint16)
    differences = np.diff(np.diff(steps, axis=0, prepend=np.uint16(0)), axis=1, prepend=np.uint16(0)).astype(np.int16)
    zigzag = ((differences << 1) ^ (differences >> 15)).astype(np.uint16)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, lo=(zigzag & 255).astype(np.uint8), hi=(zigzag >> 8).astype(np.uint8), mask=mask)


@pytest.fixture(scope="module")
def planes(tmp_path_factory):
    folder = write_workspace(tmp_path_factory.mktemp("measured") / "w")
    for name in CAMERAS:
        write_rendered((folder / "truth" / name).with_suffix(".npz"), plane_depth(name), np.ones((HEIGHT, WIDTH), np.uint8))
    return folder


def test_exact_depth_is_read_to_half_a_step(tmp_path):
    depth = np.random.default_rng(0).uniform(0, 190, (30, 40))
    mask = np.random.default_rng(1).integers(0, 4, depth.shape).astype(np.uint8)
    write_rendered(tmp_path / "a.npz", depth, mask)
    read = measure.read_reference(tmp_path, "a.jpg")
    known = (mask == 1) | (mask == 3)
    assert not read[~known].any()
    assert np.abs(read - depth)[known].max() < 0.0016


def test_a_resized_plane_stays_the_plane():
    small = plane_depth("key.png").reshape(HEIGHT // 2, 2, WIDTH // 2, 2)
    small = (1 / (1 / small).mean((1, 3))).astype(np.float32)  # inverse depth is linear on a plane
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(measure.resized(small, (WIDTH, HEIGHT))[inner], plane_depth("key.png")[inner], rtol=1e-5)


def test_completeness_outliers_and_error_of_a_map(planes, tmp_path, monkeypatch, capsys):
    """A quarter is missing, a quarter is off by far too much, the rest by 0.03 along the ray."""
    depth = plane_depth("key.png") + 0.03 / measure.ray_lengths(Workspace(planes).views["key.png"])
    depth[: HEIGHT // 4] = 0
    depth[HEIGHT // 4 : HEIGHT // 2] *= 1.5
    (tmp_path / "depth_maps").mkdir()
    np.save(tmp_path / "depth_maps/key.png.npy", depth.astype(np.float32))
    partners = [{"name": SIDES[0], "matched": True, "seconds": 0.5}]
    (tmp_path / "report.json").write_text(json.dumps({"settings": {"image_scale": 1.0}, "clusters": [{"key": "key.png", "partners": partners}]}))
    monkeypatch.setattr(sys, "argv", ["measure.py", "maps", str(tmp_path), "--workspace", str(planes), "--reference", str(planes / "truth"), "--gsd", "0.02"])
    measure.main()
    said = capsys.readouterr().out
    assert "completeness 0.5000, outliers 0.3333, RMSE 0.0300 (limit 0.0600); 0.500 s per pair" in said


def test_pairs_of_the_plane_work_and_their_geometry_is_right(planes, tmp_path, monkeypatch):
    rows = tmp_path / "rows.json"
    monkeypatch.setattr(sys, "argv", ["measure.py", "pairs", str(tmp_path / "cache"), "--workspace", str(planes), "--reference", str(planes / "truth"), "--json", str(rows)])
    measure.main()
    found = {(r["key"], r["partner"]): r for r in json.loads(rows.read_text())}
    side, ahead = found["key.png", SIDES[0]], found["key.png", "forward.png"]
    assert side["complete"] > 0.8 and side["wrong"] < 0.01 and side["error"] < 0.2
    assert side["epipole"] > 0.5 and ahead["epipole"] < -0.25
    assert ahead["octaves"] == pytest.approx(np.log2(7 / 10), abs=0.1), "the partner is 3 nearer to a plane 10 away"


def test_incidence_of_the_plane(planes):
    view = Workspace(planes).views["key.png"]
    xyz, normal = measure.surface(view, plane_depth("key.png"))
    expected = np.array([0.15, -0.1, 1.0]) / np.linalg.norm([0.15, -0.1, 1.0])
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(np.abs(normal[inner] @ expected), 1, atol=1e-9)
    np.testing.assert_allclose(xyz @ [0.15, -0.1, 1.0], 10, rtol=1e-9)
