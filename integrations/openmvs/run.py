#!/usr/bin/env python3
"""Computes the depth maps of viewrank's plan with OpenMVS's DensifyPointCloud, checks each of them, and fuses them.

    python3 -I run.py                                       all clusters, in rank order, then the fusion
    python3 -I run.py --stop-at 20                          the first 20 clusters
    python3 -I run.py --stop-at 80%                         as many as the plan foretells for 80 % of the area that all would cover
    python3 -I run.py --stop-at 2h                          start no cluster after two hours
    python3 -I run.py --progress ../progress.json           end when that file says "target_reached": true
    python3 -I run.py --no-fusion                           only the depth maps
    python3 -I run.py --rank 7                              the seventh cluster alone; many such runs may go on side by side
    python3 -I run.py --stop-at 0                           only the fusion
    python3 -I run.py -- --geometric-iters 2                options for DensifyPointCloud behind two dashes, in place of those of run.py
    python3 -I run.py --stop-at 0 -- --number-views-fuse 3  another fusion of the same maps

Runs resume: a map that is there, is as planned, and whose row in report.json fits its scene and options is kept; any other is made anew and never fused. Options that only
change the cloud or the speed leave the maps as they are. A map is made in a folder under unfinished/ and takes the place of the one before when it is whole and as planned; a
run that fails or is killed loses none. report.json says for each key view what came out: DensifyPointCloud ends with success whatever it did, so that maps, partners and depth
ranges are read from the .dmap files. fused.ply and fused.mvs are replaced when the fusion has succeeded. Exit code 1: something is not as planned. Needs Python 3.8 and nothing else.
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
import array
import contextlib
import hashlib
import json
import re
import shutil
import stat
import struct
import subprocess
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
FILLED_LEAST = 0.01  # share of pixels with a depth below which a map counts as empty
MOST_BYTES_OF_A_RECORD = 16 << 20
NO_POSE = 0xFFFFFFFF  # DensifyPointCloud passes over such images and does not load them
# Kinds of .dmap by their first letters: bytes of the head, and bytes per pixel of the planes of depths, normals, confidences and views. OpenMVS v2.0 to v2.4.0 writes DR, in
# floats; develop of 2026 D2, with depths as halves and confidences as bytes. It reads only maps of the kind that it writes.
KINDS = {b"DR": (28, (4, 12, 4, 4)), b"D2": (32, (2, 4, 1, 4))}
KINDS_NOTED = HERE / "kinds.json"
UNFINISHED = HERE / "unfinished"  # viewrank looks for no depth maps in a folder of this name

# Options of DensifyPointCloud v2.3.0 and develop of 2026. Those of the cloud are read behind ComputeDepthMaps in Scene::DenseReconstruction (SceneDensify.cpp) and where main() writes or
# filters a cloud. All others may change a map: resolutions, iterations, neighbours and region of interest choose what is matched, and postprocess-dmaps filters the map before it is saved.
OF_THE_CLOUD = {"number-views-fuse", "fusion-filter", "estimate-colors", "estimate-normals", "estimate-scale", "filter-point-cloud", "export-number-views", "fusion-prior-weight", "fusion-recycle-dropped", "crop-to-roi", "roi-border", "archive-type"}
OF_THE_MACHINE = {"max-threads", "cuda-device", "process-priority", "verbosity"}
# fusion-mode and the files are what run.py is for; remove-dmaps would take the maps away.
OF_RUN_PY = {"working-folder", "input-file", "output-file", "view-neighbors-file", "fusion-mode", "remove-dmaps"}
SHORT = {"w": "working-folder", "i": "input-file", "o": "output-file", "p": "pointcloud-file", "c": "config-file", "v": "verbosity", "h": "help"}


def main():
    args = arguments()
    refuse_strangers()
    try:
        run = json.loads(read_record(HERE / "run.json"))
        if not isinstance(run, dict):
            raise ValueError
    except (ValueError, RecursionError):
        sys.exit(f"error: {HERE / 'run.json'}: missing, or not what viewrank wrote: export again")
    refuse_other_pictures(run.get("pictures", {}))
    program = Densify(args.densify, run, args.threads, args.options)
    report = Report(program.options)
    if args.rank is not None:
        sys.exit(one(run["clusters"], args.rank, program, report))
    program.refuse_other_kinds()
    clusters_until = stop_rule(args)
    for row in run["clusters"]:
        report.settle(row)
    run["clusters"] = [at_full_size(row, program, report) for row in run["clusters"]]
    for row in run["clusters"]:
        if clusters_until(row):
            break
        compute(row, program, report)
    failed = report.finish(run["clusters"], program)
    if not args.no_fusion:
        failed |= not fuse(run, program, report)
    sys.exit(1 if failed else 0)


def refuse_other_pictures(planned):
    """Ends where the file of a picture has another length than when the plan was made: its partners and its camera may no longer be right."""
    for name, length in planned.items():
        with contextlib.suppress(OSError):  # said by the program
            if (HERE / name).stat().st_size != length:
                sys.exit(f"error: {ascii(name)}: the picture has changed since the plan: plan again")


def refuse_strangers():
    """Ends where anything here is neither a file nor a folder: it would be followed out of this folder, or a pipe waited for. links.txt lists the links that viewrank made;
    those of a run are in its folder below unfinished/. Links to folders or pipes are refused, too: viewrank links pictures alone, one of which may be missing."""
    listed = HERE / "links.txt"
    if not listed.exists():
        sys.exit(f"error: no {listed}: export again")
    links = set(read_record(listed).split("\n"))
    for folder, folders, files in os.walk(HERE, onerror=refuse_unlisted):
        is_of_a_run = Path(folder).parent == UNFINISHED
        for name in [*folders, *files]:
            path = Path(folder, name)
            with contextlib.suppress(FileNotFoundError):  # that of another run
                mode = path.lstat().st_mode
                is_known = stat.S_ISLNK(mode) and (is_of_a_run or f"./{path.relative_to(HERE).as_posix()}" in links and (os.path.isfile(path) or not os.path.exists(path)))
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or is_known):
                    sys.exit(f"error: {ascii(str(path))}: not made by viewrank: move it away, or put the file or folder itself in the place of a link")


def refuse_unlisted(error):
    """A folder that cannot be listed may hide links."""
    if not isinstance(error, FileNotFoundError):  # that of another run
        sys.exit(f"error: {ascii(error.filename)}: {error.strerror}")


def read_record(path):
    """Reads a record that may not be ours: follows no link, waits for no pipe, and refuses long files. Empty if there is no such file."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_BYTES_OF_A_RECORD:
            sys.exit(f"error: {path}: a link, not a file, or longer than {MOST_BYTES_OF_A_RECORD >> 20} MiB, so no record of viewrank's\nhint: move it away")
        return path.read_text(encoding="utf-8", errors="surrogateescape")
    except OSError:  # another run was faster
        return ""


def say(text):
    """Prints one line: no name in it begins another."""
    print(text.replace("\n", "?"), flush=True)


def at_full_size(row, program, report):
    """The row of a key view that is planned at half the size but finished at full size, by an earlier plan: that map is kept. Any other as it is."""
    full = {**row, "scale": 1}
    if row.get("scale", 1) == 1 or not report.is_good(full, digest_of(full, program)):
        return row
    say(f"{row['rank']:4d} {row['key']}: planned at half the size, kept at full size")
    return full


def one(clusters, rank, program, report):
    """Computes one cluster; 1 where it is not as planned."""
    row = next((row for row in clusters if row["rank"] == rank), None)
    if row is None:
        sys.exit(f"error: --rank {rank}: the clusters have the ranks 1 to {len(clusters)}")
    report.single = True
    program.refuse_other_kinds(map_of(row))
    compute(row, program, report)
    return 1 if report.rows[row["key"]]["problems"] else 0


def arguments():
    own, _, foreign = partition(sys.argv[1:], "--")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--densify", default=os.environ.get("DENSIFY", "DensifyPointCloud"), metavar="PROGRAM", help="the program (default: DensifyPointCloud, or $DENSIFY)")
    parser.add_argument("--rank", type=int, metavar="N", help="the N-th cluster alone, without fusion (for queues)")
    parser.add_argument("--stop-at", metavar="N|P%|TIME", help="clusters, foretold share, or time (90s, 30m, 2h)")
    parser.add_argument("--progress", type=Path, metavar="FILE", help="JSON file whose target_reached ends the run")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="threads of each run (default: all)")
    parser.add_argument("--no-fusion", action="store_true")
    args = parser.parse_args(own)
    args.options = foreign
    return args


def partition(words, separator):
    at = words.index(separator) if separator in words else len(words)
    return words[:at], separator, words[at + 1 :]


def stop_rule(args):
    """A function that says, before each cluster, whether to stop."""
    started, text = time.monotonic(), args.stop_at or ""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([%smh]?)", text) if text else None
    if text and not match:
        sys.exit(f"error: --stop-at {text}: not a number of clusters, a share such as 80%, or a time such as 2h")
    amount, unit = (float(match[1]), match[2]) if match else (None, None)
    last_share = [0.0]

    def stop(row):
        before, last_share[0] = last_share[0], row["share"]
        if args.progress and target_reached(args.progress):
            return True
        if amount is None:
            return False
        if unit == "%":
            return before >= amount / 100
        if unit == "":
            return row["rank"] > amount
        return time.monotonic() - started > amount * {"s": 1, "m": 60, "h": 3600}[unit]

    return stop


def target_reached(path):
    try:
        return json.loads(read_record(path)).get("target_reached") is True
    except (ValueError, AttributeError, RecursionError):
        return False


def users_options(words, names):
    """Values by name of what stands behind the two dashes, as boost::program_options reads it: --name value, --name=value, -n value, -nvalue; names may be cut short where only
    one begins like that. The last word on an option counts."""
    options, words = {}, list(words)
    while words:
        word = words.pop(0)
        if word.startswith("--"):
            name, _, value = word[2:].partition("=")
            meant = [name] if name in names else [known for known in names if known.startswith(name)]
            name = meant[0] if len(meant) == 1 else name
        elif word[:1] == "-" and word[1:2] in SHORT:
            name, value = SHORT[word[1]], word[2:]
        else:
            sys.exit(f"error: {word}: not an option of DensifyPointCloud")
        if name in OF_RUN_PY:
            sys.exit(f"error: {word}: run.py needs this option of DensifyPointCloud for itself\nhint: leave it out")
        if not value and words and not words[0].startswith("--"):
            value = words.pop(0)
        options[name] = value
    return options


class Densify:
    """The program with the options of each run: those of the user replace ours, but not in what a fusion must not change."""

    def __init__(self, program, run, threads, words):
        self.program = shutil.which(program)
        if not self.program:
            sys.exit(f"error: no program {program}\nhint: name it with --densify or the variable DENSIFY")
        answer = subprocess.run([self.program, "--help"], cwd=HERE, capture_output=True, text=True, errors="replace", check=False)
        self.known = answer.stdout + answer.stderr
        wanted = {"resolution-level": "0", "min-resolution": "16", "max-resolution": str(run["resolution"])}
        self.of_maps = {"number-views": "0", "geometric-iters": "0", "postprocess-dmaps": "3"}
        names = {*re.findall(r"--([a-z][a-z-]+)", self.known), *wanted, *self.of_maps, *OF_THE_CLOUD, *OF_THE_MACHINE, *OF_RUN_PY, *SHORT.values(), "dense-config-file"}
        # Nothing is to be cut off or made up around the sparse points.
        wanted.update({option: "0" for option in ("estimate-roi", "crop-to-roi", "tower-mode") if f"--{option}" in self.known})
        self.users = users_options(words, names)
        self.common = {"dense-config-file": "dense.cfg", "verbosity": "1", **({"max-threads": str(threads)} if threads else {}), **wanted}
        shaping = {name: self.users[name] for name in sorted(self.users) if name not in OF_THE_CLOUD | OF_THE_MACHINE}
        self.of_full_size = {**wanted, **shaping}
        self.options = in_words(self.of_full_size)
        found = os.stat(self.program)
        self.identity = f"{os.path.realpath(self.program)} {found.st_size} {found.st_mtime_ns}"
        self.kinds = {}  # of the maps of each program that made one here
        with contextlib.suppress(ValueError, AttributeError, RecursionError):
            self.kinds = {name: kind for name, kind in json.loads(read_record(KINDS_NOTED)).items() if kind in ("DR", "D2")}

    def note_kind(self, kind):
        if self.kinds.get(self.identity) != kind:
            self.kinds[self.identity] = kind
            write_whole(KINDS_NOTED, self.kinds)

    def refuse_other_kinds(self, but=None):
        """Ends where a map is of another kind than those of this program, as far as that is known: it could not fuse it. `but`: a map that is to be replaced."""
        own = self.kinds.get(self.identity)
        for path in sorted(HERE.glob("depth*.dmap")):
            other = kind_of(path) if own and path != but and re.fullmatch(r"depth\d+\.dmap", path.name) else own
            if other != own:
                sys.exit(
                    f"error: {self.program} writes maps of kind {own} and reads no others, but {path.name} is of kind {ascii(other)[1:-1]}\n"
                    f"hint: name the version that made it with --densify, or move the depth*.dmap away to compute all of them again"
                )

    def options_of(self, row):
        """What shapes the map of a row, in words: the options of all with its own resolution."""
        return in_words({**self.of_full_size, "max-resolution": self.resolution_of(row)})

    def resolution_of(self, row):
        full = self.of_full_size["max-resolution"]
        scale = row.get("scale", 1)
        return full if scale == 1 or not full.isdigit() else str(round(int(full) * scale))

    def size_of(self, size):
        """Width and height at which images of this size are matched at full size, by the rule of TImage::computeMaxResolution."""
        level, least, most = (int(self.of_full_size[f"{name}"]) for name in ("resolution-level", "min-resolution", "max-resolution"))
        side = max(size)
        while level and side >> level < least:
            level -= 1
        scale = min(side >> level, most) / side
        return [round(length * scale) for length in size]

    def make_map(self, folder, row):
        # No geometric passes: the partners have no maps. Filter 3: speckles and gaps, without the one that needs partners' maps.
        users = {name: value for name, value in self.users.items() if name not in OF_THE_CLOUD}
        options = {**self.common, **self.of_maps, **users, "max-resolution": self.resolution_of(row), "fusion-mode": "1"}
        return self.run(folder, row["scene"], f"{folder.name}.mvs", options)

    def fuse(self, folder, scene, output, agree):
        # v2.4.0 and develop would take filter 2, which joins five pixels or none: few of those that the plan foretells, from few maps.
        ours = {"fusion-filter": "0" if agree in ("0", "1") else "1"} if "--fusion-filter" in self.known else {}
        kept = {"view-neighbors-file": "fuse.txt", "number-views": "0", "geometric-iters": "0", "postprocess-dmaps": "0"}
        return self.run(folder, scene, output, {**self.common, "number-views-fuse": agree, **ours, **self.users, **kept})

    def run(self, folder, scene, output, options):
        # Image names, maps and the files of options are resolved against the folder, and logs are written into it.
        options = {name: str(HERE / value) if value.startswith("..") else value for name, value in options.items()}
        command = [self.program, "-w", str(folder), "-i", scene, "-o", output, *in_words(options)]
        done = subprocess.run(command, cwd=HERE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", check=False)
        for log in HERE.glob("DensifyPointCloud-*.log"):
            with contextlib.suppress(FileNotFoundError):  # another run was faster
                log.unlink()
        refused = next((line for line in lines_of(done) if done.returncode != 0 and "option '" in line), None)
        if refused:
            sys.exit(f"error: DensifyPointCloud refuses the options: {refused}")
        return done


def in_words(options):
    return [word for name, value in options.items() for word in (f"--{name}", value) if word]


def map_of(row):
    return HERE / f"depth{row['id']:04d}.dmap"


def digest_of(row, program):
    """SHA-256 of everything that determines a map: its scene and the options."""
    return hashlib.sha256((HERE / row["scene"]).read_bytes() + repr(program.options_of(row)).encode()).hexdigest()


def compute(row, program, report):
    report.settle(row)
    digest = digest_of(row, program)
    if report.is_good(row, digest):
        return
    started = time.monotonic()
    with workplace(f"{row['id']:04d}") as folder:
        done = program.make_map(folder, row)
        made = folder / map_of(row).name
        try:
            found = check(row, made)
        except Newer as error:
            if not map_of(row).exists():  # for a viewrank that reads it
                made.replace(map_of(row))
            sys.exit(f"error: {made.name}: {error}\nhint: use a newer viewrank, or OpenMVS v2.0 to v2.4.0")
        result = {"rank": row["rank"], "key": row["key"], "digest": digest, "seconds": round(time.monotonic() - started, 2), **found}
        if not result["problems"]:
            program.note_kind(result["kind"])
            program.refuse_other_kinds(map_of(row))
            write_whole(folder / "row.json", result)
            report.settle(row, folder)
            return
        if done.returncode != 0 or not made.exists():
            result["problems"].append(last_words(done))
        report.add(row, result)
        if is_whole(made, row["size"]) and not map_of(row).exists():  # to be looked at
            made.replace(map_of(row))


@contextlib.contextmanager
def workplace(name):
    """A folder in which all that is here is linked except what is written there, and options that somebody else left for the program. It goes again, unless a finished map waits there for its place."""
    make_folder(UNFINISHED)
    folder = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=UNFINISHED))
    try:
        for path in HERE.iterdir():
            if path != UNFINISHED and not re.match(r"depth\d+\.|fusing|DensifyPointCloud\.cfg$", path.name):
                (folder / path.name).symlink_to(path, target_is_directory=path.is_dir())
        yield folder
    finally:
        if not (folder / "row.json").exists():
            shutil.rmtree(folder, ignore_errors=True)


def lines_of(done):
    """Lines of the program's log, without time and component."""
    return [line.split("] ", 1)[-1].strip() for line in done.stdout.splitlines() if line.strip() and "Command line:" not in line]


def last_words(done):
    """Exit code of the program with its first error lines, else its last lines."""
    lines = lines_of(done)
    errors = [line for line in lines if line.startswith("error")]
    return " | ".join([f"DensifyPointCloud ended with {done.returncode}", *(errors[:3] or lines[-3:])])


def check(row, path):
    """Result for a key view."""
    if not path.exists():
        return {"problems": ["no depth map"], "partner_ids": [], "filled": 0.0}
    try:
        found = read_map(path, row["size"])
    except Newer:
        raise
    except (OSError, struct.error, ValueError) as error:
        return {"problems": [f"unreadable depth map: {error}"], "partner_ids": [], "filled": 0.0}
    problems = []
    key, *partners = found["ids"] or [None]
    if key != row["id"]:
        problems.append(f"the map is of image {key}, not of {row['id']}")
    if sorted(partners) != sorted(row["partner_ids"]):
        problems.append(f"partners {sorted(partners)} instead of {sorted(row['partner_ids'])}")
    least, greatest = row["depths"]
    if not (0.8 * least <= found["range"][0] <= least * 1.001 and greatest * 0.999 <= found["range"][1] <= 1.25 * greatest):
        problems.append(f"depth range {found['range'][0]:g} to {found['range'][1]:g}, but the sparse points have {least:g} to {greatest:g}")
    if found["filled"] < FILLED_LEAST:
        problems.append(f"only {100 * found['filled']:.1f} % of the pixels have a depth")
    own = {name: found[name] for name in ("kind", "range", "size")}
    return {"problems": problems, "scale": row.get("scale", 1), "partner_ids": partners, "filled": round(found["filled"], 4), **own}


class Newer(ValueError):
    """A map of a kind that came after this script."""


def read_map(path, most):
    """Head of a .dmap and the share of its pixels that have a depth."""
    with open(path, "rb") as file:
        head = read_head(file, most)
        width, height = head["size"]
        filled = 0
        for _ in range(height):
            if head["kind"] == "DR":
                filled += sum(1 for depth in memoryview(file.read(4 * width)).cast("f") if depth > 0)
            else:  # bits of a half that is above 0 and finite
                filled += sum(1 for half in memoryview(file.read(2 * width)).cast("H") if 0 < half < 0x7C00)
    return {**head, "filled": filled / max(1, width * height)}


def read_head(file, most):
    """Head of a .dmap that is whole and not larger than `most`, width and height; ValueError and struct.error otherwise."""
    head = file.read(28)
    kind, bits = head[:2], head[2] if len(head) > 2 else 1
    # Each bit of the type of DR is a plane; D2 also has bits that say how it was made.
    if kind not in KINDS and any(kind) or kind == b"DR" and bits > 15:
        raise Newer(f"a depth map of kind {ascii(kind)[2:-1]} and type {bits}, which is newer than this run.py")
    if kind not in KINDS:
        raise ValueError("it does not begin with DR or D2")
    length, widths = KINDS[kind]
    planes = sum(width for bit, width in zip((1, 2, 4, 8), widths) if bits & bit)
    width, height, least, greatest = struct.unpack_from("<2I2f", head, 12)
    file.read(length - 28)
    (length,) = struct.unpack("<H", file.read(2))
    file.read(length)
    (count,) = struct.unpack("<I", file.read(4))
    if count > 1 << 16:
        raise ValueError(f"{count} images")
    ids = struct.unpack(f"<{count}I", file.read(4 * count))
    file.read(21 * 8)
    if not (width and height and bits & 1):
        raise ValueError("no depths")
    wide, high = (side + 1 for side in most)  # programs round up
    if max(width, height) > max(wide, high) or width * height > wide * high:
        raise ValueError(f"{width} x {height} pixels, more than the image has")
    if file.tell() + planes * width * height > os.fstat(file.fileno()).st_size:
        raise ValueError("cut off")
    return {"bytes": planes * width * height, "kind": kind.decode(), "ids": list(ids), "range": [round(least, 6), round(greatest, 6)], "size": [width, height]}


def kind_of(path):
    with open(path, "rb") as file:
        return file.read(2).decode("ascii", "replace")


def enlarged(path, size):
    """Bytes of a .dmap with each pixel repeated to a larger size. Its confidences fall as those of a match do whose deviation is twice as large, so that fusion averages finer maps
    with four times the weight."""
    with open(path, "rb") as file:
        head = read_head(file, size)
        start, planes = file.tell(), file.read(head["bytes"])
    (width, height), (wide, high) = head["size"], size
    columns = [min(x * width // wide, width - 1) for x in range(wide)]
    rows = [min(y * height // high, height - 1) for y in range(high)]
    with open(path, "rb") as file:
        before = bytearray(file.read(start))
    struct.pack_into("<4I", before, 4, wide, high, wide, high)
    k = struct.unpack_from("<9d", before, start - 168)
    sx, sy = wide / width, high / height
    k = [k[0] * sx, k[1] * sx, (k[2] + 0.5) * sx - 0.5, k[3], k[4] * sy, (k[5] + 0.5) * sy - 0.5, *k[6:]]
    struct.pack_into("<9d", before, start - 168, *k)
    parts, at = [bytes(before)], 0
    for bit, pixel in zip((1, 2, 4, 8), KINDS[bytes(before[:2])][1]):
        if before[2] & bit:
            plane = planes[at : at + pixel * width * height]
            at += len(plane)
            if bit == 4:
                plane = of_doubled_deviation(plane, before)
            unit, words = ({1: "B", 2: "H"}.get(pixel, "I"), max(1, pixel // 4))
            taken = [words * x + word for x in columns for word in range(words)]
            lines = (array.array(unit, plane[pixel * width * y : pixel * width * (y + 1)]) for y in range(height))
            lines = [array.array(unit, [line[x] for x in taken]).tobytes() for line in lines]
            parts += [lines[y] for y in rows]
    return b"".join(parts)


def of_doubled_deviation(plane, head):
    """The plane of confidences c with 1 - 4 (1 - c) in their place."""
    lowered = lambda c: max(0.0, 1 - 4 * (1 - c)) if c > 0 else c
    if head[:2] == b"DR":
        return array.array("f", map(lowered, array.array("f", plane))).tobytes()
    (greatest,) = struct.unpack_from("<f", head, 28)
    unit = greatest / 255 if greatest > 0 else 1
    return plane.translate(bytes(min(255, round(lowered(byte * unit) / unit)) for byte in range(256)))


def is_whole(path, most):
    try:
        with open(path, "rb") as file:
            read_head(file, most)
    except (OSError, struct.error, ValueError):
        return False
    return True


def is_row(row):
    """Is it a row of a report, which may be anybody's?"""
    kinds = {"key": str, "digest": str, "rank": int, "problems": list, "filled": (int, float), "seconds": (int, float)}
    if not isinstance(row, dict) or not all(isinstance(row.get(name), kind) for name, kind in kinds.items()):
        return False
    if not all(abs(row[name]) < 1e9 for name in ("rank", "filled", "seconds")):  # nor is one a number for which there is no float
        return False
    return all(isinstance(problem, str) for problem in row["problems"]) and ("before" not in row or is_row(row["before"]))


class Report:
    """report.json: a row per key view that was tried, and the fusion; `older`: rows of other plans or options, whose maps may fit again; `before` in a row: that of the map
    that is still there, because what came out in its place was not as planned.

    Runs of single ranks go on side by side, on several machines: each writes its row into rows/, and the next whole run joins these."""

    def __init__(self, options):
        self.path = HERE / "report.json"
        self.rows = {}
        for path in (self.path, *sorted((HERE / "rows").glob("*.json"))):
            with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
                found = json.loads(read_record(path))
                self.rows.update({row["key"]: row for row in [*found.get("older", []), *found["clusters"]] if is_row(row)})
        self.older = []
        self.options = options
        self.fusion = None
        self.single = False

    def has(self, row, digest):
        """Was it tried, with this scene and these options? The row of the map that is there counts where the last try was another."""
        found = self.rows.get(row["key"], {})
        if found.get("digest") != digest and found.get("before", {}).get("digest") == digest:
            found = self.rows[row["key"]] = found["before"]
        return found.get("digest") == digest

    def is_good(self, row, digest):
        """Is its map there, whole and as planned?"""
        return self.has(row, digest) and not self.rows[row["key"]]["problems"] and is_whole(map_of(row), row["size"])

    def settle(self, row, checked=None):
        """Puts a map that is finished in its place and notes its row; also where the run that made it was killed in between. What is not as planned stays where it is, as the
        folder may be a stranger's. `checked`: the folder of a map that is known to be as planned."""
        for note in UNFINISHED.glob(f"{row['id']:04d}-*/row.json"):
            made = note.parent / map_of(row).name
            if made.is_symlink():
                sys.exit(f"error: {ascii(str(note.parent))}: not made by this script; move it away")
            with contextlib.suppress(FileNotFoundError, ValueError, RecursionError):  # another run was faster; not a row
                result = json.loads(read_record(note))
                if not is_row(result) or result["key"] != row["key"]:
                    continue
                if note.parent != checked and check(row, made if made.exists() else map_of(row))["problems"]:
                    continue
                with contextlib.suppress(FileNotFoundError):
                    made.replace(map_of(row))
                self.add(row, result)
                note.unlink()
            for left in UNFINISHED.glob(f"{row['id']:04d}-*"):
                shutil.rmtree(left, ignore_errors=True)

    def add(self, row, result):
        last = self.rows.get(result["key"], {})
        before = last.get("before") or (last if last and not last["problems"] else None)
        if result["problems"] and before and map_of(row).exists():
            result["before"] = before
        self.rows[result["key"]] = result
        if self.single:  # report.json is not ours alone; this row counts more than one there
            self.write_rows(self.path_of(row), [result])
        else:
            self.write()
            with contextlib.suppress(FileNotFoundError):
                self.path_of(row).unlink()
        state = "; ".join(result["problems"]) or f"{100 * result['filled']:.0f} % filled, partners as planned"
        say(f"{result['rank']:4d} {result['key']}: {state} ({result['seconds']:.0f} s)")

    def write(self):
        self.write_rows(self.path, sorted(self.rows.values(), key=lambda row: row["rank"]))

    def path_of(self, row):
        return HERE / "rows" / f"{row['id']:04d}.json"

    def write_rows(self, path, rows):
        write_whole(path, {"options": self.options, "clusters": rows, "older": [] if self.single else self.older, "fusion": self.fusion})

    def finish(self, clusters, program):
        """Rows of this plan and these options only; says how many are as planned; True where one isn't."""
        tried = [row for row in clusters if row["key"] in self.rows]
        present = {row["key"]: row["rank"] for row in tried if self.has(row, digest_of(row, program))}
        self.older = [row for key, row in self.rows.items() if key not in present]
        self.rows = {key: {**self.rows[key], "rank": rank} for key, rank in present.items()}
        self.write()
        if len(present) < len(tried):
            left_out = ", ".join(row["key"] for row in tried if row["key"] not in self.rows)
            say(f"left out, their maps were made for another plan or with other options, or are not finished: {left_out}")
        wrong = [row for row in self.rows.values() if row["problems"]]
        say(f"{len(self.rows)} of {len(clusters)} key views tried, {len(self.rows) - len(wrong)} as planned")
        return bool(wrong)


def fuse(run, program, report):
    """Joins the maps that are as planned; each is compared with those of the key views that overlap it. One whose image cannot be read is left out."""
    rows = run["clusters"]
    there = {i for i, row in enumerate(rows) if report.is_good(row, digest_of(row, program))}
    problems = []
    kinds = sorted({kind_of(map_of(rows[i])) for i in there})
    if len(kinds) > 1:
        say(f"nothing is fused: maps of the kinds {' and '.join(kinds)}, and OpenMVS reads only those of the kind that it writes: move the others away")
        return False
    while there:
        agree = program.users.get("number-views-fuse") or str(min(run["maps_per_point"], len(there)))
        done, points = fuse_maps(run, there, agree, program)
        if points:
            break
        unread = re.search(r"failed reloading image '.*?/(images/.+)'", done.stdout)
        broken = {i for i in there if unread and rows[i]["image"] == unread[1]}
        problems += [f"{rows[i]['key']}: its image cannot be read" for i in broken] or [f"{last_words(done)} (the maps are of kind {kinds[0]}: OpenMVS reads only maps of the kind that it writes)"]
        there = there - broken if broken else set()
    if not there:
        say("; ".join([*problems, "nothing is fused" if problems else "nothing to fuse"]))
    else:
        report.fusion = {"maps": len(there), "agreeing": int(agree), "points": points, "problems": problems}
        report.write()
        say("; ".join([*problems, f"{len(there)} maps fused: {points} points in {HERE / 'fused.ply'}"]))
    return bool(there) and not problems


def fuse_maps(run, there, agree, program):
    """Exit status of the program, and the number of points of the new fused.ply; with none, the earlier files stay."""
    # A list must not be empty: a map that none overlaps is compared with any image of the scene.
    partners = {i: [o for o in run["overlaps"][i] if o in there][: run["fused_with"]] or sorted(there - {i})[:1] or [int(i == 0)] for i in there}
    write_new(HERE / "fuse.txt", "".join(" ".join(map(str, [i, *partners[i]])) + "\n" for i in sorted(there)))
    for left in UNFINISHED.glob("fusion-*"):  # by a run that was killed
        shutil.rmtree(left, ignore_errors=True)
    with workplace("fusion") as folder:
        (folder / "fusing.mvs").write_bytes(fusion_scene(run["clusters"], there))
        for row in (run["clusters"][i] for i in there):
            path = map_of(row)
            if row.get("scale", 1) == 1:
                (folder / path.name).symlink_to(path)
            else:
                # The fusion takes the camera of its own image size for every map, whatever the size of the map.
                (folder / path.name).write_bytes(enlarged(path, program.size_of(row["size"])))
        done = program.fuse(folder, "fusing.mvs", "fusing-done.mvs", agree)
        points = ply_points(folder / "fusing-done.ply") if done.returncode == 0 else 0
        for made in folder.glob("fusing-done.*"):
            if points:
                made.replace(HERE / f"fused{made.suffix}")
    return done, points


def fusion_scene(rows, there):
    """fuse.mvs, in which the images of key views that take no part have no pose: one that is missing or broken keeps no others from being fused, and none costs memory."""
    scene = bytearray((HERE / "fuse.mvs").read_bytes())
    for i, row in enumerate(rows):
        if i not in there:
            name = row["image"].encode()
            entry = struct.pack("<Q", len(name)) + name + struct.pack("<Q", 0)  # the name, no mask; platform, camera and pose follow
            struct.pack_into("<I", scene, scene.index(entry) + len(entry) + 8, NO_POSE)
    return scene


def write_whole(path, content):
    make_folder(path.parent)
    draft = path.with_suffix(f".{os.getpid()}.tmp")
    try:
        write_new(draft, json.dumps(content, indent=1) + "\n")
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def make_folder(path):
    if path.is_symlink():
        sys.exit(f"error: {path}: a symbolic link in place of a folder of run.py's\nhint: move it away")
    path.mkdir(exist_ok=True)


def write_new(path, text):
    """Writes a file in the place of what was there: a stranger's link is not followed."""
    path.unlink(missing_ok=True)
    with open(path, "x", encoding="utf-8") as file:
        file.write(text)


def ply_points(path):
    try:
        with open(path, "rb") as file:
            match = re.search(rb"element vertex (\d+)", file.read(2000))
    except OSError:
        return 0
    return int(match[1]) if match else 0


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted; finished maps stay, run again to go on")
    except OSError as error:
        where = f"{ascii(os.fsdecode(error.filename))}: " if isinstance(error.filename, (str, bytes, os.PathLike)) else ""
        sys.exit(f"error: {where}{error.strerror or error}\nhint: finished maps stay, run again to go on")
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, struct.error) as error:
        sys.exit(f"error: a file here is not what viewrank or run.py wrote ({type(error).__name__}: {error})\nhint: export again")
