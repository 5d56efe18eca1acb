"""Terrain with relief, rock outcrops, the pond, and the figures pecked into the rock."""

import math

import numpy as np

from .materials import ROCK, TERRAIN, WATER
from .noise import fbm2_grid, noise3_grid
from .shapes import grid_faces, smooth_normals


class Pad:
    """Level ground under a hut."""

    def __init__(self, hut, level):
        self.x, self.y = hut.x, hut.y
        self.cos, self.sin = math.cos(math.radians(hut.turn)), math.sin(math.radians(hut.turn))
        self.half_length, self.half_width = hut.length / 2, hut.width / 2
        self.level = level


def eased(t):
    return t * t * (3 - 2 * t)


class Ground:
    """Height of the terrain. Takes arrays of x and y."""

    def __init__(self, layout, seed, salt):
        self.layout = layout
        self.salt = 17 * seed + salt
        self.pads = []
        # Of the water.
        self.level = self.raw_at(layout.pond.x, layout.pond.y) - 0.35
        self.pads = [Pad(hut, self.raw_at(hut.x, hut.y)) for hut in layout.huts]

    def raw_at(self, x, y):
        return float(self.raw(np.array([x]), np.array([y]))[0])

    def at(self, x, y):
        return float(self(np.array([x]), np.array([y]))[0])

    def raw(self, x, y):
        """As nature made it, without pads and pond; hills begin 38 m from the middle."""
        salt, slope = self.salt, self.layout.slope
        waves = 1.9 * fbm2_grid(x, y, 0.055, 3, salt + 1) + 0.35 * fbm2_grid(x, y, 0.24, 3, salt + 9)
        z = slope[0] * x + slope[1] * y
        z = z + self.layout.relief * waves + 0.05 * fbm2_grid(x, y, 1.1, 2, salt + 20)
        far = np.clip((np.hypot(x / 1.1, y) - 38) / 120, 0, 1)
        return z + far**1.5 * (45 + 30 * fbm2_grid(x, y, 0.012, 4, salt + 30))

    def from_pond(self, x, y):
        """1 at the shore."""
        pond = self.layout.pond
        return ((np.abs(x - pond.x) / pond.along) ** pond.power + (np.abs(y - pond.y) / pond.across) ** pond.power) ** (
            1 / pond.power
        )

    def __call__(self, x, y):
        z = self.raw(x, y)
        for pad in self.pads:
            u = pad.cos * (x - pad.x) + pad.sin * (y - pad.y)
            v = -pad.sin * (x - pad.x) + pad.cos * (y - pad.y)
            outside = np.maximum(np.abs(u) - pad.half_length - 0.6, np.abs(v) - pad.half_width - 0.6)
            share = eased(1 - np.clip(outside / 3.0, 0, 1))
            z = z * (1 - share) + pad.level * share
        r = self.from_pond(x, y)
        share = eased(1 - np.clip((r - 1.0) / 0.7, 0, 1))
        z = z * (1 - share) + (self.level + 0.25) * share
        return z - 1.3 * np.clip((1.02 - r) / 0.35, 0, 1)


def lattice(half, step):
    """Coordinates along an axis: even steps in the middle, growing steps out to 170 m."""
    core = np.linspace(-half, half, int(round(2 * half / step)) + 1)
    out = [half]
    while out[-1] < 170:
        step = min(step * 1.22, 9.0)
        out.append(out[-1] + step)
    beyond = np.array(out[1:])
    return np.concatenate([-beyond[::-1], core, beyond])


def add_terrain(mesh, ground):
    half = ground.layout.half
    x, y = lattice(half[0] + 4, 0.3), lattice(half[1] + 4, 0.3)
    X, Y = np.meshgrid(x, y)
    vertices = np.stack([X, Y, ground(X, Y)], -1).reshape(-1, 3)
    faces = grid_faces(len(y), len(x))
    mesh.add(vertices, faces, TERRAIN, smooth_normals(vertices, faces))


def add_pond(mesh, ground):
    pond, corners = ground.layout.pond, 48
    w = np.linspace(0, 2 * math.pi, corners, endpoint=False)
    r = 1.2 / (np.abs(np.cos(w)) ** pond.power + np.abs(np.sin(w)) ** pond.power) ** (1 / pond.power)
    shore = [pond.x + pond.along * r * np.cos(w), pond.y + pond.across * r * np.sin(w), np.full(corners, ground.level)]
    vertices = np.concatenate([[(pond.x, pond.y, ground.level)], np.stack(shore, 1)])
    mesh.add(vertices, [(0, 1 + i, 1 + (i + 1) % corners) for i in range(corners)], WATER)


def add_outcrop(mesh, ground, outcrop, salt):
    step = 0.075 if outcrop.along > 4 else 0.1
    u = np.linspace(-1.3, 1.3, int(2.6 * outcrop.along / step))
    v = np.linspace(-1.3, 1.3, int(2.6 * outcrop.across / step))
    U, V = np.meshgrid(u, v)
    c, s = math.cos(math.radians(outcrop.turn)), math.sin(math.radians(outcrop.turn))
    X = outcrop.x + c * U * outcrop.along - s * V * outcrop.across
    Y = outcrop.y + s * U * outcrop.along + c * V * outcrop.across
    Z = ground(X, Y) + rock_height(outcrop, (U, V), (X, Y), salt) - 0.08
    vertices = roughened(np.stack([X, Y, Z], -1).reshape(-1, 3), outcrop.roughness, salt + 70)
    faces = grid_faces(len(v), len(u))
    above = vertices[:, 2] > ground(vertices[:, 0], vertices[:, 1]) - 0.12
    vertices, faces = used_part(vertices, faces[above[faces].any(1)])
    mesh.add(vertices, faces, ROCK, smooth_normals(vertices, faces))


def rock_height(outcrop, local, place, salt):
    """A slab that leans (steep at one side, smooth at the other) with soft ledges and cracks."""
    (U, V), (X, Y) = local, place
    ledge = 0.42 * outcrop.roughness
    r = np.hypot(U, V) + 0.22 * fbm2_grid(X, Y, 0.33, 4, salt)
    tilt = 1 + 0.45 * U + 0.15 * V
    f = np.clip(1 - np.maximum(r, 0) ** 2.6, -0.6, 1)
    h = np.sign(f) * np.abs(f) ** 0.55 * tilt * outcrop.height
    shift = 0.5 * fbm2_grid(X, Y, 0.5, 3, salt + 40)
    t = h / ledge + shift
    steps = np.floor(t) + np.clip((t - np.floor(t) - 0.5) * 2.6 + 0.5, 0, 1)
    h = 0.5 * h + 0.5 * (steps - shift) * 0.42 * outcrop.roughness
    crack = np.clip(1 - np.abs(fbm2_grid(X, Y, 0.45, 3, salt + 60)) / 0.035, 0, 1)
    return h - 0.28 * crack * (h > 0.1)


def roughened(vertices, roughness, salt):
    moved = vertices.copy()
    for k, (frequency, amplitude) in enumerate([(0.9, 0.16), (2.1, 0.075), (4.7, 0.03)]):
        for axis in range(3):
            reach = roughness * amplitude * (0.6 if axis == 2 else 1.0)
            moved[:, axis] += reach * noise3_grid(vertices, frequency, salt + 5 * k + axis)
    return moved


def used_part(vertices, faces):
    used = np.unique(faces)
    new = np.full(len(vertices), -1)
    new[used] = np.arange(len(used))
    return vertices[used], new[faces]


MAN = [
    (0, -0.5, 0, 0.35), (-0.4, 0.45, -0.35, 0.1), (-0.35, 0.1, 0.35, 0.1), (0.35, 0.1, 0.4, 0.45),
    (-0.3, -1, -0.25, -0.5), (-0.25, -0.5, 0.25, -0.5), (0.25, -0.5, 0.3, -1), (0, 0.5, 0.02, 0.62),
]  # fmt: skip
DEER = [
    (-0.6, 0, 0.5, 0), (-0.55, 0, -0.6, -0.5), (-0.4, 0, -0.35, -0.5), (0.3, 0, 0.3, -0.5), (0.45, 0, 0.5, -0.5),
    (0.5, 0, 0.8, 0.35), (0.8, 0.35, 1.0, 0.25), (0.8, 0.35, 0.7, 0.8), (0.8, 0.35, 0.95, 0.75), (-0.6, 0, -0.8, 0.15),
]  # fmt: skip
HOUSE = [
    (-0.5, -0.5, 0.5, -0.5), (0.5, -0.5, 0.5, 0.4), (0.5, 0.4, -0.5, 0.4), (-0.5, 0.4, -0.5, -0.5), (-0.6, 0.4, 0, 0.9),
    (0, 0.9, 0.6, 0.4), (-0.25, -0.5, -0.25, 0.4), (0.25, -0.5, 0.25, 0.4), (-0.5, -0.05, 0.5, -0.05),
]  # fmt: skip


def spiral():
    w = np.linspace(0, 4 * math.pi, 26)
    r = 0.15 + 0.05 * w
    ends = [(r[i] * math.cos(w[i]), r[i] * math.sin(w[i])) for i in range(26)]
    return [(*ends[i], *ends[i + 1]) for i in range(25)]


def figures(layout, rng):
    """Segments in plan view (x, y, x, y), of each figure (x, y, radius, first segment, end), and where around its rock the last one is."""
    segments, found, angle = [], [], None
    for outcrop in layout.outcrops:
        for _ in range(outcrop.figures):
            (place, angle), start = on_outcrop(outcrop, rng), len(segments)
            scale, turn = rng.uniform(0.28, 0.6), rng.uniform(0, 6.3)
            drawing = (MAN, DEER, spiral(), HOUSE)[rng.integers(4)]
            segments += [(*moved(a, b, place, turn, scale), *moved(c, d, place, turn, scale)) for a, b, c, d in drawing]
            found.append((*place, 1.25 * scale, start, len(segments)))
    return np.array(segments, float).reshape(-1, 4), np.array(found, float).reshape(-1, 5), angle


def on_outcrop(outcrop, rng):
    r, a, turn = 0.75 * math.sqrt(rng.random()), rng.uniform(0, 6.3), math.radians(outcrop.turn)
    u, v = r * outcrop.along * math.cos(a), r * outcrop.across * math.sin(a)
    place = outcrop.x + math.cos(turn) * u - math.sin(turn) * v, outcrop.y + math.sin(turn) * u + math.cos(turn) * v
    return place, a


def moved(x, y, place, turn, scale):
    c, s = math.cos(turn) * scale, math.sin(turn) * scale
    return place[0] + c * x - s * y, place[1] + s * x + c * y
