#!/usr/bin/env python3
"""Measures what the order of viewrank saves on the sets of benches/sets.py (docs/benchmarks.md).

    python3 benches/compare.py SET... [--out target/compare] [--viewrank target/release/viewrank] [-k 5]
    python3 benches/compare.py --all

For each set: makes it where it is missing (sets.py), plans for integrations/sgm, matches every view cluster of the plan, and evaluates all orders,
against exact depth where the set is rendered. Writes SET/evaluation (page, JSON) and, over all sets measured so far, `table.md` and
`curves.svg` to --out. Matching a set takes minutes to an hour on two cores. Needs integrations/sgm/requirements.txt.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SETS = ["valley", "statue", "room", "grove", "yard", "boruszyn", "lewis", "caliterra", "ochota"]
SHARES = (0.5, 0.7, 0.8, 0.9)
COLOURS = {"ours": "#1668a8", "maxpts": "#b03a86", "every n-th": "#c98a1b", "farthest view": "#4c9496", "optimum": "#5b6670"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", metavar="SET", choices=[*SETS, []], help=", ".join(SETS))
    parser.add_argument("--all", action="store_true", help="every set")
    parser.add_argument("--out", type=Path, default=ROOT / "target/compare")
    parser.add_argument("--viewrank", type=Path, default=ROOT / "target/release/viewrank")
    parser.add_argument("-k", type=int, default=5, help="partners per key view")
    options = parser.parse_args()
    for name in SETS if options.all else options.sets:
        measure(name, options)
    measured = {name: read(options.out / name) for name in SETS if (options.out / name / "evaluation/evaluation.json").exists()}
    if measured:
        options.out.joinpath("table.md").write_text(table(measured))
        options.out.joinpath("curves.svg").write_text(curves(measured))
        print((options.out / "table.md").read_text())


def measure(name, options):
    data = Path(os.environ.get("VIEWRANK_DATA", ROOT / "target/data")) / name
    if not data.exists():
        run(sys.executable, ROOT / "benches/sets.py", name)
    project = options.out / name
    project.mkdir(parents=True, exist_ok=True)
    for folder in ("images", "sparse", "truth"):
        if (data / folder).exists() and not (project / folder).is_symlink():
            (project / folder).symlink_to((data / folder).resolve())
    (project / "viewrank.toml").write_text("image_scale = 0.5\n")
    run(options.viewrank, "plan", project, "--backend", "sgm", "-k", options.k, "--quiet")
    run(options.viewrank.with_name("viewrank-bench"), "partners", project, project / "rules", "-k", options.k)
    maps = project / f"rules/k{options.k}/ours"
    run(sys.executable, ROOT / "integrations/sgm/sgm.py", "match", project, "--out", maps, "--image-scale", 0.5, "--clusters", maps / "clusters.txt")
    truth = ["--reference", project / "truth/depth"] if (project / "truth/depth").exists() else []
    run(options.viewrank, "evaluate", project, "--depth-maps", maps, "--clusters", maps / "clusters.txt", "--baselines", *truth,
        "--out", project / "evaluation", "--quiet")


def run(*command):
    subprocess.run([str(part) for part in command], check=True)


def read(project):
    return json.loads((project / "evaluation/evaluation.json").read_text())


def table(measured):
    """Key views for each share, a row per set and order; orders that need the same are one row."""
    lines = ["| set | maps | order | " + " | ".join(f"{100 * share:.0f} %" for share in SHARES) + " |", "| --- " * (3 + len(SHARES)) + "|"]
    for name, evaluation in measured.items():
        rows = {}
        for order in evaluation["orders"]:
            needed = {round(at["share"], 2): at["clusters"] for at in order["needed"]}
            rows.setdefault(tuple(f"{needed[share]:.{1 if order['spread'] else 0}f}" for share in SHARES), []).append(order["name"])
        for cells, orders in rows.items():
            lines.append(f"| {name} | {len(evaluation['key_views'])} | {', '.join(orders)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def curves(measured):
    """SVG: a plot per set, share over key views, a line per order."""
    width, height, columns = 300, 220, 3
    parts = []
    for i, (name, evaluation) in enumerate(measured.items()):
        left, top = 10 + (i % columns) * (width + 20), 10 + i // columns * (height + 30)
        x = lambda n, most: left + 40 + (width - 50) * n / most
        y = lambda share: top + 30 + (height - 60) * (1 - share)
        parts.append(f'<text x="{left + 40}" y="{top + 18}" font-weight="600">{name}</text>')
        parts += [f'<path d="M{left + 40} {y(s):.0f}h{width - 50}" stroke="#d9dee3"/><text x="{left + 34}" y="{y(s) + 4:.0f}" text-anchor="end">{100 * s:.0f} %</text>'
                  for s in (0, 0.5, 0.9, 1)]
        for order in evaluation["orders"]:
            if order["name"] in COLOURS and evaluation["kept"]["real"] > 0:
                kept = [value / evaluation["kept"]["real"] for value in order["kept"]]
                points = " ".join(f"{x(n, len(kept) - 1):.1f},{y(share):.1f}" for n, share in enumerate(kept))
                parts.append(f'<polyline fill="none" stroke="{COLOURS[order["name"]]}" stroke-width="1.8" points="{points}"/>')
    bottom = 20 + -(-len(measured) // columns) * (height + 30)
    legend = "".join(f'<rect x="{20 + 130 * i}" y="{bottom}" width="12" height="12" fill="{colour}"/><text x="{38 + 130 * i}" y="{bottom + 11}">{order}</text>'
                     for i, (order, colour) in enumerate(COLOURS.items()))
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {columns * (width + 20)} {bottom + 30}" font-family="system-ui, sans-serif" font-size="12">'
            f'<rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}{legend}</svg>\n')


if __name__ == "__main__":
    main()
