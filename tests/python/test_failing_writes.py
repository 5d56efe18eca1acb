"""Every change of a file in turn fails for want of space, for each command that writes: nothing of the user's is lost, what was written before stays
whole or is replaced whole, the error names a file and the cause, and the next run is as if nothing had been. And the same on a read-only disk."""
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import LONG, spread

PROGRAM = os.path.abspath(os.environ.get("VIEWRANK", "target/debug/viewrank"))
# Times, and what depends on them.
VARYING = {"viewrank/timings.json"} | {
    f"viewrank/cache/{stage}.table" for stage in ("twins", "agreement", "clusters", "pilot", "ranking")}
# Number of a command's changes that fail in turn without VIEWRANK_LONG=1. tests/it/output/ has each change of each kind of set for the library,
# through which all commands write.
MOST = 4

PLAN = ["plan", "p", "--quiet", "--confidence", "geometric", "--backend", "sgm,openmvs"]
COMMANDS = {
    "plan with a region and two sizes": ([], [*PLAN, "--region", "region.geojson", "--scales", "1,0.5"]),
    "plan over another plan": ([PLAN], [*PLAN, "-k", "3", "--target", "50%"]),
    "plan that compares photographs": ([], ["plan", "p", "--quiet", "--confidence", "photometric", "--backend", "sgm"]),
    "report with a flight": ([PLAN, ["report", "p", "--quiet"], [*PLAN, "-k", "3"]], ["report", "p", "--quiet"]),
    "evaluate": ([PLAN], ["evaluate", "p", "--quiet", "--depth-maps", "maps"]),
    "train": ([PLAN], ["train", "p", "--quiet", "--depth-maps", "MAPS", "--out", "p/fitted.toml"]),
    "predict": ([PLAN], ["predict", "p", "--out", "p/pictures"]),
    "dispatch": ([PLAN], ["dispatch", "p", "--scheduler", "shell", "--program", "/bin/true", "--backend", "sgm"]),
    "export in tiles": ([PLAN], ["export", "p", "--backend", "mvsnet", "--tiles", "2"]),
    "undistort": ([], ["undistort", "p", "--quiet"]),
}


@pytest.fixture(scope="session")
def faults(tmp_path_factory):
    """The program that runs a command and makes its changes fail."""
    if shutil.which("cc") is None or os.uname().sysname != "Linux":
        pytest.skip("needs cc and Linux")
    program = tmp_path_factory.mktemp("faults") / "failing_writes"
    subprocess.run(["cc", "-O1", "-o", program, Path(__file__).with_name("failing_writes.c")], check=True)
    if subprocess.run([program, "true"], capture_output=True).returncode:
        pytest.skip("needs seccomp with user notification")
    return program


def test_each_kind_of_change_is_counted_and_fails(faults, tmp_path):
    """Whether a program asks the C library or the kernel, by path or in an open folder."""
    script = f"""if True:
        import os
        folder = os.open({str(tmp_path)!r}, os.O_RDONLY)
        file = os.open("a", os.O_CREAT | os.O_WRONLY, dir_fd=folder)
        os.write(file, b"text")
        os.fsync(file)
        os.mkdir("b", dir_fd=folder)
        os.rename("a", "b/c", src_dir_fd=folder, dst_dir_fd=folder)
        os.link("b/c", "d", src_dir_fd=folder, dst_dir_fd=folder)
        os.symlink("d", "e", dir_fd=folder)
        os.fsync(folder)
        os.unlink("e", dir_fd=folder)
    """
    changes = 9
    for at in range(changes + 2):
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()
        counted = tmp_path.with_suffix(".count")
        alone = {"FAULT_ROOT": str(tmp_path), "FAULT_AT": str(at), "FAULT_COUNT": str(counted)}
        done = subprocess.run([faults, sys.executable, "-c", script], env=os.environ | alone, capture_output=True, text=True)
        is_hit = 1 <= at <= changes
        assert int(counted.read_text()) == (at if is_hit else changes), at
        assert ("No space left" in done.stderr) == is_hit and bool(done.returncode) == is_hit, f"{at}: {done.stderr}"


class Place:
    """A folder with a project p, its depth maps and a region."""

    def __init__(self, fixtures, folder):
        self.folder = folder
        shutil.copytree(fixtures / "valley", folder / "p")
        (folder / "p/notes.txt").write_text("notes")
        (folder / "p/viewrank.toml").write_text("image_scale = 0.1\n")
        (folder / "p/viewrank").mkdir()
        (folder / "p/viewrank/clusters.txt").write_text("the user's")
        region = '{"type": "Polygon", "crs": null, "coordinates": [[[-20, -20], [20, -20], [20, 20], [-20, 20], [-20, -20]]]}'
        (folder / "region.geojson").write_text(region)
        (folder / "maps").mkdir()
        random = np.random.default_rng(0)
        for image in sorted((folder / "p/images").iterdir()):
            np.save(folder / f"maps/{image.name}.npy", (20 + random.random((45, 60))).astype(np.float32))
        self.saved = {}
        self.saved["[]"] = self.save()

    def after(self, commands):
        """As these commands leave the folder, which run once for all tests. The folder has the same path in all of them: plans have it in their files."""
        saved = self.saved.get(str(commands))
        if saved is None:
            self.restore(self.saved["[]"])
            for earlier in commands:
                assert self.run(earlier).returncode == 0
            saved = self.saved[str(commands)] = self.save()
        self.restore(saved)
        return saved

    def save(self):
        copy = self.folder.with_name(f"saved{len(self.saved)}")
        shutil.copytree(self.folder, copy, symlinks=True)
        return copy

    def restore(self, saved):
        shutil.rmtree(self.folder)
        shutil.copytree(saved, self.folder, symlinks=True)

    def run(self, arguments, *wrapper, **environment):
        arguments = [str(self.folder / "maps") if word == "MAPS" else word for word in arguments]
        alone = {"XDG_CONFIG_HOME": str(self.folder / "nobody"), **environment}
        return subprocess.run([*wrapper, PROGRAM, *arguments], cwd=self.folder, env=os.environ | alone, capture_output=True, text=True, timeout=300)

    def files(self):
        """All files but the bookkeeping, by path."""
        found = {}
        for path in sorted((self.folder / "p").rglob("*")):
            name = str(path.relative_to(self.folder / "p"))
            # A link to an image is as good as a copy, which takes its place where none can be made.
            if path.is_file() and not name.startswith("viewrank/.") and "/viewrank/." not in name and name not in VARYING:
                found[name] = path.read_bytes()
        return found


def is_users(name):
    return name.startswith(("images/", "sparse/")) or name in ("notes.txt", "README.md")


@pytest.fixture(scope="module")
def place(fixtures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("writes") / "home"
    folder.mkdir()
    return Place(fixtures, folder)


@pytest.mark.parametrize("name", COMMANDS)
def test_each_write_in_turn(name, faults, place, tmp_path):
    before, command = COMMANDS[name]
    saved, old, counted = place.after(before), place.files(), tmp_path / "count"
    done = place.run(command, faults, FAULT_ROOT=str(place.folder / "p"), FAULT_COUNT=str(counted))
    assert done.returncode == 0, done.stderr
    new, changes = place.files(), int(counted.read_text())
    assert new != old and changes > 3
    failed = 0
    for at in spread(range(1, changes + 1), MOST):
        # As a disk that stays full, and as an error that passes.
        for dies in ({"FAULT_DIES": "1"}, {}) if LONG else ({"FAULT_DIES": "1"},) if at % 2 else ({},):
            place.restore(saved)
            done = place.run(command, faults, FAULT_ROOT=str(place.folder / "p"), FAULT_AT=str(at), **dies)
            where = f"change {at} of {changes} {dies}: {done.stderr}"
            assert done.returncode in (0, 1), where
            found = place.files()
            assert all(found.get(file) == content for file, content in old.items() if is_users(file)), where
            for file in found.keys() & old.keys():
                assert found[file] in (old[file], new.get(file)), f"{file}: {where}"
            kept = [content for file, content in found.items() if file.startswith("viewrank/clusters.txt")]
            assert b"the user's" in kept, where
            if done.returncode:
                failed += 1
                assert "no space left" in done.stderr.lower() and "p/" in done.stderr, where
            again = place.run(command)
            assert again.returncode == 0, f"{where} then {again.stderr}"
            assert {file: found for file, found in place.files().items() if not file.startswith("viewrank/clusters.txt.")} == {
                file: content for file, content in new.items() if not file.startswith("viewrank/clusters.txt.")
            }, where
    assert failed, "some of them matter"


READ_ONLY = """set -e
mount -t tmpfs none "$1"
cp -a "$2/." "$1"
mount -o remount,ro "$1"
shift 2
cd "$1"
shift
"$@"
"""


@pytest.mark.parametrize("name", COMMANDS)
def test_read_only(name, place, tmp_path):
    """The disk turns read-only, as after an error of it."""
    alone = ["unshare", "--mount", "--propagation", "private", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*alone, f"mount -t tmpfs none '{tmp_path}'"], capture_output=True).returncode:
        pytest.skip("needs the right to mount")
    before, command = COMMANDS[name]
    there = tmp_path / "there"
    there.mkdir()
    place.after(before)
    arguments = [str(there / "maps") if word == "MAPS" else word for word in command]
    words = [*alone, READ_ONLY, "sh", there, place.folder, there, PROGRAM, *arguments]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and "read-only file system" in done.stderr.lower(), done.stderr
