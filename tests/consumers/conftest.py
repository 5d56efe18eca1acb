"""Fixtures: viewrank, the set that is matched, and the real programs. A program that is not there skips its tests; each variable is named in the skip."""
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from measure import Views

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def viewrank():
    """Runs viewrank (VIEWRANK, else the debug build)."""
    program = os.environ.get("VIEWRANK", str(ROOT / "target/debug/viewrank"))

    def run(*arguments):
        return call([program, *map(str, arguments)], ROOT)

    return run


@pytest.fixture(scope="session")
def source():
    """The set: VIEWRANK_SET (a folder, or one of VIEWRANK_DATA), else fixtures/valley."""
    wanted = os.environ.get("VIEWRANK_SET")
    if wanted is None:
        return ROOT / "fixtures/valley"
    folders = [Path(wanted), Path(os.environ.get("VIEWRANK_DATA", ROOT / "target/data")) / wanted]
    found = next((folder.resolve() for folder in folders if (folder / "sparse").is_dir()), None)
    assert found, f"VIEWRANK_SET: neither {folders[0]} nor {folders[1]} is a set"
    return found


@pytest.fixture
def planned(viewrank, source, tmp_path):
    """A project planned for a backend, the plan cut after VIEWRANK_MAPS maps (6); returns the project and the folder of the export."""

    def plan(backend):
        project = tmp_path / "project"
        project.mkdir()
        shutil.copytree(source / "sparse", project / "sparse")
        (project / "images").symlink_to(source / "images")
        (project / "viewrank.toml").write_text(f"image_scale = {os.environ.get('VIEWRANK_SCALE', '0.5')}\n")
        viewrank("plan", project, "--backend", backend, "--budget", os.environ.get("VIEWRANK_MAPS", "6"), "--quiet")
        return project, project / "viewrank" / backend

    return plan


@pytest.fixture
def views(source):
    """What the sparse model knows of each view."""
    return Views(source / "sparse/0")


@pytest.fixture
def program():
    """The path of a program: in the folder that a variable names, else on the PATH; skips without it."""

    def find(variable, name):
        folder = os.environ.get(variable)
        found = shutil.which(name, path=folder) if folder else shutil.which(name)
        if found is None:
            pytest.skip(f"no {name}: {variable} is the folder that holds it")
        return Path(found).resolve()

    return find


def call(words, folder, **variables):
    """Runs a command (words, or a line for the shell); fails the test with the end of what it said."""
    shell = isinstance(words, str)
    done = subprocess.run(
        words, cwd=folder, env={**os.environ, **{k: str(v) for k, v in variables.items()}}, capture_output=True, shell=shell, check=False,
        executable="/bin/bash" if shell else None,
    )
    said = (done.stdout + done.stderr).decode(errors="replace")
    assert done.returncode == 0, f"{words}: exit code {done.returncode}\n{said[-4000:]}"
    return said


def clusters_of(export):
    """Names of key views and their partners, in rank order, and the whole of export.json."""
    record = json.loads((export / "export.json").read_text())
    return [(c["key"]["name"], [p["name"] for p in c["partners"]]) for c in record["clusters"]], record
