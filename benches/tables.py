#!/usr/bin/env python3
"""Writes the tables of docs/benchmarks.md and README.md, from cells.json of benches/cells.py, splats.json of benches/splats.py, partners.json of
benches/partners.py, experiments.json and planning.json of integrations/sgm/experiments.py.

    benches/tables.py RESULTS_FOLDER

A table stands between `<!-- NAME -->` and `<!-- end -->`. The order of the sets and what they show are in SETS; a set without results is named and left out.
"""

import json
import re
import sys
from pathlib import Path

import paper

SETS = {
    "lewis": "oblique, from a drone",
    "boruszyn": "a farm, from a kite",
    "caliterra": "nadir, fields",
    "ochota": "oblique, a city",
    "statue": "a bust in a hall, rendered",
    "room": "an interior with white walls, rendered",
    "valley": "nadir and oblique, rendered",
    "kitchen": "hand-held frames, 7-Scenes",
    "office": "hand-held, a room, COLMAP's own maps",
}
MATCHERS = ("openmvs", "sgm", "colmap", "patchmatchnet")
ORDERS = ("ours", "every n-th", "maxpts", "oracle")
ROOT = Path(__file__).resolve().parents[1]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    by_set = lambda name: {path.parent.name: json.loads(path.read_text()) for path in sorted(Path(sys.argv[1]).rglob(name))}
    found = [json.loads(path.read_text()) for path in sorted(Path(sys.argv[1]).rglob("cells.json"))]
    results = {(one["set"], one["matcher"]): one for one in found}
    for matcher in MATCHERS:
        missing = [name for name in SETS if (name, matcher) not in results]
        if missing:
            print(f"{matcher}: no results of {', '.join(missing)}", file=sys.stderr)
    of_matcher = {matcher: [results[name, matcher] for name in SETS if (name, matcher) in results] for matcher in MATCHERS}
    openmvs = of_matcher["openmvs"]
    tables = {f"cells-{matcher}": covered(of) for matcher, of in of_matcher.items()}
    tables |= {f"default-{matcher}": default(of) for matcher, of in of_matcher.items()}
    tables |= {f"check-{matcher}": checked(of) for matcher, of in of_matcher.items()}
    tables["reached-patchmatchnet"] = reached(of_matcher["patchmatchnet"])
    trained = by_set("splats.json")
    tables["splats"] = splats(trained)
    timed = by_set("planning.json")
    tables["planning"] = paper.planning(timed) if timed else []
    tables["partners-exact"] = partners([*by_set("partners.json").values()])
    tables |= paper.tables([*by_set("experiments.json").values()])
    replace(ROOT / "docs/benchmarks.md", tables)
    replace(ROOT / "README.md", {"saved": saved(openmvs), "splats": splats(trained, with_sets=False)})


def replace(path, tables):
    text = path.read_text(encoding="utf-8")
    for name, lines in tables.items():
        block = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.S)
        if lines and block.search(text):
            text = block.sub(lambda found: found[1] + "\n".join(lines) + "\n" + found[2], text)
    path.write_text(text, encoding="utf-8")


def table(head, rows):
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def order(result, name):
    return next(order for order in result["cells"]["all"]["orders"] if order["name"] == name)


def title(result):
    return f"{result['set']}, {result['cells']['maps']}"


def covered(results):
    """All cells covered at 10, 20, 30 and 50 % of the maps by each order, and the way of ours."""
    if not results:
        return []
    rows = []
    for result in results:
        shares = [" ".join(f"{100 * share:.0f}" for share in order(result, one)["covered"]) for one in ORDERS]
        way = " ".join("–" if way is None else f"{way:.2f}".replace("0.", ".") for way in order(result, "ours")["way"])
        rows.append([title(result), *shares, way])
    return table(["set, maps", *ORDERS, "way of ours"], rows)


def default(results):
    """What the default plan gave: in a fusion of its maps alone where there was one, else by the table of cells."""
    rows = []
    for result in results:
        plan, spread = result["default"], result["default"]["every n-th"]
        given = [of["fused"] if "fused" in of else cells["all"] for of, cells in ((plan, plan["covered"]), (spread, spread))]
        rows.append([title(result), str(plan["maps"]), *(f"{100 * share:.1f}" for share in given)])
    return table(["set, maps", "plan", "gave", "every n-th"], rows) if rows else []


def checked(results):
    """The table of cells against real fusions of the first 10 and 30 % of the maps."""
    rows = [[result["set"], *(f"{of['real']:.1f}, {of['said']:.1f}" for of in result["check"])] for result in results if "check" in result]
    return table(["fused, by the table", *(f"{order}, {share}" for share in ("10 %", "30 %") for order in ("ours", "every n-th"))], rows) if rows else []


def reached(results):
    """The share of all maps that `viewrank evaluate` says of the first ones, and the share of the cells that they cover."""
    rows = [[title(result), *(f"{100 * of['said']:.0f}, {100 * of['real']:.0f}" for of in result["so far"])] for result in results if result["so far"]]
    return table(["said, covered", "10 %", "20 %", "30 %", "50 %"], rows) if rows else []


def splats(of_sets, with_sets=True):
    """PSNR of splats by the order that their images are taken in, means over the trainings; for each share of the images their mean, for the smaller ones the sets, too."""
    names = list(dict.fromkeys(row["order"] for rows in of_sets.values() for row in rows))
    lines = []
    for share in sorted({row["share"] for rows in of_sets.values() for row in rows}):
        psnr, ssim = [], []
        for of_set, rows in of_sets.items():
            rows = [row for row in rows if row["share"] == share]
            if rows:
                for means, kind in ((psnr, "psnr"), (ssim, "ssim")):
                    means.append([mean([row[kind] for row in rows if row["order"] == name]) for name in names])
                if with_sets and share < 0.5:
                    lines.append([f"{of_set}, {rows[0]['images']} images", *(f"{of_order:.2f}" for of_order in psnr[-1])])
        both = zip(zip(*psnr), zip(*ssim))
        lines.append([f"mean at {100 * share:.0f} % (SSIM)", *(f"{mean(of_psnr):.2f} ({mean(of_ssim):.3f})" for of_psnr, of_ssim in both)])
    return table(["PSNR, dB", *names], lines) if lines else []


def partners(results):
    """Clouds of OpenMVS by numbers of partners against exact depth."""
    rows = []
    for result in sorted(results, key=lambda result: list(SETS).index(result["set"])):
        for row in result["rows"] if result["exact"] and result["matcher"] == "openmvs" else []:
            at_work = [f"{100 * at['F1']:.1f} ({at['maps']})" for at in row["at"]]
            rows.append([result["set"], str(row["k"]), f"{row['seconds']:.0f}", f"{100 * row['F1']:.1f}", *at_work])
    return table(["set", "k", "CPU s", "F1", *(f"F1 in {share} of the time" for share in ("¼", "½", "all"))], rows) if rows else []


def mean(values):
    return sum(values) / len(values)


def saved(results):
    """Minutes and points of all maps and of the default plan."""
    rows = []
    for result in results:
        plan = result["default"]
        if "fused" not in plan:
            continue
        minutes = {name: seconds / 60 for name, seconds in plan["seconds"].items()}
        points = {name: f"{count / 1000:,.0f} k" for name, count in plan["points"].items()}
        of_all = [str(result["cells"]["maps"]), f"{minutes['all']:.1f}", points["all"]]
        of_plan = [str(plan["maps"]), f"{minutes['planning'] + minutes['matching']:.1f}", points["plan"]]
        shares = [f"{100 * of['fused']:.0f} %" for of in (plan, plan["every n-th"])]
        rows.append([f"{result['set']}, {SETS[result['set']].removesuffix(', rendered')}", *of_all, *of_plan, *shares])
    return table(["set", "all maps", "minutes", "points", "plan", "minutes", "points", "of the area", "every n-th"], rows) if rows else []


if __name__ == "__main__":
    sys.exit(main())
