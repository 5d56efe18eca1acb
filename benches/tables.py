#!/usr/bin/env python3
"""Writes the tables of the fused cloud into docs/benchmarks.md and README.md, from the cells.json that benches/cells.py wrote.

    benches/tables.py RESULTS_FOLDER

A table stands between `<!-- NAME -->` and `<!-- end -->`. The order of the sets and what they show are in SETS; a set without results is named and left out.
"""

import json
import re
import sys
from pathlib import Path

SETS = {
    "lewis": "oblique, from a drone",
    "boruszyn": "a stone relief",
    "caliterra": "nadir, fields",
    "ochota": "oblique, a city",
    "statue": "a bust in a hall, rendered",
    "room": "an interior with white walls, rendered",
    "valley": "nadir and oblique, rendered",
    "kitchen": "hand-held frames, 7-Scenes",
}
ORDERS = ("ours", "every n-th", "maxpts", "farthest view", "random", "oracle")
KINDS = {"all": "all", "agreeing": "three agree"}
ROOT = Path(__file__).resolve().parents[1]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    found = [json.loads(path.read_text()) for path in sorted(Path(sys.argv[1]).rglob("cells.json"))]
    results = {(one["set"], one["matcher"]): one for one in found}
    for matcher in ("openmvs", "sgm"):
        missing = [name for name in SETS if (name, matcher) not in results]
        if missing:
            print(f"{matcher}: no results of {', '.join(missing)}", file=sys.stderr)
    openmvs, sgm = ([results[name, matcher] for name in SETS if (name, matcher) in results] for matcher in ("openmvs", "sgm"))
    tables = {"cells-openmvs": covered(openmvs), "cells-sgm": covered(sgm), "maps-openmvs": needed(openmvs), "default-openmvs": default(openmvs), "default-sgm": default(sgm), "check-openmvs": checked(openmvs)}
    replace(ROOT / "docs/benchmarks.md", tables)
    replace(ROOT / "README.md", {"saved": saved(openmvs)})


def replace(path, tables):
    text = path.read_text(encoding="utf-8")
    for name, lines in tables.items():
        block = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.S)
        if lines and block.search(text):
            text = block.sub(lambda found: found[1] + "\n".join(lines) + "\n" + found[2], text)
    path.write_text(text, encoding="utf-8")


def table(head, rows):
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def order(result, kind, name):
    return next(order for order in result["cells"][kind]["orders"] if order["name"] == name)


def title(result):
    return f"{result['set']}: {SETS[result['set']]}, {result['cells']['maps']}"


def covered(results):
    """Cells covered at 10, 20, 30 and 50 % of the maps."""
    rows = []
    for result in results:
        for kind, name in KINDS.items():
            shares = [" ".join(f"{100 * share:.0f}" for share in order(result, kind, one)["covered"]) for one in ORDERS]
            way = " ".join("–" if way is None else f"{way:.2f}" for way in order(result, kind, "ours")["way"])
            rows.append([title(result) if kind == "all" else "", name, *shares, way])
    return table(["set, maps", "cells", *ORDERS, "way of ours"], rows) if rows else []


def needed(results):
    """Maps for 50, 70, 80 and 90 % of all cells."""
    orders = [one for one in ORDERS if one != "random"]
    rows = [[f"{result['set']}, {result['cells']['maps']}", *(", ".join(map(str, order(result, "all", one)["needed"])) for one in orders)] for result in results]
    return table(["set, maps", *orders], rows) if rows else []


def default(results):
    """What the default plan promised and gave."""
    rows = []
    for result in results:
        plan = result["default"]
        shares = [f"{100 * value:.1f}" for value in (plan["forecast"], plan["covered"]["all"], plan["covered"]["agreeing"])]
        rows.append([f"{result['set']}, {result['cells']['maps']}", str(plan["maps"]), *shares, ", ".join(f"{100 * plan['every n-th'][kind]:.1f}" for kind in KINDS)])
    return table(["set, maps", "plan", "forecast share", "covered of all cells", "where three agree", "every n-th"], rows) if rows else []


def checked(results):
    """The table against real fusions of the first maps."""
    rows = [[result["set"], *(f"{of['real']:.1f}, {of['said']:.1f}" for of in result["check"])] for result in results if "check" in result]
    if not rows:
        return []
    first = next(result for result in results if "check" in result)
    return table(["set: real, said", *(f"{of['order']}, {percent}" for of, percent in zip(first["check"], ("10 %", "10 %", "30 %", "30 %")))], rows)


def saved(results):
    """Maps for half and for 80 % of all cells, fewest in bold."""
    orders, rows = ("ours", "every n-th", "maxpts"), []
    for result in results:
        row = [f"{result['set']}, {SETS[result['set']].removesuffix(', rendered')}", str(result["cells"]["maps"])]
        for place in (0, 2):
            maps = [order(result, "all", one)["needed"][place] for one in orders]
            row += [f"**{number}**" if number == min(maps) else str(number) for number in maps]
        rows.append(row)
    return table(["set", "all", "half: viewrank", "every n-th", "maxpts", "80 %: viewrank", "every n-th", "maxpts"], rows) if rows else []


if __name__ == "__main__":
    sys.exit(main())
