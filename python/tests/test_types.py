"""The types of the installed package."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import viewrank

pytest.importorskip("mypy")


def mypy(*arguments, cwd):
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


def test_the_package_is_strictly_typed(tmp_path):
    done = mypy("mypy", "--strict", "-p", "viewrank", cwd=tmp_path)
    assert done.returncode == 0, done.stdout


def test_a_program_with_the_public_names_is_strictly_typed(tmp_path):
    (tmp_path / "user.py").write_text(
        textwrap.dedent("""\
            import viewrank

            plan = viewrank.plan("project", backend="openmvs", k=5, target=0.9)
            names: list[str] = [cluster.key for cluster in plan.clusters]
            total: float = float(plan.curve["share"].sum() + plan.surface.vertices.sum())
            export = plan.export("colmap")
            print(export.folder / "export.json", viewrank.evaluate(plan, "maps").completeness)
            """),
        encoding="utf-8",
    )
    done = mypy("mypy", "--strict", "user.py", cwd=tmp_path)
    assert done.returncode == 0, done.stdout


def test_the_stubs_are_those_of_the_native_part(tmp_path):
    done = mypy("mypy.stubtest", "viewrank._viewrank", "--ignore-missing-stub", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_public_name_is_documented():
    assert (Path(viewrank.__file__).parent / "py.typed").is_file()
    for name in viewrank.__all__:
        assert name == "__version__" or getattr(viewrank, name).__doc__, name
