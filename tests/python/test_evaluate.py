"""The whole loop on the fixture: plan, match with integrations/sgm, evaluate; real fulfilment recomputed by tests/oracle/real.py."""

import json
import os
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

ROOT = Path(__file__).resolve().parents[2]
SGM = ROOT / "integrations/sgm/sgm.py"
SCALE = "0.3"


@pytest.fixture(scope="module")
def matched(tmp_path_factory, viewrank, fixtures):
    """A planned project, depth maps of its first 12 clusters, and reference maps with 8 partners."""
    folder = tmp_path_factory.mktemp("evaluate")
    project = folder / "valley"
    shutil.copytree(fixtures / "valley", project)
    (project / "viewrank.toml").write_text(f"image_scale = {SCALE}\n")
    viewrank("plan", project, "--backend", "sgm", "--quiet")
    match = [sys.executable, SGM, "match", project, "--cache", folder / "pairs", "--image-scale", SCALE]
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
        weight = np.load(tables / "weight.npy")
        assert real @ weight == pytest.approx(evaluation["real"], abs=1e-6)
        assert real @ weight == pytest.approx(evaluation["kept"]["real"], abs=1e-6)
    assert 0.3 < evaluation["quality"]["completeness"] <= 1
    assert len(evaluation["key_views"]) == min(12, len((matched / "clusters.txt").read_text().splitlines()))
    assert sum(evaluation["missing"].values()) < evaluation["triangles"]


def table(path):
    head, *rows = path.read_text().splitlines()
    rows = [row.split("\t") for row in rows]
    return head.split("\t"), [(int(cells), int(agreeing), int(maps, 16)) for cells, agreeing, maps in rows]


def test_orders_are_judged_by_the_cells_of_the_cloud(matched, viewrank):
    out = matched / "cells"
    evaluation = json.loads(viewrank("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--out", out, "--format", "json").stdout)
    made, maps = evaluation["cells"], [view["name"] for view in evaluation["key_views"]]
    names, rows = table(out / "cells.tsv")
    assert made["source"] == "maps" and names == maps and made["all"]["cells"] == sum(row[0] for row in rows)
    for first in range(len(maps) + 1):
        mask = (1 << first) - 1
        for column, kind in enumerate(("all", "agreeing")):
            share = sum(row[column] for row in rows if (row[2] & mask).bit_count() >= evaluation["support"]) / made[kind]["cells"]
            assert made[kind]["orders"][0]["curve"][first] == pytest.approx(share, abs=1e-9), "the maps of the table are in the plan's order"
    assert all(ours <= best + 1e-9 for ours, best in zip(made["all"]["orders"][0]["covered"], made["all"]["orders"][-1]["covered"]))
    # The kept table alone says the same.
    kept = json.loads(viewrank("evaluate", matched / "valley", "--cells", out / "cells.tsv", "--format", "json").stdout)
    assert kept["all"]["orders"] == made["all"]["orders"]
    # Terminal and page have one set of names for the orders.
    said = viewrank("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--out", out, "--baselines").stdout
    for text in (said, (out / "evaluation.html").read_text()):
        assert "without prediction" in text and "most sparse points" in text and not re.search(r"\b(nocp|maxpts|ours)\b", text)
    other = matched / "other.tsv"
    other.write_text("elsewhere.jpg\n1\t0\t1\n")
    assert "none of its maps" in viewrank("evaluate", matched / "valley", "--cells", other, expect=1).stderr


def test_a_fused_cloud_says_which_maps_made_its_points(matched, viewrank):
    """As COLMAP writes it: fused.ply.vis counts the images by ascending id."""
    model = pycolmap.Reconstruction(matched / "valley/sparse/0")
    keys = [line.split("\t")[0] for line in (matched / "clusters.txt").read_text().splitlines()]
    positions = {image_id: place for place, image_id in enumerate(sorted(model.images))}
    points = list(model.points3D.values())
    views = [sorted({element.image_id for element in point.track.elements}) for point in points]
    cloud = matched / "fused.ply"
    cloud.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n" + "".join("{} {} {}\n".format(*point.xyz) for point in points))
    lists = [struct.pack(f"<I{len(of)}I", len(of), *(positions[view] for view in of)) for of in views]
    Path(f"{cloud}.vis").write_bytes(struct.pack("<Q", len(points)) + b"".join(lists))
    out = matched / "fused"
    viewrank("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--cloud", cloud, "--out", out, "--quiet")
    made = json.loads((out / "evaluation.json").read_text())["cells"]
    assert made["source"] == {"cloud": str(cloud)}
    names, rows = table(out / "cells.tsv")
    assert names == keys and 0 < made["all"]["cells"] <= len(points)
    # A map that observes no point is in no row, and cells can only have maps that observe a point.
    seen = {model.images[view].name for of in views for view in of}
    used = {name for place, name in enumerate(names) if any(row[2] >> place & 1 for row in rows)}
    assert used == seen & set(keys)
    # By far most cells have one point: the table has as many cells seen by two of these maps as there are points that two of them observe.
    two = sum(len({model.images[view].name for view in of} & set(keys)) >= 2 for of in views)
    assert sum(row[0] for row in rows if row[2].bit_count() >= 2) == pytest.approx(two, rel=0.3)


def test_maps_of_other_clusters_are_told(matched, viewrank):
    lines = (matched / "clusters.txt").read_text().splitlines()
    other = matched / "other.txt"
    other.write_text("\n".join("\t".join(line.split("\t")[:3]) for line in lines) + "\n")
    done = viewrank("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--clusters", other, "--out", matched / "elsewhere")
    assert "made with other partners than planned" in done.stderr


def test_depth_maps_at_half_the_size_are_a_baseline(matched, viewrank):
    half = made(matched / "half/depth_maps/x").parent
    for path in (matched / "maps/depth_maps").glob("*.npy"):
        np.save(half / path.name, np.load(path)[::2, ::2])
    command = ("evaluate", matched / "valley", "--depth-maps", matched / "maps", "--out", matched / "against-half", "--half-size")
    done = viewrank(*command, half.parent)
    found = json.loads((matched / "against-half/evaluation.json").read_text())["half_size"]
    assert found["maps"] == len(list(half.glob("*.npy"))) and found["work"] == pytest.approx(0.25)
    assert 0 < found["share"] < 1 and 0 < found["same_as"] < found["maps"], "coarser maps of the same places are worth less"
    assert f"the first {found['same_as']} at full size give as much" in done.stdout
    refused = viewrank(*command, matched / "maps", expect=1)
    assert "not at half the size" in refused.stderr
    mixed = made(matched / "mixed/depth_maps/x").parent
    for i, path in enumerate(sorted(half.glob("*.npy"))):
        shutil.copy((half if i else matched / "maps/depth_maps") / path.name, mixed)
    refused = viewrank(*command, mixed.parent, expect=1)
    assert f"1 of the {found['maps']} depth maps" in refused.stderr


def test_maps_of_two_sizes_are_told_apart(matched, viewrank):
    """Of a backend that mixes them; a size that is neither does not count, as for run, and is named."""
    mixed = made(matched / "sizes/depth_maps/x").parent
    paths = sorted((matched / "maps/depth_maps").glob("*.npy"))
    for step, path in zip([2, 4] + [1] * len(paths), paths):
        np.save(mixed / path.name, np.load(path)[::step, ::step])
    out = matched / "two-sizes"
    done = viewrank("evaluate", matched / "valley", "--depth-maps", mixed.parent, "--out", out)
    found = json.loads((out / "evaluation.json").read_text())
    name = {view["name"].rsplit("/")[-1]: view["scale"] for view in found["key_views"]}
    assert sorted(name.values()) == [0.5] + [1] * (len(paths) - 2)
    assert f"{len(paths) - 1} depth maps, 1 of them at half the size" in done.stdout and "1 at half the size" in (out / "evaluation.html").read_text()
    assert len(found["other_sizes"]) == 1 and f"left out: 1 depth map of neither the size that image_scale = {SCALE} gives nor half of it, the first of {found['other_sizes'][0]}" in done.stderr
    only = made(matched / "other-size/depth_maps/x").parent
    shutil.copy(mixed / paths[1].name, only)
    refused = viewrank("evaluate", matched / "valley", "--depth-maps", only.parent, expect=1)
    assert f"has the size that image_scale = {SCALE} gives" in refused.stderr and "viewrank.toml" in refused.stderr


def write_npy(folder, number, name, ids, depth):
    np.save(made(folder / f"{name}.npy"), depth)


def write_colmap(folder, number, name, ids, depth):
    height, width = depth.shape
    made(folder / f"stereo/depth_maps/{name}.geometric.bin").write_bytes(f"{width}&{height}&1&".encode() + depth.tobytes())


def write_pfm(folder, number, name, ids, depth):
    height, width = depth.shape
    made(folder / f"{number:08}.pfm").write_bytes(f"Pf\n{width} {height}\n-1.0\n".encode() + depth[::-1].tobytes())


def write_dmb(folder, number, name, ids, depth):
    made(folder / f"2333_{number:08}/depths.dmb").write_bytes(struct.pack("<4i", 1, *depth.shape, 1) + depth.tobytes())


def write_dmap(folder, number, name, ids, depth):
    height, width = depth.shape
    image = f"images/{name}".encode()
    header = struct.pack("<2sBB4I2f", b"DR", 1, 0, 2 * width, 2 * height, width, height, 1, 100)
    names = struct.pack("<H", len(image)) + image + struct.pack(f"<{1 + len(ids)}I", len(ids), *ids)
    made(folder / f"depth{number:04}.dmap").write_bytes(header + names + bytes(21 * 8) + depth.tobytes())


def made(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def test_every_format_of_depth_maps_gives_the_same_evaluation(matched, viewrank):
    images = {image.name: image.image_id for image in pycolmap.Reconstruction(str(matched / "valley/sparse/0")).images.values()}
    clusters = [line.split("\t") for line in (matched / "clusters.txt").read_text().splitlines()][:4]
    (matched / "four.txt").write_text("".join("\t".join(cluster) + "\n" for cluster in clusters))
    results = {}
    for write in (write_npy, write_colmap, write_pfm, write_dmb, write_dmap):
        folder = matched / write.__name__
        for number, cluster in enumerate(clusters):
            depth = np.load(matched / f"maps/depth_maps/{cluster[0]}.npy")
            write(folder, number, cluster[0], [images[name] for name in cluster], depth)
        (folder / "view_names.txt").write_text("".join(f"{number}\t{cluster[0]}\n" for number, cluster in enumerate(clusters)))
        done = viewrank("evaluate", matched / "valley", "--depth-maps", folder, "--clusters", matched / "four.txt", "--reference", matched / "reference", "--out", folder / "out", "--format", "json", "--quiet")
        results[write.__name__] = json.loads(done.stdout)
        assert {"evaluation.html", "evaluation.json", "evaluation.ply"} <= {path.name for path in (folder / "out").iterdir()}
    expected = results.pop("write_npy")
    assert expected["quality"]["completeness"] > 0.3 and len(expected["key_views"]) == 4
    for name, result in results.items():
        for view, known in zip(result["key_views"], expected["key_views"], strict=True):
            assert view["quality"] == known["quality"], name
            assert set(view["matched"]) == set(known["matched"]), name
            # The ids of a .dmap give the partners in another order, in which the sums round otherwise.
            assert view["real"] == pytest.approx(known["real"], rel=1e-6), name
        assert result["missing"] == expected["missing"], name


def test_rules_are_written_for_the_matcher_and_compared(matched, viewrank):
    rules = matched / "rules"
    bench = Path(os.environ["VIEWRANK"]).with_name("viewrank-bench")
    subprocess.run([bench, "partners", matched / "valley", rules, "-k", "2"], check=True)
    names = sorted(path.parent.name for path in rules.glob("k2/*/clusters.txt"))
    assert names == ["colmap", "goesele", "maxcon", "mindist", "mvsnet", "openmvs", "ours", "ours-nocp", "random", "shen"]
    for name in names:
        if name not in ("ours", "maxcon"):
            shutil.rmtree(rules / "k2" / name)
    for name in ("ours", "maxcon"):
        folder = rules / "k2" / name
        head = (folder / "clusters.txt").read_text().splitlines()[:3]
        (folder / "clusters.txt").write_text("\n".join(head) + "\n")
        subprocess.run([sys.executable, SGM, "match", matched / "valley", "--cache", matched / "pairs", "--image-scale", SCALE, "--out", folder, "--clusters", folder / "clusters.txt"], check=True)
    compared = subprocess.run([bench, "compare", matched / "valley", rules, "--reference", matched / "reference", "--json"], check=True, stdout=subprocess.PIPE)
    rows = json.loads(compared.stdout)
    assert [row["name"] for row in rows] == ["k2/maxcon", "k2/ours"]
    assert all(row["pairs"] == 6 and 0 < row["real"] < 1 for row in rows)


def test_errors_have_hints(tmp_path, viewrank, fixtures):
    done = viewrank("evaluate", fixtures / "valley", "--depth-maps", tmp_path, expect=1)
    assert "hint: make the plan first: viewrank plan" in done.stderr
    viewrank("evaluate", fixtures / "valley", expect=1)
