"""`viewrank watch` among other programs: those that copy models, a backend that makes depth maps, a disk that fills."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = os.environ.get("VIEWRANK", str(ROOT / "target/debug/viewrank"))
SGM = ROOT / "integrations/sgm/sgm.py"
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")
# Longer than any machine needs for what is waited for.
PATIENCE = 300


class Daemon:
    """A running `viewrank watch` with its log."""

    def __init__(self, root, config, *options, settle="1s"):
        self.root = Path(root)
        self.log = config / "log.jsonl"
        environment = os.environ | {"XDG_CONFIG_HOME": str(config)}
        command = [PROGRAM, "watch", self.root, "--settle", settle, "--log-format", "json", *options]
        with self.log.open("w") as log:
            self.process = subprocess.Popen(list(map(str, command)), stderr=log, env=environment)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def stop(self):
        """Seconds until it ended."""
        start = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(timeout=60)
        return time.monotonic() - start

    def said(self, project, word):
        """How often the log says this word of the project."""
        records = (json.loads(line)["fields"] for line in self.log.read_text().splitlines())
        path = str(self.root / project)
        return sum(r.get("project") == path and r["message"].startswith(word) for r in records)

    def status(self, project):
        """State and its details; empty before there is any."""
        try:
            status = json.loads((self.root / "viewrank/status.json").read_text())
        except FileNotFoundError:
            return {}
        return next((p for p in status["projects"] if p["project"] == str(project)), {})

    def wait(self, condition, what):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert self.process.poll() is None, f"the daemon ended: {self.log.read_text()}"
            assert time.monotonic() < end, f"waited in vain for {what}: {self.log.read_text()}"
            time.sleep(0.05)

    def wait_planned(self, project):
        self.wait(lambda: self.said(project, "planned"), f"{project} to be planned")


@pytest.fixture()
def source(tmp_path, fixtures):
    """A project elsewhere, with a few images."""
    folder = tmp_path / "source"
    shutil.copytree(fixtures / "valley/sparse", folder / "sparse")
    (folder / "images").mkdir()
    for image in sorted((fixtures / "valley/images").iterdir())[:3]:
        shutil.copy(image, folder / "images")
    return folder


@pytest.fixture()
def config(tmp_path):
    """The user's folder of configuration."""
    folder = tmp_path / "config"
    (folder / "viewrank").mkdir(parents=True)
    return folder


@pytest.fixture()
def root(tmp_path):
    folder = tmp_path / "root"
    folder.mkdir()
    return folder


def cp(source, target):
    subprocess.run(["cp", "-r", source, target], check=True)


def rsync(*options):
    def copy(source, target):
        if not shutil.which("rsync"):
            pytest.skip("no rsync")
        subprocess.run(["rsync", "-a", *options, f"{source}/", target], check=True)

    return copy


def tar(source, target):
    archive = source.with_suffix(".tar")
    subprocess.run(["tar", "cf", archive, "-C", source, "."], check=True)
    target.mkdir()
    subprocess.run(["tar", "xf", archive, "-C", target], check=True)


def move_from_other_disk(source, target):
    other = Path("/dev/shm") / f"viewrank-{os.getpid()}"
    if not other.parent.is_dir() or other.parent.stat().st_dev == source.stat().st_dev:
        pytest.skip("no other file system")
    shutil.copytree(source, other)
    subprocess.run(["mv", other, target], check=True)


def slowly(source, target):
    """100 kB/s for the largest file's last 300 kB and an image, all else at once."""
    for path in sorted(p for p in source.rglob("*") if p.is_file()):
        there = target / path.relative_to(source)
        there.parent.mkdir(parents=True, exist_ok=True)
        content = path.read_bytes()
        slow = len(content) > 300_000 or path.parent.name == "images"
        head = max(0, len(content) - 300_000) if slow else len(content)
        with there.open("wb", buffering=0) as file:
            file.write(content[:head])
            for start in range(head, len(content), 10_000):
                file.write(content[start : start + 10_000])
                time.sleep(0.1)


def with_pycolmap(source, target):
    pycolmap = pytest.importorskip("pycolmap")
    (target / "sparse/0").mkdir(parents=True)
    pycolmap.Reconstruction(source / "sparse/0").write(target / "sparse/0")


@pytest.mark.parametrize("copy", [cp, rsync(), rsync("--inplace"), rsync("--whole-file", "--bwlimit=2000"), tar, move_from_other_disk, slowly, with_pycolmap])
def test_however_a_project_comes_it_is_planned_once(copy, source, root, config):
    with Daemon(root, config) as daemon:
        copy(source, root / "project")
        daemon.wait_planned("project")
        time.sleep(3)
        assert daemon.said("project", "planned") == 1
        assert daemon.said("project", "planning") == 1
        assert (root / "project/viewrank/clusters.txt").read_text().count("\n") > 3


def test_ten_projects_at_once_are_planned_once_each(source, root, config):
    names = [f"p{i}" for i in range(10)]
    with Daemon(root, config, "--jobs", "2") as daemon:
        threads = [threading.Thread(target=cp, args=(source, root / name)) for name in names]
        [t.start() for t in threads]
        [t.join() for t in threads]
        for name in names:
            daemon.wait_planned(name)
        time.sleep(3)
        assert [daemon.said(name, "planned") for name in names] == [1] * 10
        assert [daemon.said(name, "planning") for name in names] == [1] * 10


def test_a_model_that_stays_cut_off_is_waited_for_without_an_error(source, root, config):
    images = (source / "sparse/0/images.bin").read_bytes()
    (source / "sparse/0/images.bin").write_bytes(images[: len(images) // 2])
    with Daemon(root, config) as daemon:
        cp(source, root / "p")
        daemon.wait(lambda: "images.bin" in daemon.status("p").get("reason", ""), "what is waited for")
        assert daemon.status("p")["state"] == "waiting"
        (root / "p/sparse/0/images.bin").write_bytes(images)
        daemon.wait_planned("p")
        assert daemon.said("p", "failed") == 0


def test_it_stops_within_two_seconds_while_it_plans(source, root, config):
    cp(source, root / "p")
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "planning"), "the plan to begin")
        assert daemon.stop() < 2
        assert daemon.process.returncode == 0
    assert not (root / "p/viewrank/manifest.json").exists()
    assert not list((root / "p").rglob("*.new"))


def test_a_second_daemon_says_who_holds_the_root_and_leaves(root, config, tmp_path):
    with Daemon(root, config) as first:
        first.wait(lambda: (root / "viewrank/status.json").exists(), "the first")
        other = tmp_path / "other"
        other.mkdir()
        with Daemon(root, other) as second:
            assert second.process.wait(timeout=60) == 1
            assert f"process {first.process.pid}" in second.log.read_text()


def test_a_folder_that_goes_while_it_is_planned_is_forgotten_and_found_again(source, root, config):
    cp(source, root / "p")
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "planning"), "the plan to begin")
        shutil.rmtree(root / "p")
        daemon.wait(lambda: daemon.said("p", "gone"), "it to be missed")
        assert not (root / "p").exists()
        cp(source, root / "p")
        daemon.wait_planned("p")


@pytest.fixture()
def small_disk(tmp_path):
    """A file system of 6 MB of its own, as root only."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6M", "tmpfs", folder], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("may not mount a file system")
    yield folder
    subprocess.run(["umount", "-l", folder], check=False)


def test_a_full_disk_is_said_and_tried_again(source, small_disk, config):
    cp(source, small_disk / "p")
    free = os.statvfs(small_disk)
    (small_disk / "ballast").write_bytes(bytes(free.f_bavail * free.f_frsize - 300_000))
    with Daemon(small_disk, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "failed"), "the failure")
        left = [p.name for p in (small_disk / "p/viewrank").rglob("*") if p.is_file() and not p.name.startswith(".")]
        assert left == [], "the old set, which is none"
        (small_disk / "ballast").unlink()
        daemon.wait_planned("p")
        assert daemon.status("p") == {} or daemon.process.poll() is None
    assert "no space left" in daemon.log.read_text()


def test_a_permission_that_goes_is_said_and_tried_again(source, small_disk, config):
    cp(source, small_disk / "p")
    with Daemon(small_disk, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        before = (small_disk / "p/viewrank/manifest.json").read_bytes()
        (small_disk / "p/viewrank.toml").write_text("partners.k = 3\n")
        subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
        daemon.wait(lambda: daemon.said("p", "failed"), "the failure")
        assert (small_disk / "p/viewrank/manifest.json").read_bytes() == before
        subprocess.run(["mount", "-o", "remount,rw", small_disk], check=True)
        daemon.wait(lambda: daemon.said("p", "planned") == 2, "the second plan")
        assert (small_disk / "p/viewrank/manifest.json").read_bytes() != before
    assert "not permitted" in daemon.log.read_text()


def progress(project):
    try:
        return json.loads((project / "viewrank/progress.json").read_text())
    except FileNotFoundError:
        return {}


def match(project, clusters, *options):
    """Depth maps of those lines of clusters.txt by integrations/sgm."""
    listed = project.parent / "matched.txt"
    listed.write_text("".join(f"{line}\n" for line in clusters))
    command = [sys.executable, SGM, "match", project, "--out", project / "sgm", "--image-scale", "0.5", "--clusters", listed, *options]
    subprocess.run(list(map(str, command)), check=True)


@pytest.fixture()
def planned_project(root, fixtures):
    project = root / "valley"
    shutil.copytree(fixtures / "valley", project)
    (project / "viewrank.toml").write_text('image_scale = 0.5\nbackends = ["sgm"]\n[cut]\ntarget = "60%"\n')
    return project


def test_the_backend_is_followed_to_the_target_and_the_user_s_command_runs_once(planned_project, root, config, tmp_path):
    pytest.importorskip("cv2")
    stop = tmp_path / "stop"
    (config / "viewrank/viewrank.toml").write_text(f'on_target = "echo $VIEWRANK_PROJECT >> {stop}"\n')
    with Daemon(root, config) as daemon:
        daemon.wait_planned("valley")
        clusters = (planned_project / "viewrank/clusters.txt").read_text().splitlines()
        for count in range(1, len(clusters) + 1):
            match(planned_project, clusters[:count])
            daemon.wait(lambda: progress(planned_project).get("done") == count, f"{count} maps to be counted")
            said = progress(planned_project)
            assert said["finished"] == [line.split("\t")[0] for line in clusters[:count]]
            assert said["clusters"] == len(clusters)
            assert 0 < said["fulfilment"] <= said["reachable"] <= 1
            assert abs(said["share"] - said["fulfilment"] / said["reachable"]) < 1e-9
            assert (said["seconds_per_pair"] is None) == (count == 1)
            assert said["target_reached"] == (said["share"] >= 0.6)
            assert stop.exists() == said["target_reached"] or not said["announced"]
            if said["target_reached"]:
                assert said["clusters_to_target"] == 0
                break
        said = progress(planned_project)
        state = "reached" if said["target_reached"] else "computing"
        daemon.wait(lambda: daemon.status("valley").get("state") == state, state)
    with Daemon(root, config) as daemon:
        daemon.wait(lambda: daemon.status("valley").get("state") == state, state)
    if said["target_reached"]:
        assert stop.read_text() == f"{planned_project}\n", "once, though the daemon was started twice"


def test_what_is_left_is_ranked_again_and_what_is_finished_stays(planned_project, root, config):
    pytest.importorskip("cv2")
    manifest = planned_project / "viewrank/manifest.json"
    with Daemon(root, config, "--replan") as daemon:
        daemon.wait_planned("valley")
        before = json.loads(manifest.read_text())["clusters"]
        lines = (planned_project / "viewrank/clusters.txt").read_text().splitlines()
        match(planned_project, lines[1:3])
        daemon.wait(lambda: progress(planned_project).get("done") == 2, "two maps")
        after = json.loads(manifest.read_text())["clusters"]
        assert [c["key"] for c in after[:2]] == [c["key"] for c in before[1:3]]
        assert [c["finished"] for c in after] == [True, True] + [False] * (len(after) - 2)
        assert {c["key"] for c in before} <= {c["key"] for c in after}
        assert (planned_project / "viewrank/clusters.txt").read_text().splitlines()[:2] == lines[1:3]
        assert daemon.said("valley", "planning") == 1


def test_a_map_that_is_cut_off_is_named_and_the_others_are_measured(planned_project, root, config):
    pytest.importorskip("cv2")
    with Daemon(root, config) as daemon:
        daemon.wait_planned("valley")
        lines = (planned_project / "viewrank/clusters.txt").read_text().splitlines()
        match(planned_project, lines[:2])
        daemon.wait(lambda: progress(planned_project).get("done") == 2, "two maps")
        first = next((planned_project / "sgm/depth_maps").glob("*.npy"))
        first.write_bytes(first.read_bytes()[:1000])
        daemon.wait(lambda: progress(planned_project).get("done") == 1, "one map")
        assert first.name in progress(planned_project)["note"]


def test_new_images_keep_the_maps_that_still_fit(planned_project, root, config):
    pytest.importorskip("cv2")
    pycolmap = pytest.importorskip("pycolmap")
    model = planned_project / "sparse/0"
    whole = pycolmap.Reconstruction(model)
    fewer = pycolmap.Reconstruction(model)
    last = max(fewer.reg_image_ids())
    fewer.deregister_frame(fewer.image(last).frame_id)
    fewer.write(model)
    with Daemon(root, config) as daemon:
        daemon.wait_planned("valley")
        lines = (planned_project / "viewrank/clusters.txt").read_text().splitlines()
        match(planned_project, lines[:2])
        daemon.wait(lambda: progress(planned_project).get("done") == 2, "two maps")
        whole.write(model)
        daemon.wait(lambda: daemon.said("valley", "planned") == 2, "the plan of the larger model")
        manifest = json.loads((planned_project / "viewrank/manifest.json").read_text())
        assert manifest["outdated"] == []
        assert [c["key"] for c in manifest["clusters"] if c["finished"]] == [line.split("\t")[0] for line in lines[:2]]


def test_a_project_may_not_name_a_command(source, root, config, tmp_path):
    cp(source, root / "p")
    (root / "p/viewrank.toml").write_text(f'on_target = "touch {tmp_path}/harm"\n')
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "failed"), "the refusal")
        assert "on_target names a command" in daemon.log.read_text()
        (root / "p/viewrank.toml").unlink()
        daemon.wait_planned("p")
    assert not (tmp_path / "harm").exists()
