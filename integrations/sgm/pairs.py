"""Depth by one partner, kept in a cache: a file per pair, so that many partner choices are judged at the price of one."""

import contextlib
import hashlib
import os
import stat
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import matching
import rectify
from rectify import Parallax, Refused
from workspace import ImageError, read_array

VERSION = 2  # raised when the same input gives other maps


@dataclass
class PairMap:
    """Inverse z-depth of a key view by one partner, or why there is none."""

    refused: str = ""
    code: np.ndarray = field(default=None, repr=False)  # h x w uint16: 0 unknown, else inverse depth = low + step (code - 1)
    low: float = 0.0
    step: float = 0.0
    parallax: Parallax = None
    angle: float = float("nan")  # median triangulation angle of the shared points, degrees
    octaves: float = float("nan")  # log2 of how much finer the key view shows them
    seconds: float = 0.0  # wall time of matching
    cached: bool = False

    @property
    def matched(self):
        return self.code is not None

    @property
    def share(self):
        """Share of the key view's pixels that were matched."""
        return float((self.code > 0).mean()) if self.matched else 0.0

    def inverse(self):
        """h x w float32, nan unknown."""
        return np.where(self.code > 0, self.low + self.step * (self.code - 1.0), np.nan).astype(np.float32)

    def deviation(self):
        """Standard deviation of `inverse` per pixel of matching error."""
        return self.parallax.deviation(self.inverse())


class Pairs:
    """Matches pairs of a workspace; with a cache folder, only those that are not in it. Refused pairs are judged anew each time, which takes little."""

    def __init__(self, workspace, cache=None):
        self.workspace, self.cache, self.images = workspace, cache and Path(cache), {}

    def get(self, key, partner):
        a, b = self.workspace.views[key], self.workspace.views[partner]
        shared = self.workspace.xyz[np.intersect1d(a.points, b.points, assume_unique=True)]
        around = self.workspace.xyz[np.union1d(a.points, b.points)]
        path = self.cache and self.cache / key / (partner + ".npz")
        mark = path and fingerprint(self.workspace, a, b, shared, around)
        found = path and load(path, mark, a.size)
        if found:
            return found
        start = time.perf_counter()
        result = self.match(a, b, shared, around)
        result.seconds = time.perf_counter() - start
        if path and result.matched:
            save(path, result, mark)
        return result

    def match(self, a, b, shared, around):
        """The pair, or why it is refused.

        Raises ImageError where the key view's image cannot be read: no pair of that key view says anything then."""
        if len(shared) < rectify.MIN_SHARED:
            return PairMap(f"only {len(shared)} shared sparse points, fewer than {rectify.MIN_SHARED}")
        angle, octaves = rectify.geometry(a, b, shared)
        try:
            pair = rectify.rectify(a, b, shared, around)
        except Refused as reason:
            return PairMap(str(reason), angle=angle, octaves=octaves)
        key = self.image(a.name)
        try:
            partner = self.image(b.name)
        except ImageError as reason:
            return PairMap(reason.what, angle=angle, octaves=octaves)
        code, low, step = encode(matching.match(pair, *key, *partner))
        return PairMap("", code, low, step, pair.parallax, angle, octaves)

    def image(self, name):
        """The grey image and its mask; the last 40 are kept."""
        if name not in self.images:
            if len(self.images) >= 40:
                self.images.pop(next(iter(self.images)))
            self.images[name] = self.workspace.grey(name), self.workspace.mask(name)
        return self.images[name]


def fingerprint(workspace, a, b, shared, around):
    """SHA-256 of everything that the pair's map depends on."""
    parts = [str(VERSION).encode(), shared.tobytes(), around.tobytes()]
    for v in (a, b):
        parts += [v.K.tobytes(), v.R.tobytes(), v.t.tobytes(), str(v.size).encode()]
        with contextlib.suppress(OSError):
            parts.append(str((workspace.images / v.name).stat().st_size).encode())
        if mask := workspace.mask_digest(v.name):
            parts += [b"mask", mask]
    return hashlib.sha256(b"|".join(parts)).hexdigest()


def made_of(workspace, key, partners):
    """Digest of the current cameras and poses of a cluster's views, 16 hex digits."""
    views = [workspace.views[name] for name in (key, *partners)]
    return hashlib.sha256(b"|".join(part.tobytes() for v in views for part in (v.K, v.R, v.t))).hexdigest()[:16]


def encode(inverse):
    """Inverse depths as 65535 steps between their extremes, far finer than the match; 0 where unknown."""
    known = np.isfinite(inverse)
    low, high = (float(np.nanmin(inverse)), float(np.nanmax(inverse))) if known.any() else (0.0, 1.0)
    step = max((high - low) / 65534, 1e-30)
    code = np.zeros(inverse.shape, np.uint16)
    code[known] = 1 + np.rint((inverse[known] - low) / step).clip(0, 65534).astype(np.uint16)
    return code, low, step


def save(path, pair, mark):
    arrays = {"fingerprint": mark, "angle": pair.angle, "octaves": pair.octaves, "seconds": pair.seconds}
    arrays |= {"code": pair.code, "low": pair.low, "step": pair.step} | vars(pair.parallax)
    write_whole(path, lambda file: write_npz(file, arrays))


def load(path, mark, size):
    """The matched pair at `path` if it is whole, of this fingerprint and of a key view of this size, else None: the cache may be anybody's, and a pair is soon matched again."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > 3 * size[0] * size[1] + (1 << 20):
            return None
        with zipfile.ZipFile(path) as archive:
            if str(packed(archive, "fingerprint", f"<U{len(mark)}")) != mark:
                return None
            angle, octaves, seconds = (float(packed(archive, name, "<f8")) for name in ("angle", "octaves", "seconds"))
            low, step, gain, coarse = numbers = [float(packed(archive, name, "<f8")) for name in ("low", "step", "gain", "coarse")]
            plane, epipole = packed(archive, "plane", "<f8", 3), packed(archive, "epipole", "<f8", 2)
            if not np.isfinite([*numbers, *plane, *epipole]).all() or not (gain and step > 0 and coarse >= 1):
                return None
            return PairMap("", packed(archive, "code", "<u2", *size[::-1]), low, step, Parallax(plane, epipole, gain, coarse), angle, octaves, seconds, cached=True)
    except Exception:  # OSError, and all that zipfile and its decompressors raise on damaged files
        return None


def packed(archive, name, kind, *shape):
    """An array of the cache. Only the method that we write: others may ask for memory by their head."""
    entry = archive.getinfo(f"{name}.npy")
    if entry.compress_type != zipfile.ZIP_DEFLATED:
        raise ValueError(f"{name}: packed otherwise")
    with archive.open(entry) as file:
        return read_array(file, kind, *shape)


def write_npz(file, arrays):
    """As numpy.savez_compressed, at the fastest level."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, value in arrays.items():
            with archive.open(name + ".npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(value), allow_pickle=False)


def write_whole(path, write):
    """Writes a file under a temporary name, then renames it: it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256(os.fsencode(path.name)).hexdigest()  # the name itself may be as long as a name can be
    temporary = path.with_name(f".{digest[:16]}.{os.getpid()}.part")
    temporary.unlink(missing_ok=True)  # what a killed run left, or a stranger's link, which would be followed
    try:
        with open(temporary, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
