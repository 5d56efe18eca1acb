#!/usr/bin/env python3
"""Compares reading a COLMAP model with pycolmap.Reconstruction on the same files: wall time (median of the runs, which take
turns), its ratio, and peak memory.

Needs pycolmap. The model is a folder with cameras, images and points3D, such as a survey of 1200 views, 1 M points and
6.6 M observations:
    benches/read.py MODEL [--runs 3] [--limit 4]
Exits with 1 where the counts differ or pycolmap takes less than --limit times our time.
"""
import argparse
import os
import statistics
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent

THEIRS = """
import sys, time, pycolmap
start = time.perf_counter()
model = pycolmap.Reconstruction(sys.argv[1])
seconds = time.perf_counter() - start
print(model.num_reg_images(), len(model.points3D), model.compute_num_observations(), seconds)
"""


def run(command):
    """(counts, seconds of reading, peak MiB) of one run."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    *counts, seconds = process.stdout.read().split()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{command[0]} failed")
    return counts, float(seconds), usage.ru_maxrss / 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--limit", type=float, default=4)
    arguments = parser.parse_args()
    subprocess.run(["cargo", "build", "-q", "--release", "--example", "scene"], cwd=REPOSITORY, check=True)
    programs = {
        "viewrank": [str(REPOSITORY / "target/release/examples/scene"), arguments.model],
        "pycolmap": [sys.executable, "-c", THEIRS, arguments.model],
    }
    for command in programs.values():  # Once for the file cache.
        run(command)
    runs = {name: [] for name in programs}
    for _ in range(arguments.runs):
        for name, command in programs.items():
            runs[name].append(run(command))
    seconds = {name: statistics.median(r[1] for r in all_runs) for name, all_runs in runs.items()}
    for name, all_runs in runs.items():
        counts = "views {} points {} observations {}".format(*all_runs[0][0])
        print(f"{name:<10}{seconds[name]:8.3f} s  {max(r[2] for r in all_runs):8.0f} MiB  {counts}")
    ratio = seconds["pycolmap"] / seconds["viewrank"]
    print(f"pycolmap takes {ratio:.1f} times as long")
    same = runs["viewrank"][0][0] == runs["pycolmap"][0][0]
    return 0 if same and ratio >= arguments.limit else 1


if __name__ == "__main__":
    sys.exit(main())
