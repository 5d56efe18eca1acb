#!/usr/bin/env python3
"""The paper's three experiments on one project: partner selection, ranking only, and the full method against Max (maxcon + maxpts).

    experiments.py PROJECT --out DIR [--cache DIR] [--reference DIR] [--truth PROJECT/truth/depth] [--image-scale 0.5]

PROJECT (sparse/, images/) stays as it is; everything goes to DIR:

    project/       the plan
    reference22/   depth maps with the 22 most connected partners, the reference where there is no exact one (--reference: take these)
    rules/kK/RULE/ view clusters of each partner rule, and their depth maps
    results/       partners.csv, orders.csv, full.csv, gap.csv, results.json, and a picture of each
    results-truth/ the same against exact depth (--truth: NAME.npz as in the rendered sets of benches/sets.py)

Depth maps that are there already are kept, single pairs come from the cache, so a second run costs little.
"""

import os
import sys

if __name__ == "__main__":
    # The current folder may be a stranger's: a json.py that he put there is not imported.
    sys.path[1:] = [path for path in sys.path[1:] if os.path.realpath(path) != os.path.realpath(os.curdir)]

import argparse
import csv
import json
import subprocess
from pathlib import Path

import numpy as np

from measure import read_rendered

HERE = Path(__file__).resolve().parent
SHARES = (0.5, 0.7, 0.8, 0.9)
CONNECTED = 22  # partners of the reference maps: the paper's n


class Experiments:
    def __init__(self, args):
        self.args = args
        self.project, self.rules = args.out / "project", args.out / "rules"

    def viewrank(self, *arguments):
        done = subprocess.run([self.args.viewrank, *map(str, arguments)], stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            sys.exit(f"viewrank {' '.join(map(str, arguments))} ended with {done.returncode}")
        return done.stdout

    def bench(self, *arguments):
        """The program of crates/bench, which is built beside viewrank."""
        program = Path(self.args.viewrank).with_name("viewrank-bench")
        return subprocess.run([program, *map(str, arguments)], stdout=subprocess.PIPE, text=True, check=True).stdout

    def evaluate(self, *arguments):
        return json.loads(self.viewrank("evaluate", self.project, "--quiet", "--format", "json", *arguments))

    def match(self, out, *arguments):
        command = [sys.executable, HERE / "sgm.py", "match", self.args.project, "--out", out, "--cache", self.args.cache, "--image-scale", self.args.image_scale, "--jobs", self.args.jobs]
        subprocess.run([str(c) for c in (*command, *arguments)], check=True)

    def prepare(self):
        """The plan, the reference, and the depth maps of every rule."""
        self.project.mkdir(parents=True, exist_ok=True)
        for name in ("sparse", "images"):
            link = self.project / name
            if not link.is_symlink():
                link.symlink_to(self.args.project.resolve() / name)
        (self.project / "viewrank.toml").write_text(f"image_scale = {self.args.image_scale}\n" + self.args.settings.replace(";", "\n") + "\n")
        self.viewrank("plan", self.project, "--backend", "sgm", "-k", 5, "--quiet")
        if not self.args.reference:
            self.args.reference = self.args.out / "reference22"
            self.match(self.args.reference, "--connected", CONNECTED)
        self.bench("partners", self.project, self.rules, "-k", ",".join(map(str, self.args.k)))
        for clusters in sorted(self.rules.glob("k*/*/clusters.txt")):
            if not self.args.rules or clusters.parent.name in self.args.rules:
                self.match(clusters.parent, "--clusters", clusters)
            else:
                clusters.unlink()

    def run(self, reference, folder):
        """All three experiments against one reference."""
        folder.mkdir(parents=True, exist_ok=True)
        compared = {}
        for k in self.args.k:
            rows = self.bench("compare", self.project, self.rules / f"k{k}", "--reference", reference, "--json")
            compared |= {(k, row["name"]): row for row in json.loads(rows)}
        orders = {}
        for rule in ("ours", "maxcon"):
            maps = self.rules / "k5" / rule
            orders[rule] = self.evaluate("--depth-maps", maps, "--clusters", maps / "clusters.txt", "--reference", reference, "--baselines", "--out", folder / f"evaluation-{rule}")
        partners(compared, folder)
        ranking(orders, folder)
        gap(orders["ours"], folder)
        full = full_method(compared, self.args.k, folder)
        speed = {} if self.args.truth and folder.name == "results-truth" else self.speed(orders["ours"])
        summary = {"orders": {r: closed(e["orders"]) for r, e in orders.items()}, "full": full, "gap": orders["ours"]["gap"], "speed": speed}
        (folder / "results.json").write_text(json.dumps(summary, indent=1))
        print(report(folder, compared, orders, full, speed), flush=True)

    def speed(self, evaluation):
        """Plan plus matching of the clusters that are predicted to reach 70 %, against matching all; seconds of one core."""
        report = json.loads((self.rules / "k5/ours/report.json").read_text())
        seconds = {row["key"]: sum(p["seconds"] for p in row["partners"]) for row in report["clusters"]}
        plan = json.loads((self.project / "viewrank/timings.json").read_text())["total"]
        count = next(row["clusters"] for row in evaluation["gap"] if row["share"] > 0.69)
        keys = [row["name"] for row in evaluation["key_views"]]
        chosen, everything = (sum(seconds.get(k, 0) for k in names) for names in (keys[:count], keys))
        return {"plan": plan, "chosen": chosen, "all": everything, "times": everything / max(plan + chosen, 1e-9), "real": next(row["real"] for row in evaluation["gap"] if row["share"] > 0.69)}


def closed(orders):
    """(maxpts - ours) / (maxpts - optimum) in key views, at each share: how much of the way from maxpts to the optimum ours goes."""
    needed = {o["name"]: {round(n["share"], 2): n["clusters"] for n in o["needed"]} for o in orders}
    rows = {}
    for share in SHARES:
        ours, most, best = (needed[name][share] for name in ("ours", "maxpts", "optimum"))
        rows[share] = {name: values[share] for name, values in needed.items()} | {"way": (most - ours) / (most - best) if most > best else float(ours <= best)}
    return rows


def write_csv(path, header, rows):
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])


def partners(compared, folder):
    """Experiment 1: completeness and outliers of each rule."""
    rows = [[k, name, r["clusters"], r["pairs"], *(round(r["quality"][q], 5) for q in ("completeness", "outliers", "rmse")), round(r["predicted"], 5), round(r["real"], 5)] for (k, name), r in compared.items()]
    write_csv(folder / "partners.csv", ["k", "rule", "key_views", "pairs", "completeness", "outliers", "rmse", "predicted", "real"], rows)
    names = sorted({name for _, name in compared})
    lines = {n: [(100 * r["quality"]["outliers"], 100 * r["quality"]["completeness"]) for (_, name), r in compared.items() if name == n] for n in names}
    (folder / "partners.svg").write_text(plot(lines, "outliers, %", "completeness, %", marks=True))


def ranking(orders, folder):
    """Experiment 2: the same clusters in different orders."""
    rows, lines = [], {}
    for rule, evaluation in orders.items():
        for order in evaluation["orders"]:
            rows += [[rule, order["name"], n["share"], n["clusters"], n["pairs"]] for n in order["needed"]]
            if rule == "ours":
                lines[order["name"]] = [(i, 100 * kept / evaluation["kept"]["real"]) for i, kept in enumerate(order["kept"])]
    write_csv(folder / "orders.csv", ["partners", "order", "share", "key_views", "pairs"], rows)
    (folder / "orders.svg").write_text(plot(lines, "key views", "real fulfilment, %"))


def gap(evaluation, folder):
    rows = [[g["share"], g["clusters"], g["pairs"], round(g["predicted"], 4), round(g["real"], 4)] for g in evaluation["gap"]]
    write_csv(folder / "gap.csv", ["share", "key_views", "pairs", "predicted", "real"], rows)
    lines = {name: [(i, 100 * s) for i, s in enumerate(evaluation["curve"][name])] for name in ("predicted", "real")}
    (folder / "gap.svg").write_text(plot(lines, "key views", "share, %"))


def pairs_for(curve, fulfilment):
    reached = np.searchsorted(curve["fulfilment"], fulfilment - 1e-9)
    return curve["pairs"][reached] if reached < len(curve["pairs"]) else None


def full_method(compared, counts, folder):
    """Experiment 3: pairs that ours and Max need for the same real fulfilment: shares of what all clusters of Max reach at its best k."""
    total = max(compared[k, "maxcon"]["real"] for k in counts)
    names = [(k, rule) for rule in ("ours", "ours-nocp", "maxcon") for k in counts if (k, rule) in compared]
    table = {f"{rule} k={k}": [pairs_for(compared[k, rule]["curve"], s * total) for s in SHARES] for k, rule in names}
    best = [min((row[i] for name, row in table.items() if name.startswith("maxcon") and row[i] is not None), default=None) for i in range(len(SHARES))]
    write_csv(folder / "full.csv", ["clusters", *(f"{s:.0%}" for s in SHARES)], [[name, *row] for name, row in table.items()])
    lines = {f"{rule} k={k}": list(zip(compared[k, rule]["curve"]["pairs"], [100 * f / total for f in compared[k, rule]["curve"]["fulfilment"]], strict=True)) for k, rule in names if rule != "ours-nocp"}
    (folder / "full.svg").write_text(plot(lines, "matching pairs", "real fulfilment, %"))
    ratio = {name: [None if a is None or not b else round(a / b, 3) for a, b in zip(row, table[name.replace("ours-nocp", "maxcon").replace("ours", "maxcon")], strict=True)] for name, row in table.items() if not name.startswith("maxcon")}
    return {"total": total, "pairs": table, "of_max_at_same_k": ratio, "best_max": best}


def report(folder, compared, orders, full, speed):
    lines = [f"\n== {folder}", "partners: completeness / outliers / real f_o"]
    for (k, name), r in compared.items():
        lines.append(f"  k={k:<3} {name:12} {100 * r['quality']['completeness']:6.2f} % {100 * r['quality']['outliers']:6.2f} % {r['real']:.4f} ({r['clusters']} maps)")
    for rule, evaluation in orders.items():
        lines.append(f"ranking of the clusters of {rule}: key views for {', '.join(f'{s:.0%}' for s in SHARES)}")
        rows = closed(evaluation["orders"])
        for name in [o["name"] for o in evaluation["orders"]]:
            lines.append(f"  {name:12}" + "".join(f"{rows[s][name]:8.1f}" for s in SHARES))
        lines.append("  way to opt. " + "".join(f"{rows[s]['way']:8.2f}" for s in SHARES))
    lines.append("predicted / real: " + ", ".join(f"{100 * g['predicted']:.0f}/{100 * g['real']:.0f}" for g in orders["ours"]["gap"]))
    lines.append(f"full method, pairs for {', '.join(f'{s:.0%}' for s in SHARES)} of Max")
    lines += [f"  {name:18}" + "".join(f"{v if v is not None else '-':>7}" for v in row) + "   " + str(full["of_max_at_same_k"].get(name, "")) for name, row in full["pairs"].items()]
    if speed:
        lines.append("time: plan {plan:.1f} s + chosen {chosen:.1f} s against {all:.1f} s: {times:.1f} times, {real:.2f} really reached".format(**speed))
    return "\n".join(lines)


COLOURS = ["#1668a8", "#2a9d6f", "#8e5bb5", "#c0392b", "#b8860b", "#777777", "#222222", "#e377c2", "#17becf", "#7f3b08", "#4d9221", "#c51b7d"]


def plot(lines, x_label, y_label, marks=False, width=760, height=420):
    """Lines as SVG; with marks each point is a dot."""
    points = [p for line in lines.values() for p in line]
    x_low, x_high = 0, max(p[0] for p in points) * 1.03 or 1
    y_low = 0 if not marks else min(p[1] for p in points) - 2
    y_high = max(p[1] for p in points) * 1.01 or 1
    at = lambda x, y: (60 + (width - 260) * (x - x_low) / (x_high - x_low), 20 + (height - 70) * (y_high - y) / (y_high - y_low))
    svg = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12"><rect width="{width}" height="{height}" fill="#fff"/>']
    for i in range(6):
        x, y = x_low + (x_high - x_low) * i / 5, y_low + (y_high - y_low) * i / 5
        (px, bottom), (left, py) = at(x, y_low), at(x_low, y)
        svg.append(f'<path d="M{left} {py:.1f}H{width - 200}" stroke="#ddd"/><text x="{left - 6}" y="{py + 4:.1f}" text-anchor="end">{y:.3g}</text><text x="{px:.1f}" y="{bottom + 18:.1f}" text-anchor="middle">{x:.3g}</text>')
    svg.append(f'<text x="{(width - 200) / 2}" y="{height - 10}" text-anchor="middle">{x_label}</text><text transform="translate(14 {height / 2}) rotate(-90)" text-anchor="middle">{y_label}</text>')
    for i, (name, line) in enumerate(lines.items()):
        colour, drawn = COLOURS[i % len(COLOURS)], [at(*p) for p in line]
        svg.append(f'<polyline fill="none" stroke="{colour}" stroke-width="1.7" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in drawn)}"/>')
        svg += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in drawn if marks]
        svg.append(f'<path d="M{width - 190} {30 + 17 * i}h22" stroke="{colour}" stroke-width="2"/><text x="{width - 162}" y="{34 + 17 * i}">{name}</text>')
    return "\n".join([*svg, "</svg>\n"])


def unpack_truth(source, target):
    """Exact depth of a rendered set as NAME.npy."""
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.glob("*.npz")):
        out = target / (path.stem + ".jpg.npy")
        if not out.is_file():
            np.save(out, read_rendered(path))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cache", type=Path, help="matched pairs (default OUT/pairs)")
    parser.add_argument("--reference", type=Path, help="finished maps with many partners (default: made in OUT/reference22)")
    parser.add_argument("--truth", type=Path, help="exact depth of a rendered set")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("-k", type=lambda text: [int(k) for k in text.split(",")], default=[2, 3, 5, 11], help="partners per key view (default 2,3,5,11; 5 is needed)")
    parser.add_argument("--rules", type=lambda text: text.split(","), default=[], help="only these partner rules, ours and maxcon among them (default: all)")
    parser.add_argument("--settings", default="", help="more lines of viewrank.toml, separated by semicolons")
    parser.add_argument("--viewrank", default=os.environ.get("VIEWRANK", "viewrank"), help="the program (default: VIEWRANK, else on the path)")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    args.cache = args.cache or args.out / "pairs"
    experiments = Experiments(args)
    experiments.prepare()
    experiments.run(args.reference, args.out / "results")
    if args.truth:
        unpack_truth(args.truth, args.out / "truth")
        experiments.run(args.out / "truth", args.out / "results-truth")


if __name__ == "__main__":
    main()
