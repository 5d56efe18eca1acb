#!/usr/bin/env python3
"""Computes the depth maps of viewrank's plan with OpenMVS's DensifyPointCloud, checks each of them, and fuses them.

    python3 run.py                                       all clusters, in rank order, then the fusion
    python3 run.py --stop-at 20                          the first 20 clusters
    python3 run.py --stop-at 80%                         as many as the plan foretells for 80 % of what all would give
    python3 run.py --stop-at 2h                          start no cluster after two hours
    python3 run.py --progress ../progress.json           end when that file says "target_reached": true
    python3 run.py --no-fusion                           only the depth maps
    python3 run.py --rank 7                              the seventh cluster alone; many such runs may go on side by side
    python3 run.py --stop-at 0                           only the fusion
    python3 run.py -- --geometric-iters 2                options for DensifyPointCloud behind two dashes

Runs resume: a map that is there, is as planned, and whose row in report.json fits its scene and options is kept; any other is made anew and never fused. report.json says for
each key view what came out: DensifyPointCloud ends with success whatever it did, so that maps, partners and depth ranges are read from the .dmap files.
fused.ply and fused.mvs are replaced when the fusion has succeeded. Exit code 1: something is not as planned. Needs Python 3.8 and nothing else.
"""

import argparse
import contextlib
import hashlib
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
FILLED_LEAST = 0.01  # share of pixels with a depth below which a map counts as empty
NO_POSE = 0xFFFFFFFF  # DensifyPointCloud passes over such images and does not load them


def main():
    args = arguments()
    run = json.loads((HERE / "run.json").read_text(encoding="utf-8"))
    program = Densify(args.densify, run, args.threads, args.options)
    report = Report(program.options)
    if args.rank is not None:
        sys.exit(one(run["clusters"], args.rank, program, report))
    clusters_until = stop_rule(args)
    for row in run["clusters"]:
        if clusters_until(row):
            break
        compute(row, program, report)
    failed = report.finish(run["clusters"], program)
    if not args.no_fusion:
        failed |= not fuse(run, program, report)
    sys.exit(1 if failed else 0)


def one(clusters, rank, program, report):
    """Computes one cluster; 1 where it is not as planned."""
    row = next((row for row in clusters if row["rank"] == rank), None)
    if row is None:
        sys.exit(f"error: --rank {rank}: the clusters have the ranks 1 to {len(clusters)}")
    report.single = True
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
        return json.loads(path.read_text(encoding="utf-8")).get("target_reached") is True
    except (OSError, ValueError, AttributeError):
        return False


class Densify:
    """The program with the options that every run shares."""

    def __init__(self, program, run, threads, foreign):
        self.program = shutil.which(program)
        if not self.program:
            sys.exit(f"error: no program {program}\nhint: name it with --densify or the variable DENSIFY")
        answer = subprocess.run([self.program, "--help"], cwd=HERE, capture_output=True, text=True, errors="replace", check=False)
        self.known = answer.stdout + answer.stderr
        self.folder = HERE / "work"
        wanted = ["--resolution-level", "0", "--min-resolution", "16", "--max-resolution", str(run["resolution"])]
        # Nothing is to be cut off or made up around the sparse points.
        for option in ("--estimate-roi", "--crop-to-roi", "--tower-mode"):
            wanted += [option, "0"] if option in self.known else []
        self.options = wanted + foreign
        self.threads = ["--max-threads", str(threads)] if threads else []

    def run(self, scene, output, *options):
        # All in one folder: image names and maps are resolved against it, and logs are written into it.
        command = [self.program, "-w", str(HERE), "-i", str(scene), "-o", str(output), "--dense-config-file", "dense.cfg", "-v", "1"]
        command += [*self.options, *self.threads, *options]
        done = subprocess.run(command, cwd=HERE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", check=False)
        for log in HERE.glob("DensifyPointCloud-*.log"):
            with contextlib.suppress(FileNotFoundError):  # another run was faster
                log.unlink()
        return done


def map_of(row):
    return HERE / f"depth{row['id']:04d}.dmap"


def digest_of(row, program):
    """Of all that makes a map what it is: its scene and the options."""
    return hashlib.sha256((HERE / row["scene"]).read_bytes() + repr(program.options).encode()).hexdigest()


def compute(row, program, report):
    digest = digest_of(row, program)
    if report.is_good(row, digest):
        return
    report.drop(row)
    with contextlib.suppress(FileNotFoundError):
        map_of(row).unlink()
    started = time.monotonic()
    # No geometric passes: the partners have no maps. Filter 3: speckles and gaps, without the one that needs partners' maps.
    scratch = HERE / f"scratch-{row['rank']:04d}.mvs"
    done = program.run(row["scene"], scratch, "--number-views", "0", "--geometric-iters", "0", "--postprocess-dmaps", "3", "--fusion-mode", "1")
    for left in HERE.glob(f"{scratch.stem}*"):
        left.unlink()
    result = {"rank": row["rank"], "key": row["key"], "digest": digest, "seconds": round(time.monotonic() - started, 2), **check(row)}
    if result["problems"] and done.returncode != 0:
        result["problems"].append(last_words(done))
    report.add(row, result)


def last_words(done):
    """How a run of the program ended: what it calls errors, else its last lines."""
    lines = [line.split("] ", 1)[-1].strip() for line in done.stdout.splitlines() if line.strip() and "Command line:" not in line]
    errors = [line for line in lines if line.startswith("error")]
    return " | ".join([f"DensifyPointCloud ended with {done.returncode}", *(errors or lines)[-3:]])


def check(row):
    """What came out for a key view."""
    path = map_of(row)
    if not path.exists():
        return {"problems": ["no depth map"], "partner_ids": [], "filled": 0.0}
    try:
        found = read_map(path)
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
    return {"problems": problems, "partner_ids": partners, "filled": round(found["filled"], 4), "range": found["range"], "size": found["size"]}


def read_map(path):
    """Head of a .dmap and the share of its pixels that have a depth."""
    with open(path, "rb") as file:
        head = read_head(file)
        width, height = head["size"]
        filled = 0
        for _ in range(height):
            filled += sum(1 for depth in memoryview(file.read(4 * width)).cast("f") if depth > 0)
    return {**head, "filled": filled / max(1, width * height)}


def read_head(file):
    """Head of a .dmap that is whole; ValueError and struct.error otherwise."""
    head = file.read(28)
    if head[:2] != b"DR":
        raise ValueError("it does not begin with DR")
    # Planes behind each other: depths, then as the bits say normals, confidences and indices of views.
    planes = sum(size for bit, size in ((1, 4), (2, 12), (4, 4), (8, 4)) if head[2] & bit)
    width, height, least, greatest = struct.unpack_from("<2I2f", head, 12)
    (length,) = struct.unpack("<H", file.read(2))
    file.read(length)
    (count,) = struct.unpack("<I", file.read(4))
    if count > 1 << 16:
        raise ValueError(f"{count} images")
    ids = struct.unpack(f"<{count}I", file.read(4 * count))
    file.read(21 * 8)
    if file.tell() + planes * width * height > os.fstat(file.fileno()).st_size:
        raise ValueError("cut off")
    return {"ids": list(ids), "range": [round(least, 6), round(greatest, 6)], "size": [width, height]}


def is_whole(path):
    try:
        with open(path, "rb") as file:
            read_head(file)
    except (OSError, struct.error, ValueError):
        return False
    return True


class Report:
    """report.json: a row per key view that was tried, and the fusion; `older`: rows of other plans or options, whose maps may fit again.

    Runs of single ranks go on side by side, on several machines: each writes its row into rows/, and the next whole run joins these."""

    def __init__(self, options):
        self.path = HERE / "report.json"
        self.rows = {}
        for path in (self.path, *sorted((HERE / "rows").glob("*.json"))):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                found = json.loads(path.read_text(encoding="utf-8"))
                self.rows.update({row["key"]: row for row in [*found.get("older", []), *found["clusters"]]})
        self.older = []
        self.options = options
        self.fusion = None
        self.single = False

    def has(self, row, digest):
        """Was it tried, with this scene and these options?"""
        return self.rows.get(row["key"], {}).get("digest") == digest

    def is_good(self, row, digest):
        """Is its map there, whole and as planned?"""
        return self.has(row, digest) and not self.rows[row["key"]]["problems"] and is_whole(map_of(row))

    def drop(self, row):
        if self.single:  # report.json is not ours alone; this row counts more than one there
            self.write_rows(self.path_of(row), [{"rank": row["rank"], "key": row["key"], "digest": "", "problems": ["not finished"]}])
            return
        with contextlib.suppress(FileNotFoundError):
            self.path_of(row).unlink()
        if self.rows.pop(row["key"], None):
            self.write()

    def add(self, row, result):
        self.rows[result["key"]] = result
        if self.single:
            self.write_rows(self.path_of(row), [result])
        else:
            self.write()
        state = "; ".join(result["problems"]) or f"{100 * result['filled']:.0f} % filled, partners as planned"
        print(f"{result['rank']:4d} {result['key']}: {state} ({result['seconds']:.0f} s)", flush=True)

    def write(self):
        self.write_rows(self.path, sorted(self.rows.values(), key=lambda row: row["rank"]))

    def path_of(self, row):
        return HERE / "rows" / f"{row['id']:04d}.json"

    def write_rows(self, path, rows):
        path.parent.mkdir(exist_ok=True)
        text = json.dumps({"options": self.options, "clusters": rows, "older": [] if self.single else self.older, "fusion": self.fusion}, indent=1)
        whole = path.with_suffix(".tmp")
        whole.write_text(text + "\n", encoding="utf-8")
        whole.replace(path)

    def finish(self, clusters, program):
        """Rows of this plan and these options only; says how many are as planned; True where one isn't."""
        tried = [row for row in clusters if row["key"] in self.rows]
        present = {row["key"]: row["rank"] for row in tried if self.has(row, digest_of(row, program))}
        self.older = [row for key, row in self.rows.items() if key not in present]
        self.rows = {key: {**self.rows[key], "rank": rank} for key, rank in present.items()}
        self.write()
        if len(present) < len(tried):
            left_out = ", ".join(row["key"] for row in tried if row["key"] not in self.rows)
            print(f"left out, their maps were made for another plan or with other options, or are not finished: {left_out}", flush=True)
        wrong = [row for row in self.rows.values() if row["problems"]]
        print(f"{len(self.rows)} of {len(clusters)} key views tried, {len(self.rows) - len(wrong)} as planned", flush=True)
        return bool(wrong)


def fuse(run, program, report):
    """Joins the maps that are as planned; each is compared with those of the key views that overlap it. One whose image cannot be read is left out."""
    rows = run["clusters"]
    there = {i for i, row in enumerate(rows) if report.is_good(row, digest_of(row, program))}
    problems = []
    while there:
        done, points = fuse_maps(run, there, program)
        if points:
            break
        unread = re.search(r"failed reloading image '.*?/(images/.+)'", done.stdout)
        broken = {i for i in there if unread and f"images/{rows[i]['key']}" == unread[1]}
        problems += [f"{rows[i]['key']}: its image cannot be read" for i in broken] or [last_words(done)]
        there = there - broken if broken else set()
    if not there:
        print("; ".join([*problems, "nothing is fused" if problems else "nothing to fuse"]), flush=True)
    else:
        report.fusion = {"maps": len(there), "agreeing": min(run["maps_per_point"], len(there)), "points": points, "problems": problems}
        report.write()
        print("; ".join([*problems, f"{len(there)} maps fused: {points} points in {HERE / 'fused.ply'}"]), flush=True)
    return bool(there) and not problems


def fuse_maps(run, there, program):
    """How the program ended, and points of the new fused.ply; without any the files of before stay."""
    # A list must not be empty: a map that none overlaps is compared with any image of the scene.
    partners = {i: [o for o in run["overlaps"][i] if o in there] or sorted(there - {i})[:1] or [int(i == 0)] for i in there}
    (HERE / "fuse.txt").write_text("".join(" ".join(map(str, [i, *partners[i]])) + "\n" for i in sorted(there)))
    (HERE / "fusing.mvs").write_bytes(fusion_scene(run["clusters"], there))
    agree = min(run["maps_per_point"], len(there))
    options = ["--view-neighbors-file", "fuse.txt", "--number-views", "0", "--geometric-iters", "0", "--postprocess-dmaps", "0", "--number-views-fuse", str(agree)]
    # Branch develop keeps only what five maps agree on unless told otherwise.
    options += ["--fusion-filter", "1" if agree > 1 else "0"] if "--fusion-filter" in program.known else []
    done = program.run("fusing.mvs", "fusing-done.mvs", *options)
    points = ply_points(HERE / "fusing-done.ply") if done.returncode == 0 else 0
    for made in HERE.glob("fusing-done.*"):
        if points:
            made.replace(HERE / f"fused{made.suffix}")
    for left in HERE.glob("fusing*"):
        left.unlink()
    return done, points


def fusion_scene(rows, there):
    """fuse.mvs, in which the images of key views that take no part have no pose: one that is missing or broken keeps no others from being fused, and none costs memory."""
    scene = bytearray((HERE / "fuse.mvs").read_bytes())
    for i, row in enumerate(rows):
        if i not in there:
            name = f"images/{row['key']}".encode()
            entry = struct.pack("<Q", len(name)) + name + struct.pack("<Q", 0)  # the name, no mask; platform, camera and pose follow
            struct.pack_into("<I", scene, scene.index(entry) + len(entry) + 8, NO_POSE)
    return scene


def ply_points(path):
    try:
        with open(path, "rb") as file:
            match = re.search(rb"element vertex (\d+)", file.read(2000))
    except OSError:
        return 0
    return int(match[1]) if match else 0


if __name__ == "__main__":
    main()
