"""Evaluation and diagnosis."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Optional, Union

import numpy as np
from numpy.typing import NDArray

from . import _viewrank
from ._plan import Plan, load
from ._run import Progress, Runner
from ._scene import PathLike
from ._text import printable

__all__ = ["Evaluation", "Finding", "backends", "doctor", "evaluate"]


@dataclass(frozen=True)
class Evaluation:
    """Finished depth maps, measured.

    Attributes
    ----------
    depth_maps : int
        Number of clusters with a depth map.
    completeness : float
        Correct pixels over those of the reference, 0 to 1.
    predicted, real : float
        Fulfilment of these clusters, predicted and measured, 0 to 1.
    predicted_kept, kept : float
        Weight of the triangles that fusion keeps of them, predicted and measured, 0 to 1.
    curve : dict of ndarray
        Along the order of the clusters, entry i after i clusters: ``predicted`` and ``real`` shares (0 to 1), ``fulfilment``, ``pairs``.
    missing : dict of str to int
        Number of triangles that are not well done, by reason.
    without_map : list of str
        Key views without a depth map.
    data : dict
        The whole evaluation, as ``evaluation.json`` has it.
    """

    depth_maps: int
    completeness: float
    predicted: float
    real: float
    predicted_kept: float
    kept: float
    curve: dict[str, NDArray[np.float64]] = field(repr=False)
    missing: dict[str, int] = field(repr=False)
    without_map: list[str] = field(repr=False)
    data: dict[str, Any] = field(repr=False)


@dataclass(frozen=True)
class Finding:
    """Something that the user of a project should know.

    Attributes
    ----------
    severity : {"error", "warning", "note"}
        Error: the result will be wrong or missing. Warning: it will be worse than it could be.
    check : str
        Identifier of the kind of finding.
    what, cure : str
        The finding and its remedy.
    backends : list of str
        Backends concerned; empty: all.
    views : list of str
        Views concerned; empty: the whole project.
    """

    severity: str
    check: str
    what: str
    cure: str
    backends: list[str]
    views: list[str]


def evaluate(
    plan: Union[Plan, PathLike],
    depth_maps: PathLike,
    reference: Optional[PathLike] = None,
    *,
    baselines: bool = False,
    threads: Optional[int] = None,
    progress: Progress = None,
) -> Evaluation:
    """Measure finished depth maps against their plan. Writes nothing.

    Parameters
    ----------
    plan : Plan or path
        The plan, or a project with a written plan.
    depth_maps : path
        Folder of depth maps of COLMAP, OpenMVS, MVSNet, ACMM or integrations/sgm.
    reference : path, optional
        Folder of reference depth maps. Default: every depth counts as correct.
    baselines : bool
        Also compare the order with others (``data["orders"]``).
    threads, progress
        See `plan`.

    Raises
    ------
    EvaluateError
        The depth maps cannot be read, or none belongs to the plan.
    """
    planned = plan if isinstance(plan, Plan) else load(plan, threads=threads, progress=progress)
    with Runner(progress, threads) as runner:
        data = json.loads(planned._native.evaluate(depth_maps, reference, baselines, runner))
    return Evaluation(
        depth_maps=len(data["key_views"]),
        completeness=data["quality"]["completeness"],
        predicted=data["predicted"],
        real=data["real"],
        predicted_kept=data["kept"]["predicted"],
        kept=data["kept"]["real"],
        curve={name: np.asarray(values, dtype=np.float64) for name, values in data["curve"].items()},
        missing=data["missing"],
        without_map=data["without_map"],
        data=data,
    )


def doctor(
    project: PathLike,
    backend: Union[str, Sequence[str]] = (),
    *,
    model: Optional[str] = None,
    progress: Progress = None,
) -> list[Finding]:
    """Find problems of a project: views without partners, weak links, implausible units, traps of MVS programs.

    Parameters
    ----------
    project : path
        As for `read`.
    backend : str or sequence of str, optional
        Backends to check; partners are checked for the first. Default: all.
    model : str, optional
        Name of a sub-model.
    progress : bool or callable, optional
        See `plan`.

    Returns
    -------
    list of Finding
        Most severe first.
    """
    names = [backend] if isinstance(backend, str) else list(backend)
    with Runner(progress) as runner:
        diagnosis = json.loads(_viewrank.doctor_json(project, names, model, runner))

    def finding(found: dict[str, Any]) -> Finding:
        texts = {text: printable(found[text]) for text in ("what", "cure")}
        return Finding(**{**found, **texts, "views": [view["name"] for view in found["views"]]})

    return [finding(found) for found in diagnosis["findings"]]


def backends() -> list[str]:
    """Return the names of the supported MVS programs."""
    return _viewrank.backend_names()
