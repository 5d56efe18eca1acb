"""The scenes by name. Each has layout(seed), build(seed), plan_views(scene, total, seed), SALT and FOCAL_TO_WIDTH."""

from importlib import import_module

INDOORS = ("statue", "room")
NAMES = ("valley", "yard", "quarry", "grove", *INDOORS)


def scene(name):
    return import_module("." + name, __name__)
