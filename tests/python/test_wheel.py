"""The wheel in an environment of its own; building one takes minutes, so that it is tried before a release:

    pip install maturin && packaging/wheel
    VIEWRANK_WHEEL=target/wheels/viewrank-...whl python -m pytest tests/python/test_wheel.py
"""
import os
import subprocess
import venv

import pytest

WHEEL = os.environ.get("VIEWRANK_WHEEL")
pytestmark = pytest.mark.skipif(WHEEL is None, reason="VIEWRANK_WHEEL names no wheel")


def test_the_wheel_carries_the_program_its_manual_and_completions(fixtures, tmp_path):
    folder = tmp_path / "environment"
    venv.create(folder, with_pip=True)
    # Without NumPy, which only the module needs; python/tests has its tests.
    subprocess.run([folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", WHEEL], check=True)

    def run(*arguments):
        return subprocess.run([folder / "bin" / "viewrank", *arguments], capture_output=True, text=True, check=True).stdout

    assert run("--version").startswith("viewrank ")
    (tmp_path / "sparse").symlink_to(fixtures / "valley" / "sparse")
    run("plan", tmp_path, "--quiet")
    assert (tmp_path / "viewrank" / "manifest.json").is_file()
    share = folder / "share"
    assert (share / "man" / "man1" / "viewrank.1").read_text() == run("man")
    assert (share / "man" / "man1" / "viewrank-plan.1").read_text() == run("man", "plan")
    assert (share / "bash-completion" / "completions" / "viewrank").read_text() == run("completions", "bash")
