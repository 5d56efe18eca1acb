"""integrations/openmvs/run.py with a stand-in for DensifyPointCloud that does what a file tells it to."""

import json
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

RUNNER = Path(__file__).resolve().parents[2] / "integrations/openmvs/run.py"

STAND_IN = '''#!{python}
import json, struct, sys
from pathlib import Path
if "--help" in sys.argv:
    print("--tower-mode"); sys.exit(0)
here = Path(sys.argv[sys.argv.index("-w") + 1])
with open(here / "calls.jsonl", "a") as log:
    log.write(json.dumps(sys.argv[1:]) + "\\n")
scene = sys.argv[sys.argv.index("-i") + 1]
if scene == "fusing.mvs":
    data = (here / scene).read_bytes()
    for key in ("k0", "k1", "k2"):
        at = data.index(b"images/" + key.encode()) + len("images/k0") + 8
        if data[at + 8 : at + 12] != b"\\xff" * 4 and not (here / "images" / key).exists():
            print(f"06:04:49 [App     ] error: failed reloading image '{{here}}/images/{{key}}'")
            sys.exit(1)
    if (here / "no-points").exists():
        print("06:04:49 [App     ] error: out of luck")
        sys.exit(0)
    (here / "fusing-done.ply").write_bytes(b"ply\\nelement vertex 42\\nend_header\\n")
    (here / "fusing-done.mvs").write_bytes(data)
for made in json.loads((here / "made.json").read_text()).get(scene, []):
    ids, (least, greatest), depth = made["ids"], made["range"], made["depth"]
    head = b"DR" + bytes([3, 0]) + struct.pack("<4I2f", 4, 4, 4, 4, least, greatest)
    head += struct.pack("<H", 1) + b"a" + struct.pack(f"<I{{len(ids)}}I", len(ids), *ids) + bytes(21 * 8)
    planes = struct.pack("<16f", *[depth] * 16) + bytes(16 * 12)
    (here / f"depth{{ids[0]:04d}}.dmap").write_bytes(head + planes[: made.get("bytes")])
    if "bytes" in made:
        print("Killed")
        sys.exit(137)
'''


@pytest.fixture
def folder(tmp_path):
    shutil.copy(RUNNER, tmp_path / "run.py")
    rows = [dict(rank=i + 1, scene=f"clusters/{i}.mvs", key=f"k{i}", id=10 + i, partner_ids=[1, 2], share=(i + 1) / 3, depths=[100, 200]) for i in range(3)]
    (tmp_path / "clusters").mkdir()
    for row in rows:
        (tmp_path / row["scene"]).write_text(row["key"])
    # The middle of a scene as it matters here: name, no mask, platform, camera, pose, id of each image.
    image = lambda name: struct.pack("<Q", len(name)) + name.encode() + struct.pack("<Q4I", 0, 0, 0, 7, 1)
    (tmp_path / "fuse.mvs").write_bytes(b"MVSI" + b"".join(image(f"images/{row['key']}") for row in rows))
    (tmp_path / "images").mkdir()
    for row in rows:
        (tmp_path / "images" / row["key"]).touch()
    run = dict(clusters=rows, overlaps=[[1, 2], [0, 2], [0, 1]], maps_per_point=2, resolution=400)
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


def run(folder, *options):
    (folder / "calls.jsonl").unlink(missing_ok=True)
    done = subprocess.run([sys.executable, folder / "run.py", "--densify", folder / "densify", *options], capture_output=True, text=True)
    calls = [json.loads(line) for line in (folder / "calls.jsonl").read_text().splitlines()] if (folder / "calls.jsonl").exists() else []
    return done, calls, {row["key"]: row for row in json.loads((folder / "report.json").read_text())["clusters"]}


def scenes(calls):
    return [call[call.index("-i") + 1] for call in calls]


def test_in_rank_order_then_fused_and_resumed(folder):
    done, calls, report = run(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert scenes(calls) == ["clusters/0.mvs", "clusters/1.mvs", "clusters/2.mvs", "fusing.mvs"]
    assert all(not row["problems"] for row in report.values())
    assert scenes(run(folder)[1]) == ["fusing.mvs"]


def test_openmvs_silent_no_map(folder):
    make(folder, k1=[])
    done, _, report = run(folder)
    assert done.returncode == 1 and report["k1"]["problems"] == ["no depth map"]
    assert (folder / "fuse.txt").read_text() == "0 2\n2 0\n"


def test_partners_ranges_and_empty_maps_are_checked(folder):
    make(folder, k0=[dict(ids=[10, 1], range=[90, 220], depth=1)], k1=[dict(ids=[11, 1, 2], range=[0.1, 100], depth=1)], k2=[dict(ids=[12, 1, 2], range=[90, 220], depth=0)])
    done, _, report = run(folder)
    assert done.returncode == 1
    assert "partners [1] instead of [1, 2]" in report["k0"]["problems"][0]
    assert "depth range 0.1 to 100" in report["k1"]["problems"][0]
    assert "0.0 % of the pixels" in report["k2"]["problems"][0]


def poses(folder):
    """Of the images of the scene that was fused last."""
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
    """An image that takes no part is not loaded: it costs no memory, and may be missing."""
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
    done, _, _ = run(folder)
    assert done.returncode == 1 and "DensifyPointCloud ended with 0 | error: out of luck; nothing is fused" in done.stdout
    assert (folder / "fused.ply").read_bytes() == before and not list(folder.glob("fusing*"))


def test_openmvs_existing_dmap_kept(folder):
    run(folder)
    (folder / "clusters/1.mvs").write_text("other partners")
    make(folder, k1=[])
    done, calls, report = run(folder)
    assert scenes(calls) == ["clusters/1.mvs", "fusing.mvs"]
    assert not (folder / "depth0011.dmap").exists(), "the map of other partners must not stay"


@pytest.mark.parametrize("older", ["plan", "options"])
def test_a_map_of_an_older_plan_is_not_fused(folder, older):
    """The run ends before it comes to that cluster: the map is there, its row in report.json too."""
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
    """Also where a cluster has a single partner, whose scene keeps the partner out by a score."""
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
