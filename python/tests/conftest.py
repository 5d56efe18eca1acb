"""The installed package on the small data of the repository. Run outside `python/`, so that the package is the installed one."""

import shutil
from pathlib import Path

import pytest

import viewrank

FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"


@pytest.fixture(scope="session")
def valley(tmp_path_factory):
    """A copy of the valley project."""
    folder = tmp_path_factory.mktemp("projects") / "valley"
    shutil.copytree(FIXTURES / "valley", folder, ignore=shutil.ignore_patterns("viewrank"))
    return folder


@pytest.fixture(scope="session")
def plan(valley):
    """A plan of the valley without the images, which is fast."""
    return viewrank.plan(valley, backend="openmvs", k=5, target=0.9, confidence="geometric")


@pytest.fixture(scope="session")
def scene(valley):
    return viewrank.read(valley)
