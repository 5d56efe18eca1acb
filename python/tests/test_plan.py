"""Plans of a project."""

import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

import viewrank


def program(*arguments):
    """Runs the program that was installed with the package."""
    command = [str(Path(sys.executable).parent / "viewrank"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_clusters_are_those_that_the_program_writes(valley, plan):
    folder = plan.write()
    by_module = (folder / "manifest.json").read_bytes()
    written = json.loads(by_module)
    assert [(c.key, c.partners, c.gain, c.share) for c in plan.ranking] == [
        (c["key"], c["partners"], c["gain"], c["share"]) for c in written["clusters"]
    ]
    assert written["cut"]["clusters"] == len(plan.clusters)
    done = program("plan", valley, "--backend", "openmvs", "-k", "5", "--target", "90%", "--confidence", "geometric", "-q")
    assert done.returncode == 0, done.stderr
    assert (folder / "manifest.json").read_bytes() == by_module


def test_clusters_have_partners_gains_and_shares(plan):
    assert 0 < len(plan.clusters) < len(plan.ranking) <= len(plan.names)
    for cluster in plan.clusters:
        assert cluster.key in plan.names and cluster.key not in cluster.partners
        assert set(cluster.partners) < set(plan.names) and 0 < len(cluster.partners) <= 5
        assert cluster.gain > 0 and cluster.scale == 1.0
    shares = [cluster.share for cluster in plan.ranking]
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0)
    assert plan.clusters[-1].share >= 0.9 > plan.clusters[-2].share
    assert repr(plan.clusters[0]).startswith("Cluster(key=")


def test_the_curve_sums_pairs_and_cost(valley, plan):
    curve = plan.curve
    assert curve["clusters"].tolist() == list(range(1, len(plan.ranking) + 1))
    assert curve["pairs"].tolist() == np.cumsum([len(cluster.partners) for cluster in plan.ranking]).tolist()
    assert np.allclose(curve["share"], [cluster.share for cluster in plan.ranking])
    assert np.all(np.diff(curve["points"]) > 0) and np.all(np.isnan(curve["seconds"]))
    settings = {"forecast.seconds_per_pair": 2.0, "forecast.seconds_per_map": 1.0}
    timed = viewrank.plan(valley, k=3, confidence="geometric", settings=settings).curve
    assert np.allclose(timed["seconds"], 2.0 * timed["pairs"] + timed["clusters"])


def test_tables_are_consistent_and_cannot_be_changed(plan):
    surface, visibility, fulfilment = plan.surface, plan.visibility, plan.fulfilment
    triangles = len(surface.triangles)
    assert surface.vertices.shape[1] == surface.triangles.shape[1] == 3
    assert surface.triangles.max() < len(surface.vertices)
    assert surface.fulfilment.shape == surface.reachable.shape == surface.chosen_views.shape == (triangles,)
    assert np.all(surface.fulfilment <= surface.reachable)
    assert len(visibility.offsets) == len(plan.names) + 1 and visibility.offsets[-1] == len(visibility.triangles)
    assert visibility.triangles.max() < triangles and np.all(np.diff(visibility.seen_by(0).astype(int)) > 0)
    assert len(fulfilment.offsets) == len(fulfilment.keys) + 1
    assert fulfilment.values.min() > 0 and fulfilment.values.max() <= 1
    # A cluster fulfils only what its key view sees.
    for row, key in enumerate(fulfilment.keys):
        rows = slice(int(fulfilment.offsets[row]), int(fulfilment.offsets[row + 1]))
        assert np.all(np.isin(fulfilment.triangles[rows], visibility.seen_by(int(key))))
    for array in (surface.vertices, surface.fulfilment, visibility.triangles, fulfilment.values, plan.curve):
        with pytest.raises(ValueError):
            array[0] = array[0]


def test_a_table_outlives_its_plan(valley):
    plan = viewrank.plan(valley, confidence="geometric")
    vertices, total = plan.surface.vertices, plan.surface.vertices.sum()
    del plan
    assert vertices.base is not None and vertices.sum() == total


def test_the_same_plan_on_one_thread(valley, plan):
    one = viewrank.plan(valley, backend="openmvs", k=5, target=0.9, confidence="geometric", threads=1)
    assert one.ranking == plan.ranking


def test_a_budget_is_a_number_or_a_share(valley):
    by_number = viewrank.plan(valley, confidence="geometric", budget=7)
    by_share = viewrank.plan(valley, confidence="geometric", budget=0.25)
    assert len(by_number.clusters) == len(by_share.clusters) == 7


def test_targets_are_shares_or_percentages(valley):
    chosen = [len(viewrank.plan(valley, confidence="geometric", target=target).clusters) for target in (0.8, 80, 80.0, "80%", "0.8")]
    assert len(set(chosen)) == 1
    whole = viewrank.plan(valley, confidence="geometric", target=1)
    assert whole.clusters == whole.ranking
    with pytest.raises(viewrank.SettingsError, match="\"180\""):
        viewrank.plan(valley, target=180)


def test_a_notebook_shows_curve_and_map(plan):
    html = plan._repr_html_()
    curve, picture, _ = ElementTree.fromstring(html)
    assert f"cut at {len(plan.clusters)}" in "".join(curve.itertext())
    discs = [mark for mark in picture.iter() if mark.tag.endswith("circle")]
    assert len(discs) == len(plan.names)
    titles = "".join(picture.itertext())
    assert f"1: {plan.clusters[0].key}" in titles


def test_load_returns_the_written_plan(valley, plan):
    plan.write()
    loaded = viewrank.load(valley)
    assert loaded.ranking == plan.ranking and loaded.backend == "openmvs" and loaded.cut == plan.cut


def test_an_export_names_the_folder_that_its_commands_run_in(valley, plan):
    export = plan.export("openmvs")
    assert export.folder == valley / "viewrank" / "openmvs"
    assert (export.folder / export.commands[0].split()[-1]).is_file()


def test_export_writes_the_files_of_a_backend(plan, tmp_path):
    export = plan.export("sgm", tmp_path / "sgm", budget=2)
    assert export.backend == "sgm" and (export.folder / "export.json").is_file()
    assert len(export.record["clusters"]) == 2
    with pytest.raises(viewrank.SettingsError) as raised:
        plan.export("opnmvs")
    assert "did you mean openmvs?" in raised.value.hint


def test_report_is_a_page(plan, tmp_path):
    page = plan.report(tmp_path / "report.html")
    assert page.read_text(encoding="utf-8").lstrip().lower().startswith("<!doctype html>")


def test_the_report_of_a_plan_elsewhere_is_beside_the_plan(valley, tmp_path):
    done = program("plan", valley, "--out", tmp_path, "--backend", "openmvs", "--confidence", "geometric", "--quiet")
    assert done.returncode == 0, done.stderr
    report = valley / "viewrank/report.html"
    before = report.read_bytes() if report.exists() else None
    assert viewrank.load(tmp_path).report() == tmp_path / "viewrank/report.html"
    assert (report.read_bytes() if report.exists() else None) == before


def test_doctor_finds_what_the_program_finds(valley):
    done = program("doctor", valley, "--backend", "colmap", "--format", "json")
    printed = json.loads(done.stdout)["findings"]
    found = viewrank.doctor(valley, "colmap")
    assert [(finding.check, finding.severity, finding.what) for finding in found] == [
        (finding["check"], finding["severity"], finding["what"]) for finding in printed
    ]


def test_evaluate_measures_depth_maps(plan, scene, tmp_path):
    camera = scene.cameras[0]
    for folder, depth in (("maps", 1.0), ("half_as_far", 0.5)):
        (tmp_path / folder).mkdir()
        depths = np.full((camera.height, camera.width), depth, dtype=np.float32)
        np.save(tmp_path / folder / f"{plan.clusters[0].key}.npy", depths)
    evaluation = viewrank.evaluate(plan, tmp_path / "maps")
    assert evaluation.depth_maps == 1 and len(evaluation.without_map) == len(plan.fulfilment.keys) - 1
    assert evaluation.completeness == 1.0 and evaluation.predicted > 0 and len(evaluation.curve["real"]) == 2
    wrong = viewrank.evaluate(plan, tmp_path / "maps", tmp_path / "half_as_far")
    assert wrong.completeness == 0.0 == wrong.real and wrong.predicted == evaluation.predicted


def test_the_program_reports_its_version_and_exit_codes(tmp_path):
    assert program("--version").stdout == f"viewrank {viewrank.__version__}\n"
    missing = program("plan", tmp_path / "missing")
    assert missing.returncode == 1 and "hint: " in missing.stderr
    assert program("plan").returncode == 2
