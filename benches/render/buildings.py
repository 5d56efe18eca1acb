"""Huts, walls, cars, boards and hand rails."""

import math

import numpy as np

from .materials import BARK, BOARD, PAINT, PLASTER, ROOF, STONE, WINDOW, WOOD
from .shapes import UP, add_box, add_tube, heading

QUAD = [(0, 1, 2), (0, 2, 3)]


class Hut:
    """A plastered house with a gable roof, on its pad; u along, v across, w up from the foot of the walls."""

    def __init__(self, mesh, hut, level):
        self.mesh = mesh
        self.axes = (*heading(math.radians(hut.turn)), UP)
        self.foot = np.array([hut.x, hut.y, level - 0.3])
        self.half = hut.length / 2, hut.width / 2
        self.hut, self.walls, self.rise = hut, hut.height + 0.3, hut.width / 2 * 0.75

    def at(self, u, v, w):
        ex, ey, ez = self.axes
        return self.foot + u * ex + v * ey + w * ez

    def add(self):
        self.add_walls()
        self.add_roof()
        hx, hy = self.half
        self.add_openings(hx, hy)

    def add_walls(self):
        (hx, hy), top, obj = self.half, self.walls, self.mesh.new_object()
        corners = ((-hx, -hy), (hx, -hy), (hx, hy), (-hx, hy), (-hx, -hy))
        for p, q in zip(corners, corners[1:]):
            length = math.hypot(q[0] - p[0], q[1] - p[1])
            wall = [self.at(*p, 0), self.at(*q, 0), self.at(*q, top), self.at(*p, top)]
            self.mesh.add(wall, QUAD, PLASTER, texture=[(0, 0), (length, 0), (length, top), (0, top)], obj=obj)
        for side, order in ((-hx, (0, 2, 1)), (hx, (0, 1, 2))):
            gable = [self.at(side, -hy, top), self.at(side, hy, top), self.at(side, 0, top + self.rise)]
            texture = [(0, top), (self.hut.width, top), (hy, top + self.rise)]
            self.mesh.add(gable, [order], PLASTER, texture=texture, obj=obj)

    def add_roof(self):
        (hx, hy), (ex, ey, ez), over = self.half, self.axes, 0.45
        for side in (-1, 1):
            slope = np.array([0, -side * hy, self.rise])
            slope = slope / np.linalg.norm(slope)
            up = slope[1] * ey + slope[2] * ez
            normal = np.cross(ex, up) * 1.0
            normal = -normal if normal[2] < 0 else normal
            length = math.hypot(hy, self.rise) + over
            middle = self.at(0, 0, self.walls + self.rise + 0.06) - up * (length / 2)
            add_box(self.mesh, middle, (ex, up, normal), (hx + over, length / 2, 0.06), ROOF)
        chimney = self.at(hx * 0.45, hy * 0.4, self.walls + self.rise * 0.9)
        add_box(self.mesh, chimney, self.axes, (0.3, 0.3, 0.75), STONE)

    def add_openings(self, hx, hy):
        for floor in range(1 if self.hut.height < 4 else 2):
            z = 0.3 + 1.45 + floor * 2.3
            for k in np.linspace(-0.55, 0.55, 2 if self.hut.length < 8 else 3):
                self.add_opening((k * hx, -hy), (1, 0), (1.0, 1.1), z, WINDOW)
                if abs(k) > 0.1:
                    self.add_opening((k * hx, hy), (-1, 0), (0.9, 1.0), z, WINDOW)
            self.add_opening((hx, 0.25 * hy), (0, 1), (0.9, 1.0), z, WINDOW)
        self.add_opening((-hx, 0.2 * hy), (0, -1), (1.0, 2.05), 0.3 + 1.03, WOOD)

    def add_opening(self, place, along, size, z, material):
        """A rectangle just off the wall, with a frame."""
        (u, v), (w, h), (ex, ey, ez) = place, size, self.axes
        t, n = np.array(along), np.array([along[1], -along[0]])

        def at(a, b, d):
            return self.at(u + a * t[0] + d * n[0], v + a * t[1] + d * n[1], z + b)

        corners = [at(-w / 2, -h / 2, 0.02), at(w / 2, -h / 2, 0.02), at(w / 2, h / 2, 0.02), at(-w / 2, h / 2, 0.02)]
        self.mesh.add(corners, QUAD, material, texture=[(0, 0), (w, 0), (w, h), (0, h)])
        axes = t[0] * ex + t[1] * ey, n[0] * ex + n[1] * ey, ez
        bars = [(0, h / 2, w / 2 + 0.06, 0.05), (0, -h / 2, w / 2 + 0.06, 0.05)]
        bars += [(w / 2, 0, 0.05, h / 2), (-w / 2, 0, 0.05, h / 2), (0, 0, 0.025, h / 2)]
        for a, b, half_width, half_height in bars:
            add_box(self.mesh, at(a, b, 0.03), axes, (half_width, 0.035, half_height), WOOD)


def add_wall(mesh, ground, wall):
    """A wall of pieces of at most 2.5 m, each on its own ground."""
    x0, y0, x1, y1, height = wall
    length = math.hypot(x1 - x0, y1 - y0)
    pieces = int(length / 2.5) + 1
    along = np.array([x1 - x0, y1 - y0, 0]) / length
    for i in range(pieces):
        t = (i + 0.5) / pieces
        x, y = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
        centre = (x, y, ground.at(x, y) + height / 2 - 0.2)
        half = (length / pieces / 2, 0.14, height / 2 + 0.2)
        add_box(mesh, centre, (along, (-along[1], along[0], 0), (0, 0, 1)), half, PLASTER)


def add_car(mesh, ground, car):
    ex, ey = heading(math.radians(car.turn))
    axes = ex, ey, (0, 0, 1)
    # The roof has the paint of the body.
    paint, place = mesh.object_count, np.array([car.x, car.y, ground.at(car.x, car.y)])
    add_box(mesh, place + [0, 0, 0.62], axes, (2.1, 0.86, 0.32), PAINT)
    add_box(mesh, place - 0.25 * ex + [0, 0, 1.15], axes, (1.15, 0.76, 0.24), WINDOW)
    add_box(mesh, place - 0.25 * ex + [0, 0, 1.41], axes, (1.1, 0.74, 0.03), PAINT, obj=paint)
    for u in (-1.35, 1.35):
        for v in (-0.8, 0.8):
            wheel = [place + u * ex + (v + side) * ey + [0, 0, 0.32] for side in (-0.1, 0.1)]
            add_tube(mesh, wheel, 0.32, 16, BARK)


def add_board(mesh, ground, board):
    """A board to read, on two posts."""
    x, y, z = board.x, board.y, ground.at(board.x, board.y)
    c, s = math.cos(math.radians(board.turn)), math.sin(math.radians(board.turn))
    along, up = np.array([c, s, 0]), np.array([-s * 0.5, c * 0.5, 0.85])
    up /= np.linalg.norm(up)
    for u in (-0.5, 0.5):
        add_tube(mesh, [(x + u * c, y + u * s, z - 0.2), (x + u * c, y + u * s, z + 1.0)], 0.045, 8, WOOD)
    add_box(mesh, (x, y, z + 1.05), (along, up, np.cross(along, up)), (0.62, 0.42, 0.02), BOARD)


def add_rail(mesh, ground, line, rng):
    """Wooden posts every 1.9 m with two round rails."""
    line = np.array(line, float)
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    total = lengths.sum()
    posts = max(2, int(round(total / 1.9)) + 1)
    along, at = np.concatenate([[0], np.cumsum(lengths)]), np.linspace(0, total, posts)
    x, y = np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])
    z = ground(x, y)
    tops = []
    for i in range(posts):
        lean = rng.normal(0, 0.02, 2)
        top = (x[i] + lean[0], y[i] + lean[1])
        add_tube(mesh, [(x[i], y[i], z[i] - 0.3), (*top, z[i] + 1.08)], 0.06, 8, WOOD)
        tops.append((*top, z[i]))
    tops = np.array(tops)
    for height in (0.5, 0.97):
        for i in range(posts - 1):
            a, b = (tops[k] + [0, 0, height + rng.normal(0, 0.015)] for k in (i, i + 1))
            over = (b - a) * 0.04
            add_tube(mesh, [a - over, (a + b) / 2 - [0, 0, 0.01], b + over], [0.042, 0.04, 0.038], 8, WOOD)
