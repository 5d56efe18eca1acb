"""The whole loop on the fixture: plan, match with integrations/sgm, evaluate; real fulfilment once more by tests/oracle/real.py."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
SGM = ROOT / "integrations/sgm/sgm.py"


@pytest.fixture(scope="module")
def matched(tmp_path_factory, viewrank, fixtures):
    """A planned project, depth maps of its first 12 clusters, and reference maps with 8 partners."""
    folder = tmp_path_factory.mktemp("evaluate")
    project = folder / "valley"
    shutil.copytree(fixtures / "valley", project)
    (project / "viewrank.toml").write_text("image_scale = 0.5\n")
    viewrank("plan", project, "--backend", "sgm", "--quiet")
    match = [sys.executable, SGM, "match", project, "--cache", folder / "pairs", "--image-scale", "0.5"]
    clusters = (project / "viewrank/clusters.txt").read_text().splitlines()[:12]
    (folder / "clusters.txt").write_text("\n".join(clusters) + "\n")
    subprocess.run([*match, "--out", folder / "maps", "--clusters", folder / "clusters.txt"], check=True)
    subprocess.run([*match, "--out", folder / "reference", "--connected", "8"], check=True)
    return folder


def test_the_oracle_agrees_on_real_fulfilment(matched, viewrank):
    tables = matched / "tables"
    viewrank("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--reference", matched / "reference", "--dump-tables", tables, "--baselines")
    done = subprocess.run([sys.executable, ROOT / "tests/oracle/real.py", matched / "valley/sparse/0", tables, matched / "maps", matched / "reference"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    evaluation = json.loads((matched / "valley/viewrank/evaluation/evaluation.json").read_text())
    real = np.zeros(len(np.load(tables / "triangles.npy")))
    rows, values = np.load(tables / "real.npy"), np.load(tables / "real_value.npy")
    np.maximum.at(real, rows[:, 1], values)
    if evaluation["support"] == 1:
        assert real.mean() == pytest.approx(evaluation["real"], abs=1e-6)
    assert 0.3 < evaluation["quality"]["completeness"] <= 1
    assert len(evaluation["key_views"]) == min(12, len((matched / "clusters.txt").read_text().splitlines()))
    assert sum(evaluation["missing"].values()) < evaluation["triangles"]


def test_maps_of_other_clusters_are_told(matched, viewrank):
    lines = (matched / "clusters.txt").read_text().splitlines()
    other = matched / "other.txt"
    other.write_text("\n".join("\t".join(line.split("\t")[:3]) for line in lines) + "\n")
    done = viewrank("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--clusters", other, "--out", matched / "elsewhere")
    assert "made with other partners than planned" in done.stderr


def test_rules_are_written_for_the_matcher_and_compared(matched, viewrank):
    rules = matched / "rules"
    viewrank("evaluate", matched / "valley", "--write-baselines", rules, "-k", "2", "--quiet")
    names = sorted(path.parent.name for path in rules.glob("k2/*/clusters.txt"))
    assert names == ["bailer", "colmap", "goesele", "maxcon", "mindist", "mvsnet", "openmvs", "ours", "ours-nocp", "random", "shen"]
    for name in names:
        if name not in ("ours", "maxcon"):
            shutil.rmtree(rules / "k2" / name)
    for name in ("ours", "maxcon"):
        folder = rules / "k2" / name
        head = (folder / "clusters.txt").read_text().splitlines()[:3]
        (folder / "clusters.txt").write_text("\n".join(head) + "\n")
        subprocess.run([sys.executable, SGM, "match", matched / "valley", "--cache", matched / "pairs", "--image-scale", "0.5", "--out", folder, "--clusters", folder / "clusters.txt"], check=True)
    rows = json.loads(viewrank("evaluate", matched / "valley", "--compare", rules, "--reference", matched / "reference", "--format", "json", "--quiet").stdout)
    assert [row["name"] for row in rows] == ["k2/maxcon", "k2/ours"]
    assert all(row["pairs"] == 6 and 0 < row["real"] < 1 for row in rows)


def test_errors_have_hints(tmp_path, viewrank, fixtures):
    done = viewrank("evaluate", fixtures / "valley", "--depth-maps", tmp_path, expect=1)
    assert "hint: make the plan first: viewrank plan" in done.stderr
    viewrank("evaluate", fixtures / "valley", expect=2)
