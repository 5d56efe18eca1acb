"""The run.sh of exports, with stubs of the programs that they call: behaviour after a failure, on a second start, and
with maps of an older plan."""
import json
import os
import shlex
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT

pytestmark = pytest.mark.usefixtures("without_pilot")

# Of the stand-ins, without the modules that site adds: it starts in a third of the time.
INTERPRETER = f"{sys.executable} -IS"


@pytest.fixture(scope="session")
def plans(viewrank, fixtures, tmp_path_factory):
    """Plans of the same views, by the number of partners; "sizes": with four, at two sizes."""
    options = {4: ("-k", 4, "--budget", 20), 3: ("-k", 3, "--budget", 20), "sizes": ("-k", 4, "--scales", "1,0.5", "--budget", "40%", "--target", "100%")}
    plans = {name: tmp_path_factory.mktemp("runs") / "project" for name in options}
    for name, project in plans.items():
        shutil.copytree(fixtures / "valley", project)
        # Without a pilot the plans for three and four partners begin with the same key views.
        viewrank("plan", project, *options[name], "--confidence", "geometric", "--quiet")
    return plans


class Work:
    """An export with stubs next to it, controlled by environment variables; they record their calls in `calls.txt`."""

    def __init__(self, viewrank, plans, backend, folder, programs):
        self.viewrank, self.plans, self.backend, self.folder = viewrank, plans, backend, folder / backend
        self.bin = folder / "bin"
        self.bin.mkdir()
        for name, text in programs.items():
            (self.bin / name).write_text(text.replace("PYTHON", INTERPRETER))
            (self.bin / name).chmod(0o755)
        self.said = self.export(4)

    def weights(self):
        """Puts the file beside the program that PatchmatchNet's weights are in."""
        (self.bin / "checkpoints").mkdir()
        (self.bin / "checkpoints/params_000007.ckpt").write_text("weights")

    def export(self, partners, *options):
        """What the export says."""
        return self.viewrank("export", self.plans[partners], "--backend", self.backend, "--out", self.folder, *options).stdout

    def clusters(self):
        (record,) = [path for path in self.folder.rglob("export.json")]
        return json.loads(record.read_text())["clusters"]

    def halves(self):
        """The key views that are matched at half the size."""
        halves = {cluster["key"]["target"] for cluster in self.clusters() if cluster["scale"] == 0.5}
        assert halves and len(halves) < len(self.clusters()), "the plan has both sizes"
        return halves

    def targets(self):
        return [cluster["key"]["target"] for cluster in self.clusters()]

    def partners(self):
        """How many each key view has."""
        return {cluster["key"]["target"]: len(cluster["partners"]) for cluster in self.clusters()}

    def run(self, *options, script="run.sh", **environment):
        """How the script ends, and the calls that it makes."""
        log = self.folder / "calls.txt"
        log.unlink(missing_ok=True)
        environment = {"PATH": f"{self.bin}:/usr/bin:/bin", **environment}
        done = subprocess.run([self.folder / script, *map(str, options)], env=environment, capture_output=True, text=True, cwd="/")
        return done, log.read_text().splitlines() if log.exists() else []


@pytest.fixture
def work(viewrank, plans, tmp_path):
    return lambda backend, programs: Work(viewrank, plans, backend, tmp_path, programs)


# COLMAP

COLMAP = """#!PYTHON
# Makes the maps of its list that are not there, as large as run.json says for viewrank. MAPS: is killed after so many. DURING: a command that is run when the list is read.
# MADE: JSON by map and by "fusion" of what is made otherwise.
import json, os, subprocess, sys
from pathlib import Path
words = sys.argv[1:]
value = lambda option: words[words.index(option) + 1]
workspace = Path(value("--workspace_path"))
log = open(os.environ.get("CALLS", workspace / "calls.txt"), "a")
otherwise = json.loads(os.environ.get("MADE", "{}"))
if words[0] != "patch_match_stereo":
    names = (workspace / "stereo/fusion.cfg").read_text().split()
    kind = value("--input_type")
    for name in names if "CALLS" in os.environ else []:
        assert (workspace / "images" / name).exists() and all((workspace / f"stereo/{of}/{name}.{kind}.bin").exists() for of in ("depth_maps", "normal_maps")), name
    print(words[0], *names, *words[5:9], file=log) if "CALLS" in os.environ else print(words[0], file=log)
    if otherwise.get("fusion", 3) is not None:
        cloud = value("--output_path")
        Path(cloud).open("x").write("ply\\nformat ascii 1.0\\nelement vertex %d\\nproperty float x\\nend_header\\n" % otherwise.get("fusion", 3))
        Path(cloud + ".vis").open("x").write("views")
    sys.exit(0)
kind = "geometric" if value("--PatchMatchStereo.geom_consistency") == "1" else "photometric"
path = Path(value("--config_path")) if "--config_path" in words else workspace / "stereo/patch-match.cfg"
lines = [line for line in path.read_text().splitlines() if line[0] != "#"]
rows = workspace / "../../run.json"
sizes = {row["problem"]["reference"]: row["size"] for row in json.loads(rows.read_text())["maps"]} if workspace.is_absolute() and rows.exists() else {}
if "DURING" in os.environ:
    subprocess.run(os.environ["DURING"], shell=True, check=True)
left = int(os.environ.get("MAPS", 1000))
for name, sources in zip(lines[::2], lines[1::2]):
    maps = [workspace / f"stereo/{folder}/{name}.{kind}.bin" for folder in ("depth_maps", "normal_maps")]
    if all(path.exists() for path in maps):
        continue
    if left == 0:
        maps[0].write_bytes(b"2&2&1&cut off")
        sys.exit(137)
    left -= 1
    assert all((workspace / "images" / image.strip()).exists() for image in [name, *sources.split(",")])
    for channels, path in zip((1, 3), maps):
        width, height = otherwise.get("size", sizes.get(name, (2, 2)))
        made = b"%d&%d&%d&" % (width, height, channels) + bytes(4 * width * height * channels)
        if otherwise.get(path.parts[-2], len(made)) is not None:
            path.write_bytes(made[: otherwise.get(path.parts[-2])])
    print(f"{kind} {name} {len(sources.split(','))}", *words[words.index("--PatchMatchStereo.filter") + 2 :] if "CALLS" in os.environ else [], file=log)
"""
RUN = "stereo/viewrank/run.sh"


def maps_made(calls):
    return [call.split()[1] for call in calls if call.startswith(("photometric", "geometric"))]


def partners_used(calls):
    return {call.split()[1]: int(call.split()[2]) for call in calls if "jpg" in call}


@pytest.fixture
def colmap(work):
    return work("colmap", {"colmap": COLMAP})


def kept(done):
    """Returns the number of maps of which the script says that they were made otherwise."""
    return next((int(line.split()[0]) for line in done.stderr.splitlines() if "were made otherwise" in line), 0)


def remove_maps(folder):
    for path in (folder / "stereo").rglob("*.bin"):
        path.unlink()


def test_the_script_computes_in_rank_order_and_keeps_maps_of_an_earlier_plan(colmap):
    keys = colmap.targets()
    done, calls = colmap.run(script=RUN)
    assert done.returncode == 0 and maps_made(calls) == keys and calls[-1] == "stereo_fusion"
    done, calls = colmap.run(script=RUN)
    assert calls == ["stereo_fusion"] and kept(done) == 0
    colmap.export(3)
    both = set(keys) & set(colmap.targets())
    done, calls = colmap.run(script=RUN)
    assert set(maps_made(calls)) == set(colmap.targets()) - both and kept(done) == len(both) > 4
    assert kept(colmap.run(script=RUN)[0]) == len(both), "they are still known for what they are"
    remove_maps(colmap.folder)
    done, calls = colmap.run(script=RUN)
    assert maps_made(calls) == colmap.targets() and kept(done) == 0


def test_maps_of_a_run_that_outlasts_its_plan_are_known(colmap):
    """A plan is exported while COLMAP processes the list of the previous one."""
    earlier = colmap.partners()
    program = os.environ.get("VIEWRANK", ROOT / "target/debug/viewrank")
    words = [program, "export", colmap.plans[3], "--backend", "colmap", "--out", colmap.folder]
    done, calls = colmap.run(script=RUN, DURING=shlex.join(map(str, words)))
    assert partners_used(calls) == earlier
    both = [key for key in colmap.partners() if key in earlier]
    assert len(both) > 4 and kept(colmap.run(script=RUN)[0]) == len(both)


def test_two_runs_do_not_compute_at_once(colmap):
    done, calls = colmap.run(script=RUN, DURING=f"! env -u DURING '{colmap.folder}/{RUN}' 2>said.txt")
    assert done.returncode == 0 and maps_made(calls) == colmap.targets()
    assert (colmap.folder / "said.txt").read_text() == "error: another run.sh or viewrank run computes here\n"


def test_maps_that_a_killed_run_cut_off_are_made_anew(colmap):
    keys = colmap.targets()
    assert maps_made(colmap.run(script=RUN, MAPS="2")[1]) == keys[:2]
    assert maps_made(colmap.run(script=RUN)[1]) == keys[2:]


def test_geometric_maps_and_those_that_they_need(colmap):
    colmap.export(4, "--geometric", "on")
    done, calls = colmap.run(script=RUN)
    made = [call.split()[0] for call in calls]
    keys = colmap.targets()
    assert done.returncode == 0 and made.count("geometric") == len(keys) < made.count("photometric")
    assert colmap.run(script=RUN)[1] == ["stereo_fusion"]
    colmap.export(4)
    assert kept(colmap.run(script=RUN)[0]) == len(keys), "a geometric pass cannot start from filtered maps, nor the other way round"


@pytest.mark.parametrize("words", [["--rank", "1"], ["--fuse"], ["--help"], [""]])
def test_a_script_with_options_computes_nothing(colmap, words):
    done, calls = colmap.run(*words, script=RUN)
    assert done.returncode == 2 and "viewrank run has --rank" in done.stderr and calls == []


# Gipuma

GIPUMA = """#!/bin/sh
# A folder named by the time and the key view less four characters, as main.cpp makes it. FAIL: key views that it fails at.
case " ${FAIL:-} " in *" $1 "*) exit 1 ;; esac
echo "$*" | sed 's/ -.*//' >> calls.txt
while [ "$1" != -output_folder ]; do
    case $1 in -*) ;; *) [ -n "${key:-}" ] || key=$1; test -s "images/$1" && test -s "p/$1.P" || exit 1; count=$((${count:-0} + 1)) ;; esac
    shift
    [ "$1" != -images_folder ] || shift 2
    [ "$1" != -p_folder ] || shift 2
done
folder=$2$(date +%Y%m%d_%H%M%S)_${key%????}
mkdir "$folder" && echo "$count" > "$folder/disp.dmb" && echo > "$folder/normals.dmb"
"""


def fusible(folder):
    """What fusibile takes (main.cpp): folders 2..._..._IMAGE, and of each how many views its map was made of."""
    taken = {}
    for path in (folder / "results").iterdir():
        if path.name.count("_") >= 2 and path.name[0] == "2":
            image = path.name.split("_", 2)[2] + ".jpg"
            assert image not in taken and (folder / "images" / image).exists() and (folder / "p" / f"{image}.P").exists()
            taken[image] = int((path / "disp.dmb").read_text())
    return taken


def test_gipuma_timestamp_folder(work):
    """fusibile takes all folders that there are: one for each key view of the plan in force, whatever was computed before."""
    gipuma = work("gipuma", {"gipuma": GIPUMA})
    keys = gipuma.targets()
    done, calls = gipuma.run(FAIL=keys[0])
    assert done.returncode == 1 and len(calls) == len(keys) - 1 and f"_{keys[0][:-4]} failed" in done.stderr, "the others are tried"
    assert set(fusible(gipuma.folder)) == set(keys[1:])
    done, calls = gipuma.run()
    assert done.returncode == 0 and [call.split()[0] for call in calls] == keys[:1], "a second start computes what is missing"
    assert fusible(gipuma.folder) == {key: 1 + count for key, count in gipuma.partners().items()}
    gipuma.export(4, "--budget", "2")
    assert gipuma.run()[1] == [] and set(fusible(gipuma.folder)) == set(keys[:2])
    gipuma.export(3)
    assert len(gipuma.run()[1]) == len(gipuma.targets()) and fusible(gipuma.folder) == {key: 1 + count for key, count in gipuma.partners().items()}
    gipuma.export(4)
    assert gipuma.run()[1] == [] and fusible(gipuma.folder) == {key: 1 + count for key, count in gipuma.partners().items()}, "back from older/"


# MVE

SCENE = """#!PYTHON
# Opens every view of the scene that it is given, as Scene::init_views. FAIL: images that it fails at. MADE: JSON of what is made otherwise.
import json, os, struct, sys
from pathlib import Path
otherwise = json.loads(os.environ.get("MADE", "{}"))
scene = Path(sys.argv[SCENE])
run = scene / "run.json"
rows = {row["view"]: row for row in json.loads((run if run.exists() else scene / "../../run.json").read_text())["maps"]}
views = {}
for view in sorted((scene / "views").glob("*.mve")):
    values = dict(line.split(" = ") for line in (view / "meta.ini").read_text().splitlines() if " = " in line)
    assert values["id"] not in views
    views[values["id"]] = view, values["name"]
option = lambda letter: next(word[2:] for word in sys.argv if word.startswith(letter))
note = lambda *words: print(*words, file=open(os.environ.get("CALLS", scene / "calls.txt"), "a"))
"""
# The depths of a map are the id of its image.
DMRECON = SCENE.replace("SCENE", "-1") + """
features = (scene / "synth_0.out").read_text().splitlines()[1]
view, name = views[option("-m")]
if name in os.environ.get("FAIL", "").split() or not (view / "undistorted.jpg").exists():
    sys.exit(1)
note(name)
width, height = otherwise.get("size", rows["views/" + view.name]["size"])
depths = struct.pack("<f", otherwise.get("depth", int(view.stem[-8:])))
made = b"\\x89MVE_IMAGE\\n" + struct.pack("<4i", width, height, 1, 9) + width * height * depths
if "map" not in otherwise or otherwise["map"]:
    (view / f"depth-L{option('-s')}.mvei").write_bytes(made[: otherwise.get("map")])
if option("-s") != "0":
    (view / f"undist-L{option('-s')}.png").write_bytes(b"PNG")
os.system(os.environ.get("DURING", "true"))
"""
SCENE2PSET = SCENE.replace("SCENE", "-2") + """
joined = []
level = option("-F")
wanted = next((word[2:].split(",") for word in sys.argv if word.startswith("-v")), views)
for view, name in (views[id] for id in sorted(wanted, key=int)):
    map, picture = view / f"depth-L{level}.mvei", view / ("undistorted.jpg" if level == "0" else f"undist-L{level}.png")
    if map.exists():
        assert struct.unpack_from("<f", map.read_bytes(), 27) == (int(view.stem[-8:]),) and picture.exists()
        joined.append(name)
note("joined", *joined)
if otherwise.get("fusion", 3) is not None:
    Path(scene, sys.argv[-1]).open("x").write("ply\\nformat ascii 1.0\\nelement vertex %d\\nproperty float x\\nend_header\\n" % otherwise.get("fusion", 3))
"""


@pytest.fixture
def mve(work):
    return work("mve", {"dmrecon": DMRECON, "scene2pset": SCENE2PSET})


def key_names(export):
    return [cluster["key"]["name"] for cluster in export.clusters()]


def test_mve_tries_every_cluster_and_joins_what_there_is(mve):
    names = key_names(mve)
    done, calls = mve.run(FAIL=names[0])
    assert done.returncode == 1 and calls == [*names[1:], " ".join(["joined", *names[1:]])] and "failed" in done.stderr
    done, calls = mve.run()
    assert done.returncode == 0 and calls == [names[0], " ".join(["joined", *names])], done.stderr
    mve.export(4, "--budget", "2")
    done, calls = mve.run()
    assert done.returncode == 0 and calls == [" ".join(["joined", *names[:2]])], done.stderr
    mve.export(4)
    assert mve.run()[1] == [" ".join(["joined", *names])], "maps of before came back"
    mve.export(3)
    names = key_names(mve)
    done, calls = mve.run(FAIL=names[1])
    assert calls[-1].split()[1:] == [name for name in names if name != names[1]], "no map of other partners in its place"
    assert mve.run()[1][:-1] == names[1:2]


def test_mve_keeps_maps_that_nobody_marked_but_none_that_a_killed_run_left(mve):
    names = key_names(mve)
    mine, cut = (mve.folder / row["view"] / f"depth-L{row['level']}.mvei" for row in json.loads((mve.folder / "run.json").read_text())["maps"][:2])
    marks = [line.split()[1] for line in (mve.folder / "run.sh").read_text().splitlines() if " bundles/" in line]
    (image_id,) = [int(path.parent.name[5:13]) for path in [mine]]
    mine.write_bytes(b"\x89MVE_IMAGE\n" + struct.pack("<4if", 1, 1, 1, 9, image_id))
    before = mine.read_bytes()
    cut.write_bytes(b"cut off")
    (mve.folder / "done").mkdir()
    (mve.folder / "done" / marks[1]).write_text("unfinished\n")
    done, calls = mve.run()
    assert calls == [*names[1:], " ".join(["joined", *names])] and done.returncode == 0, done.stderr
    assert "1 depth maps were made otherwise" in done.stderr and mine.read_bytes() == before


def test_mve_marks_no_empty_map_and_keeps_the_cloud_of_before(mve):
    mve.run()
    before = (mve.folder / "fused.ply").read_bytes()
    mve.export(3)
    done, calls = mve.run(MADE='{"depth": 0, "fusion": 0}')
    assert done.returncode == 1 and (mve.folder / "fused.ply").read_bytes() == before
    assert set(mve.run()[1]) >= set(key_names(mve)), "none counts as made"


def test_mve_joins_the_maps_of_each_size(mve):
    mve.run()
    mve.export("sizes")
    done, calls = mve.run()
    assert done.returncode == 0, done.stderr
    names = {cluster["key"]["target"]: cluster["key"]["name"] for cluster in mve.clusters()}
    halves = {names[target] for target in mve.halves()}
    assert [set(call.split()[1:]) for call in calls[-2:]] == [set(names.values()) - halves, halves], "each view has one map, of its size"
    assert (mve.folder / "fused_half.ply").exists()
    mve.export(4)
    assert mve.run()[0].returncode == 0
    assert not (mve.folder / "fused_half.ply").exists(), "no cloud of another plan beside the new one"


# What is called once per cluster

FAILING = """#!PYTHON
# Notes its call. FAIL: a word of calls that fail.
import os, sys
from pathlib import Path
call = Path(sys.argv[0]).name + " " + " ".join(sys.argv[1:])
print(call, file=open("calls.txt", "a"))
if os.environ.get("FAIL", "-") in sys.argv:
    sys.exit(1)
if "GeomImage" in sys.argv:  # the pattern is the name of the master, and of the folder
    Path("MM-Malt-Img-" + sys.argv[3].rsplit(".", 1)[0]).mkdir(exist_ok=True)
"""

# Depths of 1, uncompressed.
ALICEVISION = """#!PYTHON
# FAIL: a word of calls that fail. MADE: JSON of what is made otherwise.
import json, os, struct, sys
from pathlib import Path
otherwise = json.loads(os.environ.get("MADE", "{}"))
value = lambda option: sys.argv[sys.argv.index(option) + 1]
note = lambda *words: print(*words, file=open(os.environ.get("CALLS", "calls.txt"), "a"))
scene = Path(value("-i"))
content = json.loads(scene.read_text())
views = sorted(int(view["viewId"]) for view in content["views"])
assert {int(pose["poseId"]) for pose in content["poses"]} == set(views)
assert {int(seen["observationId"]) for landmark in content["structure"] for seen in landmark["observations"]} <= set(views)
if os.environ.get("FAIL", "-") in sys.argv:
    sys.exit(1)


def exr(width, height, depth):
    text = lambda name, kind, data: name.encode() + b"\\0" + kind.encode() + b"\\0" + struct.pack("<I", len(data)) + data
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = struct.pack("<2I", 20000630, 2) + text("channels", "chlist", b"Y\\0" + struct.pack("<4I", 2, 0, 1, 1) + b"\\0") + text("compression", "compression", b"\\0")
    head += text("dataWindow", "box2i", window) + text("displayWindow", "box2i", window) + text("lineOrder", "lineOrder", b"\\0")
    head += text("pixelAspectRatio", "float", struct.pack("<f", 1)) + text("screenWindowCenter", "v2f", bytes(8)) + text("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\\0"
    lines = [struct.pack("<2I", row, 4 * width) + width * struct.pack("<f", depth) for row in range(height)]
    first = len(head) + 8 * height
    return head + b"".join(struct.pack("<Q", first + row * len(lines[0])) for row in range(height)) + b"".join(lines)


if "--rangeStart" in sys.argv:
    view = views[int(value("--rangeStart"))]
    assert Path(value("--imagesFolder"), f"{view}.jpg").exists()
    row = next(row for row in json.loads((scene.parent.parent / "run.json").read_text())["maps"] if row["view"] == view)
    note(view)
    made = exr(*otherwise.get("size", row["size"]), otherwise.get("depth", 1))
    if "map" not in otherwise or otherwise["map"]:
        Path(value("-o"), f"{view}_depthMap.exr").write_bytes(made[: otherwise.get("map")])
    Path(value("-o"), f"{view}_simMap.exr").write_bytes(made)
    os.system(os.environ.get("DURING", "true"))
elif "-o" in sys.argv:  # the filtering: Fuser.cpp keeps the nmodMap that it finds
    for view in views:
        assert Path(value("--depthMapsFolder"), f"{view}_depthMap.exr").exists() and Path(value("--depthMapsFolder"), f"{view}_simMap.exr").exists()
        Path(value("-o"), f"{view}_nmodMap.png").open("x").write("counts")
else:  # the meshing; -o would be short for two options
    assert all(Path(value("--depthMapsFolder"), f"{view}_nmodMap.png").exists() for view in views)
    note("joined", *views)
    if otherwise.get("fusion", 3) is not None:
        for option in ("--output", "--outputMesh"):
            Path(value(option)).open("x").write("points" if otherwise.get("fusion", 3) else "")
"""


@pytest.fixture
def alice(work):
    return work("alicevision", {f"aliceVision_{name}": ALICEVISION for name in ("depthMapEstimation", "depthMapFiltering", "meshing")})


def test_alicevision_tries_every_cluster_and_joins_them_when_all_are_there(alice):
    keys = alice.targets()
    joined = " ".join(["joined", *sorted(keys, key=int)])
    done, calls = alice.run(FAIL="clusters/0001.sfm")
    assert done.returncode == 1 and calls == keys[1:] and f"depthMaps/{keys[0]}_depthMap.exr failed" in done.stderr, done.stderr
    done, calls = alice.run()
    assert done.returncode == 0 and calls == [keys[0], joined], done.stderr
    mesh = alice.folder / "mesh.obj"
    mesh.write_text("of before")
    done, calls = alice.run(FAIL="keys.sfm")
    assert done.returncode == 1 and "the fusion failed" in done.stderr and not calls and mesh.read_text() == "of before"
    alice.export(3)
    keys = alice.targets()
    done, calls = alice.run(FAIL="clusters/0002.sfm")
    assert done.returncode == 1 and calls == [keys[0], *keys[2:]] and not list(alice.folder.glob("joining*"))
    done, calls = alice.run()
    assert done.returncode == 0 and calls[0] == keys[1] and mesh.read_text() == "points"


def test_sure_tries_every_cluster(work):
    sure = work("sure", {"sure": FAILING})

    def projects(folder="projects"):
        return {path.name for path in (sure.folder / folder).iterdir() if path.name != "my_dsm"}

    def keys():
        return {path.name for path in (sure.folder / "clusters").iterdir()}

    first = min(keys())
    done, calls = sure.run(FAIL=f"projects/{next(name for name in project_names(sure) if name.startswith(first))}")
    assert done.returncode == 1 and len(calls) == 2 * len(sure.targets()) - 1
    done, calls = sure.run()
    assert done.returncode == 0 and len(calls) == 2 and f"projects/{first}-" in calls[0]
    assert {name.split("-")[0] for name in projects()} == keys()
    # Products of another size, or of views that are no key views now, are not joined with the new ones.
    of_first = projects()
    for name in of_first:
        (sure.folder / "projects" / name / "points.las").write_text("full size")
    mine = sure.folder / "projects/my_dsm/dsm.tif"
    mine.parent.mkdir()
    mine.write_text("mine")
    sure.export("sizes")
    done, calls = sure.run()
    assert done.returncode == 0 and projects() == set(project_names(sure)) and len(calls) == 2 * len(projects() - of_first) > 0
    assert of_first & projects() and projects("older") == of_first - projects() and not sure.run()[1]
    # What was finished comes back, and the user's own folder stays.
    sure.export(4)
    assert not sure.run()[1] and projects() == of_first and mine.read_text() == "mine"
    assert all((sure.folder / "projects" / name / "points.las").exists() for name in of_first)


def project_names(sure):
    """Names of the projects of the plan."""
    (line,) = [line for line in (sure.folder / "run.sh").read_text().splitlines() if line.startswith("results=")]
    return line.split("'")[1].split()


def test_micmac_tries_every_cluster(work, tmp_path):
    micmac = work("micmac", {"mm3d": FAILING})
    (tmp_path / "Ori-a").mkdir()
    (tmp_path / "Ori-a/Orientation-a.xml").write_text("<x/>")
    first = micmac.targets()[0]
    done, calls = micmac.run(tmp_path / "Ori-a", FAIL=first)
    assert done.returncode == 1 and len(calls) == len(micmac.targets()) and f"{Path(first).stem} failed" in done.stderr
    done, calls = micmac.run(tmp_path / "Ori-a")
    assert done.returncode == 0 and len(calls) == 1 and first in calls[0]
    (tmp_path / "Ori-a/Orientation-a.xml").write_text("<y/>")
    assert len(micmac.run(tmp_path / "Ori-a")[1]) == len(micmac.targets()), "other orientations, other maps"


# PatchmatchNet's eval.py, which is strict about the files of every view in its list. MADE: JSON of what is made otherwise.
EVAL = """
import json, os, struct, sys
from pathlib import Path
otherwise = json.loads(os.environ.get("MADE", "{}"))
value = lambda option: sys.argv[sys.argv.index(option) + 1]
source, out = Path(value("--input_folder")), Path(value("--output_folder"))
export = next(folder for folder in (source, *source.parents) if (folder / "run.json").exists())
note = lambda *words: print(*words, file=open(os.environ.get("CALLS", export / "calls.txt"), "a"))
assert Path(value("--checkpoint_path")).is_file()
lines = (source / "pair.txt").read_text().splitlines()
pairs = {int(key): [int(view) for view in line.split()[1::2]] for key, line in zip(lines[1::2], lines[2::2])}
assert len(pairs) == int(lines[0])
pairs = {key: others for key, others in pairs.items() if others}
views = {view for key, others in pairs.items() for view in (key, *others)}
for view in views:
    assert (source / f"images/{view:08}.jpg").is_file() and (source / f"cams/{view:08}_cam.txt").read_text().startswith("extrinsic")
run = json.loads((export / "run.json").read_text())
rows = {row["partners"]["key"]: row for row in run["maps"]}
longest = int(value("--image_max_dim")) if "--image_max_dim" in sys.argv else None
files = lambda view: [out / f"{kind}/{view:08}.pfm" for kind in ("depth_est", "confidence")]
if value("--output_type") == "depth":
    for key, others in pairs.items():
        row = rows[key]
        assert len(others) <= int(value("--num_views")) and longest == row["longest"]
        width, height = otherwise.get("size", row["size"])
        for path in files(key):
            path.parent.mkdir(parents=True, exist_ok=True)
            made = b"Pf\\n%d %d\\n-1.000000\\n" % (width, height) + struct.pack("<f", otherwise.get("depth", 1)) * (width * height)
            if "map" not in otherwise or otherwise["map"]:
                path.write_bytes(made[: otherwise.get("map")])
        note(key)
    os.system(os.environ.get("DURING", "true"))
else:
    assert longest == run["fused_at"] and int(value("--geo_mask_thres")) == 1
    for view in views:
        width, height = rows[view]["fused_size"]
        for path in files(view):
            head, size, _, floats = path.read_bytes().split(b"\\n", 3)
            assert (head, size, len(floats)) == (b"Pf", b"%d %d" % (width, height), 4 * width * height), path
    note("joined", *pairs)
    if otherwise.get("fusion", 3) is not None:
        (out / "fused.ply").open("x" if "MADE" in os.environ else "w").write("ply\\nformat ascii 1.0\\nelement vertex %d\\nproperty float x\\nend_header\\n" % otherwise.get("fusion", 3))
"""


def test_patchmatchnet_computes_all_and_joins_them(work):
    net = work("patchmatchnet", {"eval.py": EVAL})
    net.weights()
    keys = net.targets()
    joined = lambda: " ".join(["joined", *(lines[0] for lines in zip(*[iter((net.folder / "fuse/pair.txt").read_text().splitlines()[1:])] * 2) if lines[1].split()[1:])])
    for _ in range(2):
        done, calls = net.run(PATCHMATCHNET=str(net.bin))
        assert done.returncode == 0 and calls == [*keys, joined()], done.stderr
    done, calls = net.run()
    assert done.returncode != 0 and "PATCHMATCHNET" in done.stderr and not calls
    net.export("sizes")
    halves = net.halves()
    done, calls = net.run(PATCHMATCHNET=str(net.bin))
    assert done.returncode == 0 and "viewrank run PROJECT --fuse joins them" in done.stdout, done.stderr
    assert calls == sorted(net.targets(), key=lambda key: (key in halves, net.targets().index(key)))
