"""`viewrank undistort` against `image_undistorter` of COLMAP 3.8: cameras, 2D points, pixels."""
import json
import struct
import subprocess

import cv2
import numpy as np
import pycolmap
import pytest

# Number of the model in COLMAP's files, parameters for images of 600 x 450.
CAMERAS = {
    "SIMPLE_RADIAL": (2, [510, 300, 225, -0.15]),
    "RADIAL": (3, [510, 307, 220, 0.12, 0.03]),
    "OPENCV": (4, [510, 515, 307.3, 219.9, -0.12, 0.03, 0.001, -0.002]),
    "OPENCV_FISHEYE": (5, [400, 402, 300, 225, 0.02, 0.01, 0, 0]),
    "FULL_OPENCV": (6, [510, 510, 300, 225, 0.1, -0.05, 0.001, 0, 0.01, 0.02, 0, 0]),
    "FOV": (7, [500, 500, 300, 225, 0.6]),
    "THIN_PRISM_FISHEYE": (10, [450, 450, 300, 225, 0.01, 0, 0.001, 0.001, 0, 0, 0.001, 0]),
}
OPTIONS = [
    [],
    ["--blank_pixels", "0.5", "--max_image_size", "400"],
    ["--blank_pixels", "1", "--max_scale", "1.02"],
    ["--roi_min_x", "0.1", "--roi_min_y", "0.2", "--roi_max_x", "0.95", "--roi_max_y", "0.9"],
]
KEPT = 4
ENCODING = {".tif": (cv2.IMWRITE_TIFF_COMPRESSION, 1), ".jpg": (cv2.IMWRITE_JPEG_QUALITY, 95)}


@pytest.fixture
def project(tmp_path, fixtures):
    """Makes a project of a few views of the fixture, as if a camera of that model had taken them."""

    def make(camera, suffix=".tif"):
        model, params = CAMERAS[camera]
        reconstruction = pycolmap.Reconstruction(fixtures / "valley/sparse/0")
        images = sorted(reconstruction.images.values(), key=lambda image: image.name)
        for image in images[KEPT:]:
            reconstruction.deregister_frame(image.frame_id)
        for i, image in enumerate(images[:KEPT]):
            source = cv2.imread(str(fixtures / "valley/images" / image.name))
            image.name = f"flight {i % 2}/{image.name}".replace(".jpg", suffix)
            to = tmp_path / "project/images" / image.name
            to.parent.mkdir(parents=True, exist_ok=True)
            # zlib of OpenCV and of pycolmap don't get on in one process: no PNG, no deflated TIFF.
            assert cv2.imwrite(str(to), source, [*ENCODING[suffix]])
        sparse = tmp_path / "project/sparse/0"
        sparse.mkdir(parents=True)
        reconstruction.write_binary(sparse)
        for name in ("rigs.bin", "frames.bin"):
            (sparse / name).unlink(missing_ok=True)
        (sparse / "cameras.bin").write_bytes(struct.pack(f"<QIiQQ{len(params)}d", 1, 1, model, 600, 450, *params))
        return tmp_path / "project"

    return make


def colmap(project, out, options):
    out.mkdir()
    command = ["colmap", "image_undistorter", "--image_path", project / "images", "--input_path", project / "sparse/0", "--output_path", out]
    subprocess.run([*map(str, command), *options], check=True, capture_output=True)
    return out


def ours(viewrank, project, out, options):
    """Runs with the same options, typed our way."""
    typed = dict(zip(options[::2], options[1::2], strict=True))
    region = [typed.pop(f"--roi_{side}", default) for side, default in (("min_x", "0"), ("min_y", "0"), ("max_x", "1"), ("max_y", "1"))]
    words = [word for key, value in typed.items() for word in (key.replace("_", "-"), value)]
    roi = ["--roi", ",".join(region)] if any("roi" in option for option in options) else []
    done = viewrank("undistort", project, "--out", out, *words, *roi, "--format", "json")
    return json.loads(done.stdout)


def assert_same_workspace(theirs, mine, most):
    a, b = pycolmap.Reconstruction(theirs / "sparse"), pycolmap.Reconstruction(mine / "sparse")
    ours, their = b.cameras[1], a.cameras[1]
    assert ours.model.name == "PINHOLE"
    assert (ours.width, ours.height) == (their.width, their.height)
    assert np.allclose(ours.params, their.params, rtol=0, atol=1e-6)
    assert set(a.points3D) == set(b.points3D) and a.compute_num_observations() == b.compute_num_observations()
    for image_id, image in a.images.items():
        other = b.images[image_id]
        assert other.name == image.name
        assert np.abs(other.cam_from_world().matrix() - image.cam_from_world().matrix()).max() < 1e-12
        pixels = [np.array([point.xy for point in i.points2D]) for i in (image, other)]
        assert np.nanmax(np.abs(pixels[0] - pixels[1])) < 1e-4
        assert [p.point3D_id for p in image.points2D] == [p.point3D_id for p in other.points2D]
        pictures = [cv2.imread(str(folder / "images" / image.name)).astype(int) for folder in (theirs, mine)]
        assert pictures[0].shape == pictures[1].shape == (their.height, their.width, 3)
        off = np.abs(pictures[0] - pictures[1])
        assert off.max() <= most and off.mean() < most / 4, (image.name, off.max(), off.mean())
    for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
        folders = [{p.relative_to(f) for p in (f / "stereo" / kind).rglob("*") if p.is_dir()} for f in (theirs, mine)]
        assert folders[0] == folders[1]
    for name in ("patch-match.cfg", "fusion.cfg"):
        lines = [sorted((f / "stereo" / name).read_text().splitlines()) for f in (theirs, mine)]
        assert lines[0] == lines[1]


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_camera_model_as_colmap(viewrank, project, tmp_path, camera):
    folder = project(camera)
    ours(viewrank, folder, tmp_path / "ours", [])
    assert_same_workspace(colmap(folder, tmp_path / "theirs", []), tmp_path / "ours", 2)


@pytest.mark.parametrize("options", OPTIONS[1:], ids=lambda options: options[0])
def test_every_option_as_colmap(viewrank, project, tmp_path, options):
    folder = project("OPENCV")
    ours(viewrank, folder, tmp_path / "ours", options)
    assert_same_workspace(colmap(folder, tmp_path / "theirs", options), tmp_path / "ours", 2)


def test_jpeg_up_to_the_two_decoders_and_encoders(viewrank, project, tmp_path):
    folder = project("OPENCV", ".jpg")
    ours(viewrank, folder, tmp_path / "ours", [])
    assert_same_workspace(colmap(folder, tmp_path / "theirs", []), tmp_path / "ours", 24)


def test_goes_on_where_it_was(viewrank, project, tmp_path):
    folder = project("SIMPLE_RADIAL")
    assert ours(viewrank, folder, tmp_path / "ours", [])["computed"] == KEPT
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "ours").rglob("*") if path.is_file()}
    assert ours(viewrank, folder, tmp_path / "ours", [])["computed"] == 0
    assert before == {path: path.stat().st_mtime_ns for path in before}
    (tmp_path / "ours/images/flight 0").rename(tmp_path / "gone")
    assert ours(viewrank, folder, tmp_path / "ours", [])["computed"] == KEPT
    assert ours(viewrank, folder, tmp_path / "ours", ["--max_image_size", "300"])["computed"] == KEPT
    assert pycolmap.Reconstruction(tmp_path / "ours/sparse").cameras[1].width == 300


def test_everything_else_works_on_it(viewrank, project, tmp_path):
    folder = project("SIMPLE_RADIAL", ".jpg")
    viewrank("undistort", folder, "--quiet")
    viewrank("plan", folder / "dense", "--backend", "colmap", "-k", "2", "--quiet")
    cfg = (folder / "dense/stereo/patch-match.cfg").read_text()
    assert "viewrank" in cfg and "__auto__" not in cfg
    assert not list((folder / "dense").rglob("*.before-viewrank"))
    viewrank("undistort", folder, "--quiet")
    assert (folder / "dense/stereo/patch-match.cfg").read_text() == cfg, "nothing changed: the plan's list stays"
    for backend in ("openmvs", "mvsnet", "sure", "alicevision", "splat"):
        viewrank("export", folder / "dense", "--backend", backend)


def test_masks_are_left_behind_with_a_warning(viewrank, project):
    folder = project("OPENCV")
    assert "masks" not in viewrank("undistort", folder, "--quiet").stderr
    for image in (folder / "images").rglob("*.*"):
        mask = folder / "masks" / f"{image.relative_to(folder / 'images')}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        mask.write_bytes(b"")
    assert f"the masks in {folder / 'masks'} are not undistorted" in viewrank("undistort", folder, "--quiet").stderr


def test_the_images_themselves_are_never_overwritten(viewrank, project):
    folder = project("SIMPLE_RADIAL")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = viewrank("undistort", folder, "--out", folder, expect=1)
    assert "--out" in done.stderr
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
