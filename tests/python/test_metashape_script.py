"""integrations/metashape/depth_maps.py with a stand-in for Metashape."""

import json
import runpy
import shutil
import sys
import types
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "integrations/metashape/depth_maps.py"


class Chunk:
    label = "one"

    def __init__(self, labels):
        self.cameras = [types.SimpleNamespace(label=label, key=10 + i, enabled=True) for i, label in enumerate(labels)]
        self.calls = []

    def buildDepthMaps(self, **options):
        self.calls.append((options, [camera.label for camera in self.cameras if camera.enabled]))

    def buildPointCloud(self):
        self.calls.append("cloud")


def play(tmp_path, monkeypatch, labels):
    chunk = Chunk(labels)
    document = types.SimpleNamespace(chunks=[chunk], open=lambda path: None, save=lambda: None)
    monkeypatch.setitem(sys.modules, "Metashape", types.SimpleNamespace(Document=lambda: document, MildFiltering="mild"))
    shutil.copy(SCRIPT, tmp_path / "depth_maps.py")
    clusters = dict(keys=["a/k.jpg"], enabled=["a/k.jpg", "a/p.jpg"], max_neighbors=1, downscale=2.0)
    (tmp_path / "clusters.json").write_text(json.dumps(clusters))
    monkeypatch.setattr(sys, "argv", ["depth_maps.py", "project.psx"])
    runpy.run_path(str(tmp_path / "depth_maps.py"), run_name="__main__")
    return chunk


@pytest.mark.parametrize("labels", [["k.jpg", "p.jpg", "x.jpg"], ["k", "p", "x"]])
def test_metashape_label_extension(tmp_path, monkeypatch, labels):
    options, _ = play(tmp_path, monkeypatch, labels).calls[0]
    assert options["cameras"] == [10] and options["downscale"] == 2


def test_metashape_disabled_not_partner(tmp_path, monkeypatch):
    chunk = play(tmp_path, monkeypatch, ["k.jpg", "p.jpg", "x.jpg"])
    assert chunk.calls[0][1] == ["k.jpg", "p.jpg"], "partners stay enabled while the maps are made"
    assert all(camera.enabled for camera in chunk.cameras) and chunk.calls[1] == "cloud"


@pytest.mark.parametrize("labels", [["k.jpg", "k.jpg", "p.jpg"], ["p.jpg"]])
def test_metashape_duplicate_labels(tmp_path, monkeypatch, labels):
    with pytest.raises(SystemExit) as end:
        play(tmp_path, monkeypatch, labels)
    assert "a/k.jpg" in str(end.value)
