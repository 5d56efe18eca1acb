"""The hard scene: mostly trees, bushes and tall grass that move, shaded ground, a pond, views from 44 m above to eye level."""

import math

import numpy as np

from .. import outdoors
from ..camera import look
from ..flights import Views, upwards
from .layout import Foliage, Hut, Outcrop, Outdoors, Pond, Pose, Spacing, scatter

SALT = 13000
FOCAL_TO_WIDTH = 0.85
# Below this number of views, too few to join all, the arcs leave out the hut and the walk stays around the clearing.
FEW = 90
CLEARING = 11


def layout(seed):
    _, by = scatter(seed)
    return Outdoors(
        relief=1.2, slope=(0.04, -0.05), grass=0.8, rock=(0.39, 0.36, 0.33), path_half=0.7,
        path=[(-60, 12), (-28, 7), (-16, 1 + by()), (-6, -3.5), (4, -2 + by()), (12, 4), (22, 3), (60, -6)],
        outcrops=[
            Outcrop(-3 + by(), 4 + by(), 4.8, 3.6, 2.1, 20, 1.0, 10),
            Outcrop(16 + by(), -10 + by(), 4.2, 3.1, 2.5, -40, 1.3, 6),
        ],
        pond=Pond(-14, -12, 4.8, 3.4, 2.2),
        huts=[Hut(12.5, 13, 5.6, 4.2, 2.6, -25)],
        trees=50, bushes=190, boulders=16, conifers=0.3, tall_grass=34,
        spacing=Spacing(extent=(24.0, 20.0), trees_apart=1.0, around_targets=6.8, growth=1.45),
        foliage=Foliage(near=4.0, most_near=0.08, most=0.55),
        rails=[
            [(-9.5, -1.2), (-4, -1.6), (2.5, 0.2)],
            [(-9.5, 4.5), (-8.5, 9), (-3.5, 10.5)],
            [(11.5, -6.5), (11, -11), (13.5, -14.5)],
        ],
        boards=[Pose(3.6, 1.0, 30)],
        targets=[("outcrop", 0), ("outcrop", 1), ("hut", 0)], ring_radii=(11.0, 17.0, 26.0),
        walk=[
            (-16, 1), (-11, -1.5), (-6, -4.5), (0, -4.8), (5, -1.5), (6, 4), (3.5, 9), (-2, 12), (-8, 10.5), (-11.5, 5), (-10, -1),
            (-3, -4.5), (5, -4), (9.5, -6), (10, -12), (14, -16.5), (19, -16),
        ],
    )  # fmt: skip


def build(seed):
    return outdoors.build(layout(seed), seed, SALT)


def plan_views(scene, total, seed):
    """30 % nadir flight at two heights with gaps, 40 % arcs of three sizes around three things, 30 % walk among the trees."""
    views = Views(scene, seed, FOCAL_TO_WIDTH)
    flown, around = int(round(0.3 * total)), int(round(0.4 * total))
    add_flight(views, flown)
    add_arcs(views, around, few=total < FEW)
    add_walk(views, total - flown - around, few=total < FEW)
    return views.found


def add_flight(views, count):
    rng, level = views.rng, views.scene.ground.at(0, 0)
    high = min(count, max(2, count // 4))
    for k, (x, y, altitude, way, spread) in enumerate(low_places(count - high, rng) + high_places(high, rng)):
        centre = np.array([x, y, level + altitude]) + rng.normal(0, spread, 3)
        target = centre + [0, 0, -10] + rng.normal(0, 0.9, 3)
        views.add("grid_%03d" % k, look(centre, target, np.array([0, way, 0.0]) + rng.normal(0, 0.12, 3)), centre)


def low_places(count, rng):
    """A grid to and fro with some places left out: x, y, altitude, direction of flight, spread."""
    lines = max(2, int(round(math.sqrt(count / 1.1))))
    in_line = -(-count // lines) + 1
    cells = [(i, j if i % 2 == 0 else in_line - 1 - j) for i in range(lines) for j in range(in_line)]
    lost = set(rng.choice(len(cells), len(cells) - count, replace=False).tolist())
    kept = [cell for q, cell in enumerate(cells) if q not in lost]
    place = lambda i, j: (32 * (i / (lines - 1) - 0.5), 26 * (j / (in_line - 1) - 0.5))  # noqa: E731
    return [(*place(i, j), 24 + 5 * rng.random(), 1 if i % 2 == 0 else -1, 1.3) for i, j in kept]


def high_places(count, rng):
    """A spiral."""
    at = lambda i: (15 * math.cos(2.4 * i) * math.sqrt(i / count), 12 * math.sin(2.4 * i) * math.sqrt(i / count))  # noqa: E731
    return [(*at(i), 40 + 4 * rng.random(), 1, 2.0) for i in range(count)]


def add_arcs(views, total, few):
    rng, count = views.rng, [0, 0, 0]
    arcs = [(target, ring) for target in range(2 if few else 3) for ring in range(3)]
    share = np.array([5, 7, 4, 4, 5, 3, 3, 4, 3])[: len(arcs)]
    start = rng.uniform(0, 6.3, 3)
    counts = np.diff(np.round(np.concatenate([[0], np.cumsum(share)]) / share.sum() * total).astype(int))
    for (target, ring), n in zip(arcs, counts):
        middle, arc = views.target(views.scene.layout.targets[target]), rng.uniform(4.4, 5.8)
        for i in range(n):
            angle = start[target] + arc * (i + ring / 3 + rng.uniform(-0.25, 0.25)) / n
            elevation = math.radians(rng.uniform(*((24, 40), (30, 55), (32, 62))[ring]))
            radius = views.scene.layout.ring_radii[ring] * rng.uniform(0.85, 1.2)
            aim = middle + rng.normal(0, (1.2, 1.8, 2.5)[ring], 3)
            views.add_free("ring_%s_%03d" % ("abc"[target], count[target]), middle + upwards(angle, elevation, radius), aim, 0.7)
            count[target] += 1


class Walk:
    """A line among the trees, by the length along it."""

    def __init__(self, line):
        self.line = np.array(line, float)
        self.lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.line, axis=0), axis=1))])

    def at(self, s):
        return np.array([np.interp(s, self.lengths, self.line[:, axis]) for axis in (0, 1)])


def add_walk(views, count, few):
    layout = views.scene.layout
    walk = Walk(layout.walk[:CLEARING] if few else layout.walk)
    things = np.array([thing[:2] for thing in (*layout.outcrops, *layout.huts)])
    for i in range(count):
        # Steps aside, farther and farther, where something is in the way.
        for trial in np.minimum(np.arange(400), 80):
            centre, target = on_walk(views, walk, things, i, count, trial)
            if views.free(centre, look(centre, target)):
                views.add("walk_%03d" % i, look(centre, target), centre)
                break
        else:
            views.add_free("walk_%03d" % i, centre, target)


def on_walk(views, walk, things, i, count, trial):
    """Three of four look at the nearest rock or hut, the others ahead."""
    rng, ground = views.rng, views.scene.ground
    s = walk.lengths[-1] * (i + rng.uniform(0.2, 0.8)) / count
    place = walk.at(s) + rng.normal(0, 0.4 + 0.03 * trial, 2)
    ahead, nearest = walk.at(s + 1) - walk.at(s - 1), things[np.argmin(np.hypot(*(things - place).T))]
    if i % 4 == 3:
        angle = math.atan2(ahead[1], ahead[0]) + rng.normal(0, 0.3)
    else:
        angle = math.atan2(*(nearest - place)[::-1]) + rng.normal(0, 0.16)
    centre = np.array([*place, ground.at(*place) + rng.uniform(1.7, 3.6) + 0.02 * trial])
    aim = place + 9 * np.array([math.cos(angle), math.sin(angle)])
    return centre, np.array([*aim, ground.at(*aim) + rng.uniform(-0.2, 0.9)])
