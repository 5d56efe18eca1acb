"""More buildings and paving than the valley: a yard with two houses, walls, cars and hedges."""

from .. import flights, outdoors
from .layout import Hut, Outcrop, Outdoors, Pond, Pose, scatter

SALT = 5000
FOCAL_TO_WIDTH = 0.85


def layout(seed):
    _, by = scatter(seed)
    return Outdoors(
        relief=0.35, slope=(0.015, -0.02), grass=1.0, rock=(0.42, 0.38, 0.33), paved=True, path_half=1.7,
        path=[(-60, 14), (-28, 12), (-14, 10 + by()), (-4, 4.5), (3, -1), (14, -4 + by()), (28, -6), (60, -9)],
        outcrops=[
            Outcrop(11 + by(), 10 + by(), 3.4, 2.6, 1.5, -30, 1.2, 0),
            Outcrop(-19, -8, 3.0, 2.2, 1.1, 15, 1.0, 6),
        ],
        pond=Pond(10, -15.5, 4.6, 2.4, 8.0),
        huts=[Hut(-8 + by(), -6 + by(), 10.5, 7.5, 4.6, -8), Hut(17, 3.5, 5.5, 4.0, 2.5, 82)],
        walls=[(-27, -20, -27, 6, 1.3), (22, -20, -8, -22, 1.1)],
        cars=[Pose(-3.2, 7.8, -38), Pose(8.0, 1.0, -20)],
        trees=12, bushes=12, boulders=14, conifers=0.4,
        hedges=[[(-26, 20), (-8, 21), (10, 19)], [(26, 16), (27, -3)]],
        rails=[[(3, -11.8), (3.5, -19.5)], [(-24, 15.5), (-14, 14), (-6, 9.5)]],
        boards=[Pose(-0.5, 1.2, 60)],
        targets=[("hut", 0), ("outcrop", 0)], ring_radii=(13.0, 19.0),
    )  # fmt: skip


def build(seed):
    return outdoors.build(layout(seed), seed, SALT)


def plan_views(scene, total, seed):
    return flights.grid_domes_walk(scene, total, seed, FOCAL_TO_WIDTH)
