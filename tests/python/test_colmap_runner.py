"""COLMAP's depth maps by `viewrank run`, with a stub of COLMAP: each is made in a workspace of its own, and takes its place when it is what the plan asked for."""

import json
import os
import shutil
import subprocess

import pytest

import test_openmvs_runner
from test_run_scripts import COLMAP, INTERPRETER, maps_made, plans  # noqa: F401 (a fixture)

pytestmark = pytest.mark.usefixtures("without_pilot")


class Site(test_openmvs_runner.Site):
    backend, name, stand_in, record = "colmap", "colmap", COLMAP.replace("PYTHON", INTERPRETER), "stereo/viewrank/run.json"

    def keys(self):
        return [row["problem"]["reference"] for row in self.rows]

    def calls(self):
        """What the program was called for since the last question."""
        log = self.home / "calls"
        calls = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        return calls

    def run(self, *words, expect=0, **made):
        environment = {**os.environ, "CALLS": str(self.home / "calls"), "MADE": json.dumps(made)}
        command = [self.viewrank.program, "run", self.project, "--backend", "colmap", "--program", self.program, *words]
        done = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True)
        assert done.returncode == expect, done.stdout + done.stderr
        return done

    def script(self):
        environment = {"PATH": "/usr/bin:/bin", "COLMAP": str(self.program), "CALLS": str(self.home / "calls")}
        return subprocess.run([self.export / "stereo/viewrank/run.sh"], env=environment, capture_output=True, text=True, cwd="/")

    def map(self, rank, kind="depth_maps"):
        return self.export / f"stereo/{kind}/{self.keys()[rank - 1]}.photometric.bin"

    def maps(self):
        return {path.relative_to(self.export): path.read_bytes() for path in self.export.glob("stereo/*_maps/**/*.bin")}

    def cloud(self):
        return self.export / "stereo/viewrank/fused.ply"


@pytest.fixture
def site(tmp_path, viewrank, plans):  # noqa: F811
    site = Site(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    return site


def test_maps_one_by_one_and_a_cloud(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    site.run("--fuse")
    keys, calls = site.keys(), site.calls()
    assert calls[:3] == [f"photometric {key} 4" for key in keys] and len(site.maps()) == 6 and not site.left()
    assert calls[3].split()[: len(keys) + 1] == ["stereo_fusion", *keys] and "--StereoFusion.min_num_pixels 2" in calls[3]
    assert site.cloud().read_text().startswith("ply") and site.cloud().with_name("fused.ply.vis").exists()
    for words in (["--rank", 1], ["--rank", 3], ["--fuse"]):
        assert "nothing to do" in site.run(*words).stderr
    assert not site.calls()


FAULTS = {
    "no depth map": (dict(depth_maps=None), "made no depth map"),
    "no normal map": (dict(normal_maps=None), "made no normal map"),
    "cut off": (dict(normal_maps=5000), "pixels need"),
    "of another size": (dict(size=[20, 10]), "has 20 x 10 pixels instead of"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_map_that_is_not_what_the_plan_asked_for_takes_no_place(site, fault):
    made, said = FAULTS[fault]
    for kind in ("depth_maps", "normal_maps"):
        site.map(2, kind).write_bytes(b"of an older plan")
    before = site.maps()
    done = site.rank(2, expect=1, **made)
    assert said in done.stderr and "rank 2" in done.stderr, done.stderr
    assert site.maps() == before and not site.left()
    site.run("--fuse")
    assert not [call for call in site.calls() if "fusion" in call], "nothing to fuse"
    site.rank(2)
    assert len(site.map(2).read_bytes()) > 1000


def test_an_unfinished_run_is_fused_from_the_maps_that_are_there(site):
    site.rank(3)
    site.run("--fuse")
    assert "--StereoFusion.min_num_pixels 1" in site.calls()[-1], "one map alone agrees with none"
    site.rank(1)
    site.run("--fuse")
    assert site.calls()[-1].split()[1:4:2] == [site.keys()[0], "--StereoFusion.min_num_pixels"]
    # A map without its normals is none.
    site.map(1, "normal_maps").unlink()
    site.run("--fuse")
    assert site.calls()[-1].split()[1:3] == [site.keys()[2], "--StereoFusion.min_num_pixels"]
    site.rank(1)
    assert maps_made(site.calls()) == site.keys()[:1]


@pytest.mark.parametrize("points", [None, 0], ids=["none", "empty"])
def test_a_fusion_that_fails_leaves_the_cloud_of_before(site, points):
    site.rank(1)
    site.run("--fuse")
    before = site.cloud().read_bytes()
    site.rank(2)
    assert "fused no points" in site.run("--fuse", expect=1, fusion=points).stderr
    assert site.cloud().read_bytes() == before and not site.left()
    site.run("--fuse")


def test_key_views_of_half_the_size_are_matched_at_it(tmp_path, viewrank, plans):  # noqa: F811
    site = Site(tmp_path, viewrank, plans["sizes"])
    site.plan("-k", "4", "--scales", "1,0.5", "--budget", "40%", "--target", "100%")
    widths = {row["size"][0] for row in site.rows}
    assert len(widths) == 2 and max(widths) == 2 * min(widths)
    half = next(row for row in site.rows if row["size"][0] == min(widths))
    site.rank(half["rank"])
    (call,) = site.calls()
    assert call.endswith(f" 4 --PatchMatchStereo.max_image_size {min(widths)}")


def test_maps_of_other_partners_are_made_anew_and_others_kept(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    site.calls()
    before = site.maps()
    (site.project / "none").mkdir()
    site.plan("-k", "3", "--budget", "3", "--finished", site.project / "none")
    again = set(site.keys())
    for rank in (1, 2, 3):  # what an export says of maps of before changes meanwhile
        site.rank(rank)
    assert set(maps_made(site.calls())) == again
    assert set(before) <= set(site.maps())
    site.plan("-k", "3", "--budget", "2", "--finished", site.project / "none")
    assert "nothing to do" in site.rank(1).stderr


def test_maps_of_the_users_own_colmap_are_made_anew_unless_they_are_planned_around(tmp_path, viewrank, plans):  # noqa: F811
    """A dense workspace in which COLMAP has computed some maps."""
    site = Site(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    dense = site.project / "dense"
    shutil.copytree(site.project / "viewrank/colmap", dense)
    shutil.rmtree(dense / "stereo/viewrank")
    shutil.rmtree(site.project / "viewrank")
    for path in dense.glob("**/.*"):
        path.unlink()
    site.project, site.export = dense, dense
    site.plan("-k", "4", "--budget", "3")
    theirs = {kind: b"2&2&%d&" % channels + bytes(16 * channels) for kind, channels in (("depth_maps", 1), ("normal_maps", 3))}
    for kind, content in theirs.items():
        site.map(1, kind).write_bytes(content)
    site.rank(1)
    assert maps_made(site.calls()) == site.keys()[:1] and site.map(1).read_bytes() != theirs["depth_maps"]
    assert not (dense / "unfinished").exists() and not site.left()
    site.run("--fuse")
    assert site.cloud().exists() and not (dense / "fused.ply").exists()


def test_viewrank_knows_the_maps_of_the_script(site):
    left = site.export / "stereo/viewrank/unfinished/0123456789abcdef/stereo"
    left.mkdir(parents=True)
    (left / "fusion.cfg").symlink_to("/etc/passwd")  # what a killed run left is in nobody's way
    done = site.script()
    assert done.returncode == 0, done.stderr
    assert maps_made(site.calls()) == site.keys()
    for rank in (1, 2, 3):
        assert "nothing to do" in site.rank(rank).stderr
    site.run("--fuse")
    assert len(site.calls()) == 1


def test_of_two_marks_that_of_the_last_map_counts(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    (site.project / "none").mkdir()
    site.plan("-k", "3", "--budget", "3", "--finished", site.project / "none")
    for path in site.maps():
        (site.export / path).unlink()
    assert site.script().returncode == 0
    site.calls()
    assert "nothing to do" in site.rank(1).stderr
    of_script = site.keys()
    site.plan("-k", "4", "--budget", "3", "--finished", site.project / "none")
    rank = next(rank for rank, key in enumerate(site.keys(), 1) if key in of_script)
    site.rank(rank)
    assert maps_made(site.calls()) == [site.keys()[rank - 1]], "the script has made another since"
    assert "nothing to do" in site.rank(rank).stderr


def test_what_a_stranger_left_where_a_map_is_made_is_not_followed(site, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/letter").write_text("precious")
    unfinished = site.export / "stereo/viewrank/unfinished"
    unfinished.symlink_to(tmp_path / "outside")
    site.rank(1, expect=1)
    unfinished.unlink()
    shutil.rmtree(site.export / "stereo/normal_maps")
    (site.export / "stereo/normal_maps").symlink_to(tmp_path / "outside")
    site.rank(1, expect=1)
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["letter"] and (tmp_path / "outside/letter").read_text() == "precious"
