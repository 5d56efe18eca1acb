"""Choices that differ from set to set."""

from typing import NamedTuple, Optional, Union


class Recipe(NamedTuple):
    """Focal length in pixels of the reduced photographs, to begin with. Partners: "all", "near" (by GPS), or how many likely ones."""

    focal: float
    partners: Union[str, int]
    features: int = 4000
    # Seconds by which GPS lags, where its heights are poor.
    lag: Optional[float] = None
    # A file of ground control in the repository, and the width of the images that its pixels refer to.
    control: Optional[str] = None
    control_width: Optional[int] = None
    # Near duplicates, left out once all are mapped.
    dropped: tuple = ()
    quality: int = 90
    distorted: bool = True
