"""The triangulation against scipy's (Qhull) and CGAL's: the same sets of cells on the same points."""
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def ours(example):
    return example("delaunay")


@pytest.fixture(scope="module")
def cgal(tmp_path_factory):
    if not shutil.which("g++") or not Path("/usr/include/CGAL").is_dir():
        pytest.skip("CGAL is not installed (Debian: libcgal-dev)")
    program = tmp_path_factory.mktemp("cgal") / "cgal_delaunay"
    subprocess.run(["g++", "-O1", "-o", program, ROOT / "benches/cgal_delaunay.cpp", "-lgmp", "-lmpfr"], check=True)
    return program


def cells_of(program, points, folder):
    """Returns the set of cells, each given by four positions: coinciding points are one vertex."""
    points.astype("<f8").tofile(folder / "points")
    subprocess.run([program, folder / "points", folder / "cells"], check=True, stdout=subprocess.PIPE)
    return as_set(points, np.fromfile(folder / "cells", "<u4").reshape(-1, 4))


def as_set(points, cells):
    _, place = np.unique(points, axis=0, return_inverse=True)
    found = set(map(tuple, np.sort(place.reshape(-1)[cells], axis=1).tolist()))
    assert len(found) == len(cells)
    return found


def volume(points, cells):
    a, b, c, d = (points[cells[:, i]] for i in range(4))
    return np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)).sum() / 6


def whole(rng, count, low, high):
    return rng.integers(low, high, (count, 3)).astype(float)


def sphere(squared_radius):
    side = np.arange(-int(squared_radius**0.5), int(squared_radius**0.5) + 1)
    points = np.stack(np.meshgrid(side, side, side), -1).reshape(-1, 3)
    return points[(points**2).sum(1) == squared_radius].astype(float)


def terrain(rng, count):
    x, y = rng.integers(0, 1 << 20, (2, count))
    return np.column_stack([x, y, np.round(30000 * np.sin(x / 1e5) * np.cos(y / 1.3e5) + rng.normal(0, 200, count))])


@pytest.mark.parametrize("seed", range(3))
def test_cells_are_those_of_qhull(ours, tmp_path, seed):
    rng = np.random.default_rng(seed)
    for points in (whole(rng, 5000, 0, 1 << 20), terrain(rng, 5000)):
        reference = Delaunay(points).simplices
        assert cells_of(ours, points, tmp_path) == as_set(points, reference)


def test_degenerate_sets_are_filled_as_by_qhull(ours, tmp_path):
    rng = np.random.default_rng(0)
    for points in (whole(rng, 3000, 0, 12), sphere(1241), np.vstack([sphere(81), sphere(9)])):
        cells_of(ours, points, tmp_path)
        cells = np.fromfile(tmp_path / "cells", "<u4").reshape(-1, 4)
        assert volume(points, cells) == pytest.approx(ConvexHull(points).volume, rel=1e-12)


DEGENERATE = {
    "random": lambda rng: whole(rng, 20000, 0, 1 << 23),
    "terrain": lambda rng: terrain(rng, 20000),
    "few values": lambda rng: whole(rng, 5000, 0, 15),
    "lattice": lambda rng: rng.permutation(np.stack(np.meshgrid(*[np.arange(20.0)] * 3), -1).reshape(-1, 3)),
    "flat lattice": lambda rng: rng.permutation(np.stack(np.meshgrid(np.arange(90.0), np.arange(70.0), np.arange(2.0)), -1).reshape(-1, 3)),
    "sphere": lambda rng: rng.permutation(sphere(9801)),
    "spheres": lambda rng: rng.permutation(np.vstack([sphere(9801), sphere(1241), np.zeros((1, 3))])),
    "duplicates": lambda rng: whole(rng, 1000, 0, 1 << 20)[rng.integers(0, 1000, 10000)],
    "plane and a point": lambda rng: np.vstack([whole(rng, 3000, 0, 64) * [1, 1, 0], [[7, 9, 31]]]),
    "tilted plane": lambda rng: whole(rng, 3000, 0, 64) @ np.array([[4, 0, 1], [0, 4, 3], [0, 0, 0]]) + [[0, 0, 5]] * (rng.random((3000, 1)) < 0.1),
    "skew lines": lambda rng: np.vstack([np.outer(np.arange(60), [1, 0, 0]), np.outer(np.arange(60), [0, 1, 0]) + [0, 0, 900]]).astype(float),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_cells_are_those_of_cgal(ours, cgal, tmp_path, name):
    """Also for ties: CGAL perturbs by the same ranks."""
    points = DEGENERATE[name](np.random.default_rng(1))
    assert cells_of(ours, points, tmp_path) == cells_of(cgal, points, tmp_path)
