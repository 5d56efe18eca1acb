"""A richly textured stone bust of 0.62 m on a pedestal in a hall of 26 x 18 x 6.5 m, taken by hand in three rings and some close-ups.

Most of the background, which is in every picture, is blank or seen with a small baseline.
"""

import math

import numpy as np

from ..bust import add_bust
from ..flights import upwards
from ..furniture import Furnisher, Place
from ..handheld import Handheld
from ..materials import BOARD, CLOTH, GLOSS, PAINT, STONE, WALL, WOOD
from ..plants import Leaves
from ..scene import Interior, Scene
from ..shapes import Mesh, add_boulder, add_box, heading
from .layout import Indoors, scatter

SALT = 17000
FOCAL_TO_WIDTH = 1.0
# Which of the four walls are first: windows, pictures, door.
ORDERS = ((0, 1, 2, 3), (1, 0, 3, 2), (0, 1, 3, 2), (1, 0, 2, 3))


def layout(seed):
    rng, by = scatter(seed)
    place = (-2.5 + 3 * by(), 3 * by(0.4))
    sun = (rng.uniform(0, 360), 0.0, rng.uniform(42, 55))
    return Indoors((26.0, 18.0, 6.5), place, (0.56, 0.51, 0.43), sun, reach=1.2, subject=(*place, 1.33))


def build(seed):
    plan, rng, mesh, salt = layout(seed), np.random.default_rng([seed, 31]), Mesh(), 17 * seed + SALT
    add = Furnisher(mesh, rng)
    add.shell(plan.size, 0.4)
    add_subject(add, np.array([*plan.place, 0.0]), salt)
    add_walls(add, plan.size, ORDERS[seed % 4])
    for x in np.arange(-10, 11, 4):
        add_box(mesh, (x, 0, plan.size[2] - 0.15), ((1, 0, 0), (0, 1, 0), (0, 0, 1)), (0.14, plan.size[1] / 2, 0.15), WOOD)
    taken = [(*plan.place, 2.7)]
    add_pillars(add, plan.size[2], taken)
    for k in range(22):
        add_thing(add, Place(free_spot(plan.size, taken, rng), *heading(rng.uniform(0, 6.3))), k, salt)
    room = Interior(False, np.array(plan.stone, float), salt)
    return Scene(plan, None, mesh.whole(), Leaves.none(), room)


def add_subject(add, foot, salt):
    place = Place(foot, *heading(add.rng.uniform(0, 6.3)))
    for z, high, wide in ((0.07, 0.07, 0.29), (0.52, 0.38, 0.20), (0.17, 0.03, 0.24), (0.93, 0.03, 0.23), (0.98, 0.02, 0.26)):
        add.box(place, (0, 0, z), (wide, wide, high), STONE)
    add.box(place, (0, -0.205, 0.62), (0.11, 0.006, 0.07), BOARD)
    turn = math.atan2(place.front[1], place.front[0]) + math.pi / 2 + math.pi
    add_bust(add.mesh, foot + [0, 0, 1.0], turn, salt + 300, add.rng)


def add_walls(add, size, order):
    x, y = size[0] / 2, size[1] / 2
    walls = [
        (Place(np.array([0, -y, 0]), np.array([-1.0, 0, 0]), np.array([0, 1.0, 0])), size[0]),
        (Place(np.array([0, y, 0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0])), size[0]),
        (Place(np.array([x, 0, 0]), np.array([0, -1.0, 0]), np.array([-1.0, 0, 0])), size[1]),
        (Place(np.array([-x, 0, 0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0])), size[1]),
    ]
    walls, rng = [walls[i] for i in order], add.rng
    windows, pictures, door, board = (wall for wall, _ in walls)
    for k in range(5):
        add.window(windows, (k - 2) * 4.9, 3.3, 1.9, 3.6)
    for k in range(6):
        x, z = (k - 2.5) * 4 + rng.normal(0, 0.4), rng.uniform(1.6, 2.4)
        add.picture(pictures, x, z, rng.uniform(0.7, 2.6), rng.uniform(0.7, 1.7))
    add.picture(door, -3.5, 1.15, 1.3, 2.3, WOOD)
    add.picture(door, 3.0, 3.4, 2.6, 3.0, CLOTH)
    add.picture(board, rng.uniform(-6, 6), 1.7, 1.1, 0.8, BOARD)
    for wall, length in walls:
        add.box(wall, (0, 0.02, 0.09), (length / 2, 0.02, 0.09), WOOD)


def add_pillars(add, height, taken):
    for i, x in enumerate((-9, -3, 3, 9)):
        for j, y in enumerate((-5.8, 5.8)):
            taken.append((x, y, 0.9))
            add.pillar(np.array([x, y, 0]), height, STONE if (i + j) % 2 else WALL)


def free_spot(size, taken, rng, apart=0.8):
    for _ in range(4000):
        x, y = rng.uniform(-size[0] / 2 + 1, size[0] / 2 - 1), rng.uniform(-size[1] / 2 + 1, size[1] / 2 - 1)
        if all(math.hypot(x - q[0], y - q[1]) > apart + q[2] for q in taken):
            taken.append((x, y, apart))
            return np.array([x, y, 0])
    raise RuntimeError("the hall is full")


def add_thing(add, place, k, salt):
    """Seven kinds of things in turn."""
    kind = k % 7
    if kind == 0:
        add.box(place, (0, 0, 0.45), (0.55, 0.35, 0.45), PAINT)
        add.box(place, (0, 0, 0.93), (0.6, 0.4, 0.03), GLOSS)
        add.stack(place._replace(foot=place.foot + [0, 0, 0.96]))
    elif kind == 1:
        add.table(place, 1.6, 0.45, 0.45, WOOD)
    elif kind == 2:
        add.box(place, (0, 0, 0.45), (0.22, 0.22, 0.45), WALL)
        add.vase(place.foot + [0, 0, 0.9], 0.55, STONE)
    elif kind == 3:
        add.box(place, (0, 0, 0.3), (0.4, 0.4, 0.3), STONE)
        add_boulder(add.mesh, place.foot + [0, 0, 0.9], 0.38, salt + 40 + k, add.rng)
    elif kind == 4:
        add_screen(add, place)
    elif kind == 5:
        add.sofa(place, 1.8)
    else:
        add.chair(place)
        add.chair(place.moved(along=0.8))


def add_screen(add, place):
    """A standing wall with a picture on each side."""
    foot, along, front = place
    add.box(place, (0, 0, 0.95), (0.75, 0.04, 0.95), WALL)
    add.picture(Place(foot + 0.04 * front, -along, front), 0, 1.25, 1.2, 0.9)
    add.picture(Place(foot - 0.04 * front, along, -front), 0, 1.25, 0.9, 0.7, BOARD)


def plan_views(scene, total, seed):
    """80 % in three rings (a little from below, from above, from well above), 20 % close-ups."""
    views = Handheld(scene, seed, FOCAL_TO_WIDTH)
    counts = np.round(np.array([0.28, 0.30, 0.22]) * total).astype(int)
    for ring, (count, elevation, radius) in enumerate(zip(counts, (-6, 14, 38), (0.98, 1.05, 0.95))):
        add_ring(views, "abc"[ring], count, elevation, radius)
    add_close_ups(views, total - counts.sum())
    return views.found


def add_ring(views, name, count, elevation, radius):
    rng, start = views.rng, views.rng.uniform(0, 6.3)
    for i in range(count):
        angle = start + 2 * math.pi * (i + rng.uniform(-0.3, 0.3)) / count
        up = math.radians(elevation + rng.normal(0, 4))
        centre = views.subject + upwards(angle, up, radius * rng.uniform(0.85, 1.2))
        views.add("ring_%s_%03d" % (name, i), centre, views.subject + rng.normal(0, 0.04, 3), 0.3)


def add_close_ups(views, count):
    rng = views.rng
    for i in range(count):
        angle = 2 * math.pi * (i + rng.uniform(-0.3, 0.3)) / count + 0.3
        centre = views.subject + upwards(angle, math.radians(rng.uniform(-5, 35)), rng.uniform(0.52, 0.75))
        views.add("close_%03d" % i, centre, views.subject + rng.normal(0, 1, 3) * [0.05, 0.05, 0.12], 0.2)
