"""More rock and relief than the valley, and little grass."""

from .. import flights, outdoors
from .layout import Hut, Outcrop, Outdoors, Pond, Pose, scatter

SALT = 9000
FOCAL_TO_WIDTH = 0.85


def layout(seed):
    _, by = scatter(seed)
    return Outdoors(
        relief=1.6, slope=(0.08, -0.05), grass=0.35, rock=(0.47, 0.42, 0.33), path_half=1.6,
        path=[(-60, 2), (-26, -2), (-10, -7), (4, -5 + by()), (14, 3), (17, 14), (22, 40)],
        outcrops=[
            Outcrop(-8 + by(), 9 + by(), 8.0, 5.0, 5.0, 5, 1.5, 0),
            Outcrop(12 + by(), -12, 6.0, 4.5, 3.2, -35, 1.3, 8),
            Outcrop(-19, -12, 4.0, 3.4, 2.4, 60, 1.4, 0),
            Outcrop(24, 10, 4.5, 3.0, 3.5, 85, 1.5, 0),
        ],
        pond=Pond(0, -16, 4.2, 3.3, 2.2),
        huts=[Hut(5, 5, 4.6, 3.4, 2.4, 40)],
        cars=[Pose(9.5, -1.0, 50)],
        trees=9, bushes=26, boulders=34, conifers=0.7,
        rails=[[(-14, -9.5), (-6, -9.4), (2, -8)]],
        boards=[Pose(1.0, -1.5, 10)],
        targets=[("outcrop", 0), ("outcrop", 1)], ring_radii=(10.0, 17.0),
    )  # fmt: skip


def build(seed):
    return outdoors.build(layout(seed), seed, SALT)


def plan_views(scene, total, seed):
    return flights.grid_domes_walk(scene, total, seed, FOCAL_TO_WIDTH)
