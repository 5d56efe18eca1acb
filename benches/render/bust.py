"""A bust: head, neck, draped shoulders and a socle, 0.62 m high; a body with one radius per direction and height, and curls of hair."""

import math

import numpy as np

from .materials import MARBLE
from .noise import noise3_grid
from .shapes import grid_faces, icosphere, smooth_normals

HEIGHT = 0.62
HEIGHTS = [0, 0.015, 0.03, 0.06, 0.09, 0.115, 0.16, 0.22, 0.27, 0.31, 0.335, 0.355, 0.38, 0.40, 0.42, 0.45, 0.48, 0.51, 0.54, 0.57]
HEIGHTS += [0.595, 0.611, 0.62]
# Half widths and half depths at these heights.
WIDTHS = [0.11, 0.115, 0.10, 0.062, 0.06, 0.09, 0.15, 0.21, 0.245, 0.245, 0.20, 0.12, 0.070, 0.064, 0.068, 0.080, 0.086, 0.088, 0.087]
WIDTHS += [0.078, 0.058, 0.033, 0.003]
DEPTHS = [0.11, 0.115, 0.10, 0.062, 0.06, 0.075, 0.10, 0.12, 0.128, 0.118, 0.10, 0.08, 0.068, 0.068, 0.078, 0.098, 0.105, 0.108, 0.106]
DEPTHS += [0.094, 0.07, 0.04, 0.003]
DIRECTIONS, LEVELS, CURLS = 300, 236, 90
ROUNDNESS = 2.25



class Bust:
    """z: height; t: direction; q: direction from the face, which looks somewhere; r: radius."""

    def __init__(self, salt, rng):
        self.salt, self.rng = salt, rng
        widths = np.array(WIDTHS)
        widths[9:12] *= rng.uniform(0.85, 1.1)
        heights, directions = np.linspace(0, HEIGHT, LEVELS), np.linspace(-math.pi, math.pi, DIRECTIONS + 1)
        self.z, self.t = np.meshgrid(heights, directions, indexing="ij")
        q = self.t - rng.uniform(-0.45, 0.45) * np.clip((self.z - 0.37) / 0.06, 0, 1)
        self.q = np.arctan2(np.sin(q), np.cos(q))
        self.r = self.smooth_body(widths)
        self.add_face()
        self.hair = self.where_hair_is()
        self.add_relief()

    def smooth_body(self, widths):
        """Superellipses one above the other."""
        from scipy.interpolate import PchipInterpolator

        a, b = PchipInterpolator(HEIGHTS, widths)(self.z), PchipInterpolator(HEIGHTS, np.array(DEPTHS))(self.z)
        q, e = self.q, ROUNDNESS
        return (np.abs(np.sin(q) / a) ** e + np.abs(np.cos(q) / b) ** e) ** (-1 / e)

    def bump(self, direction, height, wide, high):
        return np.exp(-(((self.q - direction) / wide) ** 2) - ((self.z - height) / high) ** 2)

    def add_face(self):
        z, bump = self.z, self.bump
        self.r += 0.026 * np.exp(-((self.q / 0.11) ** 2)) * np.clip((0.520 - z) / 0.045, 0, 1) * np.clip((z - 0.472) / 0.006, 0, 1)
        self.r += sum(self.eye_and_cheek(side) for side in (-1, 1))
        lips = 0.006 * bump(0, 0.4625, 0.2, 0.0035) - 0.006 * bump(0, 0.4575, 0.22, 0.0025) + 0.006 * bump(0, 0.452, 0.17, 0.004)
        self.r += lips + 0.012 * bump(0, 0.428, 0.25, 0.012)

    def eye_and_cheek(self, side):
        bump = self.bump
        eye = -0.013 * bump(side * 0.37, 0.513, 0.15, 0.011) + 0.006 * bump(side * 0.37, 0.512, 0.09, 0.006)
        return eye + 0.008 * bump(side * 0.33, 0.531, 0.26, 0.006) + 0.006 * bump(side * 0.55, 0.48, 0.2, 0.018)

    def where_hair_is(self):
        q, z = self.q, self.z
        hair = np.clip((np.abs(q) - self.rng.uniform(0.95, 1.2)) / 0.2, 0, 1) * np.clip((z - 0.405) / 0.03, 0, 1)
        hair = np.maximum(hair, np.clip((z - 0.553 - 0.01 * np.cos(3 * q)) / 0.01, 0, 1))
        return hair * np.clip((0.617 - z) / 0.02, 0, 1)

    def places(self):
        return np.stack([self.r * np.sin(self.t), self.r * np.cos(self.t), self.z], -1).reshape(-1, 3)

    def add_relief(self):
        """Folds of the cloth, hair, and the roughness of the stone."""
        z, rng, smooth = self.z, self.rng, self.places()

        def noise(frequency, k):
            return noise3_grid(smooth, frequency, self.salt + k).reshape(z.shape)

        cloth = np.clip((z - 0.12) / 0.05, 0, 1) * np.clip((0.35 - z) / 0.04, 0, 1)
        depth = rng.uniform(0.35, 0.7)
        phase = 2 * math.pi * (z * 15 + depth * np.sin(self.q + rng.uniform(-1, 1)) + 0.55 * noise(9, 1))
        folds = cloth * (0.010 * (1 - np.abs(np.sin(phase / 2))) ** 1.5 + 0.005 * np.sin(2 * phase))
        strands = self.hair * (0.012 + 0.016 * np.abs(noise(38, 2)) + 0.006 * noise(85, 3))
        self.r += folds + strands + 0.0015 * noise(70, 4) + 0.0007 * noise(190, 5)


def add_bust(mesh, foot, turn, salt, rng):
    bust = Bust(salt, rng)
    c, s = math.cos(turn), math.sin(turn)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    body, faces = bust.places(), grid_faces(LEVELS, DIRECTIONS + 1)[:, ::-1]
    vertices, obj = body @ turned.T + foot, mesh.new_object()
    mesh.add(vertices, faces, MARBLE, smooth_normals(vertices, faces), obj=obj)
    sphere, faces = icosphere(2)
    spots = np.nonzero((bust.hair > 0.8).ravel())[0]
    for i in rng.choice(spots, CURLS, replace=False):
        radii = rng.uniform(0.010, 0.018) * np.array([1, 1, rng.uniform(0.8, 1.5)])
        bumps = 1 + 0.25 * noise3_grid(sphere * 2 + i, 1.7, salt + 6) + 0.1 * noise3_grid(sphere * 5 + i, 1.7, salt + 7)
        curl = (body[i] * [0.97, 0.97, 1] + sphere * bumps[:, None] * radii) @ turned.T + foot
        mesh.add(curl, faces, MARBLE, smooth_normals(curl, faces), obj=obj)
