"""The notebook of examples/, from a fixture to pictures."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_notebook_shows_curve_map_and_picture(monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("PROJECT", str(ROOT / "fixtures" / "valley"))
    notebook = nbformat.read(ROOT / "examples" / "quickstart.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=600).execute(cwd=str(ROOT))
    shown = [output.data for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    pages = [data["text/html"] for data in shown if "text/html" in data]
    assert any(page.count("<svg") == 2 for page in pages), "the plan shows its curve and its map"
    assert any("image/png" in data for data in shown), "the surface is drawn"
