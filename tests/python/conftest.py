"""What the tests share: the program (from VIEWRANK, else the debug build) and the data sets, where they are."""
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
    """The large data sets (VIEWRANK_DATA, else ../shared/data); tests that need them are skipped where they aren't."""
    folder = Path(os.environ.get("VIEWRANK_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no data sets in {folder} (set VIEWRANK_DATA)")
    return folder
