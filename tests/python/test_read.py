"""Every model is read as pycolmap reads it: the same counts, poses and reprojections."""
import json
import subprocess

import numpy as np
import pycolmap
import pytest

# pycolmap cuts names of text models at the first blank and takes quaternions as they are; both are tested in Rust.
OTHERWISE = {"names/txt", "txt_unnormalised_quaternion"}


@pytest.fixture(scope="session")
def read(example, tmp_path_factory):
    """Returns names, poses, observations and pixels of a model as viewrank reads them (crates/io/examples/scene.rs)."""
    program = example("scene")

    def run(model):
        out = tmp_path_factory.mktemp("scene")
        subprocess.run([program, model, out], check=True, capture_output=True)
        arrays = [np.load(out / f"{name}.npy") for name in ("poses", "observations", "pixels")]
        return json.loads((out / "views.json").read_text()), *arrays

    return run


SETS = ["valley", "caliterra", "lewis", "boruszyn"]


@pytest.fixture(scope="session")
def models(fixtures):
    """The small models of every kind, and that of `valley`."""
    formats = fixtures / "formats"
    names = json.loads((formats / "expected.json").read_text()).keys() - OTHERWISE
    return [fixtures / "valley/sparse/0", *(formats / name for name in sorted(names))]


def of_set(folder):
    """Returns the model of the undistorted images and, if there is one, that of the original images."""
    return [model for model in (folder / "sparse/0", folder / "distorted/sparse/0") if model.is_dir()]


def plain(name):
    """The name of an image as viewrank reads it: a path below the folder of the images."""
    return "/".join(part for part in name.replace("\\", "/").split("/") if part not in ("", ".", ".."))


def compare(read, folder):
    theirs = pycolmap.Reconstruction(folder)
    names, poses, observations, pixels = read(folder)
    images = {plain(image.name): image for image in theirs.images.values() if image.has_pose}
    assert sorted(images, key=lambda name: name.encode()) == names
    assert len(observations) == theirs.compute_num_observations()

    for name, pose in zip(names, poses):
        matrix = images[name].cam_from_world().matrix()
        assert np.abs(pose[:9].reshape(3, 3) - matrix[:, :3]).max() < 1e-12
        assert np.abs(pose[9:] - matrix[:, 3]).max() <= 1e-12 * (1 + np.abs(matrix[:, 3]).max())

    # Observations in one order: by point, image, pixel.
    found = {}
    for (view, point), row in zip(observations, pixels):
        found.setdefault((int(point), names[view]), []).append(tuple(row))
    expected = {}
    for point_id, point in theirs.points3D.items():
        for element in point.track.elements:
            image = theirs.images[element.image_id]
            camera = theirs.cameras[image.camera_id]
            projected = camera.img_from_cam(image.cam_from_world() * point.xyz)
            projected = (np.nan, np.nan) if projected is None else projected
            measured = image.points2D[element.point2D_idx].xy
            undistorted = camera.model.name in ("PINHOLE", "SIMPLE_PINHOLE")
            row = (*measured, *projected), 1e-9 if undistorted else 1e-6
            expected.setdefault((point_id, plain(image.name)), []).append(row)
    assert found.keys() == expected.keys()
    for key, rows in expected.items():
        for mine, (theirs_row, tolerance) in zip(sorted(found[key]), sorted(rows), strict=True):
            assert mine[:2] == theirs_row[:2], key
            assert np.allclose(mine[2:], theirs_row[2:], rtol=0, atol=tolerance, equal_nan=True), (key, mine, theirs_row)


def compare_counts(viewrank, model):
    theirs = pycolmap.Reconstruction(model)
    found = json.loads(viewrank("inspect", model, "--format", "json").stdout)
    assert (found["registered"], found["cameras"]) == (theirs.num_reg_images(), theirs.num_cameras()), model
    assert (found["points"], found["observations"]) == (theirs.num_points3D(), theirs.compute_num_observations()), model
    if theirs.num_points3D():
        theirs.update_point_3d_errors()
        assert abs(found["mean_reprojection_error_px"] - theirs.compute_mean_reprojection_error()) < 1e-6, model


def test_poses_and_reprojections_are_those_of_pycolmap(read, models):
    compared = [compare(read, model) for model in models]
    assert len(compared) > 50


def test_inspect_counts_are_those_of_pycolmap(viewrank, models):
    for model in models:
        compare_counts(viewrank, model)


@pytest.mark.parametrize("name", SETS)
def test_the_data_sets_are_read_as_pycolmap_reads_them(read, viewrank, data, name):
    for model in of_set(data(name)):
        compare(read, model)
        compare_counts(viewrank, model)
