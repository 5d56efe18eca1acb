"""MVE's depth maps by `viewrank run`, with stubs of its programs: each is made in a scene of its own, and takes its place when it is what the plan asked for."""

import json
import os
import subprocess

import pytest

import test_colmap_runner
from test_run_scripts import DMRECON, INTERPRETER, SCENE2PSET, plans  # noqa: F401 (a fixture)

pytestmark = pytest.mark.usefixtures("without_pilot")


class Site(test_colmap_runner.Site):
    backend, name, stand_in, record = "mve", "dmrecon", DMRECON.replace("PYTHON", INTERPRETER), "run.json"

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.joiner = self.home / "scene2pset"
        self.joiner.write_text(SCENE2PSET.replace("PYTHON", INTERPRETER))
        self.joiner.chmod(0o755)

    def keys(self):
        return [cluster["key"]["name"] for cluster in json.loads((self.export / "export.json").read_text())["clusters"]]

    def run(self, *words, expect=0, **made):
        environment = {**os.environ, "PATH": "/usr/bin:/bin", "CALLS": str(self.home / "calls"), "MADE": json.dumps(made)}
        command = [self.viewrank.program, "run", self.project, "--backend", "mve", "--program", self.program, *words]
        done = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True)
        assert done.returncode == expect, done.stdout + done.stderr
        return done

    def script(self):
        environment = {"PATH": f"{self.home}:/usr/bin:/bin", "CALLS": str(self.home / "calls")}
        return subprocess.run([self.export / "run.sh"], env=environment, capture_output=True, text=True, cwd="/")

    def map(self, rank, kind="depth"):
        row = self.rows[rank - 1]
        return self.export / row["view"] / f"{kind}-L{row['level']}.mvei"

    def maps(self):
        return {path.relative_to(self.export): path.read_bytes() for path in self.export.glob("views/*/*.mvei")}

    def cloud(self, name="fused.ply"):
        return self.export / name


@pytest.fixture
def site(tmp_path, viewrank, plans):  # noqa: F811
    site = Site(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    return site


def test_maps_one_by_one_and_a_cloud(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    site.run("--fuse")
    keys = site.keys()
    assert site.calls() == [*keys, " ".join(["joined", *keys])] and len(site.maps()) == 6 and not site.left()
    assert site.cloud().read_text().startswith("ply")
    for words in (["--rank", 1], ["--rank", 3], ["--fuse"]):
        assert "nothing to do" in site.run(*words).stderr
    assert not site.calls()


FAULTS = {
    "no map": (dict(map=None), "made no depth map"),
    "empty": (dict(depth=0), "only 0.0 % of the pixels have a depth"),
    "cut off": (dict(map=5000), "pixels need"),
    "of another size": (dict(size=[20, 10]), "has 20 x 10 pixels instead of"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_map_that_is_not_what_the_plan_asked_for_takes_no_place(site, fault):
    made, said = FAULTS[fault]
    site.map(2).write_bytes(b"of an older plan")
    before = site.maps()
    done = site.rank(2, expect=1, **made)
    assert said in done.stderr and "rank 2" in done.stderr, done.stderr
    assert site.maps() == before and not site.left()
    site.run("--fuse")
    assert len(site.calls()) == 1, "nothing to join"
    site.rank(2)
    assert len(site.map(2).read_bytes()) > 1000
    assert site.map(2).with_name(site.map(2).name + ".before-viewrank").read_bytes() == b"of an older plan", "which may be the user's"


def test_an_unfinished_run_is_joined_from_the_maps_that_are_there(site):
    site.rank(3)
    site.run("--fuse")
    assert site.calls()[-1] == f"joined {site.keys()[2]}"
    site.rank(1)
    site.run("--fuse")
    assert site.calls()[-1] == f"joined {site.keys()[0]} {site.keys()[2]}"
    site.map(1).unlink()
    site.run("--fuse")
    assert site.calls()[-1] == f"joined {site.keys()[2]}"


@pytest.mark.parametrize("points", [None, 0], ids=["none", "empty"])
def test_a_fusion_that_fails_leaves_the_cloud_of_before(site, points):
    site.rank(1)
    site.run("--fuse")
    before = site.cloud().read_bytes()
    site.rank(2)
    assert "no points" in site.run("--fuse", expect=1, fusion=points).stderr
    assert site.cloud().read_bytes() == before and not site.left()
    site.run("--fuse")


def test_without_scene2pset_the_fusion_says_so(site):
    site.rank(1)
    site.joiner.unlink()
    assert f"no program scene2pset in {site.home} or on the PATH" in site.run("--fuse", expect=1).stderr


def test_each_size_has_a_cloud(tmp_path, viewrank, plans):  # noqa: F811
    site = Site(tmp_path, viewrank, plans["sizes"])
    site.plan("-k", "4", "--scales", "1,0.5", "--budget", "40%", "--target", "100%")
    levels = {row["level"] for row in site.rows}
    assert len(levels) == 2
    first = {level: next(row["rank"] for row in site.rows if row["level"] == level) for level in sorted(levels)}
    for rank in first.values():
        site.rank(rank)
    site.run("--fuse")
    assert site.calls()[-2:] == [f"joined {site.keys()[rank - 1]}" for rank in first.values()]
    assert site.cloud().exists() and site.cloud("fused_half.ply").exists()
    (site.project / "none").mkdir()
    site.plan("-k", "4", "--budget", "3", "--finished", site.project / "none")
    site.rank(1)
    site.run("--fuse")
    assert site.cloud().exists() and not site.cloud("fused_half.ply").exists(), "no cloud of another plan beside the new one"


def test_maps_of_other_partners_are_made_anew_and_others_kept(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    site.calls()
    before = site.maps()
    (site.project / "none").mkdir()
    site.plan("-k", "3", "--budget", "3", "--finished", site.project / "none")
    again = site.keys()
    for rank in (1, 2, 3):
        site.rank(rank)
    assert site.calls() == again
    assert set(before) <= set(site.maps())


def test_script_and_viewrank_know_each_other_s_maps(site):
    site.rank(2)
    left = site.export / "unfinished/0123456789abcdef/views"
    left.mkdir(parents=True)
    (left / "picture.jpg").symlink_to("/etc/passwd")  # what a killed run left is in nobody's way
    done = site.script()
    assert done.returncode == 0, done.stderr
    keys = site.keys()
    assert site.calls() == [keys[1], keys[0], keys[2], " ".join(["joined", *keys])]
    for rank in (1, 2, 3):
        assert "nothing to do" in site.rank(rank).stderr
    site.run("--fuse")
    assert len(site.calls()) == 1


def test_what_a_stranger_left_where_a_map_is_made_is_not_followed(site, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/letter").write_text("precious")
    (site.export / "unfinished").symlink_to(tmp_path / "outside")
    site.rank(1, expect=1)
    (site.export / "unfinished").unlink()
    view = site.map(1).parent
    view.rename(tmp_path / "view")
    view.symlink_to(tmp_path / "outside")
    site.rank(1, expect=1)
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["letter"]
