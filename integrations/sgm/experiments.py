#!/usr/bin/env python3
"""The paper's experiments on one project: ranking, partner selection, the full method against Max (maxcon + maxpts), the gap between prediction and result, and time.

    experiments.py PROJECT --out DIR [--reference DIR] [--cache DIR] [--image-scale 0.5] [-k 2,3,5,11] [--rules ours,maxcon,openmvs]

PROJECT (sparse/, images/) stays as it is; DIR becomes a project with links to it:

    viewrank/         the plan, and the evaluation of all its clusters
    bare/             the model without pictures, planned to be timed
    truth/depth/      exact depth of a rendered set (PROJECT/truth/depth of benches/sets.py), the reference where there is one
    reference22/      else depth maps with the 22 most connected partners (--reference: take these)
    rules/kK/RULE/    view clusters of each partner rule, and their depth maps
    pairs/            depth by single pairs (--cache: elsewhere)
    experiments.json  all results, of which benches/tables.py makes tables; and a picture of each experiment

View clusters and depth maps that are there already are kept, single pairs come from the cache, so a second run costs little. Planning is timed once.
"""

import errno
import os
import sys


def explain(kind, error, _):
    """One line in place of a trace: files and paths may be a stranger's."""
    what = getattr(error, "strerror", None) or " ".join(f"{kind.__name__}: {error}".split())
    cure = "move the project to a shorter path" if getattr(error, "errno", None) == errno.ENAMETOOLONG else "check the files that it reads, or export again"
    print("interrupted" if kind is KeyboardInterrupt else f"error: {getattr(error, 'filename', None) or __file__}: {what}; {cure}", file=sys.stderr)


if __name__ == "__main__":
    sys.excepthook = explain
    # The current folder may be a stranger's: a json.py that he put there is not imported.
    sys.path[1:] = [path for path in sys.path[1:] if os.path.realpath(path) != os.path.realpath(os.curdir)]

import argparse
import json
import resource
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from measure import read_rendered

HERE = Path(__file__).resolve().parent
SHARES = (0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9)
CONNECTED = 22  # partners of the reference maps: the paper's n
RANKED = 5  # partners of the clusters whose orders are compared
NEEDED = ("ours", "maxcon")
TIMED = (2, 22)  # maps whose matching is timed


class Experiments:
    def __init__(self, args):
        self.args = args
        self.project, self.rules = args.out, args.out / "rules"

    def viewrank(self, *arguments):
        """What the program prints with --format json, and the usage of the process."""
        process = subprocess.Popen([self.args.viewrank, *map(str, arguments), "--quiet", "--format", "json"], stdout=subprocess.PIPE)
        answer = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            sys.exit(f"viewrank {' '.join(map(str, arguments))} ended with {os.waitstatus_to_exitcode(status)}")
        return json.loads(answer), usage

    def bench(self, *arguments):
        """The program of crates/bench, which is built beside viewrank."""
        program = Path(self.args.viewrank).with_name("viewrank-bench")
        return subprocess.run([program, *map(str, arguments)], stdout=subprocess.PIPE, text=True, check=True).stdout

    def match(self, out, *arguments):
        command = [sys.executable, HERE / "sgm.py", "match", self.args.project, "--out", out, "--cache", self.args.cache, "--image-scale", self.args.image_scale, "--jobs", self.args.jobs]
        subprocess.run([str(c) for c in (*command, *arguments)], check=True)

    def plan(self, project, backend, *options):
        """A plan, with its seconds, those of all cores together, and its peak memory."""
        plan, usage = self.viewrank("plan", project, *(["--backend", backend] if backend else []), "-k", RANKED, *options)
        return {"views": plan["views"], "seconds": plan["timings"], "cpu": usage.ru_utime + usage.ru_stime, "peak_mb": usage.ru_maxrss / 1024}

    def plan_timed(self):
        """Plans from nothing, then once more with another target; leaves the plan for sgm."""
        note, bare = self.project / "planning.json", self.project / "bare"
        linked(self.args.project, self.project, ("sparse", "images"), self.settings())
        linked(self.args.project, bare, ("sparse",), self.settings())
        if note.exists():
            return
        timed = {}
        for name, project, backend in (("no pictures", bare, None), ("OpenMVS", self.project, "openmvs"), ("sgm", self.project, "sgm")):
            shutil.rmtree(project / "viewrank", ignore_errors=True)
            timed[name] = [self.plan(project, backend, *again) for again in ([], ["--target", "80%"])]
        self.plan(self.project, "sgm")
        note.write_text(json.dumps(timed, indent=1) + "\n")

    def settings(self):
        return f"image_scale = {self.args.image_scale}\n" + self.args.settings.replace(";", "\n") + "\n"

    def reference(self):
        """The folder of reference maps, and what they are."""
        exact = self.args.project / "truth/depth"
        if self.args.reference:
            return self.args.reference, "given maps"
        if exact.is_dir():
            unpack_truth(exact, self.project / "truth/depth")
            return self.project / "truth/depth", "exact depth"
        self.match(self.project / "reference22", "--connected", CONNECTED)
        return self.project / "reference22", f"maps with {CONNECTED} partners"

    def match_rules(self):
        """View clusters of every rule with their depth maps, those whose orders are compared first."""
        wanted = [self.rules / f"k{k}/{rule}/clusters.txt" for k in self.args.k for rule in self.args.rules]
        if not wanted or not all(path.exists() for path in wanted):
            self.bench("partners", self.project, self.rules, "-k", ",".join(map(str, self.args.k)))
        found = {(int(path.parts[-3][1:]), path.parts[-2]): path for path in self.rules.glob("k*/*/clusters.txt")}
        for k, rule in sorted(found, key=lambda choice: (choice[0] != RANKED, choice[1] not in NEEDED, choice)):
            clusters = found[k, rule]
            if k in self.args.k and (not self.args.rules or rule in self.args.rules):
                self.match(clusters.parent, "--clusters", clusters)
            else:
                clusters.unlink()

    def run(self):
        self.plan_timed()
        reference, about = self.reference()
        self.match_rules()
        compared = self.compare(reference)
        maps = self.rules / f"k{RANKED}/ours"
        evaluation, _ = self.viewrank("evaluate", self.project, "--depth-maps", maps, "--reference", reference, "--baselines")
        results = {"set": self.args.project.resolve().name, "reference": about, "maps": len(evaluation["key_views"]), "image_scale": self.args.image_scale}
        results |= {"ranking": ranking(evaluation), "partners": partners(compared), "full": full_method(compared), "gap": gap(evaluation), "time": self.time()}
        (self.project / "experiments.json").write_text(json.dumps(results, indent=1) + "\n")
        pictures(self.project, evaluation, compared, results)

    def compare(self, reference):
        """What the maps of each (k, rule) show."""
        compared = {}
        for k in self.args.k:
            rows = self.bench("compare", self.project, self.rules / f"k{k}", "--reference", reference, "--json")
            compared |= {(k, row["name"]): row for row in json.loads(rows)}
        return compared

    def time(self):
        """Planning as `plan_timed` has it; matching in seconds of one core per map."""
        note = self.project / "matching.json"
        if not note.exists():
            # The difference, so that reading the model does not count.
            few, more = (self.cpu_of_matching(maps) for maps in TIMED)
            note.write_text(json.dumps((more - few) / (TIMED[1] - TIMED[0])) + "\n")
        return {name: json.loads((self.project / f"{name}.json").read_text()) for name in ("planning", "matching")}

    def cpu_of_matching(self, maps):
        """Seconds of the first maps of the plan, each pair matched anew."""
        with tempfile.TemporaryDirectory() as scratch:
            command = [sys.executable, HERE / "sgm.py", "match", self.args.project, "--clusters", self.rules / f"k{RANKED}/ours/clusters.txt", "--out", scratch, "--image-scale", self.args.image_scale, "--stop-at", maps]
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([str(c) for c in command], check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def linked(source, project, names, settings):
    """A project with links to parts of another."""
    project.mkdir(parents=True, exist_ok=True)
    for name in names:
        if not (project / name).is_symlink():
            (project / name).symlink_to(source.resolve() / name)
    (project / "viewrank.toml").write_text(settings)


def reached_at(curve, value):
    """The first place of a rising curve that has this value; none if it never does."""
    places = np.flatnonzero(np.asarray(curve) >= value - 1e-9)
    return int(places[0]) if len(places) else None


def ranking(evaluation):
    """Clusters that each order needs, by real fulfilment and by cells of the cloud."""
    total = evaluation["kept"]["real"]
    by_triangle = {o["name"]: {round(n["share"], 2): n["clusters"] for n in o["needed"]} for o in evaluation["orders"]}
    needed = {"f_o": {name: [row[share] for share in SHARES] for name, row in by_triangle.items()}}
    for kind in ("all", "agreeing"):
        curves = {o["name"]: o["curve"] for o in evaluation["cells"][kind]["orders"]}
        needed[kind] = {name: [reached_at(curve, share) for share in SHARES] for name, curve in curves.items()}
    return {"shares": SHARES, "reachable": total, "needed": needed}


def partners(compared):
    """Quality of the maps of each rule, and f_o of all of them."""
    quality = ("completeness", "outliers", "rmse")
    return [{"k": k, "rule": rule, "maps": r["clusters"], "pairs": r["pairs"], **{name: r["quality"][name] for name in quality}, "forecast": r["predicted"], "real": r["real"]} for (k, rule), r in compared.items()]


def full_method(compared):
    """Pairs that each choice needs, in its own order and in the best one, for shares of what all clusters of Max reach at its best k."""
    total = max(row["real"] for (_, rule), row in compared.items() if rule == "maxcon")
    rows = []
    for (k, rule), row in compared.items():
        if rule in (*NEEDED, "ours-nocp"):
            needed = {name: [pairs_for(curve, share * total) for share in SHARES] for name, curve in (("needed", row["curve"]), ("optimum", row["optimum"]))}
            rows.append({"k": k, "rule": rule, "pairs": row["pairs"], **needed})
    return {"shares": SHARES, "reachable": total, "rows": rows}


def pairs_for(curve, fulfilment):
    at = reached_at(curve["fulfilment"], fulfilment)
    return None if at is None else curve["pairs"][at]


def gap(evaluation):
    """Forecast and real share of the cloud of all clusters, along the order."""
    curve = evaluation["curve"]
    return {"forecast": curve["predicted"], "all": curve["real"], "agreeing": curve["agreeing"], "f_o of all": [evaluation["predicted"], evaluation["real"]]}


def pictures(out, evaluation, compared, results):
    lines = {o["name"]: [(i, 100 * kept / evaluation["kept"]["real"]) for i, kept in enumerate(o["kept"])] for o in evaluation["orders"]}
    (out / "orders.svg").write_text(plot(lines, "key views", "real fulfilment, %"))
    names = sorted({name for _, name in compared})
    lines = {n: [(100 * r["quality"]["outliers"], 100 * r["quality"]["completeness"]) for (_, name), r in compared.items() if name == n] for n in names}
    (out / "partners.svg").write_text(plot(lines, "outliers, %", "completeness, %", marks=True))
    lines = {f"{rule} k={k}": [(p, 100 * f / results["full"]["reachable"]) for p, f in zip(r["curve"]["pairs"], r["curve"]["fulfilment"], strict=True)] for (k, rule), r in compared.items() if rule in NEEDED}
    (out / "full.svg").write_text(plot(lines, "matching pairs", "real fulfilment, %"))
    lines = {name: [(i, 100 * share) for i, share in enumerate(results["gap"][name])] for name in ("forecast", "all")}
    (out / "gap.svg").write_text(plot(lines, "key views", "share, %"))


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
    parser.add_argument("--reference", type=Path, help="reference maps (default: exact depth, else maps with many partners)")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("-k", type=lambda text: [int(k) for k in text.split(",")], default=[2, 3, 5, 11], help="partners per key view (default 2,3,5,11; 5 is needed)")
    parser.add_argument("--rules", type=lambda text: text.split(","), default=[], help="only these partner rules, ours and maxcon among them (default: all)")
    parser.add_argument("--settings", default="", help="more lines of viewrank.toml, separated by semicolons")
    parser.add_argument("--viewrank", default=os.environ.get("VIEWRANK", "viewrank"), help="the program (default: VIEWRANK, else on the path)")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    args.cache = args.cache or args.out / "pairs"
    if RANKED not in args.k or (args.rules and not set(NEEDED) <= set(args.rules)):
        parser.error(f"-k needs {RANKED}, --rules {' and '.join(NEEDED)}")
    Experiments(args).run()


if __name__ == "__main__":
    main()
