"""Trees, bushes, hedges and tall grass. Trunks and branches are part of the static mesh; leaves and blades move from image to image."""

import math

import numpy as np

from .materials import BARK
from .shapes import add_tube


class Leaves:
    """Triangles that move. `plant` says which of them sway together, `height` how far, `shade` how much light gets to them."""

    def __init__(self):
        self.triangles, self.normals, self.shade, self.plant, self.height = [], [], [], [], []

    def add(self, triangles, normals, shade, plant, height):
        self.triangles.append(triangles.astype(np.float32))
        self.normals.append(normals.astype(np.float32))
        self.shade.append(shade.astype(np.float32))
        self.plant.append(plant.astype(np.int32))
        self.height.append(height)

    def whole(self):
        for name, parts in vars(self).items():
            setattr(self, name, np.concatenate(parts))
        return self

    @classmethod
    def none(cls):
        """One leaf out of sight, so that nobody has to ask whether there are any."""
        leaves = cls()
        triangle = np.array([[(0, 0, -90), (0.01, 0, -90), (0, 0.01, -90)]])
        leaves.add(triangle, np.array([[0, 0, 1]]), np.ones(1), np.zeros(1), np.zeros(1, np.float32))
        return leaves.whole()


class Tree:
    """A bent trunk; `top` is the share of the height that it reaches."""

    def __init__(self, mesh, place, height, conifer, rng):
        self.mesh, self.place, self.height, self.rng = mesh, np.asarray(place, float), height, rng
        self.foliage = []
        k = np.linspace(0, 1, 6)
        bend = rng.normal(0, 0.05 * height, 2)
        self.top = 0.97 if conifer else 0.72
        x, y = (self.place[axis] + bend[axis] * k**2 for axis in (0, 1))
        self.line = np.stack([x, y, self.place[2] - 0.2 + (height * self.top + 0.2) * k], 1)
        self.radius = 0.026 * height + 0.03
        radii = self.radius * (1 - 0.85 * k) * np.where(k == 0, 1.25, 1)
        add_tube(mesh, self.line, radii, 8, BARK, caps=False)

    def trunk_at(self, h):
        """Middle of the trunk at a share of the height."""
        k = np.linspace(0, 1, 6) * self.top
        x, y = (np.interp(h, k, self.line[:, axis]) for axis in (0, 1))
        return np.array([x, y, self.place[2] + h * self.height])

    def grow_whorls(self):
        """Branches of a conifer, in rings."""
        for h in np.arange(0.14, 0.99, 0.055):
            reach = 0.24 * self.height * (1 - h) ** 0.8 + 0.1
            branches = int(7 + 6 * (1 - h))
            start = self.rng.uniform(0, 6.3)
            for b in range(branches):
                self.grow_needles(self.trunk_at(h), reach, start + 6.283 * b / branches + self.rng.normal(0, 0.12))

    def grow_needles(self, at, reach, angle):
        rng = self.rng
        n = int(26 * reach / (0.24 * 8) * 2 + 8)
        t = rng.uniform(0.1, 1, n) ** 0.8
        width = 0.10 * reach * (1.3 - t) + 0.06
        branch = [at[0] + reach * t * math.cos(angle), at[1] + reach * t * math.sin(angle), at[2] - 0.32 * reach * t * t]
        places = np.stack(branch, 1) + rng.normal(0, 1, (n, 3)) * np.stack([width * 1.7, width * 1.7, width * 0.7], 1)
        sizes = rng.uniform(0.09, 0.17, n)
        normals = rng.normal(0, 0.8, (n, 3))
        normals[:, 2] += 0.7
        self.foliage.append((places, normals, sizes, 0.35 + 0.65 * t))

    def grow_crown(self):
        """Branches of a broad-leaved tree, and clumps of leaves around its middle."""
        for _ in range(5):
            self.grow_branch()
        middle = self.trunk_at(0.66)
        for _ in range(30):
            self.grow_clump(middle, 0.27 * self.height)

    def grow_branch(self):
        rng, r = self.rng, self.radius
        h, angle = rng.uniform(0.35, 0.65), rng.uniform(0, 6.3)
        start, length = self.trunk_at(h), rng.uniform(0.15, 0.26) * self.height
        end = start + [length * math.cos(angle), length * math.sin(angle), length * rng.uniform(0.4, 0.9)]
        bend = (start + end) / 2 + [0, 0, 0.05 * length]
        add_tube(self.mesh, [start, bend, end], [r * 0.4, r * 0.25, r * 0.1], 6, BARK, caps=False)

    def grow_clump(self, middle, crown):
        rng = self.rng
        out = rng.normal(0, 1, 3)
        out /= np.linalg.norm(out)
        if out[2] < -0.55:
            out[2] *= -0.5
        centre = middle + out * [crown, crown, 0.30 * self.height] * rng.uniform(0.45, 0.95)
        radius = rng.uniform(0.22, 0.4) * crown
        n = int(260 * (radius / 0.6) ** 2) + 60
        v = rng.normal(0, 1, (n, 3))
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        r = rng.uniform(0.55, 1.08, n)
        places = centre + v * r[:, None] * [radius, radius, radius * 0.75]
        normals = v + rng.normal(0, 0.7, (n, 3)) + [0, 0, 0.3]
        sizes = rng.uniform(0.09, 0.17, n)
        light = np.clip(0.30 + 0.7 * (r - 0.5) + 0.25 * v[:, 2] + 0.15 * out[2], 0.18, 1)
        self.foliage.append((places, normals, sizes, light))


def add_tree(mesh, leaves, place, height, conifer, plant, rng):
    tree = Tree(mesh, place, height, conifer, rng)
    if conifer:
        tree.grow_whorls()
    else:
        tree.grow_crown()
    foliage = (np.concatenate(parts) for parts in zip(*tree.foliage))
    add_leaves(leaves, foliage, plant, (tree.place[2], height), rng)


def add_leaves(leaves, foliage, plant, extent, rng):
    """Foliage: places, normals, sizes, light. Extent: where the plant begins, and its height."""
    places, normals, sizes, light = foliage
    foot, height = extent
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    a = np.cross(normals, rng.normal(0, 1, normals.shape))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b, s = np.cross(normals, a), sizes[:, None]
    corners = [places + a * s * 0.75, places - a * s * 0.5 + b * s * 0.45, places - a * s * 0.5 - b * s * 0.45]
    swing = np.clip((places[:, 2] - foot) / height, 0, 1).astype(np.float32) * np.float32(min(1, height / 6))
    leaves.add(np.stack(corners, 1), normals, light, np.full(len(places), plant), swing)


def add_bush(leaves, place, radius, plant, rng):
    n = int(1500 * radius * radius) + 250
    v = rng.normal(0, 1, (n, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    v[:, 2] = np.abs(v[:, 2])
    lumps = 1 + 0.25 * np.sin(3 * np.arctan2(v[:, 1], v[:, 0]) + plant) * np.sqrt(1 - v[:, 2] ** 2)
    r = rng.uniform(0.45, 1.05, n)
    places = place + v * (r * lumps)[:, None] * [radius, radius, radius * rng.uniform(0.8, 1.3)]
    normals = v + rng.normal(0, 0.7, (n, 3))
    sizes = rng.uniform(0.06, 0.11, n)
    light = np.clip(0.2 + 0.75 * (r - 0.45) / 0.6 + 0.2 * v[:, 2], 0.18, 1)
    add_leaves(leaves, (places, normals, sizes, light), plant, (place[2], 2.5 * radius), rng)


def add_tall_grass(leaves, ground, place, radius, plant, rng):
    """A patch of upright blades in tufts; returns the number of tufts, each of which sways on its own."""
    tufts = int(9 * radius * radius) + 4
    d, a = radius * np.sqrt(rng.random(tufts)), rng.uniform(0, 6.3, tufts)
    tuft = np.repeat(np.arange(tufts), 48)
    n = len(tuft)
    q = np.stack([place[0] + d * np.cos(a), place[1] + d * np.sin(a)], 1)[tuft] + rng.normal(0, 0.13, (n, 2))
    height = (rng.uniform(0.35, 0.85, tufts) * (1.1 - 0.5 * d / radius))[tuft] * rng.uniform(0.6, 1.1, n)
    foot = np.stack([q[:, 0], q[:, 1], ground(q[:, 0], q[:, 1]) - 0.03], 1)
    tip = foot + np.stack([*(rng.normal(0, 0.28, (2, n)) * height), height], 1)
    w = rng.uniform(0, 6.3, n)
    side = 0.5 * rng.uniform(0.012, 0.026, n)[:, None] * np.stack([np.cos(w), np.sin(w), np.zeros(n)], 1)
    normals = np.cross(side, tip - foot) + [0, 0, 1e-4]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = rng.uniform(0.45, 0.95, n)
    leaves.add(np.stack([foot - side, foot + side, tip], 1), normals, light, plant + tuft, np.full(n, 0.45, np.float32))
    return tufts
