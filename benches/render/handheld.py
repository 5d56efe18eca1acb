"""Views indoors, taken by hand."""

import numpy as np

from .camera import View, look
from .rays import Rays

# Where to step when no direction is better than another.
ASIDE = np.zeros(3)


class Handheld:
    """Collects views, and steps aside where something is in the way."""

    def __init__(self, scene, seed, focal_to_width):
        self.size, self.rng, self.found = scene.layout.size, np.random.default_rng(300 + seed), []
        self.rays = Rays(scene.surface.vertices, scene.surface.faces)
        self.subject = np.array(scene.layout.subject)
        around = self.rng.normal(0, 1, (300, 3))
        self.around = (around / np.linalg.norm(around, axis=1, keepdims=True)).astype(np.float32)
        u, v = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.37, 0.37, 7))
        self.directions = np.stack([u / focal_to_width, v / focal_to_width, np.ones(u.shape)], -1).reshape(-1, 3)

    def add(self, name, centre, target, least, away=ASIDE):
        """The nearest fifth of the picture is farther than `least`; `away` is where to step."""
        for _ in range(60):
            rotation = look(centre, target, np.array([0, 0, 1.0]) + self.rng.normal(0, 0.035, 3))
            if self.free(centre, rotation, least):
                self.found.append(View(name, rotation, centre))
                return
            centre = centre + away * self.rng.uniform(0, 0.08) + self.rng.normal(0, 0.05, 3)
        print("no free place for", name)

    def free(self, centre, rotation, least):
        ahead = self.distances(centre, (self.directions @ rotation).astype(np.float32))
        clear = self.distances(centre, self.around).min() > 0.22 and np.percentile(ahead, 20) > least
        inside = all(abs(centre[a]) < self.size[a] / 2 - 0.3 for a in (0, 1)) and centre[2] < self.size[2] - 0.3
        return clear and inside

    def distances(self, origin, directions):
        hits = self.rays.from_point(origin, directions)
        return np.where(hits["primID"] < 0, 99, hits["tfar"])
