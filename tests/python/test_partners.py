"""benches/partners.py: what counts as shown, complete and accurate."""

import sys
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from conftest import ROOT

sys.path[:0] = [str(ROOT / "benches")]

import partners  # noqa: E402

MATRIX = np.array([[50.0, 0, 40], [0, 50, 30], [0, 0, 1]])


def view(x, depth=4.0):
    """A camera above the plane z = 4, looking at it."""
    return partners.TrueView(np.full((60, 80), depth, np.float32), MATRIX, pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([-x, 0.0, 0])))


def bench():
    return SimpleNamespace(wanted_gsd=lambda points: np.full(len(points), 0.1))


def test_a_view_shows_its_own_points_and_none_behind_them():
    points = view(1).points()
    assert points[:, 2] == pytest.approx(4) and points[:, 0].mean() == pytest.approx(1, abs=0.1)
    assert view(1).shows(points).all()
    assert not view(1).shows(points * [1, 1, 1.5]).any() and not view(1).shows(-points).any()
    # A view beside it shows a part.
    assert 0 < view(3).shows(points).sum() < len(points)


def test_exact_depth_judges_what_two_photographs_show(monkeypatch, tmp_path):
    views = [view(0), view(3)]
    monkeypatch.setattr(partners, "true_views", lambda *_: iter(views))
    model = SimpleNamespace(images={})
    exact = partners.Exact(tmp_path, SimpleNamespace(model=model, **vars(bench())))
    both = views[0].points()[views[1].shows(views[0].points())]
    assert (exact.cells[:, 0] >= both[:, 0].min() - 0.3).all() and (exact.cells[:, 0] <= both[:, 0].max() + 0.3).all()
    assert exact.of(both) == {"complete": 1, "accurate": 1, "F1": 1}
    off = exact.of(np.concatenate([both, both + [0, 0, 1]]))
    assert off["complete"] == 1 and off["accurate"] == pytest.approx(0.5) and off["F1"] == pytest.approx(2 / 3)


def test_the_union_of_clouds_and_what_most_of_them_have():
    x, y = np.meshgrid(np.arange(0, 10, 0.05), np.arange(0, 10, 0.05))
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    half, most = plane[plane[:, 0] < 5], plane[plane[:, 0] < 8]
    union = partners.Union([half, most, most, plane], bench())
    assert union.of(plane) == {"complete": 1, "agreed": 1}
    assert union.of(most)["agreed"] == 1 and union.of(most)["complete"] == pytest.approx(0.8, abs=0.05)
    assert union.of(half)["agreed"] == pytest.approx(5 / 8, abs=0.05)


def test_maps_are_counted_by_the_time_that_they_take():
    run = SimpleNamespace(clusters=list(range(40)), seconds=80)
    assert partners.Run.fitting(run, 20) == 10 and partners.Run.fitting(run, 1000) == 40 and partners.Run.fitting(run, 0.1) == 2
