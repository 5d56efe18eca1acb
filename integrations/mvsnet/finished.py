#!/usr/bin/env python3
"""Writes fuse/, what the fusion reads: pair.txt, which is pair_fuse.txt with only those key views whose maps in depths/ are complete (the fusion opens
the maps of every view in it), and the maps with their confidences, beside cams/ and images/ of the export.

The fusion takes one size for all: maps of the plan's other size (sizes.txt) are resized. Those of any other, of an earlier plan, are left out, and so are
those whose camera has changed since this script first saw them (fuse/seen.json). Run it again whenever more maps are finished."""
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

import contextlib
import json
import shutil
import stat
from array import array
from pathlib import Path

folder = Path(__file__).resolve().parent


# Maps that the fusion compares with one: the best of those that are finished.
FUSED_WITH = 24
MOST_BYTES_OF_A_RECORD = 16 << 20


def read_record(path):
    """Reads a list or a record that may not be ours: follows no link, waits for no pipe, and refuses long files. Empty if there is no such file."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_BYTES_OF_A_RECORD:
            sys.exit(f"error: {path}: a link, not a file, or longer than {MOST_BYTES_OF_A_RECORD >> 20} MiB, so not of viewrank's; move it away")
        return path.read_text(encoding="utf-8", errors="surrogateescape")
    except FileNotFoundError:
        return ""


def opened(path):
    """The file of a PFM behind its header, its number of channels, and its width and height."""
    file = open(path, "rb")
    channels = 3 if file.readline(100).strip() == b"PF" else 1
    width, height = map(int, file.readline(100).split())
    file.readline(100)
    return file, channels, (width, height)


def size_of(path):
    """Width and height of a PFM of one channel with all its pixels, else None: a run that was stopped may leave half of one."""
    if not path.is_file():  # a pipe would be waited for
        return None
    try:
        file, channels, (width, height) = opened(path)
        with file:
            is_complete = channels == 1 and path.stat().st_size - file.tell() == 4 * width * height
    except (OSError, ValueError):
        return None
    return (width, height) if is_complete else None


def finished_size(view):
    """Size of the map and the confidence of a key view; None if they are not finished."""
    map_size, size = (size_of(folder / f"depths/{kind}/{int(view):08}.pfm") for kind in ("depth_est", "confidence"))
    return size if map_size == size else None


@contextlib.contextmanager
def new_file(path):
    """Writes a new file, which takes the place of an older one when it is complete."""
    draft = path.with_name(f"{path.name}.part")
    draft.unlink(missing_ok=True)
    with open(draft, "xb") as file:
        yield file
    os.replace(draft, path)


def resize(path, to, wide, high):
    """Writes the map with the nearest pixel at each place, the lowest row first. The copy has the time of the map, by which it is known to be its copy."""
    times = path.stat()
    file, _, (width, height) = opened(path)
    with file:
        start = file.tell()
        file.seek(0)
        scale = file.read(start).split(b"\n")[2]
        rows = [array("f", file.read(4 * width)) for _ in range(height)]
    columns = [min(x * width // wide, width - 1) for x in range(wide)]
    # Bottom up, as the rows are counted from the top.
    origins = [height - 1 - min(y * height // high, height - 1) for y in reversed(range(high))]
    with new_file(to) as file:
        file.write(b"Pf\n%d %d\n%s\n" % (wide, high, scale))
        for row in origins:
            array("f", [rows[row][x] for x in columns]).tofile(file)
    os.utime(to, ns=(times.st_atime_ns, times.st_mtime_ns))


def own_folder(path):
    """A folder of this script; a link in its place would lead somewhere else."""
    if path.is_symlink():
        sys.exit(f"error: {path}: a link in place of a folder of this script; move it away")
    path.mkdir(exist_ok=True)
    return path


def take(to, path):
    """Gives a map a second name, or copies it where the file system has no such names."""
    to.unlink(missing_ok=True)
    try:
        os.link(path, to)
    except OSError:
        shutil.copy2(path, to)


def place(view, size):
    """Puts map and confidence of a key view into fuse/ in the size of the fusion."""
    for kind in ("depth_est", "confidence"):
        path, to = (root / f"{kind}/{int(view):08}.pfm" for root in (folder / "depths", fuse))
        own_folder(to.parent)
        wanted = sizes[view][0]
        if size == wanted:
            take(to, path)
            continue
        is_current = to.is_file() and not to.is_symlink() and to.stat().st_mtime_ns == path.stat().st_mtime_ns and size_of(to) == wanted
        if not is_current:
            resize(path, to, *wanted)


def seen_now(view):
    """The time of a map, and the camera that it has now, without the range of depths."""
    lines = read_record(folder / f"cams/{int(view):08}_cam.txt").splitlines()
    return [(folder / f"depths/depth_est/{int(view):08}.pfm").stat().st_mtime_ns, " ".join(lines[:10])]


def seen_before():
    try:
        seen = json.loads(read_record(fuse / "seen.json"))
        return {key: [time, camera] for key, (time, camera) in seen.items() if isinstance(time, int) and isinstance(camera, str)}
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}


def write(path, text):
    with new_file(path) as file:
        file.write(text.encode())


def named(views):
    names = ", ".join(views[:5])
    return names if len(views) <= 5 else f"{names} and {len(views) - 5} more"


if not (folder / "sizes.txt").exists():
    sys.exit("error: sizes.txt is missing: export again")
fuse = own_folder(folder / "fuse")
# Of each key view the size in which its map is fused, then the other.
sizes = {}
for view, *sides in map(str.split, read_record(folder / "sizes.txt").splitlines()):
    width, height, *other = map(int, sides)
    sizes[view] = ((width, height), tuple(other))
lines = read_record(folder / "pair_fuse.txt").splitlines()[1:]
lists = {key: line.split()[1:] for key, line in zip(lines[::2], lines[1::2])}
found = {key: size for key in lists for size in [finished_size(key)] if size}
before = seen_before()
now = {key: seen_now(key) for key in found}
# Of a map that is the same file as before, the camera of that time.
seen = {**before, **{key: before[key] if key in before and before[key][0] == now[key][0] else now[key] for key in found}}
moved = [key for key in found if seen[key] != now[key]]
strange = [key for key in found if found[key] not in sizes[key]]
for left_out, what in ((strange, "that have no size of this plan"), (moved, "whose cameras have changed")):
    if left_out:
        print(f"left out: maps {what}, of views {named(left_out)}; the first commands compute them again", file=sys.stderr)
finished = {key: size for key, size in found.items() if key not in strange + moved}
write(fuse / "seen.json", json.dumps(seen))
entries = []
for key in lists:
    pairs = [pair for pair in zip(lists[key][::2], lists[key][1::2]) if pair[0] in finished][:FUSED_WITH]
    if key in finished and pairs:
        entries.append(f"{key}\n{len(pairs)} {' '.join(' '.join(pair) for pair in pairs)}\n")
count = f"{len(finished)} of {len(lists)} key views have maps of this plan"
if not entries:
    sys.exit(f"error: {count} in depths/{', and no two of them share points' if finished else ''}: nothing to join")
for view, size in finished.items():
    place(view, size)
write(fuse / "pair.txt", f"{len(entries)}\n" + "".join(entries))
resized = sum(size != sizes[view][0] for view, size in finished.items())
print(f"{count}{f', {resized} of them resized' if resized else ''}; {len(entries)} have another that shows the same: fuse/pair.txt")
