"""Reads depth maps by readers of its own, and measures them at the sparse points: how much is filled, and how far off that is."""
import struct
from dataclasses import dataclass

import numpy as np
import pycolmap

# A measured depth within this share of the sparse point's counts as right.
RIGHT = 0.01


class Views:
    """Cameras, poses and observed sparse points of a COLMAP model, by name of the image."""

    def __init__(self, model):
        self.model = pycolmap.Reconstruction(model)
        self.images = {image.name: image for image in self.model.images.values()}

    def names(self):
        return sorted(self.images)

    def camera(self, name):
        return self.model.cameras[self.images[name].camera_id]

    def pose(self, name):
        """World to camera, 3 x 4."""
        return self.images[name].cam_from_world().matrix()

    def points(self, name):
        """Positions (pixels) and depths (z) of the sparse points that a view observes."""
        seen = [p for p in self.images[name].points2D if p.has_point3D()]
        world = np.array([self.model.points3D[p.point3D_id].xyz for p in seen])
        pose = self.pose(name)
        return np.array([p.xy for p in seen]), (world @ pose[:, :3].T + pose[:, 3])[:, 2]

    def depths(self, name, distances):
        """Turns a map of distances from the camera into depths along its axis."""
        camera = self.camera(name)
        height, width = distances.shape
        fx, fy, cx, cy = camera.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]]
        x = ((np.arange(width) + 0.5) * camera.width / width - cx) / fx
        y = ((np.arange(height) + 0.5) * camera.height / height - cy) / fy
        return distances / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)


@dataclass
class Measured:
    """Means over views: share of the pixels with a depth; of the sparse points there, share within RIGHT; median error (relative)."""

    maps: int
    filled: float
    right: float
    error: float

    def __str__(self):
        return f"{self.maps} maps, {100 * self.filled:.1f} % filled, {100 * self.right:.1f} % within 1 %, median error {100 * self.error:.2f} %"


def measure(views, maps):
    """Measures depth maps (name of the image -> array of z, 0 for none)."""
    rows = []
    for name, depth in maps.items():
        camera = views.camera(name)
        at, z = views.points(name)
        column = (at[:, 0] * depth.shape[1] / camera.width).astype(int)
        row = (at[:, 1] * depth.shape[0] / camera.height).astype(int)
        inside = (z > 0) & (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
        found = depth[row[inside], column[inside]]
        off = np.abs(found / z[inside] - 1)[found > 0]
        assert len(off) >= 20, f"{name}: {len(off)} sparse points have a depth"
        rows.append(((depth > 0).mean(), (off < RIGHT).mean(), np.median(off)))
    filled, right, error = np.mean(rows, axis=0)
    return Measured(len(rows), filled, right, error)


def assert_as_good(ours, default, filled=0.03, right=0.02):
    """The same maps as the program makes by its own choice of partners: filled and right alike, up to these differences."""
    said = f"\n  as planned: {ours}\n  by itself:  {default}"
    print(said)
    assert ours.maps == default.maps, said
    assert ours.filled >= default.filled - filled and ours.right >= default.right - right, said
    assert ours.error <= 1.25 * default.error + 0.0005, said


def read_pfm(path):
    with open(path, "rb") as file:
        assert file.readline().strip() == b"Pf"
        width, height = map(int, file.readline().split())
        kind = "<f4" if float(file.readline()) < 0 else ">f4"
        return np.frombuffer(file.read(), kind, width * height).reshape(height, width)[::-1]


def read_mvei(path):
    data = path.read_bytes()
    width, height, channels, kind = struct.unpack_from("<4i", data, 11)
    assert data.startswith(b"\x89MVE_IMAGE\n") and (channels, kind) == (1, 9)
    return np.frombuffer(data, "<f4", width * height, 27).reshape(height, width)


def read_dmap(path):
    """Depths of OpenMVS, and the name of the image with the ids of the key view and its partners."""
    data = path.read_bytes()
    head, depth, unit = {b"DR": (28, "<f4", 1.0), b"D2": (32, "<f2", 2.0 ** struct.unpack_from("b", data, 3)[0])}[data[:2]]
    assert data[2] & 1
    width, height = struct.unpack_from("<2I", data, 12)
    length = struct.unpack_from("<H", data, head)[0]
    image = data[head + 2 : head + 2 + length].decode()
    count = struct.unpack_from("<I", data, head + 2 + length)[0]
    ids = struct.unpack_from(f"<{count}I", data, head + 6 + length)
    start = head + 6 + length + 4 * count + 21 * 8
    return np.frombuffer(data, depth, width * height, start).reshape(height, width).astype(np.float32) * np.float32(unit), image, ids


def read_ply(path):
    """Positions of a binary little-endian PLY's vertices, and the name of each property."""
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "char": "i1", "int": "<i4", "uint": "<u4", "short": "<i2", "ushort": "<u2"}
    kinds |= {"float32": "<f4", "uint8": "u1", "int32": "<i4"}
    with open(path, "rb") as file:
        count, fields, element = 0, [], ""
        text = False
        while (line := file.readline().decode().split()) != ["end_header"]:
            if line[0] == "format":
                text = line[1] == "ascii"
            elif line[0] == "element":
                element, count = line[1], int(line[2]) if line[1] == "vertex" else count
            elif line[0] == "property" and element == "vertex" and line[1] != "list":
                fields.append((line[2], kinds[line[1]]))
        if text:
            rows = np.loadtxt(file, max_rows=count, ndmin=2)
            return rows[:, :3]
        table = np.fromfile(file, np.dtype(fields), count)
        return np.stack([table["x"], table["y"], table["z"]], 1).astype(float)
