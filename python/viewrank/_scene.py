"""Sparse models."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Optional, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _viewrank
from ._errors import ReadError
from ._run import Progress, Runner
from ._text import printable

__all__ = ["Camera", "PathLike", "Scene", "read"]

PathLike = Union[str, "os.PathLike[str]"]


class Camera(NamedTuple):
    """Intrinsics as COLMAP writes them.

    Attributes
    ----------
    model : str
        COLMAP's name of the camera model, such as ``"PINHOLE"``.
    width, height : int
        Image size, pixels.
    params : list of float
        Parameters in COLMAP's order for the model, such as fx, fy, cx, cy. The centre of the first pixel is at (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: list[float]


class Scene:
    """A sparse model: views, cameras, points and tracks. Immutable.

    `read` reads one, `from_arrays` and `from_reconstruction` make one. All arrays are read-only; views are in the order of their names.
    """

    def __init__(self, native: _viewrank.Model) -> None:
        self._native = native

    @classmethod
    def from_arrays(
        cls,
        names: Sequence[str],
        cameras: Sequence[Union[Camera, tuple[str, int, int, Sequence[float]]]],
        cam_from_world: ArrayLike,
        points: ArrayLike,
        observations: ArrayLike,
        *,
        camera: Optional[ArrayLike] = None,
        pixels: Optional[ArrayLike] = None,
        images: Optional[PathLike] = None,
        folder: Optional[PathLike] = None,
    ) -> Scene:
        """Make a model of arrays.

        Parameters
        ----------
        names : sequence of str
            Image path of each of the n views, relative to `images`, unique.
        cameras : sequence of Camera or (model, width, height, params)
            Intrinsics.
        cam_from_world : array_like, shape (n, 3, 4) or (n, 4, 4)
            World to camera, ``[R | t]``: x right, y down, z forward; scene units.
        points : array_like, shape (p, 3)
            Sparse points, world coordinates, scene units.
        observations : array_like of int, shape (o, 2)
            Which point is seen in which view: rows (point, view), counted from 0.
        camera : array_like of int, shape (n,), optional
            Camera of each view, counted from 0. Default: the first for all.
        pixels : array_like, shape (o, 2), optional
            Where each observation is in its image, pixels. Default: the projection of the point.
        images : path, optional
            Image folder. Without images, confidence is geometric.
        folder : path, optional
            New folder for the model (as COLMAP writes it) and its plan. Default: a temporary one, removed with the scene.

        Raises
        ------
        ReadError
            The arrays contradict each other.
        WriteError
            The folder cannot be written, or has another model.
        """
        poses = np.asarray(cam_from_world, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)):
            raise ReadError(f"cannot use cam_from_world: its shape is {poses.shape}", "give (views, 3, 4) or (views, 4, 4)")
        none = np.empty((0, 2))
        native = _viewrank.Model.from_arrays(
            list(names),
            [(str(model), int(width), int(height), [float(p) for p in params]) for model, width, height, params in cameras],
            np.zeros(len(names), dtype=np.int64) if camera is None else _whole("camera", camera, 1),
            np.ascontiguousarray(poses[:, :3, :]).reshape(-1, 12),
            _table("points", points, 3),
            _whole("observations", observations, 2),
            none if pixels is None else _table("pixels", pixels, 2),
            images,
            folder,
            Runner(),
        )
        return cls(native)

    @classmethod
    def from_reconstruction(
        cls, reconstruction: Any, *, images: Optional[PathLike] = None, folder: Optional[PathLike] = None
    ) -> Scene:
        """Make a model of a ``pycolmap.Reconstruction``.

        Parameters
        ----------
        reconstruction : pycolmap.Reconstruction
            Its registered images become views.
        images, folder : path, optional
            As in `from_arrays`.
        """
        return cls(_viewrank.Model.written_by(reconstruction.write_binary, images, folder, Runner()))

    @property
    def folder(self) -> Optional[Path]:
        """Folder of the project; None where it is temporary."""
        return self._native.folder

    @property
    def images(self) -> Optional[Path]:
        """Image folder, if there is one."""
        return self._native.images

    @cached_property
    def names(self) -> list[str]:
        """Names of the n views, sorted."""
        return self._native.names

    @cached_property
    def cameras(self) -> list[Camera]:
        """Intrinsics."""
        return [Camera(*camera) for camera in self._native.cameras]

    @cached_property
    def camera(self) -> NDArray[np.intp]:
        """Camera of each view, shape (n,), counted from 0."""
        return _frozen(np.asarray(self._native.camera, dtype=np.intp))

    @cached_property
    def cam_from_world(self) -> NDArray[np.float64]:
        """World to camera, ``[R | t]``, shape (n, 3, 4): x right, y down, z forward; scene units."""
        return _frozen(self._native.cam_from_world().reshape(-1, 3, 4))

    @property
    def centres(self) -> NDArray[np.float64]:
        """Camera centres, shape (n, 3), world coordinates, scene units."""
        poses = self.cam_from_world
        return np.asarray(-np.einsum("nij,ni->nj", poses[:, :, :3], poses[:, :, 3]))

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Sparse points, shape (p, 3), world coordinates, scene units."""
        return self._native.points()

    @cached_property
    def point_ids(self) -> NDArray[np.uint64]:
        """Ids of the points in the model's file, shape (p,)."""
        return self._native.point_ids()

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colours of the points, shape (p, 3), R G B."""
        return self._native.colours()

    @cached_property
    def track_offsets(self) -> NDArray[np.uintp]:
        """Point i is observed by ``track_views[track_offsets[i]:track_offsets[i + 1]]``; shape (p + 1,)."""
        return self._native.track_offsets()

    @cached_property
    def track_views(self) -> NDArray[np.uint32]:
        """View of each observation, shape (o,)."""
        return _frozen(np.asarray(self._native.track_views(), dtype=np.uint32))

    @cached_property
    def track_pixels(self) -> NDArray[np.float64]:
        """Image position of each observation, shape (o, 2), pixels."""
        return self._native.track_pixels()

    @property
    def unregistered(self) -> list[str]:
        """Images without a pose."""
        return self._native.unregistered

    @property
    def warnings(self) -> list[str]:
        """Problems that did not prevent reading."""
        return [printable(warning) for warning in self._native.warnings]

    def __repr__(self) -> str:
        return f"Scene({len(self.names)} views, {len(self.points)} points)"


def read(
    project: PathLike,
    *,
    model: Optional[str] = None,
    images: Optional[PathLike] = None,
    progress: Progress = None,
) -> Scene:
    """Read the sparse model of a project.

    Parameters
    ----------
    project : path
        A project or model of COLMAP, Bundler, VisualSFM, OpenMVG, OpenSfM, OpenDroneMap, AliceVision, OpenMVS or SURE.
    model : str, optional
        Name of a sub-model. Default: the one with most registered images.
    images : path, optional
        Image folder, if it is not next to the model.
    progress : bool or callable, optional
        See `plan`.

    Raises
    ------
    ReadError
        There is no model, or it cannot be read.
    """
    with Runner(progress) as runner:
        return Scene(_viewrank.Model.read(project, model, images, runner))


def _table(name: str, values: ArrayLike, columns: int) -> NDArray[np.float64]:
    table = np.ascontiguousarray(values, dtype=np.float64)
    if table.size == 0:
        return np.empty((0, columns))
    if table.ndim != 2 or table.shape[1] != columns:
        raise ReadError(f"cannot use {name}: its shape is {table.shape}", f"give (rows, {columns})")
    return table


def _whole(name: str, values: ArrayLike, dimensions: int) -> NDArray[np.int64]:
    table = np.asarray(values)
    if table.size == 0:
        return np.empty((0, 2)[:dimensions], dtype=np.int64)
    if table.ndim != dimensions or (dimensions == 2 and table.shape[1] != 2) or table.dtype.kind not in "iu":
        shape = "(views,)" if dimensions == 1 else "(observations, 2)"
        raise ReadError(f"cannot use {name}: its shape is {table.shape}, its type {table.dtype}", f"give whole numbers, {shape}")
    if table.min() < 0:
        raise ReadError(f"cannot use {name}: an index is negative", "count from 0")
    return np.ascontiguousarray(table, dtype=np.int64)


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array
