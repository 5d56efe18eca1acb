#!/usr/bin/env python3
"""Writes a grid of points at the height of the ground, for oriented images without a sparse cloud.

    python3 ground.py PROJECT HEIGHT [SPACING]

PROJECT holds ori/*.ori; HEIGHT and SPACING are in their units. PROJECT/ground.ply covers what the images see of the plane z = HEIGHT; viewrank
takes it where there is no cloud: which images overlap then follows from their frustums. SPACING is a 25th of the middle flying height
unless given. Needs Python 3.8 and nothing else.
"""

import errno
import os
import sys


class Printable:
    """Standard output or error, without what a terminal would obey: names in messages may be a stranger's, and so may this folder's name in those of Python itself."""

    def __init__(self, stream):
        self.stream = stream

    def write(self, text):
        shown = "".join(sign if sign.isprintable() or sign == "\n" else "?" for sign in text)
        encoding = getattr(self.stream, "encoding", None) or "utf-8"
        self.attempt(lambda: self.stream.write(shown.encode(encoding, "replace").decode(encoding)))

    def flush(self):
        self.attempt(lambda: self.stream.flush())

    def attempt(self, action):
        """What nobody reads any more, or never did, is dropped."""
        try:
            if self.stream:
                action()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())


def explain(kind, error, _):
    """One line in place of a trace: files and paths may be a stranger's."""
    what = getattr(error, "strerror", None) or " ".join(f"{kind.__name__}: {error}".split())
    cure = "move the project to a shorter path" if getattr(error, "errno", None) == errno.ENAMETOOLONG else "check the files that it reads, or export again"
    print("interrupted" if kind is KeyboardInterrupt else f"error: {getattr(error, 'filename', None) or __file__}: {what}; {cure}", file=sys.stderr)


if __name__ == "__main__":
    sys.stdout, sys.stderr = Printable(sys.stdout), Printable(sys.stderr)
    sys.excepthook = explain
    # This folder and the current one may be a stranger's: a json.py that he put there is not imported.
    sys.path[:] = [path for path in sys.path if os.path.realpath(path) not in (os.path.dirname(os.path.realpath(__file__)), os.path.realpath(os.curdir))]

import math
import stat
import statistics
from pathlib import Path

MOST_POINTS = 1_000_000
MOST_BYTES_OF_A_RECORD = 1 << 20  # an orientation has some 1,000
# The keys of an orientation that are read.
CAMERA_MATRIX, SIZE, ROTATION, CENTRE = "IntOri_CameraMatrix", "IntOri_SensorSize", "ExtOri_RotationMatrix", "ExtOri_TranslationVector"
FOCAL_LENGTH, PIXEL_SIZE, PRINCIPAL_POINT = "IntOri_FocalLength", "IntOri_PixelSize", "IntOri_PrincipalPoint"
KNOWN = {CAMERA_MATRIX, SIZE, ROTATION, CENTRE, FOCAL_LENGTH, PIXEL_SIZE, PRINCIPAL_POINT}


def main():
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    project, height = Path(sys.argv[1]), float(sys.argv[2])
    target = project / "ground.ply"
    if target.exists():
        sys.exit(f"error: {target} is there; move it away")
    cameras = [read(path) for path in sorted((project / "ori").glob("*.ori"))]
    if not cameras:
        sys.exit(f"error: no ori/*.ori in {project}")
    above = statistics.median(abs(camera["centre"][2] - height) for camera in cameras)
    spacing = float(sys.argv[3]) if len(sys.argv) == 4 else above / 25
    seen = [corner for camera in cameras for corner in footprint(camera, height, 10 * above)]
    if not seen or not spacing > 0:
        sys.exit(f"error: no image looks at the plane z = {height:g}; is the height in the units of the orientations?")
    axes = [steps(min(corner[axis] for corner in seen), max(corner[axis] for corner in seen), spacing) for axis in (0, 1)]
    count = math.prod(last - first + 1 for first, last in axes)
    if count > MOST_POINTS:
        sys.exit(f"error: {count} points; give a SPACING above {spacing * math.sqrt(count / MOST_POINTS):g}")
    write(target, axes, spacing, height)
    print(f"{count} points, {spacing:g} apart, in {target}")


def read_record(path):
    """Reads a record that may not be ours: follows no link, waits for no pipe, and refuses long files."""
    found = path.lstat()
    if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_BYTES_OF_A_RECORD:
        sys.exit(f"error: {path}: a link, not a file, or longer than {MOST_BYTES_OF_A_RECORD >> 20} MiB, so no orientation; move it away")
    return path.read_text(encoding="utf-8", errors="replace")


def read(path):
    """Camera matrix, size, rotation and centre: the numbers below each key."""
    entries, key = {}, None
    for line in read_record(path).splitlines():
        if line.startswith("$"):
            key = line[1:].split("__")[0].split("(")[0].rstrip("_")
            entries[key] = []
        elif key in KNOWN:
            entries[key] += line.split()
    try:
        numbers = {key: [float(word) for word in entries[key]] for key in KNOWN & entries.keys()}
        if CAMERA_MATRIX in numbers:
            k = numbers[CAMERA_MATRIX]
        else:
            (f,), (px, py), (cx, cy) = (numbers[key] for key in (FOCAL_LENGTH, PIXEL_SIZE, PRINCIPAL_POINT))
            k = [f / px, 0, cx, 0, f / py, cy, 0, 0, 1]
        camera = {"k": k, "size": numbers[SIZE], "r": numbers[ROTATION], "centre": numbers[CENTRE]}
    except (KeyError, ValueError, ZeroDivisionError) as error:
        sys.exit(f"error: {path}: {error!r}")
    numbers = [number for values in camera.values() for number in values]
    if [len(values) for values in camera.values()] != [9, 2, 9, 3] or not all(map(math.isfinite, numbers)) or not (k[0] and k[4]):
        sys.exit(f"error: {path}: not the numbers of a camera")
    return camera


def footprint(camera, height, farthest):
    """Where the rays of the image's corners meet the plane, no farther than that from the camera; none above the horizon."""
    (width, rows), k, r, c = camera["size"], camera["k"], camera["r"], camera["centre"]
    for u, v in ((0, 0), (width, 0), (0, rows), (width, rows)):
        ray = ((u - k[2]) / k[0], (v - k[5]) / k[4], 1.0)
        x, y, z = (sum(r[3 * i + axis] * ray[i] for i in range(3)) for axis in range(3))
        along = (height - c[2]) / z if z else -1.0
        if 0 < along * math.hypot(x, y) < farthest or (along > 0 and x == y == 0):
            yield c[0] + along * x, c[1] + along * y


def steps(least, greatest, spacing):
    return math.floor(least / spacing), math.ceil(greatest / spacing)


def write(target, axes, spacing, height):
    (left, right), (bottom, top) = axes
    part = target.with_suffix(".part")
    part.unlink(missing_ok=True)
    with open(part, "x", encoding="ascii") as file:
        file.write(f"ply\nformat ascii 1.0\nelement vertex {(right - left + 1) * (top - bottom + 1)}\n")
        file.write("property double x\nproperty double y\nproperty double z\nend_header\n")
        for j in range(bottom, top + 1):
            for i in range(left, right + 1):
                file.write(f"{i * spacing!r} {j * spacing!r} {height!r}\n")
    part.replace(target)


if __name__ == "__main__":
    main()
