"""The scripts that make data sets write what other readers read."""
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "benches"), str(ROOT / "integrations" / "sgm")]

from aerial import model as aerial  # noqa: E402
from measure import read_rendered  # noqa: E402
from render import colmap_model, depth_file  # noqa: E402
from render.camera import Camera, look  # noqa: E402


@pytest.mark.parametrize("fine", [False, True])
def test_exact_depth_is_read_back(tmp_path, fine):
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.5, 180, (37, 53))
    mask = rng.integers(0, 4, depth.shape).astype(np.uint8)
    depth_file.write(tmp_path / "a.npz", np.where(mask % 2 == 1, depth, 0), mask, fine)
    found, found_mask = depth_file.read(tmp_path / "a.npz")
    assert (found_mask == mask).all() and (found[mask % 2 == 0] == 0).all()
    there = mask % 2 == 1
    error = depth_file.STEP / 2 / (depth_file.FINE if fine else 1) + 1e-5
    assert np.abs(found - depth)[there].max() <= error
    assert np.abs(read_rendered(tmp_path / "a.npz") - depth)[there & (mask == depth_file.STATIC)].max() <= depth_file.STEP / 2 + 1e-5


def test_models_are_read_by_pycolmap(tmp_path):
    camera = Camera.centred(640, 480, 0.8)
    centre, target = np.array([3.0, -2.0, 1.5]), np.array([0.0, 0.0, 0.5])
    rotation = look(centre, target)
    image = colmap_model.Image(7, "a.jpg", rotation, -rotation @ centre, np.array([[320.0, 240.0]]), np.array([9]))
    other = colmap_model.posed(8, "b.jpg", np.eye(3), np.zeros(3))
    point = colmap_model.Point(9, target, (1, 2, 3), 0.5, [(7, 0)])
    colmap_model.write(tmp_path, camera, [image, other], [point])
    read = pycolmap.Reconstruction(str(tmp_path))
    assert read.images[7].projection_center() == pytest.approx(centre)
    # It looks at the target.
    assert read.images[7].project_point(read.points3D[9].xyz) == pytest.approx([320, 240])
    again, poses = colmap_model.read_poses(tmp_path)
    assert again == camera and list(poses) == ["a.jpg", "b.jpg"]
    assert poses["a.jpg"][0] == pytest.approx(rotation) and poses["a.jpg"][1] == pytest.approx(centre)


def test_a_survey_is_consistent_and_always_the_same(tmp_path):
    for name in ("one", "two"):
        aerial.make(tmp_path / name, views=60, points=3000)
    files = ("cameras.bin", "images.bin", "points3D.bin")
    assert all((tmp_path / "one" / f).read_bytes() == (tmp_path / "two" / f).read_bytes() for f in files)
    read = pycolmap.Reconstruction(str(tmp_path / "one"))
    assert read.num_reg_images() == 60 and 2500 < read.num_points3D() <= 3000
    assert 5 < read.compute_mean_track_length() < 8
    stored = read.compute_mean_reprojection_error()
    read.update_point_3d_errors()
    assert stored == pytest.approx(read.compute_mean_reprojection_error()) and 0.3 < stored < 0.8
