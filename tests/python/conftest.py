"""Fixtures of all tests: the program (from VIEWRANK, else the debug build), the small data of the repository, and the data sets."""
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def viewrank():
    """Runs the program and returns what it did; fails the test on another exit code than the expected one."""
    program = os.environ.get("VIEWRANK", str(ROOT / "target" / "debug" / "viewrank"))

    def run(*arguments, expect=0):
        done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=False)
        assert done.returncode == expect, f"{arguments}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    return run


@pytest.fixture(scope="session")
def fixtures():
    """The repository's own small data."""
    return ROOT / "fixtures"


@pytest.fixture(scope="session")
def data():
    """The folder of a data set in VIEWRANK_DATA, else in target/data; skips the test where the set is missing."""
    root = Path(os.environ.get("VIEWRANK_DATA", ROOT / "target" / "data"))

    def folder(name):
        if not (root / name).is_dir():
            pytest.skip(f"no data set {name} in {root}: make it by benches/sets.py {name.split('/')[0]}, or set VIEWRANK_DATA")
        return root / name

    return folder
