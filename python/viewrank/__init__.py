"""Rank multi-view stereo view clusters before matching.

>>> import viewrank
>>> plan = viewrank.plan("project", backend="openmvs")  # doctest: +SKIP
>>> plan.clusters  # doctest: +SKIP
>>> plan.write()  # doctest: +SKIP

`plan` ranks, `load` reads a written plan, `read` a sparse model; `evaluate` measures finished depth maps, `doctor` finds problems.
Lengths are in scene units, poses map world to camera (x right, y down, z forward), pixels have their centres at 0.5. Errors are subclasses of
`Error` with a ``hint``.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from ._errors import Error, EvaluateError, ExportError, PlanError, ReadError, SettingsError, WriteError
from ._viewrank import VERSION as __version__

if TYPE_CHECKING:
    from ._apps import Evaluation, Finding, backends, doctor, evaluate
    from ._plan import Cluster, Export, Fulfilment, Plan, Surface, Visibility, load, plan
    from ._scene import Camera, Scene, read
else:
    # On first use, so that the program starts without NumPy.
    _MODULES = ("_apps", "_plan", "_scene")

    def __getattr__(name):
        for module in (import_module(f".{module}", __name__) for module in _MODULES if not name.startswith("_")):
            if name in module.__all__:
                globals()[name] = getattr(module, name)
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return __all__


__all__ = [
    "Camera",
    "Cluster",
    "Error",
    "EvaluateError",
    "Evaluation",
    "Export",
    "ExportError",
    "Finding",
    "Fulfilment",
    "Plan",
    "PlanError",
    "ReadError",
    "Scene",
    "SettingsError",
    "Surface",
    "Visibility",
    "WriteError",
    "__version__",
    "backends",
    "doctor",
    "evaluate",
    "load",
    "plan",
    "read",
]
