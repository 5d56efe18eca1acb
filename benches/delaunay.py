#!/usr/bin/env python3
"""Compares the 3D Delaunay triangulation with CGAL's on the same files: CPU time (user + system of the whole program, median
of the runs, which take turns), peak memory and numbers of cells.

Needs numpy, g++ and CGAL's headers (Debian: apt-get install g++ libcgal-dev). Run from anywhere:
    benches/delaunay.py [--points 1000000] [--runs 3] [--inputs uniform,terrain,...] [--work DIR]
Exits with 1 where a ratio of CPU times is above --limit, or cells are not as many as CGAL's on inputs that lie on the
grid (uniform, terrain, lattice, duplicates; the others are rounded to it on our side).
"""
import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parent.parent


def whole(points, step):
    """Rounded to a step that the grid keeps."""
    return np.round(points / step) * step


def uniform(rng, n):
    return whole(rng.random((n, 3)), 2.0**-23)


def terrain(rng, n):
    """1 km square, hills of 40 m, noise of 5 cm."""
    x, y = rng.random((2, n)) * 1000
    z = 40 * np.sin(x / 130) * np.cos(y / 170) + rng.normal(0, 0.05, n)
    return whole(np.column_stack([x, y, z]), 2.0**-13)


def lattice(rng, n):
    side = round(n ** (1 / 3))
    return rng.permutation(np.stack(np.meshgrid(*[np.arange(side, dtype=float)] * 3), -1).reshape(-1, 3))


def duplicates(rng, n):
    return uniform(rng, n // 10)[rng.integers(0, n // 10, n)]


def tilted_plane(rng, n):
    x, y = rng.random((2, n)) * 100
    return np.column_stack([x, y, 0.3 * x + 0.7 * y + 1])


def map_coordinates(rng, n):
    """Offsets of 400 km and more, millimetre steps."""
    return np.round(np.array([400_000.0, 5_400_000.0, 300.0]) + rng.random((n, 3)) * [1000, 1000, 100], 3)


def coplanar(rng, n):
    return np.column_stack([rng.random((n, 2)), np.full(n, 0.5)])


ON_GRID = {"uniform", "terrain", "lattice", "duplicates"}
INPUTS = dict(uniform=uniform, terrain=terrain, lattice=lattice, duplicates=duplicates, tilted_plane=tilted_plane,
              map_coordinates=map_coordinates, coplanar=coplanar)


def build(work):
    yardstick = work / "cgal_delaunay"
    subprocess.run(["g++", "-O3", "-DNDEBUG", "-o", yardstick, REPOSITORY / "benches/cgal_delaunay.cpp", "-lgmp", "-lmpfr"],
                   check=True)
    subprocess.run(["cargo", "build", "-q", "--release", "-p", "viewrank-core", "--example", "delaunay"], cwd=REPOSITORY, check=True)
    target = Path(os.environ.get("CARGO_TARGET_DIR", REPOSITORY / "target"))
    return yardstick, target / "release/examples/delaunay"


def run(program, points):
    """(CPU seconds, peak MiB, printed words) of one run."""
    process = subprocess.Popen([program, points], stdout=subprocess.PIPE, text=True)
    words = process.stdout.read().split()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{program} failed on {points}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, words


def compare(name, programs, points, runs):
    seconds, memory, words = [[], []], [0, 0], [None, None]
    for _ in range(runs):
        for side, program in enumerate(programs):
            cpu, peak, words[side] = run(program, points)
            seconds[side].append(cpu)
            memory[side] = max(memory[side], peak)
    cgal, ours = map(statistics.median, seconds)
    agree = words[0][:4] == words[1][:4] or name not in ON_GRID
    print(f"{name:16} {words[1][1]:>9} {words[0][2]:>9} {words[1][2]:>9} {cgal:7.2f} {ours:7.2f} {ours / cgal:6.2f} "
          f"{memory[0]:6.0f} {memory[1]:6.0f}", flush=True)
    return agree, ours / cgal


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--inputs", default=",".join(INPUTS))
    parser.add_argument("--work", type=Path, help="where programs and points are kept (default: a temporary folder)")
    parser.add_argument("--limit", type=float, default=1.0, help="largest ratio of CPU times")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        work.mkdir(exist_ok=True)
        programs = build(work)
        print("input             vertices cells:CGAL      ours  s:CGAL    ours  ratio MB:CGAL  ours")
        results = []
        for name in arguments.inputs.split(","):
            points = work / f"{name}_{arguments.points}.f64"
            if not points.exists():
                INPUTS[name](np.random.default_rng(7), arguments.points).astype("<f8").tofile(points)
            results.append(compare(name, programs, points, arguments.runs))
    if not all(agree and ratio <= arguments.limit for agree, ratio in results):
        sys.exit(1)


if __name__ == "__main__":
    main()
