#!/usr/bin/env python3
"""Time per view and peak memory of `viewrank plan` on synthetic surveys of growing size.

    cargo build --release && python benches/plan.py [--views 300 1200 5000 10000] [-k 5] [--threads 2]

Makes the models with synth_uav.py (--tool, by default ../shared/tools/synth_uav.py; needs numpy) in a folder that is kept between
runs, plans each without images, and prints a table: wall time per view, core time per view of partners and ranking, peak memory.
"""
import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# As in the survey of 1,200 views and 1,000,000 points.
POINTS_PER_VIEW = 833


def main():
    arguments = parse()
    print(f"{'views':>7} {'points':>9} {'wall s':>8} {'ms/view':>8} {'read':>6} {'surface':>8} {'visible':>8} "
          f"{'partners':>9} {'ranking':>8} {'peak MB':>8} {'key views':>10}")
    for views in arguments.views:
        model = make(arguments, views)
        row(views, *plan(arguments, model))


def parse():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, nargs="+", default=[300, 1200, 5000, 10000])
    parser.add_argument("-k", default="5")
    parser.add_argument("--threads", default="2")
    parser.add_argument("--program", type=Path, default=ROOT / "target" / "release" / "viewrank")
    parser.add_argument("--tool", type=Path, default=ROOT.parent / "shared" / "tools" / "synth_uav.py")
    parser.add_argument("--models", type=Path, default=ROOT / "target" / "surveys", help="where models are kept")
    return parser.parse_args()


def make(arguments, views):
    folder = arguments.models / str(views)
    if not (folder / "points3D.bin").exists():
        points = POINTS_PER_VIEW * views
        command = [sys.executable, arguments.tool, folder, "--views", str(views), "--points", str(points), "--quiet"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def plan(arguments, model):
    """The summary of the plan, and the usage of the process."""
    command = [arguments.program, "plan", model, "-k", arguments.k, "--threads", arguments.threads]
    process = subprocess.Popen([*command, "--quiet", "--dry-run", "--format", "json"], stdout=subprocess.PIPE)
    summary = json.loads(process.stdout.read())
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"viewrank failed on {model}")
    return summary, usage


def row(views, summary, usage):
    stage = {name: 1000 * seconds / views for name, seconds in summary["timings"].items()}
    print(f"{views:>7} {summary['points']:>9} {summary['timings']['total']:>8.1f} {stage['total']:>8.1f} {stage['read']:>6.1f} "
          f"{stage['surface']:>8.1f} {stage['visibility']:>8.1f} {stage['partners']:>9.2f} {stage['ranking']:>8.2f} "
          f"{usage.ru_maxrss / 1024:>8.0f} {summary['cut']['clusters']:>10}", flush=True)


if __name__ == "__main__":
    main()
