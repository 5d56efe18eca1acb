"""Sparse models in the binary layout of COLMAP 3 with one PINHOLE camera."""

import struct
from typing import NamedTuple

import numpy as np

from .camera import Camera

OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
PINHOLE = 1


class Image(NamedTuple):
    """Pixels: n x 2; points: their ids."""

    id: int
    name: str
    rotation: np.ndarray
    translation: np.ndarray
    pixels: np.ndarray
    points: np.ndarray


class Point(NamedTuple):
    """Track: (image id, index of the pixel)."""

    id: int
    place: np.ndarray
    colour: np.ndarray
    error: float
    track: list


def posed(number, name, rotation, centre):
    """An image without pixels."""
    return Image(number, name, rotation, -rotation @ centre, np.zeros((0, 2)), np.zeros(0, np.int64))


def quaternion(rotation):
    """w, x, y, z with w >= 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    q = np.array([w, x, y, z])
    return q if q[0] >= 0 else -q


def write(folder, camera, images, points):
    folder.mkdir(parents=True, exist_ok=True)
    width, height, f, cx, cy = camera
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, PINHOLE, width, height, f, f, cx, cy))
    with open(folder / "images.bin", "wb") as out:
        out.write(struct.pack("<Q", len(images)))
        for image in images:
            out.write(image_record(image))
    with open(folder / "points3D.bin", "wb") as out:
        out.write(struct.pack("<Q", len(points)))
        for p in points:
            out.write(struct.pack("<Q3d3BdQ", p.id, *p.place, *p.colour, p.error, len(p.track)))
            out.write(np.array(p.track, "<i4").tobytes())


def image_record(image):
    observations = np.empty(len(image.pixels), OBSERVATION)
    observations["x"], observations["y"], observations["point"] = image.pixels[:, 0], image.pixels[:, 1], image.points
    head = struct.pack("<i7di", image.id, *quaternion(image.rotation), *image.translation, 1)
    return head + image.name.encode() + b"\0" + struct.pack("<Q", len(observations)) + observations.tobytes()


def read_poses(folder):
    """The camera and {name: (rotation, centre)} of a model that `write` made, in its order."""
    from scipy.spatial.transform import Rotation

    _, _, _, width, height, f, _, cx, cy = struct.unpack("<QiiQQ4d", (folder / "cameras.bin").read_bytes())
    read = (folder / "images.bin").read_bytes()
    head, at, poses = struct.Struct("<i7di"), 8, {}
    for _ in range(struct.unpack_from("<Q", read)[0]):
        _, w, x, y, z, *translation, _ = head.unpack_from(read, at)
        end = read.index(b"\0", at + head.size)
        name = read[at + head.size : end].decode()
        at = end + 9 + OBSERVATION.itemsize * struct.unpack_from("<Q", read, end + 1)[0]
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        poses[name] = (rotation, -rotation.T @ np.array(translation))
    return Camera(width, height, f, cx, cy), poses
