"""How long calls report progress."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Callable, Optional, Union

__all__ = ["Progress", "Runner"]

Progress = Union[bool, Callable[[str, int, int], object], None]
"""``progress(stage, done, total)``, or True for a bar by tqdm."""


class Runner:
    """The callback and the number of threads of a long call."""

    def __init__(self, progress: Progress = None, threads: Optional[int] = None) -> None:
        self.progress = _Bars() if progress is True else progress or None
        self.threads = threads

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        if isinstance(self.progress, _Bars):
            self.progress.close()


class _Bars:
    """A bar of tqdm per stage."""

    def __init__(self) -> None:
        self._new: Any = import_module("tqdm.auto").tqdm
        self._stage = ""
        self._bar: Any = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self.close()
            self._stage, self._bar = stage, self._new(total=total, desc=stage)
        self._bar.total = total
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
