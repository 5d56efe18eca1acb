#!/usr/bin/env python3
"""Computes the depth maps of viewrank's plan with OpenMVS's DensifyPointCloud, in rank order, and fuses them.

    python3 -I run.py --densify /path/to/DensifyPointCloud
    python3 -I run.py --stop-at 20          the first 20 maps, without a cloud

A map of this plan that is there is not computed again. This is for machines without viewrank: `viewrank run PROJECT` goes on from these maps, checks those that it computes,
measures how much of the cloud is there, and fuses the maps of an unfinished run and those of two sizes. Needs Python 3.8 and nothing else.
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
    # Nor is a program started from there: relative entries of PATH are dropped, and Windows does not look there first.
    os.environ["PATH"] = os.pathsep.join(filter(os.path.isabs, os.environ.get("PATH", os.defpath).split(os.pathsep))) or os.defpath
    os.environ["NoDefaultCurrentDirectoryInExePath"] = "1"

import argparse
import json
import shutil
import stat
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
WORK = HERE / "unfinished"  # viewrank looks for no depth maps there
MARKS = HERE / "done"  # of finished maps, which viewrank reads
MOST_BYTES_OF_A_RECORD = 128 << 20
# The links to pictures that viewrank made, a line each:
# @LINKS@


def main():
    args = arguments()
    refuse_strangers(HERE)
    run = json.loads(read_record(HERE / "run.json"))
    refuse_other_pictures(run["pictures"])
    program = shutil.which(args.densify)
    if not program:
        sys.exit(f"error: no program {args.densify}\nhint: name it with --densify or the variable DENSIFY")
    with tempfile.TemporaryDirectory() as folder:  # it writes a log even then
        help_text = subprocess.run([program, "--help"], cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    known = [word for option in run["where_known"] if option[0] in help_text.stdout + help_text.stderr for word in option]
    options = [*run["options"], *known, "--config-file", str(HERE / "options.cfg"), "--dense-config-file", str(HERE / "dense.cfg"), "--max-threads", str(args.threads)]
    clusters = run["clusters"] if args.stop_at is None else run["clusters"][: args.stop_at]
    failed = [row["key"] for row in clusters if not compute(row, [program, *options, *run["of_maps"]])]
    if failed:
        sys.exit(f"error: {len(failed)} of {len(clusters)} depth maps failed: {', '.join(map(ascii, failed))}\nhint: run again, or `viewrank run PROJECT`, which says why")
    if args.stop_at is not None or len({row["resolution"] for row in clusters}) > 1:
        print("not fused: a part of the maps, or maps of two sizes: viewrank run PROJECT --fuse does that")
    else:
        fuse(run, [program, *options, *run["of_the_cloud"]])


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--densify", default=os.environ.get("DENSIFY", "DensifyPointCloud"), metavar="PROGRAM", help="the program (default: DensifyPointCloud, or $DENSIFY)")
    parser.add_argument("--stop-at", type=int, metavar="N", help="number of maps; they are not fused")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="threads of the program (default: all)")
    return parser.parse_args()


def refuse_strangers(top):
    """Ends where anything here is neither a file nor a folder nor a link to a picture that this script lists: it would be followed out of this folder, or a pipe waited for."""
    lines = Path(__file__).read_text(encoding="utf-8").split("\n")
    links = {line[2:] for line in lines if line.startswith("# ./")}
    for folder, folders, files in os.walk(top, onerror=refuse_unlisted):
        names = [*folders, *files]
        if Path(folder) == WORK:
            folders.clear()  # of other runs; each works in a new one
        for path in (Path(folder, name) for name in names):
            mode = path.lstat().st_mode
            is_picture = f"./{path.relative_to(top).as_posix()}" in links and (os.path.isfile(path) or not os.path.exists(path))
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or stat.S_ISLNK(mode) and is_picture):
                sys.exit(f"error: {ascii(str(path))}: not made by viewrank: move it away, or put the file or folder itself in the place of a link")


def refuse_unlisted(error):
    """A folder that cannot be listed may hide links."""
    sys.exit(f"error: {ascii(error.filename)}: {error.strerror}")


def read_record(path):
    """Reads a record that may not be ours: follows no link, waits for no pipe, and refuses long files."""
    try:
        found = path.lstat()
    except OSError:
        sys.exit(f"error: no {path}: export again")
    if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_BYTES_OF_A_RECORD:
        sys.exit(f"error: {path}: a link, not a file, or longer than {MOST_BYTES_OF_A_RECORD >> 20} MiB, so no record of viewrank's\nhint: move it away")
    return path.read_text(encoding="utf-8", errors="surrogateescape")


def refuse_other_pictures(planned):
    """Ends where the file of a picture has another length than when the plan was made: its partners and its camera may no longer be right."""
    for name, length in planned.items():
        picture = HERE / name
        if picture.exists() and picture.stat().st_size != length:
            sys.exit(f"error: {ascii(name)}: the picture has changed since the plan: plan again")


def compute(row, command):
    """Computes a map unless it is there; False if it fails. A half-made one never takes its place."""
    mark, place = MARKS / row["mark"], HERE / row["map"]
    if place.exists() and mark.exists() and read_record(mark).strip() in row["ids_of_map"]:
        return True
    mark.unlink(missing_ok=True)
    WORK.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=WORK) as folder:
        done = densify(command, folder, HERE / f"clusters/{row['rank']:04d}.mvs", "dense.mvs", row["resolution"])
        made = Path(folder) / row["map"]
        if done.returncode != 0 or not made.exists():
            said = [line for line in done.stdout.splitlines() if "error" in line] or [f"DensifyPointCloud ended with {done.returncode} and no depth map"]
            print(f"{row['rank']:4d} {row['key']}: failed: {said[0]}", flush=True)
            return False
        made.replace(place)
    MARKS.mkdir(exist_ok=True)
    write_new(mark, row["ids_of_map"][0] + "\n")
    print(f"{row['rank']:4d} {row['key']}: done", flush=True)
    return True


def fuse(run, command):
    """Joins all maps to fused.ply and fused.mvs, which keep their places if that fails."""
    for made in HERE.glob("fusing.*"):
        made.unlink()
    own_files(HERE)
    agreeing = min(run["maps_per_point"], len(run["clusters"]))
    command = [*command, "--view-neighbors-file", str(HERE / "fuse.txt"), "--number-views-fuse", str(agreeing)]
    done = densify(command, HERE, HERE / "fuse.mvs", "fusing.mvs", run["resolution"])
    if done.returncode != 0 or not (HERE / "fusing.ply").exists():
        sys.exit(f"error: nothing was fused: see DensifyPointCloud-*.log in {HERE}")
    for made in HERE.glob("fusing.*"):
        made.replace(HERE / f"fused{made.suffix}")
    print(f"{len(run['clusters'])} maps fused: {HERE / 'fused.ply'}")


def own_files(folder):
    """Gives files that have other names, which may be somebody else's, a file of their own: a program may write into what is there."""
    for path in [path for path in folder.iterdir() if stat.S_ISREG(path.lstat().st_mode) and path.lstat().st_nlink > 1]:
        handle, own = tempfile.mkstemp(dir=folder)
        os.close(handle)
        shutil.copy2(path, own)
        os.replace(own, path)


def densify(command, folder, scene, output, resolution):
    # With a file of options, OpenMVS takes the folder as it is written.
    command = [*command, "--working-folder", str(folder) + os.sep, "--input-file", str(scene), "--output-file", output, "--max-resolution", str(resolution)]
    return subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", check=False)


def write_new(path, text):
    """Writes a file in the place of what was there: a stranger's link is not followed."""
    path.unlink(missing_ok=True)
    with open(path, "x", encoding="utf-8") as file:
        file.write(text)


if __name__ == "__main__":
    try:
        main()
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        sys.exit(f"error: a file here is not what viewrank wrote ({type(error).__name__}: {error})\nhint: export again")
