"""Image names that a shell would take for commands, patterns or options, in the exports of all backends: the scripts run only the
backend's programs, or the export is refused with the name."""
import json
import os
import shlex
import shutil
import subprocess

import pycolmap
import pytest
from conftest import spread

pytestmark = pytest.mark.usefixtures("without_pilot")

PROGRAM = os.path.abspath(os.environ.get("VIEWRANK", "target/debug/viewrank"))
NAMES = ["$(touch pwned).jpg", "`touch pwned`.jpg", "a;touch pwned;.jpg", "a&touch pwned&.jpg", "a|touch pwned.jpg", "it's;touch pwned;'.jpg",
         "\"touch pwned\".jpg", "-rf.jpg", "--help.jpg", "a b.jpg", "*.jpg", "?.jpg", "~root.jpg", "#a.jpg", "%s.jpg", "a\\b.jpg", "$HOME.jpg", "!x.jpg",
         "{a,b}.jpg", "<x>.jpg", "ä 名.jpg", "a=b.jpg", "[a].jpg", "(x).jpg", "a,b.jpg", "con.jpg", "{}.jpg", "a:b.jpg"]
# Beside the stand-ins, in whose place the programs of the backends are looked for.
TOOLS = ("sh bash env cd mkdir rm mv cp ln cat sed grep awk cut sort head tail tr test expr basename dirname find touch date sleep flock printf "
         "seq wc tee true false kill ps ls python3 readlink realpath mktemp xargs comm uniq stat nproc").split()
STUB = """#!/bin/sh
{ printf '%s' "${0##*/}"; for word; do printf '\\036%s' "$word"; done; printf '\\035'; } >>"$CALLS"
"""
PROGRAMS = ["colmap", "DensifyPointCloud", "ReconstructMesh", "InterfaceCOLMAP", "mm3d", "gipuma", "fusibile", "dmrecon", "scene2pset", "fssrecon",
            "meshclean", "makescene", "pmvs2", "genOption", "docker", "RealityScan", "metashape", "SURE", "sure", "aliceVision_depthMapEstimation",
            "aliceVision_depthMapFiltering", "aliceVision_meshing", "aliceVision_prepareDenseScene", "viewrank"]

# Backends whose scripts call programs that have a stand-in.
CALLED = {"sure", "colmap", "openmvs", "pmvs", "gipuma", "mve", "alicevision"}


@pytest.fixture(scope="module")
def few_points(fixtures):
    """fixtures/valley with every eighth point, as nobody looks at these plans: the model, and the ids of its images by their names' order."""
    model = pycolmap.Reconstruction(fixtures / "valley/sparse/0")
    for point in list(model.points3D):
        if point % 8:
            model.delete_point3D(point)
    return model, sorted(model.images, key=lambda number: model.images[number].name)


class Model:
    """fixtures/valley with other names; those that a backend refuses are replaced by harmless ones."""

    def __init__(self, fixtures, few_points, folder):
        self.folder, self.images, self.names = folder, sorted((fixtures / "valley/images").iterdir()), list(NAMES)
        self.model, self.ids = few_points

    def plan(self, backend):
        """Plans for the backend; returns the project and the refused names."""
        refused = []
        while True:
            project = self.folder / str(len(refused)) / "$(touch pwned) 'a' project"
            (project / "images").mkdir(parents=True)
            for image, number, name in zip(self.images, self.ids, self.names, strict=True):
                shutil.copy(image, project / "images" / name)
                self.model.images[number].name = name
            (project / "sparse/0").mkdir(parents=True)
            self.model.write_binary(project / "sparse/0")
            options = ["--backend", backend, "--budget", "100%", "--target", "100%", "--confidence", "none", "--quiet"]
            done = subprocess.run([PROGRAM, "plan", project, *options], capture_output=True, text=True)
            if done.returncode == 0:
                return project, refused
            shown = {name: name.replace("\\", "/") for name in self.names}  # a separator of Windows
            named = [name for name, said in shown.items() if json.dumps(said) in done.stderr or said in done.stderr]
            assert done.returncode == 1 and named and named[0] not in refused, done.stderr
            assert not (project / "viewrank/manifest.json").exists(), "nothing is written"
            refused.append(max(named, key=len))
            self.names[self.names.index(refused[-1])] = f"harmless_{len(refused)}.jpg"


def backends():
    listed = json.loads(subprocess.run([PROGRAM, "backends", "--format", "json"], capture_output=True, check=True).stdout)
    return [backend["name"] for backend in listed]


@pytest.fixture
def machine(tmp_path):
    """A folder with stubs of every program, which record their arguments, and the tools that scripts may use."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in PROGRAMS:
        (folder / name).write_text(STUB)
        (folder / name).chmod(0o755)
    for name in TOOLS:
        if found := shutil.which(name):
            (folder / name).symlink_to(found)
    return folder


def run(command, folder, machine, calls):
    environment = {"PATH": str(machine), "CALLS": str(calls), "HOME": str(folder)}
    subprocess.run(["sh", "-c", command], cwd=folder, env=environment, capture_output=True, timeout=60, stdin=subprocess.DEVNULL)


@pytest.mark.parametrize("name", ["a\u3164", "a'\u202e$(touch pwned)", "a\x01';touch pwned;#'", "%s\\\x1b", "a\n", "=ls"])
def test_a_shown_command_names_the_same_folder(fixtures, tmp_path, name):
    """Whatever of its name cannot be shown."""
    project = tmp_path / name
    shutil.copytree(fixtures / "valley", project)
    (project / "opensfm").mkdir()
    done = subprocess.run([PROGRAM, "plan", project, "--quiet", "--confidence", "none"], capture_output=True, check=True)
    done = subprocess.run([PROGRAM, "export", project, "--backend", "odm"], capture_output=True, text=True)
    (command,) = [line.split("run there")[1] for line in done.stdout.splitlines() if "run there" in line]
    assert command.isprintable()
    for shell in (["sh"], ["bash"], ["zsh"], ["busybox", "sh"]):
        if shutil.which(shell[0]):
            said = subprocess.run([*shell, "-c", command.replace("./run.sh", "printf '%s'", 1)], cwd=tmp_path, capture_output=True, text=True).stdout
            assert os.path.samefile(said, project) and said.rstrip("/") == str(project)
    assert not list(tmp_path.rglob("pwned*"))


def test_no_json_file_has_signs_that_a_terminal_obeys(fixtures, few_points, tmp_path):
    model = Model(fixtures, few_points, tmp_path / "model")
    model.names[:2] = ["\u202egpj.exe.jpg", "\u2028ls.jpg"]
    project, refused = model.plan("splat")
    assert not set(refused) & set(model.names[:2])
    texts = {path: path.read_text() for suffix in ("json", "geojson") for path in project.rglob(f"*.{suffix}")}
    assert len(texts) > 3 and any("\\u" in text for text in texts.values())
    assert [path.name for path, text in texts.items() if not text.replace("\n", "").isprintable()] == []


@pytest.mark.parametrize("backend", backends())
def test_names_stay_names(fixtures, few_points, machine, tmp_path, backend):
    project, refused = Model(fixtures, few_points, tmp_path / "model").plan(backend)
    # MicMac's own patterns are of all these signs.
    assert len(refused) <= (25 if backend == "micmac" else 5), refused
    (record,) = [path for path in project.rglob("export.json")]
    root = project if backend == "colmap" and not (project / "viewrank/colmap").exists() else project / "viewrank" / backend
    calls = tmp_path / "calls"
    calls.touch()
    scripts = [f"./{path.relative_to(root)}" for path in root.rglob("*.sh")]
    for command in [*map(shlex.quote, scripts), *json.loads(record.read_text())["commands"]]:
        run(command, root, machine, calls)
    if backend in ("colmap", "openmvs", "sgm"):
        for rank in spread(range(1, len(NAMES) + 1), 7):
            run(shlex.join(map(str, [PROGRAM, "run", project, "--program", machine / "colmap", "--rank", rank])), root, machine, calls)
    assert not list(tmp_path.rglob("pwned*")), "a name was run"
    assert calls.stat().st_size or backend not in CALLED
    words = [word for call in calls.read_text().split("\x1d") for word in call.split("\x1e")[1:]]
    for word in words:
        if "touch" in word:
            assert any(name.rsplit(".", 1)[0] in word for name in NAMES) or "$(touch pwned) 'a' project" in word, word
