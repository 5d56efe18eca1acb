"""A furnished room of 6 x 5 x 2.8 m with nearly blank white walls and ceiling, glossy table tops, books, posters and a rug.

Somebody walks around in it and looks inwards, ahead and outwards, from 0.5 to 6 m.
"""

import math

import numpy as np

from ..furniture import Furnisher, Place
from ..handheld import Handheld
from ..materials import BOARD, CLOTH, GLOSS, MARBLE, PAINT, STONE, WALL, WINDOW
from ..plants import Leaves
from ..scene import Interior, Scene
from ..shapes import Mesh, add_turned, heading
from .layout import Indoors, scatter

SALT = 21000
FOCAL_TO_WIDTH = 0.72


def layout(seed):
    rng, by = scatter(seed)
    place = (by(0.5), by(0.3))
    sun = (rng.uniform(0, 360), 0.0, rng.uniform(48, 62))
    return Indoors((6.0, 5.0, 2.8), place, (0.50, 0.47, 0.42), sun, reach=0.7, subject=(*place, 0.75))


def build(seed):
    plan, rng, mesh, salt = layout(seed), np.random.default_rng([seed, 31]), Mesh(), 17 * seed + SALT
    add = Furnisher(mesh, rng)
    add.shell(plan.size, 0.2)
    places = along_the_walls(plan.size)
    for thing, i in zip(THINGS, rng.permutation(8)):
        thing(add, places[i], rng.uniform(-0.2, 0.2))
    add_middle(add, np.array([*plan.place, 0.0]))
    room = Interior(True, np.array(plan.stone, float), salt)
    return Scene(plan, None, mesh.whole(), Leaves.none(), room)


def along_the_walls(size):
    """Two places at each wall."""
    x, y = size[0] / 2, size[1] / 2
    feet = ((-1.5, -y, 0), (1.5, -y, 0), (x, -1.25, math.pi / 2), (x, 1.25, math.pi / 2))
    feet += ((1.5, y, math.pi), (-1.5, y, math.pi), (-x, 1.25, -math.pi / 2), (-x, -1.25, -math.pi / 2))
    return [Place(np.array([x, y, 0.0]), *heading(turn)) for x, y, turn in feet]


def add_sofa(add, place, x):
    add.sofa(place, 1.9)
    add.picture(place, x, 1.7, 1.2, 0.7)


def add_window(add, place, x):
    """With a radiator and a vase below it."""
    add.window(place, x, 1.55, 1.3, 1.3)
    for at in np.arange(-0.5, 0.55, 0.1):
        add.box(place, (x + at, 0.06, 0.40), (0.035, 0.04, 0.28), GLOSS)
    add.vase(place.moved(x + add.rng.uniform(-0.5, 0.5), 0.1, 0.9).foot, 0.2, STONE)
    add.picture(place, x - 1.0, 1.6, 0.45, 0.6)


def add_screen(add, place, x):
    add.box(place, (x, 0.22, 0.28), (0.8, 0.22, 0.28), GLOSS)
    add.box(place, (x, 0.2, 0.95), (0.55, 0.025, 0.32), WINDOW)
    add.box(place, (x, 0.2, 0.6), (0.2, 0.1, 0.03), WINDOW)
    add.ledge(place, x, 1.75, 1.1)
    add.stack(place.moved(x + 0.65, 0.22, 0.56))


def add_desk(add, place, x):
    add.table(place.moved(x, 0.38), 1.4, 0.7, 0.74)
    add.chair(place.moved(x, 0.95).turned_about())
    add.stack(place.moved(x - 0.4, 0.4, 0.74))
    add.vase(place.moved(x + 0.5, 0.3, 0.74).foot, 0.28, STONE)
    add.picture(place, x + 0.1, 1.5, 0.5, 0.7)


def add_door(add, place, x):
    add.picture(place, x, 1.03, 0.95, 2.06, WALL)
    add.picture(place, x + 0.9, 1.55, 0.5, 0.7)
    add.picture(place, x - 0.85, 1.6, 0.35, 0.45, BOARD)


def add_posters(add, place, x):
    add.picture(place, x - 0.45, 1.55, 0.6, 0.85)
    add.picture(place, x + 0.35, 1.5, 0.5, 0.5)
    add.picture(place, x + 0.35, 2.05, 0.4, 0.3, BOARD)


def add_armchair(add, place, x):
    add.sofa(place.moved(front=0.05), 0.95)
    add.picture(place, x - 0.2, 1.65, 0.8, 0.6)
    add.floor_lamp(place.moved(0.75, 0.3).foot)


THINGS = (Furnisher.shelf, add_sofa, add_window, add_screen, add_desk, add_door, add_posters, add_armchair)


def add_middle(add, foot):
    """A table on a rug with things on it, and four chairs."""
    place = Place(foot, *heading(add.rng.uniform(-0.4, 0.4)))
    add.box(place, (0.1, 0, 0.006), (1.5, 1.05, 0.006), CLOTH)
    add.table(place, 1.5, 0.85, 0.74)
    add.vase(place.moved(0.3, up=0.74).foot, 0.32, MARBLE)
    add.stack(place.moved(-0.4, 0.1, 0.74))
    add.stack(place.moved(0.55, -0.2, 0.74))
    bowl = place.moved(-0.1, -0.2, 0.74).foot
    add_turned(add.mesh, bowl, [0, 0.02, 0.06, 0.09], [0.04, 0.08, 0.12, 0.13], PAINT)
    for x, y in ((-0.4, -1), (0.4, -1), (-0.4, 1), (0.4, 1)):
        turn = math.atan2(place.front[1], place.front[0]) - math.pi / 2 + add.rng.normal(0, 0.2) + (math.pi if y > 0 else 0)
        add.chair(Place(place.moved(x, y * 0.68).foot, *heading(turn)))


def plan_views(scene, total, seed):
    """Once around while looking inwards, ahead and outwards, and some close-ups."""
    views, count = Handheld(scene, seed, FOCAL_TO_WIDTH), dict(inward=0, ahead=0, outward=0, close=0)
    for i in range(total):
        angle = 2 * math.pi * (i + views.rng.uniform(-0.3, 0.3)) / total
        kind = "close" if i % 8 == 7 else ("inward", "ahead", "inward", "outward")[i % 4]
        out = np.array([math.cos(angle), math.sin(angle), 0])
        centre, target = aimed(views, kind, angle, out)
        views.add("%s_%03d" % (kind, count[kind]), centre, target, 0.45, np.array([*(-out[:2]), 0.3]))
        count[kind] += 1
    return views.found


def aimed(views, kind, angle, out):
    """Centre and target; `out` points from the middle of the room to the wall."""
    rng, (sx, sy, _) = views.rng, views.size
    ahead = np.array([-sx * math.sin(angle), sy * math.cos(angle), 0])
    ahead /= np.linalg.norm(ahead)
    edge = min(sx / 2 / (abs(out[0]) + 1e-9), sy / 2 / (abs(out[1]) + 1e-9))
    centre = np.array([0, 0, rng.uniform(1.25, 1.8)])
    if kind == "inward":
        centre = centre + out * (edge - rng.uniform(0.5, 1.0))
        return centre, views.subject + rng.normal(0, 0.25, 3) + 0.3 * out
    if kind == "ahead":
        centre = centre + out * rng.uniform(0.62, 0.8) * edge
        return centre, centre + 2 * ahead - rng.uniform(0, 0.8) * out + [0, 0, rng.uniform(-0.8, -0.2)]
    if kind == "outward":
        centre = centre + out * rng.uniform(-0.35, 0.2) * edge
        return centre, centre + 2 * out + 0.4 * rng.normal() * ahead + [0, 0, rng.uniform(-0.9, -0.1)]
    centre = centre + out * (edge - rng.uniform(1.0, 1.5))
    return centre, np.array([*(out * (edge - 0.1))[:2], rng.uniform(0.5, 1.5)])
