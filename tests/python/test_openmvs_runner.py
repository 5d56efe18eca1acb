"""integrations/openmvs/run.py with a stub of DensifyPointCloud that is controlled by a file."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import LONG

RUNNER = Path(__file__).resolve().parents[2] / "integrations/openmvs/run.py"

STAND_IN = '''#!{python} -IS
import json, os, re, signal, struct, sys
from pathlib import Path
NAMES = "working-folder input-file output-file view-neighbors-file dense-config-file resolution-level max-resolution min-resolution number-views number-views-fuse iters".split()
NAMES += "geometric-iters estimate-colors estimate-normals fusion-mode postprocess-dmaps remove-dmaps tower-mode max-threads cuda-device verbosity".split()
SHORT = dict(w="working-folder", i="input-file", o="output-file", v="verbosity")
if "--help" in sys.argv:
    print("  -w [ --working-folder ] arg", *(f"  --{{name}} arg" for name in NAMES), sep="\\n")
    sys.exit(0)
home = Path(__file__).parent
with open(home / "calls.jsonl", "a") as log:
    log.write(json.dumps(sys.argv[1:]) + "\\n")


def refuse(why):
    print(f"06:04:49 [App     ] {{why}}", "06:04:49 [App     ] MEMORYINFO: {{", "}} ENDINFO", sep="\\n")
    sys.exit(1)


# As boost::program_options reads them, which takes each option once.
options, words = {{}}, sys.argv[1:]
while words:
    word = words.pop(0)
    name, equals, value = word[2:].partition("=") if word.startswith("--") else (SHORT[word[1]], "", word[2:])
    meant = [name] if name in NAMES else [known for known in NAMES if known.startswith(name)]
    if len(meant) != 1:
        refuse(f"option '--{{name}}' is ambiguous" if meant else f"unrecognised option '--{{name}}'")
    if meant[0] in options:
        refuse(f"option '--{{meant[0]}}' cannot be specified more than once")
    if not value and (not words or words[0][:2] == "--" and words[0][2:] in NAMES):
        refuse(f"the required argument for option '--{{meant[0]}}' is missing")
    options[meant[0]] = value or words.pop(0)

here, scene = Path(options["working-folder"]), options["input-file"]
data = (here / scene).read_bytes()
if scene == "fusing.mvs":
    (home / "fused").mkdir(exist_ok=True)
    for path in here.glob("*.dmap"):
        (home / "fused" / path.name).write_bytes(path.read_bytes())
    for key in ("k0", "k1", "k2"):
        at = data.find(b"images/" + key.encode()) + len("images/k0") + 8
        if b"images/" + key.encode() in data and data[at + 8 : at + 12] != b"\\xff" * 4 and not (here / "images" / key).exists():
            print(f"06:04:49 [App     ] error: failed reloading image '{{here}}/images/{{key}}'")
            sys.exit(1)
    if (here / "no-points").exists():
        print("06:04:49 [App     ] error: out of luck")
        sys.exit(0)
    (here / "fusing-done.ply").write_bytes(b"ply\\nelement vertex 42\\nend_header\\n")
    (here / "fusing-done.mvs").write_bytes(data)
elif not (here / "images").is_dir() or list(here.glob("*.dmap")):
    sys.exit("no images, or maps that OpenMVS would keep")
for made in json.loads((home / "made.json").read_text()).get(scene, []):
    ids, (least, greatest), depth = made["ids"], made["range"], made["depth"] + int(options.get("iters", 0))
    kind = made.get("kind", "DR")
    # D2: an exponent and the value of a confidence of 255 in the head, halves, normals of two shorts.
    head = kind.encode() + bytes([3, 0 if kind == "DR" else 3]) + struct.pack("<4I2f", 4, 4, 4, 4, least, greatest) + (b"" if kind == "DR" else struct.pack("<f", 1))
    head += struct.pack("<H", 1) + b"a" + struct.pack(f"<I{{len(ids)}}I", len(ids), *ids) + bytes(21 * 8)
    planes = struct.pack("<16f", *[depth] * 16) + bytes(16 * 12) if kind == "DR" else struct.pack("<16e", *[depth / 8] * 16) + bytes(16 * 4)
    (here / f"depth{{ids[0]:04d}}.dmap").write_bytes(head + planes[: made.get("bytes")])
    if made.get("kill"):
        os.kill(os.getppid(), made["kill"])
    if "bytes" in made:
        print("Killed")
        sys.exit(137)
'''


@pytest.fixture
def folder(tmp_path):
    shutil.copy(RUNNER, tmp_path / "run.py")
    rows = [dict(rank=i + 1, scene=f"clusters/{i}.mvs", key=f"k{i}", image=f"images/k{i}", id=10 + i, partner_ids=[1, 2], share=(i + 1) / 3, depths=[100, 200], size=[400, 300]) for i in range(3)]
    (tmp_path / "clusters").mkdir()
    for row in rows:
        (tmp_path / row["scene"]).write_text(row["key"])
    # The middle of a scene as it matters here: name, no mask, platform, camera, pose, id of each image.
    image = lambda name: struct.pack("<Q", len(name)) + name.encode() + struct.pack("<Q4I", 0, 0, 0, 7, 1)
    (tmp_path / "fuse.mvs").write_bytes(b"MVSI" + b"".join(image(row["image"]) for row in rows))
    (tmp_path / "links.txt").touch()
    (tmp_path / "images").mkdir()
    for row in rows:
        (tmp_path / row["image"]).touch()
    run = dict(clusters=rows, overlaps=[[1, 2], [0, 2], [0, 1]], fused_with=24, maps_per_point=2, resolution=400, pictures={row["image"]: 0 for row in rows})
    (tmp_path / "run.json").write_text(json.dumps(run))
    make(tmp_path)
    stand_in = tmp_path / "densify"
    stand_in.write_text(STAND_IN.format(python=sys.executable))
    stand_in.chmod(0o755)
    return tmp_path


def make(folder, **changes):
    made = {f"clusters/{i}.mvs": [dict(ids=[10 + i, 2, 1], range=[90, 220], depth=150)] for i in range(3)}
    made.update({f"clusters/{key[1:]}.mvs": value for key, value in changes.items()})
    (folder / "made.json").write_text(json.dumps(made))


def run(folder, *options, program=("run.py",)):
    (folder / "calls.jsonl").unlink(missing_ok=True)
    done = subprocess.run([sys.executable, *program, "--densify", folder / "densify", *options], capture_output=True, text=True, cwd=folder)
    calls = [json.loads(line) for line in (folder / "calls.jsonl").read_text().splitlines()] if (folder / "calls.jsonl").exists() else []
    report = json.loads((folder / "report.json").read_text()) if (folder / "report.json").exists() else {"clusters": []}
    return done, calls, {row["key"]: row for row in report["clusters"]}


def scenes(calls):
    return [call[call.index("-i") + 1] for call in calls]


def value(call, option):
    return call[call.index(option) + 1]


def maps(folder):
    """Bytes of the depth maps, by name."""
    return {path.name: path.read_bytes() for path in folder.glob("*.dmap")}


def depth(content):
    return struct.unpack_from("<f", content, len(content) - 16 * 16)[0]


def nothing_left(folder):
    return not list((folder / "unfinished").iterdir()) and not list(folder.rglob("*.tmp"))


def test_a_picture_that_changed_since_the_plan_is_not_matched(folder):
    (folder / "images/k1").write_bytes(b"another picture")
    done, calls, _ = run(folder)
    assert done.returncode == 1 and "'images/k1': the picture has changed since the plan: plan again" in done.stderr and not calls


def test_in_rank_order_then_fused_and_resumed(folder):
    done, calls, report = run(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert scenes(calls) == ["clusters/0.mvs", "clusters/1.mvs", "clusters/2.mvs", "fusing.mvs"]
    assert all(not row["problems"] for row in report.values())
    assert scenes(run(folder)[1]) == ["fusing.mvs"]


def test_a_map_of_half_the_size_is_fused_at_full_size(folder):
    """DensifyPointCloud would silently fuse it with the camera of the full image."""
    plan = json.loads((folder / "run.json").read_text())
    plan["clusters"][1].update(scale=0.5, size=[800, 601])
    (folder / "run.json").write_text(json.dumps(plan))
    done, calls, report = run(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [value(call, "--max-resolution") for call in calls] == ["400", "200", "400", "400"]
    assert report["k1"]["scale"] == 0.5 and report["k1"]["size"] == [4, 4]
    made, fused = (folder / "depth0011.dmap").read_bytes(), (folder / "fused/depth0011.dmap").read_bytes()
    assert struct.unpack_from("<4I", made, 4) == (4, 4, 4, 4) and struct.unpack_from("<4I", fused, 4) == (400, 300, 400, 300)
    planes = fused[-(400 * 300 * 16) :]
    assert struct.unpack_from("<120000f", planes) == (150.0,) * 120000 and not any(planes[4 * 400 * 300 :])
    assert (folder / "fused/depth0010.dmap").read_bytes() == (folder / "depth0010.dmap").read_bytes()
    assert scenes(run(folder)[1]) == ["fusing.mvs"], "it is kept"
    plan["clusters"][1]["scale"] = 1
    (folder / "run.json").write_text(json.dumps(plan))
    assert scenes(run(folder)[1]) == ["clusters/1.mvs", "fusing.mvs"], "planned at full size now"
    plan["clusters"][1]["scale"] = 0.5
    (folder / "run.json").write_text(json.dumps(plan))
    done, calls, report = run(folder)
    assert scenes(calls) == ["fusing.mvs"] and "k1: planned at half the size, kept at full size" in done.stdout, "no finished map is made coarser"
    assert report["k1"]["scale"] == 1 and (folder / "fused/depth0011.dmap").read_bytes() == (folder / "depth0011.dmap").read_bytes()


def test_enlarging_keeps_where_pixels_look_and_lowers_confidence(folder, tmp_path):
    sys.path.insert(0, str(folder))
    import run as runner

    k = [500.0, 0, 1.5, 0, 510.0, 1.0, 0, 0, 1]
    head = b"DR" + bytes([7, 0]) + struct.pack("<4I2f", 4, 3, 4, 3, 1, 9) + struct.pack("<H", 1) + b"a" + struct.pack("<I2I", 2, 10, 1)
    planes = struct.pack("<12f", *range(1, 13)) + struct.pack("<36f", *range(36)) + struct.pack("<12f", 0, 0.5, 0.9, 0.95, *[1.0] * 8)
    path = tmp_path / "depth0010.dmap"
    path.write_bytes(head + struct.pack("<21d", *k, *range(12)) + planes)
    large = runner.enlarged(path, [8, 6])
    depths = struct.unpack_from("<48f", large, len(large) - 48 * 20)
    assert depths[:8] == (1, 1, 2, 2, 3, 3, 4, 4) and depths[8:16] == depths[:8] and depths[40:] == (9, 9, 10, 10, 11, 11, 12, 12)
    normals = struct.unpack_from("<144f", large, len(large) - 48 * 16)
    assert normals[:12] == (0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5)
    confidences = struct.unpack_from("<8f", large, len(large) - 48 * 4)
    assert confidences == pytest.approx((0, 0, 0, 0, 0.6, 0.6, 0.8, 0.8))
    # The ray through the middle of a pixel is that through the corner of its four copies.
    wide = struct.unpack_from("<9d", large, len(head))
    assert [(2 * 0 + 0.5 - wide[2]) / wide[0], (2 * 2 + 0.5 - wide[5]) / wide[4]] == pytest.approx([(0 - k[2]) / k[0], (2 - k[5]) / k[4]])


def test_openmvs_compares_a_map_with_the_best_of_those_that_are_there(folder):
    run_json = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**run_json, "fused_with": 1}))
    make(folder, k1=[])
    run(folder)
    assert (folder / "fuse.txt").read_text() == "0 2\n2 0\n"
    make(folder)
    run(folder)
    assert (folder / "fuse.txt").read_text() == "0 1\n1 0\n2 0\n"


def test_openmvs_silent_no_map(folder):
    make(folder, k1=[])
    done, _, report = run(folder)
    assert done.returncode == 1 and report["k1"]["problems"][0] == "no depth map" and "ended with 0" in report["k1"]["problems"][1]
    assert (folder / "fuse.txt").read_text() == "0 2\n2 0\n"


def test_partners_ranges_and_empty_maps_are_checked(folder):
    make(folder, k0=[dict(ids=[10, 1], range=[90, 220], depth=1)], k1=[dict(ids=[11, 1, 2], range=[0.1, 100], depth=1)], k2=[dict(ids=[12, 1, 2], range=[90, 220], depth=0)])
    done, _, report = run(folder)
    assert done.returncode == 1
    assert "partners [1] instead of [1, 2]" in report["k0"]["problems"][0]
    assert "depth range 0.1 to 100" in report["k1"]["problems"][0]
    assert "0.0 % of the pixels" in report["k2"]["problems"][0]


def poses(folder):
    """Returns the poses of the images of the last fused scene."""
    data = (folder / "fused.mvs").read_bytes()
    return [struct.unpack_from("<I", data, data.index(f"images/k{i}".encode()) + 25)[0] for i in range(3)]


def test_maps_that_are_not_as_planned_are_made_anew_and_not_fused(folder):
    """Partners that are not the plan's; a map cut off behind its depths by a program that was killed."""
    cut = dict(ids=[12, 1, 2], range=[90, 220], depth=150, bytes=100)
    make(folder, k1=[dict(ids=[11, 1], range=[90, 220], depth=1)], k2=[cut])
    done, _, report = run(folder)
    assert done.returncode == 1 and "partners" in report["k1"]["problems"][0]
    assert report["k2"]["problems"] == ["unreadable depth map: cut off", "DensifyPointCloud ended with 137 | Killed"]
    assert (folder / "fuse.txt").read_text() == "0 1\n" and poses(folder) == [7, 0xFFFFFFFF, 0xFFFFFFFF]
    make(folder)
    done, calls, report = run(folder)
    assert done.returncode == 0 and scenes(calls) == ["clusters/1.mvs", "clusters/2.mvs", "fusing.mvs"]
    assert poses(folder) == [7, 7, 7] and not any(row["problems"] for row in report.values())
    os.truncate(folder / "depth0010.dmap", 100)
    assert scenes(run(folder)[1]) == ["clusters/0.mvs", "fusing.mvs"], "cut off later"


def test_openmvs_all_images_loaded(folder):
    """An unused image is not loaded: it costs no memory, and may be missing."""
    make(folder, k1=[])
    (folder / "images/k1").unlink()
    done, _, _ = run(folder)
    assert poses(folder) == [7, 0xFFFFFFFF, 7] and "2 maps fused: 42 points" in done.stdout
    run(folder, "--stop-at", "0", "--", "--resolution-level", "1")
    assert poses(folder) == [7, 0xFFFFFFFF, 7], "nothing to fuse: what was fused stays"


def test_an_image_that_cannot_be_read_keeps_no_others_from_being_fused(folder):
    run(folder)
    (folder / "images/k1").unlink()
    done, _, report = run(folder)
    assert done.returncode == 1 and "k1: its image cannot be read; 2 maps fused: 42 points" in done.stdout
    assert (folder / "fuse.txt").read_text() == "0 2\n2 0\n" and not list(folder.glob("fusing*"))


def test_a_fusion_that_fails_leaves_the_one_of_before(folder):
    run(folder)
    before = (folder / "fused.ply").read_bytes()
    (folder / "no-points").touch()
    (folder / "unfinished/fusion-killed").mkdir(parents=True)
    done, _, _ = run(folder)
    assert nothing_left(folder)
    assert done.returncode == 1 and "DensifyPointCloud ended with 0 | error: out of luck" in done.stdout and "nothing is fused" in done.stdout
    assert (folder / "fused.ply").read_bytes() == before and not list(folder.glob("fusing*"))


def test_openmvs_existing_dmap_kept(folder):
    """OpenMVS would reuse the map of other partners; if the new one fails, the old map stays but is not fused."""
    run(folder)
    before, scene = maps(folder), (folder / "clusters/1.mvs").read_text()
    (folder / "clusters/1.mvs").write_text("other partners")
    make(folder, k1=[])
    done, calls, report = run(folder)
    assert scenes(calls) == ["clusters/1.mvs", "fusing.mvs"] and report["k1"]["problems"][0] == "no depth map"
    assert maps(folder) == before and (folder / "fuse.txt").read_text() == "0 2\n2 0\n"
    (folder / "clusters/1.mvs").write_text(scene)
    done, calls, report = run(folder)
    assert done.returncode == 0 and scenes(calls) == ["fusing.mvs"], "the plan of before finds its map"
    assert not any(row["problems"] for row in report.values())


def test_the_users_options_replace_those_of_the_runner(folder):
    run(folder)
    before = maps(folder)
    done, calls, report = run(folder, "--", "--geometric-iters", "2")
    assert done.returncode == 0 and len(report) == 3, done.stdout + done.stderr
    *of_maps, fusion = calls
    assert [value(call, "--geometric-iters") for call in of_maps] == ["2"] * 3
    assert value(fusion, "--geometric-iters") == "0", "a fusion changes no map"
    assert maps(folder).keys() == before.keys() and nothing_left(folder)


@pytest.mark.parametrize(
    "words, option, wanted",
    [
        (["--postprocess-dmaps=1"], "--postprocess-dmaps", "1"),
        (["--max-res", "800"], "--max-resolution", "800"),
        (["--verb=3", "--number-views", "4"], "--number-views", "4"),
        (["-v3"], "--verbosity", "3"),
        (["-v", "2", "--cuda-device", "-2"], "--cuda-device", "-2"),
        (["--iters", "2", "--iters", "3"], "--iters", "3"),
        (["--max-threads", "7"], "--max-threads", "7"),
    ],
)
def test_spellings_of_options(folder, words, option, wanted):
    done, calls, _ = run(folder, "--threads", "1", "--", *words)
    assert done.returncode == 0 and [value(call, option) for call in calls[:3]] == [wanted] * 3, done.stdout + done.stderr


@pytest.mark.parametrize("words", [["-w", "elsewhere"], ["-oelsewhere.mvs"], ["--fusion-mode=0"], ["--remove-dmaps", "1"], ["--remove", "1"], ["scene.mvs"]])
def test_options_that_would_take_the_runner_its_files_are_refused(folder, words):
    done, calls, _ = run(folder, "--", *words)
    assert done.returncode == 1 and calls == [] and words[0] in done.stderr


@pytest.mark.parametrize("words", [["--number-views-fuse", "3"], ["--estimate-colors=0"], ["--max-threads", "2"], ["-v", "3"]])
def test_options_of_the_fusion_leave_the_maps(folder, words):
    """They don't identify a map, whether given when it is made or only when it is fused."""
    run(folder)
    before = maps(folder)
    done, calls, report = run(folder, "--stop-at", "0", "--", *words)
    assert done.returncode == 0 and scenes(calls) == ["fusing.mvs"] and len(report) == 3
    assert maps(folder) == before
    assert scenes(run(folder, "--", *words)[1]) == ["fusing.mvs"]


def test_the_number_of_agreeing_maps_reaches_the_fusion_alone(folder):
    calls = run(folder, "--", "--number-views-fuse", "3")[1]
    assert [value(call, "--number-views-fuse") for call in calls if "--number-views-fuse" in call] == ["3"] and len(calls) == 4
    assert json.loads((folder / "report.json").read_text())["fusion"]["agreeing"] == 3


@pytest.mark.parametrize("words, why", [(["--itres", "3"], "unrecognised option '--itres'"), (["--number"], "option '--number' is ambiguous"), (["--iters"], "the required argument for option '--iters' is missing")])
@pytest.mark.parametrize("single", [True, False])
def test_refused_options_are_named_and_end_the_run(folder, words, why, single):
    run(folder)
    before, report = maps(folder), (folder / "report.json").read_bytes()
    done, calls, _ = run(folder, *(["--rank", "1"] if single else []), "--", *words)
    assert done.returncode == 1 and len(calls) == 1 and done.stderr.rstrip().endswith(why)
    assert maps(folder) == before and (folder / "report.json").read_bytes() == report and nothing_left(folder)


CUT = dict(range=[90, 220], depth=150, bytes=100)


@pytest.mark.parametrize("single", [True, False])
@pytest.mark.parametrize(
    "failure",
    [[], [dict(ids=[11, 1, 2], **CUT)], [dict(ids=[11, 1], range=[90, 220], depth=150)], [dict(ids=[11, 1, 2], kill=signal.SIGINT, **CUT)], [dict(ids=[11, 1, 2], kill=signal.SIGKILL, **CUT)]],
    ids=["no map", "cut off", "other partners", "interrupted", "killed"],
)
def test_a_run_that_fails_loses_no_map(folder, failure, single):
    run(folder)
    before = maps(folder)
    make(folder, k0=failure and [{**failure[0], "ids": [10, *failure[0]["ids"][1:]]}], k1=failure)
    rank = ["--rank", "2"] if single else []
    done, calls, _ = run(folder, *rank, "--", "--iters", "9")
    assert done.returncode != 0 and calls
    after = maps(folder)
    assert after.keys() == before.keys() and after["depth0011.dmap"] == before["depth0011.dmap"]
    assert single or after["depth0010.dmap"] == before["depth0010.dmap"]
    make(folder)
    done, calls, report = run(folder, "--", "--iters", "9")
    assert done.returncode == 0 and {"clusters/0.mvs", "clusters/1.mvs"} <= set(scenes(calls)) and not any(row["problems"] for row in report.values())
    assert {depth(content) for content in maps(folder).values()} == {159} and nothing_left(folder)


KILLED = """
import os, pathlib, runpy, shutil, sys, tempfile
left = int(sys.argv.pop(1))
def counted(call):
    def wrapped(*arguments, **named):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), 9)
        return call(*arguments, **named)
    return wrapped
for owner, name in ((pathlib.Path, "replace"), (pathlib.Path, "unlink"), (pathlib.Path, "mkdir"), (pathlib.Path, "symlink_to"), (shutil, "rmtree"), (tempfile, "mkdtemp"), (pathlib.Path, "write_text")):
    setattr(owner, name, counted(getattr(owner, name)))
sys.argv = ["run.py", *sys.argv[1:]]
runpy.run_path("run.py", run_name="__main__")
"""


@pytest.mark.parametrize("words", [["--rank", "1"], ["--stop-at", "1", "--no-fusion"]], ids=["single", "whole"])
def test_killed_at_any_step_every_map_is_there_and_known_for_what_it_is(folder, tmp_path_factory, words):
    """A map of two iterations is to become one of nine; the run is killed before its first change of a file, its second, and on."""
    run(folder, "--", "--iters", "2")
    names = maps(folder).keys()
    steps, finished = 0, False
    while not finished:
        copy, again = (tmp_path_factory.mktemp("killed") / name for name in ("copy", "again"))
        shutil.copytree(folder, copy)
        done, _, _ = run(copy, *words, "--", "--iters", "9", program=("-IS", "-c", KILLED, str(steps)))
        finished = done.returncode == 0
        assert finished or done.returncode == -signal.SIGKILL, done.stderr
        assert maps(copy).keys() == names and {depth(content) for content in maps(copy).values()} <= {152, 159}
        shutil.copytree(copy, again, symlinks=True)
        run(again, "--stop-at", "0", "--", "--iters", "2")
        older = {i for i in range(3) if depth(maps(again)[f"depth{10 + i:04d}.dmap"]) == 152}
        assert {int(line.split()[0]) for line in (again / "fuse.txt").read_text().splitlines()} == older
        done, calls, report = run(copy, "--", "--iters", "9")
        assert done.returncode == 0 and len(calls) == len(older) + 1, "nothing that is finished is made again"
        assert {depth(content) for content in maps(copy).values()} == {159} and len(report) == 3
        # Every fifth step without VIEWRANK_LONG=1.
        steps += 1 if LONG else 5
    assert steps > 10 and len(older) == 2


@pytest.mark.parametrize("older", ["plan", "options"])
def test_a_map_of_an_older_plan_is_not_fused(folder, older):
    """The run ends before that cluster: its map and its row in report.json exist."""
    run(folder)
    if older == "plan":
        (folder / "clusters/1.mvs").write_text("other partners")
    done, calls, report = run(folder, "--stop-at", "1", *(["--", "--resolution-level", "1"] if older == "options" else []))
    fused = scenes(calls)[-1] == "fusing.mvs"
    assert fused and "left out" in done.stdout and "k1" in done.stdout
    lines = (folder / "fuse.txt").read_text().splitlines()
    assert {int(line.split()[0]) for line in lines} == ({0, 2} if older == "plan" else {0})
    assert "k1" not in report and (folder / "depth0011.dmap").exists()


def test_nothing_is_fused_where_all_maps_are_of_other_options(folder):
    run(folder)
    done, calls, report = run(folder, "--stop-at", "0", "--", "--resolution-level", "1")
    assert done.returncode == 1 and calls == [] and report == {} and "nothing to fuse" in done.stdout
    assert scenes(run(folder)[1]) == ["fusing.mvs"], "their maps are still good for the options that they were made with"


def test_openmvs_existing_dmap_header_rewritten(folder):
    fusion = run(folder)[1][-1]
    for option, value in (("--geometric-iters", "0"), ("--postprocess-dmaps", "0")):
        assert fusion[fusion.index(option) + 1] == value, "maps stay as they are"


def test_openmvs_number_views_1_is_global(folder):
    assert all(call[call.index("--number-views") + 1] == "0" for call in run(folder)[1])


def test_openmvs_number_views_1_defeats_score_0(folder):
    """Also for clusters with a single partner, whose scene excludes the partner by a score."""
    text = (folder / "run.json").read_text().replace("[1, 2]", "[1]")
    (folder / "run.json").write_text(text)
    make(folder, **{f"k{i}": [dict(ids=[10 + i, 1], range=[90, 220], depth=150)] for i in range(3)})
    done, calls, _ = run(folder)
    assert done.returncode == 0 and all(call[call.index("--number-views") + 1] == "0" for call in calls)


@pytest.mark.parametrize("stop, count", [("2", 2), ("60%", 2), ("0s", 0)])
def test_stops(folder, stop, count):
    calls = run(folder, "--stop-at", stop, "--no-fusion")[1]
    assert len(calls) == count


def test_ends_when_the_target_is_reached(folder):
    (folder / "progress.json").write_text('{"target_reached": true}')
    assert run(folder, "--progress", folder / "progress.json", "--no-fusion")[1] == []


def test_single_ranks_then_the_fusion(folder):
    one = [sys.executable, folder / "run.py", "--densify", folder / "densify", "--rank"]
    for rank in (2, 1, 2):
        assert subprocess.run([*one, str(rank)], capture_output=True).returncode == 0
    calls = [json.loads(line) for line in (folder / "calls.jsonl").read_text().splitlines()]
    assert scenes(calls) == ["clusters/1.mvs", "clusters/0.mvs"] and not (folder / "report.json").exists()
    _, calls, report = run(folder, "--stop-at", "0")
    assert scenes(calls) == ["fusing.mvs"] and sorted(report) == ["k0", "k1"]
    assert (folder / "fuse.txt").read_text() == "0 1\n1 0\n"


def test_a_single_rank_that_is_not_as_planned_fails(folder):
    make(folder, k1=[])
    done = subprocess.run([sys.executable, folder / "run.py", "--densify", folder / "densify", "--rank", "2"], capture_output=True, text=True)
    assert done.returncode == 1 and "no depth map" in done.stdout


def of_a_stranger(folder):
    """What somebody else may leave here, by name."""
    row = dict(key="k0", digest="a", rank=1, problems=[], filled=10**400, seconds=1)
    return {
        "folder for fuse.txt": lambda: (folder / "fuse.txt").mkdir(),
        "folder for fused.ply": lambda: (folder / "fused.ply").mkdir(),
        "folder for a map": lambda: (folder / "depth0010.dmap/x").mkdir(parents=True),
        "folder for a log": lambda: (folder / "DensifyPointCloud-x.log").mkdir(),
        "list for run.json": lambda: (folder / "run.json").write_text("[]"),
        "no clusters": lambda: (folder / "run.json").write_text('{"clusters": [[]]}'),
        "number without a float": lambda: [(folder / "unfinished/0010-a").mkdir(parents=True), (folder / "unfinished/0010-a/row.json").write_text(json.dumps(row)), (folder / "report.json").write_text(json.dumps({"clusters": [row]}))],
    }


@pytest.mark.parametrize("what", of_a_stranger(Path()))
def test_what_a_stranger_left_is_no_traceback(folder, what):
    of_a_stranger(folder)[what]()
    done, _, _ = run(folder)
    assert "Traceback" not in done.stderr and (done.returncode == 0 or done.stderr.startswith("error: ") and done.returncode == 1), done.stderr


def test_a_full_disk_loses_nothing_and_leaves_no_draft(folder):
    run(folder)
    before = {name: (folder / name).read_bytes() for name in ("report.json", "fused.ply")}
    limited = "import resource, sys, runpy; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100)); sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    done, _, _ = run(folder, program=("-c", limited, "run.py"))
    assert done.returncode == 1 and done.stderr.startswith("error: ") and "Traceback" not in done.stderr, done.stderr
    assert not list(folder.glob("*.tmp")) and before == {name: (folder / name).read_bytes() for name in before}


@pytest.mark.parametrize("entry", ["", ".", "images"])
def test_no_program_of_this_folder_is_started(folder, entry):
    program = folder / entry / "DensifyPointCloud"
    program.write_text("#!/bin/sh\ntouch started\n")
    program.chmod(0o755)
    environment = {**os.environ, "PATH": f"{entry}{os.pathsep}/usr/bin"}
    done = subprocess.run([sys.executable, "-I", "run.py"], env=environment, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 1 and "no program" in done.stderr and not list(folder.rglob("started"))
