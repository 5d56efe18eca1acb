"""Parameters of scenes. Lengths in metres, angles in degrees, x and y of places before the rest."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


class Outcrop(NamedTuple):
    x: float
    y: float
    along: float
    across: float
    height: float
    turn: float
    roughness: float
    figures: int


class Pond(NamedTuple):
    """A superellipse."""

    x: float
    y: float
    along: float
    across: float
    power: float


class Hut(NamedTuple):
    x: float
    y: float
    length: float
    width: float
    height: float
    turn: float


class Pose(NamedTuple):
    """Of a car or a board."""

    x: float
    y: float
    turn: float


class Spacing(NamedTuple):
    """Where plants and boulders may be, and how large trees are."""

    extent: tuple = (31, 26)
    trees_apart: float = 2.2
    around_targets: float = 10.5
    growth: float = 1.0


class Foliage(NamedTuple):
    """Which views are refused: leaves nearer than `near` in more than `most_near` of the picture, or any in more than `most`."""

    near: float = 6
    most_near: float = 0.3
    most: float = 1


@dataclass
class Outdoors:
    """A site of about 60 x 50 m."""

    relief: float
    slope: tuple
    grass: float
    rock: tuple
    path: list
    outcrops: list
    pond: Pond
    huts: list
    trees: int
    bushes: int
    boulders: int
    conifers: float
    rails: list
    boards: list
    # Outcrops and huts that rings of views are around, and the radii of the rings.
    targets: list
    ring_radii: tuple
    path_half: float
    paved: bool = False
    walls: list = field(default_factory=list)
    cars: list = field(default_factory=list)
    hedges: list = field(default_factory=list)
    tall_grass: int = 0
    spacing: Spacing = Spacing()
    foliage: Foliage = Foliage()
    walk: list = field(default_factory=list)
    half: tuple = (30.0, 25.0)
    # Azimuth, how far it moves during the flight, elevation.
    sun: tuple = (148, 2.0, 49)

    def __post_init__(self):
        self.path = np.array(self.path, float)


@dataclass
class Indoors:
    """A room of a size, with what it is about at a place."""

    size: tuple
    place: tuple
    stone: tuple
    sun: tuple
    # How far away what hides the light from all sides may be.
    reach: float
    subject: tuple = None


def scatter(seed):
    """The random generator of a seed, and a shift of places by up to `reach` metres drawn from it."""
    rng = np.random.default_rng(1000 + seed)
    return rng, lambda reach=0.6: rng.uniform(-reach, reach)
