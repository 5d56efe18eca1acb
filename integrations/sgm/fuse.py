"""Joins depth maps into one coloured cloud: a point per cell of one ground sampling distance, the mean of the depths in it.

Maps are added one after the other, so that memory follows the cloud and not the maps.
"""

import sys
from dataclasses import dataclass

import cv2
import numpy as np

from pairs import write_whole
from workspace import InputError, decoded, read_array

# Cells along each axis that a whole number of 63 bits can address; what is further from the middle of the sparse points is left out.
ACROSS = 1 << 21
# Points that wait to be merged, at least.
PENDING = 2_000_000
COLOUR_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
VERTEX = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


@dataclass
class Cells:
    """Sums over the points of each cell: x, y, z from `middle`, red, green, blue, and their number; cells in ascending order."""

    middle: np.ndarray
    size: float

    def __post_init__(self):
        self.keys, self.sums = np.empty(0, np.int64), np.empty((0, 7))
        self.pending = []

    def add(self, points, colours):
        offsets = points - self.middle
        places = np.floor(offsets / self.size).clip(-ACROSS, ACROSS).astype(np.int64) + ACROSS // 2
        inside = ((places >= 0) & (places < ACROSS)).all(1)
        x, y, z = places[inside].T
        rows = np.hstack([offsets[inside], colours[inside], np.ones((inside.sum(), 1))])
        self.pending.append(summed((x * ACROSS + y) * ACROSS + z, rows))
        if sum(len(keys) for keys, _ in self.pending) > max(PENDING, len(self.keys)):
            self.merge()

    def merge(self):
        parts = [(self.keys, self.sums), *self.pending]
        self.keys, self.sums = summed(np.concatenate([keys for keys, _ in parts]), np.concatenate([sums for _, sums in parts]))
        self.pending = []

    def vertices(self):
        self.merge()
        means = self.sums[:, :6] / self.sums[:, 6:]
        vertices = np.empty(len(means), VERTEX)
        for axis, name in enumerate("xyz"):
            vertices[name] = means[:, axis] + self.middle[axis]
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = np.rint(means[:, 3 + channel]).clip(0, 255)
        return vertices


def summed(keys, rows):
    """The distinct keys, ascending, and the sums of their rows."""
    order = np.argsort(keys, kind="stable")
    keys, rows = keys[order], rows[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]]) if len(keys) else np.empty(0, np.int64)
    return keys[starts], np.add.reduceat(rows, starts) if len(keys) else rows


def points_of(view, depth):
    """Points (n x 3) of the pixels that have a depth."""
    y, x = np.nonzero(depth > 0)
    z = depth[y, x].astype(float)
    rays = np.linalg.solve(view.K, np.stack([x, y, np.ones_like(x)]).astype(float))
    return (rays * z).T @ view.R + view.centre


def colours_of(workspace, view, depth):
    """Red, green and blue (n x 3) of the same pixels; grey where the image cannot be read."""
    image = decoded(workspace.images / view.name, COLOUR_AS_STORED, view)
    if image is None:
        return np.full(((depth > 0).sum(), 3), 128.0)
    return cv2.resize(image, depth.shape[::-1], interpolation=cv2.INTER_AREA)[depth > 0][:, ::-1].astype(float)


def fuse(workspaces, clusters, out):
    """Writes OUT/fused.ply of the maps that are there, whole and of their planned size; returns the number of maps and of points. `workspaces`: one for each size."""
    workspace = workspaces[1.0]
    middle = np.median(workspace.xyz, axis=0) if len(workspace.xyz) else np.zeros(3)
    cells, maps, strange = Cells(middle, workspace.gsd()), 0, []
    for key, _, size in clusters:
        path, view = out / "depth_maps" / f"{key}.npy", workspaces[size].views[key]
        if not path.is_file():
            continue
        try:
            with open(path, "rb") as file:
                depth = np.nan_to_num(read_array(file, "<f4", *view.size[::-1]), copy=True, nan=0, posinf=0, neginf=0)
        except (OSError, ValueError) as error:
            strange.append(f"{path}: {error}")
            continue
        cells.add(points_of(view, depth), colours_of(workspace, view, depth))
        maps += 1
    if strange and not maps:
        raise InputError(f"{strange[0]}. Give the --image-scale that it was made with, or match again")
    if not maps:
        raise InputError(f"no depth maps of these clusters in {out}: run match first")
    if strange:
        print(f"left out: {len(strange)} maps, the first {strange[0]}", file=sys.stderr)
    vertices = cells.vertices()
    write_ply(out / "fused.ply", vertices)
    return maps, len(vertices)


def write_ply(path, vertices):
    kinds = {"<f8": "double", "|u1": "uchar"}
    properties = "".join(f"property {kinds[VERTEX[name].str]} {name}\n" for name in VERTEX.names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    write_whole(path, lambda file: file.write(header.encode() + vertices.tobytes()))
