#!/usr/bin/env python3
"""Writes fuse/pair.txt: pair_fuse.txt with only those key views whose maps in depths/ are complete. The fusion opens the maps of every view in it.

Also links cams/ and images/ into fuse/. Run it again whenever more maps are finished."""
import os
import sys

# The folder may be a stranger's: a json.py that he put there is not imported.
sys.path[:] = [path for path in sys.path if os.path.realpath(path) != os.path.dirname(os.path.realpath(__file__))]

from pathlib import Path

folder = Path(__file__).resolve().parent


def is_complete(path):
    """True for a PFM with all its pixels: a run that was stopped may leave half of one."""
    try:
        with open(path, "rb") as file:
            channels = 3 if file.readline().strip() == b"PF" else 1
            width, height = map(int, file.readline().split())
            file.readline()
            return path.stat().st_size - file.tell() == 4 * channels * width * height
    except (OSError, ValueError):
        return False


def is_finished(view):
    return all(is_complete(folder / f"depths/{kind}/{int(view):08}.pfm") for kind in ("depth_est", "confidence"))


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
print(f"{len(finished)} of {len(lists)} key views have maps, {len(entries)} of them another that shows the same: fuse/pair.txt")
