#!/usr/bin/env python3
"""Measures `viewrank watch`: cost while idle, latency, and memory growth.

    cargo build --release && python benches/daemon.py [idle] [latency] [soak] [--program FILE]

idle     1,000 planned projects: CPU over a minute, memory, watches, size of the status. Wanted: under 0.1 % of a core and 100 MB.
latency  from the last byte of a model written to the start of planning, beyond the settle time, of projects that come, some with 20,000
         images written just before. Wanted: at most 0.3 s.
soak     2,000 changes over 50 projects, of which some go and come back and some have depth maps: memory, threads, descriptors and watches
         after the first 100 and after all. Wanted: no growth (of memory at most a tenth).

Ends with 1 where something is not as wanted. Needs Linux and Python, nothing else. The long form of the kill test: VIEWRANK_KILLS=3000 cargo test --test slow daemon_kill::.
"""

import argparse
import json
import os
import shutil
import signal
import struct
import subprocess
import tempfile
import time
from datetime import datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SETTLE = 0.5
IDLE_SECONDS = 60
IMAGES = 20_000
FAILURES = []


class Daemon:
    def __init__(self, program, root, *options):
        self.root = root
        self.log = Path(tempfile.mkstemp(suffix=".jsonl")[1])
        with self.log.open("w") as log:
            command = [program, "watch", root, "--settle", f"{int(SETTLE * 1000)}ms", "--log-format", "json", *options]
            self.process = subprocess.Popen(list(map(str, command)), stderr=log, env=os.environ | {"XDG_CONFIG_HOME": str(root)})

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait()
        self.log.unlink()

    def said(self, word):
        """Returns time and project of each log line that begins with the word."""
        records = map(json.loads, self.log.read_text().splitlines())
        said = [r for r in records if r["fields"].get("message", "").startswith(word)]
        return [(datetime.fromisoformat(r["timestamp"]).timestamp(), r["fields"].get("project")) for r in said]

    def wait(self, word, count, patience=1200):
        end = time.monotonic() + patience
        while len(self.said(word)) < count:
            if self.process.poll() is not None or time.monotonic() > end:
                raise SystemExit(f"waited in vain for {count} x {word}:\n{self.log.read_text()[-2000:]}")
            time.sleep(0.1)

    def cpu_seconds(self):
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def sizes(self):
        """Returns resident MB, threads, descriptors and watches."""
        proc = Path(f"/proc/{self.process.pid}")
        status = dict(line.split(":", 1) for line in (proc / "status").read_text().splitlines())
        descriptors = list((proc / "fd").iterdir())
        watches = sum(line.startswith("inotify") for fd in (proc / "fdinfo").iterdir() for line in fd.read_text().splitlines())
        return int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"]), len(descriptors), watches


def small_model(folder, variant, side=3, left_out=0):
    """A text model of side x side views over a wavy ground, the last ones left out, without noise; variants differ in their points."""
    folder.mkdir(parents=True, exist_ok=True)
    places = [8.0 * i - 4.0 * (side - 1) for i in range(side)]
    views = [(x, y) for x in places for y in places][: side * side - left_out]
    width = 8.0 * (side + 2)
    state, points = 7 + variant, []
    for _ in range(int(width * width / 4)):
        numbers = []
        for _ in range(2):
            state = (1103515245 * state + 12345) % 2**31
            numbers.append(width * state / 2**31 - width / 2)
        x, y = numbers
        points.append((x, y, 1.5 * ((0.3 * x) % 2.0 - 1.0)))
    tracks, seen = [], [[] for _ in views]
    for number, (x, y, z) in enumerate(points, 1):
        track = []
        for i, (cx, cy) in enumerate(views):
            # Looking down from 40 m: x to the right, y turned.
            depth = 40.0 - z
            u, v = 200.0 + 320.0 * (x - cx) / depth, 150.0 - 320.0 * (y - cy) / depth
            if 0 < u < 400 and 0 < v < 300:
                track.append((i + 1, len(seen[i])))
                seen[i].append((u, v, number))
        tracks.append(track)
    images = "".join(
        f"{i} 0 1 0 0 {-cx} {cy} 40 1 view{i}.jpg\n{' '.join(f'{u} {v} {n}' for u, v, n in seen[i - 1])}\n"
        for i, (cx, cy) in enumerate(views, 1)
    )
    lines = (
        f"{n} {x} {y} {z} 128 128 128 0.1 {' '.join(f'{i} {j}' for i, j in track)}\n"
        for n, ((x, y, z), track) in enumerate(zip(points, tracks), 1)
        if len(track) > 1
    )
    write(folder / "cameras.txt", "1 PINHOLE 400 300 320 320 200 150\n")
    write(folder / "images.txt", images)
    write(folder / "points3D.txt", "".join(lines))


def write(path, text):
    path.write_text(text)


def depth_map(path):
    """40 m everywhere."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (30, 40), }".ljust(117) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00\x76\x00" + header + struct.pack("<f", 40.0) * 1200)


def planned_projects(program, root, count):
    """Makes a number of planned projects."""
    small_model(root / "p0/sparse/0", 0)
    subprocess.run([program, "watch", "--once", root, "--settle", "10ms"], check=True, stderr=subprocess.DEVNULL)
    for i in range(1, count):
        shutil.copytree(root / "p0", root / f"group{i % 10}/p{i}")


def idle(program, root):
    planned_projects(program, root, 1000)
    with Daemon(program, root) as daemon:
        daemon.wait("planned", 1000)
        time.sleep(5)
        before, start = daemon.cpu_seconds(), time.monotonic()
        time.sleep(IDLE_SECONDS)
        share = (daemon.cpu_seconds() - before) / (time.monotonic() - start)
        memory, threads, descriptors, watches = daemon.sizes()
        status = (root / "viewrank/status.json").stat().st_size
        must(share < 0.001 and memory < 100, "idle: under 0.1 % of a core and 100 MB")
        print(f"idle: 1000 projects: {100 * share:.3f} % of a core, {memory:.0f} MB, {threads} threads, {descriptors} descriptors, "
              f"{watches} watches, status.json {status / 1e3:.0f} kB", flush=True)


def latency(program, root):
    late = []
    with Daemon(program, root) as daemon:
        for i in range(20):
            (root / f"p{i}/images").mkdir(parents=True)
            for image in range(IMAGES if i % 4 == 0 else 9):
                (root / f"p{i}/images/view{image}.jpg").touch()
            small_model(root / f"p{i}/sparse/0", i)
            written = time.time()
            daemon.wait("planned", i + 1)
            late.append(daemon.said("planning")[i][0] - written - SETTLE)
    late.sort()
    print(f"latency beyond the settle time of {SETTLE} s: median {late[10]:.3f} s, most {late[-1]:.3f} s of {len(late)}", flush=True)
    must(late[-1] <= 0.3, "latency: at most 0.3 s")


def soak(program, root, changes):
    projects, sizes = 50, []
    with Daemon(program, root, "--jobs", "2") as daemon:
        for done in range(0, changes, projects):
            for i in range(projects):
                small_model(root / f"p{i}/sparse/0", (done // projects) % 2 * 100 + i)
            daemon.wait("planned", done + projects)
            for i in range(5):
                depth_map(root / f"p{i + 5}/sgm/depth_maps/view1.jpg.npy")
            if done + projects in (100, changes // 2, changes):
                time.sleep(3)
                memory, threads, descriptors, watches = daemon.sizes()
                sizes.append((memory, threads, descriptors, watches))
                print(f"soak: after {done + projects} changes: {memory:.0f} MB, {threads} threads, {descriptors} descriptors, {watches} watches", flush=True)
            for i in range(5):
                shutil.rmtree(root / f"p{i}")
            daemon.wait("gone", 5 * (done // projects + 1))
        planned = len(daemon.said("planned"))
        print(f"soak: {planned} plans for {changes} changes", flush=True)
        must(planned == changes, "soak: a plan for each change")
        (first, *counts), (last, *last_counts) = sizes[0], sizes[-1]
        must(last <= 1.1 * first and counts == last_counts, "soak: no growth")


def must(condition, wanted):
    if not condition:
        FAILURES.append(wanted)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", nargs="*", default=["idle", "latency", "soak"])
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/viewrank")
    parser.add_argument("--changes", type=int, default=2000)
    arguments = parser.parse_args()
    for what in arguments.what:
        with tempfile.TemporaryDirectory() as folder:
            rest = [arguments.changes] if what == "soak" else []
            {"idle": idle, "latency": latency, "soak": soak}[what](arguments.program, Path(folder).resolve(), *rest)
    if FAILURES:
        raise SystemExit("not as wanted: " + "; ".join(FAILURES))


if __name__ == "__main__":
    main()
