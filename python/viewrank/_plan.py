"""Plans: which views get a depth map, with which partners, in which order."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Optional, Union

import numpy as np
from numpy.typing import NDArray

from . import _viewrank
from ._run import Progress, Runner
from ._scene import PathLike, Scene
from ._text import printable

__all__ = ["Cluster", "Export", "Fulfilment", "Plan", "Surface", "Visibility", "load", "plan"]


@dataclass(frozen=True)
class Cluster:
    """A key view with its matching partners.

    Attributes
    ----------
    key : str
        Name of the view that gets a depth map.
    partners : list of str
        Names of the views that it is matched against.
    gain : float
        What it adds to the fulfilment of all clusters ranked before it, 0 to 1.
    share : float
        Part that fusion keeps of this cluster and all before it, over that of all clusters, 0 to 1.
    scale : float
        Size at which it is matched, over that of the plan: 1 or, with `ranking.scales`, 0.5.
    """

    key: str
    partners: list[str]
    gain: float
    share: float
    scale: float = 1.0


@dataclass(frozen=True)
class Surface:
    """The triangle mesh of a plan, with the fulfilment reached on it. All arrays are read-only.

    Attributes
    ----------
    vertices : ndarray of float64, shape (v, 3)
        World coordinates, scene units.
    triangles : ndarray of uint32, shape (t, 3)
        Vertices, counter-clockwise seen from outside.
    fulfilment : ndarray of float32, shape (t,)
        Fulfilment by the chosen clusters, 0 to 1.
    reachable : ndarray of float32, shape (t,)
        Fulfilment by all clusters together, 0 to 1.
    chosen_views : ndarray of uint16, shape (t,)
        Number of chosen key views that fulfil the triangle at all.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.uint32]
    fulfilment: NDArray[np.float32]
    reachable: NDArray[np.float32]
    chosen_views: NDArray[np.uint16]


@dataclass(frozen=True)
class Visibility:
    """Which view sees which triangle, as compressed sparse rows (CSR), a row per view. All arrays are read-only.

    Attributes
    ----------
    offsets : ndarray of uint, shape (views + 1,)
        Row i is ``triangles[offsets[i]:offsets[i + 1]]``.
    triangles : ndarray of uint32
        Triangles, ascending within a row.
    """

    offsets: NDArray[np.uintp]
    triangles: NDArray[np.uint32]

    def seen_by(self, view: int) -> NDArray[np.uint32]:
        """Return the triangles that a view (its position in `Plan.names`) sees, ascending."""
        return self.triangles[int(self.offsets[view]) : int(self.offsets[view + 1])]


@dataclass(frozen=True)
class Fulfilment:
    """How well each cluster fulfils each triangle, as compressed sparse rows (CSR), a row per cluster. All arrays are read-only.

    Attributes
    ----------
    keys : ndarray of uint32, shape (clusters,)
        Key view of each row, a position in `Plan.names`; ascending, not by rank.
    offsets : ndarray of uint, shape (clusters + 1,)
        Row i is ``triangles[offsets[i]:offsets[i + 1]]`` with ``values`` of the same range.
    triangles : ndarray of uint32
        Triangles, ascending within a row.
    values : ndarray of float32
        Fulfilment, above 0, up to 1.
    """

    keys: NDArray[np.uint32]
    offsets: NDArray[np.uintp]
    triangles: NDArray[np.uint32]
    values: NDArray[np.float32]


@dataclass(frozen=True)
class Export:
    """Files written for a backend.

    Attributes
    ----------
    folder : pathlib.Path
        Where they are.
    backend : str
        Name of the backend.
    commands : list of str
        Shell commands that run it there.
    warnings : list of str
        What to look at before.
    record : dict
        The whole record, as ``export.json`` has it.
    """

    folder: Path
    backend: str
    commands: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    record: dict[str, Any] = field(default_factory=dict, repr=False)


class Plan:
    """A ranking of view clusters, its cut, and the tables that it was made from. Immutable.

    `plan` makes one, `load` reads one that was written. In a notebook it shows its curve and a map.
    """

    def __init__(self, native: _viewrank.Plan) -> None:
        self._native = native

    @property
    def backend(self) -> str:
        """Name of the backend that the plan is made for."""
        return self._native.backend

    @property
    def folder(self) -> Optional[Path]:
        """Folder of the project; None where it is temporary."""
        return self._native.folder

    @cached_property
    def names(self) -> list[str]:
        """Names of all views, sorted; positions in this list number the views of the tables."""
        return self._native.names

    @cached_property
    def ranking(self) -> list[Cluster]:
        """All clusters with a gain, best first."""
        return [Cluster(*cluster) for cluster in self._native.ranking()]

    @property
    def clusters(self) -> list[Cluster]:
        """The clusters to compute, best first: the ranking up to the cut."""
        return self.ranking[: self.cut["clusters"]]

    @cached_property
    def cut(self) -> dict[str, Any]:
        """The cut as the manifest has it: ``clusters``, ``pairs``, ``share``, ``kept``, ``reachable``, bands of the shares and more."""
        return dict(json.loads(self._native.cut()))

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All settings in force."""
        return dict(json.loads(self._native.settings()))

    @property
    def warnings(self) -> list[str]:
        """What to look at before matching."""
        return [printable(warning) for warning in self._native.warnings]

    @cached_property
    def curve(self) -> NDArray[np.void]:
        """What each prefix of the ranking gives and costs: a structured array with an entry per cluster, best first.

        Fields: ``clusters`` and ``pairs`` (int64, cumulative); ``share`` (0 to 1, of what fusion keeps of all clusters); ``kept`` (0 to 1, weight of
        the triangles that fusion keeps); ``fulfilment`` (0 to 1); ``points`` (pixels that will be measured, before fusion); ``seconds`` (of matching;
        NaN unless ``forecast.seconds_per_pair`` or ``forecast.seconds_per_map`` is set). Of a backend that uses the images themselves, ``share``,
        ``kept`` and ``fulfilment`` count how well all photographs can be drawn again, and ``pairs`` and ``points`` are 0.
        """
        columns = self._native.curve()
        table = np.empty(len(columns["clusters"]), dtype=[(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            table[name] = column
        table.flags.writeable = False
        return table

    @cached_property
    def surface(self) -> Surface:
        """The surface, with the fulfilment reached at the cut."""
        states = self._native.triangle_states(self.cut["clusters"])
        for state in states:
            state.flags.writeable = False
        return Surface(self._native.vertices(), self._native.triangles(), *states)

    @cached_property
    def visibility(self) -> Visibility:
        """Which view sees which triangle."""
        return Visibility(self._native.visibility_offsets(), self._native.visibility_triangles())

    @cached_property
    def fulfilment(self) -> Fulfilment:
        """How well each cluster fulfils each triangle."""
        native = self._native
        keys = np.asarray(native.fulfilment_keys(), dtype=np.uint32)
        keys.flags.writeable = False
        return Fulfilment(keys, native.fulfilment_offsets(), native.fulfilment_triangles(), native.fulfilment_values())

    def write(self, *, progress: Progress = None) -> Path:
        """Write the plan and the files of its backends to the project, as ``viewrank plan`` does.

        Returns
        -------
        pathlib.Path
            The folder of the plan, ``PROJECT/viewrank``.

        Raises
        ------
        ReadError
            The model's files have changed since they were read.
        WriteError
            The files cannot be written, or the model has no folder.
        """
        with Runner(progress) as runner:
            return self._native.write(runner)[0]

    def export(
        self,
        backend: str,
        out: Optional[PathLike] = None,
        *,
        budget: Optional[int] = None,
        refs: Optional[str] = None,
        geometric: Optional[bool] = None,
        scene: Optional[PathLike] = None,
        scale: bool = False,
        progress: Progress = None,
    ) -> Export:
        """Write the input files of an MVS program for the chosen clusters.

        Parameters
        ----------
        backend : str
            Name of the program; `backends` lists them.
        out : path, optional
            Folder of the files. Default: ``PROJECT/viewrank/BACKEND``; for COLMAP the project's dense workspace.
        budget : int, optional
            Number of clusters. Default: the plan's cut.
        refs : {"keys", "keys+partners", "all"}, optional
            COLMAP: views that get depth maps.
        geometric : bool, optional
            COLMAP: geometric consistency.
        scene, scale
            OpenMVS: the list of neighbours for this ``scene.mvs``, and a copy of it at a size that fits OpenMVS's depth range.
        progress : bool or callable, optional
            See `plan`.

        Raises
        ------
        ReadError
            The model's files have changed since they were read.
        ExportError
            The program cannot take the views, or the folder holds something else.
        """
        clusters = self.cut["clusters"] if budget is None else budget
        with Runner(progress) as runner:
            folder, text = self._native.export(backend, out, clusters, refs, geometric, scene, scale, runner)
        record = dict(json.loads(text))
        runner_script = record.get("runner")
        commands = [f"./{runner_script}"] if runner_script else list(record.get("commands", []))
        return Export(folder, record["backend"], commands, [printable(warning) for warning in record.get("warnings", [])], record)

    def report(
        self,
        path: Optional[PathLike] = None,
        *,
        depth_maps: Optional[PathLike] = None,
        reference: Optional[PathLike] = None,
        progress: Progress = None,
    ) -> Path:
        """Write the report, a page for any browser.

        Parameters
        ----------
        path : path, optional
            The HTML file, which is replaced. Default: ``PROJECT/viewrank/report.html``.
        depth_maps, reference : path, optional
            Finished depth maps to compare with the prediction, and better ones to measure them by.
        progress : bool or callable, optional
            See `plan`.
        """
        with Runner(progress) as runner:
            return self._native.report(path, depth_maps, reference, runner)

    def __repr__(self) -> str:
        cut = self.cut
        what = f"depth maps, {cut['pairs']} pairs" if self._native.makes_maps else "images"
        return f"Plan({cut['clusters']} of {len(self.names)} {what}, share {cut['share']:.3f}, for {self.backend})"

    def _repr_html_(self) -> str:
        style = 'style="display:flex;flex-wrap:wrap;gap:12px;align-items:flex-start"'
        legend = (
            "Map: orange discs are key views (rank and name on hovering), rings other views. The surface is blue where the chosen depth maps reach "
            "all that can be reached, yellow half, red nothing; grey where no view reaches anything."
        )
        legend = f'<p style="flex-basis:100%;font-size:13px;color:#666;margin:0">{legend}</p>'
        return f"<div {style}>{self._native.curve_svg()}{self._native.map_svg()}{legend}</div>"


def plan(
    source: Any,
    *,
    backend: Union[str, Sequence[str], None] = None,
    k: Optional[int] = None,
    target: Union[float, str, None] = None,
    budget: Union[int, float, str, None] = None,
    test_every: Optional[int] = None,
    time: Union[float, str, None] = None,
    points: Union[float, str, None] = None,
    region: Union[PathLike, Sequence[float], None] = None,
    gsd: Union[float, str, None] = None,
    accuracy: Union[float, str, None] = None,
    partners: Optional[str] = None,
    confidence: Optional[str] = None,
    surface: Optional[str] = None,
    up: Optional[Sequence[float]] = None,
    mesh: Optional[PathLike] = None,
    mesh_as_is: Optional[bool] = None,
    pilot: Optional[PathLike] = None,
    seed: Optional[int] = None,
    max_memory: Union[int, str, None] = None,
    settings: Optional[Mapping[str, Any]] = None,
    model: Optional[str] = None,
    images: Optional[PathLike] = None,
    folder: Optional[PathLike] = None,
    threads: Optional[int] = None,
    progress: Progress = None,
) -> Plan:
    """Rank the view clusters of a project. Writes nothing; `Plan.write` does.

    The user's settings file and the project's ``viewrank.toml`` apply, as for the program; keywords override them.

    Parameters
    ----------
    source : path, Scene, pycolmap.Reconstruction or mapping
        The project; a mapping has the arguments of `Scene.from_arrays`.
    backend : str or sequence of str, optional
        Backends to write for; the plan is made for the first. Default: as the project is set up, else what is
        installed.
    k : int, optional
        Matching partners per key view. Default: 5.
    target : float or str, optional
        Stop at this share of what all clusters together reach: 0.9, 90 or ``"90%"``; 1 is all. Default: 0.9, if no other limit is set.
    budget : int, float or str, optional
        Stop after this number of clusters, or this share (0 to 1, or ``"5%"``) of the views.
    test_every : int, optional
        Keep every n-th view by name, from the first, apart for tests: of ``"splat"`` and ``"images"``, which use the images themselves; 0: none, whatever the model says.
    time : float or str, optional
        Stop before the forecast time of matching exceeds this, seconds or ``"2h"``.
    points : float or str, optional
        Stop before the forecast number of points exceeds this, such as ``"50M"``.
    region : path, "auto" or sequence of float, optional
        Plan for this part of the scene: a file of GeoJSON polygons or a closed PLY mesh, a box (x0, y0, z0, x1, y1, z1), or
        ``"auto"``, the part that the photographs show most densely.
    gsd, accuracy : float or str, optional
        Wanted ground sampling distance, scene units per pixel, and accuracy of a point, scene units; ``"2cm"`` where the units are
        metric. Default: from the model.
    partners : {"search", "sampled"}, optional
        Choice of partners.
    confidence : {"photometric", "geometric", "none", "auto"}, optional
        What predicts success; ``"auto"`` compares the pictures where there are images.
    surface : {"auto", "3d", "terrain"}, optional
        Kind of surface.
    up : sequence of 3 float, optional
        Up direction of a terrain surface, world coordinates.
    pilot
        Folder of small depth maps of all views that the program made (``viewrank pilot``), to rank by.
    mesh, mesh_as_is
        PLY file to use as surface; True for `mesh_as_is` skips simplification and refinement.
    seed : int, optional
        Seed of all random choices. Default: 0.
    max_memory : int or str, optional
        Memory limit, bytes or ``"8G"``.
    settings : mapping, optional
        Any other settings by key, such as ``{"forecast.seconds_per_pair": 1.5}``; ``viewrank config`` lists them.
    model : str, optional
        Name of a sub-model of a project.
    images, folder : path, optional
        Image folder; folder for a model in memory and its plan. See `Scene.from_arrays`.
    threads : int, optional
        Number of threads; the plan is the same for any. Default: one per core.
    progress : bool or callable, optional
        Called as ``progress(stage, done, total)`` in the calling thread; True shows bars by tqdm.

    Returns
    -------
    Plan

    Raises
    ------
    ReadError
        The model cannot be read.
    SettingsError
        A setting is wrong.
    PlanError
        Planning failed.
    KeyboardInterrupt
        Ctrl-C; nothing was written.

    Examples
    --------
    >>> import viewrank
    >>> plan = viewrank.plan("project", backend="openmvs", k=5, target=0.9)  # doctest: +SKIP
    >>> plan.clusters[0].key  # doctest: +SKIP
    'a.jpg'
    """
    keywords = {
        "backend": backend,
        "k": k,
        "target": target,
        "budget": budget,
        "time": time,
        "points": points,
        "region": region,
        "gsd": gsd,
        "accuracy": accuracy,
        "partners": partners,
        "confidence": confidence,
        "surface": surface,
        "up": up,
        "mesh": mesh,
        "mesh_as_is": mesh_as_is,
        "test_every": test_every,
        "pilot": pilot,
        "seed": seed,
        "max_memory": max_memory,
        "settings": None if settings is None else dict(settings),
    }
    with Runner(progress, threads) as runner:
        native = _model(source, model, images, folder, runner)
        return Plan(_viewrank.Plan.new(native, keywords, runner))


def load(project: PathLike, *, threads: Optional[int] = None, progress: Progress = None) -> Plan:
    """Read the plan that was written to a project, with all its tables, which are computed again.

    Raises
    ------
    ReadError
        There is no plan, or the model or the images have changed since it was made.
    """
    with Runner(progress, threads) as runner:
        return Plan(_viewrank.Plan.load(project, runner))


def _model(
    source: Any, model: Optional[str], images: Optional[PathLike], folder: Optional[PathLike], runner: Runner
) -> _viewrank.Model:
    """Return the model behind whatever `plan` was given."""
    if isinstance(source, (str, os.PathLike)):
        return _viewrank.Model.read(source, model, images, runner)
    if isinstance(source, Scene):
        return source._native
    if hasattr(source, "write_binary"):
        return Scene.from_reconstruction(source, images=images, folder=folder)._native
    if isinstance(source, Mapping):
        return Scene.from_arrays(**{"images": images, "folder": folder, **source})._native
    raise TypeError(f"cannot plan {type(source).__name__}: give a path, a Scene, a pycolmap.Reconstruction or a mapping of arrays")
