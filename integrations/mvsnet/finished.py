#!/usr/bin/env python3
"""Writes fuse/pair.txt: pair_fuse.txt with only those key views whose maps in depths/ are complete. The fusion opens the maps of every view in it.

Also links cams/ and images/ into fuse/. If half/ has key views that are matched at half the size, the maps and their confidences go there too, in their
full size: the fusion takes one size for all. Run it again whenever more maps are finished."""
import os
import sys

# The folder may be a stranger's: a json.py that he put there is not imported.
sys.path[:] = [path for path in sys.path if os.path.realpath(path) != os.path.dirname(os.path.realpath(__file__))]

from array import array
from pathlib import Path

folder = Path(__file__).resolve().parent


def opened(path):
    """The file of a PFM behind its header, its number of channels, and its width and height."""
    file = open(path, "rb")
    channels = 3 if file.readline().strip() == b"PF" else 1
    width, height = map(int, file.readline().split())
    file.readline()
    return file, channels, (width, height)


def is_complete(path):
    """True for a PFM with all its pixels: a run that was stopped may leave half of one."""
    try:
        file, channels, (width, height) = opened(path)
        with file:
            return path.stat().st_size - file.tell() == 4 * channels * width * height
    except (OSError, ValueError):
        return False


def is_finished(view):
    return all(is_complete(folder / f"depths/{kind}/{int(view):08}.pfm") for kind in ("depth_est", "confidence"))


def enlarge(path, to, wide, high):
    """Writes the map with each pixel repeated to a larger size: of one channel, 32-bit floats, the lowest row first."""
    file, _, (width, height) = opened(path)
    with file:
        start = file.tell()
        file.seek(0)
        scale = file.read(start).split(b"\n")[2]
        rows = [array("f", file.read(4 * width)) for _ in range(height)]
    columns = [min(x * width // wide, width - 1) for x in range(wide)]
    # Bottom up, as the rows are counted from the top.
    origins = [height - 1 - min(y * height // high, height - 1) for y in reversed(range(high))]
    with open(f"{to}.part", "wb") as file:
        file.write(b"Pf\n%d %d\n%s\n" % (wide, high, scale))
        for row in origins:
            array("f", [rows[row][x] for x in columns]).tofile(file)
    os.replace(f"{to}.part", to)


def place(view):
    """Puts both maps of a key view into fuse/ in their full size, by a link where they have it."""
    for kind in ("depth_est", "confidence"):
        path, to = (folder / f"{root}/{kind}/{int(view):08}.pfm" for root in ("depths", "fuse"))
        to.parent.mkdir(exist_ok=True)
        file, _, size = opened(path)
        file.close()
        if size != full_sizes[view]:
            enlarge(path, to, *full_sizes[view])
        elif not to.is_symlink():
            to.unlink(missing_ok=True)
            to.symlink_to(f"../../depths/{kind}/{path.name}")


def full_size_lines():
    path = folder / "half/full_sizes.txt"
    return path.read_text().splitlines() if path.exists() else []


full_sizes = {view: (int(width), int(height)) for view, width, height in map(str.split, full_size_lines())}
lines = (folder / "pair_fuse.txt").read_text().splitlines()[1:]
lists = {key: line.split()[1:] for key, line in zip(lines[::2], lines[1::2])}
finished = {key for key in lists if is_finished(key)}
entries = []
for key in lists:
    pairs = [pair for pair in zip(lists[key][::2], lists[key][1::2]) if pair[0] in finished]
    if key in finished and pairs:
        entries.append(f"{key}\n{len(pairs)} {' '.join(' '.join(pair) for pair in pairs)}\n")
if not entries:
    sys.exit(f"error: {len(finished)} of {len(lists)} key views have maps in depths/, and no two of them share points: nothing to join")
fuse = folder / "fuse"
fuse.mkdir(exist_ok=True)
(fuse / "pair.txt.part").write_text(f"{len(entries)}\n" + "".join(entries))
os.replace(fuse / "pair.txt.part", fuse / "pair.txt")
for name in ("cams", "images"):
    if not (fuse / name).exists():
        (fuse / name).symlink_to(f"../{name}")
for view in finished if full_sizes else ():
    place(view)
print(f"{len(finished)} of {len(lists)} key views have maps, {len(entries)} of them another that shows the same: fuse/pair.txt")
