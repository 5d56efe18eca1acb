#!/usr/bin/env python3
"""Draws what benches/sizes.py has measured: cells covered over work, a panel per set.

    benches/sizes_curves.py WORK_FOLDER/openmvs-0.5 ... > docs/pictures/sizes.svg

The folders that hold rows.json; each WORK_FOLDER is named like its set.
"""

import json
import sys
from pathlib import Path

PLANS = {"two sizes, worth 0.8": ("two sizes", "#0b6e4f"), "full size": ("full size", "#1f5fa8"), "half size": ("half size", "#c26a00"),
         "every n-th": ("every n-th, full size", "#8a8f94"), "OpenMVS alone, half size": ("OpenMVS alone, half size", "#b3261e")}
WIDTH, HEIGHT, LEFT, TOP, GAP = 230, 170, 44, 34, 56


def main():
    folders = [Path(folder) for folder in sys.argv[1:]]
    if not folders:
        sys.exit(__doc__)
    panels = [panel(folder.resolve().parent.name, json.loads((folder / "rows.json").read_text())) for folder in folders]
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    place = lambda i: f"translate({LEFT + i % columns * (WIDTH + GAP)} {TOP + i // columns * (HEIGHT + GAP + 10)})"  # noqa: E731
    drawn = "".join(f'<g transform="{place(i)}">{text}</g>' for i, text in enumerate(panels))
    width, bottom = LEFT + columns * (WIDTH + GAP), TOP + lines * (HEIGHT + GAP + 10)
    legend = "".join(f'<circle cx="{LEFT + i * 165}" cy="{bottom}" r="4" fill="{colour}"/><text x="{LEFT + 9 + i * 165}" y="{bottom + 4}">{name}</text>'
                     for i, (name, colour) in enumerate(PLANS.values()))
    print(f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {bottom + 22}" font-family="system-ui, sans-serif" font-size="12">'
          f'<title>Cells covered by the fused cloud over work, at one and at two sizes</title><rect width="100%" height="100%" fill="#fff"/>{drawn}{legend}</svg>')


def panel(name, rows):
    x, y = (lambda work: work / 100 * WIDTH), (lambda share: (1 - share / 100) * HEIGHT)
    grid = "".join(f'<path d="M0 {y(v):.0f}H{WIDTH}M{x(v):.0f} 0V{HEIGHT}" stroke="#e5e8ea"/><text x="-6" y="{y(v) + 4:.0f}" text-anchor="end" fill="#5b6670">{v}</text>'
                   f'<text x="{x(v):.0f}" y="{HEIGHT + 15}" text-anchor="middle" fill="#5b6670">{v}</text>' for v in (0, 25, 50, 75, 100))
    lines = ""
    for plan, (_, colour) in PLANS.items():
        points = [(x(row["work"]), y(row["covered"])) for row in rows if row["plan"] == plan]
        lines += f'<polyline points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in points)}" fill="none" stroke="{colour}" stroke-width="1.6"/>'
        lines += "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.4" fill="{colour}"/>' for a, b in points)
    title = f'<text x="0" y="-10" font-weight="600">{name}: covered %, by work %</text>'
    return title + grid + lines


if __name__ == "__main__":
    main()
