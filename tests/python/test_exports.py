"""Exports for COLMAP, read back by COLMAP 3.8 and pycolmap; places and messages of the exports of all backends."""
import json
import shutil
import struct
import subprocess

import cv2
import numpy as np
import pycolmap
import pytest

from conftest import names_of


def colmap(*words):
    done = subprocess.run(["colmap", *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_every_backend_writes_where_it_is_told_to(viewrank, export):
    for backend in json.loads(viewrank("backends", "--format", "json").stdout):
        folder = export(backend["name"])
        (record,) = folder.rglob("export.json")
        assert json.loads(record.read_text())["backend"] == backend["name"]
        before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
        export(backend["name"])
        assert before == {path: path.stat().st_mtime_ns for path in before}, "the same once more changes nothing"


# COLMAP


def assert_loads(model, names, whole, tmp_path):
    """Asserts that both generations of COLMAP read the model, which is the part of the whole one that these images see."""
    reduced = pycolmap.Reconstruction(model)
    assert {image.name for image in reduced.images.values()} == names
    for image in reduced.images.values():
        original = whole.images[image.image_id]
        assert original.name == image.name and np.array_equal(original.cam_from_world().matrix(), image.cam_from_world().matrix())
        assert [p.xy.tolist() for p in image.points2D] == [p.xy.tolist() for p in original.points2D]
    for point_id, point in reduced.points3D.items():
        assert np.array_equal(point.xyz, whole.points3D[point_id].xyz)
        for element in point.track.elements:
            assert reduced.images[element.image_id].points2D[element.point2D_idx].point3D_id == point_id
    said = colmap("model_analyzer", "--path", model)
    assert f"Registered images: {len(names)}\n" in said and f"Points: {reduced.num_points3D()}\n" in said
    (tmp_path / "text").mkdir()
    colmap("model_converter", "--input_path", model, "--output_path", tmp_path / "text", "--output_type", "TXT")
    again = pycolmap.Reconstruction(tmp_path / "text")
    assert again.num_reg_images() == len(names) and again.num_points3D() == reduced.num_points3D()
    shutil.rmtree(tmp_path / "text")


@pytest.mark.parametrize("refs", ["keys", "keys+partners", "all"])
def test_colmap_workspaces_load(export, planned, tmp_path, refs):
    project, clusters = planned
    folder = export("colmap", "--refs", refs)
    whole = pycolmap.Reconstruction(project / "sparse/0")
    names = {image.name for image in whole.images.values()} if refs == "all" else names_of(clusters)
    assert_loads(folder / "sparse", names, whole, tmp_path)
    assert all((folder / "images" / name).is_file() for name in names)


@pytest.mark.parametrize("refs", ["keys", "keys+partners"])
def test_splat_models_load(export, planned, tmp_path, refs):
    project, clusters = planned
    folder = export("splat", "--refs", refs)
    names = {key for key, _ in clusters} if refs == "keys" else names_of(clusters)
    assert_loads(folder / "sparse/0", names, pycolmap.Reconstruction(project / "sparse/0"), tmp_path)
    colmap("image_undistorter", "--image_path", folder / "images", "--input_path", folder / "sparse/0", "--output_path", tmp_path)
    assert {p.name for p in (tmp_path / "images").iterdir()} == names


def write_plane_maps(folder, names, plane, reduced=()):
    """Writes photometric maps of a horizontal plane in patch match's format (mat.cc: width&height&channels&, plane by plane); half as large for `reduced` names."""
    model = pycolmap.Reconstruction(folder / "sparse")
    for image in model.images.values():
        if image.name not in names:
            continue
        camera, pose = model.cameras[image.camera_id], image.cam_from_world()
        size = 0.5 if image.name in reduced else 1.0
        width, height = int(camera.width * size), int(camera.height * size)
        fx, fy, cx, cy = (size * value for value in camera.params)
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        rotation = pose.rotation.matrix()
        rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x, float)], -1) @ rotation
        centre = -rotation.T @ pose.translation
        depth = (plane - centre[2]) / rays[..., 2]
        depth[(depth < 0) | (depth > 200)] = 0
        normal = np.broadcast_to((rotation @ [0, 0, 1.0])[:, None, None], (3, *depth.shape))
        head = f"{width}&{height}&".encode()
        for kind, planes in (("depth_maps", depth[None]), ("normal_maps", normal)):
            data = head + f"{len(planes)}&".encode() + np.ascontiguousarray(planes, "<f4").tobytes()
            (folder / "stereo" / kind / f"{image.name}.photometric.bin").write_bytes(data)


def test_colmap_vis_index_not_id(export, planned):
    """COLMAP fuses the key views with the written options, and its .vis counts by position in images.bin."""
    clusters = planned[1]
    folder = export("colmap")
    plane = float(np.median([p.xyz[2] for p in pycolmap.Reconstruction(folder / "sparse").points3D.values()]))
    keys = [key for key, _ in clusters]
    write_plane_maps(folder, keys, plane)
    command = json.loads((folder / "stereo/viewrank/export.json").read_text())["commands"][-1].split()
    assert command[:2] == ["colmap", "stereo_fusion"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr

    head, _, body = (folder / "stereo/viewrank/fused.ply").read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    assert count > 1000, "enough key views agree with the options of the runner"
    points = np.frombuffer(body, np.dtype([("x", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)]), count)["x"].astype(float)
    assert np.abs(points[:, 2] - plane).max() < 0.01 * np.ptp(points[:, 0])
    order = image_order(folder / "sparse/images.bin")
    model = pycolmap.Reconstruction(folder / "sparse")
    by_name = {image.name: image for image in model.images.values()}
    vis = (folder / "stereo/viewrank/fused.ply.vis").read_bytes()
    at, seen, by_id = 8, set(), set()

    def shows(image, point):
        camera = model.cameras[image.camera_id]
        x, y = camera.img_from_cam(image.cam_from_world() * point)
        return -10 < x < camera.width + 10 and -10 < y < camera.height + 10

    assert struct.unpack_from("<Q", vis)[0] == count
    for point in points:
        (views,) = struct.unpack_from("<I", vis, at)
        positions = struct.unpack_from(f"<{views}I", vis, at + 4)
        at += 4 + 4 * views
        for position in positions:
            assert shows(by_name[order[position]], point)
            by_id.add(model.images[position].name if position in model.images else None)
            seen.add(order[position])
    assert at == len(vis) and seen <= set(keys) and len(seen) > len(keys) / 2
    assert not by_id <= set(keys), "taken for ids the numbers name images that were not fused"


def test_colmap_fuses_maps_of_two_sizes(export, planned):
    """A plan with key views at half size needs only their maps in the same workspace."""
    folder = export("colmap")
    plane = float(np.median([p.xyz[2] for p in pycolmap.Reconstruction(folder / "sparse").points3D.values()]))
    keys = [key for key, _ in planned[1]]
    command = json.loads((folder / "stereo/viewrank/export.json").read_text())["commands"][-1].split()
    counts = []
    for reduced in (keys[::2], keys):
        write_plane_maps(folder, keys, plane, reduced)
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        head, _, body = (folder / "stereo/viewrank/fused.ply").read_bytes().partition(b"end_header\n")
        counts.append(int(head.split(b"element vertex ")[1].split()[0]))
        points = np.frombuffer(body, np.dtype([("x", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)]), counts[-1])["x"].astype(float)
        assert np.abs(points[:, 2] - plane).max() < 0.01 * np.ptp(points[:, 0])
    assert counts[0] > 1.5 * counts[1] > 1000, "the maps of full size give more points"


def image_order(path):
    """Names in the order of images.bin."""
    data, at, names = path.read_bytes(), 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        end = data.index(b"\0", at + 64)
        names.append(data[at + 64 : end].decode())
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return names


# What is written where


@pytest.fixture
def own(planned, tmp_path):
    """A copy of the planned project, in a folder with a blank."""
    shutil.copytree(planned[0], tmp_path / "my project", symlinks=True)
    return tmp_path / "my project"


def files_of(folder):
    return {path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir()}


def test_each_folder_has_an_export_of_its_own(viewrank, own):
    viewrank("export", own, "--backend", "openmvs", "--out", own / "one")
    before = files_of(own / "one")
    viewrank("export", own, "--backend", "openmvs", "--out", own / "two", "--budget", "3")
    assert before == files_of(own / "one") and not (own / "two/clusters/0004.mvs").exists()
    said = viewrank("export", own, "--backend", "openmvs", "--out", own / "one", "--budget", "3").stdout
    assert files_of(own / "one") == files_of(own / "two")
    assert f"removed      {len(before - files_of(own / 'one'))} files of an earlier export: one/clusters/0004.mvs" in said
    there = files_of(own / "one")
    refused = viewrank("export", own, "--backend", "mvsnet", "--out", own / "one", expect=1).stderr
    assert "contains the export for openmvs" in refused and "--out" in refused and files_of(own / "one") == there


def test_an_export_of_a_plan_and_one_by_hand_are_the_same_set(viewrank, own):
    viewrank("plan", own, "--backend", "splat", "--budget", "8", "--quiet")
    viewrank("export", own, "--backend", "splat", "--budget", "2")
    assert len(list((own / "viewrank/splat/images").iterdir())) == 2, "programs take all images of the folder"


def test_nothing_is_written_where_one_backend_cannot(viewrank, own, tmp_path):
    (own / "file").write_text("mine")
    said = viewrank("export", own, "--backend", "colmap,openmvs", "--out", own / "file", expect=1).stderr
    assert "a file is in the way" in said and "move it away" in said and (own / "file").read_text() == "mine"
    viewrank("export", own, "--backend", "openmvs", "--tiles", "2", "--out", tmp_path / "out/colmap")
    viewrank("export", own, "--backend", "openmvs,colmap", "--tiles", "2", "--out", tmp_path / "out", expect=1)
    assert not (tmp_path / "out/openmvs").exists()


def test_a_new_plan_names_the_exports_of_the_old_one(viewrank, own):
    viewrank("export", own, "--backend", "openmvs", "--out", own / "scenes")
    assert "earlier plan" not in viewrank("plan", own, "-k", "4", "--budget", "8", "--confidence", "geometric", "--quiet").stderr
    said = viewrank("plan", own, "-k", "2", "--quiet").stderr
    line = next(line for line in said.splitlines() if "scenes contains an export of an earlier plan for openmvs" in line)
    assert line.endswith(f"viewrank export '{own}' --backend openmvs --out '{own}/scenes'"), line
    assert (own / "scenes/run.json").exists(), "somebody may be computing there"


def test_backends_are_understood_and_their_options_too(viewrank, own):
    made = json.loads(viewrank("export", own, "--backend", "Meshroom, COLMAP,colmap", "--refs", "keys", "--dry-run", "--format", "json").stdout)
    assert [(report["backend"], report["unheeded"]) for report in made] == [("alicevision", ["--refs"]), ("colmap", [])]
    for command in ("plan", "export", "doctor"):
        said = viewrank(command, own, "--backend", "colmpa", expect=2).stderr
        assert "did you mean colmap?" in said and "metashape" in said and "docs/programs.md" in said, command
    (own / "viewrank.toml").write_text('backends = ["nothing"]\n')
    assert "viewrank.toml:1: no backend" in viewrank("plan", own, expect=2).stderr


def test_images_that_are_not_there_or_of_another_size(viewrank, own):
    names = sorted(path.name for path in (own / "images").iterdir())
    (own / "images" / names[0]).unlink()
    shutil.copy(own / "images" / names[1], own / "kept.jpg")
    small = np.zeros((45, 60, 3), np.uint8)
    cv2.imwrite(str(own / "images" / names[1]), small)
    said = viewrank("plan", own, "-k", "4", "--target", "100%", "--quiet").stderr
    assert f"images missing from {own}/images: 1 of 28, e.g. {names[0]}: viewrank doctor '{own}'" in said
    assert f"images of another size than their cameras: 1 of 28, e.g. {names[1]} with 60 x 45 instead of 600 x 450" in said
    cv2.imwrite(str(own / "images" / names[1]), small[:40])
    said = viewrank("plan", own, "-k", "4", "--target", "100%", "--quiet").stderr
    assert f"images of another aspect ratio than their cameras: 1 of 28, e.g. {names[1]} with 60 x 40 instead of 600 x 450" in said
    views = json.loads((own / "viewrank/manifest.json").read_text())["views"]
    assert [view["name"] for view in views if view.get("reason") == "no_image"] == names[:2]
    shutil.rmtree(own / "images")
    (own / "images").mkdir()
    viewrank("plan", own, "-k", "4", "--quiet")
    said = viewrank("export", own, "--backend", "openmvs", expect=1).stderr
    assert "none of them is in" in said and not (own / "viewrank/openmvs").exists()
