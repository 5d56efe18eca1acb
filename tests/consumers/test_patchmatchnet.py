"""PatchmatchNet (PATCHMATCHNET: its folder with the checkpoint; `python` of PATCHMATCHNET_PYTHON or the PATH): commands as printed, against its own
list of pairs from `colmap_input.py`, with all of its defaults."""
import filecmp
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import call, clusters_of
from measure import assert_as_good, measure, read_pfm, read_ply


@pytest.fixture
def net(program):
    """The folder of PatchmatchNet, and the PATH on which its python is."""
    if "PATCHMATCHNET" not in os.environ:
        pytest.skip("no PatchmatchNet: PATCHMATCHNET is the folder of its eval.py")
    python = program("PATCHMATCHNET_PYTHON", "python")
    # Not resolved: the python of an environment finds its modules by where it lies.
    folder = os.environ.get("PATCHMATCHNET_PYTHON", str(python.parent))
    return Path(os.environ["PATCHMATCHNET"]).resolve(), f"{folder}:/usr/bin:/bin"


def masks(depths, numbers):
    """Mean share of the pixels that the fusion keeps, by its own masks; nothing of a map that it has no partner for."""
    pictures = [cv2.imread(str(depths / f"mask/{number:08}_final.png"), cv2.IMREAD_GRAYSCALE) for number in numbers]
    return np.mean([0.0 if picture is None else (picture > 0).mean() for picture in pictures])


def write_default(views, source, net, path, folder, keys):
    """Its own converter's files, with the rows of these key views alone; returns their numbers."""
    scene = folder / "scene"
    (scene / "sparse").mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (scene / f"sparse/{name}.bin").symlink_to(source / f"sparse/0/{name}.bin")
    (scene / "images").symlink_to(source / "images")
    out = folder / "default"
    out.mkdir()
    call(["python", "colmap_input.py", "--input_folder", str(scene), "--output_folder", str(out)], net, PATH=path)
    copies = sorted((out / "images").iterdir())
    number = {key: int(next(c for c in copies if filecmp.cmp(c, source / "images" / key, shallow=False)).stem) for key in keys}
    lines = (out / "pair.txt").read_text().splitlines()[1:]
    rows = dict(zip(map(int, lines[::2]), lines[1::2]))
    chosen = sorted(number.values())
    (out / "pair.txt").write_text(f"{len(keys)}\n" + "".join(f"{n}\n{rows[n]}\n" for n in chosen))
    return out, number, rows


def test_maps_and_cloud_are_as_good_as_its_own_choice(planned, net, views, source, tmp_path):
    net, path = net
    _, export = planned("patchmatchnet")
    clusters, record = clusters_of(export)
    keys = [key for key, _ in clusters]
    for command in record["commands"]:
        call(command, export, PATCHMATCHNET=net, PATH=path)
    ids = {key: views.images[key].image_id for key in keys}
    ours = {key: read_pfm(export / f"depths/depth_est/{ids[key]:08}.pfm") for key in keys}

    out, number, rows = write_default(views, source, net, path, tmp_path, keys)
    checkpoint = "checkpoints/params_000007.ckpt"
    size = ["--image_max_dim", str(max(next(iter(ours.values())).shape))]
    base = ["python", "eval.py", "--input_folder", str(out), "--output_folder", str(out / "depths"), "--checkpoint_path", checkpoint, *size]
    call([*base, "--output_type", "depth"], net, PATH=path)
    default = {key: read_pfm(out / f"depths/depth_est/{number[key]:08}.pfm") for key in keys}
    assert_as_good(measure(views, ours), measure(views, default))

    # The fusion: of the same maps with the program's own numbers, partners that have no map left out.
    there = set(number.values())
    fused = []
    for n in sorted(there):
        words = rows[n].split()[1:]
        pairs = [(a, b) for a, b in zip(words[::2], words[1::2]) if int(a) in there and float(b) > 0]
        fused.append(f"{n}\n{len(pairs)} " + " ".join(f"{a} {b}" for a, b in pairs) + "\n")
    (out / "pair.txt").write_text(f"{len(fused)}\n" + "".join(fused))
    call([*base, "--output_type", "fusion"], net, PATH=path)
    kept, own = masks(export / "depths", ids.values()), masks(out / "depths", number.values())
    print(f"kept by the fusion: {100 * kept:.1f} % of the pixels as printed, {100 * own:.1f} % with its own numbers")
    assert kept >= own - 0.03
    assert len(read_ply(export / "depths/fused.ply")) > 0
