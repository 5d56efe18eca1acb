"""Run with: python -m pytest integrations/sgm

The scene is rendered here: textured planes seen by pinhole cameras, so that every depth is known in closed form.
"""

import json
import py_compile
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import fuse
import rectify
import sgm
from merge import merge
from pairs import Pairs, write_whole
from workspace import InputError, View, Workspace

FIXTURE = Path(__file__).parents[2] / "fixtures" / "valley"
WIDTH, HEIGHT, FOCAL = 320, 240, 280.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])  # COLMAP's pixel convention
PLANE = np.array([0.15, -0.1, 1.0]), 10.0  # n . X = c

# name: (centre, rotation vector)
CAMERAS = {
    "key.png": ((0, 0, 0), (0, 0, 0)),
    "sub folder/left.png": ((-1.5, 0.2, 0), (0, 0.05, 0.3)),
    "sub folder/right ü.png": ((1.4, -0.3, 0.1), (0.03, -0.1, -0.2)),
    "forward.png": ((0.3, 0.2, 3.0), (0, 0, 0.1)),
}


def pose(name):
    centre, turn = CAMERAS[name]
    R = cv2.Rodrigues(np.array(turn, float))[0]
    return R, -R @ np.array(centre, float)


def plane_depth(name):
    """z-depth of the plane at every pixel centre."""
    R, t = pose(name)
    normal, c = R @ PLANE[0], PLANE[1] + (R @ PLANE[0]) @ t
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones_like(u)], -1)
    return c / (rays @ normal)


def texture(size=1500):
    rng = np.random.default_rng(0)
    image = sum(cv2.resize(rng.uniform(-1, 1, (size // s, size // s)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC) for s in (3, 6, 15, 50))
    return np.clip(128 + 45 * image, 0, 255).astype(np.uint8)


def render(name, image):
    """The plane's texture, laid along x and y of the world at 100 px per unit."""
    R, t = pose(name)
    normal, c = PLANE
    # (x, y) of the plane -> world: X = (x, y, (c - n_x x - n_y y) / n_z)
    to_world = np.array([[1, 0, 0], [0, 1, 0], [-normal[0] / normal[2], -normal[1] / normal[2], c / normal[2]]])
    metres = np.array([[0.01, 0, -7.5], [0, 0.01, -7.5], [0, 0, 1]])
    corner = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV's pixels
    H = corner @ K @ (R @ to_world + np.outer(t, [0, 0, 1])) @ metres
    return cv2.warpPerspective(image, H, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)


def write_workspace(folder, text=False):
    (folder / "sparse").mkdir(parents=True)
    image = texture()
    for name in CAMERAS:
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imencode(".png", render(name, image))[1].tofile(path)
    normal, c = PLANE
    xy = np.random.default_rng(1).uniform(-4, 4, (300, 2))
    xyz = np.c_[xy, (c - xy @ normal[:2]) / normal[2]]
    tracks = {name: observed(name, xyz) for name in CAMERAS}
    (write_text if text else write_binary)(folder / "sparse", xyz, tracks)
    return folder


def observed(name, xyz):
    """[(x, y, point id)] of the points in the image."""
    R, t = pose(name)
    p = (xyz @ R.T + t) @ K.T
    q = p[:, :2] / p[:, 2:]
    ok = (p[:, 2] > 0) & (q > 0).all(1) & (q < (WIDTH, HEIGHT)).all(1)
    return [(*q[i], i + 7) for i in np.flatnonzero(ok)]


def quaternion(R):
    w = np.sqrt(1 + np.trace(R)) / 2
    return w, (R[2, 1] - R[1, 2]) / (4 * w), (R[0, 2] - R[2, 0]) / (4 * w), (R[1, 0] - R[0, 1]) / (4 * w)


def write_binary(folder, xyz, tracks):
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 3, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    images = struct.pack("<Q", len(tracks))
    for number, (name, points) in enumerate(tracks.items()):
        R, t = pose(name)
        images += struct.pack("<I7dI", 11 + number, *quaternion(R), *t, 3) + name.encode() + b"\0" + struct.pack("<Q", len(points))
        images += b"".join(struct.pack("<ddq", *p) for p in points)
    (folder / "images.bin").write_bytes(images)
    points = b"".join(struct.pack("<Q3d3Bd", i + 7, *p, 0, 0, 0, 0.5) + struct.pack("<Q", 1) + struct.pack("<II", 11, 0) for i, p in enumerate(xyz))
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(xyz)) + points)


def write_text(folder, xyz, tracks):
    (folder / "cameras.txt").write_text(f"# comment\n3 SIMPLE_PINHOLE {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    lines = ["# comment"]
    for number, (name, points) in enumerate(tracks.items()):
        R, t = pose(name)
        lines += [" ".join(map(str, (11 + number, *quaternion(R), *t, 3, name))), " ".join(f"{x} {y} {i}" for x, y, i in points)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "points3D.txt").write_text("".join(f"{i + 7} {x} {y} {z} 0 0 0 0.5 11 0\n" for i, (x, y, z) in enumerate(xyz)))


@pytest.fixture(scope="session")
def planes(tmp_path_factory):
    return write_workspace(tmp_path_factory.mktemp("planes") / "w")


def write_clusters(path, *rows):
    path.write_text("# comment\n" + "".join("\t".join(row) + "\n" for row in rows), encoding="utf-8")
    return path


SIDES = ("sub folder/left.png", "sub folder/right ü.png")


def run(workspace, out, clusters, *more):
    sgm.main(["match", str(workspace), "--out", str(out), "--clusters", str(clusters), *more])
    return json.loads((out / "report.json").read_text())


def test_parallax_is_the_inverse_of_projection():
    """The disparity of a point is the one at which both canvases show it, wherever the epipole is."""
    rng = np.random.default_rng(2)
    for centre in ((2, 0.3, 0.1), (0.2, -0.1, 2.5), (-1, 1, -1.5), (1.5, 0, 0)):
        R = cv2.Rodrigues(rng.normal(0, 0.05, 3))[0]
        a = View("a", K, np.eye(3), np.zeros(3), (WIDTH, HEIGHT), (WIDTH, HEIGHT), None)
        b = View("b", K, R, -R @ np.array(centre), (WIDTH, HEIGHT), (WIDTH, HEIGHT), None)
        xyz = np.c_[rng.uniform(-3, 3, (200, 2)), rng.uniform(9, 11, 200)]
        pair = rectify.rectify(a, b, xyz, xyz)
        pixels, depth = a.project(xyz)
        there, _ = b.project(xyz)
        d = pair.parallax.disparity(*pixels.T, 1 / depth)
        np.testing.assert_allclose(pair.parallax.inverse_depth(*pixels.T, d), 1 / depth, rtol=1e-9)
        offset = pixels - pair.parallax.epipole
        radius = np.hypot(*offset.T)
        moved = np.c_[pair.parallax.epipole + offset * ((radius - d) / radius)[:, None], np.ones(200)] @ pair.homography.T
        np.testing.assert_allclose(moved[:, :2] / moved[:, 2:], there, atol=1e-2)


def test_a_pair_measures_a_slanted_plane(planes):
    workspace = Workspace(planes)
    exact = plane_depth("key.png")
    for partner in SIDES:
        pair = Pairs(workspace).get("key.png", partner)
        assert not pair.refused
        assert pair.share > 0.6
        with np.errstate(invalid="ignore"):
            error = np.abs(pair.inverse() - 1 / exact) / pair.deviation()
        error = error[np.isfinite(error)]
        assert np.median(error) < 0.15 and np.mean(error < 1) > 0.99


def test_pairs_fills_the_cache_alone(planes, tmp_path):
    clusters, cache = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES)), tmp_path / "pairs"
    sgm.main(["pairs", str(planes), "--cache", str(cache), "--clusters", str(clusters)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clusters.txt", "pairs"]
    report = run(planes, tmp_path / "out", clusters, "--cache", str(cache))
    assert all(pair["cached"] for pair in report["clusters"][0]["partners"])


def test_motion_along_the_viewing_direction_is_matched(planes):
    pair = Pairs(Workspace(planes)).get("key.png", "forward.png")
    assert not pair.refused
    with np.errstate(invalid="ignore"):
        error = np.abs(pair.inverse() - 1 / plane_depth("key.png")) / pair.deviation()
    assert pair.share > 0.3 and np.mean(error[np.isfinite(error)] < 1) > 0.95


def test_same_place_and_unconnected_views_are_refused(planes):
    workspace = Workspace(planes)
    twin = workspace.views["key.png"]
    workspace.views["twin.png"] = View("twin.png", twin.K, twin.R, twin.t, twin.size, twin.full_size, twin.points)
    workspace.views["stranger.png"] = View("stranger.png", twin.K, twin.R, twin.t + 1, twin.size, twin.full_size, twin.points[:3])
    assert "same place" in Pairs(workspace).get("key.png", "twin.png").refused
    assert "shared sparse points" in Pairs(workspace).get("key.png", "stranger.png").refused


def test_merge_takes_what_two_agree_on():
    shape = (40, 40)
    good, other, wrong = (np.full(shape, w, np.float32) for w in (0.1, 0.1002, 0.2))
    sigma = np.full(shape, 0.001, np.float32)
    depth, count = merge([wrong, good, other], [sigma] * 3)
    np.testing.assert_allclose(depth, 1 / 0.1001, rtol=1e-5)
    assert (count == 2).all()
    depth, count = merge([wrong, good], [sigma] * 2)
    assert not depth.any() and not count.any()


def test_maps_and_report(planes, tmp_path):
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png"))
    report = run(planes, tmp_path / "out", clusters, "--image-scale", "0.75")
    depth, count = (np.load(tmp_path / "out" / folder / "key.png.npy") for folder in ("depth_maps", "counts"))
    assert depth.shape == count.shape == (180, 240) and depth.dtype == np.float32 and count.dtype == np.uint8
    exact = cv2.resize(plane_depth("key.png"), (240, 180), interpolation=cv2.INTER_LINEAR)
    assert (depth > 0).mean() > 0.5
    assert np.median(np.abs(depth / exact - 1)[depth > 0]) < 0.005
    assert (count[depth > 0] == 2).all() and not count[depth == 0].any()
    first, second = report["clusters"]
    assert first["key"] == "key.png" and [p["matched"] for p in first["partners"]] == [True, True]
    assert second["measured"] == 0, "one partner is not enough for two to agree"
    assert (tmp_path / "out/depth_maps" / (SIDES[0] + ".npy")).is_file()
    assert not list((tmp_path / "out").rglob("*.part"))


def test_text_model_gives_the_same_workspace(planes, tmp_path):
    binary, text = Workspace(planes), Workspace(write_workspace(tmp_path / "t", text=True))
    assert list(binary.views) == list(text.views) and np.allclose(binary.xyz, text.xyz)
    for name, view in binary.views.items():
        other = text.views[name]
        assert np.allclose(view.K, other.K) and np.allclose(view.R, other.R) and np.allclose(view.t, other.t)
        assert np.array_equal(view.points, other.points)


def test_finished_maps_are_kept_and_changed_ones_made_anew(planes, tmp_path):
    out, cache = tmp_path / "out", tmp_path / "cache"
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png", SIDES[1]))
    first = run(planes, out, clusters, "--cache", str(cache))
    kept, changed = (out / "depth_maps" / (name + ".npy") for name in ("key.png", SIDES[0]))
    before = kept.stat().st_mtime_ns, changed.stat().st_mtime_ns
    write_clusters(clusters, ("key.png", *SIDES), (SIDES[0], SIDES[1], "key.png"))
    second = run(planes, out, clusters, "--cache", str(cache))
    assert kept.stat().st_mtime_ns == before[0] and changed.stat().st_mtime_ns > before[1]
    assert not any(p["cached"] for row in first["clusters"] for p in row["partners"])
    assert all(p["cached"] for row in second["clusters"] if row["key"] == SIDES[0] for p in row["partners"])


def test_maps_of_views_that_moved_are_made_anew_unless_the_plan_stands_around_them(planes, tmp_path):
    out = tmp_path / "out"
    report = run(planes, out, write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES)))
    made = report["clusters"][0]["made_of"]
    workspace = Workspace(planes)
    assert sgm.made_of(workspace, "key.png", SIDES) == made
    workspace.views[SIDES[0]].t += 0.01
    moved = sgm.made_of(workspace, "key.png", SIDES)
    assert moved != made
    finished = lambda kept, made: sgm.Report(out, report["settings"], kept).finished("key.png", list(SIDES), 1.0, made)  # noqa: E731
    assert [finished(set(), made), finished(set(), moved), finished({"key.png"}, moved)] == [True, False, True]


def test_a_key_view_in_sizes_txt_is_matched_at_that_size(planes, tmp_path):
    out = tmp_path / "out"
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png", SIDES[1]))
    (tmp_path / "sizes.txt").write_text("key.png\t0.5\n")
    report = run(planes, out, clusters)
    full = Workspace(planes).views["key.png"].size
    half, other = (np.load(out / "depth_maps" / (name + ".npy")) for name in ("key.png", SIDES[0]))
    assert half.shape == (full[1] // 2, full[0] // 2) and other.shape == full[::-1]
    assert np.median(half[half > 0]) == pytest.approx(np.median(other[other > 0]), rel=0.05)
    assert {row["key"]: row["size"] for row in report["clusters"]} == {"key.png": 0.5, SIDES[0]: 1.0}
    (tmp_path / "sizes.txt").unlink()
    again = run(planes, out, clusters)
    assert np.load(out / "depth_maps/key.png.npy").shape == full[::-1] and all(row["size"] == 1.0 for row in again["clusters"])
    (tmp_path / "sizes.txt").write_text("key.png 0.5\n")
    with pytest.raises(InputError, match="sizes.txt"):
        sgm.read_clusters(clusters, Workspace(planes))


def test_a_lost_map_or_a_broken_cache_file_is_made_again(planes, tmp_path):
    out, cache = tmp_path / "out", tmp_path / "cache"
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES))
    run(planes, out, clusters, "--cache", str(cache))
    path = out / "depth_maps/key.png.npy"
    whole = path.read_bytes()
    path.unlink()
    broken = cache / "key.png" / (SIDES[0] + ".npz")
    broken.write_bytes(broken.read_bytes()[:500])
    report = run(planes, out, clusters, "--cache", str(cache))
    assert path.read_bytes() == whole
    assert [p["cached"] for p in report["clusters"][0]["partners"]] == [False, True]


def test_a_cached_pair_of_another_model_is_matched_again(planes, tmp_path):
    workspace = Workspace(planes)
    Pairs(workspace, tmp_path).get("key.png", SIDES[0])
    assert Pairs(workspace, tmp_path).get("key.png", SIDES[0]).cached
    workspace.views["key.png"].t += 0.01
    assert not Pairs(workspace, tmp_path).get("key.png", SIDES[0]).cached


def test_the_stored_steps_are_finer_than_the_match(planes):
    pair = Pairs(Workspace(planes)).get("key.png", SIDES[0])
    assert pair.step < 0.01 * np.nanmin(pair.deviation())


def test_stops_at_a_number_a_time_or_the_target(planes, tmp_path):
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png", SIDES[1]))
    assert len(run(planes, tmp_path / "a", clusters, "--stop-at", "1")["clusters"]) == 1
    report = run(planes, tmp_path / "a", clusters, "--stop-at", "0s")
    assert len(report["clusters"]) == 1 and "s are over" in report["stopped"]
    progress = tmp_path / "progress.json"
    progress.write_text('{"target_reached": true}')
    report = run(planes, tmp_path / "b", clusters, "--progress", str(progress))
    assert report["clusters"] == [] and "target" in report["stopped"]
    progress.write_text('{"target_reached": false}')
    assert len(run(planes, tmp_path / "b", clusters, "--progress", str(progress))["clusters"]) == 2


def test_single_ranks_side_by_side_become_one_report(planes, tmp_path):
    out = tmp_path / "out"
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png", SIDES[1]))
    base = ["match", str(planes), "--out", str(out), "--clusters", str(clusters)]
    for rank in ("2", "1"):
        sgm.main([*base, "--rank", rank])
        assert not (out / "report.json").exists()
    made = {path: path.stat().st_mtime_ns for path in (out / "depth_maps").rglob("*.npy")}
    sgm.main([*base, "--rank", "1"])
    report = run(planes, out, clusters, "--stop-at", "0")
    assert {row["key"] for row in report["clusters"]} == {"key.png", SIDES[0]} and len(made) == 2
    assert all(path.stat().st_mtime_ns == time for path, time in made.items()), "a finished rank is kept"
    write_clusters(clusters, ("key.png", *SIDES), (SIDES[0], SIDES[1], "key.png"))
    sgm.main([*base, "--rank", "2"])
    rows = {row["key"]: row for row in run(planes, out, clusters, "--stop-at", "0")["clusters"]}
    assert [p["name"] for p in rows[SIDES[0]]["partners"]] == [SIDES[1], "key.png"], "the newer row counts"
    with pytest.raises(SystemExit, match="the ranks 1 to 2"):
        sgm.main([*base, "--rank", "3"])


def test_the_manifest_is_read_up_to_its_cut(planes, tmp_path):
    clusters = [{"rank": 1, "key": "key.png", "partners": list(SIDES)}, {"rank": 2, "key": SIDES[0], "partners": ["key.png"]}]
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({"version": sgm.MANIFEST_VERSION, "clusters": clusters, "cut": {"clusters": 1}}))
    assert sgm.read_clusters(path, Workspace(planes)) == [("key.png", list(SIDES), 1.0)]


def test_what_a_stranger_put_beside_the_scripts_is_not_run(planes, tmp_path):
    scripts, trap = tmp_path / "scripts", tmp_path / "trapped"
    scripts.mkdir()
    for path in Path(sgm.__file__).parent.glob("*.py"):
        if not path.name.startswith(("test_", "measure", "experiments")):
            shutil.copy(path, scripts)
    code = f"open({str(trap)!r}, 'w').close()"
    for name in ("argparse", "json", "numpy", "re", "signal", "types", "zipfile", "struct"):
        (scripts / f"{name}.py").write_text(code)
    for name in ("cv2", "concurrent", "multiprocessing"):
        (scripts / name).mkdir()
        (scripts / name / "__init__.py").write_text(code)
    (scripts / "__pycache__").mkdir()
    for name in ("workspace", "pairs", "fuse"):
        (tmp_path / "trap.py").write_text(code)
        compiled = scripts / "__pycache__" / f"{name}.{sys.implementation.cache_tag}.pyc"
        py_compile.compile(tmp_path / "trap.py", compiled, invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH)
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES))
    command = [sys.executable, "sgm.py", "match", planes, "--out", tmp_path / "out", "--clusters", clusters, "--jobs", "2"]
    done = subprocess.run(command, cwd=scripts, capture_output=True, text=True)
    assert done.returncode == 0 and (tmp_path / "out/depth_maps/key.png.npy").is_file(), done.stderr
    assert not trap.exists()


def test_nothing_is_written_through_links(planes, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES))
    for name in ("depth_maps", "rows", "pairs/key.png"):
        out = tmp_path / name.replace("/", "_") / "out"
        (out / name).parent.mkdir(parents=True)
        (out / name).symlink_to(tmp_path / "elsewhere")
        with pytest.raises(SystemExit, match="a symbolic link in place of a folder"):
            run(planes, out, clusters, "--cache", str(out / "pairs"))
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_manifest_of_another_version_is_not_read(planes, tmp_path):
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({"version": sgm.MANIFEST_VERSION - 1, "order": ["key.png"]}))
    with pytest.raises(InputError, match="another version of viewrank. Plan again: viewrank plan"):
        sgm.read_clusters(path, Workspace(planes))


@pytest.mark.parametrize("text", ["", "x", "2 h", "1.5", "-1", "2d"])
def test_a_limit_is_a_number_or_a_time(text):
    assert sgm.parse_limit("20") == (20, None) and sgm.parse_limit("1.5h") == (None, 5400)
    with pytest.raises(InputError, match="neither a number of clusters"):
        sgm.parse_limit(text)


@pytest.mark.parametrize("rows, words", [
    ([("nobody.png", "key.png")], "line 2: view nobody.png is not in"),
    ([("key.png", "nobody.png")], "view nobody.png is not in"),
    ([("key.png", "key.png")], "its own partner"),
    ([("key.png", SIDES[0]), ("key.png", SIDES[1])], "line 3: key view key.png is already in line 2"),
    ([], "no view cluster"),
])
def test_clusters_that_do_not_fit_are_named(planes, tmp_path, rows, words):
    path = write_clusters(tmp_path / "clusters.txt", *rows)
    with pytest.raises(InputError, match=words):
        sgm.read_clusters(path, Workspace(planes))


def damaged(source, target, change):
    shutil.copytree(source, target)
    change(target)
    return target


@pytest.mark.parametrize("change, words", [
    (lambda w: shutil.rmtree(w / "images"), "no such folder"),
    (lambda w: shutil.rmtree(w / "sparse"), "no sparse/images.bin"),
    (lambda w: (w / "sparse/images.bin").write_bytes((w / "sparse/images.bin").read_bytes()[:-5]), "not a complete COLMAP file"),
    (lambda w: (w / "sparse/points3D.bin").write_bytes(struct.pack("<Q", 2**60)), "not a complete COLMAP file"),
    (lambda w: (w / "sparse/cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 3, 2, 8, 8, 1, 1, 1, 0)), "undistort first"),
    (lambda w: (w / "sparse/images.bin").write_bytes((w / "sparse/images.bin").read_bytes().replace(b"forward.png", b"../ward.png")), "not a path below images"),
])
def test_a_damaged_workspace_is_refused_with_a_reason(planes, tmp_path, change, words):
    with pytest.raises(InputError, match=words):
        Workspace(damaged(planes, tmp_path / "w", change))


@pytest.mark.parametrize("single", [False, True])
def test_the_maps_of_a_key_view_stay_where_its_image_is_lost(planes, tmp_path, single, capsys):
    folder = shutil.copytree(planes, tmp_path / "planes")
    lists = tmp_path / "clusters.txt"
    partners = "sub folder/left.png\tsub folder/right ü.png"
    lists.write_text(f"key.png\t{partners}\nforward.png\t{partners}\n", encoding="utf-8")
    match = ["match", str(folder), "--out", str(tmp_path / "out"), "--clusters", str(lists)]
    sgm.main(match)
    lists.write_text(f"key.png\t{partners}\tforward.png\nforward.png\t{partners}\tkey.png\n", encoding="utf-8")
    (folder / "images/key.png").unlink()
    maps = {path: path.read_bytes() for path in (tmp_path / "out").rglob("key.png.npy")}
    assert len(maps) == 2
    with pytest.raises(SystemExit) as ended:
        sgm.main([*match, *(["--rank", "1"] if single else [])])
    assert ended.value.code not in (0, None) and "key.png" in capsys.readouterr().err
    assert maps == {path: path.read_bytes() for path in (tmp_path / "out").rglob("key.png.npy")}
    report = tmp_path / "out" / ("rows/key.png.json" if single else "report.json")
    rows = {row["key"]: row for row in json.loads(report.read_text(encoding="utf-8"))["clusters"]}
    assert len(rows["key.png"]["partners"]) == 2, "the row is still that of the maps"
    assert single or len(rows["forward.png"]["partners"]) == 3, "the others are computed"


@pytest.mark.parametrize("change, words", [
    (lambda path: cv2.imwrite(str(path), np.zeros((9, 9), np.uint8)), "9 x 9 pixels, but the model says 320 x 240"),
    (lambda path: cv2.imwrite(str(path), np.zeros((8, 8), np.uint8)), "8 x 8 pixels, but the model says 320 x 240"),
    (lambda path: path.write_bytes(path.read_bytes()[:30]), "no JPEG, PNG or TIFF of at most"),
    (lambda path: path.write_bytes(b""), "no JPEG, PNG or TIFF of at most"),
    (lambda path: path.unlink(), "no JPEG, PNG or TIFF of at most"),
])
def test_a_pair_with_a_bad_image_is_refused(planes, tmp_path, change, words):
    workspace = Workspace(damaged(planes, tmp_path / "w", lambda w: change(w / "images/forward.png")))
    pairs = Pairs(workspace)
    assert words in pairs.get("key.png", "forward.png").refused
    assert pairs.get("key.png", SIDES[0]).matched


def halve(path):
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    cv2.imencode(".png", cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))[1].tofile(path)


def test_images_of_half_the_size_are_matched_in_the_models_size(planes, tmp_path):
    folder = damaged(planes, tmp_path / "w", lambda w: [halve(w / "images" / name) for name in ("key.png", SIDES[0])])
    workspace = Workspace(folder)
    pair = Pairs(workspace).get("key.png", SIDES[0])
    assert pair.code.shape == (HEIGHT, WIDTH)
    known = pair.code > 0
    assert known.mean() > 0.5 and np.median(np.abs(pair.inverse() * plane_depth("key.png") - 1)[known]) < 0.01
    stored = cv2.imread(str(folder / "images/key.png"), cv2.IMREAD_GRAYSCALE)
    assert (Workspace(folder, 0.5).grey("key.png") == stored).all(), "nothing is left to scale"


def test_what_masks_exclude_is_not_matched(planes, tmp_path):
    folder = shutil.copytree(planes, tmp_path / "w")
    get = lambda: Pairs(Workspace(folder), tmp_path / "cache").get("key.png", SIDES[0])  # noqa: E731
    whole = get()

    def put(name, usable):
        path = folder / "masks" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imencode(".png", np.where(usable, 255, 0).astype(np.uint8))[1].tofile(path)

    left = np.tile(np.arange(WIDTH // 2) < WIDTH // 4, (HEIGHT // 2, 1))  # a mask of half the size
    put("key.png.png", ~left)
    half = get()
    assert not half.cached and not (half.code[:, : WIDTH // 2] > 0).any()
    kept = whole.code[:, WIDTH // 2 + 10 :] > 0
    assert (half.code[:, WIDTH // 2 + 10 :] > 0)[kept].mean() > 0.95, "the rest is matched as before"
    assert get().cached
    put(f"{SIDES[0]}.png", left & False)
    assert get().share == 0, "nor is what the partner's mask excludes"
    (folder / "masks/key.png.png").write_bytes(b"no image")
    shutil.rmtree(folder / "masks/sub folder")
    assert (get().code == whole.code).all(), "a mask that cannot be used excludes nothing"


def test_where_masks_are_and_what_is_black(planes, tmp_path):
    folder = shutil.copytree(planes, tmp_path / "w")
    half = Workspace(folder, 0.5)
    assert half.mask("key.png") is None
    rows = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rows[: HEIGHT // 2, :, 2] = 1  # of 255, in red alone
    for mask, content in (("images/masks/key.png.png", rows), ("masks/key.png", 255 - rows)):
        (folder / mask).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / mask), content)
        found = half.mask("key.png")
        assert found.shape == (HEIGHT // 2, WIDTH // 2)
        expected = content.any(axis=2)[::2, ::2]
        assert (found == expected).all(), mask


def test_a_failure_is_said_once_with_its_reason(planes, tmp_path, capsys):
    folder = damaged(planes, tmp_path / "w", lambda w: [(w / "images" / name).write_bytes(b"") for name in ("key.png", SIDES[1])])
    clusters = write_clusters(tmp_path / "clusters.txt", ("forward.png", *SIDES), ("key.png", *SIDES))
    match = ["match", str(folder), "--out", str(tmp_path / "out"), "--clusters", str(clusters)]
    reason = f"{folder / 'images' / 'key.png'}: no JPEG, PNG or TIFF of at most 33554432 pixels that OpenCV can read"
    with pytest.raises(SystemExit, match="^error: 1 of 2 key views failed"):
        sgm.main(match)
    said = capsys.readouterr().err
    assert said.count(f"error: no depth map of key.png: {reason}") == said.count("key.png: no JPEG") == 1
    assert "refused 1 x: no JPEG, PNG or TIFF of at most N pixels" in said
    with pytest.raises(SystemExit) as ended:
        sgm.main([*match, "--rank", "2"])
    assert ended.value.code == f"error: {reason}" and reason not in capsys.readouterr().err


def test_a_refused_pair_is_judged_anew_when_its_image_is_there(planes, tmp_path):
    folder = damaged(planes, tmp_path / "w", lambda w: (w / "images" / SIDES[0]).write_bytes(b""))
    assert Pairs(Workspace(folder), tmp_path / "cache").get("key.png", SIDES[0]).refused
    shutil.copy(planes / "images" / SIDES[0], folder / "images" / SIDES[0])
    assert Pairs(Workspace(folder), tmp_path / "cache").get("key.png", SIDES[0]).matched


def test_the_fixture_is_measured(tmp_path):
    """Two nadir views and a partner between them: most of the ground is found, at the height that the sparse points have."""
    workspace = Workspace(FIXTURE, 0.5)
    key = "grid_034.jpg"
    clusters = write_clusters(tmp_path / "clusters.txt", (key, *(name for name, _ in workspace.connected(key)[:3])))
    run(FIXTURE, tmp_path / "out", clusters, "--image-scale", "0.5")
    depth = np.load(tmp_path / "out/depth_maps" / (key + ".npy"))
    pixels, z = workspace.views[key].project(workspace.xyz[workspace.views[key].points])
    x, y = np.rint(pixels).astype(int).clip(0, np.array(depth.shape[::-1]) - 1).T
    found = depth[y, x] > 0
    assert (depth > 0).mean() > 0.6 and found.mean() > 0.7
    assert np.median(np.abs(depth[y, x] / z - 1)[found]) < 0.003


def test_the_fused_cloud_is_the_plane_in_cells_of_one_pixel(planes, tmp_path, capsys):
    clusters = write_clusters(tmp_path / "clusters.txt", ("key.png", *SIDES), (SIDES[0], "key.png", SIDES[1]), (SIDES[1], "key.png", SIDES[0]))
    run(planes, tmp_path / "out", clusters, "--stop-at", "2")
    command = ["fuse", str(planes), "--out", str(tmp_path / "out"), "--clusters", str(clusters)]
    sgm.main(command)
    cloud = (tmp_path / "out/fused.ply").read_bytes()
    vertices = np.frombuffer(cloud[cloud.index(b"end_header\n") + 11 :], fuse.VERTEX)
    xyz = np.stack([vertices[axis] for axis in "xyz"], 1)
    gsd = Workspace(planes).gsd()
    off = np.abs(xyz @ PLANE[0] - PLANE[1]) / np.linalg.norm(PLANE[0])
    assert np.median(off) < gsd and np.percentile(off, 95) < 4 * gsd
    cells = np.floor((xyz - np.median(Workspace(planes).xyz, axis=0)) / gsd).astype(int)
    assert len(np.unique(cells, axis=0)) == len(xyz) > 0.5 * (np.load(tmp_path / "out/depth_maps/key.png.npy") > 0).sum()
    assert (vertices["red"] == vertices["green"]).all() and vertices["red"].std() > 10, "the texture is grey"
    sgm.main(command)
    assert (tmp_path / "out/fused.ply").read_bytes() == cloud
    other = tmp_path / f"out/depth_maps/{SIDES[0]}.npy"
    np.save(other, np.load(other)[::2, ::2])
    sgm.main(command)
    assert "left out: 1 maps, the first" in capsys.readouterr().err
    assert 0 < (tmp_path / "out/fused.ply").stat().st_size < len(cloud)
    with pytest.raises(SystemExit, match="no depth maps of these clusters"):
        sgm.main([*command[:3], str(tmp_path / "empty"), *command[4:]])


def test_sums_over_cells_do_not_depend_on_how_the_points_come(monkeypatch):
    rng = np.random.default_rng(1)
    points, colours = rng.uniform(-3, 3, (500, 3)), rng.integers(0, 256, (500, 3)).astype(float)
    whole = fuse.Cells(np.zeros(3), 0.5)
    whole.add(points, colours)
    monkeypatch.setattr(fuse, "PENDING", 20)
    parts = fuse.Cells(np.zeros(3), 0.5)
    for part in range(0, 500, 7):
        parts.add(points[part : part + 7], colours[part : part + 7])
    one, other = whole.vertices(), parts.vertices()
    assert all(np.allclose(one[name], other[name], atol=1) for name in one.dtype.names)
    by_cell = {}
    for point in points:
        by_cell.setdefault(tuple(np.floor(point / 0.5)), []).append(point)
    assert sorted(map(tuple, np.round([np.mean(cell, axis=0) for cell in by_cell.values()], 9))) == sorted(zip(*(np.round(one[axis], 9) for axis in "xyz"), strict=True))


@pytest.mark.parametrize("name", ["x" * 246 + ".png", "ü" * 123 + ".png"])
def test_a_name_that_just_fits_with_its_end_is_written(tmp_path, name):
    path = tmp_path / "rows" / (name + ".json")
    write_whole(path, lambda file: file.write(b"[]"))
    assert path.read_bytes() == b"[]" and [*path.parent.iterdir()] == [path]
