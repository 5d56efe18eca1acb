#!/usr/bin/env python3
"""Time per view and peak memory of `viewrank plan` on synthetic surveys of growing size.

    cargo build --release && python benches/plan.py [--views 300 1200 5000 10000 50000] [-k 5] [--threads 2] [--max-memory 8G]

Makes the models (benches/aerial; needs numpy), those of more than 10,000 views as copies of that of 10,000 beside each other, in a folder
that is kept between runs, plans each without images, and prints a table: wall time per view, core time per view of partners and ranking, peak
memory and its forecast, tiles of the surface, tables on disk. A plan that does not fit --max-memory has a line that says so.
"""
import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import aerial.model
import survey

ROOT = Path(__file__).resolve().parents[1]
# As in the survey of 1,200 views and 1,000,000 points.
POINTS_PER_VIEW = 833
# Made in a quarter of an hour.
LARGEST = 10_000


def main():
    arguments = parse()
    print(f"{'views':>7} {'points':>9} {'wall s':>8} {'ms/view':>8} {'read':>6} {'surface':>8} {'visible':>8} "
          f"{'partners':>9} {'ranking':>8} {'peak MB':>8} {'forecast':>8} {'tiles':>5} {'disk MB':>8} {'key views':>10}")
    for views in arguments.views:
        model = make(arguments, views)
        row(views, *plan(arguments, model))


def parse():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, nargs="+", default=[300, 1200, 5000, 10000])
    parser.add_argument("--points-per-view", type=int, default=POINTS_PER_VIEW)
    parser.add_argument("--max-memory", help="as that of viewrank plan")
    parser.add_argument("-k", default="5")
    parser.add_argument("--threads", default="2")
    parser.add_argument("--program", type=Path, default=ROOT / "target" / "release" / "viewrank")
    parser.add_argument("--models", type=Path, default=ROOT / "target" / "surveys", help="where models are kept")
    return parser.parse_args()


def make(arguments, views):
    points = arguments.points_per_view * views
    folder = arguments.models / (str(views) if arguments.points_per_view == POINTS_PER_VIEW else f"{views}-{points}")
    if views > LARGEST and views % LARGEST:
        sys.exit(f"more than {LARGEST} views are copies of {LARGEST}: {views} is no multiple")
    if not (folder / "points3D.bin").exists() and views > LARGEST:
        survey.beside_each_other(make(arguments, LARGEST), folder, views // LARGEST)
    elif not (folder / "points3D.bin").exists():
        aerial.model.make(folder, views, points)
    return folder


def plan(arguments, model):
    """The summary of the plan, and the usage of the process."""
    command = [arguments.program, "plan", model, "-k", arguments.k, "--threads", arguments.threads]
    command += ["--max-memory", arguments.max_memory] if arguments.max_memory else []
    process = subprocess.Popen([*command, "--quiet", "--dry-run", "--format", "json"], stdout=subprocess.PIPE)
    answer = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status and not arguments.max_memory:
        sys.exit(f"viewrank failed on {model}")
    return (None if status else json.loads(answer)), usage


def row(views, summary, usage):
    if summary is None:
        return print(f"{views:>7} refused after {usage.ru_utime:.0f} s of CPU, {usage.ru_maxrss / 1024:.0f} MB: see above", flush=True)
    forecast = max(summary["memory"][stage] for stage in ("read", "surface", "visibility", "partners")) / 2**20
    disk = summary["memory"]["disk"] / 2**20
    stage = {name: 1000 * seconds / views for name, seconds in summary["timings"].items()}
    print(f"{views:>7} {summary['points']:>9} {summary['timings']['total']:>8.1f} {stage['total']:>8.1f} {stage['read']:>6.1f} "
          f"{stage['surface']:>8.1f} {stage['visibility']:>8.1f} {stage['partners']:>9.2f} {stage['ranking']:>8.2f} "
          f"{usage.ru_maxrss / 1024:>8.0f} {forecast:>8.0f} {summary['tiles']:>5} {disk:>8.0f} {summary['cut']['clusters']:>10}", flush=True)


if __name__ == "__main__":
    main()
