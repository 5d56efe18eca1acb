"""Which points a view observes."""

import numpy as np

from .flight import ALTITUDE, FOCAL, HEIGHT, WIDTH
from .site import Points

# Metres along the line of sight where it is looked whether something is in the way.
STEPS = np.array([0.8, 1.4, 2.1, 3.0, 4.2, 5.8, 7.8, 10.5, 14, 18.5, 24, 31], np.float32)
FARTHEST = 3.2 * ALTITUDE
BORDER = 8


class Cloud:
    """Points sorted into square cells, to find those that a view may see. `order` is where they were."""

    CELL = 8.0

    def __init__(self, points, half, rng):
        self.half, self.cells = half, int(np.ceil(2 * half / self.CELL))
        i, j = (np.clip(((points.places[:, a] + half) / self.CELL).astype(np.int64), 0, self.cells - 1) for a in (1, 0))
        cell = i * self.cells + j
        self.order = np.argsort(cell, kind="stable")
        self.start = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=self.cells**2))])
        self.points = Points(*(part[self.order] for part in points))
        count = len(cell)
        preferred = self.points.normals * 0.8 + rng.standard_normal((count, 3), dtype=np.float32) * 0.45
        preferred[:, 2] += 0.35
        self.preferred = preferred / np.linalg.norm(preferred, axis=1, keepdims=True)
        # How often a point is found where it is visible.
        self.salience = rng.beta(1.3, 2.2, count).astype(np.float32)

    def near(self, low, high):
        """Those in cells of a rectangle."""
        (j0, i0), (j1, i1) = ([int(np.clip((v + self.half) / self.CELL, 0, self.cells - 1)) for v in corner] for corner in (low, high))
        rows = [(self.start[i * self.cells + j0], self.start[i * self.cells + j1 + 1]) for i in range(i0, i1 + 1)]
        return np.concatenate([np.arange(*row) for row in rows])


def footprint(site, view):
    """Least and largest x and y that the view may see."""
    corners = [[(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, 1] for u in (0, WIDTH) for v in (0, HEIGHT)]
    rays = np.array(corners) @ view.rotation
    depth = np.minimum((view.centre[2] - site.lowest) / np.maximum(-rays[:, 2], 1e-3), FARTHEST)
    ground = view.centre[:2] + rays[:, :2] * depth[:, None]
    ground = np.concatenate([ground, view.centre[None, :2] + rays[:, :2] * (depth * 0.4)[:, None]])
    return ground.min(0), ground.max(0)


def in_image(local):
    z = local[:, 2]
    inverse = 1 / np.maximum(z, 1)
    u, v = FOCAL * local[:, 0] * inverse + WIDTH / 2, FOCAL * local[:, 1] * inverse + HEIGHT / 2
    inside = (u > BORDER) & (u < WIDTH - BORDER) & (v > BORDER) & (v < HEIGHT - BORDER)
    return (z > 5) & (z < FARTHEST) & inside


def observed(site, cloud, view, rng, gain=None):
    """Points that the view can see, and how likely it finds each; with a gain only those that it does find."""
    points = cloud.near(*footprint(site, view))
    draw = np.full(len(points), np.float32(0.01))
    if gain is not None:
        # Drawn first: most candidates fall out cheaply.
        draw = rng.random(len(points), dtype=np.float32) / np.maximum(gain * cloud.salience[points], 1e-9)
        points, draw = points[draw < 1], draw[draw < 1]
    away = (cloud.points.places[points] - view.centre).astype(np.float32)
    local = away @ view.rotation.T.astype(np.float32)
    inside = in_image(local)
    points, away, depth, draw = points[inside], away[inside], local[inside, 2], draw[inside]
    distance = np.linalg.norm(away, axis=1)
    towards = -away / distance[:, None]
    likely = likelihood(cloud, points, towards, depth)
    found = likely > (draw if gain is not None else 0.01)
    points, likely = points[found], likely[found]
    free = line_of_sight(site, cloud, points, towards[found], distance[found])
    return points[free], likely[free]


def likelihood(cloud, points, towards, depth):
    """0 for points that face away."""
    facing = (cloud.points.normals[points] * towards).sum(1)
    angle = np.arccos(np.clip((cloud.preferred[points] * towards).sum(1), -1, 1))
    return np.exp(-((angle / 0.62) ** 2) - (0.9 * np.log(depth / ALTITUDE)) ** 2) * (facing > 0.12)


def line_of_sight(site, cloud, points, towards, distance):
    """True where nothing in the raster is in the way."""
    start = cloud.points.places[points].astype(np.float32) + 0.25 * cloud.points.normals[points]
    free, top = np.ones(len(points), bool), site.top.ravel()
    for step in STEPS:
        at = start + towards * np.minimum(step, distance * 0.9)[:, None]
        free &= top[site.cell(at[:, 0], at[:, 1])] < at[:, 2] + 0.15
    return free
