#!/usr/bin/env python3
"""Depth maps of the view clusters that viewrank chose, by semi-global matching on one CPU. README.md says what is read and written.

    sgm.py match WORKSPACE --out DIR                       the clusters of WORKSPACE/viewrank/clusters.txt, in rank order
    sgm.py match WORKSPACE --out DIR --clusters manifest.json --stop-at 2h
    sgm.py match WORKSPACE --out DIR --rank 7              the seventh cluster alone; many such runs may go on side by side
    sgm.py match WORKSPACE --out DIR --connected 22        every view with the 22 views that share most sparse points
    sgm.py pairs WORKSPACE --cache DIR --connected 22      only fill the cache of pairs
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


if __name__ in ("__main__", "__mp_main__"):
    sys.stdout, sys.stderr = Printable(sys.stdout), Printable(sys.stderr)
    sys.excepthook = explain
    # This folder and the current one may be a stranger's: a json.py that he put there is not imported.
    sys.path[:] = [path for path in sys.path if os.path.realpath(path) not in (os.path.dirname(os.path.realpath(__file__)), os.path.realpath(os.curdir))]

HERE = os.path.dirname(os.path.realpath(__file__))

import argparse
import concurrent.futures
import contextlib
import json
import multiprocessing
import re
import signal
import tempfile
import time
import types
from pathlib import Path


def read_module(name):
    """Imports a module that lies here from its source, whatever lies here compiled."""
    if name not in sys.modules:
        path = Path(HERE, f"{name}.py")
        module = sys.modules[name] = types.ModuleType(name)
        exec(compile(path.read_text(encoding="utf-8"), path, "exec"), module.__dict__)


try:
    for name in ("workspace", "rectify", "matching", "merge", "pairs", "fuse"):
        read_module(name)
except ModuleNotFoundError as error:
    sys.exit(f"error: {error}; pip install numpy opencv-python-headless")

import cv2
import numpy as np

from fuse import fuse
from merge import MIN_AGREE, SIGMA_PX, merge
from pairs import VERSION, Pairs, made_of, write_whole
from workspace import InputError, Workspace, read_record, refuse_links

MAX_PARTNERS = 255  # counts are 8 bit
MANIFEST_VERSION = 2  # of manifest.json; the fields of others may mean something else


# ------------------------------------------------------------------------------------------------------------ clusters


def read_clusters(path, workspace):
    """[(key view, partners, size)] in rank order from clusters.txt, with the sizes of sizes.txt beside it, or from a manifest up to its cut."""
    try:
        text = read_record(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}. Write it with: viewrank plan {workspace.folder}") from error
    rows, sizes = manifest_clusters(path, text, workspace) if path.suffix == ".json" else (tabbed_rows(text), sizes_beside(path))
    clusters, places = [], {}
    for place, (key, *partners) in rows:
        check_cluster(f"{path}, {place}", key, partners, workspace)
        if key in places:
            raise InputError(f"{path}, {place}: key view {key} is already in {places[key]}")
        places[key] = place
        clusters.append((key, partners, sizes.get(key, 1.0)))
    if not clusters:
        raise InputError(f"{path}: no view cluster in it")
    return clusters


def tabbed_rows(text):
    for number, line in enumerate(text.split("\n"), 1):
        line = line.rstrip("\r")
        if line.strip() and not line.startswith("#"):
            yield f"line {number}", line.split("\t")


def manifest_clusters(path, text, workspace):
    """Rows as of tabbed_rows up to the manifest's cut, and the size of each key view."""
    try:
        manifest = json.loads(text)
        if manifest["version"] != MANIFEST_VERSION:
            raise InputError(f"{path}: written by another version of viewrank. Plan again: viewrank plan {workspace.folder}")
        clusters = manifest["clusters"][: manifest["cut"]["clusters"]]
        rows = [(f"rank {c['rank']}", [c["key"], *c["partners"]]) for c in clusters]
        return rows, {c["key"]: c.get("scale", 1.0) for c in clusters}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: not a manifest of viewrank ({error!r})") from error


def sizes_beside(path):
    """Size over that of the others, by key view; those that are not in sizes.txt have 1."""
    try:
        text = read_record(path.with_name("sizes.txt"))
    except OSError:
        return {}
    try:
        return {key: float(size) for _, (key, size) in tabbed_rows(text)}
    except ValueError as error:
        raise InputError(f"{path.with_name('sizes.txt')}: a line is not a key view, a tab and a size ({error})") from error


def check_cluster(where, key, partners, workspace):
    for name in (key, *partners):
        if name not in workspace.views:
            raise InputError(f"{where}: view {name} is not in {workspace.folder}. Were the clusters planned for another model?")
    if key in partners or len(set(partners)) < len(partners):
        raise InputError(f"{where}: {key} has a partner twice, or is its own partner")
    if len(partners) > MAX_PARTNERS:
        raise InputError(f"{where}: {len(partners)} partners, more than {MAX_PARTNERS}")


def wanted(args, workspace):
    if args.connected:
        return [(key, [name for name, _ in workspace.connected(key)[: args.connected]], 1.0) for key in workspace.views]
    return read_clusters(args.clusters or workspace.folder / "viewrank" / "clusters.txt", workspace)


# ---------------------------------------------------------------------------------------------------------- one cluster


def compute(pairs, key, partners, size, out):
    """Matches and merges one view cluster, writes its maps if `out` is given, and returns its row of the report.

    Without the key view's image nothing is written, and the row is {"key", "failed": reason}."""
    start = time.perf_counter()
    try:
        found = [pairs.get(key, partner) for partner in partners]
    except InputError as error:
        return {"key": key, "failed": str(error)}
    usable = [pair for pair in found if pair.matched]
    width, height = pairs.workspace.views[key].size
    row = {"key": key, "width": width, "height": height, "size": size, "made_of": made_of(pairs.workspace, key, partners), "partners": [partner_row(*p) for p in zip(partners, found, strict=True)]}
    if out:
        depth, count = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
        if len(usable) >= MIN_AGREE:
            depth, count = merge([p.inverse() for p in usable], [p.deviation() for p in usable])
        for folder, array in (("counts", count), ("depth_maps", depth)):
            write_whole(out / folder / (key + ".npy"), lambda file, array=array: np.save(file, array))
        row["measured"] = round(float((depth > 0).mean()), 4)
    row["seconds"] = round(time.perf_counter() - start, 3)
    return row


def partner_row(name, pair):
    row = {"name": name, "matched": pair.matched}
    row |= {"share": round(pair.share, 4)} if row["matched"] else {"refused": pair.refused}
    if np.isfinite(pair.angle):
        row |= {"angle": round(pair.angle, 2), "octaves": round(pair.octaves, 2)}
    return row | {"seconds": round(pair.seconds, 3), "cached": pair.cached}


# --------------------------------------------------------------------------------------------------------------- report


def is_row(row):
    """Is it the row of a finished key view? A report may be anybody's."""
    number, partners = (int, float), row.get("partners")
    if not isinstance(row.get("measured"), number) or not isinstance(partners, list):
        return False
    partner_kinds = {"name": str, "matched": bool, "seconds": number}
    has_kinds = all(isinstance(p, dict) and all(isinstance(p.get(name), kind) for name, kind in partner_kinds.items()) for p in partners)
    return has_kinds and all(p["matched"] or isinstance(p.get("refused"), str) for p in partners)


class Report:
    """OUT/report.json, written anew every two seconds and at the end. A key view is in it only while its maps are whole and belong to its row.

    Runs of single ranks go on side by side, on several machines: each writes OUT/rows/KEY.json, and the next run of a list joins these."""

    def __init__(self, out, settings, kept, single=False):
        """`kept`: key views whose maps the plan stands around."""
        self.path, self.out, self.settings, self.rows, self.stopped, self.single = out / "report.json", out, settings, {}, "", single
        self.kept, self.before = kept, {}
        for path in (self.path, *sorted((out / "rows").rglob("*.json"))):
            try:
                old = json.loads(read_record(path))
                if old["settings"] == settings:
                    self.rows |= {row["key"]: row for row in old["clusters"]}
                    self.rows = {key: row for key, row in self.rows.items() if is_row(row)}  # others are being computed
            except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
                pass

    def finished(self, key, partners, size, made):
        """Are its maps there, made with these partners, and of views that lie where they do now or in a plan that stands around them?"""
        row = self.rows.get(key)
        there = all((self.out / folder / (key + ".npy")).is_file() for folder in ("depth_maps", "counts"))
        same = row is not None and [p["name"] for p in row["partners"]] == partners
        same = same and row.get("size", 1.0) == size
        return there and same and (key in self.kept or row.get("made_of") == made)

    def begin(self, keys):
        """Takes out the rows of key views whose maps are about to be replaced."""
        for key in keys:
            if key in self.rows:
                self.before[key] = self.rows.pop(key)
            if self.single:  # report.json is not ours alone; this row counts more than one there
                self.write_row({"key": key, "partners": []})
            else:
                (self.out / "rows" / (key + ".json")).unlink(missing_ok=True)
        self.write()

    def restore(self, key):
        """Puts back the row of a key view whose maps were not replaced."""
        if key in self.before:
            self.add(self.before[key])
        elif self.single:
            (self.out / "rows" / (key + ".json")).unlink(missing_ok=True)

    def add(self, row):
        self.rows[row["key"]] = row
        if self.single:
            self.write_row(row)
        elif time.time() - self.written > 2:  # a row that a crash loses is made again from the cache
            self.write()

    def write_row(self, row):
        self.write_file(self.out / "rows" / (row["key"] + ".json"), [row])

    def write(self):
        self.written = time.time()
        if not self.single:
            self.write_file(self.path, list(self.rows.values()))

    def write_file(self, path, rows):
        content = {"version": 1, "tool": "viewrank integrations/sgm", "settings": self.settings, "stopped": self.stopped, "clusters": rows}
        write_whole(path, lambda file: file.write(json.dumps(content, indent=1).encode("utf-8", "surrogateescape")))


class Marks:
    """WORKSPACE/done, which says what a finished map is made from, as `viewrank run` reads and writes it.

    Only of the maps of the export in WORKSPACE: its clusters, at its image scale, where `viewrank run` looks for them."""

    def __init__(self, args, workspace):
        self.folder, self.listed = workspace.folder / "done", {}
        if args.clusters is None or args.clusters.resolve() != (workspace.folder / "clusters.txt").resolve():
            return
        try:
            text = read_record(workspace.folder / "marks.tsv")
        except OSError:
            return
        refuse_links(self.folder)
        try:
            rows = (line.split("\t", 3) for line in text.split("\n") if line)
            lines = [(mark, made_from, float(scale), path) for mark, made_from, scale, path in rows]
        except ValueError:
            raise InputError(f"{workspace.folder / 'marks.tsv'}: not written by viewrank. Export again") from None
        if not lines:
            return
        # All maps of an export are in one folder; to look up one per line would take long for a stranger's list.
        results = lines[0][3].partition("/depth_maps/")[0]
        if (workspace.folder / results / "depth_maps").resolve() != (args.out / "depth_maps").resolve():
            return
        for mark, made_from, scale, path in lines:
            if not re.fullmatch("[0-9a-f]+", mark):  # or it would lead elsewhere
                raise InputError(f"{workspace.folder / 'marks.tsv'}: {mark} is no mark. Export again")
            folder, _, name = path.partition("/depth_maps/")
            if scale == args.image_scale and folder == results:
                self.listed[name.removesuffix(".npy")] = (mark, made_from)

    def add(self, key):
        if key in self.listed:
            mark, made_from = self.listed[key]
            write_whole(self.folder / mark, lambda file: file.write(made_from.encode() + b"\n"))

    def remove(self, key):
        if key in self.listed:
            (self.folder / self.listed[key][0]).unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------------------- the loop


class Stop:
    """When to end before all clusters are done: after a time, or when the target is reached."""

    def __init__(self, seconds, progress):
        self.seconds, self.progress, self.begin = seconds, progress, time.time()

    def reason(self):
        if self.seconds is not None and time.time() - self.begin >= self.seconds:
            return f"{self.seconds:g} s are over"
        if self.progress and target_reached(self.progress):
            return f"{self.progress} says that the target is reached"
        return ""


def parse_limit(text):
    """(clusters, seconds) of "20", "90s", "30m", "2h"; one of them is None, both without a limit."""
    if text is None:
        return None, None
    found = re.fullmatch(r"(\d+)|(\d+(?:\.\d+)?)([smh])", text)
    if not found:
        raise InputError(f"--stop-at {text}: neither a number of clusters (20) nor a time (90s, 30m, 2h)")
    return (int(found[1]), None) if found[1] else (None, float(found[2]) * {"s": 1, "m": 60, "h": 3600}[found[3]])


def target_reached(path):
    try:
        return json.loads(read_record(path)).get("target_reached") is True
    except (OSError, ValueError, AttributeError, RecursionError):
        return False


STATE = {}  # of a worker process


def start_worker(folder, scale, cache, out):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    cv2.setNumThreads(1)
    STATE.update(folder=folder, scale=scale, cache=cache, out=out, pairs={})


def work(cluster):
    size = cluster[2]
    if size not in STATE["pairs"]:
        STATE["pairs"][size] = Pairs(Workspace(STATE["folder"], STATE["scale"] * size), STATE["cache"])
    return compute(STATE["pairs"][size], *cluster, STATE["out"])


@contextlib.contextmanager
def inside(folder):
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def run(clusters, args, out, stop, done):
    """Computes clusters in order on `args.jobs` processes until `stop` says so; `done` gets the row of each. Returns why it stopped."""
    fresh = multiprocessing.get_context("spawn")  # a fork would inherit OpenCV's threads, and hang
    worker = (args.workspace.absolute(), args.image_scale, args.cache and args.cache.absolute(), out and out.absolute())
    with contextlib.ExitStack() as stack:
        # A process that Python starts looks for modules in the current folder first, which may be a stranger's.
        empty = stack.enter_context(tempfile.TemporaryDirectory())
        with inside(empty):
            pool = stack.enter_context(concurrent.futures.ProcessPoolExecutor(args.jobs, fresh, start_worker, worker))
        waiting, running, reason = iter(clusters), set(), ""
        while True:
            while len(running) < args.jobs and not reason:
                reason = stop.reason()
                cluster = None if reason else next(waiting, None)
                if cluster is None:
                    reason = reason or "all clusters done"
                    break
                with inside(empty):
                    running.add(pool.submit(work, cluster))
            if not running:
                return reason
            ready, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in ready:
                done(future.result())


def match(args):
    refuse_links(args.out)
    workspace = Workspace(args.workspace, args.image_scale)
    first, seconds = parse_limit(args.stop_at)
    all_clusters = wanted(args, workspace)
    clusters = of_rank(all_clusters, args.rank) if args.rank is not None else all_clusters[:first]
    settings = {"version": VERSION, "image_scale": args.image_scale, "sigma_px": SIGMA_PX, "min_agree": MIN_AGREE}
    report = Report(args.out, settings, kept_by_plan(workspace), single=args.rank is not None)
    sizes = {size: Workspace(args.workspace, args.image_scale * size) for size in {size for *_, size in clusters}}
    marks = Marks(args, workspace)
    todo = []
    for cluster in clusters:
        made = made_of(sizes[cluster[2]], *cluster[:2])
        if not report.finished(*cluster, made):
            marks.remove(cluster[0])
            todo.append(cluster)
        elif report.rows[cluster[0]].get("made_of") == made:
            marks.add(cluster[0])
    report.begin(key for key, *_ in todo)
    print(f"{len(clusters)} key views, {len(clusters) - len(todo)} finished before; {sum(len(p) for _, p, _ in todo)} pairs to do", file=sys.stderr)
    line = Line(len(todo))

    def done(row):
        if "failed" in row:
            report.restore(row["key"])
        else:
            report.add(row)
            marks.add(row["key"])
        line.step(row)

    report.stopped = "interrupted"
    try:
        report.stopped = run(todo, args, args.out, Stop(seconds, args.progress), done)
    finally:
        report.write()
    print(summary(report, [key for key, *_ in all_clusters]), file=sys.stderr)
    return line.failure()


def kept_by_plan(workspace):
    """Key views whose depth maps the plan stands around: those of views that hardly moved since they were made are as good as new ones."""
    try:
        is_export = (workspace.folder / "export.json").is_file()  # the manifest is in the folder above
        folder = workspace.folder.absolute().parent if is_export else workspace.folder / "viewrank"
        manifest = json.loads(read_record(folder / "manifest.json"))
        return {cluster["key"] for cluster in manifest["clusters"] if cluster["finished"] and manifest["version"] == MANIFEST_VERSION}
    except (OSError, InputError, ValueError, KeyError, TypeError, RecursionError):
        return set()


def of_rank(clusters, rank):
    if not 1 <= rank <= len(clusters):
        raise InputError(f"--rank {rank}: the clusters have the ranks 1 to {len(clusters)}")
    return clusters[rank - 1 : rank]


def fill(args):
    workspace = Workspace(args.workspace, args.image_scale)
    clusters = wanted(args, workspace)
    line = Line(len(clusters))
    run(clusters, args, None, Stop(None, None), line.step)
    return line.failure()


def join(args):
    refuse_links(args.out)
    workspace = Workspace(args.workspace, args.image_scale)
    clusters = wanted(args, workspace)
    maps, points = fuse({size: Workspace(args.workspace, args.image_scale * size) for size in {1.0} | {size for *_, size in clusters}}, clusters, args.out)
    print(f"{maps} depth maps, {points:,} points: {args.out / 'fused.ply'}", file=sys.stderr)
    return ""


def interrupt(*_):
    raise KeyboardInterrupt


class Line:
    """A line of progress every ten seconds, and at the end; one for each key view that failed, if there are several to do."""

    def __init__(self, total):
        self.total, self.count, self.failed, self.begin, self.last = total, 0, [], time.time(), 0.0

    def step(self, row):
        self.count += 1
        now = time.time()
        if "failed" in row:
            self.failed.append(row["failed"])
            if self.total > 1:
                print(f"error: no depth map of {row['key']}: {row['failed']}", file=sys.stderr, flush=True)
        if now - self.last > 10 or self.count == self.total:
            self.last = now
            left = (now - self.begin) / self.count * (self.total - self.count)
            print(f"{self.count}/{self.total} key views, {now - self.begin:.0f} s, {left:.0f} s left; last: {row['key']}", file=sys.stderr, flush=True)

    def failure(self):
        """What went wrong in all; empty if nothing did."""
        if self.failed and self.total == 1:
            return self.failed[0]
        return f"{len(self.failed)} of {self.total} key views failed; maps that they had before stay" if self.failed else ""


def summary(report, keys):
    rows = [report.rows[key] for key in keys if key in report.rows]
    partners = [p for row in rows for p in row["partners"]]
    matched = [p for p in partners if p["matched"]]
    text = f"{len(rows)} of {len(keys)} maps are there ({report.stopped}); {len(matched)} of {len(partners)} pairs matched"
    if matched:
        text += f", {np.mean([p['seconds'] for p in matched]):.2f} s each; {100 * np.mean([row['measured'] for row in rows]):.0f} % of the pixels have a depth"
    reasons = {}
    for p in partners:
        if not p["matched"]:
            kind = re.sub(r"\d+(\.\d+)?", "N", p["refused"])
            reasons[kind] = reasons.get(kind, 0) + 1
    return "\n".join([text] + [f"  refused {count} x: {kind}" for kind, count in sorted(reasons.items(), key=lambda r: (-r[1], r[0]))])


# ----------------------------------------------------------------------------------------------------------------- main


def arguments(argv):
    parser = argparse.ArgumentParser(prog="sgm.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, about in (("match", "depth maps of view clusters"), ("fuse", "a cloud of the maps that are there, OUT/fused.ply"), ("pairs", "only fill the cache of pairs")):
        p = commands.add_parser(name, help=about)
        p.add_argument("workspace", type=Path, help="undistorted COLMAP workspace: images/ and sparse/ or sparse/0/")
        which = p.add_mutually_exclusive_group()
        which.add_argument("--clusters", type=Path, metavar="FILE", help="clusters.txt or manifest.json (default WORKSPACE/viewrank/clusters.txt)")
        which.add_argument("--connected", type=int, metavar="N", help="every view with the N views that share most sparse points")
        p.add_argument("--cache", type=Path, metavar="DIR", required=name == "pairs", help="keep the maps of single pairs here, and reuse them")
        p.add_argument("--image-scale", type=float, default=1.0, metavar="S", help="size of the matched images over the model's (default 1)")
        p.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default 1)")
        if name != "pairs":
            p.add_argument("--out", type=Path, metavar="DIR", required=True)
        if name == "match":
            p.add_argument("--rank", type=int, metavar="N", help="the N-th cluster alone (for queues)")
            p.add_argument("--stop-at", metavar="N|TIME", help="end after the first N clusters, or start none after a time (90s, 30m, 2h)")
            p.add_argument("--progress", type=Path, metavar="FILE", help="end when this JSON file says \"target_reached\": true")
    args = parser.parse_args(argv)
    if not 0 < args.image_scale <= 1 or args.jobs < 1 or (args.connected is not None and not 1 <= args.connected <= MAX_PARTNERS):
        parser.error(f"--image-scale is above 0 and up to 1, --jobs at least 1, --connected 1 to {MAX_PARTNERS}")
    return args


def main(argv=None):
    args = arguments(argv)
    signal.signal(signal.SIGTERM, interrupt)  # or the workers would outlive us
    try:
        failure = {"match": match, "fuse": join, "pairs": fill}[args.command](args)
    except InputError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted; finished maps stay, run again to go on")
    if failure:
        sys.exit(f"error: {failure}")


if __name__ == "__main__":
    main()
