"""Where the pictures outdoors are taken: a flight in a grid, two domes around targets, and a low walk."""

import math

import numpy as np

from .camera import View, look
from .rays import Rays


def upwards(angle, elevation, radius=1.0):
    """A vector by its azimuth and elevation, radians."""
    flat = math.cos(elevation)
    return radius * np.array([flat * math.cos(angle), flat * math.sin(angle), math.sin(elevation)])


class Views:
    """Collects views, and moves those away that have something before the lens."""

    def __init__(self, scene, seed, focal_to_width):
        from scipy.spatial import cKDTree

        self.scene, self.rng, self.found = scene, np.random.default_rng(300 + seed), []
        vertices, leaves = scene.surface.vertices, scene.leaves.triangles
        near = (np.abs(vertices[:, 0]) < 45) & (np.abs(vertices[:, 1]) < 45)
        self.things = cKDTree(np.concatenate([vertices[near], leaves[::3, 0]]))
        self.rays = Rays(vertices, scene.surface.faces, leaves)
        u, v = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.38, 0.38, 7))
        self.directions = np.stack([u / focal_to_width, v / focal_to_width, np.ones(u.shape)], -1).reshape(-1, 3)

    def free(self, centre, rotation):
        """Nothing near the camera nor in front of it."""
        if self.things.query(centre)[0] < 1.6:
            return False
        hits = self.rays.from_point(centre, (self.directions @ rotation).astype(np.float32))
        t, leaves, foliage = np.where(hits["primID"] < 0, 200, hits["tfar"]), hits["geomID"] == 1, self.scene.layout.foliage
        clear = np.percentile(t, 25) > 3.5 and np.median(t) > 5
        return clear and np.mean(leaves & (t < foliage.near)) < foliage.most_near and np.mean(leaves) <= foliage.most

    def add(self, name, rotation, centre):
        self.found.append(View(name, rotation, centre))

    def add_free(self, name, centre, target, lift=0.5):
        """The lowest of 24 places above each other from where the target is seen freely."""
        for _ in range(24):
            rotation = look(centre, target)
            if self.free(centre, rotation):
                return self.add(name, rotation, centre)
            centre = centre + [0, 0, lift]
        print("no free place for", name)

    def target(self, which):
        """Middle of an outcrop or a hut."""
        kind, number = which
        thing = (self.scene.layout.huts if kind == "hut" else self.scene.layout.outcrops)[number]
        return np.array([thing.x, thing.y, self.scene.ground.at(thing.x, thing.y) + 0.4 * thing.height])


def grid_domes_walk(scene, total, seed, focal_to_width):
    """40 % grid, 30 % two domes, 30 % walk."""
    views = Views(scene, seed, focal_to_width)
    add_grid(views, total, focal_to_width)
    for which, name in zip(scene.layout.targets, "ab"):
        add_dome(views, int(round(0.15 * total)), which, name)
    add_walk(views, total - len(views.found))
    return views.found


def add_grid(views, total, focal_to_width, altitude=25.0):
    """Lines to and fro, looking down, with 80 % overlap where there are enough views."""
    wanted = int(round(0.4 * total))
    lines = max(2, int(round(math.sqrt(wanted / 1.35))))
    in_line = int(round(wanted / lines))
    width = altitude / focal_to_width
    step_x = min(0.2 * width, 60 / lines)
    step_y = min(0.2 * (width * 0.75) * (1 if total >= 100 else 1.25), 50 / in_line)
    level, rng, k = views.scene.ground.at(0, 0), views.rng, 0
    for i in range(lines):
        for j in range(in_line):
            along = j if i % 2 == 0 else in_line - 1 - j
            place = [(i - (lines - 1) / 2) * step_x, (along - (in_line - 1) / 2) * step_y, level + altitude]
            centre = np.array(place) + rng.normal(0, 0.25, 3)
            ahead = np.array([0, 1 if i % 2 == 0 else -1, 0.0]) + rng.normal(0, 0.03, 3)
            views.add("grid_%03d" % k, look(centre, centre + [0, 0, -10] + rng.normal(0, 0.35, 3), ahead), centre)
            k += 1


def add_dome(views, wanted, which, name):
    """Two rings around a target at several elevations."""
    middle, rng, k = views.target(which), views.rng, 0
    inner, start = wanted // 2, rng.uniform(0, 6.3)
    for ring, count in ((0, inner), (1, wanted - inner)):
        for i in range(count):
            angle = start + 2 * math.pi * (i + 0.5 * ring) / count
            elevation = math.radians((34, 58)[i % 2] if ring == 0 else (28, 46, 62)[i % 3]) + rng.normal(0, 0.03)
            centre = middle + upwards(angle, elevation, views.scene.layout.ring_radii[ring])
            views.add_free("dome_%s_%03d" % (name, k), centre, middle + rng.normal(0, 0.5, 3), 0.7)
            k += 1


def worth_a_look(scene):
    layout, ground = scene.layout, scene.ground
    spots = [np.array([o.x, o.y, ground.at(o.x, o.y) + 0.5]) for o in layout.outcrops]
    spots += [np.array([h.x, h.y, ground.at(h.x, h.y) + 1.5]) for h in layout.huts]
    return spots + [np.array([layout.pond.x, layout.pond.y, ground.level])]


def add_walk(views, count):
    """A closed curve 4.5 to 8.5 m above the ground; two of three look at what is near, the others inwards and ahead."""
    rng, ground = views.rng, views.scene.ground
    phase, spots = rng.uniform(0, 6.3), worth_a_look(views.scene)
    for i in range(count):
        a = 2 * math.pi * i / count
        q = 1 + 0.16 * math.sin(3 * a + phase) + 0.10 * math.sin(7 * a + 2 * phase)
        x, y = 19.5 * q * math.cos(a), 15.0 * q * math.sin(a)
        centre = np.array([x, y, ground.at(x, y) + rng.uniform(4.5, 8.5)])
        inward = np.array([-0.35 * x, -0.35 * y, 0]) + centre * [1, 1, 0]
        ahead = a + 0.55
        target = 0.55 * inward + 0.45 * np.array([13 * math.cos(ahead), 10 * math.sin(ahead), 0])
        spot = min(spots, key=lambda p, centre=centre: np.hypot(*(p - centre)[:2]) + rng.uniform(0, 5))
        if 6 < np.hypot(*(spot - centre)[:2]) < 17 and i % 3 != 0:
            target = 0.35 * target + 0.65 * spot
        target = target + rng.normal(0, 1.2, 3)
        target[2] = ground.at(target[0], target[1]) + 0.4
        views.add_free("walk_%03d" % i, centre, target)
