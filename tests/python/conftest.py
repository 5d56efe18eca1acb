"""Fixtures of all tests: the program (from VIEWRANK, else the debug build), the small data of the repository, the data sets, and an export."""
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LONG = bool(os.environ.get("VIEWRANK_LONG"))


def spread(items, most):
    """Evenly spread items with the first and the last, `most` of them; all with VIEWRANK_LONG=1."""
    items = list(items)
    if LONG or len(items) <= most:
        return items
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


@pytest.fixture(scope="session")
def viewrank():
    """Runs the program and returns what it did; fails the test on another exit code than the expected one."""
    program = os.environ.get("VIEWRANK", str(ROOT / "target" / "debug" / "viewrank"))

    def run(*arguments, expect=0):
        done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=False)
        assert done.returncode == expect, f"{arguments}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    run.program = Path(program).resolve()
    return run


@pytest.fixture(scope="session")
def example():
    """The path of a program of crates/*/examples, as `cargo test` and `cargo build --examples` leave it."""

    def path(name):
        program = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug/examples" / name
        assert program.is_file(), f"no {program}: cargo build --examples"
        return program

    return path


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


@pytest.fixture(scope="module")
def without_pilot(tmp_path_factory):
    """The user's own settings: plans match no thumbnails, which takes most of their time, unless a test asks for it."""
    folder = tmp_path_factory.mktemp("config")
    (folder / "viewrank").mkdir()
    (folder / "viewrank/viewrank.toml").write_text('confidence.source = "geometric"\n')
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(folder))
        yield


@pytest.fixture(scope="session")
def planned(viewrank, fixtures, tmp_path_factory):
    """The fixture's project with a plan, and the plan's clusters by name."""
    project = tmp_path_factory.mktemp("exports") / "project"
    shutil.copytree(fixtures / "valley", project)
    viewrank("plan", project, "-k", "4", "--budget", "8", "--confidence", "geometric", "--quiet")
    manifest = json.loads((project / "viewrank/manifest.json").read_text())
    clusters = [(cluster["key"], cluster["partners"]) for cluster in manifest["clusters"][:8]]
    assert len(clusters) == 8
    return project, clusters


def names_of(clusters):
    return {name for key, partners in clusters for name in (key, *partners)}


@pytest.fixture
def export(viewrank, planned, tmp_path):
    def run(backend, *options):
        viewrank("export", planned[0], "--backend", backend, "--out", tmp_path / backend, *options)
        return tmp_path / backend

    return run
