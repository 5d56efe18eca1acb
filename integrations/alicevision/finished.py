#!/usr/bin/env python3
"""Writes finished.sfm: keys.sfm with only those views that have a depth map in depthMaps/. Filtering and meshing open the maps of all views."""
import os
import sys


class Printable:
    """Standard output or error, without what a terminal would obey: names in messages may be a stranger's, and so may this folder's name in those of Python itself."""

    def __init__(self, stream):
        self.stream = stream

    def write(self, text):
        self.stream.write("".join(sign if sign.isprintable() or sign == "\n" else "?" for sign in text))

    def flush(self):
        self.stream.flush()


if __name__ == "__main__":
    sys.stdout, sys.stderr = Printable(sys.stdout), Printable(sys.stderr)
    # This folder and the current one may be a stranger's: a json.py that he put there is not imported.
    sys.path[:] = [path for path in sys.path if os.path.realpath(path) not in (os.path.dirname(os.path.realpath(__file__)), os.path.realpath(os.curdir))]

import json
import stat
from pathlib import Path

# Of the scene, of which most are the points.
MOST_BYTES_OF_A_RECORD = 1 << 30


def read_record(path):
    """Reads a record that may not be ours: follows no link, waits for no pipe, and refuses long files. Empty if there is no such file."""
    try:
        found = path.lstat()
    except FileNotFoundError:
        return ""
    if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_BYTES_OF_A_RECORD:
        sys.exit(f"error: {path}: a link, not a file, or longer than {MOST_BYTES_OF_A_RECORD >> 20} MiB, so not of viewrank's; move it away")
    return path.read_text(encoding="utf-8", errors="surrogateescape")


folder = Path(__file__).resolve().parent


def explain(kind, error, _):
    """An error in place of a trace: the files here may be a stranger's, or half of viewrank's."""
    print("stopped" if kind is KeyboardInterrupt else f"error: {folder}: {kind.__name__}: {error}; if its lists are not what viewrank wrote, export again", file=sys.stderr)


sys.excepthook = explain
try:
    scene = json.loads(read_record(folder / "keys.sfm"))
except (ValueError, RecursionError):
    sys.exit(f"error: {folder / 'keys.sfm'}: missing, or not what viewrank wrote: export again")
scene["views"] = [view for view in scene["views"] if (folder / f"depthMaps/{view['viewId']}_depthMap.exr").is_file()]
ids = {view["viewId"] for view in scene["views"]}
if not ids:
    sys.exit("error: depthMaps holds no map of a key view")
scene["poses"] = [pose for pose in scene["poses"] if pose["poseId"] in ids]
for landmark in scene["structure"]:
    landmark["observations"] = [seen for seen in landmark["observations"] if seen["observationId"] in ids]
scene["structure"] = [landmark for landmark in scene["structure"] if len(landmark["observations"]) > 1]
# A new file: what somebody has put in the place of the draft is not written.
draft = folder / "finished.sfm.part"
draft.unlink(missing_ok=True)
with open(draft, "x", encoding="utf-8") as file:
    json.dump(scene, file, indent=1)
os.replace(draft, folder / "finished.sfm")
