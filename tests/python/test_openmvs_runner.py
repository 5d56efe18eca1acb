"""OpenMVS's depth maps by `viewrank run`, and by the script of its exports where there is no viewrank, with a stub of DensifyPointCloud that is controlled by a file."""

import json
import os
import shutil
import signal
import subprocess
import sys

import pycolmap
import pytest

from test_export_formats import Mvs
from test_run_scripts import plans  # noqa: F401 (a fixture)

pytestmark = pytest.mark.usefixtures("without_pilot")

# Makes what run.json says of a scene, but for what made.json beside the stub says of its rank. It is the program, so it refuses what DensifyPointCloud would trip over.
STAND_IN = '''#!{python} -IS
import json, os, signal, struct, sys
from pathlib import Path
home = Path(__file__).parent
known = "working-folder input-file output-file config-file dense-config-file max-threads verbosity resolution-level min-resolution max-resolution number-views".split()
known += "geometric-iters postprocess-dmaps fusion-mode number-views-fuse view-neighbors-file".split()
if (home / "newer").exists():
    known += ["fusion-filter", "estimate-roi", "crop-to-roi"]
if "--help" in sys.argv:
    print(*(f"  --{{name}} arg" for name in known), sep="\\n")
    sys.exit(0)
names, values = sys.argv[1::2], sys.argv[2::2]
options = dict(zip((name[2:] for name in names), values))
if len(options) < len(names) or set(options) - set(known):
    sys.exit("unrecognised or repeated options")
if not options["working-folder"].endswith("/"):
    sys.exit("with a file of options, names would only be appended")
with open(home / "calls.jsonl", "a") as log:
    log.write(json.dumps(options) + "\\n")
export, work, scene = Path(options["config-file"]).parent, Path(options["working-folder"]), Path(options["input-file"])
run = json.loads((export / "run.json").read_text())
made = json.loads((home / "made.json").read_text()) if (home / "made.json").exists() else {{}}


def size_at(row, resolution):
    scale = min(1, resolution / max(row["size"]))
    return [round(side * scale) for side in row["size"]]


if scene.name == "fuse.mvs":
    lists = [list(map(int, line.split())) for line in (work / options["view-neighbors-file"]).read_text().splitlines()]
    (home / "lists.json").write_text(json.dumps(lists))
    (home / "fuse.mvs").write_bytes((work / scene).read_bytes())
    for key, *_ in lists:
        row = run["clusters"][key]
        sizes = struct.unpack_from("<2I", (work / row["map"]).read_bytes(), 12)
        if list(sizes) != size_at(row, int(options["max-resolution"])) or not (work / row["image"]).exists():
            print("error: the map has another size than the image, or there is no image")
            sys.exit(3)
    if made.get("fusion", 42) is not None:
        (work / options["output-file"]).write_bytes(b"scene")
        (work / options["output-file"]).with_suffix(".ply").write_bytes(b"ply\\nformat ascii 1.0\\nelement vertex %d\\nproperty float x\\nend_header\\n" % made.get("fusion", 42))
    sys.exit(0)

row = next(row for row in run["clusters"] if row["rank"] == int(scene.stem))
if list(work.iterdir()) or not (b"../../" + row["image"].encode() in scene.read_bytes() and (work / "../.." / row["image"]).exists()):
    sys.exit("maps that OpenMVS would keep, or no images")
what = dict(ids=row["ids"], range=row["depths"], depth=row["depths"][0], kind="DR") | made.get(str(row["rank"]), {{}})
if "kill" in what:
    os.kill(os.getppid(), what["kill"])
if what["depth"] is None:
    print("error: out of luck")
    sys.exit(0)
(width, height), (least, greatest), kind = size_at(row, int(options["max-resolution"])), what["range"], what["kind"].encode()
pixels, old = width * height, kind == b"DR"
head = kind + bytes([3, 0 if old else 10]) + struct.pack("<4I2f", width, height, width, height, least, greatest) + (b"" if old else struct.pack("<f", 1))
head += struct.pack("<H", 1) + b"a" + struct.pack(f"<I{{len(what['ids'])}}I", len(what["ids"]), *what["ids"]) + bytes(21 * 8)
depth = struct.pack("<f", what["depth"]) if old else struct.pack("<e", what["depth"] / 1024)
whole = head + depth * pixels + bytes((12 if old else 4) * pixels)
(work / row["map"]).write_bytes(whole[: what.get("bytes")])
print("06:04:49 [App     ] Densifying point-cloud completed", "06:04:49 [App     ] MEMORYINFO: {{", "}} ENDINFO", sep="\\n")
'''


class Site:
    """A planned project with the stub beside it."""

    backend, name, stand_in, record = "openmvs", "DensifyPointCloud", STAND_IN.format(python=sys.executable), "run.json"

    def __init__(self, folder, viewrank, plan):
        self.viewrank, self.project, self.home = viewrank, folder / "site", folder / "bin"
        shutil.copytree(plan, self.project, symlinks=True)
        self.home.mkdir()
        self.program = self.home / self.name
        self.program.write_text(self.stand_in)
        self.program.chmod(0o755)
        self.export = self.project / "viewrank" / self.backend

    def plan(self, *options):
        self.viewrank("plan", self.project, "--backend", self.backend, "--confidence", "geometric", "--quiet", *options)
        run = json.loads((self.export / self.record).read_text())
        self.rows = run.get("clusters", run.get("maps"))

    def makes(self, **of_ranks):
        """What the stub makes of ranks (`_1`) and of the `fusion` from now on."""
        (self.home / "made.json").write_text(json.dumps({name.lstrip("_"): made for name, made in of_ranks.items()}))

    def calls(self):
        """What the program was called for since the last question: options, by rank or "fuse"."""
        log = self.home / "calls.jsonl"
        calls = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
        log.unlink(missing_ok=True)
        return {call["input-file"].split("/")[-1].removesuffix(".mvs").lstrip("0"): call for call in calls}

    def run(self, *words, expect=0):
        return self.viewrank("run", self.project, "--backend", "openmvs", "--program", self.program, *words, expect=expect)

    def rank(self, rank, **options):
        return self.run("--rank", rank, **options)

    def script(self, *words):
        return subprocess.run([sys.executable, "-I", self.export / "run.py", "--densify", self.program, *words], capture_output=True, text=True, cwd="/", timeout=60)

    def map(self, rank):
        return self.export / self.rows[rank - 1]["map"]

    def maps(self):
        return {path.name: path.read_bytes() for path in self.export.glob("*.dmap")}

    def left(self):
        unfinished = (self.export / self.record).with_name("unfinished")
        return sorted(path.name for path in unfinished.iterdir()) if unfinished.exists() else []


@pytest.fixture
def site(tmp_path, viewrank, plans):  # noqa: F811
    site = Site(tmp_path, viewrank, plans[4])
    site.plan("-k", "4", "--budget", "3")
    return site


# viewrank run


def test_maps_and_cloud_with_options_by_which_nothing_is_cut_off(site):
    (site.home / "newer").touch()
    for rank in (1, 2, 3):
        site.rank(rank)
    site.run("--fuse")
    calls = site.calls()
    assert list(calls) == ["1", "2", "3", "fuse"] and len(site.maps()) == 3 and not site.left()
    for call in calls.values():
        assert (call["number-views"], call["geometric-iters"], call["estimate-roi"], call["crop-to-roi"]) == ("0", "0", "0", "0")
    assert calls["1"]["fusion-mode"] == "1" and calls["fuse"]["number-views-fuse"] == "2" and calls["fuse"]["fusion-filter"] == "1"
    assert (site.export / "fused.ply").read_text().startswith("ply") and (site.export / "fused.mvs").exists()
    for words in (["--rank", 1], ["--rank", 3], ["--fuse"]):
        assert "nothing to do" in site.run(*words).stderr
    assert not site.calls()


def test_options_of_newer_versions_are_passed_to_these_alone(site):
    site.rank(1)
    assert not {"fusion-filter", "estimate-roi"} & set(site.calls()["1"])


FAULTS = {
    "no map": (dict(depth=None), "made no depth map"),
    "empty": (dict(depth=0), "only 0.0 % of the pixels have a depth"),
    "cut off": (dict(bytes=5000), "pixels need"),
    "of another image": (dict(ids=[9999, 1]), "is of image 9999"),
    "other partners": (dict(ids="fewer"), "instead of"),
    "range": (dict(range=[0.1, 100]), "searched depths of 0.1"),
    "newer": (dict(kind="D3"), "newer than this viewrank"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_map_that_is_not_what_the_plan_asked_for_takes_no_place(site, fault):
    """DensifyPointCloud ends with success whatever it did."""
    made, said = FAULTS[fault]
    if made.get("ids") == "fewer":
        made = dict(ids=site.rows[1]["ids"][:-1])
    site.map(2).write_bytes(b"of an older plan")
    site.makes(_2=made)
    done = site.rank(2, expect=1)
    assert said in done.stderr and "rank 2" in done.stderr, done.stderr
    assert site.maps() == {site.map(2).name: b"of an older plan"}
    site.run("--fuse")
    assert list(site.calls()) == ["2"], "nothing to fuse"
    site.makes()
    site.rank(2)
    assert len(site.map(2).read_bytes()) > 1000 and not site.left()


def test_an_unfinished_run_is_fused_from_the_maps_that_are_there(site):
    """Images of other key views have no pose: none is loaded."""
    site.rank(3)
    site.rank(1)
    site.run("--fuse")
    assert json.loads((site.home / "lists.json").read_text()) == [[0, 2], [2, 0]]
    assert [image[2][2] == 0xFFFFFFFF for image in Mvs(site.home / "fuse.mvs").images] == [False, True, False]
    site.rank(2)
    site.run("--fuse")
    assert [key for key, *_ in json.loads((site.home / "lists.json").read_text())] == [0, 1, 2]


def test_one_map_alone_is_fused_with_what_it_has(site):
    site.rank(1)
    site.run("--fuse")
    assert site.calls()["fuse"]["number-views-fuse"] == "1"


@pytest.mark.parametrize("points", [None, 0], ids=["none", "empty"])
def test_a_fusion_that_fails_leaves_the_cloud_of_before(site, points):
    site.rank(1)
    site.run("--fuse")
    before = (site.export / "fused.ply").read_bytes()
    site.rank(2)
    site.makes(fusion=points)
    assert "fused no points" in site.run("--fuse", expect=1).stderr
    assert (site.export / "fused.ply").read_bytes() == before and not site.left()
    site.makes()
    site.run("--fuse")


def test_a_plan_for_another_program_is_computed_at_the_size_of_this_one(site):
    """OpenMVS matches large images at half the size."""
    model = pycolmap.Reconstruction(site.project / "sparse/0")
    for camera in model.cameras.values():
        camera.rescale(4.0)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = 4.0 * point.xy
    model.write(site.project / "sparse/0")
    site.viewrank("plan", site.project, "--backend", "sgm", "--budget", "3", "--confidence", "geometric", "--quiet")
    site.viewrank("export", site.project, "--backend", "openmvs")
    site.rank(1)
    assert site.calls()["1"]["max-resolution"] == "1200"


@pytest.mark.parametrize("kind", ["DR", "D2"])
def test_maps_of_half_the_size_are_fused_at_full_size(tmp_path, viewrank, plans, kind):  # noqa: F811
    """DensifyPointCloud would silently fuse them with the camera of the full image."""
    site = Site(tmp_path, viewrank, plans["sizes"])
    site.plan("-k", "4", "--scales", "1,0.5", "--budget", "40%", "--target", "100%")
    site.makes(**{f"_{row['rank']}": dict(kind=kind) for row in site.rows})
    sizes = {row["resolution"] for row in site.rows}
    assert len(sizes) == 2 and max(sizes) == 2 * min(sizes)
    for row in site.rows:
        site.rank(row["rank"])
    before = site.maps()
    assert len({len(content) for content in before.values()}) == 2
    site.run("--fuse")
    assert site.maps() == before and not site.left()
    assert "not fused" in site.script().stdout, "the script leaves that to viewrank"


def test_maps_of_two_kinds_are_not_mixed(site):
    """OpenMVS reads only maps of the kind that it writes."""
    site.rank(1)
    before = site.maps()
    site.makes(_2=dict(kind="D2"))
    said = site.rank(2, expect=1).stderr
    assert site.map(1).name in said and "D2" in said and "--program" in said and site.maps() == before
    site.map(1).rename(site.home / "kept")
    site.rank(2)
    (site.home / "kept").rename(site.map(1))
    assert "of the kind" in site.run("--fuse", expect=1).stderr


def test_a_whole_run_says_why_a_map_failed_and_fuses_the_others(site):
    site.makes(_2=dict(ids=site.rows[1]["ids"][:-1]))
    done = site.run("--no-report", expect=1)
    assert "OpenMVS matched the partners" in done.stderr and "ENDINFO" not in done.stderr
    assert len(site.maps()) == 2 and (site.export / "fused.ply").exists()


def test_a_finished_map_that_lost_its_end_is_made_again(site):
    for rank in (1, 2, 3):
        site.rank(rank)
    content = site.map(2).read_bytes()
    site.map(2).write_bytes(content[:-1])
    site.run("--fuse")
    assert [key for key, *_ in json.loads((site.home / "lists.json").read_text())] == [0, 2]
    site.rank(2)
    assert site.map(2).read_bytes() == content


def test_a_task_of_another_plan_is_not_computed_by_this_ones_files(site):
    """A process of a queue may wait while somebody plans again."""
    text = (site.export / "run.json").read_text()
    run = json.loads(text)
    run["clusters"][0], run["clusters"][1] = [{**run["clusters"][i], "rank": 2 - i} for i in (1, 0)]
    site.rank(3)
    (site.export / "run.json").write_text(json.dumps(run))
    assert "not what this viewrank writes" in site.rank(1, expect=1).stderr and not site.map(1).exists()


def test_a_picture_that_changed_since_the_plan_is_not_matched(site):
    picture = site.project / "images" / site.rows[0]["key"]
    content = picture.read_bytes()
    picture.unlink()  # may be a link
    picture.write_bytes(content + b"\0")
    assert "changed since" in site.rank(1, expect=1).stderr
    assert "has changed since the plan" in site.script().stderr and not site.calls()


def test_what_a_stranger_left_where_a_map_is_made_is_not_followed(site, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/letter").write_text("precious")
    (site.export / "DensifyPointCloud.cfg").write_text(f"output-file={tmp_path}/outside/letter")
    site.rank(1)
    assert site.calls()["1"]["config-file"].endswith("options.cfg")
    # Within the project, too, nothing of anybody else's is removed.
    shutil.rmtree(site.export / "unfinished")
    (site.export / "unfinished").symlink_to("../../images")
    pictures = sorted((site.project / "images").rglob("*"))
    site.rank(3)
    assert sorted((site.project / "images").rglob("*")) == pictures
    (site.export / "unfinished").unlink()
    (site.export / "unfinished").symlink_to(tmp_path / "outside")
    site.rank(2, expect=1)
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["letter"] and (tmp_path / "outside/letter").read_text() == "precious"


# The script


def test_the_script_computes_in_rank_order_and_fuses_and_viewrank_knows_its_maps(site):
    done = site.script("--stop-at", "2")
    assert done.returncode == 0 and "viewrank run" in done.stdout and list(site.calls()) == ["1", "2"], done.stderr
    assert "nothing to do" in site.rank(2).stderr
    assert site.script().returncode == 0 and list(site.calls()) == ["3", "fuse"] and not site.left()
    assert (site.export / "fused.ply").read_text().startswith("ply")
    assert "nothing to do" in site.rank(3).stderr and not site.calls()


def test_the_script_makes_maps_of_other_partners_anew(site):
    assert site.script().returncode == 0
    site.calls()
    before = site.maps()
    (site.project / "none").mkdir()
    site.plan("-k", "3", "--budget", "3", "--finished", site.project / "none")
    again = {row["map"] for row in site.rows}
    site.script()
    assert set(site.calls()) == {"1", "2", "3", "fuse"} and again <= set(site.maps()) and site.maps() != before


def test_the_fusion_works_on_files_that_have_no_other_name(site, tmp_path):
    assert site.script("--stop-at", "3").returncode == 0
    other = tmp_path / "other"
    os.link(site.map(1), other)
    assert site.script().returncode == 0 and (site.export / "fused.ply").exists()
    assert other.stat().st_nlink == site.map(1).stat().st_nlink == 1 and other.read_bytes() == site.map(1).read_bytes()


def test_what_a_killed_fusion_left_is_in_nobodys_way(site):
    left = site.export / "unfinished/0123456789abcdef"
    (left / "images").mkdir(parents=True)
    (left / "depth0001.dmap").symlink_to(site.export / "run.json")
    assert site.script().returncode == 0


@pytest.mark.parametrize("kill", [None, signal.SIGKILL], ids=["failed", "killed"])
def test_a_script_that_fails_or_is_killed_loses_no_map(site, kill):
    site.makes(_2=dict(depth=None) if kill is None else dict(kill=kill))
    site.map(2).write_bytes(b"of an older plan")
    done = site.script()
    assert done.returncode != 0 and site.map(2).read_bytes() == b"of an older plan" and site.map(1).exists() and not (site.export / "fused.ply").exists()
    assert kill or "1 of 3 depth maps failed" in done.stderr
    site.makes()
    site.calls()
    assert site.script().returncode == 0 and set(site.calls()) >= {"2", "fuse"} and "1" not in site.calls()


@pytest.mark.parametrize("entry", ["", ".", "images"])
def test_no_program_of_the_folder_is_started(site, entry):
    for name in ("DensifyPointCloud", "images/DensifyPointCloud"):
        (site.export / name).write_text(f"#!/bin/sh\n: > '{site.home}/taken'\n")
        (site.export / name).chmod(0o755)
    environment = {"PATH": f"{entry}:/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-I", "run.py"], env=environment, capture_output=True, text=True, cwd=site.export)
    assert done.returncode == 1 and "no program" in done.stderr and not (site.home / "taken").exists()
