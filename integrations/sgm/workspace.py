"""Reads an undistorted COLMAP workspace: cameras, poses, sparse points and images.

Pixel coordinates here are OpenCV's: the centre of the first pixel is (0, 0). COLMAP's files put it at (0.5, 0.5).
"""

import contextlib
import hashlib
import os
import re
import stat
import struct
from dataclasses import dataclass, field
from pathlib import Path

# Read when OpenCV is loaded: a second bound beside that of each view, should a decoder see another size than `size_of`.
MOST_PIXELS = 1 << 29
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(MOST_PIXELS)

import cv2
import numpy as np

PINHOLE_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
PINHOLE_IDS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE"}
GREY_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # the model knows nothing of EXIF
MASK_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH  # so that the darkest colours are not black
COPY_PIXELS = 1 << 25  # which images may have, however small their camera is: they may be those before a reduction
MOST_BYTES_OF_A_RECORD = 32 << 20
LARGEST_ROUNDING = 0.02  # of an aspect ratio
UNDISTORT = "undistort first: colmap image_undistorter --image_path IMAGES --input_path MODEL --output_path WORKSPACE"


class InputError(Exception):
    """Input that can't be used; the message says where and what to do."""


class ImageError(InputError):
    """An image that can't be matched."""

    def __init__(self, path, what):
        super().__init__(f"{path}: {what}")
        self.what = what


@dataclass
class View:
    """A registered image as it is matched: reduced, with x_pixel ~ K (R X + t)."""

    name: str
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    size: tuple  # width, height in matched pixels
    full_size: tuple  # width, height in the model
    points: np.ndarray = field(repr=False)  # rows of Workspace.xyz that it observes, sorted

    @property
    def centre(self):
        return -self.R.T @ self.t

    @property
    def most_picture_pixels(self):
        """Pixels that an image or a mask of the view may have: as many as its camera, or as a picture of COPY_PIXELS."""
        return max(self.full_size[0] * self.full_size[1], COPY_PIXELS)

    def project(self, xyz):
        """Pixels (n x 2) and z-depths (n) of points."""
        p = (xyz @ self.R.T + self.t) @ self.K.T
        return p[:, :2] / p[:, 2:], p[:, 2]


class Workspace:
    """The views of `folder` by name, the sparse points (`xyz`, n x 3), and the images at `image_scale` times the model's size."""

    def __init__(self, folder, image_scale=1.0):
        self.folder = Path(folder)
        self.images = self.folder / "images"
        if not self.images.is_dir():
            raise InputError(f"{self.images}: no such folder. An undistorted COLMAP workspace has images/ and sparse/; {UNDISTORT}")
        cameras, images, (ids, self.xyz) = read_model(model_folder(self.folder))
        order = np.argsort(ids)
        self.views, self.digests = {}, {}
        for name, camera, quaternion, t, observed in sorted(images, key=lambda image: image[0]):
            if camera not in cameras:
                raise InputError(f"{folder}: {name} refers to camera {camera}, which the model does not have")
            check_name(name)
            points = rows_of(np.unique(observed), ids, order)
            self.views[name] = reduced_view(name, cameras[camera], rotation(quaternion, name), t, points, image_scale)

    def grey(self, name):
        """The image as it is matched: grey, 8 bit, scaled from whatever size its file has."""
        path, view = self.images / name, self.views[name]
        image = decoded(path, GREY_AS_STORED, view)
        if image is None:
            raise ImageError(path, f"no JPEG, PNG or TIFF of at most {view.most_picture_pixels} pixels that OpenCV can read")
        size = image.shape[::-1]
        if not same_aspect_ratio(size, view.full_size):
            raise ImageError(path, f"{size[0]} x {size[1]} pixels, but the model says {view.full_size[0]} x {view.full_size[1]}: are these the images that were undistorted with this model?")
        return image if size == view.size else cv2.resize(image, view.size, interpolation=cv2.INTER_AREA if size[0] > view.size[0] else cv2.INTER_LINEAR)

    def mask(self, name):
        """True where the view may be matched (height x width, as matched); None if all of it may, as with a mask that can't be used."""
        path, view = self.mask_file(name), self.views[name]
        mask = decoded(path, MASK_AS_STORED, view) if path else None
        if mask is None or not same_aspect_ratio(mask.shape[1::-1], view.full_size):
            return None
        usable = mask.any(axis=2).astype(np.float32)
        return cv2.resize(usable, view.size, interpolation=cv2.INTER_AREA if mask.shape[1] > view.size[0] else cv2.INTER_NEAREST) >= 0.5

    def mask_digest(self, name):
        """SHA-256 of the view's mask, read once; empty without one that can be read."""
        if name not in self.digests:
            path = self.mask_file(name)
            data = bytes_of(path, self.views[name]) if path else b""
            self.digests[name] = hashlib.sha256(data).digest() if data else b""
        return self.digests[name]

    def mask_file(self, name):
        """Where viewrank finds the view's mask; None without one."""
        names = [f"{name}.png", name] if name.lower().endswith(".png") else [f"{name}.png"]
        paths = (folder / "masks" / mask for folder in (self.folder, self.images) for mask in names)
        return next((path for path in paths if path.is_file()), None)

    def connected(self, key):
        """All views that share sparse points with `key`, most first, ties by name, as (name, shared points)."""
        seen = np.zeros(len(self.xyz), bool)
        seen[self.views[key].points] = True
        shared = [(name, int(seen[view.points].sum())) for name, view in self.views.items() if name != key]
        return sorted((s for s in shared if s[1]), key=lambda s: (-s[1], s[0]))

    def gsd(self):
        """Median over the views of (median depth of the view's points) / (focal length), in scene units per matched pixel."""
        each = [np.median(v.project(self.xyz[v.points])[1]) * 2 / (v.K[0, 0] + v.K[1, 1]) for v in self.views.values() if len(v.points)]
        return float(np.median(each))


def decoded(path, how, view):
    """The image as OpenCV reads it; None if it can't, or if it has more pixels than one of the view may have: a file of a few bytes may claim any number."""
    data = bytes_of(path, view)
    size = size_of(data)
    if not size or not 0 < size[0] * size[1] <= view.most_picture_pixels:
        return None
    with silent_libraries():
        return cv2.imdecode(np.frombuffer(data, np.uint8), how)


@contextlib.contextmanager
def silent_libraries():
    """Drops what libraries print: libpng names a broken profile as the file does, with what a terminal would obey."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def bytes_of(path, view):
    """The content of an image or a mask of the view; empty if it can't be read, or is longer than four channels of 16 bit with a long profile."""
    try:
        found = path.stat()
        return path.read_bytes() if stat.S_ISREG(found.st_mode) and found.st_size <= 8 * view.most_picture_pixels + (1 << 24) else b""
    except OSError:
        return b""


def size_of(data):
    """Width and height by the header of a JPEG, PNG or TIFF, the formats that viewrank reads; None for any other file."""
    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return struct.unpack_from(">2I", data, 16) if data[12:16] == b"IHDR" else None
        if data[:2] == b"\xff\xd8":
            return size_of_jpeg(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return size_of_tiff(data, "<" if data[:1] == b"I" else ">")
    except (struct.error, IndexError):
        pass
    return None


MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")  # of a segment with a length
MOST_SEGMENTS = 1 << 14  # before that of the size, which follows profiles


def size_of_jpeg(data):
    at = 2
    for _ in range(MOST_SEGMENTS):
        found = MARKER.search(data, at)
        marker = found[0][1] if found else 0xD9
        if marker in (0xD9, 0xDA):
            return None
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return struct.unpack_from(">2H", data, found.end() + 3)[::-1]
        at = found.end() + struct.unpack_from(">H", data, found.end())[0]
    return None


def size_of_tiff(data, order):
    """That of the first image, or of one of its tiles if these are larger: OpenCV decodes tile by tile."""
    (at,) = struct.unpack_from(order + "I", data, 4)
    tags = {}
    for entry in range(struct.unpack_from(order + "H", data, at)[0]):
        tag, kind, _ = struct.unpack_from(order + "HHI", data, at + 2 + 12 * entry)
        if kind in (3, 4):
            (tags[tag],) = struct.unpack_from(order + {3: "H", 4: "I"}[kind], data, at + 10 + 12 * entry)
    (width, height), (tile_width, tile_height) = ([tags.get(tag, 0) for tag in pair] for pair in ((256, 257), (322, 323)))
    return (width, height) if tile_width * tile_height <= max(width * height, COPY_PIXELS) else None


def read_record(path):
    """Reads a list or a record that may not be ours: follows no link, waits for no pipe, and refuses long files. OSError if there is no such file."""
    found = path.lstat()
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{path}: a link, or not a file. Move it away")
    if found.st_size > MOST_BYTES_OF_A_RECORD:
        raise InputError(f"{path}: longer than {MOST_BYTES_OF_A_RECORD >> 20} MiB, so no list or record of viewrank's. Move it away")
    return path.read_text(encoding="utf-8", errors="surrogateescape")


def refuse_links(out):
    """Links at and below OUT would lead out of a project, which may be a stranger's, and a pipe would be waited for. Files that are links are replaced, not written."""
    if os.path.islink(out):
        raise InputError(f"{out}: a symbolic link in place of a folder of sgm.py's. Name the folder itself with --out")

    def unlisted(error):
        if not isinstance(error, FileNotFoundError):
            raise InputError(f"{error.filename}: {error.strerror}. Move it away, or name another --out")

    for folder, names, files in os.walk(out, onerror=unlisted):
        for name in names:
            if os.path.islink(os.path.join(folder, name)):
                raise InputError(f"{os.path.join(folder, name)}: a symbolic link in place of a folder of sgm.py's. Move it away, or name another --out")
        for name in files:
            path = os.path.join(folder, name)
            if os.path.exists(path) and not os.path.isfile(path):
                raise InputError(f"{path}: not a file. Move it away, or name another --out")


ARRAY = re.compile(rb"\{'descr': '([^']{1,8})', 'fortran_order': False, 'shape': \(([0-9, ]{0,40})\), \} *\n")


def read_array(file, kind, *shape):
    """The array of a .npy as numpy.save writes it; ValueError if it is not of this type and shape: a head may claim any, and memory for it would be asked for."""
    head = file.read(10)
    if len(head) < 10 or head[:8] != b"\x93NUMPY\1\0":
        raise ValueError("not a .npy")
    found = ARRAY.fullmatch(file.read(*struct.unpack_from("<H", head, 8)))
    if not found:
        raise ValueError("not a .npy of numbers")
    kind_found, shape_found = found[1].decode(), tuple(int(side) for side in found[2].replace(b",", b" ").split())
    if (kind_found, shape_found) != (np.dtype(kind).str, shape):
        raise ValueError(f"{kind_found} of the shape {shape_found}, not {np.dtype(kind).str} of the shape {shape}")
    length = np.dtype(kind).itemsize * int(np.prod(shape, dtype=np.int64))
    data = file.read(length + 1)
    if len(data) != length:
        raise ValueError("not of the length that its head says")
    return np.frombuffer(data, kind).reshape(shape)


def same_aspect_ratio(size, full_size):
    """Is one size the other, scaled and rounded?"""
    (width, height), (full_width, full_height) = size, full_size
    return abs(width * full_height / (height * full_width) - 1) <= min(sum(1 / side for side in (*size, *full_size)), LARGEST_ROUNDING)


def rows_of(wanted, ids, order):
    """Rows of the points whose ids are wanted, sorted; ids that the model lacks (-1 for none) are left out."""
    place = np.searchsorted(ids, wanted, sorter=order).clip(0, max(len(ids) - 1, 0))
    rows = order[place] if len(ids) else np.empty(0, np.int64)
    return np.sort(rows[ids[rows] == wanted]) if len(ids) else rows


def reduced_view(name, camera, R, t, points, scale):
    width, height, fx, fy, cx, cy = camera
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise InputError(f"view {name}: its camera has {width} x {height} pixels, not 1 to {MOST_PIXELS}")
    size = max(1, round(width * scale)), max(1, round(height * scale))
    sx, sy = size[0] / width, size[1] / height
    K = np.array([[fx * sx, 0, cx * sx - 0.5], [0, fy * sy, cy * sy - 0.5], [0, 0, 1]])
    return View(name, K, R, np.array(t, float), size, (width, height), points)


def check_name(name):
    """Output files are named after views, so a name must not lead out of the output folder."""
    if not name or name.startswith(("/", "\\")) or ".." in Path(name).parts or "\0" in name:
        raise InputError(f"view name {name!r} is not a path below images/: rename the image in the model")


def rotation(quaternion, name):
    q = np.array(quaternion, float)
    length = np.linalg.norm(q)
    if not np.isfinite(length) or length < 1e-12:
        raise InputError(f"view {name}: its rotation is no quaternion: {quaternion}")
    w, x, y, z = q / length
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def model_folder(workspace):
    for folder in (workspace / "sparse", workspace / "sparse" / "0"):
        if (folder / "images.bin").is_file() or (folder / "images.txt").is_file():
            return folder
    raise InputError(f"{workspace}: no sparse/images.bin, sparse/0/images.bin or the same as .txt")


def read_model(folder):
    """cameras {id: (width, height, fx, fy, cx, cy)}, images [(name, camera, quaternion, t, point ids)], points (ids, n x 3).

    Binary wins over text, as in COLMAP.
    """
    binary = (folder / "images.bin").is_file()
    readers = (read_cameras_bin, read_images_bin, read_points_bin) if binary else (read_cameras_txt, read_images_txt, read_points_txt)
    result = []
    for name, reader in zip(("cameras", "images", "points3D"), readers, strict=True):
        path = folder / (name + (".bin" if binary else ".txt"))
        try:
            if not path.is_file():  # a pipe would be waited for
                raise InputError(f"{path}: no such file")
            result.append(reader(path))
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        except (struct.error, ValueError, IndexError) as error:
            raise InputError(f"{path}: not a complete COLMAP file ({error})") from error
    return result


def pinhole(path, camera, model, width, height, parameters):
    if model not in PINHOLE_PARAMETERS:
        raise InputError(f"{path}: camera {camera} is {model}; only PINHOLE and SIMPLE_PINHOLE can be matched; {UNDISTORT}")
    f, *rest = parameters[: PINHOLE_PARAMETERS[model]]
    return (width, height, f, *([f] if model == "SIMPLE_PINHOLE" else []), *rest)


def read_cameras_bin(path):
    data, at, cameras = path.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        camera, model, width, height = struct.unpack_from("<IiQQ", data, at)
        model = PINHOLE_IDS.get(model, f"COLMAP model {model}")
        count = PINHOLE_PARAMETERS.get(model, 0)
        cameras[camera] = pinhole(path, camera, model, width, height, struct.unpack_from(f"<{count}d", data, at + 24))
        at += 24 + 8 * count
    return cameras


def read_images_bin(path):
    data, at, images = path.read_bytes(), 8, []
    observation = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "surrogateescape")
        (count,) = struct.unpack_from("<Q", data, end + 1)
        points = np.frombuffer(data, observation, count, end + 9)["point"]
        images.append((name, camera, pose[:4], pose[4:], points))
        at = end + 9 + count * observation.itemsize
    return images


def read_points_bin(path):
    data, at = path.read_bytes(), 8
    (count,) = struct.unpack_from("<Q", data)
    if count * 51 > len(data):
        raise ValueError(f"{count} points do not fit into {len(data)} bytes")
    ids, xyz = np.empty(count, np.int64), np.empty((count, 3))
    for i in range(count):
        ids[i], *xyz[i] = struct.unpack_from("<Q3d", data, at)
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    return ids, xyz


def text_lines(path):
    """Lines without comments; empty ones stay (an image without points has an empty second line)."""
    with open(path, encoding="utf-8", errors="surrogateescape") as file:
        return [line.rstrip("\r\n") for line in file if not line.startswith("#")]


def read_cameras_txt(path):
    cameras = {}
    for line in filter(str.strip, text_lines(path)):
        camera, model, width, height, *parameters = line.split()
        cameras[int(camera)] = pinhole(path, camera, model, int(width), int(height), [float(p) for p in parameters])
    return cameras


def read_images_txt(path):
    lines, images = text_lines(path), []
    while lines and not lines[-1].strip():
        lines.pop()
    for head, body in zip(lines[::2], [*lines[1::2], ""], strict=False):
        _, *pose, camera, name = head.split(maxsplit=9)
        points = np.array(body.split()[2::3], dtype=np.int64)
        pose = [float(p) for p in pose]
        images.append((name, int(camera), pose[:4], pose[4:], points))
    return images


def read_points_txt(path):
    rows = [line.split(maxsplit=4)[:4] for line in text_lines(path) if line.strip()]
    return np.array([int(r[0]) for r in rows], np.int64), np.array([r[1:] for r in rows], float).reshape(-1, 3)
