"""Poses of the survey: lines of nadir views, then lines of oblique ones."""

from typing import NamedTuple

import numpy as np

from .site import Site

WIDTH, HEIGHT, FOCAL, ALTITUDE = 5472, 3648, 3650.0, 60.0


class View(NamedTuple):
    """Rotation camera from world, centre."""

    name: str
    rotation: np.ndarray
    centre: np.ndarray

    def local(self, points):
        return (points - self.centre) @ self.rotation.T


def pixels(local):
    return np.stack([FOCAL * local[:, 0] / local[:, 2] + WIDTH / 2, FOCAL * local[:, 1] / local[:, 2] + HEIGHT / 2], 1)


class Survey:
    """`side`: length of the square that is flown over."""

    def __init__(self, count, rng):
        self.nadir = int(round(0.6 * count))
        self.width, height = ALTITUDE * WIDTH / FOCAL, ALTITUDE * HEIGHT / FOCAL
        self.side = float(np.sqrt(self.nadir * (0.3 * self.width) * (0.2 * height)))
        self.rng, self.site = rng, Site(self.side, rng)
        self.level = float(np.median(self.site.terrain))
        self.views = [self.view("nadir", *at) for at in self.lines(self.nadir)]
        self.views += [self.view("oblique", *at) for at in self.lines(count - self.nadir)]

    def lines(self, count, spread=0.6):
        """Number, place and heading of each view; lines to and fro."""
        lines = max(1, int(round(self.side / (0.3 * self.width) * np.sqrt(count / self.nadir))))
        number = 0
        for i in range(lines):
            in_line = count // lines + (i < count % lines)
            for j in range(in_line):
                along = j if i % 2 == 0 else in_line - 1 - j
                x, y = ((i + 0.5) / lines - 0.5) * self.side, ((along + 0.5) / in_line - 0.5) * self.side
                yield number, x + self.rng.normal(0, spread), y + self.rng.normal(0, spread), 0.0 if i % 2 == 0 else np.pi
                number += 1

    def view(self, prefix, number, x, y, heading):
        """At a height that follows the terrain by half; oblique views look to four sides in turn."""
        rng, terrain = self.rng, float(self.site.height(np.array([x]), np.array([y]))[0])
        z = self.level + ALTITUDE + 0.5 * (terrain - self.level) + rng.normal(0, 0.5)
        yaw, pitch, roll = heading + rng.normal(0, 0.04), rng.normal(0, 0.03), rng.normal(0, 0.02)
        if prefix == "oblique":
            yaw = heading + (number % 4) * np.pi / 2 + rng.normal(0, 0.05)
            pitch = np.radians(40) + rng.normal(0, 0.03)
        return View("%s_%05d.jpg" % (prefix, number), rotation(yaw, pitch, roll), np.array([x, y, z]))


def rotation(yaw, pitch, roll):
    """Camera from world; pitch 0 looks down."""
    forward = np.array([np.sin(yaw) * np.sin(pitch), np.cos(yaw) * np.sin(pitch), -np.cos(pitch)])
    up = np.array([np.sin(yaw), np.cos(yaw), 0]) * np.cos(pitch) + np.array([0, 0, np.sin(pitch)])
    right, down, c, s = np.cross(forward, up), -up, np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward])
