"""A scene: its layout, its mesh and leaves, and the inputs of its textures."""

from collections import namedtuple
from dataclasses import dataclass

import numpy as np

from .plants import Leaves
from .shapes import Surface

# Inputs of the textures outdoors. `mud_along` is the half length of the strip of mud around the pond, `blades` says how the grass is bent,
# in each image another way.
Site = namedtuple(
    "Site", "pond_x pond_y mud_along pond_across pond_power grass paved path_half rock half salt blades path pads segments figures"
)
Interior = namedtuple("Interior", "planks stone salt")


@dataclass
class Scene:
    layout: object
    ground: object
    surface: Surface
    leaves: Leaves
    texture: object

    @property
    def indoors(self):
        return self.ground is None


def pads_as_rows(pads):
    """x, y, cosine and sine of the turn, half length, half width."""
    rows = [(pad.x, pad.y, pad.cos, pad.sin, pad.half_length, pad.half_width) for pad in pads]
    return np.array(rows, float).reshape(-1, 6)
