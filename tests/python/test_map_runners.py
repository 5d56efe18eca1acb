"""Depth maps of MVE, AliceVision and PatchmatchNet by `viewrank run`, with stubs of their programs: each is made in a folder of its own, and takes its place when it is what the plan asked for."""

import fcntl
import json
import os
import subprocess

import numpy as np
import pytest

import test_colmap_runner
from test_run_scripts import ALICEVISION, DMRECON, EVAL, INTERPRETER, SCENE2PSET, plans  # noqa: F401 (a fixture)

pytestmark = pytest.mark.usefixtures("without_pilot")


class Site(test_colmap_runner.Site):
    record = "run.json"
    # Names and texts of the programs that join the maps, and the file that the last of them writes.
    joining, made = {}, ""
    # How many maps the program joins at least.
    least = 1

    def __init__(self, *arguments):
        super().__init__(*arguments)
        for name, text in self.joining.items():
            path = self.home / name
            path.write_text(text.replace("PYTHON", INTERPRETER))
            path.chmod(0o755)

    def run(self, *words, expect=0, during="true", **made):
        environment = {**os.environ, "PATH": "/usr/bin:/bin", "DURING": during, "CALLS": str(self.home / "calls"), "MADE": json.dumps(made)}
        command = [self.viewrank.program, "run", self.project, "--backend", self.backend, "--program", self.program, *words]
        done = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True)
        assert done.returncode == expect, done.stdout + done.stderr
        return done

    def script(self):
        environment = {"PATH": f"{self.home}:/usr/bin:/bin", "CALLS": str(self.home / "calls")}
        return subprocess.run([self.export / "run.sh"], env=environment, capture_output=True, text=True, cwd="/")

    def clusters(self):
        return json.loads((self.export / "export.json").read_text())["clusters"]

    def cloud(self):
        return self.export / self.made


class Mve(Site):
    backend, name, stand_in = "mve", "dmrecon", DMRECON.replace("PYTHON", INTERPRETER)
    joining, made = {"scene2pset": SCENE2PSET}, "fused.ply"

    def keys(self):
        return [cluster["key"]["name"] for cluster in self.clusters()]

    def joined(self, *ranks):
        return " ".join(["joined", *(self.keys()[rank - 1] for rank in ranks)])

    def map(self, rank):
        row = self.rows[rank - 1]
        return self.export / row["view"] / f"depth-L{row['level']}.mvei"

    def maps(self):
        return {path.relative_to(self.export): path.read_bytes() for path in self.export.glob("views/*/*.mvei")}


class AliceVision(Site):
    backend, name, stand_in = "alicevision", "aliceVision_depthMapEstimation", ALICEVISION.replace("PYTHON", INTERPRETER)
    joining, made = {"aliceVision_depthMapFiltering": ALICEVISION, "aliceVision_meshing": ALICEVISION}, "dense.abc"

    def keys(self):
        return [str(row["view"]) for row in self.rows]

    def joined(self, *ranks):
        return " ".join(["joined", *sorted((self.keys()[rank - 1] for rank in ranks), key=int)])

    def map(self, rank):
        return self.export / f"depthMaps/{self.keys()[rank - 1]}_depthMap.exr"

    def maps(self):
        return {path.relative_to(self.export): path.read_bytes() for path in self.export.glob("depthMaps/*.exr")}


class Net(Site):
    backend, name, stand_in, made, least = "patchmatchnet", "eval.py", EVAL, "depths/fused.ply", 2

    def __init__(self, *arguments):
        super().__init__(*arguments)
        (self.home / "checkpoints").mkdir()
        (self.home / "checkpoints/params_000007.ckpt").write_text("weights")

    def script(self):
        environment = {"PATH": "/usr/bin:/bin", "PATCHMATCHNET": str(self.home), "CALLS": str(self.home / "calls")}
        return subprocess.run([self.export / "run.sh"], env=environment, capture_output=True, text=True, cwd="/")

    def keys(self):
        return [str(row["partners"]["key"]) for row in self.rows]

    def joined(self, *ranks):
        there = {int(self.keys()[rank - 1]) for rank in ranks}
        rows = (self.rows[rank - 1] for rank in ranks)
        joined = [str(row["partners"]["key"]) for row in rows if there & {view for view, _ in row["compared"]["others"]}]
        assert len(joined) > 1
        return " ".join(["joined", *joined])

    def map(self, rank):
        return self.export / f"depths/depth_est/{int(self.keys()[rank - 1]):08}.pfm"

    def maps(self):
        return {path.relative_to(self.export): path.read_bytes() for path in self.export.glob("depths/depth_est/*.pfm")}


@pytest.fixture(params=[Mve, AliceVision, Net])
def site(tmp_path, viewrank, plans, request):  # noqa: F811
    site = request.param(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    return site


def test_maps_one_by_one_and_a_cloud(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    site.run("--fuse")
    assert site.calls() == [*site.keys(), site.joined(1, 2, 3)] and all(site.map(rank).exists() for rank in (1, 2, 3)) and not site.left()
    assert site.cloud().read_text().startswith("p")
    for words in (["--rank", 1], ["--rank", 3], ["--fuse"]):
        assert "nothing to do" in site.run(*words).stderr
    assert not site.calls()


FAULTS = {
    "no map": (dict(map=None), "made no depth map"),
    "empty": (dict(depth=0), "only 0.0 % of the pixels have a depth"),
    "cut off": (dict(map=5000), "did not write all of the depth map"),
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
    if site.least == 1:
        site.run("--fuse")
        assert site.calls()[-1] == site.joined(3)
    else:
        assert "nothing to join" in site.run("--fuse", expect=1).stderr
    site.rank(1)
    site.run("--fuse")
    assert site.calls()[-1] == site.joined(1, 3)
    site.rank(2)
    site.map(1).unlink()
    site.run("--fuse")
    assert site.calls()[-1] == site.joined(2, 3)


@pytest.mark.parametrize("points", [None, 0], ids=["none", "empty"])
def test_a_fusion_that_fails_leaves_the_cloud_of_before(site, points):
    site.rank(1)
    site.rank(2)
    site.run("--fuse")
    before = site.cloud().read_bytes()
    site.rank(3)
    assert any(said in site.run("--fuse", expect=1, fusion=points).stderr for said in ("joined no points", "made no mesh.obj", "fused no points"))
    assert site.cloud().read_bytes() == before and not site.left()
    site.run("--fuse")


@pytest.mark.parametrize("site", [Mve, AliceVision], indirect=True)
def test_without_the_programs_that_join_the_fusion_says_so(site):
    site.rank(1)
    [name, *_] = site.joining
    (site.home / name).unlink()
    assert f"no program {name} in {site.home} or on the PATH" in site.run("--fuse", expect=1).stderr


def test_each_size_has_a_cloud_of_mve(tmp_path, viewrank, plans):  # noqa: F811
    site = Mve(tmp_path, viewrank, plans["sizes"])
    site.plan("-k", "4", "--scales", "1,0.5", "--budget", "40%", "--target", "100%")
    levels = {row["level"] for row in site.rows}
    assert len(levels) == 2
    first = {level: next(row["rank"] for row in site.rows if row["level"] == level) for level in sorted(levels)}
    for rank in first.values():
        site.rank(rank)
    picture = next(site.export.glob("views/*/undist-L*.png"))
    picture.unlink()  # without it the cloud would have no colours
    site.calls()
    for rank in first.values():
        site.rank(rank)
    assert len(site.calls()) == 1 and picture.exists()
    site.run("--fuse")
    half = site.export / "fused_half.ply"
    assert site.calls()[-2:] == [site.joined(rank) for rank in first.values()] and site.cloud().exists() and half.exists()
    (site.project / "none").mkdir()
    site.plan("-k", "4", "--budget", "3", "--finished", site.project / "none")
    site.rank(1)
    site.run("--fuse")
    assert site.cloud().exists() and not half.exists(), "no cloud of another plan beside the new one"
    site.plan("-k", "3", "--scales", "1,0.5", "--budget", "40%", "--target", "100%", "--finished", site.project / "none")
    site.calls()
    site.rank(first[max(levels)])
    assert site.calls(), "the map of half the size is of other partners, whatever was made at full size since"


def test_patchmatchnet_s_script_computes_all_and_viewrank_knows_them(tmp_path, viewrank, plans):  # noqa: F811
    site = Net(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    site.rank(2)
    site.calls()
    assert site.script().returncode == 0
    assert site.calls() == [*site.keys(), site.joined(1, 2, 3)]
    for rank in (1, 2, 3):
        assert "nothing to do" in site.rank(rank).stderr
    # Without its weights it ends at once, and what was finished stays so.
    weights = site.home / "checkpoints/params_000007.ckpt"
    weights.unlink()
    done = site.script()
    assert done.returncode == 1 and "no eval.py, or no checkpoints/params_000007.ckpt" in done.stderr
    weights.write_text("weights")
    assert "nothing to do" in site.rank(1).stderr and not site.calls()
    # Of a plan with other partners a map that it did not make is not taken for one that it did.
    (site.project / "none").mkdir()
    site.plan("-k", "3", "--budget", "3", "--finished", site.project / "none")
    site.program.write_text("raise SystemExit(1)")
    assert site.script().returncode != 0
    site.program.write_text(EVAL)
    site.plan("-k", "4", "--budget", "3", "--finished", site.project / "none")
    site.rank(1)
    assert site.calls() == site.keys()[:1]


def pfm(path):
    """Rows from the lowest up."""
    _, size, _, floats = path.read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    return np.frombuffer(floats, "<f4").reshape(height, width)[::-1]


def test_patchmatchnet_joins_maps_of_two_sizes_at_one(tmp_path, viewrank, plans):  # noqa: F811
    site = Net(tmp_path, viewrank, plans["sizes"])
    site.plan("-k", "4", "--scales", "1,0.5", "--budget", "40%", "--target", "100%")
    sizes = {tuple(row["size"]) for row in site.rows}
    [fused] = {tuple(row["fused_size"]) for row in site.rows}
    assert len(sizes) == 2 and fused == max(sizes)
    for row in site.rows:
        site.rank(row["rank"])
    half = next(row for row in site.rows if tuple(row["size"]) != fused)
    width, height = half["size"]
    values = np.arange(1, width * height + 1, dtype="<f4").reshape(height, width)
    for kind in ("depth_est", "confidence"):
        path = site.export / f"depths/{kind}/{half['partners']['key']:08}.pfm"
        path.write_bytes(b"Pf\n%d %d\n-1.000000\n" % (width, height) + values[::-1].tobytes())
    # The stand-in keeps what it was given.
    kept = tmp_path / "kept"
    source = site.program.read_text()
    site.program.write_text(source.replace('note("joined"', f'os.system(f"cp -RL {{out}} {kept}"); note("joined"'))
    site.run("--fuse")
    copy = pfm(kept / f"depth_est/{half['partners']['key']:08}.pfm")
    rows, columns = (np.arange(side) * of // side for side, of in zip(copy.shape, values.shape))
    assert np.array_equal(copy, values[rows][:, columns]), "the nearest pixel at each place"
    assert np.array_equal(pfm(path), values), "the map itself stays as it is"


def test_a_map_that_leads_out_of_the_export_counts_as_none(site, tmp_path):
    site.rank(1)
    site.calls()
    outside = tmp_path / "outside"
    site.map(1).rename(outside)
    site.map(1).symlink_to(outside)
    content = outside.read_bytes()
    site.rank(1)
    assert site.calls() == site.keys()[:1] and not site.map(1).is_symlink() and outside.read_bytes() == content


def test_confidences_that_lead_out_of_the_export_are_not_joined(tmp_path, viewrank, plans):  # noqa: F811
    site = Net(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    for rank in (1, 2, 3):
        site.rank(rank)
    path = site.export / "depths/confidence" / site.map(1).name
    path.rename(tmp_path / "outside.pfm")
    path.symlink_to(tmp_path / "outside.pfm")
    site.calls()
    done = site.run("--fuse", expect=1)
    assert f"{path.relative_to(site.export)}: a link out of the export" in done.stdout + done.stderr and not site.calls()


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
    after, again = site.maps(), {site.map(rank).relative_to(site.export) for rank in (1, 2, 3)}
    assert all(after[path] == content for path, content in before.items() if path not in again)


def test_a_program_is_not_taken_from_the_current_folder(site, tmp_path):
    """Nor from a folder of its name there, unless somebody names it."""
    planted = tmp_path / "cwd" / site.name
    planted.mkdir(parents=True)
    (planted / site.name).write_text(f"#!/bin/sh\n: > '{tmp_path}/taken'\n")
    (planted / site.name).chmod(0o755)
    variable = {"mve": "DMRECON", "alicevision": "ALICEVISION", "patchmatchnet": "PATCHMATCHNET"}[site.backend]
    for named in ({}, {variable: site.name}):
        environment = {**os.environ, "PATH": f"{site.home}:/usr/bin:/bin", "CALLS": str(site.home / "calls"), **named}
        command = [site.viewrank.program, "run", site.project, "--backend", site.backend, "--rank", "1"]
        subprocess.run(command, env=environment, cwd=planted.parent, capture_output=True, check=False)
        assert not (tmp_path / "taken").exists()
    assert site.calls() == site.keys()[:1]
    folder = {**os.environ, "PATH": "/usr/bin:/bin", "CALLS": str(site.home / "calls"), variable: str(site.home)}
    assert subprocess.run([*command[:-1], "2"], env=folder, capture_output=True, check=False).returncode == 0, "the folder that it is in"


def test_a_failed_task_leaves_what_viewrank_made_viewrank_s_own(site):
    site.rank(1)
    (site.project / "none").mkdir()
    site.plan("-k", "3", "--budget", "3", "--finished", site.project / "none")
    site.rank(1, expect=1, map=None)
    site.rank(1)
    assert not list(site.export.glob("**/*.before-viewrank"))


@pytest.mark.parametrize("site", [Mve, AliceVision], indirect=True)
def test_script_and_viewrank_know_each_other_s_maps(site):
    site.rank(2)
    left = site.export / "unfinished/0123456789abcdef"
    left.mkdir(parents=True)
    (left / "picture.jpg").symlink_to("/etc/passwd")  # what a killed run left is in nobody's way
    done = site.script()
    assert done.returncode == 0, done.stderr
    keys = site.keys()
    assert site.calls() == [keys[1], keys[0], keys[2], site.joined(1, 2, 3)]
    for rank in (1, 2, 3):
        assert "nothing to do" in site.rank(rank).stderr
    site.run("--fuse")
    assert len(site.calls()) == 1


def test_script_and_viewrank_do_not_compute_at_the_same_time(site):
    folder = os.open(site.export, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_SH)  # as viewrank run
    done = site.script()
    assert done.returncode == 1 and "viewrank run computes here" in done.stderr and not site.calls()
    site.rank(1)
    fcntl.flock(folder, fcntl.LOCK_EX)  # as the script
    command = [site.viewrank.program, "run", site.project, "--backend", site.backend, "--program", site.program, "--rank", "2"]
    with subprocess.Popen(command, env={**os.environ, "CALLS": str(site.home / "calls")}, stderr=subprocess.PIPE, text=True) as waiting:
        assert any("waiting for another process" in line for line in waiting.stderr)
        assert len(site.calls()) == 1
        os.close(folder)
        assert "done" in waiting.stderr.read()
    assert waiting.returncode == 0 and len(site.calls()) == 1


def test_a_list_that_is_changed_meanwhile_is_not_followed(site, tmp_path):
    place = site.map(1).relative_to(site.export)
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / place.name).write_text("precious")
    run = site.export / "run.json"
    changed = json.loads(run.read_text())
    outside = os.path.relpath(tmp_path / "outside", site.export)
    for row in changed["maps"]:
        if site.backend == "patchmatchnet":  # names its files by number alone
            row["partners"]["key"] += 1
            continue
        row["view"] = outside if site.backend == "mve" else f"../{outside}/{row['view']}"
    (tmp_path / "run.json").write_text(json.dumps(changed))
    site.rank(1, during=f"cp '{tmp_path}/run.json' '{run}'")
    assert site.map(1).exists() and [path.name for path in (tmp_path / "outside").iterdir()] == [place.name]
    assert (tmp_path / "outside" / place.name).read_text() == "precious"


def test_what_a_stranger_left_where_a_map_is_made_is_not_followed(site, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/letter").write_text("precious")
    (site.export / "unfinished").symlink_to(tmp_path / "outside")
    site.rank(1, expect=1)
    (site.export / "unfinished").unlink()
    folder = site.map(1).parent
    folder.rename(tmp_path / "folder")
    folder.symlink_to(tmp_path / "outside")
    site.rank(1, expect=1)
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["letter"]
