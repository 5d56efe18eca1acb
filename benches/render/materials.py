"""Numbers of the materials, as the faces in `truth/scene.ply` have them."""

TERRAIN, ROCK, PLASTER, ROOF, WINDOW, WOOD, WATER, BARK, LEAF, STONE, PAINT, BOARD = range(12)
# Indoors. From WALL on: the shell of the building, which casts no shadow.
MARBLE, PICTURE, BOOK, CLOTH, GLOSS, WALL, FLOOR, PANE = range(12, 20)
NAMES = (
    "terrain rock plaster roof window wood water bark leaf stone paint board marble picture book cloth gloss wall floor pane"
).split()
OUTDOOR_NAMES = NAMES[:MARBLE]
MIRRORS = (WATER, WINDOW, PAINT, GLOSS)
