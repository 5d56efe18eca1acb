"""viewrank export --tiles: projects by area that a backend takes by themselves."""

import json
import shutil

import pytest

pytestmark = pytest.mark.usefixtures("without_pilot")

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def project(tmp_path_factory, viewrank, fixtures):
    folder = tmp_path_factory.mktemp("tiles") / "valley"
    shutil.copytree(fixtures / "valley", folder)
    viewrank("plan", folder, "--backend", "colmap", "--target", "99%", "--quiet")
    return folder


def clusters(project):
    lines = (project / "viewrank/clusters.txt").read_text().splitlines()
    return {line.split("\t")[0]: line.split("\t")[1:] for line in lines}


def problems(tile):
    lines = [line for line in (tile / "stereo/patch-match.cfg").read_text().splitlines() if not line.startswith("#")]
    return {key: partners.split(", ") for key, partners in zip(lines[::2], lines[1::2], strict=True)}


def test_each_cluster_is_in_one_tile_with_all_its_partners(project, viewrank):
    viewrank("export", project, "--backend", "colmap", "--tiles", "3")
    tiles = sorted((project / "viewrank/colmap-tiles").iterdir())
    assert len(tiles) == 3
    found = [problems(tile) for tile in tiles]
    wanted = clusters(project)
    assert sum(map(len, found)) == len(wanted)
    assert {key: set(partners) for tile in found for key, partners in tile.items()} == {key: set(partners) for key, partners in wanted.items()}
    order = list(wanted)
    for tile, own in zip(tiles, found, strict=True):
        assert sorted(own, key=order.index) == list(own), "best first within a tile"
        model = pycolmap.Reconstruction(str(tile / "sparse"))
        views = set(own) | {partner for partners in own.values() for partner in partners}
        assert {image.name for image in model.images.values()} == views
        assert all((tile / "images" / name).is_file() for name in views)


def test_an_export_with_fewer_tiles_leaves_no_old_ones(project, viewrank):
    viewrank("export", project, "--backend", "openmvs", "--tiles", "3")
    viewrank("export", project, "--backend", "openmvs", "--tiles", "1")
    tiles = list((project / "viewrank/openmvs-tiles").iterdir())
    assert len(tiles) == 1
    assert len(json.loads((tiles[0] / "run.json").read_text())["clusters"]) == len(clusters(project))


def test_elsewhere_and_dry(project, viewrank, tmp_path):
    done = viewrank("export", project, "--backend", "colmap", "--tiles", "2", "--out", tmp_path / "out", "--dry-run")
    assert "tile_01" in done.stdout and not (tmp_path / "out").exists()
    (report,) = json.loads(viewrank("export", project, "--backend", "colmap", "--tiles", "2", "--dry-run", "--format", "json").stdout)
    assert [tile["backend"] for tile in report["tiles"]] == ["colmap"] * 2
    assert sum(len(tile["clusters"]) for tile in report["tiles"]) == len(clusters(project))
    viewrank("export", project, "--backend", "colmap", "--tiles", "2", "--out", tmp_path / "out")
    assert (tmp_path / "out/tile_01/stereo/viewrank/run.sh").is_file()
