"""Planning predicts which pairs integrations/sgm refuses, and which places it searches: compared with the matcher's own rule for every pair."""

import shutil
import sys

import numpy as np
import oracle
import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "integrations/sgm"))
pytest.importorskip("cv2")
import rectify  # noqa: E402
from workspace import Workspace  # noqa: E402

SCALE = 0.5


def refusal(workspace, key, partner):
    a, b = workspace.views[key], workspace.views[partner]
    shared = workspace.xyz[np.intersect1d(a.points, b.points, assume_unique=True)]
    if len(shared) < rectify.MIN_SHARED:
        return "few", shared
    try:
        rectify.rectify(a, b, shared, workspace.xyz[np.union1d(a.points, b.points)])
    except rectify.Refused as reason:
        return str(reason), shared
    return "", shared


@pytest.mark.parametrize("name", ["fixture", "statue", "room"])
def test_no_pair_is_planned_that_the_matcher_refuses_and_none_is_left_out_that_it_takes(name, viewrank, fixtures, data, tmp_path):
    source = fixtures / "valley" if name == "fixture" else data(name)
    for part in ("sparse", "images"):
        (tmp_path / part).symlink_to(source / part)
    (tmp_path / "viewrank.toml").write_text(f'image_scale = {SCALE}\n[partners]\ncandidates = 1000\nk = 2\n[confidence]\nsource = "geometric"\n')
    viewrank("plan", tmp_path, "--backend", "sgm", "--dump-tables", tmp_path / "tables")
    tables, workspace = oracle.Tables(tmp_path / "tables"), Workspace(source, SCALE)
    names = [view["name"] for view in tables.views]
    planned = refused = left_out = 0
    for key, own in enumerate(names):
        candidates = set(tables.candidates_of(key).tolist())
        for other, partner in enumerate(names):
            if other == key:
                continue
            why, shared = refusal(workspace, own, partner)
            if other in candidates:
                assert not why, f"{own} with {partner}: {why}"
                planned += 1
            elif why and "disparities" in why:
                refused += 1
            elif not why and len(shared) >= 8:
                angle, octaves = rectify.geometry(workspace.views[own], workspace.views[partner], shared)
                left_out += 3 < angle < 55 and abs(octaves) < 1.4
    assert planned > 50 and left_out == 0
    assert name == "fixture" or refused > 100, "statue has deep scenes"
    shutil.rmtree(tmp_path / "tables")


def test_a_place_is_expected_to_match_only_where_the_matcher_looks(viewrank, fixtures, tmp_path):
    for part in ("sparse", "images"):
        (tmp_path / part).symlink_to(fixtures / "valley" / part)
    # Wide pairs too: their parallax is what needs a deep search. OpenMVS has no rule of its own for what it searches.
    gate = "[partners.gate]\nmin_shared_points = 8\nmin_angle = 1\nmax_angle = 180\nmax_scale_octaves = 9\nepipole_inside = true\n"
    (tmp_path / "viewrank.toml").write_text(f"image_scale = {SCALE}\n[partners]\ncandidates = 27\n{gate}")
    viewrank("plan", tmp_path, "--backend", "openmvs", "--dump-tables", tmp_path / "everywhere")
    viewrank("plan", tmp_path, "--backend", "sgm", "--dump-tables", tmp_path / "tables")
    tables, everywhere = oracle.Tables(tmp_path / "tables"), oracle.Tables(tmp_path / "everywhere")
    workspace = Workspace(tmp_path, SCALE)
    names = [view["name"] for view in tables.views]
    beyond = within = 0
    for key, own in enumerate(names):
        for other in tables.candidates_of(key).tolist():
            a, b = workspace.views[own], workspace.views[names[other]]
            shared = workspace.xyz[np.intersect1d(a.points, b.points, assume_unique=True)]
            pair = rectify.rectify(a, b, shared, workspace.xyz[np.union1d(a.points, b.points)])
            pixels, depth = a.project(tables.centroids[tables.seen[key]])
            disparity = pair.parallax.disparity(*pixels.T, 1 / depth) - pair.canvas.low
            clear = (np.abs(disparity) > 1e-6) & (np.abs(disparity - pair.canvas.count) > 1e-6)
            searched = (disparity > 0) & (disparity < pair.canvas.count)
            agreement = tables.agreement_of(key, other)
            expected = np.where(searched, everywhere.agreement_of(key, other), 0)
            assert (agreement == expected)[clear].all(), f"{own}, {names[other]}: not what the matcher searches"
            both = np.isin(tables.seen[key], tables.seen[other])
            beyond += (both & ~searched).sum()
            within += (both & searched & (agreement > 0)).sum()
    assert beyond > 100 and within > beyond, (beyond, within)
