"""Puts an outdoor scene together from its layout."""

import math

import numpy as np

from .buildings import Hut, add_board, add_car, add_rail, add_wall
from .noise import polyline_distance
from .plants import Leaves, add_bush, add_tall_grass, add_tree
from .scene import Scene, Site, pads_as_rows
from .shapes import Mesh, add_boulder
from .terrain import Ground, add_outcrop, add_pond, add_terrain, figures


def build(layout, seed, salt):
    rng, ground, mesh, leaves = np.random.default_rng(seed), Ground(layout, seed, salt), Mesh(), Leaves()
    add_terrain(mesh, ground)
    for i, outcrop in enumerate(layout.outcrops):
        add_outcrop(mesh, ground, outcrop, ground.salt + 200 + 100 * i)
    add_pond(mesh, ground)
    add_buildings(mesh, ground, rng)
    Growth(mesh, leaves, ground, rng).fill()
    surface = mesh.whole()
    segments, found, angle = figures(layout, rng)
    rock, half = np.array(layout.rock, float), np.array(layout.half, float)
    # The mud is as long as an angle by chance: so it is in the sets that all measurements are of, and they have to stay as they are.
    pond = layout.pond._replace(along=layout.pond.along if angle is None else angle)
    numbers = [float(x) for x in (*pond, layout.grass)]
    blades, pads = np.zeros(2), pads_as_rows(ground.pads)
    path_half = float(layout.path_half)
    texture = Site(*numbers, layout.paved, path_half, rock, half, ground.salt, blades, layout.path, pads, segments, found)
    return Scene(layout, ground, surface, leaves.whole(), texture)


def add_buildings(mesh, ground, rng):
    layout = ground.layout
    for hut, pad in zip(layout.huts, ground.pads):
        Hut(mesh, hut, pad.level).add()
    for line in layout.rails:
        add_rail(mesh, ground, line, rng)
    for wall in layout.walls:
        add_wall(mesh, ground, wall)
    for car in layout.cars:
        add_car(mesh, ground, car)
    for board in layout.boards:
        add_board(mesh, ground, board)


class Growth:
    """Finds free places for trees, bushes, boulders and tall grass."""

    def __init__(self, mesh, leaves, ground, rng):
        self.mesh, self.leaves, self.ground, self.rng = mesh, leaves, ground, rng
        self.layout = ground.layout
        self.kept_free = self.around_outcrops_huts_pond()
        self.taken = []
        self.plants = 0

    def around_outcrops_huts_pond(self):
        """Circles: x, y, radius."""
        layout, pond = self.layout, self.layout.pond
        circles = []
        for i, outcrop in enumerate(layout.outcrops):
            beside = max(outcrop.along, outcrop.across) * 1.5 + 1.5
            target = ("outcrop", i) in layout.targets
            circles.append((outcrop.x, outcrop.y, layout.spacing.around_targets if target else beside))
        circles += [(hut.x, hut.y, max(hut.length, hut.width) * 0.5 + 3.6) for hut in layout.huts]
        return circles + [(pond.x, pond.y, max(pond.along, pond.across) + 2.2)]

    def fill(self):
        self.add_trees()
        self.add_bushes()
        for line in self.layout.hedges:
            self.add_hedge(np.array(line, float))
        self.add_boulders()
        self.plants += 1000
        for _ in range(self.layout.tall_grass):
            place = self.free_place(0.1, small=True)
            if place is not None:
                radius = self.rng.uniform(1.1, 2.6)
                self.plants += add_tall_grass(self.leaves, self.ground, place, radius, self.plants, self.rng)

    def free_place(self, apart, small=False):
        """A place with `apart` metres to the next plant, or None after 4000 trials."""
        (reach_x, reach_y), layout = self.layout.spacing.extent, self.layout
        for _ in range(4000):
            x, y = self.rng.uniform(-reach_x, reach_x), self.rng.uniform(-reach_y, reach_y)
            if polyline_distance(x, y, layout.path) < layout.path_half + (0.7 if small else 1.6):
                continue
            if any((x - cx) ** 2 + (y - cy) ** 2 < (r * (0.78 if small else 1)) ** 2 for cx, cy, r in self.kept_free):
                continue
            if any(math.hypot(x - tx, y - ty) < apart + r for tx, ty, r in self.taken):
                continue
            return x, y
        return None

    def add_trees(self):
        rng, spacing = self.rng, self.layout.spacing
        for _ in range(self.layout.trees):
            place = self.free_place(spacing.trees_apart)
            if place is None:
                continue
            self.taken.append((*place, 1.4))
            conifer = rng.random() < self.layout.conifers
            height = spacing.growth * (rng.uniform(6.5, 10.0) if conifer else rng.uniform(4.5, 8.0))
            foot = (*place, self.ground.at(*place))
            add_tree(self.mesh, self.leaves, foot, height, conifer, self.plants, rng)
            self.plants += 1

    def add_bushes(self):
        for _ in range(self.layout.bushes):
            place = self.free_place(0.6, small=True)
            if place is None:
                continue
            radius = self.rng.uniform(0.4, 1.1) * (0.5 + 0.5 * self.layout.spacing.growth)
            self.taken.append((*place, radius * 0.6))
            self.add_bush(place, radius)

    def add_bush(self, place, radius):
        foot = np.array([*place, self.ground.at(*place) - 0.05])
        add_bush(self.leaves, foot, radius, 1000 + self.plants, self.rng)
        self.plants += 1

    def add_hedge(self, line):
        for i in range(len(line) - 1):
            length = np.linalg.norm(line[i + 1] - line[i])
            for t in np.arange(0, 1, 0.95 / length):
                place = line[i] + t * (line[i + 1] - line[i]) + self.rng.normal(0, 0.08, 2)
                self.add_bush(place, self.rng.uniform(0.65, 0.8))

    def add_boulders(self):
        for i in range(self.layout.boulders):
            place = self.free_place(0.5, small=True)
            if place is None:
                continue
            size = 0.25 + 0.9 * self.rng.random() ** 2
            self.taken.append((*place, size))
            middle = np.array([*place, self.ground.at(*place) + 0.2 * size])
            add_boulder(self.mesh, middle, size, self.ground.salt + 900 + 7 * i, self.rng)
