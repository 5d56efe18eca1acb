#!/usr/bin/env python3
"""Time per view and peak memory of `viewrank plan` on synthetic surveys of growing size.

    cargo build --release && python benches/plan.py [--views 300 1200 5000 10000 50000] [-k 5] [--threads 2] [--max-memory 8G]

Makes the models (benches/aerial; needs numpy), those of more than 10,000 views as copies of that of 10,000 beside each other, in a folder
that is kept between runs, plans each without images, and prints a table: wall time per view by stage, peak memory and its forecast, tiles of the
surface, tables on disk. A plan that does not fit --max-memory has a line that says so.

--pictures PROJECT plans copies of a project beside each other, with its images, as many as have at most so many views.

--serial plans each once more with one thread, and prints by stage how much of its work only one thread can do: all of it if two threads take as long
as one, nothing if they take half as long. Candidates are found while the surface is built, so surface, visibility and partners count as one.
"""
import argparse
import json
import os
import struct
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
        views, model = copied(arguments, views) if arguments.pictures else (views, make(arguments, views))
        summary, usage = plan(arguments, model, arguments.threads)
        row(views, summary, usage)
        if arguments.serial and summary is not None:
            serial(*[plan(arguments, model, threads) for threads in ("1", "2")])


def parse():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, nargs="+", default=[300, 1200, 5000, 10000])
    parser.add_argument("--points-per-view", type=int, default=POINTS_PER_VIEW)
    parser.add_argument("--pictures", type=Path, metavar="PROJECT", help="plan copies of this project, with its images (sparse/0 in binary, images)")
    parser.add_argument("--max-memory", help="as that of viewrank plan")
    parser.add_argument("-k", default="5")
    parser.add_argument("--threads", default="2")
    parser.add_argument("--serial", action="store_true", help="also print the share of the work that only one thread can do")
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


def copied(arguments, views):
    """Number of views, and folder, of copies of a project, whose images are links."""
    project = arguments.pictures.resolve()
    (own,) = struct.unpack_from("<Q", (project / "sparse/0/images.bin").read_bytes())
    copies = views // own
    folder = arguments.models / f"{project.name}-{copies}"
    if not (folder / "sparse/0/points3D.bin").exists():
        survey.beside_each_other(project / "sparse/0", folder / "sparse/0", copies)
    (folder / "images").mkdir(exist_ok=True)
    for copy in range(copies):
        for image in (project / "images").iterdir():
            link = folder / "images" / f"copy{copy}_{image.name}"
            link.is_symlink() or link.symlink_to(image)
    return copies * own, folder


def plan(arguments, model, threads):
    """The summary of the plan, and the usage of the process."""
    command = [arguments.program, "plan", model, "-k", arguments.k, "--threads", threads]
    # With pictures, places count as the program fuses them.
    command += ["--backend", "openmvs"] if arguments.pictures else []
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
    forecast = max(need for stage, need in summary["memory"].items() if stage != "disk") / 2**20
    disk = summary["memory"]["disk"] / 2**20
    stage = {name: 1000 * seconds / views for name, seconds in summary["timings"].items()}
    print(f"{views:>7} {summary['points']:>9} {summary['timings']['total']:>8.1f} {stage['total']:>8.1f} {stage['read']:>6.1f} "
          f"{stage['surface']:>8.1f} {stage['visibility']:>8.1f} {stage['partners']:>9.2f} {stage['ranking']:>8.2f} "
          f"{usage.ru_maxrss / 1024:>8.0f} {forecast:>8.0f} {summary['tiles']:>5} {disk:>8.0f} {summary['cut']['clusters']:>10}", flush=True)


def serial(one, two):
    """Prints the share of each stage that only one thread can do, from the plans with one and two threads."""
    together = ("surface", "visibility", "partners")
    seconds = [summary["timings"] for summary, _ in (one, two)]
    groups = {"read": ("read",), "surface to partners": together, "confidence": ("confidence",), "ranking": ("ranking",), "all": ("total",)}
    shares = []
    for name, stages in groups.items():
        alone, pair = (sum(timings[stage] for stage in stages) for timings in seconds)
        # T1 = serial + parallel, T2 = serial + parallel / 2.
        shares.append(f"{name} {max(0.0, min(1.0, (2 * pair - alone) / max(alone, 1e-9))):.0%} of {alone:.1f} s")
    print("        serial: " + ", ".join(shares), flush=True)


if __name__ == "__main__":
    main()
