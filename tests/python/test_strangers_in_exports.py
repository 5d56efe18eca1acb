"""The scripts of exports in a folder in which somebody else has put links, pipes, folders and files in the place of each file that the scripts read, write or remove: nothing
outside that folder changes, and no script waits for ever."""
import json
import os
import re
import shutil
import subprocess
import sys

import pytest

from conftest import LONG
from test_openmvs_runner import STAND_IN
from test_run_scripts import ALICEVISION, COLMAP, DMRECON, EVAL, FAILING, GIPUMA, INTERPRETER, SCENE2PSET, Work, plans  # noqa: F401 (a fixture)

pytestmark = pytest.mark.usefixtures("without_pilot")

ACMM = "#!/bin/sh\nmkdir -p ACMM/2333_00000000 && echo depths > ACMM/2333_00000000/depths.dmb\n"
PMVS = "#!/bin/sh\necho points > models/option-viewrank.ply\n"

# Programs by name, the script with its arguments, and names that are in use only while it runs or after it was killed.
CASES = {
    "acmm": ({"ACMM": ACMM}, ["run.sh"], ["ACMM", "ACMM/2333_00000000", "ACMM/2333_00000000/depths.dmb"]),
    "alicevision": ({f"aliceVision_{name}": ALICEVISION for name in ("depthMapEstimation", "depthMapFiltering", "meshing")}, ["run.sh"],
                    ["done", "done/0123456789abcdef", "depthMaps", "dense.abc", "mesh.obj"]),
    "colmap": ({"colmap": COLMAP}, ["stereo/viewrank/run.sh"], ["stereo/viewrank/unfinished.ply", "stereo/viewrank/0001.cfg", "stereo/consistency_graphs/x"]),
    "gipuma": ({"gipuma": GIPUMA}, ["run.sh"], ["unfinished", "older", "results/2_0123456789abcdef_00000001"]),
    "mve": ({"dmrecon": DMRECON, "scene2pset": SCENE2PSET}, ["run.sh"],
            ["done", "done/0123456789abcdef", "synth_0.out", "unfinished.ply", "fused_half.ply", "views/view_00000099.mve"]),
    "sure": ({"sure": FAILING}, ["run.sh"], ["older", "projects/00000001-0123456789abcdef"]),
    "micmac": ({"mm3d": FAILING}, ["run.sh", "ORI"], ["Ori-viewrank"]),
    "openmvs": ({"densify": STAND_IN.format(python=sys.executable)}, ["run.py", "--densify", "densify"],
                ["unfinished", "unfinished/0001", "unfinished/0001/dense.ply", "fusing.mvs", "fusing.ply", "depth0001.dmap"]),
    "pmvs": ({"pmvs2": PMVS}, ["run.sh"], ["models/option-viewrank.ply"]),
    "patchmatchnet": ({"eval.py": EVAL}, ["run.sh"], ["done/0123456789abcdef", "depths/depth_est/00000099.pfm", "depths/fused.ply"]),
}


class Place:
    """A finished export in a folder, a folder outside of it, and what attacks may not change."""

    def __init__(self, case, viewrank, plans, folder):  # noqa: F811
        programs, (self.script, *self.words), self.passing = CASES[case]
        (folder / "export").mkdir()
        self.work = Work(viewrank, plans, case.split()[0], folder / "export", programs)
        self.work.weights()
        self.folder, self.outside = self.work.folder, folder / "outside"
        (self.outside / "docs").mkdir(parents=True)
        (self.outside / "docs/thesis.tex").write_text("years of work")
        (self.outside / "profile").write_text("export PATH")
        (folder / "Ori-a").mkdir()
        (folder / "Ori-a/Orientation-a.xml").write_text("<x/>")
        self.words = [str(folder / "Ori-a") if word == "ORI" else word for word in self.words]
        self.export(4)
        done = self.run()
        assert done.returncode == 0, done.stdout + done.stderr

    def export(self, partners):
        """Exports a short plan."""
        self.work.export(partners, "--budget", "2")

    def run(self, first=""):
        environment = {"PATH": f"{first}{self.work.bin}:/usr/bin:/bin", "PATCHMATCHNET": str(self.work.bin), "HOME": str(self.outside)}
        command = [sys.executable] if self.script.endswith(".py") else []
        command += [self.folder / self.script, *self.words]
        return subprocess.run(command, env=environment, capture_output=True, text=True, cwd=self.folder, timeout=20, stdin=subprocess.DEVNULL)

    def kinds_of_paths(self):
        """One path of each kind below the export (numbers and hashes aside), except the stand-ins."""
        kinds = {}
        for path in sorted(self.folder.rglob("*")):
            name = str(path.relative_to(self.folder))
            if name != "calls.txt" and not self.script.startswith(name):
                kinds.setdefault(re.sub(r"[0-9a-f]{16}|\d+", "#", name), name)
        self.listed = {line.removeprefix("# ") for line in (self.folder / self.script).read_text().splitlines() if line.removeprefix("# ").startswith("./")}
        return sorted({*kinds.values(), *self.passing})

    def is_refused(self, name, put):
        """Whether the script refuses to start: pictures may be links to files, and COLMAP's folder of them a link; what else is in COLMAP's workspace is the user's own."""
        if f"./{name}" in self.listed or self.work.backend == "colmap" and name.startswith("images/"):
            return put not in (put_link_to_file, put_dangling_link)
        if self.work.backend == "colmap" and name == "images":
            return put is put_folder_that_hides_a_link
        return self.work.backend != "colmap" or name.startswith(("stereo", "sparse"))

    def secrets(self):
        return {str(path.relative_to(self.outside)): path.read_bytes() if path.is_file() else None for path in self.outside.rglob("*")}


def put_link_to_folder(path, outside):
    path.symlink_to(outside / "docs")


def put_link_to_file(path, outside):
    path.symlink_to(outside / "profile")


def put_dangling_link(path, outside):
    path.symlink_to(outside / "new")


def put_pipe(path, _):
    os.mkfifo(path)


def put_folder_that_hides_a_link(path, outside):
    path.mkdir()
    (path / "link").symlink_to(outside / "docs")
    path.chmod(0o311)


def put_hard_link(path, outside):
    os.link(outside / "profile", path)


def put_path_as_text(path, outside):
    path.write_text(f"/../../../../../../..{outside}/docs\n")


REFUSED = [put_link_to_folder, put_link_to_file, put_dangling_link, put_pipe, put_folder_that_hides_a_link]
FILES = [put_hard_link, put_path_as_text]


def remove(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# Puts a link in the place of the mark that the script makes next.
PLANTING = FAILING + """
for folder in Path().glob("projects/*" if "sure" in sys.argv[0] else "MM-Malt-Img-*"):
    mark = folder / ("viewrank.finished" if "sure" in sys.argv[0] else "viewrank.recipe")
    if not mark.is_symlink():
        mark.unlink(missing_ok=True)
        mark.symlink_to(os.environ["LETTER"])
"""


@pytest.mark.parametrize("first", [":", ".:"], ids=["empty", "dot"])
@pytest.mark.parametrize("case", CASES)
def test_no_program_of_the_folder_is_started(viewrank, plans, tmp_path, case, first):  # noqa: F811
    """An entry of the PATH that is empty or relative means the folder in which the script works."""
    place = Place(case, viewrank, plans, tmp_path)
    before = place.secrets()
    for name in [*CASES[case][0], "sh", "find", "awk", "rm", "mkdir", "python3"]:
        planted = place.folder / name
        if planted.is_dir():  # ACMM's, of its results
            continue
        planted.write_text(f"#!/bin/sh\n: > '{place.outside}/taken'\n")
        planted.chmod(0o755)
    place.export(3)
    place.run(first)
    assert place.secrets() == before


@pytest.mark.parametrize("backend, program", [("sure", "sure"), ("micmac", "mm3d")])
def test_a_mark_is_written_through_no_link(backend, program, viewrank, plans, tmp_path):  # noqa: F811
    (tmp_path / "Ori-a").mkdir()
    (tmp_path / "Ori-a/Orientation-a.xml").write_text("<x/>")
    (tmp_path / "letter").write_text("precious")
    (tmp_path / "export").mkdir()
    work = Work(viewrank, plans, backend, tmp_path / "export", {program: PLANTING})
    done, calls = work.run(*([tmp_path / "Ori-a"] if backend == "micmac" else []), LETTER=str(tmp_path / "letter"))
    assert calls and (tmp_path / "letter").read_text() == "precious", done.stdout + done.stderr


@pytest.mark.parametrize("case", CASES)
def test_nothing_outside_the_export_changes(case, viewrank, plans, tmp_path):  # noqa: F811
    place = Place(case, viewrank, plans, tmp_path)
    finished, before = tmp_path / "finished", place.secrets()
    shutil.copytree(place.folder, finished, symlinks=True)
    # A plan of other partners: all is made again, and what is there belongs to an older plan.
    place.export(3)
    replanned = tmp_path / "replanned"
    shutil.copytree(place.folder, replanned, symlinks=True)
    refused = 0
    for i, name in enumerate(place.kinds_of_paths()):
        ways = [*((finished, put) for put in REFUSED), *((replanned, put) for put in FILES if not (replanned / name).is_dir())]
        # Two of the ways at each path without VIEWRANK_LONG=1.
        for start, put in ways if LONG else (ways[i % len(REFUSED)], ways[-1 - i % len(FILES)]):
            remove(place.folder)
            shutil.copytree(start, place.folder, symlinks=True)
            path = place.folder / name
            if not path.parent.is_dir():
                continue
            remove(path)
            put(path, place.outside)
            done = place.run()
            assert place.secrets() == before, f"{put.__name__} at {name}: {done.stdout}{done.stderr}"
            if put in REFUSED and place.is_refused(name, put):
                assert done.returncode != 0 and "error:" in done.stderr, f"{put.__name__} at {name}: {done.stdout}{done.stderr}"
                refused += 1
    assert refused > (14 if case == "pmvs" else 19)
    # Where names are not looked at, the second line of one may be the path of a file outside.
    remove(place.folder)
    shutil.copytree(finished, place.folder, symlinks=True)
    canary = place.outside / "canary"
    canary.symlink_to("profile")
    named = place.folder / f"unfinished/x\n{canary}"
    named.parent.mkdir(parents=True)
    named.write_text("a")
    os.link(named, place.folder / "unfinished/second")
    (place.folder / "unfinished/x").write_text("a")
    place.run()
    assert canary.is_symlink()
    if case.startswith("colmap"):
        return
    for name in (b"\xff", b"a\nb", "\x1b]0;owned\x07".encode(), b"\\033[2J"):
        remove(place.folder)
        shutil.copytree(finished, place.folder, symlinks=True)
        os.symlink(place.outside / "docs", os.fsencode(place.folder) + b"/" + name)
        done = place.run()
        assert done.returncode != 0 and "error:" in done.stderr and "\x1b" not in done.stdout + done.stderr, done.stderr


@pytest.mark.parametrize("which", [["--rank", "1"], ["--fuse"]])
def test_tasks_of_a_queue(which, viewrank, plans, tmp_path):  # noqa: F811
    """The same for what `viewrank dispatch` and `viewrank run` start."""
    project, outside = tmp_path / "project", tmp_path / "outside"
    shutil.copytree(plans[4], project, symlinks=True)
    program = tmp_path / "colmap"
    program.write_text(COLMAP.replace("PYTHON", INTERPRETER))
    program.chmod(0o755)
    viewrank("plan", project, "--backend", "colmap", "--budget", "3", "--quiet")
    (outside / "docs").mkdir(parents=True)
    (outside / "profile").write_text("export PATH")

    def run(which, **options):
        return subprocess.run([viewrank.program, "run", project, "--program", program, *which], capture_output=True, text=True, timeout=60, **options)

    run(["--rank", "1"], check=True)
    run(["--fuse"], check=True)
    folder = project / "viewrank/dispatch/colmap"
    export = "../../colmap/stereo/viewrank"
    (mark,) = (folder / export / "done").iterdir()
    names = [f"{export}/done", f"{export}/done/{mark.name}", f"{export}/run.sh", "locks", f"locks/{mark.name}", "fused", "../../progress.json"]
    for name in names:
        for put in REFUSED[:4]:
            kept = tmp_path / "kept"
            shutil.copytree(project, kept, symlinks=True)
            remove(folder / name)
            put(folder / name, outside)
            done = run(which)
            if not name.startswith("locks") and not name.endswith(".json"):
                assert done.returncode != 0 and "error:" in done.stderr, f"{put.__name__} at {name}: {done.stdout}{done.stderr}"
            assert sorted(path.name for path in outside.rglob("*")) == ["docs", "profile"] and (outside / "profile").read_text() == "export PATH"
            remove(project)
            kept.rename(project)


@pytest.mark.parametrize("backend, name", [("openmvs", "run.py"), ("openmvs", "run.json"), ("openmvs", "clusters/*.mvs"), ("colmap", "run.sh"), ("colmap", "patch-match.cfg"), ("colmap", "run.json"),
                                           ("sgm", "matching.py"), ("sgm", "clusters.txt")])
def test_tasks_of_a_queue_use_no_other_export(backend, name, viewrank, plans, tmp_path):  # noqa: F811
    project = tmp_path / "project"
    shutil.copytree(plans[4], project, symlinks=True)
    viewrank("plan", project, "--backend", backend, "--budget", "3", "--quiet")
    path = next(path for path in (project / "viewrank" / backend).rglob(name) if not path.is_symlink())
    path.write_text(f"open({str(tmp_path / 'pwned')!r}, 'w')")
    for which in (["--rank", "1"], ["--fuse"]):
        done = viewrank("run", project, "--program", "/bin/true", *which, expect=1)
        assert f"{path.name}: missing, or not what this viewrank writes" in done.stderr and "viewrank plan" in done.stderr
    assert not (tmp_path / "pwned").exists()
