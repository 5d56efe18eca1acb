"""Makes a large survey quickly, as copies of a smaller one side by side. Reads and writes COLMAP's binary models as of 3.x; needs numpy.

No point is seen from two copies; each copy is identical to the original.
"""

import shutil
import struct

import numpy as np

# Of a point before its track, and of an image before its name.
POINT = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<u8")])
IMAGE = struct.Struct("<I4d3dI")
# Points that are moved at a time.
AT_ONCE = 500_000
OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


def beside_each_other(model, folder, copies):
    """Writes the model's cameras, and `copies` of its images and points in a row along x."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(model / "cameras.bin", folder)
    points = (model / "points3D.bin").read_bytes()
    step = points_beside(points, folder / "points3D.part", copies)
    images_beside((model / "images.bin").read_bytes(), folder / "images.bin", copies, *step)
    # What is there is whole.
    (folder / "points3D.part").rename(folder / "points3D.bin")


def points_beside(read, path, copies):
    """Spacing of the copies, and offsets of the ids of their points and images."""
    (count,) = struct.unpack_from("<Q", read)
    starts, at = np.empty(count + 1, np.int64), 8
    for i in range(count):
        starts[i] = at
        at += POINT.itemsize + 8 * struct.unpack_from("<Q", read, at + POINT.itemsize - 8)[0]
    starts[count] = at
    parts = [Part(read, starts[first : first + AT_ONCE + 1]) for first in range(0, count, AT_ONCE)]
    places = [part.heads()["place"][:, 0] for part in parts]
    width = max(map(np.max, places)) - min(map(np.min, places)) + 1.0
    points, images = (int(max(map(np.max, ids))) for ids in ([p.heads()["id"] for p in parts], [p.images() for p in parts]))
    with path.open("wb") as out:
        out.write(struct.pack("<Q", count * copies))
        for copy in range(copies):
            for part in parts:
                out.write(part.moved(copy * width, copy * points, copy * images))
    return width, points, images


class Part:
    """Some of the points with their tracks."""

    def __init__(self, read, starts):
        self.bytes = np.frombuffer(read, np.uint8, starts[-1] - starts[0], starts[0])
        self.starts = starts[:-1] - starts[0]

    def head(self):
        """Positions of the bytes before each track."""
        return self.starts[:, None] + np.arange(POINT.itemsize)

    def heads(self):
        return self.bytes[self.head()].view(POINT)[:, 0]

    def image_bytes(self):
        """Positions of the image's id in each entry of a track."""
        lengths = self.heads()["length"].astype(np.int64)
        first = np.repeat(self.starts + POINT.itemsize - 8 * (np.cumsum(lengths) - lengths), lengths)
        return (first + 8 * np.arange(len(first)))[:, None] + np.arange(4)

    def images(self):
        return self.bytes[self.image_bytes()].view("<u4")[:, 0]

    def moved(self, along_x, points, images):
        heads, ids, copy = self.heads(), self.images() + np.uint32(images), self.bytes.copy()
        heads["id"] += np.uint64(points)
        heads["place"][:, 0] += along_x
        copy[self.head()] = heads.view(np.uint8).reshape(-1, POINT.itemsize)
        copy[self.image_bytes()] = ids.view(np.uint8).reshape(-1, 4)
        return copy.data


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
