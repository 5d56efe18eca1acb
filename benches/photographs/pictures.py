"""Takes the photographs out of a clone, reduces them, and reads their EXIF."""

import io
import re
import subprocess
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Optional

LONG_SIDE = 1000
JPEG_QUALITY = 90
# Larger originals are left out: the sets were made from snapshots that lack them.
MOST_BYTES = 4 << 20


@dataclass
class Photograph:
    """Sizes in pixels, original and reduced; latitude, longitude (degrees) and altitude (metres); seconds of the day."""

    name: str
    original_width: int
    size: tuple
    gps: Optional[tuple]
    time: Optional[int]


def git(clone, *arguments):
    return subprocess.run(["git", "-C", str(clone), *arguments], capture_output=True, check=True).stdout


def files(clone, commit):
    """(path, blob) of the photographs that are not too large."""
    for entry in git(clone, "ls-tree", "-r", "-l", "-z", commit).decode().split("\0"):
        if not entry:
            continue
        about, path = entry.split("\t", 1)
        _, _, blob, size = about.split()
        if re.search(r"\.jpe?g$", path, re.I) and size.isdigit() and int(size) <= MOST_BYTES:
            yield path, blob


def take(clone, commit, folder):
    """Writes the reduced photographs to the folder. Pictures that no camera took are left out."""
    folder.mkdir(parents=True, exist_ok=True)
    taken = []
    for path, blob in files(clone, commit):
        photograph = reduced(git(clone, "cat-file", "blob", blob), folder / (PurePosixPath(path).stem + ".jpg"))
        if photograph:
            taken.append(photograph)
    return sorted(taken, key=lambda p: p.name)


def reduced(original, path):
    import cv2
    import exifread
    import numpy as np

    tags = exifread.process_file(io.BytesIO(original), details=False)
    image = cv2.imdecode(np.frombuffer(original, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or "Image Make" not in tags:
        return None
    height, width = image.shape[:2]
    scale = LONG_SIDE / max(height, width)
    if scale < 1:
        image = cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return Photograph(path.name, width, (image.shape[1], image.shape[0]), gps(tags), seconds(tags))


def ratio(value):
    return value.num / value.den if value.den else 0.0


def degrees(tags, axis, negative):
    d, m, s = (ratio(v) for v in tags["GPS GPS" + axis].values)
    angle = d + m / 60 + s / 3600
    return -angle if str(tags["GPS GPS%sRef" % axis]) == negative else angle


def gps(tags):
    if any("GPS GPS" + name not in tags for name in ("Latitude", "LatitudeRef", "Longitude", "LongitudeRef", "Altitude")):
        return None
    altitude = ratio(tags["GPS GPSAltitude"].values[0])
    below = str(tags.get("GPS GPSAltitudeRef", "")).strip() == "1"
    return degrees(tags, "Latitude", "S"), degrees(tags, "Longitude", "W"), -altitude if below else altitude


def seconds(tags):
    if "EXIF DateTimeOriginal" not in tags:
        return None
    hours, minutes, rest = str(tags["EXIF DateTimeOriginal"]).split(" ")[1].split(":")
    return 3600 * int(hours) + 60 * int(minutes) + int(rest)
