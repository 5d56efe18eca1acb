"""The standard scene: a survey of rock outcrops with rock art among lawn, trees, hand rails, a path, a pond and a hut."""

from .. import flights, outdoors
from .layout import Hut, Outcrop, Outdoors, Pond, Pose, scatter

SALT = 0
FOCAL_TO_WIDTH = 0.85


def layout(seed):
    _, by = scatter(seed)
    return Outdoors(
        relief=1.0, slope=(0.05, 0.03), grass=1.0, rock=(0.36, 0.33, 0.32), path_half=0.85,
        path=[(-60, -13), (-30, -8), (-19, -7), (-12, -5.5 + by()), (-3, -3), (4, 2.5 + by()), (12, 1.5), (20, 5), (30, 4), (60, 9)],
        outcrops=[
            Outcrop(-10 + by(), 4.5 + by(), 6.2, 4.6, 2.7, 25, 1.0, 12),
            Outcrop(10.5 + by(), -8 + by(), 5.4, 4.0, 1.5, -20, 0.8, 16),
            Outcrop(20.5, 15.5, 3.2, 2.6, 1.9, 40, 1.2, 0),
            Outcrop(-23, -15, 2.8, 2.4, 1.3, 10, 1.1, 0),
        ],
        pond=Pond(-4, -16.5, 5.2, 3.9, 2.0),
        huts=[Hut(6, 15.5, 6.2, 4.6, 2.7, 12)],
        trees=17, bushes=30, boulders=15, conifers=0.3,
        rails=[
            [(-18.5, -4.8), (-12, -3.2), (-6, -1.2)],
            [(3.0, -12.5), (7.5, -13.7), (13, -13.2), (17.0, -10.5)],
            [(-18, 1), (-17.5, 6), (-14, 10.5)],
        ],
        boards=[Pose(-7.5, -1.9, 200), Pose(4.5, -11.2, 215)],
        targets=[("outcrop", 0), ("outcrop", 1)], ring_radii=(8.5, 15.0),
    )  # fmt: skip


def build(seed):
    return outdoors.build(layout(seed), seed, SALT)


def plan_views(scene, total, seed):
    return flights.grid_domes_walk(scene, total, seed, FOCAL_TO_WIDTH)
