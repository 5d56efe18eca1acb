"""Rooms from inside and what is in them. A place is a foot (on the floor or the wall), the direction along and the one in front of it."""

import math
from typing import NamedTuple

import numpy as np

from .materials import BOOK, CLOTH, FLOOR, GLOSS, PAINT, PANE, PICTURE, STONE, WALL, WOOD
from .shapes import UP, add_box, add_panel, add_tube, add_turned, heading


class Place(NamedTuple):
    foot: np.ndarray
    along: np.ndarray
    front: np.ndarray

    def moved(self, along=0, front=0, up=0):
        return Place(self.foot + along * self.along + front * self.front + up * UP, self.along, self.front)

    def turned_about(self):
        return Place(self.foot, -self.along, -self.front)


class Furnisher:
    """Adds furniture to a mesh."""

    def __init__(self, mesh, rng):
        self.mesh, self.rng = mesh, rng

    def shell(self, size, step):
        """Floor, ceiling and four walls, seen from inside."""
        x, y, z = size
        a, b, up = x / 2, y / 2, (0, 0, 1)
        for corner, along, across, extent, material in (
            ((-a, -b, 0), (1, 0, 0), (0, 1, 0), (x, y), FLOOR),
            ((-a, b, z), (1, 0, 0), (0, -1, 0), (x, y), WALL),
            ((-a, -b, 0), (0, 1, 0), up, (y, z), WALL),
            ((a, b, 0), (0, -1, 0), up, (y, z), WALL),
            ((a, -b, 0), (-1, 0, 0), up, (x, z), WALL),
            ((-a, b, 0), (1, 0, 0), up, (x, z), WALL),
        ):
            add_panel(self.mesh, corner, along, across, extent, material, step)

    def box(self, place, middle, half, material, obj=None):
        """`middle`: along, in front of and above the place."""
        centre = place.foot + middle[0] * place.along + middle[1] * place.front + middle[2] * UP
        add_box(self.mesh, centre, (place.along, place.front, UP), half, material, obj)

    def picture(self, place, x, z, width, height, material=PICTURE, rim=WOOD):
        """Something flat with a rim on a wall."""
        self.box(place, (x, 0.02, z), (width / 2, 0.02, height / 2), rim)
        foot, along, front = place
        corner = foot + (x - width / 2 + 0.03) * along + 0.042 * front + (z - height / 2 + 0.03) * UP
        add_panel(self.mesh, corner, along, UP, (width - 0.06, height - 0.06), material, 1.0)

    def window(self, place, x, z, width, height):
        self.picture(place, x, z, width, height, PANE)
        for k in np.linspace(-0.5, 0.5, max(2, int(width / 0.7) + 1))[1:-1]:
            self.box(place, (x + k * width, 0.05, z), (0.025, 0.02, height / 2), WOOD)
        for k in np.linspace(-0.5, 0.5, max(3, int(height / 0.9) + 1))[1:-1]:
            self.box(place, (x, 0.05, z + k * height), (width / 2, 0.02, 0.025), WOOD)
        self.box(place, (x, 0.10, z - height / 2 - 0.04), (width / 2 + 0.1, 0.10, 0.03), GLOSS)

    def table(self, place, length, width, height, material=GLOSS):
        self.box(place, (0, 0, height - 0.02), (length / 2, width / 2, 0.02), material)
        for x in (-1, 1):
            for y in (-1, 1):
                middle = (x * (length / 2 - 0.05), y * (width / 2 - 0.05), height / 2 - 0.02)
                self.box(place, middle, (0.025, 0.025, height / 2 - 0.02), WOOD)

    def chair(self, place):
        self.table(place, 0.44, 0.44, 0.46, WOOD)
        self.box(place, (0, -0.20, 0.74), (0.21, 0.018, 0.14), WOOD)
        for x in (-0.19, 0.19):
            self.box(place, (x, -0.20, 0.66), (0.02, 0.02, 0.22), WOOD)

    def stack(self, place):
        """Books that lie about."""
        rng, z = self.rng, 0
        for _ in range(rng.integers(2, 6)):
            turned = heading(math.atan2(place.along[1], place.along[0]) + rng.normal(0, 0.25))
            thick = rng.uniform(0.012, 0.03)
            half = (rng.uniform(0.08, 0.12), rng.uniform(0.11, 0.15), thick)
            self.box(Place(place.foot, *turned), (0, 0, z + thick), half, (PICTURE, PAINT, BOOK)[rng.integers(3)])
            z += 2 * thick

    def ledge(self, place, x, z, width):
        """A board on the wall with some books."""
        rng = self.rng
        self.box(place, (x, 0.11, z), (width / 2, 0.11, 0.012), WOOD)
        at = -width / 2 + 0.05
        while at < width / 2 - 0.2:
            books, height = rng.uniform(0.08, 0.25), rng.uniform(0.10, 0.14)
            self.box(place, (x + at + books / 2, 0.1, z + 0.012 + height), (books / 2, 0.09, height), BOOK)
            at += books + rng.uniform(0, 0.25)

    def vase(self, foot, height, material):
        radii = np.array([0.16, 0.22, 0.30, 0.16, 0.11, 0.15]) * height * self.rng.uniform(0.8, 1.2)
        add_turned(self.mesh, foot, np.array([0, 0.15, 0.45, 0.75, 0.9, 1]) * height, radii, material)

    def sofa(self, place, width):
        self.box(place, (0, 0.45, 0.22), (width / 2, 0.42, 0.18), CLOTH)
        # The arms have the cloth of the back.
        cloth = self.mesh.object_count
        self.box(place, (0, 0.12, 0.55), (width / 2, 0.12, 0.33), CLOTH)
        for x in (-1, 1):
            self.box(place, (x * (width / 2 - 0.09), 0.45, 0.40), (0.09, 0.42, 0.22), CLOTH, cloth)
        for _ in range(self.rng.integers(1, 4)):
            self.cushion(place, width)

    def cushion(self, place, width):
        rng = self.rng
        a, b = heading(math.atan2(place.along[1], place.along[0]) + rng.normal(0, 0.2))
        middle = place.foot + rng.uniform(-0.35, 0.35) * width * place.along + 0.33 * place.front + [0, 0, 0.58]
        add_box(self.mesh, middle, (a, b * 0.94 - UP * 0.34, b * 0.34 + UP * 0.94), (0.2, 0.07, 0.19), CLOTH)

    def shelf(self, place, x):
        """A book shelf with five rows."""
        for z in np.linspace(0.06, 2.0, 6):
            self.box(place, (x, 0.16, z), (0.9, 0.16, 0.015), WOOD)
            if z < 1.9:
                self.row_of_books(place, x, z)
        for at in (-0.9, 0.9):
            self.box(place, (x + at, 0.16, 1.02), (0.015, 0.16, 1.0), WOOD)

    def row_of_books(self, place, x, z):
        rng, at = self.rng, -0.86
        while at < 0.8:
            books, height = min(rng.uniform(0.15, 0.7), 0.85 - at), rng.uniform(0.10, 0.155)
            middle = (x + at + books / 2, 0.14 + rng.uniform(0, 0.03), z + 0.015 + height)
            self.box(place, middle, (books / 2, 0.11, height), BOOK)
            at += books + (rng.uniform(0.05, 0.3) if rng.random() < 0.4 else 0.004)

    def floor_lamp(self, foot):
        add_tube(self.mesh, [foot, foot + 1.5 * UP], 0.015, 8, PAINT)
        add_turned(self.mesh, foot + 1.42 * UP, [0, 0.15, 0.3], [0.2, 0.16, 0.11], WALL)

    def pillar(self, foot, height, material):
        place = Place(foot, *heading(0))
        self.box(place, (0, 0, 0.12), (0.5, 0.5, 0.12), STONE)
        self.box(place, (0, 0, height - 0.45), (0.45, 0.45, 0.15), STONE)
        add_turned(self.mesh, foot, [0.24, 0.5, 3, height - 0.6], [0.36, 0.33, 0.32, 0.28], material, rings=24)
