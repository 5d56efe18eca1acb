#!/usr/bin/env python3
"""Draws the pictures of README.md and docs/ from fixtures/valley, in docs/pictures.

    python3 benches/pictures.py [--caliterra FOLDER] [--viewrank target/release/viewrank] [--browser chromium]

`strip.svg` is a flight with missing strips: `caliterra` (benches/sets.py) without the images of GONE. It needs pycolmap, and stays as it is without --caliterra.
`fill.svg` is the map of a plan filling up view by view, beside its curve; `method.svg` the way from photographs to files; `report.png` is a
screenshot, which needs Chromium and the packages websockets and pillow. Without them it stays as it is.
"""

import argparse
import base64
import io
import json
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "pictures"

# Seconds that each further depth map is shown, and the last state.
STEP, LAST = 1.1, 3.5
TEXT = 'font-family="system-ui, Segoe UI, sans-serif"'
HOLE = "#8d8f93"
# Numbers of the images that strip.svg leaves out, and the polygon that was to be flown, scene units.
GONE = {*range(9354, 9361), *range(9375, 9403), *range(9424, 9427)}
SITE = [[-62, -36], [60, -36], [60, 34], [-62, 34], [-62, -36]]
# Colours of a place by what shows it.
SHOWN, NO_PHOTOGRAPH, ONE_PHOTOGRAPH = "#a9c4d4", "#c43d2b", "#eda287"
PLANNED = "#b03a86"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--viewrank", type=Path, default=ROOT / "target/release/viewrank")
    parser.add_argument("--caliterra", type=Path, help="folder of that set")
    parser.add_argument("--browser", default="chromium")
    options = parser.parse_args()
    OUT.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        project = Path(folder) / "valley"
        shutil.copytree(ROOT / "fixtures/valley", project, ignore=shutil.ignore_patterns("viewrank"))
        for command in (["plan", "--backend", "openmvs"], ["report"]):
            subprocess.run([options.viewrank.resolve(), *command, project, "--quiet"], check=True)
        page = project / "viewrank/report.html"
        (OUT / "fill.svg").write_text(fill(read(page)))
        (OUT / "method.svg").write_text(method())
        screenshot(options.browser, page, OUT / "report.png", 1200, 760)
        if options.caliterra:
            flight = Path(folder) / "flight"
            region = leave_out_strips(options.caliterra, flight)
            for command in (["plan", "--backend", "openmvs", "--region", region], ["report"]):
                subprocess.run([options.viewrank.resolve(), *command, flight, "--quiet"], check=True)
            (OUT / "strip.svg").write_text(strip(flight / "viewrank"))


def leave_out_strips(source, target):
    """Writes the project without the images of GONE, and the polygon; returns the polygon's file."""
    import pycolmap

    model = pycolmap.Reconstruction(source / "sparse/0")
    for image in list(model.images.values()):
        if int(re.search(r"\d+", image.name)[0]) in GONE:
            model.deregister_frame(image.frame_id)
    (target / "sparse/0").mkdir(parents=True)
    model.write_binary(target / "sparse/0")
    (target / "images").symlink_to((source / "images").resolve())
    region = target / "site.json"
    region.write_text(json.dumps({"type": "Polygon", "coordinates": [SITE]}))
    return region


def read(page):
    """The data of a report; arrays decoded as lists."""
    text = re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text(), re.S).group(1)
    return json.loads(text)


def numbers(text, kind):
    raw = base64.b64decode(text)
    return struct.unpack(f"<{len(raw) // struct.calcsize(kind)}{kind}", raw)


def mixed(ramp, share):
    """Colour of a share between the three of the ramp."""
    at = min(max(share, 0), 1) * 2
    low, high = (ramp[0], ramp[1]) if at < 1 else (ramp[1], ramp[2])
    part = at if at < 1 else at - 1
    return "#" + "".join(f"{round(a + part * (b - a)):02x}" for a, b in zip(low, high))


class Map:
    """The surface from above, and the colour of each triangle after a number of depth maps."""

    def __init__(self, data, size, room=14):
        surface = data["surface"]
        corners = numbers(surface["vertices"], "f")
        self.triangles = list(zip(*[iter(numbers(surface["triangles"], "I"))] * 3))
        self.offsets, self.ranks = numbers(surface["offsets"], "I"), numbers(surface["ranks"], "I")
        self.shares, self.reason = numbers(surface["shares"], "B"), numbers(surface["reason"], "B")
        self.ramp = data["ramp"]
        low, high = (data["subject"][end][:2] for end in ("low", "high"))
        scale = min((size[i] - 2 * room) / (high[i] - low[i]) for i in (0, 1))
        middle = [(low[i] + high[i]) / 2 for i in (0, 1)]
        self.to_page = lambda x, y: (size[0] / 2 + scale * (x - middle[0]), size[1] / 2 - scale * (y - middle[1]))
        self.corners = [(self.to_page(x, y), z) for x, y, z in zip(*[iter(corners)] * 3)]
        # Low triangles first, so that roofs hide what is below.
        self.order = sorted(range(len(self.triangles)), key=lambda t: sum(self.corners[v][1] for v in self.triangles[t]))

    def colour(self, triangle, cut):
        if self.reason[triangle]:
            return HOLE
        steps = range(self.offsets[triangle], self.offsets[triangle + 1])
        reached = max((self.shares[i] for i in steps if self.ranks[i] <= cut), default=0)
        return mixed(self.ramp, round(reached / 255 * 8) / 8)

    def path(self, triangles):
        """One path for triangles of one colour."""
        def one(triangle):
            (ax, ay), *rest = [self.corners[v][0] for v in self.triangles[triangle]]
            return f"M{ax:.0f} {ay:.0f}" + "".join(f"L{x:.0f} {y:.0f}" for x, y in rest) + "z"
        return "".join(map(one, triangles))

    def layer(self, triangles, cut):
        """The triangles in the colours of a cut, drawn from low to high."""
        by_colour = {}
        for triangle in triangles:
            by_colour.setdefault(self.colour(triangle, cut), []).append(triangle)
        return "".join(f'<path fill="{colour}" stroke="{colour}" stroke-width=".7" d="{self.path(of)}"/>' for colour, of in by_colour.items())


def fill(data):
    """SVG: the map after 0, 1, 2 ... depth maps, and the curve up to there."""
    width, height, half = 900, 380, 430
    cut, shares = data["cut"], numbers(data["ranking"]["shares"], "d")
    ground = Map(data, (half, height))
    keys = numbers(data["ranking"]["keys"], "I")
    centres = list(zip(*[iter(numbers(data["views"]["centres"], "f"))] * 3))
    x = lambda maps: half + 70 + (width - half - 100) * maps / len(shares)
    y = lambda share: height - 60 - (height - 145) * share
    whole = LAST + STEP * (cut + 1)
    styles, layers, labels = [], [], []
    for step in range(cut + 1):
        start = 100 * STEP * step / whole
        hide = "" if step == 0 else f"0%,{start:.2f}%{{opacity:0}}{start + 1.5:.2f}%,"
        end = 100 if step == cut else 100 * STEP * (step + 1) / whole
        # Later layers cover the earlier ones; only the numbers change places.
        styles.append(f"@keyframes l{step}{{{hide}100%{{opacity:1}}}}.l{step}{{animation:l{step} {whole}s infinite}}")
        after = "" if step == cut else f"{end:.2f}%,100%{{opacity:0}}"
        before = "" if step == 0 else f"0%,{start - .01:.2f}%{{opacity:0}}"
        styles.append(f"@keyframes n{step}{{{before}{start:.2f}%,{end - .01:.2f}%{{opacity:1}}{after}}}.n{step}{{animation:n{step} {whole}s infinite}}")
        changed = [t for t in ground.order if step == 0 or ground.colour(t, step) != ground.colour(t, step - 1)]
        dot = ""
        if step:
            px, py = ground.to_page(*centres[keys[step - 1]][:2])
            dot = f'<circle cx="{px:.0f}" cy="{py:.0f}" r="7" fill="#b03a86" stroke="#fff" stroke-width="2"/>'
            before_share = shares[step - 2] if step > 1 else 0
            labels.append(f'<path class="l{step}" d="M{x(step - 1):.1f} {y(before_share):.1f}L{x(step):.1f} {y(shares[step - 1]):.1f}" stroke="#1668a8" stroke-width="4" stroke-linecap="round"/>')
        layers.append(f'<g class="l{step}">{ground.layer(changed, step)}{dot}</g>')
        share = shares[step - 1] if step else 0
        words = f"{step} of {len(shares)} depth maps: {100 * share:.0f} %" + (", enough" if step == cut else "")
        labels.append(f'<g class="n{step}"{"" if step == cut else " opacity=" + chr(34) + "0" + chr(34)}><circle cx="{x(step):.1f}" cy="{y(share):.1f}" r="7" fill="#c43d2b"/>'
                      f'<text x="{width - 30}" y="34" text-anchor="end" font-size="20" font-weight="600" fill="#1d2329">{words}</text></g>')
    axes = "".join(f'<path d="M{half + 70} {y(v / 100):.0f}H{width - 30}" stroke="#d9dee3"/><text x="{half + 62}" y="{y(v / 100) + 5:.0f}" text-anchor="end">{v} %</text>' for v in (0, 25, 50, 75, 100))
    axes += "".join(f'<text x="{x(n):.0f}" y="{height - 38}" text-anchor="middle">{n}</text>' for n in range(0, len(shares) + 1, 7))
    rest = " ".join(f"{x(i + 1):.1f},{y(s):.1f}" for i, s in enumerate(shares))
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" {TEXT} font-size="14" fill="#5b6670" role="img">'
            f"<title>A map of a scene fills up as depth maps are computed, best first: {cut} of {len(shares)} give {100 * shares[cut - 1]:.0f} % of what all give</title>"
            f'<style>@media (prefers-reduced-motion:no-preference){{{"".join(styles)}}}</style>'
            f'<rect width="{width}" height="{height}" rx="10" fill="#fff"/>{axes}'
            f'<text x="{half + 70 + (width - half - 100) / 2:.0f}" y="{height - 14}" text-anchor="middle">depth maps computed, best first</text>'
            f'<text x="{width - 30}" y="54" text-anchor="end">of what all 28 give, as predicted</text>'.replace("28", str(len(shares)))
            + f'<clipPath id="map"><rect x="14" y="14" width="{half - 20}" height="{height - 28}" rx="8"/></clipPath>'
            f'<path fill="none" stroke="#a9bccb" stroke-width="2" d="M{x(0):.1f} {y(0):.1f}L{rest}"/>'
            + '<g clip-path="url(#map)">' + "".join(layers) + "</g>" + "".join(labels) + "</svg>\n")


def strip(plan):
    """SVG: the site from above, what the photographs missed, and the images that would fill it."""
    data = read(plan / "report.html")
    missed, planned = (json.loads((plan / f"flight/{name}_local.json").read_text())["features"] for name in ("missed", "waypoints"))
    width, height, top = 900, 560, 74
    beside = 6  # scene units: where the camera flew, too
    low, high = [value - beside for value in SITE[0]], [value + beside for value in SITE[2]]
    ground = Map({**data, "subject": {"low": low, "high": high}}, (width, height - top), room=8)
    at = lambda x, y: "{:.0f} {:.0f}".format(*ground.to_page(x, y))  # noqa: E731
    outline = "M" + "L".join(at(*corner) for corner in SITE) + "z"
    holes = [t for t in ground.order if ground.reason[t]]
    layers = [f'<path fill="{colour}" stroke="{colour}" stroke-width=".7" d="{ground.path(of)}"/>' for colour, of in ((SHOWN, ground.order), (HOLE, holes))]
    for of in missed:
        outline_of_gap = of["geometry"]["coordinates"][0]
        colour = ONE_PHOTOGRAPH if of["properties"]["photographs"] else NO_PHOTOGRAPH
        layers.append(f'<path fill="{colour}" d="M{"L".join(at(*corner) for corner in outline_of_gap)}z"/>')
    centres = list(zip(*[iter(numbers(data["views"]["centres"], "f"))] * 3))
    drawn = [centre for centre in centres if all(low[i] < centre[i] < high[i] for i in (0, 1))]
    layers += [f'<path fill="none" stroke="#1d2329" stroke-width="2" d="M{at(x, y)}m-4 -4l8 8m0 -8l-8 8"/>' for x, y, _ in drawn]
    for waypoint in planned:
        x, y = ground.to_page(*waypoint["geometry"]["coordinates"][:2])
        layers.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="11" fill="{PLANNED}" stroke="#fff" stroke-width="2"/><text x="{x:.0f}" y="{y + 4.5:.0f}" text-anchor="middle" font-size="13" font-weight="600" fill="#fff">{waypoint["properties"]["rank"]}</text>')
    # A site of which no photograph shows some has a warning that says how much.
    none, one = re.search(r"No photograph shows (.*?) of the region, and only one shows (.*?)\. ", " ".join(data["warnings"])).groups()
    legend, x = [], 30
    for colour, name in ((SHOWN, "enough photographs"), (HOLE, "too few together"), (ONE_PHOTOGRAPH, "only one"), (NO_PHOTOGRAPH, "none"), ("#1d2329", f"{len(centres)} flown"), (PLANNED, f"{len(planned)} planned, best first")):
        legend.append(f'<circle cx="{x}" cy="54" r="6" fill="{colour}"/><text x="{x + 12}" y="59">{name}</text>')
        x += 40 + 7.4 * len(name)
    title = f"{none} of the site in no photograph, {one} in one alone: {len(planned)} more are planned"
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" {TEXT} font-size="14" fill="#46515a" role="img"><title>{title}</title>'
            f'<rect width="{width}" height="{height}" rx="10" fill="#fff"/><text x="22" y="32" font-size="18" font-weight="600" fill="#1d2329">{title}</text>{"".join(legend)}'
            f'<clipPath id="site"><path d="{outline}"/></clipPath><g transform="translate(0 {top - 8})"><path fill="{HOLE}" d="{outline}"/><g clip-path="url(#site)">{layers[0]}{layers[1]}</g>{"".join(layers[2:])}'
            f'<path fill="none" stroke="#1d2329" stroke-width="1.5" d="{outline}"/></g></svg>\n')


# Headline, and what happens there.
BOXES = [("sparse model", "poses and points", "of COLMAP and others"), ("surface", "carved from points", "and their rays"),
         ("partners", "views that see the same", "and will match"), ("thumbnails", "matched once: what", "agrees is counted"),
         ("ranking", "the view that adds", "most comes next"), ("files", "for COLMAP, OpenMVS,", "SURE and others")]


def method():
    """SVG: the stages as boxes with arrows."""
    box, gap, height = 168, 26, 130
    width = len(BOXES) * box + (len(BOXES) - 1) * gap + 20
    parts = []
    for i, (head, *lines) in enumerate(BOXES):
        x, ends = 10 + i * (box + gap), i in (0, len(BOXES) - 1)
        parts.append(f'<rect x="{x}" y="20" width="{box}" height="90" rx="8" fill="{"#eef1f4" if ends else "#dcebf5"}" stroke="#9db3c4"/>'
                     f'<text x="{x + box / 2}" y="50" text-anchor="middle" font-size="17" font-weight="600" fill="#1d2329">{head}</text>')
        parts += [f'<text x="{x + box / 2}" y="{73 + 19 * n}" text-anchor="middle">{line}</text>' for n, line in enumerate(lines)]
        if i:
            parts.append(f'<path d="M{x - gap + 3} 65h{gap - 10}m-6 -5l6 5l-6 5" fill="none" stroke="#5b6670" stroke-width="2"/>')
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" {TEXT} font-size="13.5" fill="#46515a" role="img">'
            f"<title>How it works: {', '.join(head for head, *_ in BOXES)}</title>"
            f'<rect width="{width}" height="{height}" rx="10" fill="#fff"/>{"".join(parts)}</svg>\n')


def screenshot(program, page, out, width, height):
    """PNG of the top of a page, with few colours."""
    sys.path.insert(0, str(ROOT / "tests/python"))
    try:
        from browser import Browser
        from PIL import Image
    except ImportError as missing:
        print(f"{out.name} stays as it is: {missing}")
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(shutil.which(program) or program, profile)
        try:
            browser.open(page, width, height)
            picture = browser.picture()
        finally:
            browser.process.terminate()
            browser.process.wait()
    colours = Image.open(io.BytesIO(picture)).convert("RGB").quantize(255, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    colours.save(out, optimize=True)


if __name__ == "__main__":
    main()
