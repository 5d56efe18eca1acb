"""integrations/metashape/depth_maps.py with a stub of Metashape."""

import json
import runpy
import shutil
import sys
import types
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "integrations/metashape/depth_maps.py"


class Chunk:
    def __init__(self, labels, document, label="one", first_key=10):
        self.label, self.document, self.labels = label, document, labels
        self.cameras = [types.SimpleNamespace(label=label, key=first_key + i, enabled=True) for i, label in enumerate(labels)]
        self.calls = []

    def copy(self):
        self.document.chunks.append(Chunk(self.labels, self.document, self.label, 20))
        return self.document.chunks[-1]

    def buildDepthMaps(self, **options):
        self.calls.append((options, [camera.label for camera in self.cameras if camera.enabled]))

    def buildPointCloud(self):
        if self.document.fails:
            raise RuntimeError("Not enough memory")
        self.calls.append("cloud")


class Document:
    def __init__(self, labels, fails):
        self.fails, self.saved = fails, []
        self.chunks = [Chunk(labels, self)]

    def open(self, path):
        pass

    def save(self):
        self.saved.append([(chunk.label, len(chunk.calls)) for chunk in self.chunks])


def play(tmp_path, monkeypatch, labels=("k.jpg", "p.jpg", "x.jpg"), fails=False, times=1):
    document = Document(labels, fails)
    monkeypatch.setitem(sys.modules, "Metashape", types.SimpleNamespace(Document=lambda: document, MildFiltering="mild"))
    shutil.copy(SCRIPT, tmp_path / "depth_maps.py")
    clusters = dict(keys=["a/k.jpg"], enabled=["a/k.jpg", "a/p.jpg"], max_neighbors=1, downscale=2.0)
    (tmp_path / "clusters.json").write_text(json.dumps(clusters))
    monkeypatch.setattr(sys, "argv", ["depth_maps.py", "project.psx"])
    for _ in range(times):
        try:
            runpy.run_path(str(tmp_path / "depth_maps.py"), run_name="__main__")
        except RuntimeError:
            assert fails
    return document


@pytest.mark.parametrize("labels", [["k.jpg", "p.jpg", "x.jpg"], ["k", "p", "x"]])
def test_metashape_label_extension(tmp_path, monkeypatch, labels):
    options, _ = play(tmp_path, monkeypatch, labels).chunks[1].calls[0]
    assert options["cameras"] == [20] and options["downscale"] == 2, "keys of the copy's cameras"


def test_metashape_disabled_not_partner(tmp_path, monkeypatch):
    chunk = play(tmp_path, monkeypatch).chunks[1]
    assert chunk.calls[0][1] == ["k.jpg", "p.jpg"], "partners stay enabled while the maps are made"
    assert chunk.calls[1] == "cloud"


def test_what_the_chunk_holds_already_stays(tmp_path, monkeypatch):
    document = play(tmp_path, monkeypatch, times=2)
    assert document.chunks[0].calls == [] and all(camera.enabled for camera in document.chunks[0].cameras)
    assert [chunk.label for chunk in document.chunks] == ["one", "one (viewrank)", "one (viewrank)"], "the copy is none to be worked on again"


def test_a_point_cloud_that_fails_loses_no_depth_maps(tmp_path, monkeypatch):
    assert play(tmp_path, monkeypatch, fails=True).saved == [[("one", 0), ("one (viewrank)", 1)]]
    assert play(tmp_path, monkeypatch).saved[-1] == [("one", 0), ("one (viewrank)", 2)]


@pytest.mark.parametrize("labels", [["k.jpg", "k.jpg", "p.jpg"], ["p.jpg"]])
def test_metashape_duplicate_labels(tmp_path, monkeypatch, labels):
    with pytest.raises(SystemExit) as end:
        play(tmp_path, monkeypatch, labels)
    assert "a/k.jpg" in str(end.value)
