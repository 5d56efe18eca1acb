#!/usr/bin/env python3
"""Whether planning has become slower: this program against an older one, in turn on the same survey, as ratios.

    cargo build --release && python benches/speed.py OLDER [--views 300] [--runs 5] [--threads 2]

OLDER is a program, or a revision of this repository such as the tag of the last release, which is then built in target/speed. Makes the survey
(benches/aerial; needs numpy) where benches/plan.py keeps it, plans it with both in turn without images, and prints for each stage the least time
of both and their ratio, then CPU time and peak memory; below 1, this program is faster. Says so where the two choose different plans. With 300 views
two minutes; the wall times need a quiet machine, the ratios less so.
"""
import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import plan as survey_plans

ROOT = Path(__file__).resolve().parents[1]
SHOWN = ("read", "surface", "visibility", "confidence", "partners", "ranking", "total")


def main():
    arguments = parse()
    model = survey_plans.make(arguments, arguments.views)
    programs = {"older": program_of(arguments.older), "this": arguments.program}
    runs = {name: [] for name in programs}
    for turn in range(arguments.runs + 1):
        for name, program in programs.items():
            run = measured(program, model, arguments)
            # The first of each only fills the file cache.
            runs[name] += [run] if turn else []
    table(runs["older"], runs["this"], arguments)


def parse():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("older", help="program, or revision of this repository")
    parser.add_argument("--program", type=Path, default=ROOT / "target" / "release" / "viewrank")
    parser.add_argument("--views", type=int, default=300)
    parser.add_argument("--points-per-view", type=int, default=survey_plans.POINTS_PER_VIEW)
    parser.add_argument("--models", type=Path, default=ROOT / "target" / "surveys", help="where surveys are kept")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", default="2")
    return parser.parse_args()


def program_of(older):
    """The program, built from its revision if need be."""
    if shutil.which(older):
        return Path(shutil.which(older)).resolve()
    source, built = (ROOT / "target" / "speed" / name for name in ("source", "built"))
    shutil.rmtree(source, ignore_errors=True)
    files = subprocess.run(["git", "archive", older], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
    with tarfile.open(fileobj=io.BytesIO(files)) as archive:
        archive.extractall(source)
    subprocess.run(["cargo", "build", "--quiet", "--release", "--locked", "--target-dir", built], cwd=source, check=True)
    return built / "release" / "viewrank"


def measured(program, model, arguments):
    """Seconds of the stages and of the CPU, peak MB, and the plan that was chosen."""
    command = [program, "plan", model, "-k", "5", "--threads", arguments.threads, "--quiet", "--dry-run", "--format", "json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    answer = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{program} failed on {model}")
    summary = json.loads(answer)
    numbers = {stage: summary["timings"].get(stage, 0.0) for stage in SHOWN}
    numbers |= {"CPU": usage.ru_utime + usage.ru_stime, "peak MB": usage.ru_maxrss / 1024}
    return numbers, (summary["triangles"], summary["cut"])


def table(older, this, arguments):
    print(f"{arguments.views} views, {arguments.threads} threads, least of {arguments.runs} runs, seconds")
    print(f"{'':<12}{'older':>9}{'this':>9}{'ratio':>8}")
    for name in [*SHOWN, "CPU", "peak MB"]:
        least = [min(numbers[name] for numbers, _ in runs) for runs in (older, this)]
        print(f"{name:<12}{least[0]:>9.2f}{least[1]:>9.2f}{least[1] / max(least[0], 1e-9):>8.2f}")
    if older[0][1] != this[0][1]:
        print("The two choose different plans.")


if __name__ == "__main__":
    main()
