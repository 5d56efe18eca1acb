"""Images, maps, pairs and records that somebody else has planted in a workspace: no size in a head is believed, and none ends a run with a traceback."""

import os
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

import sgm
from pairs import Pairs
from test_sgm import FOCAL, HEIGHT, SIDES, WIDTH, damaged, planes, run, write_clusters  # noqa: F401 (a fixture)
from workspace import InputError, Workspace, bytes_of, size_of


def png(width, height, before=b""):
    """A PNG of black bits, whose length is a thousandth of that of its pixels."""
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    rows = zlib.compress(bytes(height * (1 + (width + 7) // 8)), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">2I5B", width, height, 1, 0, 0, 0, 0)) + (before and chunk(*before)) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("extension", [".png", ".jpg", ".tiff"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_sizes_are_read_from_heads_as_opencv_decodes_them(extension, kind):
    if (extension, kind) == (".jpg", np.uint16):
        return
    for shape in ((1, 300), (300, 1), (17, 9, 3)):
        data = cv2.imencode(extension, np.zeros(shape, kind))[1].tobytes()
        assert size_of(data) == shape[1::-1]
        for end in range(0, min(len(data), 400), 7):
            assert size_of(data[:end]) in (None, shape[1::-1])
    profile = b"\xff\xe2" + struct.pack(">H", 60000) + b"\xff\xc0\0\x11\x08\1\1\1\1" + bytes(60000 - 11)
    jpeg = cv2.imencode(".jpg", np.zeros((17, 9), np.uint8))[1].tobytes()
    assert size_of(jpeg[:2] + b"\xff\xff" + profile[1:] + jpeg[2:]) == (9, 17), "that in a profile is no size"


def test_images_and_masks_of_more_pixels_than_the_camera_are_not_decoded(planes, tmp_path, monkeypatch):  # noqa: F811
    large = png(WIDTH * 50, HEIGHT * 50)
    folder = damaged(planes, tmp_path / "w", lambda w: (w / "images/key.png").write_bytes(large))
    (folder / "masks").mkdir()
    (folder / "masks" / f"{SIDES[0]}").parent.mkdir(parents=True, exist_ok=True)
    (folder / "masks" / f"{SIDES[0]}.png").write_bytes(large)
    workspace = Workspace(folder)
    assert WIDTH * HEIGHT * 2500 > workspace.views["key.png"].most_picture_pixels
    asked = []
    monkeypatch.setattr(cv2, "imdecode", lambda data, how: asked.append(len(data)))
    with pytest.raises(InputError, match="no JPEG, PNG or TIFF of at most"):
        workspace.grey("key.png")
    assert workspace.mask(SIDES[0]) is None and not asked
    os.truncate(folder / "images/key.png", 8 * workspace.views["key.png"].most_picture_pixels + (1 << 25))
    assert not bytes_of(folder / "images/key.png", workspace.views["key.png"]), "nor is a hole read"


def test_what_decoders_print_reaches_no_terminal(planes, tmp_path, capfd):  # noqa: F811
    profile = zlib.compress(struct.pack(">I", 300) + np.random.default_rng(1).bytes(296))
    image = png(WIDTH, HEIGHT, (b"iCCP", b"a\x1b]0;owned\x07\0\0" + profile))
    folder = damaged(planes, tmp_path / "w", lambda w: (w / "images/key.png").write_bytes(image))
    assert Workspace(folder).grey("key.png").shape == (HEIGHT, WIDTH)
    assert "owned" not in capfd.readouterr().err
    cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert "owned" in capfd.readouterr().err, "as OpenCV alone does"


def test_a_camera_of_too_many_pixels_is_refused(planes, tmp_path):  # noqa: F811
    folder = damaged(planes, tmp_path / "w", lambda w: (w / "sparse/cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 3, 1, 1 << 40, 1 << 40, FOCAL, FOCAL, 1, 1)))
    with pytest.raises(InputError, match="its camera has"):
        Workspace(folder)


def planted_npy(kind, shape, data=b""):
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode() + data


def test_planted_pairs_of_the_cache_are_matched_anew(planes, tmp_path):  # noqa: F811
    get = lambda: Pairs(Workspace(planes), tmp_path).get("key.png", "forward.png")
    first, path = get(), tmp_path / "key.png/forward.png.npz"
    assert get().cached
    whole, mark = path.read_bytes(), zipfile.ZipFile(path).read("fingerprint.npy")

    def packed(how=zipfile.ZIP_DEFLATED, **arrays):
        with zipfile.ZipFile(path) as old:
            contents = {name: old.read(name) for name in old.namelist()} | {f"{name}.npy": data for name, data in arrays.items()}
        with zipfile.ZipFile(path, "w", how) as archive:
            for name, data in contents.items():
                archive.writestr(name, data)

    def changed(at, value):
        path.write_bytes(whole[:at] + value + whole[at + len(value) :])

    ways = [
        lambda: packed(fingerprint=planted_npy("<U64", "(1000000000000,)")), lambda: packed(code=planted_npy("<u2", "(1000000000000, 4)")),
        lambda: packed(code=planted_npy("|O", "()")), lambda: packed(code=planted_npy("<u2", f"({HEIGHT}, {WIDTH})")), lambda: packed(step=planted_npy("<f8", "()", bytes(8))),
        lambda: packed(plane=planted_npy("<f8", "(3,)", b"\xff" * 24)), lambda: packed(code=b"nonsense"), lambda: packed(zipfile.ZIP_LZMA), lambda: packed(zipfile.ZIP_BZIP2),
        lambda: changed(whole.index(b"fingerprint.npy") + 15 + 20, b"\xff\xff\xff\xff"), lambda: changed(whole.index(b"PK\1\2") + 8, b"\1"),
        lambda: path.write_bytes(b""), lambda: os.truncate(path, 1 << 40), lambda: (path.unlink(), os.mkfifo(path)), lambda: (path.unlink(), path.symlink_to("/dev/zero")),
    ]
    for way in ways:
        path.unlink()
        path.write_bytes(whole)
        way()
        found = get()
        assert not found.cached and (found.code == first.code).all()
        assert get().cached and zipfile.ZipFile(path).read("fingerprint.npy") == mark


def test_planted_maps_are_left_out_of_the_fusion(planes, tmp_path, capsys):  # noqa: F811
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png", SIDES[1]))
    run(planes, tmp_path / "out", clusters)
    planted = tmp_path / f"out/depth_maps/{SIDES[0]}.npy"
    for content in (b"nonsense", b"", b"\x93NUMPY\1\0", planted_npy("<f4", "(100000000000, 4)"), planted_npy("<f4", f"({WIDTH},)", bytes(4 * WIDTH)), planted_npy("<f4", f"({HEIGHT}, {WIDTH})"),
                    planted_npy("|O", f"({HEIGHT}, {WIDTH})"), b"\x93NUMPY\1\0\xff\xff" + b"(" * 65535):
        planted.write_bytes(content)
        sgm.main(["fuse", str(planes), "--out", str(tmp_path / "out"), "--clusters", str(clusters)])
        said = capsys.readouterr().err
        assert f"left out: 1 maps, the first {planted}: " in said and "1 depth maps, " in said
    planted.write_bytes(planted_npy("<f4", f"({HEIGHT}, {WIDTH})", struct.pack("<3f", np.inf, np.nan, 1e38) * (HEIGHT * WIDTH // 3)))
    sgm.main(["fuse", str(planes), "--out", str(tmp_path / "out"), "--clusters", str(clusters)])
    assert "2 depth maps, " in capsys.readouterr().err


@pytest.mark.parametrize("name", ["clusters.txt", "sizes.txt", "out/report.json", "out/rows/key.png.json", "progress.json", "w/sparse/cameras.bin", "w/sparse/images.bin"])
@pytest.mark.parametrize("how", ["pipe", "link", "long"])
def test_odd_records_end_the_run_with_one_line(planes, tmp_path, name, how):  # noqa: F811
    folder = shutil.copytree(planes, tmp_path / "w")
    write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES))
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if "sparse" in name and how != "pipe":
        return  # links lead to models, which may be of any length
    if path.exists():
        path.rename(tmp_path / "before")
    {"pipe": lambda: os.mkfifo(path), "link": lambda: path.symlink_to("/dev/zero"), "long": lambda: (path.touch(), os.truncate(path, 1 << 36))}[how]()
    command = [sys.executable, Path(sgm.__file__), "match", folder, "--out", tmp_path / "out", "--clusters", tmp_path / "clusters.txt", "--progress", tmp_path / "progress.json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "Traceback" not in done.stderr and Path(name).name in done.stderr.splitlines()[-1], done.stderr
