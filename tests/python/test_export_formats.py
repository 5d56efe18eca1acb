"""Exports, read back by XML and JSON parsers and by small readers written from the grammars of the programs that cannot be run here."""
import json
import shutil
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pycolmap
import pytest

from conftest import ROOT, names_of

pytestmark = pytest.mark.usefixtures("without_pilot")

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
        assert [image[0] for image in scene.images] == [f"../../images/{name}" for name in (key, *partners)], "a map is made in unfinished/0001"
        for name, _, (platform, camera, pose, identifier), *_ in scene.images:
            image = by_name[name.removeprefix("../../images/")]
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
    whole = pycolmap.Reconstruction(project / "sparse/0")
    if dialect == "acmm":
        assert len(named) == len(names)
    else:
        assert len(named) == len(clusters) and set(names.values()) == {image.name for image in whole.images.values()}
        members = {name for key, partners in clusters for name in (key, *partners)}
        names = {index: name for index, name in names.items() if name in members}
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
# Stands in for MicMac: notes its call and the secondary images that it would find, and leaves a folder.
echo "$@ $(grep -c '<Images>' Ori-viewrank/ImSec-*.xml | wc -l)" >>calls.txt
mkdir -p "MM-Malt-Img-${3%.*}"
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
        for mark in folder.glob("MM-Malt-Img-*/viewrank.recipe"):
            mark.unlink()
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


def test_rules_that_micmac_would_obey_are_refused(export, tmp_path):
    folder = export("micmac")
    ours = tmp_path / "Ori-Project"
    ours.mkdir()
    (ours / "Orientation-a.xml").write_text("<x/>")
    (folder / "MicMac-LocalChantierDescripteur.xml").write_text("<Global/>")
    done = run_micmac(folder, ours)
    assert done.returncode == 1 and "MicMac-LocalChantierDescripteur.xml" in done.stderr and not (folder / "Ori-viewrank").exists()


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


SIDE_FILE = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:InMeshing="{0}" xcr:InTexturing="{0}"/>
  </rdf:RDF>
</x:xmpmeta>
"""


def test_realityscan_side_files_spare_poses(tmp_path):
    script = ROOT / "integrations/realityscan/switch.py"
    ours, images = tmp_path / "xmp/a b", tmp_path / "images"
    ours.mkdir(parents=True), images.mkdir()
    shutil.copy(script, tmp_path)
    (tmp_path / "xmp.txt").write_text("a b/1.xmp\na b/2.xmp\n")

    def switched(state):
        for name in ("1", "2"):
            (ours / f"{name}.xmp").write_text(SIDE_FILE.format(state))
        return subprocess.run([sys.executable, tmp_path / "switch.py", images], capture_output=True, text=True)

    assert switched(1).returncode == 0
    pose = '<d xcr:PosePrior="exact" xcr:InMeshing="1"/>'
    (images / "a b/2.xmp").write_text(pose)
    again = switched(0)
    assert again.returncode == 1 and "a b/2.xmp: holds more" in again.stderr and "1.xmp" not in again.stderr
    assert (images / "a b/1.xmp").read_text() == SIDE_FILE.format(0)
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
