"""Exports, read back by COLMAP 3.8 and pycolmap, XML and JSON parsers, and small readers written from the grammars
of the programs that cannot be run here."""
import json
import shutil
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pycolmap
import pytest

from conftest import ROOT


@pytest.fixture(scope="session")
def planned(viewrank, fixtures, tmp_path_factory):
    """The fixture's project with a plan, and the plan's clusters by name."""
    project = tmp_path_factory.mktemp("exports") / "project"
    shutil.copytree(fixtures / "valley", project)
    viewrank("plan", project, "-k", "4", "--budget", "8", "--quiet")
    manifest = json.loads((project / "viewrank/manifest.json").read_text())
    clusters = [(cluster["key"], cluster["partners"]) for cluster in manifest["clusters"][:8]]
    assert len(clusters) == 8
    return project, clusters


@pytest.fixture
def export(viewrank, planned, tmp_path):
    def run(backend, *options):
        viewrank("export", planned[0], "--backend", backend, "--out", tmp_path / backend, *options)
        return tmp_path / backend

    return run


def names_of(clusters):
    return {name for key, partners in clusters for name in (key, *partners)}


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


def test_finished_maps_of_other_partners_are_reported_and_replaced(viewrank, planned, tmp_path):
    project, folder = tmp_path / "project", tmp_path / "workspace"
    shutil.copytree(planned[0], project)

    def export():
        said = viewrank("export", project, "--backend", "colmap", "--out", folder, "--budget", "8").stdout
        return [line for line in said.splitlines() if not line.startswith("  removed ")]

    def reported():
        return [line for line in export() if "other partners" in line]

    assert not reported()
    lists = (folder / "stereo/patch-match.cfg").read_text().splitlines()
    names = [line for line in lists if line.strip() and not line.startswith("#")][::2]
    maps = [folder / f"stereo/depth_maps/{name}.photometric.bin" for name in names]
    for path in maps:
        path.write_bytes(b"")
    assert not reported(), "made by the lists in force"
    viewrank("plan", project, "-k", "3", "--budget", "8", "--quiet")
    said = reported()
    rows = [line.split("\t") for line in (folder / "stereo/viewrank/maps.tsv").read_text().splitlines()]
    stale = [name for wanted, made, name in rows if "-" not in (wanted, made) and wanted != made]
    assert stale and f"{len(stale)} finished depth maps were made with other partners" in said[0] and "--replace" in said[0]
    assert reported() == said, "until they are gone"
    environment = {"PATH": "/usr/bin:/bin", "COLMAP": "true"}
    subprocess.run(["sh", folder / "stereo/viewrank/run.sh", "--replace"], env=environment, check=True)
    assert not any((folder / "stereo/depth_maps" / name).exists() for name in stale)
    kept = {path.name for path in maps} - {name for wanted, _, name in rows if wanted != "-"}
    assert {path.name for path in maps if path.exists()} == kept, "those of views that are no key views any more"
    assert not reported()


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
    assert "earlier plan" not in viewrank("plan", own, "-k", "4", "--budget", "8", "--quiet").stderr
    said = viewrank("plan", own, "-k", "2", "--quiet").stderr
    line = next(line for line in said.splitlines() if "scenes contains an export of an earlier plan for openmvs" in line)
    assert line.endswith(f"viewrank export '{own}' --backend openmvs --out '{own}/scenes'"), line
    assert (own / "scenes/run.json").exists(), "somebody may be computing there"


def test_backends_are_understood_and_their_options_too(viewrank, own):
    made = json.loads(viewrank("export", own, "--backend", "Meshroom, COLMAP,colmap", "--refs", "keys", "--dry-run", "--format", "json").stdout)
    assert [(report["backend"], report["unheeded"]) for report in made] == [("alicevision", ["--refs"]), ("colmap", [])]
    for command in ("plan", "export", "doctor"):
        said = viewrank(command, own, "--backend", "colmpa", expect=2).stderr
        assert "did you mean colmap?" in said and "realityscan" in said, command
    (own / "viewrank.toml").write_text('backends = ["nothing"]\n')
    assert "viewrank.toml:1: no backend" in viewrank("plan", own, expect=2).stderr


def test_images_that_are_not_there_or_of_another_size(viewrank, own):
    names = sorted(path.name for path in (own / "images").iterdir())
    (own / "images" / names[0]).unlink()
    shutil.copy(own / "images" / names[1], own / "kept.jpg")
    small = np.zeros((5, 7, 3), np.uint8)
    cv2.imwrite(str(own / "images" / names[1]), small)
    said = viewrank("plan", own, "-k", "4", "--target", "100%", "--quiet").stderr
    assert f"1 of 28 images are missing from {own}/images, e.g. {names[0]}: viewrank doctor '{own}'" in said
    assert f"1 of 28 images don't have the size of their cameras, e.g. {names[1]} with 7 x 5 instead of 600 x 450" in said
    shutil.rmtree(own / "images")
    (own / "images").mkdir()
    viewrank("plan", own, "-k", "4", "--quiet")
    said = viewrank("export", own, "--backend", "openmvs", expect=1).stderr
    assert "none of them is in" in said and not (own / "viewrank/openmvs").exists()


# OpenMVS: an independent reader of the interface format.


class Mvs:
    def __init__(self, path):
        self.data, self.at = path.read_bytes(), 4
        assert self.data[:4] == b"MVSI"
        self.version, zero = self.take("2I")
        assert zero == 0
        self.platforms = self.array(lambda: (self.string(), self.array(self.camera), self.array(lambda: self.take("12d"))))
        self.images = self.array(self.image)
        self.vertices = self.array(lambda: (self.take("3f"), self.array(lambda: self.take("If"))))
        for entry in ("3f", "3B"):
            self.array(lambda: self.take(entry))
        self.array(lambda: (self.take("6f"), self.array(lambda: self.take("If"))))
        for entry in ("3f", "3B"):
            self.array(lambda: self.take(entry))
        self.transform = self.take("16d")
        self.region = self.take("15d") if self.version > 5 else None
        assert self.at == len(self.data), "to the last byte"

    def take(self, form):
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def array(self, read):
        return [read() for _ in range(self.take("Q")[0])]

    def string(self):
        (length,) = self.take("Q")
        self.at += length
        return self.data[self.at - length : self.at].decode()

    def camera(self):
        return (self.string(), self.string(), self.take("2I"), self.take("21d"))

    def image(self):
        names, indices = (self.string(), self.string()), self.take("4I")
        scores = (self.take("3f"), self.array(lambda: self.take("2I4f"))) if self.version > 6 else ((), [])
        return (*names, indices, *scores)


def test_openmvs_scenes_are_read_by_an_independent_reader(export, planned):
    project, clusters = planned
    folder = export("openmvs")
    whole = pycolmap.Reconstruction(project / "sparse/0")
    by_name = {image.name: image for image in whole.images.values()}
    for rank, (key, partners) in enumerate(clusters, 1):
        scene = Mvs(folder / f"clusters/{rank:04}.mvs")
        assert [image[0] for image in scene.images] == [f"images/{name}" for name in (key, *partners)]
        for name, _, (platform, camera, pose, identifier), *_ in scene.images:
            image = by_name[name.removeprefix("images/")]
            _, _, size, numbers = scene.platforms[platform][1][camera]
            k, own = np.reshape(numbers[:9], (3, 3)), whole.cameras[image.camera_id]
            assert size == (own.width, own.height) and identifier == image.image_id
            assert np.allclose([k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5], own.params)
            placed = np.array(scene.platforms[platform][2][pose])
            expected = image.cam_from_world()
            assert np.allclose(placed[:9].reshape(3, 3), expected.rotation.matrix())
            assert np.allclose(placed[9:], image.projection_center())
        assert all(len(views) == 2 and views[0][0] == 0 and 0 < views[1][0] <= len(partners) for _, views in scene.vertices)
        assert (folder / f"images/{key}").is_file()
    assert [image[0] for image in Mvs(folder / "fuse.mvs").images] == [f"images/{key}" for key, _ in clusters]
    Mvs(export("odm") / "openmvs/scene.mvs")


# MVSNet's family


def read_cam(path):
    """Returns the extrinsic, the intrinsic and the depths like the readers of CasMVSNet and PatchmatchNet."""
    lines = [line.rstrip() for line in path.read_text().splitlines()]
    matrix = lambda a, b: np.array([[float(x) for x in line.split()] for line in lines[a:b]])
    assert lines[0] == "extrinsic" and lines[6] == "intrinsic"
    return matrix(1, 5).reshape(4, 4), matrix(7, 10).reshape(3, 3), [float(x) for x in lines[11].split()]


def read_pairs(path):
    """Line by line, the count ignored: every second word from the second on (data_io.py, general_eval.py)."""
    lines = path.read_text().splitlines()
    rows = range(1, 1 + 2 * int(lines[0]), 2)
    return [(int(lines[i].rstrip()), [int(x) for x in lines[i + 1].rstrip().split()[1::2]]) for i in rows]


@pytest.mark.parametrize("dialect", ["mvsnet", "patchmatchnet", "acmm"])
def test_mvsnet_family_is_read(export, planned, dialect):
    project, clusters = planned
    folder = export(dialect)
    names = dict(line.split("\t") for line in (folder / "view_names.txt").read_text().splitlines())
    named = [(names[str(key)], [names[str(p)] for p in partners]) for key, partners in read_pairs(folder / "pair.txt")]
    assert named[: len(clusters)] == clusters
    assert len(named) == (len(names) if dialect == "acmm" else len(clusters))
    whole = pycolmap.Reconstruction(project / "sparse/0")
    images = {image.name: image for image in whole.images.values()}
    for index, name in names.items():
        extrinsic, intrinsic, depths = read_cam(folder / f"cams/{int(index):08}_cam.txt")
        image = images[name]
        assert np.allclose(extrinsic[:3], image.cam_from_world().matrix(), atol=1e-12)
        assert np.allclose(intrinsic, whole.cameras[image.camera_id].calibration_matrix())
        least, greatest = (depths[0], depths[1]) if dialect == "patchmatchnet" else (depths[0], depths[3])
        own = [whole.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        z = np.array([(image.cam_from_world() * x)[2] for x in own])
        assert np.mean((z >= least * 0.99) & (z <= greatest * 1.01)) > 0.9
        assert (folder / f"images/{int(index):08}.jpg").read_bytes() == (project / "images" / name).read_bytes()


# Lists of splats and NeRFs


def test_nerfstudio_reads_its_splits(export, planned):
    """transforms.json as nerfstudio_dataparser.py, the lists as colmap_dataparser.py takes them."""
    folder = export("splat")
    meta = json.loads((folder / "transforms.json").read_text())
    frames = [frame["file_path"] for frame in meta["frames"]]
    for split in ("train", "val", "test"):
        listed = meta[f"{split}_filenames"]
        assert set(listed) <= set(frames) and listed
        names = (folder / f"{split}_list.txt").read_text().splitlines()
        assert [f"images/{name}" for name in names] == listed
    model = pycolmap.Reconstruction(folder / "sparse/0")
    images = {f"images/{image.name}": image for image in model.images.values()}
    assert set(images) == set(frames) and all((folder / frame).is_file() for frame in frames)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    for frame in meta["frames"]:
        world = np.eye(4)
        world[:3] = images[frame["file_path"]].cam_from_world().inverse().matrix()
        assert np.allclose(frame["transform_matrix"], world @ flip)
    assert (folder / meta["ply_file_path"]).read_bytes().startswith(b"ply\n")


def test_gsplat_and_brush_train_on_every_key_view(export, planned):
    folder = export("splat")
    names = sorted(image.name for image in pycolmap.Reconstruction(folder / "sparse/0").images.values())
    command = next(c for c in json.loads((folder / "export.json").read_text())["commands"] if "gsplat" in c)
    every = int(command.split("--test_every ")[1].split()[0])
    held_out = [name for i, name in enumerate(names) if i % every == 0]
    assert held_out == names[:1] and every > len(names), "examples/datasets/colmap.py: index 0 is always held out"
    assert names == sorted(key for key, _ in planned[1])
    assert [p.parent.name for p in folder.rglob("cameras.bin")] == ["0"], "brush takes the largest model that it finds"


# XML by a real parser


def test_micmac_files_are_xml(export, planned):
    clusters = planned[1]
    folder = export("micmac")
    pairs = [element.text for element in ElementTree.parse(folder / "pairs.xml").getroot().findall("Cple")]
    assert pairs == [f"{key} {partner}" for key, partners in clusters for partner in partners]
    for key, partners in clusters:
        root = ElementTree.parse(folder / f"ImSec/ImSec-{key}.xml").getroot()
        assert (root.tag, root.findtext("Master")) == ("ImSecOfMaster", key)
        (solution,) = root.findall("Sols")
        assert [element.text for element in solution.findall("Images")] == partners and float(solution.findtext("Score")) > -1
    masters = [element.text for element in ElementTree.parse(folder / "ImSec/FileImSel.xml").getroot().findall("Name")]
    assert masters == [key for key, _ in clusters]


MM3D = """#!/bin/sh
# Stands in for MicMac: notes its call and the secondary images that it would find.
echo "$@ $(grep -c '<Images>' Ori-viewrank/ImSec-*.xml | wc -l)" >>calls.txt
"""


def run_micmac(folder, orientation):
    return subprocess.run([folder / "run.sh", orientation], env={"PATH": "/usr/bin:/bin", "MM3D": str(folder.parent / "mm3d")}, capture_output=True, text=True)


def test_micmac_never_deletes_what_it_is_given(export, planned, tmp_path):
    folder = export("micmac")
    (tmp_path / "mm3d").write_text(MM3D)
    (tmp_path / "mm3d").chmod(0o755)
    ours = tmp_path / "My Ori-Project"
    ours.mkdir()
    (ours / "Orientation-a.xml").write_text("<x/>")
    for _ in range(2):
        shutil.rmtree(folder / "done", ignore_errors=True)
        (folder / "calls.txt").unlink(missing_ok=True)
        done = run_micmac(folder, ours)
        assert done.returncode == 0, done.stderr
        calls = (folder / "calls.txt").read_text().splitlines()
        assert len(calls) == len(planned[1]) and all(call.startswith("Malt GeomImage") and call.endswith(str(len(planned[1]))) for call in calls)
    assert [path.name for path in ours.iterdir()] == ["Orientation-a.xml"], "the user's folder is as it was"
    (tmp_path / "link").symlink_to(folder / "Ori-viewrank")
    for wrong in (folder / "Ori-viewrank", tmp_path / "link", folder, "."):
        done = subprocess.run([folder / "run.sh", wrong], cwd=folder, capture_output=True, text=True)
        assert done.returncode != 0 and "error" in done.stderr and (folder / "Ori-viewrank/Orientation-a.xml").exists(), wrong
    (folder / "Ori-viewrank/made-by-viewrank").unlink()
    assert "move it away" in run_micmac(folder, ours).stderr and (folder / "Ori-viewrank/Orientation-a.xml").exists()


def test_sure_projects_without_a_cloud_are_planned_on_the_ground(viewrank, export, tmp_path):
    """Planned from the oriented images alone, with the height of the ground."""
    folder = export("sure")
    project = tmp_path / "without cloud"
    shutil.copytree(folder / "ori", project / "ori")
    shutil.copytree(folder / "images", project / "images")
    said = viewrank("inspect", project).stdout
    assert "ground.py" in said
    ground = ROOT / "integrations/sure/ground.py"
    done = subprocess.run([sys.executable, ground, project, "0"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    viewrank("plan", project, "--backend", "sure", "--quiet")
    assert (project / "viewrank/sure/baseImages.txt").read_text().splitlines()
    assert "is there" in subprocess.run([sys.executable, ground, project, "0"], capture_output=True, text=True).stderr


def test_realityscan_side_files_are_xml(export, planned):
    project, clusters = planned
    folder = export("realityscan")
    switch = "{http://www.capturingreality.com/ns/xcr/1.1#}"
    used = names_of(clusters)
    for image in pycolmap.Reconstruction(project / "sparse/0").images.values():
        root = ElementTree.parse(folder / "xmp" / f"{image.name.removesuffix('.jpg')}.xmp").getroot()
        (description,) = root.iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description")
        value = str(int(image.name in used))
        assert description.attrib == {f"{switch}InMeshing": value, f"{switch}InTexturing": value}


def test_realityscan_side_files_spare_poses(tmp_path):
    script = ROOT / "integrations/realityscan/switch.py"
    ours, images = tmp_path / "xmp/a b", tmp_path / "images"
    ours.mkdir(parents=True), images.mkdir()
    shutil.copy(script, tmp_path)
    text = '<d xcr:InMeshing="{0}" xcr:InTexturing="{0}"/>\n'

    def switched(state):
        for name in ("1", "2"):
            (ours / f"{name}.xmp").write_text(text.format(state))
        return subprocess.run([sys.executable, tmp_path / "switch.py", images], capture_output=True, text=True)

    assert switched(1).returncode == 0
    pose = '<d xcr:PosePrior="exact" xcr:InMeshing="1"/>'
    (images / "a b/2.xmp").write_text(pose)
    again = switched(0)
    assert again.returncode == 1 and "a b/2.xmp: holds more" in again.stderr and "1.xmp" not in again.stderr
    assert (images / "a b/1.xmp").read_text() == text.format(0)
    assert (images / "a b/2.xmp").read_text() == pose


# AliceVision, PMVS, MVE, Gipuma


def test_alicevision_files_are_consistent(export, planned):
    project, clusters = planned
    folder = export("alicevision")
    whole = pycolmap.Reconstruction(project / "sparse/0")
    ids = {image.name: image.image_id for image in whole.images.values()}
    for rank, (key, partners) in enumerate(clusters, 1):
        sfm = json.loads((folder / f"clusters/{rank:04}.sfm").read_text())
        views = {int(view["viewId"]): view for view in sfm["views"]}
        assert set(views) == {ids[name] for name in (key, *partners)}
        for view in views.values():
            assert (folder / view["path"]).is_file()
        for pose in sfm["poses"]:
            image = whole.images[int(pose["poseId"])]
            transform = pose["pose"]["transform"]
            rotation = np.array([float(x) for x in transform["rotation"]]).reshape(3, 3, order="F")
            assert np.allclose(rotation, image.cam_from_world().rotation.matrix())
            assert np.allclose([float(x) for x in transform["center"]], image.projection_center())
        observers = [{int(o["observationId"]) for o in landmark["observations"]} for landmark in sfm["structure"]]
        assert all(ids[key] in seen and seen <= set(views) for seen in observers)
        for partner in partners:
            assert sum(ids[partner] in seen for seen in observers) > 20


def test_projection_matrices_of_pmvs_and_gipuma(export, planned):
    project, _ = planned
    whole = pycolmap.Reconstruction(project / "sparse/0")
    images = {image.name: image for image in whole.images.values()}
    pmvs, gipuma = export("pmvs"), export("gipuma")
    record = json.loads((pmvs / "export.json").read_text())["clusters"]
    keyed = {view["target"]: view["name"] for cluster in record for view in (cluster["key"], *cluster["partners"])}
    matrices = {name: (pmvs / f"txt/{int(i):08}.txt").read_text() for i, name in keyed.items()}
    table = dict(line.split("\t") for line in (gipuma / "view_names.txt").read_text().splitlines())
    both = [(name, text.removeprefix("CONTOUR")) for name, text in matrices.items()]
    both += [(name, (gipuma / f"p/{file}.P").read_text()) for file, name in table.items()]
    assert len(both) == 2 * len(keyed)
    for name, text in both:
        p = np.array(text.split(), float).reshape(3, 4)
        image = images[name]
        expected = whole.cameras[image.camera_id].calibration_matrix() @ image.cam_from_world().matrix()
        assert np.allclose(p / p[2, 3], expected / expected[2, 3])


def test_mve_views_and_bundles(export, planned):
    project, clusters = planned
    folder = export("mve")
    whole = pycolmap.Reconstruction(project / "sparse/0")
    images = {image.name: image for image in whole.images.values()}
    by_id = {}
    for ini in sorted(folder.glob("views/*/meta.ini")):
        values = dict(line.split(" = ") for line in ini.read_text().splitlines() if " = " in line)
        by_id[int(values["id"])] = values["name"]
        image = images[values["name"]]
        camera = whole.cameras[image.camera_id]
        assert np.isclose(float(values["focal_length"]) * max(camera.width, camera.height), camera.focal_length_x)
        assert np.allclose(np.array(values["rotation"].split(), float).reshape(3, 3), image.cam_from_world().rotation.matrix())
        assert np.allclose(np.array(values["translation"].split(), float), image.cam_from_world().translation)
        assert (ini.parent / "undistorted.jpg").is_file()
    for rank, (key, partners) in enumerate(clusters, 1):
        lines = (folder / f"bundles/{rank:04}.out").read_text().splitlines()
        cameras, points = map(int, lines[1].split())
        assert lines[0] == "drews 1.0" and cameras == len(by_id)
        there = {by_id[i] for i in range(cameras) if float(lines[2 + 5 * i].split()[0]) != 0}
        assert there == {key, *partners}
        rows = lines[2 + 5 * cameras :]
        assert len(rows) == 3 * points
        seen = [{by_id[int(i)] for i in row.split()[1::3]} for row in rows[2::3]]
        assert all(key in views and views <= there for views in seen)
