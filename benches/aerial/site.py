"""Terrain, buildings (boxes with a flat or a gable roof) and crowns, also as rasters, and points on them."""

from typing import NamedTuple

import numpy as np

# Metres per cell of the raster, and around the area that is flown over.
CELL = 0.5
MARGIN = 240
GROUND, BUILDING, TREE = range(3)
# Of the points on terrain, roofs, walls and crowns.
COLOURS = np.array([(96, 118, 66), (150, 84, 70), (205, 200, 190), (62, 92, 44)])


class Points(NamedTuple):
    """Places (float64), normals (float32), colours (uint8)."""

    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def waves(rng, n, cells):
    """A smooth random raster of n x n cells with `cells` waves along each axis."""
    values = rng.standard_normal((cells + 2, cells + 2)).astype(np.float32)
    t = np.linspace(0, cells, n, endpoint=False, dtype=np.float32)
    i = t.astype(int)
    u = t - i
    u = u * u * (3 - 2 * u)
    rows = values[i] * (1 - u)[:, None] + values[i + 1] * u[:, None]
    return rows[:, i] * (1 - u) + rows[:, i + 1] * u


class Site:
    """`terrain` and `top` (with what is on it): heights of cells; `buildings` and `crowns`: their numbers, a row for each."""

    def __init__(self, side, rng):
        self.size = side + MARGIN
        self.cells = n = int(self.size / CELL)
        self.corner = -self.size / 2
        self.terrain = np.zeros((n, n), np.float32)
        for length, amplitude in ((260, 9.0), (90, 2.5), (28, 0.6), (9, 0.12)):
            self.terrain += amplitude * waves(rng, n, max(2, int(self.size / length)))
        self.lowest = float(self.terrain.min())
        self.top, self.kind = self.terrain.copy(), np.zeros((n, n), np.uint8)
        hectares = self.size**2 / 1e4
        built = [self.add_building(rng) for _ in range(int(9 * hectares))]
        self.buildings = np.array([b for b in built if b]).reshape(-1, 9)
        grown = [self.add_crown(rng) for _ in range(int(55 * hectares))]
        self.crowns = np.array([c for c in grown if c]).reshape(-1, 5)

    def add_building(self, rng):
        """x, y, cosine, sine, half length, half width, eaves, rise of the roof, foot; None where there is no room."""
        x, y = rng.uniform(-self.size / 2 + 15, self.size / 2 - 15, 2)
        # Along a loose pattern of streets.
        if abs((x / 55) % 1 - 0.5) > 0.32 or rng.random() < 0.25:
            return None
        length, width, height = rng.uniform(4, 10), rng.uniform(3.5, 6.5), rng.choice([3.2, 5.8, 8.6], p=[0.35, 0.5, 0.15])
        rise = rng.choice([0, 1]) * rng.uniform(1.2, 3)
        angle = rng.normal(0, 0.12) + (np.pi / 2) * rng.integers(2)
        c, s = np.cos(angle), np.sin(angle)
        patch, X, Y = self.patch(x, y, np.hypot(length, width) + 2)
        if (self.kind[patch] == BUILDING).any():
            return None
        u, v = c * (X - x) + s * (Y - y), -s * (X - x) + c * (Y - y)
        under = (np.abs(u) <= length) & (np.abs(v) <= width)
        eaves = float(self.terrain[patch].mean()) + height
        self.top[patch] = np.where(under, eaves + rise * (1 - np.abs(v) / width), self.top[patch])
        self.kind[patch][under] = BUILDING
        return x, y, c, s, length, width, eaves, rise, float(self.terrain[patch].min())

    def add_crown(self, rng):
        """x, y, radius, height, foot; None where there is a building."""
        x, y = rng.uniform(-self.size / 2 + 8, self.size / 2 - 8, 2)
        radius = rng.uniform(1.3, 4.2)
        height = radius * rng.uniform(1.9, 3.2)
        patch, X, Y = self.patch(x, y, radius)
        if (self.kind[patch] == BUILDING).any():
            return None
        q = ((X - x) ** 2 + (Y - y) ** 2) / radius**2
        foot = float(self.terrain[patch].mean())
        top = foot + height * (0.35 + 0.65 * np.sqrt(np.maximum(1 - q, 0)))
        self.top[patch] = np.where(q < 1, np.maximum(self.top[patch], top - 0.25), self.top[patch])
        self.kind[patch][q < 1] = TREE
        return x, y, radius, height, foot

    def patch(self, x, y, reach):
        """The cells around a place, and x and y of their middles."""
        i0, i1 = (int(np.clip((y + k * reach - self.corner) / CELL, 0, self.cells - 1)) for k in (-1, 1))
        j0, j1 = (int(np.clip((x + k * reach - self.corner) / CELL, 0, self.cells - 1)) for k in (-1, 1))
        i, j = np.mgrid[i0 : i1 + 1, j0 : j1 + 1]
        return (slice(i0, i1 + 1), slice(j0, j1 + 1)), self.corner + (j + 0.5) * CELL, self.corner + (i + 0.5) * CELL

    def cell(self, x, y):
        """Number of the nearest cell."""
        j, i = (np.clip(((v - self.corner) * (1 / CELL)).astype(np.int32), 0, self.cells - 1) for v in (x, y))
        return i * self.cells + j

    def height(self, x, y):
        """Of the terrain, bilinear."""
        u, v = (np.clip((w - self.corner) / CELL - 0.5, 0, self.cells - 2) for w in (x, y))
        j, i = u.astype(int), v.astype(int)
        u, v, T = u - j, v - i, self.terrain
        return (T[i, j] * (1 - u) + T[i, j + 1] * u) * (1 - v) + (T[i + 1, j] * (1 - u) + T[i + 1, j + 1] * u) * v

    def sample(self, count, half, rng):
        """About `count` points within +-half, by area."""
        B = self.buildings[(np.abs(self.buildings[:, :2]) < half).all(1)]
        C = self.crowns[(np.abs(self.crowns[:, :2]) < half).all(1)]
        roof, wall = 4 * B[:, 4] * B[:, 5], 4 * (B[:, 4] + B[:, 5]) * (B[:, 6] - B[:, 8])
        crown = 2.2 * np.pi * C[:, 2] ** 2
        areas = np.array([4 * half * half, 1.6 * roof.sum(), 0.9 * wall.sum(), 1.0 * crown.sum()])
        on = rng.multinomial(count, areas / areas.sum())
        parts = [self.on_terrain(on[0], half, rng)]
        if len(B):
            parts.append(on_roofs(on[1], B, roof, rng))
            parts.append(self.on_walls(on[2], B, wall, rng))
        if len(C):
            parts.append(on_crowns(on[3], C, crown, rng))
        places, normals = (np.concatenate(part) for part in zip(*parts))
        kinds = np.repeat([0, 1, 2, 3] if len(B) else [0, 3], [len(part[0]) for part in parts]) if len(C) else np.zeros(len(places), int)
        normals = normals.astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        colours = np.clip(COLOURS[kinds] * rng.uniform(0.7, 1.25, (len(kinds), 1)), 0, 255).astype(np.uint8)
        return Points(places, normals, colours)

    def on_terrain(self, count, half, rng, step=0.5):
        x, y = rng.uniform(-half, half, (2, count))
        kind = self.kind.ravel()[self.cell(x, y)]
        free = (kind == GROUND) | ((kind == TREE) & (rng.random(count) < 0.15))
        x, y = x[free], y[free]
        z = self.height(x, y)
        nx, ny = self.height(x - step, y) - self.height(x + step, y), self.height(x, y - step) - self.height(x, y + step)
        return np.stack([x, y, z + rng.normal(0, 0.015, len(x))], 1), np.stack([nx, ny, np.full(len(x), 2 * step)], 1)

    def on_walls(self, count, buildings, areas, rng):
        b = buildings[rng.choice(len(buildings), count, p=areas / areas.sum())]
        long = rng.random(count) * (b[:, 4] + b[:, 5]) < b[:, 4]
        side, w = rng.choice([-1.0, 1.0], count), rng.uniform(-1, 1, count)
        u, v = np.where(long, w * b[:, 4], side * b[:, 4]), np.where(long, side * b[:, 5], w * b[:, 5])
        nu, nv = np.where(long, 0, side), np.where(long, side, 0)
        x, y = turned(b, u, v)
        foot = self.height(x, y)
        normals = np.stack([b[:, 2] * nu - b[:, 3] * nv, b[:, 3] * nu + b[:, 2] * nv, np.zeros(count)], 1)
        return np.stack([x, y, foot + rng.random(count) * (b[:, 6] - foot)], 1), normals


def turned(b, u, v):
    """From along and across a building to x and y."""
    return b[:, 0] + b[:, 2] * u - b[:, 3] * v, b[:, 1] + b[:, 3] * u + b[:, 2] * v


def on_roofs(count, buildings, areas, rng):
    b = buildings[rng.choice(len(buildings), count, p=areas / areas.sum())]
    u, v = rng.uniform(-1, 1, (2, count))
    u *= b[:, 4]
    v *= b[:, 5]
    places = np.stack([*turned(b, u, v), b[:, 6] + b[:, 7] * (1 - np.abs(v) / b[:, 5])], 1)
    slope = np.sign(v) * b[:, 7] / b[:, 5]
    return places, np.stack([-b[:, 3] * slope, b[:, 2] * slope, np.ones(count)], 1)


def on_crowns(count, crowns, areas, rng):
    c = crowns[rng.choice(len(crowns), count, p=areas / areas.sum())]
    a, q = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.random(count))
    d, r = np.sqrt(1 - q * q), q * c[:, 2]
    dome = [c[:, 0] + r * np.cos(a), c[:, 1] + r * np.sin(a), c[:, 4] + c[:, 3] * (0.35 + 0.65 * d)]
    places = np.stack(dome, 1) + rng.normal(0, 0.12, (count, 3))
    return places, np.stack([q * np.cos(a), q * np.sin(a), d + 0.15], 1) + rng.normal(0, 0.3, (count, 3))
