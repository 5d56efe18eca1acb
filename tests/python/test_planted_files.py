"""Files that somebody else has planted in an export or a workspace, where the scripts look for their own: nothing of the user's is written, moved or removed, and nothing reaches
the terminal that it would obey."""
import json
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import ROOT
from test_export_formats import SIDE_FILE
from test_openmvs_runner import STAND_IN
from test_run_scripts import COLMAP, DMRECON, RUN, SCENE2PSET, Work, plans, work  # noqa: F401 (fixtures)

pytestmark = pytest.mark.usefixtures("without_pilot")

ESCAPE = "\x1b]0;owned\x07"


# run_clusters.sh


@pytest.mark.parametrize("target", ["/", ".", "pipe"])
def test_a_known_link_that_leads_to_no_file_is_refused(work, target, tmp_path):  # noqa: F811
    mve = work("mve", {"dmrecon": DMRECON, "scene2pset": SCENE2PSET})
    picture = sorted(mve.folder.glob("views/*/undistorted.jpg"))[0]
    picture.unlink()
    os.mkfifo(tmp_path / "pipe")
    picture.symlink_to(tmp_path / "pipe" if target == "pipe" else target)
    done, calls = mve.run()
    assert done.returncode == 1 and "undistorted.jpg" in done.stderr and not calls
    picture.unlink()
    picture.symlink_to(tmp_path / "missing.jpg")
    assert mve.run()[1], "the other clusters are computed without the picture"


# Programs that write into the files that are there

WRITES = """#!PYTHON
import os, sys
from pathlib import Path
print("called", file=open("calls.txt", "a"))
for folder, _, names in os.walk("."):
    for name in names:
        if name.startswith("product"):
            Path(folder, name).write_text("of the program")
"""


@pytest.mark.parametrize("backend, programs", [("micmac", ["mm3d"]), ("sure", ["sure"]), ("mve", ["dmrecon", "scene2pset"])])
def test_no_program_writes_into_files_that_have_other_names(work, tmp_path, backend, programs):  # noqa: F811
    export = work(backend, dict.fromkeys(programs, WRITES))
    (tmp_path / "Ori-a").mkdir()
    (tmp_path / "Ori-a/Orientation-a.xml").write_text("<x/>")
    folder = {"micmac": "MM-Malt-Img-a", "sure": "projects/mine", "mve": "log"}[backend]
    (export.folder / folder).mkdir(parents=True)
    planted = [export.folder / name for name in ("product.log", f"{folder}/product \\ x.tif")]
    outside = [tmp_path / f"outside{i}" for i in range(len(planted))]
    for path, user in zip(planted, outside):
        user.write_text(SECRET)
        user.chmod(0o640)
        os.link(user, path)
    done, calls = export.run(*([tmp_path / "Ori-a"] if backend == "micmac" else []))
    assert calls and [path.read_text() for path in planted] == ["of the program"] * 2, done.stderr
    assert all(path.read_text() == SECRET and path.stat().st_nlink == 1 for path in outside)
    assert all(path.stat().st_mode == user.stat().st_mode for path, user in zip(planted, outside))


@pytest.mark.parametrize("tool", ["mktemp", "cp", "mv"])
def test_messages_of_tools_do_not_reach_the_terminal(work, tmp_path, tool):  # noqa: F811
    """They name files as they are."""
    refuses = f"#!/bin/sh\nprintf '{tool}: %s\\n' \"$*\" >&2\nexit 1\n"
    sure = work("sure", {"sure": WRITES, tool: refuses})
    (sure.folder / f"product{ESCAPE}").write_text("x")
    os.link(sure.folder / f"product{ESCAPE}", tmp_path / "outside")
    done, calls = sure.run()
    assert done.returncode == 1 and not calls and "error: failed: " in done.stderr and "\x1b" not in done.stderr, done.stderr


def test_a_folder_whose_name_ends_in_a_line_break(work):  # noqa: F811
    """The script runs there, not in its neighbour without the line break, however it is started."""
    pmvs = work("pmvs", {"pmvs2": "#!/bin/sh\npwd -P; exit 1\n"})
    folder = pmvs.folder.with_name("pmvs\n")
    shutil.copytree(pmvs.folder, folder, symlinks=True)
    environment = {"PATH": f"{pmvs.bin}:/usr/bin:/bin"}
    ways = [(["sh", folder / "run.sh"], "/"), (["sh", "run.sh"], folder), (["./run.sh"], folder), (["sh", "pmvs\n/run.sh"], folder.parent)]
    for command, place in ways:
        done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
        assert done.stdout == f"{folder}\n", f"{command}: {done.stdout}{done.stderr}"


@pytest.mark.parametrize("backend, program", [("pmvs", "pmvs2"), ("gipuma", "gipuma"), ("mve", "dmrecon")])
def test_a_list_of_links_lets_no_link_pass(work, tmp_path, backend, program):  # noqa: F811
    """Those that viewrank made are in the script."""
    export = work(backend, {program: "#!/bin/sh\necho called >> calls.txt\n"})
    (tmp_path / "outside").write_text(SECRET)
    (export.folder / "other.jpg").symlink_to(tmp_path / "outside")
    (export.folder / "links.txt").write_text("./other.jpg\n")
    done, calls = export.run()
    assert done.returncode == 1 and "error: ./other.jpg: not made by viewrank" in done.stderr and not calls
    (export.folder / "other.jpg").unlink()
    assert export.run()[1], "a list by itself is in nobody's way"


# COLMAP


@pytest.fixture
def colmap(work):  # noqa: F811
    return work("colmap", {"colmap": COLMAP})


@pytest.mark.parametrize("list", ["stereo/viewrank/marks.tsv", "stereo/patch-match.cfg"])
def test_lists_of_colmap_that_are_too_long_are_not_read(colmap, list):
    os.truncate(colmap.folder / list, 1 << 32)
    done, calls = colmap.run(script=RUN)
    assert done.returncode == 1 and f"{list}: longer than the 64 MiB" in done.stderr and not calls


HASH = "0123456789abcdef"


@pytest.mark.parametrize("line", [f"{HASH}\t{HASH}\t../../user.bin", f"{HASH}\t{HASH}\ta/../../user.bin", f"{HASH}\t{HASH}\t/user.bin", f"{HASH}\t{HASH}\t..", f"{HASH}\t{HASH}\t",
                                  f"../{HASH}\t{HASH}\ta.bin", f"\t{HASH}\ta.bin", f"{HASH}\t$(id)\ta.bin", "a.bin", f"{HASH.upper()}\t{HASH}\ta.bin"])
def test_marks_lead_to_no_maps_elsewhere(colmap, line):
    marks = colmap.folder / "stereo/viewrank/marks.tsv"
    marks.write_text("".join(marks.read_text().splitlines(keepends=True)[1:]) + line + "\n")
    (colmap.folder / "user.bin").write_bytes(b"user")
    done, calls = colmap.run(script=RUN)
    assert done.returncode == 1 and "marks.tsv" in done.stderr and not calls
    assert (colmap.folder / "user.bin").read_bytes() == b"user"


def test_more_marks_than_the_plan_has_are_not_looked_at(colmap):
    marks = colmap.folder / "stereo/viewrank/marks.tsv"
    with open(marks, "a") as file:
        file.write(marks.read_text().splitlines(keepends=True)[0])
    done, calls = colmap.run(script=RUN)
    assert done.returncode == 1 and "marks.tsv" in done.stderr and not calls
    assert not (colmap.folder / "stereo/viewrank/done").exists()


@pytest.mark.parametrize("name", ["../../user", "/user", "a/../../user"])
def test_names_of_key_views_lead_to_no_maps_elsewhere(colmap, name):
    path = colmap.folder / "stereo/patch-match.cfg"
    path.write_text(f"{path.read_text()}{name}\na.jpg\n")
    done, calls = colmap.run(script=RUN)
    assert done.returncode == 1 and path.name in done.stderr and not calls


def test_a_mark_that_is_no_hash_is_taken_for_another(colmap):
    colmap.run(script=RUN)
    before = {path: path.read_bytes() for path in (colmap.folder / "stereo").rglob("*.bin")}
    (mark, *_) = sorted((colmap.folder / "stereo/viewrank/done").iterdir())
    mark.write_text("\\033[2J../../etc\n" + ESCAPE)
    done, calls = colmap.run(script=RUN)
    assert done.returncode == 0 and calls == ["stereo_fusion"] and "are kept" in done.stderr and "\x1b" not in done.stderr
    assert {path: path.read_bytes() for path in (colmap.folder / "stereo").rglob("*.bin")} == before, "no mark has a map removed"


# What is printed


def test_tasks_of_a_queue_name_views_without_escape_sequences(viewrank, plans, tmp_path):  # noqa: F811
    project = tmp_path / f"{ESCAPE}project"
    shutil.copytree(plans[4], project, symlinks=True)
    program = tmp_path / "colmap"
    program.write_text("#!/bin/sh\nexit 1\n")
    program.chmod(0o755)
    viewrank("plan", project, "--backend", "colmap", "--budget", "2", "--quiet")
    for which in (["--rank", "1"], ["--rank", "99"], ["--fuse"]):
        done = subprocess.run([viewrank.program, "run", project, "--program", program, *which], capture_output=True, text=True)
        assert "\x1b" not in done.stdout + done.stderr and "\x07" not in done.stderr, done.stderr
        assert done.returncode == {"1": 1, "99": 2}.get(which[-1], 0), done.stderr
    assert len(list((project / "viewrank/dispatch/colmap/locks").iterdir())) == 1, "the lock of the task that failed"


def test_realityscan_names_a_side_file_without_escape_sequences(tmp_path):
    shutil.copy(ROOT / "integrations/realityscan/switch.py", tmp_path)
    (tmp_path / f"xmp/{ESCAPE}").mkdir(parents=True)
    (tmp_path / f"images/{ESCAPE}").mkdir(parents=True)
    (tmp_path / f"xmp/{ESCAPE}/a.xmp").write_text(SIDE_FILE.format(0))
    (tmp_path / "xmp.txt").write_text(f"{ESCAPE}/a.xmp\n")
    (tmp_path / f"images/{ESCAPE}/a.xmp").write_text("a pose")
    done = subprocess.run([sys.executable, tmp_path / "switch.py", tmp_path / "images"], capture_output=True, text=True)
    assert done.returncode == 1 and "a.xmp: holds more" in done.stderr and "\x1b" not in done.stderr


# RealityScan


def test_realityscan_replaces_no_file_of_another_name(tmp_path):
    shutil.copy(ROOT / "integrations/realityscan/switch.py", tmp_path)
    (tmp_path / "xmp").mkdir()
    (tmp_path / "images").mkdir()
    (tmp_path / "xmp/a.xmp").write_text(SIDE_FILE.format(0))
    (tmp_path / "xmp.txt").write_text("a.xmp\n")
    (tmp_path / "images/a.xmp.new").write_text("the user's")
    subprocess.run([sys.executable, tmp_path / "switch.py", tmp_path / "images"], check=True)
    assert {path.name: path.read_text() for path in (tmp_path / "images").iterdir()} == {"a.xmp.new": "the user's", "a.xmp": (tmp_path / "xmp/a.xmp").read_text()}
    assert (tmp_path / "images/a.xmp").stat().st_mode == (tmp_path / "xmp/a.xmp").stat().st_mode


SECRET = "the user's"


@pytest.mark.parametrize("name", ["a.xmp", "b/a.xmp", "b", "xmp.txt"])
@pytest.mark.parametrize("how", ["link", "pipe", "other", "two", "long"])
def test_realityscan_takes_only_side_files_that_viewrank_wrote(tmp_path, name, how):
    shutil.copy(ROOT / "integrations/realityscan/switch.py", tmp_path)
    (tmp_path / "xmp/b").mkdir(parents=True)
    (tmp_path / "images").mkdir()
    (tmp_path / "home").mkdir()
    (tmp_path / "home/secret").write_text(SECRET)
    for listed in ("a.xmp", "b/a.xmp"):
        (tmp_path / "xmp" / listed).write_text(SIDE_FILE.format(0))
    (tmp_path / "xmp.txt").write_text("a.xmp\nb/a.xmp\n")
    path = tmp_path / "xmp.txt" if name == "xmp.txt" else tmp_path / "xmp" / name
    path.rename(tmp_path / "before")
    put = {
        "link": lambda: path.symlink_to(tmp_path / ("home" if name == "b" else "home/secret")),
        "pipe": lambda: os.mkfifo(path),
        "other": lambda: path.write_text(SECRET),
        "two": lambda: path.write_text(SIDE_FILE.format(0) * 2),
        "long": lambda: (path.touch(), os.truncate(path, 1 << 36)),
    }
    put[how]()
    done = subprocess.run([sys.executable, tmp_path / "switch.py", tmp_path / "images"], capture_output=True, text=True, timeout=20)
    assert done.returncode == 1 and done.stderr.startswith("error: ") and not list((tmp_path / "images").iterdir()), done.stderr


def test_realityscan_takes_only_what_is_listed(tmp_path):
    shutil.copy(ROOT / "integrations/realityscan/switch.py", tmp_path)
    (tmp_path / "xmp").mkdir()
    (tmp_path / "images").mkdir()
    for name in ("a.xmp", "planted.xmp", "../images.xmp"):
        (tmp_path / "xmp" / name).write_text(SIDE_FILE.format(1))
    (tmp_path / "xmp.txt").write_text("a.xmp\n")
    command = [sys.executable, tmp_path / "switch.py", tmp_path / "images"]
    assert subprocess.run(command).returncode == 0 and [path.name for path in (tmp_path / "images").iterdir()] == ["a.xmp"]
    (tmp_path / "xmp.txt").write_text("a.xmp\n../images.xmp\n")
    assert subprocess.run(command, capture_output=True).returncode == 1


# OpenMVS


def put(path, how):
    """Puts an odd thing in the place of a record."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    {"pipe": lambda: os.mkfifo(path), "link": lambda: path.symlink_to("/dev/zero"), "long": lambda: (path.touch(), os.truncate(path, 1 << 36))}[how]()


ODD = ["pipe", "link", "long"]


@pytest.fixture
def exported(viewrank, plans, tmp_path):  # noqa: F811
    """An export for OpenMVS with a stub beside it."""
    return Work(viewrank, plans, "openmvs", tmp_path, {"densify": STAND_IN.format(python=sys.executable)})


def run_py(exported):
    command = [sys.executable, exported.folder / "run.py", "--densify", exported.bin / "densify", "--stop-at", "2"]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("how", ODD)
@pytest.mark.parametrize("name", ["run.json", "done"])
def test_odd_records_end_the_run_with_one_error(exported, name, how):
    put(exported.folder / name, how)
    done = run_py(exported)
    assert done.returncode == 1 and done.stderr.startswith("error: ") and len(done.stderr.splitlines()) <= 2, done.stderr


@pytest.mark.parametrize("how", ODD)
@pytest.mark.parametrize("script, record", [("sure/ground.py", "ori/a.ori"), ("metashape/depth_maps.py", "clusters.json")])
def test_odd_records_end_other_scripts_with_one_error(tmp_path, script, record, how):
    shutil.copy(ROOT / "integrations" / script, tmp_path / "script.py")
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules/Metashape.py").touch()
    put(tmp_path / record, how)
    if script == "metashape/depth_maps.py" and how == "long":
        return
    done = subprocess.run([sys.executable, tmp_path / "script.py", tmp_path, "0"], capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": str(tmp_path / "modules")})
    assert done.returncode == 1 and done.stderr.startswith("error: ") and len(done.stderr.splitlines()) == 1, done.stderr


ORIENTATION = "$ImageID\na.jpg\n$IntOri_SensorSize\n600 400\n$IntOri_CameraMatrix\n500 0 300\n0 500 200\n0 0 1\n$ExtOri_RotationMatrix\n1 0 0\n0 -1 0\n0 0 -1\n$ExtOri_TranslationVector\n0 0 100\n"


def test_a_planted_cloud_of_any_number_of_points_is_not_unscaled(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement face 999999999999999\nelement vertex 1\nend_header\n")
    command = [sys.executable, ROOT / "integrations/openmvs/unscale.py", tmp_path / "a.ply", tmp_path / "b.ply", "2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1 and not (tmp_path / "b.ply").exists(), done.stderr


@pytest.mark.parametrize("more", ["", "$IntOri_CameraMatrix\n1 2\n", "$IntOri_CameraMatrix\n" + "nan " * 9, "$IntOri_CameraMatrix\n" + "0 " * 9, "$ExtOri_TranslationVector\n1e999 0 0\n", "$IntOri_SensorSize\n"])
def test_planted_orientations_end_with_one_error(tmp_path, more):
    (tmp_path / "ori").mkdir()
    (tmp_path / "ori/a.ori").write_text(ORIENTATION + more)
    done = subprocess.run([sys.executable, ROOT / "integrations/sure/ground.py", tmp_path, "0"], capture_output=True, text=True)
    assert done.returncode == bool(more) and len(done.stderr.splitlines()) == bool(more), done.stderr


DEEP = "[" * 100_000


def test_what_run_json_says_reaches_no_terminal(exported):
    planted = json.loads((exported.folder / "run.json").read_text())
    for row in planted["clusters"]:
        row["key"] = ESCAPE
    (exported.folder / "run.json").write_text(json.dumps(planted))
    done = run_py(exported)
    assert done.returncode == 0 and "owned" in done.stdout and "\x1b" not in done.stdout + done.stderr and "\x07" not in done.stdout + done.stderr


def test_a_link_of_the_export_that_leads_to_a_folder_is_refused(exported, tmp_path_factory):
    picture = next((exported.folder / "images").iterdir())
    picture.unlink()
    picture.symlink_to(tmp_path_factory.mktemp("outside"))
    done = run_py(exported)
    assert done.returncode == 1 and f"images/{picture.name}" in done.stderr and not (exported.bin / "calls.jsonl").exists()


# Names of folders


@pytest.mark.parametrize("script", ["openmvs/run.py", "openmvs/unscale.py", "realityscan/switch.py", "metashape/depth_maps.py",
                                    "sure/ground.py", "sgm/sgm.py"])
def test_no_message_of_a_script_has_escape_sequences(tmp_path, script):
    """Nor does a traceback; the folder is a stranger's."""
    folder = tmp_path / ESCAPE
    folder.mkdir()
    shutil.copy(ROOT / "integrations" / script, folder / "script.py")
    (folder / "sizes.txt").write_text("not a number\n")
    words = {"openmvs/unscale.py": [folder / "no.ply", "x.ply", "2"], "realityscan/switch.py": [folder], "sure/ground.py": [folder, "0"]}
    done = subprocess.run([sys.executable, folder / "script.py", *words.get(script, [])], capture_output=True, text=True)
    assert done.returncode != 0 and "owned" in done.stderr and "\x1b" not in done.stdout + done.stderr and "\x07" not in done.stderr, done.stderr


WORDS = {"openmvs/unscale.py": ["a.ply", "b.ply", "2"], "realityscan/switch.py": ["."], "metashape/depth_maps.py": ["a.psx"], "sure/ground.py": [".", "0"], "sgm/sgm.py": ["match", ".", "--out", "maps"]}


def ended_in_a_line(script, folder, words, **options):
    done = subprocess.run([sys.executable, "-I", folder / "script.py", *words], stderr=subprocess.PIPE, text=True, **{"cwd": folder, "stdout": subprocess.DEVNULL, **options})
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr, done.stderr[-2000:]


@pytest.mark.parametrize("script", ["openmvs/run.py", "openmvs/unscale.py", "realityscan/switch.py", "metashape/depth_maps.py",
                                    "sure/ground.py", "sgm/sgm.py"])
def test_no_script_ends_with_a_trace(tmp_path, script):
    """Whatever is in its files, however long its path is, and whoever reads what it says."""
    for module in (ROOT / "integrations" / script).parent.glob("*.py"):
        shutil.copy(module, tmp_path)
    shutil.copy(ROOT / "integrations" / script, tmp_path / "script.py")
    for folder in ("xmp", "ori", "images", "sparse", "depths"):
        (tmp_path / folder).mkdir()
    for content in ("[" * 100_000, "[]", '{"views": 3, "clusters": 3, "enabled": 3}', "\udcff\0", "a" * 300 + "\n", "1 2\n" * 9, "$IntOri_CameraMatrix\n1e999\n"):
        for name in ("xmp.txt", "run.json", "keys.sfm", "sizes.txt", "pair.txt", "clusters.json", "report.json", "ori/a.ori", "a.ply", "sparse/cameras.txt", "sparse/images.txt", "sparse/points3D.txt"):
            (tmp_path / name).write_text(content, encoding="utf-8", errors="surrogateescape")
        ended_in_a_line(script, tmp_path, WORDS.get(script, []))
    for words in ([], ["--help"], WORDS.get(script, [])):
        reader, writer = os.pipe()
        os.close(reader)
        ended_in_a_line(script, tmp_path, words, stdout=writer)
        os.close(writer)
        ended_in_a_line(script, tmp_path, words, preexec_fn=lambda: os.close(1))
    gone = tmp_path / "gone"
    gone.mkdir()
    ended_in_a_line(script, tmp_path, [tmp_path / "a.ply", *WORDS.get(script, [])[1:]], preexec_fn=lambda: (os.chdir(gone), os.rmdir(gone)))


@pytest.mark.parametrize("script", ["openmvs/run.py", "realityscan/switch.py", "sgm/sgm.py"])
def test_the_longest_path_is_no_trace(tmp_path, script):
    here = os.open(".", os.O_RDONLY)
    try:
        os.chdir(tmp_path)
        while len(os.getcwd()) < 4060:
            os.mkdir("a" * 30)
            os.chdir("a" * 30)
        for module in (ROOT / "integrations" / script).parent.glob("*.py"):
            shutil.copy(module, ".")
        for name in ("images", "sparse", "xmp"):
            os.mkdir(name)
        for name in ("xmp.txt", "run.json", "keys.sfm", "sizes.txt"):
            Path(name).write_text("a" * 40 + "\n")
        os.rename(Path(script).name, "script.py")
        for words in ([], ["."], ["match", ".", "--out", "o" * 30]):
            ended_in_a_line(script, Path(), words, cwd=None)
    finally:
        os.fchdir(here)
        os.close(here)


@pytest.mark.parametrize("backend", ["mve", "gipuma", "alicevision", "sure", "micmac", "odm", "patchmatchnet", "colmap"])
def test_no_message_of_sh_has_escape_sequences(viewrank, plans, tmp_path, backend):  # noqa: F811
    """It names the script where a program is missing, and where a variable is."""
    folder = tmp_path / ESCAPE
    viewrank("export", plans[4], "--backend", backend, "--out", folder)
    script = folder / ("stereo/viewrank/run.sh" if backend == "colmap" else "run.sh")
    (tmp_path / "Ori-a").mkdir()
    (tmp_path / "Ori-a/Orientation-a.xml").write_text("<x/>")
    for words in ([], ["Ori-a"], ["--rank", "1"], ["Ori-missing"]):
        environment = {"PATH": "/usr/bin:/bin", "COLMAP": "missing", "MM3D": "missing"}
        done = subprocess.run(["sh", script, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        assert done.returncode != 0 and "run.sh" in done.stderr + "run.sh" * (words != []) and "\x1b" not in done.stdout + done.stderr, done.stderr
