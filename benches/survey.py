"""Copies of a survey beside each other: a larger one in a fraction of the time. Reads and writes COLMAP's binary models as of 3.x; needs numpy.

No point is seen from two copies; within each all is as in the one.
"""

import shutil
import struct

import numpy as np

# Of a point before its track, and of an image before its name.
POINT = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<u8")])
IMAGE = struct.Struct("<I4d3dI")
OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


def beside_each_other(model, folder, copies):
    """Writes the model's cameras, and `copies` of its images and points in a row along x."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(model / "cameras.bin", folder)
    points = (model / "points3D.bin").read_bytes()
    step = points_beside(points, folder / "points3D.bin", copies)
    images_beside((model / "images.bin").read_bytes(), folder / "images.bin", copies, *step)


def points_beside(read, path, copies):
    """How far the copies lie apart, and what the ids of their points and images differ by."""
    (count,) = struct.unpack_from("<Q", read)
    starts, at = np.empty(count, np.int64), 8
    for i in range(count):
        starts[i] = at
        at += POINT.itemsize + 8 * struct.unpack_from("<Q", read, at + POINT.itemsize - 8)[0]
    buffer = np.frombuffer(read, np.uint8).copy()
    head = starts[:, None] + np.arange(POINT.itemsize)
    heads = buffer[head].view(POINT)[:, 0]
    # Each entry of a track: the image's id, and which of its observations.
    lengths = heads["length"].astype(np.int64)
    first = np.repeat(starts + POINT.itemsize - 8 * (np.cumsum(lengths) - lengths), lengths)
    entries = first + 8 * np.arange(lengths.sum())
    ids = buffer[entries[:, None] + np.arange(4)].view("<u4")[:, 0]
    width, most, images = np.ptp(heads["place"][:, 0]) + 1.0, heads["id"].max(), ids.max()
    with path.open("wb") as out:
        out.write(struct.pack("<Q", count * copies))
        for copy in range(copies):
            moved = heads.copy()
            moved["id"] += np.uint64(copy) * most
            moved["place"][:, 0] += copy * width
            buffer[head] = moved.view(np.uint8).reshape(-1, POINT.itemsize)
            of_copy = (ids + np.uint32(copy) * images).astype("<u4")
            buffer[entries[:, None] + np.arange(4)] = of_copy.view(np.uint8).reshape(-1, 4)
            out.write(buffer[8:].data)
    return width, int(most), int(images)


def images_beside(read, path, copies, width, points, images):
    (count,) = struct.unpack_from("<Q", read)
    with path.open("wb") as out:
        out.write(struct.pack("<Q", count * copies))
        for copy in range(copies):
            at = 8
            for _ in range(count):
                number, w, x, y, z, *moved, camera = IMAGE.unpack_from(read, at)
                # The camera moves along x: its translation by minus the first column of its rotation.
                column = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
                moved = np.array(moved) - copy * width * column
                end = read.index(b"\0", at + IMAGE.size)
                name = b"copy%d_" % copy + read[at + IMAGE.size : end]
                (observed,) = struct.unpack_from("<Q", read, end + 1)
                observations = np.frombuffer(read, OBSERVATION, observed, end + 9).copy()
                observations["point"] += copy * points * (observations["point"] >= 0)
                at = end + 9 + observations.nbytes
                out.write(IMAGE.pack(number + copy * images, w, x, y, z, *moved, camera) + name + b"\0")
                out.write(struct.pack("<Q", observed) + observations.tobytes())
