"""Exceptions of viewrank."""

from __future__ import annotations

from pathlib import Path
from typing import Optional, Union

from ._text import printable

__all__ = ["Error", "EvaluateError", "ExportError", "PlanError", "ReadError", "SettingsError", "WriteError"]


class Error(Exception):
    """An error of viewrank.

    Attributes
    ----------
    message : str
        What went wrong, and where.
    hint : str or None
        What to do about it.
    path : pathlib.Path or None
        The file or folder that the error is about.
    """

    message: str
    hint: Optional[str]
    path: Optional[Path]

    def __init__(self, message: str, hint: Optional[str] = None, path: Union[str, Path, None] = None) -> None:
        super().__init__(message, hint, path)
        self.message = message
        self.hint = hint
        self.path = None if path is None else Path(path)

    def __str__(self) -> str:
        return printable(self.message if self.hint is None else f"{self.message}\nhint: {self.hint}")


class ReadError(Error):
    """A project, a model or a written plan cannot be read, or arrays are no model."""


class SettingsError(Error, ValueError):
    """A setting or an option is wrong; nothing was tried."""


class PlanError(Error):
    """Planning failed."""


class ExportError(Error):
    """The files of a backend cannot be made."""


class WriteError(Error):
    """Files cannot be written. Earlier files are as they were."""


class EvaluateError(Error):
    """Depth maps cannot be measured."""
