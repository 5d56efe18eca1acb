#!/usr/bin/env python3
"""Writes finished.sfm: keys.sfm with only those views that have a depth map in depthMaps/. Filtering and meshing open the maps of all views."""
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
