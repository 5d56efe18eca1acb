"""`viewrank watch` with other programs: copies of models in progress, a backend that writes depth maps, a full disk.

VIEWRANK_LONG=1 also matches real images with integrations/sgm (minutes); otherwise dummy depth maps are used.
"""

import json
import os
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy
import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = os.environ.get("VIEWRANK", str(ROOT / "target/debug/viewrank"))
SGM = ROOT / "integrations/sgm/sgm.py"
# Longer than any machine needs for what is waited for.
PATIENCE = 120
SMALL_MODEL = runpy.run_path(ROOT / "benches/daemon.py")["small_model"]


class Daemon:
    """A running `viewrank watch` with its log."""

    def __init__(self, root, config, *options, settle="1s", program=PROGRAM, front=(), environment=None, **process):
        self.root = Path(root)
        self.log = config / "log.jsonl"
        environment = os.environ | {"XDG_CONFIG_HOME": str(config)} | (environment or {})
        command = [*front, program, "watch", self.root, "--settle", settle, "--log-format", "json", *options]
        with self.log.open("w") as log:
            self.process = subprocess.Popen(list(map(str, command)), stderr=log, env=environment, **process)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(timeout=60)

    def remove(self, folder):
        """Removes a folder in which the daemon may write a file between the listing and the removal."""
        folder = self.root / folder
        self.wait(lambda: shutil.rmtree(folder, ignore_errors=True) or not folder.exists(), "the folder to be removed")

    def said(self, project, word):
        """Returns how often the log has this word for the project."""
        records = (json.loads(line)["fields"] for line in self.log.read_text().splitlines())
        path = str(self.root / project)
        return sum(r.get("project") == path and r["message"].startswith(word) for r in records)

    def notices(self):
        return json.loads((self.root / "viewrank/status.json").read_text())["notices"]

    def status(self, project):
        """Returns the state and its details; empty before the first status."""
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
def source(tmp_path):
    """A project outside the root, with dummy images."""
    folder = tmp_path / "source"
    SMALL_MODEL(folder / "sparse/0", 0, side=5)
    (folder / "images").mkdir()
    for view in range(1, 26):
        (folder / f"images/view{view}.jpg").write_bytes(bytes(10_000))
    return folder


@pytest.fixture()
def large_source(tmp_path, fixtures):
    """A project outside the root that takes seconds to plan."""
    folder = tmp_path / "large"
    shutil.copytree(fixtures / "valley/sparse", folder / "sparse")
    (folder / "viewrank.toml").write_text("visibility.buffer_px = 3000\n")
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
        subprocess.run(["rsync", "-a", *options, f"{source}/", target], check=True)

    return copy


def tar(source, target):
    archive = source.with_name(f"{target.name}.tar")
    subprocess.run(["tar", "cf", archive, "-C", source, "."], check=True)
    target.mkdir()
    subprocess.run(["tar", "xf", archive, "-C", target], check=True)


def move_from_other_disk(source, target):
    other = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)) / "project"
    shutil.copytree(source, other)
    subprocess.run(["mv", other, target], check=True)
    other.parent.rmdir()


def slowly(source, target):
    """100 kB/s."""
    for path in sorted(p for p in source.rglob("*") if p.is_file()):
        there = target / path.relative_to(source)
        there.parent.mkdir(parents=True, exist_ok=True)
        content = path.read_bytes()
        with there.open("wb", buffering=0) as file:
            for start in range(0, len(content), 10_000):
                file.write(content[start : start + 10_000])
                time.sleep(0.1)


def with_pycolmap(source, target):
    """Writes the images first, then the model, like a mapper."""
    shutil.copytree(source / "images", target / "images")
    (target / "sparse/0").mkdir(parents=True)
    pycolmap = pytest.importorskip("pycolmap")
    pycolmap.Reconstruction(source / "sparse/0").write(target / "sparse/0")


WAYS = {
    "cp": cp,
    "a second cp": cp,
    "rsync": rsync(),
    "rsync --inplace": rsync("--inplace"),
    "rsync, slow": rsync("--whole-file", "--bwlimit=200"),
    "tar": tar,
    "a second tar": tar,
    "mv": move_from_other_disk,
    "slow writer": slowly,
    "pycolmap": with_pycolmap,
}


def test_ten_projects_that_come_at_once_each_in_its_way_are_planned_once_each(source, root, config):
    with Daemon(root, config, "--jobs", "2", settle="2s") as daemon, ThreadPoolExecutor(len(WAYS)) as threads:
        copies = [threads.submit(copy, source, root / name) for name, copy in WAYS.items()]
        for copy in copies:
            copy.result()
        for name in WAYS:
            daemon.wait_planned(name)
        # Longer than the settle time: what is planned twice would begin by then.
        time.sleep(3)
        assert {name: daemon.said(name, "planned") for name in WAYS} == dict.fromkeys(WAYS, 1)
        assert {name: daemon.said(name, "failed") for name in WAYS} == dict.fromkeys(WAYS, 0)
    plans = {(root / name / "viewrank/clusters.txt").read_text() for name in WAYS if name != "pycolmap"}
    assert len(plans) == 1 and plans.pop().count("\n") > 1, "the same plan however the project came"


def test_a_model_that_stays_cut_off_is_waited_for_without_an_error(source, root, config):
    images = (source / "sparse/0/images.txt").read_bytes()
    (source / "sparse/0/images.txt").write_bytes(images[: len(images) // 2])
    with Daemon(root, config) as daemon:
        cp(source, root / "p")
        daemon.wait(lambda: "images.txt" in daemon.status("p").get("reason", ""), "what is waited for")
        assert daemon.status("p")["state"] == "waiting"
        (root / "p/sparse/0/images.txt").write_bytes(images)
        daemon.wait_planned("p")
        assert daemon.said("p", "failed") == 0


def test_it_stops_while_it_plans_and_leaves_nothing(large_source, root, config):
    cp(large_source, root / "p")
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "planning"), "the plan to begin")
        daemon.stop()
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


def test_a_folder_that_goes_while_it_is_planned_is_forgotten_and_found_again(source, large_source, root, config):
    cp(large_source, root / "p")
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "planning"), "the plan to begin")
        daemon.remove("p")
        daemon.wait(lambda: daemon.said("p", "gone"), "it to be missed")
        assert not (root / "p").exists()
        cp(source, root / "p")
        daemon.wait_planned("p")


@pytest.fixture()
def small_disk(root):
    """A project on a file system of 6 MB of its own, as root only."""
    folder = root / "p"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6M", "tmpfs", folder], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("may not mount a file system")
    yield folder
    subprocess.run(["umount", "-l", folder], check=False)


def outputs(project):
    """Output files, without viewrank's hidden ones."""
    files = (p for p in (project / "viewrank").rglob("*") if p.is_file() and not p.name.startswith("."))
    return {str(p.relative_to(project)): p.read_bytes() for p in files if ".sets" not in p.parts}


def test_a_full_disk_is_said_and_tried_again_and_the_old_plan_stays(root, small_disk, config):
    SMALL_MODEL(small_disk / "sparse/0", 0)
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        before = outputs(small_disk)
        free = os.statvfs(small_disk)
        (small_disk / "ballast").write_bytes(bytes(free.f_bavail * free.f_frsize - 20_000))
        (small_disk / "viewrank.toml").write_text("partners.k = 3\n")
        daemon.wait(lambda: daemon.said("p", "failed"), "the failure")
        assert "no space left" in daemon.status("p").get("reason", daemon.log.read_text()).lower()
        assert outputs(small_disk) == before, "the old set, whole"
        (small_disk / "ballast").unlink()
        daemon.wait(lambda: daemon.said("p", "planned") == 2, "the second plan")
        assert outputs(small_disk).keys() == before.keys() and outputs(small_disk) != before


def test_a_permission_that_goes_is_said_and_tried_again(root, small_disk, config):
    SMALL_MODEL(small_disk / "sparse/0", 0)
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        before = outputs(small_disk)
        (small_disk / "viewrank.toml").write_text("partners.k = 3\n")
        subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
        daemon.wait(lambda: daemon.said("p", "failed"), "the failure")
        assert outputs(small_disk) == before
        subprocess.run(["mount", "-o", "remount,rw", small_disk], check=True)
        daemon.wait(lambda: daemon.said("p", "planned") == 2, "the second plan")
        assert outputs(small_disk) != before
    assert "read-only" in daemon.log.read_text().lower()


def progress(project):
    try:
        return json.loads((project / "viewrank/progress.json").read_text())
    except FileNotFoundError:
        return {}


def matched_by_sgm(project, clusters):
    """Matches these lines of clusters.txt with integrations/sgm."""
    pytest.importorskip("cv2")
    listed = project.parent / "matched.txt"
    listed.write_text("".join(f"{line}\n" for line in clusters))
    command = [sys.executable, SGM, "match", project, "--out", project / "sgm", "--image-scale", "0.5", "--clusters", listed]
    subprocess.run(list(map(str, command)), check=True)


def put_in_place(project, clusters):
    """Writes dummy depth maps of integrations/sgm. Without a reference any depth is right."""
    maps = project / "sgm/depth_maps"
    maps.mkdir(parents=True, exist_ok=True)
    depths = numpy.full((150, 200), 40.0, dtype=numpy.float32)
    depths[:10] = 0.0
    for line in clusters:
        path = maps / f"{line.split(chr(9))[0]}.npy"
        if not path.exists():
            numpy.save(path, depths)


class Backend:
    """A project, with a function that makes its depth maps."""

    def __init__(self, project, match, target):
        self.project, self.match, self.target = project, match, target

    def clusters(self):
        return (self.project / "viewrank/clusters.txt").read_text().splitlines()

    def manifest(self):
        return json.loads((self.project / "viewrank/manifest.json").read_text())

    def progress(self):
        return progress(self.project)


@pytest.fixture(params=["files", "sgm"])
def backend(request, root, fixtures):
    project = root / "p"
    target = {"files": 80, "sgm": 60}[request.param]
    if request.param == "files":
        SMALL_MODEL(project / "sparse/0", 0, side=5)
        made = Backend(project, put_in_place, target / 100)
    else:
        if not os.environ.get("VIEWRANK_LONG"):
            pytest.skip("matching takes minutes: VIEWRANK_LONG=1")
        shutil.copytree(fixtures / "valley", project)
        made = Backend(project, matched_by_sgm, target / 100)
    (project / "viewrank.toml").write_text(f'image_scale = 0.5\nbackends = ["sgm"]\n[cut]\ntarget = "{target}%"\n')
    return made


def test_the_backend_is_followed_to_the_target_and_the_user_s_command_runs_once(backend, root, config, tmp_path):
    stop = tmp_path / "stop"
    (config / "viewrank/viewrank.toml").write_text(f'on_target = "echo $VIEWRANK_PROJECT >> {stop}"\n')
    with Daemon(root, config, settle="300ms") as daemon:
        daemon.wait_planned("p")
        clusters = backend.clusters()
        for count in range(1, len(clusters) + 1):
            backend.match(backend.project, clusters[:count])
            daemon.wait(lambda: backend.progress().get("done") == count, f"{count} maps to be counted")
            said = backend.progress()
            assert said["finished"] == [line.split("\t")[0] for line in clusters[:count]]
            assert said["clusters"] == len(clusters)
            assert 0 <= said["kept"] <= said["reachable"] <= 1
            assert abs(said["share"] - said["kept"] / said["reachable"]) < 1e-9
            assert (said["seconds_per_pair"] is None) == (count == 1)
            assert said["target_reached"] == (said["share"] >= backend.target)
            if said["target_reached"]:
                assert said["clusters_to_target"] == 0
                break
        said = backend.progress()
        state = "reached" if said["target_reached"] else "partial"
        daemon.wait(lambda: daemon.status("p").get("state") == state, state)
        if state == "reached":
            daemon.wait(stop.exists, "the command")
    with Daemon(root, config, settle="300ms") as daemon:
        # What was measured in the run before is said at once; a signal counts once the daemon is up.
        word = {"reached": "done", "partial": "partial"}[state]
        daemon.wait(lambda: daemon.said("p", word) and daemon.status("p").get("state") == state, state)
        daemon.process.send_signal(signal.SIGHUP)
        time.sleep(2)
        daemon.wait(lambda: daemon.status("p").get("state") == state, state)
        assert daemon.said("p", "planning") == daemon.said("p", "planned") == 0, "nothing is new"
    if state == "reached":
        assert stop.read_text() == f"{backend.project}\n", "once, though the daemon was started twice"


def test_what_is_left_is_ranked_again_and_what_is_finished_stays(backend, root, config):
    settings = backend.project / "viewrank.toml"
    settings.write_text(re.sub(r'"\d+%"', '"99%"', settings.read_text()))
    with Daemon(root, config, "--replan", settle="300ms") as daemon:
        daemon.wait_planned("p")
        before, lines = backend.manifest()["clusters"], backend.clusters()
        backend.match(backend.project, lines[1:3])
        daemon.wait(lambda: backend.progress().get("done") == 2, "two maps")
        manifest = backend.manifest()
        after = manifest["clusters"]
        assert [c["key"] for c in after[:2]] == [c["key"] for c in before[1:3]]
        assert [c["finished"] for c in after] == [True, True] + [False] * (len(after) - 2)
        # What the finished maps show already needs no further cluster.
        reasons = {view["name"]: view["reason"] for view in manifest["views"] if view["status"] != "key"}
        assert all(reasons[c["key"]] for c in before if c["key"] not in {c["key"] for c in after})
        assert backend.clusters()[:2] == lines[1:3]
        assert daemon.said("p", "planning") == 1


def test_a_map_that_is_cut_off_is_named_and_the_others_are_measured_until_all_are_gone(backend, root, config):
    with Daemon(root, config, settle="300ms") as daemon:
        daemon.wait_planned("p")
        backend.match(backend.project, backend.clusters()[:2])
        daemon.wait(lambda: backend.progress().get("done") == 2, "two maps")
        first = next((backend.project / "sgm/depth_maps").glob("*.npy"))
        first.write_bytes(first.read_bytes()[:1000])
        daemon.wait(lambda: backend.progress().get("done") == 1, "one map")
        assert first.name in backend.progress()["note"]
        daemon.remove(backend.project / "sgm")
        # The state may still be that of the plan before the cut map was measured.
        daemon.wait(lambda: backend.progress() == {}, "no progress")
        daemon.wait(lambda: daemon.status("p").get("state") == "planned", "the plan alone")
        assert not any(c["finished"] for c in backend.manifest()["clusters"])


def test_new_images_keep_the_maps_that_still_fit(backend, root, config, fixtures):
    model = backend.project / "sparse/0"
    if backend.match is put_in_place:
        SMALL_MODEL(model, 0, side=5, left_out=1)
        write_whole = lambda: SMALL_MODEL(model, 0, side=5)
    else:
        pycolmap = pytest.importorskip("pycolmap")
        fewer = pycolmap.Reconstruction(model)
        fewer.deregister_frame(fewer.image(max(fewer.reg_image_ids())).frame_id)
        fewer.write(model)
        write_whole = lambda: pycolmap.Reconstruction(fixtures / "valley/sparse/0").write(model)
    with Daemon(root, config, settle="300ms") as daemon:
        daemon.wait_planned("p")
        lines, views = backend.clusters(), len(backend.manifest()["views"])
        backend.match(backend.project, lines[:2])
        daemon.wait(lambda: backend.progress().get("done") == 2, "two maps")
        write_whole()
        daemon.wait(lambda: len(backend.manifest()["views"]) > views, "the plan of the larger model")
        manifest = backend.manifest()
        assert manifest["outdated"] == []
        assert [c["key"] for c in manifest["clusters"] if c["finished"]] == [line.split("\t")[0] for line in lines[:2]]


def test_a_command_that_fails_is_said(root, config):
    project = root / "p"
    SMALL_MODEL(project / "sparse/0", 0)
    (project / "viewrank.toml").write_text('backends = ["sgm"]\n[cut]\ntarget = "10%"\n')
    with Daemon(root, config, "--on-target", 'touch "$VIEWRANK_PROJECT/stop"; exit 3', settle="300ms") as daemon:
        daemon.wait_planned("p")
        put_in_place(project, (project / "viewrank/clusters.txt").read_text().splitlines())
        daemon.wait(lambda: daemon.said("p", "on_target command failed"), "the failure")
        assert (project / "stop").exists() and '"status":"exit status: 3"' in daemon.log.read_text()


def test_a_project_may_not_name_a_command(source, root, config, tmp_path):
    cp(source, root / "p")
    (root / "p/viewrank.toml").write_text(f'on_target = "touch {tmp_path}/harm"\n')
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "failed"), "the refusal")
        assert "on_target runs commands, so a project's file may not set it" in daemon.log.read_text()
        (root / "p/viewrank.toml").unlink()
        daemon.wait_planned("p")
    assert not (tmp_path / "harm").exists()


def test_a_broken_file_of_settings_keeps_the_last_good_ones_also_after_a_restart(root, config):
    SMALL_MODEL(root / "p/sparse/0", 0)
    settings = root / "p/viewrank.toml"
    settings.write_text("partners.k = 3\n")
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        before = outputs(root / "p")
        settings.write_text("partners.k = = 4\n")
        daemon.wait(lambda: "using the last valid settings" in (daemon.status("p").get("note") or ""), "the note")
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: "using the last valid settings" in (daemon.status("p").get("note") or ""), "the note again")
        assert outputs(root / "p") == before
        settings.write_text("partners.k = 4\n")
        daemon.wait(lambda: outputs(root / "p") != before, "the new settings")
        daemon.wait(lambda: daemon.status("p").get("state") == "planned" and "note" not in daemon.status("p"), "no note")
        assert daemon.said("p", "failed") == 0


def test_a_change_waits_behind_the_plan_where_that_is_asked_for(large_source, root, config):
    cp(large_source, root / "p")
    with Daemon(root, config, "--on-busy", "queue", settle="100ms") as daemon:
        daemon.wait(lambda: daemon.said("p", "planning"), "the plan to begin")
        (root / "p/viewrank.toml").write_text("partners.k = 3\n")
        manifest = root / "p/viewrank/manifest.json"
        k = lambda: manifest.exists() and json.loads(manifest.read_text())["settings"]["partners"]["k"]
        daemon.wait(lambda: k() == 3, "the plan with the new settings")
        assert daemon.said("p", "planning") == 2
        daemon.wait(lambda: daemon.said("p", "planned") == 2, "the log")


def test_a_mesh_and_masks_are_input_and_what_a_backend_makes_is_none(root, config):
    project = root / "p"
    SMALL_MODEL(project / "sparse/0", 0)
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        mesh = project / "meshes/ground.ply"
        mesh.parent.mkdir()
        shutil.copy(project / "viewrank/surface.ply", mesh)
        (project / "viewrank.toml").write_text('surface.mesh = "meshes/ground.ply"\n')
        daemon.wait(lambda: daemon.said("p", "planned") == 2, "the plan on the mesh")
        mesh.write_bytes(mesh.read_bytes() + b"\n")
        daemon.wait(lambda: daemon.said("p", "planning") == 3, "another mesh")
        daemon.wait(lambda: daemon.said("p", "planned") == 3, "the plan on another mesh")
        (project / "scene_dense.ply").write_bytes(mesh.read_bytes())
        (project / "masks").mkdir()
        (project / "masks/view1.jpg.png").write_bytes(b"no picture")
        daemon.wait(lambda: daemon.said("p", "planned") == 4, "the plan with a mask")
        daemon.remove(project / "viewrank")
        daemon.wait(lambda: (project / "viewrank/manifest.json").exists(), "the plan once more")


def test_lost_events_are_made_up_for(root, config):
    (root / "busy").mkdir()
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: (root / "viewrank/status.json").exists(), "the first look")
        daemon.process.send_signal(signal.SIGSTOP)
        # More than the kernel keeps; equal ones after another count once.
        for i in range(int(Path("/proc/sys/fs/inotify/max_queued_events").read_text()) // 2 + 100):
            (root / f"busy/{i % 2}").touch()
            (root / f"busy/{i % 2}").unlink()
        SMALL_MODEL(root / "p/sparse/0", 0)
        daemon.process.send_signal(signal.SIGCONT)
        daemon.wait_planned("p")
        daemon.wait(lambda: daemon.notices() == ["file events were lost; scanned everything"], "the word about it")


def test_without_enough_watches_the_folders_are_looked_at_in_turn(root, config):
    few = ["unshare", "--user", "--map-root-user", "sh", "-c", 'echo 3 > /proc/sys/user/max_inotify_watches && exec "$0" "$@"']
    if subprocess.run([*few, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no user namespaces")
    for i in range(5):
        (root / f"folder{i}").mkdir()
    with Daemon(root, config, "--rescan", "500ms", settle="100ms", front=few) as daemon:
        daemon.wait(lambda: (root / "viewrank/status.json").exists(), "the first look")
        SMALL_MODEL(root / "folder4/p/sparse/0", 0)
        daemon.wait_planned("folder4/p")
        daemon.wait(lambda: len(daemon.notices()) == 1, "the word about it")
        assert "max_user_watches" in daemon.notices()[0]


def test_a_file_that_may_not_be_read_fails_its_project_alone_and_backs_off(config):
    if os.geteuid() != 0:
        pytest.skip("only root may start the daemon as somebody else")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name in ("good", "secret"):
            SMALL_MODEL(root / name / "sparse/0", 0)
        for path in [root, *root.rglob("*")]:
            os.chown(path, 65534, 65534)
        os.chown(root / "secret/sparse/0/images.txt", 0, 0)
        (root / "secret/sparse/0/images.txt").chmod(0o600)
        program = root / "program"
        shutil.copy(PROGRAM, program)
        for path in (root, program):
            path.chmod(0o755)
        nobody = {"user": 65534, "group": 65534, "extra_groups": []}
        with Daemon(root, config, settle="100ms", environment={"XDG_CONFIG_HOME": folder}, program=program, **nobody) as daemon:
            daemon.wait_planned("good")
            daemon.wait(lambda: daemon.said("secret", "failed"), "the failure")
            assert "images.txt" in daemon.log.read_text() and daemon.said("secret", "failed") == 1
            (root / "secret/sparse/0/images.txt").chmod(0o644)
            daemon.wait_planned("secret")
            assert daemon.said("good", "planning") == 1


def test_links_out_of_the_root_are_followed_only_when_asked(root, config, tmp_path):
    SMALL_MODEL(tmp_path / "elsewhere/p/sparse/0", 0)
    (root / "link").symlink_to(tmp_path / "elsewhere")
    SMALL_MODEL(root / "q/sparse/0", 0)
    once(root, config, expect=0)
    assert (root / "q/viewrank/manifest.json").exists() and not (tmp_path / "elsewhere/p/viewrank").exists()
    once(root, config, "--follow-links", expect=0)
    assert (tmp_path / "elsewhere/p/viewrank/manifest.json").exists()


def once(root, config, *options, expect):
    command = [PROGRAM, "watch", "--once", root, "--settle", "100ms", "--log-format", "json", *options]
    done = subprocess.run(list(map(str, command)), env=os.environ | {"XDG_CONFIG_HOME": str(config)}, capture_output=True, text=True, check=False)
    assert done.returncode == expect, done.stderr
    return done


def test_once_says_by_its_exit_code_whether_all_is_planned(root, config):
    SMALL_MODEL(root / "p/sparse/0", 0)
    metrics = root / "viewrank.prom"
    once(root, config, "--metrics", metrics, expect=0)
    assert 'viewrank_projects{state="planned"} 1' in metrics.read_text().splitlines()
    assert "cannot write metrics" in once(root, config, "--metrics", root / "nowhere/viewrank.prom", expect=2).stderr
    before = (root / "p/viewrank/manifest.json").stat().st_mtime_ns
    once(root, config, expect=0)
    assert (root / "p/viewrank/manifest.json").stat().st_mtime_ns == before, "it is planned already"
    (root / "p/viewrank.toml").write_text("partners.k = -1\n")
    (root / "p/viewrank/planned_from.json").unlink()
    assert "1 of 1 projects could not be planned" in once(root, config, expect=1).stderr
    (root / "p/viewrank.toml").unlink()
    too_large = once(root, config, "--max-memory", "1M", expect=1)
    assert "but a plan may take 1M here" in too_large.stderr
    once(root, config, "--max-memory", "4G", expect=0)
    once(root, config, "--max-memory", "1M", expect=0)  # It is planned already.


def test_an_export_that_was_asked_for_and_is_missing_fails_until_it_is_there(source, root, config):
    cp(source, root / "a")  # Its images are none.
    (root / "a/viewrank.toml").write_text('backends = ["openmvs"]\n')
    for _ in range(2):
        once(root, config, expect=1)
        shown = subprocess.run([PROGRAM, "status", root], capture_output=True, text=True).stdout
        assert "did not export to openmvs" in " ".join(shown.split())
    (root / "a/viewrank.toml").write_text('backends = ["metashape"]\n')
    once(root, config, expect=0)


def test_a_plan_that_turns_out_too_large_is_refused(root, config, monkeypatch):
    monkeypatch.setenv("RAYON_NUM_THREADS", "2")
    shutil.copytree(ROOT / "fixtures/valley", root / "p", ignore=shutil.ignore_patterns("viewrank"))
    (root / "p/viewrank.toml").write_text('target.gsd = 0.005\n')
    enough = ("--max-memory", "130M")
    assert "but a plan may take 130M here" in once(root, config, *enough, expect=1).stderr
    assert "max_memory" in (root / "viewrank/status.json").read_text(), "the hint"
    (root / "p/viewrank.toml").write_text('confidence.source = "geometric"\n')
    once(root, config, *enough, expect=0)


def test_a_supervisor_is_told_and_signals_are_heard(root, config, tmp_path):
    """A supervisor's queue holds about ten messages: a daemon that sends too many would block."""
    SMALL_MODEL(root / "p/sparse/0", 0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(str(tmp_path / "notify"))
        supervisor.settimeout(PATIENCE)
        with Daemon(root, config, settle="100ms", environment={"NOTIFY_SOCKET": str(tmp_path / "notify")}) as daemon:
            assert supervisor.recv(100).strip() == b"READY=1"
            assert supervisor.recv(100).strip() == b"WATCHDOG=1"
            daemon.wait_planned("p")
            # What lies outside of the roots is seen with the next look at everything.
            (config / "viewrank/viewrank.toml").write_text("seed = 7\n")
            daemon.process.send_signal(signal.SIGHUP)
            daemon.wait(lambda: daemon.said("p", "planned") == 2, "another look")
            daemon.process.send_signal(signal.SIGTERM)
            while (said := supervisor.recv(100).strip()) != b"STOPPING=1":
                assert said == b"WATCHDOG=1"


def test_a_root_that_goes_is_found_again_when_it_comes_back(root, config):
    SMALL_MODEL(root / "p/sparse/0", 0)
    with Daemon(root, config, "--rescan", "500ms", settle="100ms") as daemon:
        daemon.wait_planned("p")
        daemon.remove(".")
        daemon.wait(lambda: daemon.said("p", "gone"), "it to be missed")
        SMALL_MODEL(root / "q/sparse/0", 0)
        daemon.wait_planned("q")
        daemon.wait(lambda: daemon.status("q").get("state") == "planned", "its status")
        (root / "inner").mkdir()
        inner = subprocess.run([PROGRAM, "watch", root / "inner"], capture_output=True, text=True, check=False)
        assert inner.returncode == 1 and f"{root} is already watched by process {daemon.process.pid}" in inner.stderr


def test_the_status_is_shown_as_it_changes_and_when_the_daemon_is_gone(root, config):
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait(lambda: (root / "viewrank/status.json").exists(), "the first look")
        command = [PROGRAM, "status", str(root), "--json", "--follow"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as follower:
            assert json.loads(follower.stdout.readline())["projects"] == []
            SMALL_MODEL(root / "p/sparse/0", 0)
            states = []
            while "planned" not in states:
                shown = json.loads(follower.stdout.readline())
                states += [p["state"] for p in shown["projects"] if p["state"] not in states]
            assert shown["running"] and shown["projects"][0]["project"] == "p"
            follower.kill()
    down = subprocess.run([PROGRAM, "status", str(root / "p")], capture_output=True, text=True, check=True).stdout
    assert "no daemon is running" in down and "planned for sgm: " in down


def test_maps_of_undistorted_images_are_counted_where_the_model_is_distorted(root, config):
    project = root / "p"
    SMALL_MODEL(project / "sparse/0", 0)
    dense = project / "dense"
    shutil.copytree(project / "sparse/0", dense / "sparse")
    (project / "sparse/0/cameras.txt").write_text("1 OPENCV 400 300 320 320 200 150 0.01 0 0 0\n")
    (dense / "stereo").mkdir()
    (project / "viewrank.toml").write_text('backends = ["colmap"]\n')
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        keys = [line.split("\t")[0] for line in (project / "viewrank/clusters.txt").read_text().splitlines()]
        mark, made_from, name = (dense / "stereo/viewrank/marks.tsv").read_text().splitlines()[0].split("\t")
        assert name == f"{keys[0]}.photometric.bin"
        (dense / "stereo/viewrank/done").mkdir()
        (dense / "stereo/viewrank/done" / mark).write_text(made_from + "\n")
        (dense / "stereo/depth_maps" / name).write_bytes(b"2&2&1&" + bytes(16))
        daemon.wait(lambda: daemon.status("p").get("done") == 1, "the map to be counted")
        assert daemon.status("p")["note"].startswith("counted, not measured")
        assert progress(project)["share"] is None and progress(project)["finished"] == keys[:1]
        assert daemon.said("p", "failed") == 0


def test_micmacs_maps_are_measured_where_the_model_is_distorted_once_they_are_marked(root, config, fixtures):
    """MicMac matches images as they were taken. Its depth image is there before it is finished."""
    project = root / "p"
    SMALL_MODEL(project / "sparse/0", 0)
    (project / "sparse/0/cameras.txt").write_text("1 OPENCV 400 300 320 320 200 150 0.01 0 0 0\n")
    (project / "viewrank.toml").write_text('backends = ["micmac"]\n')
    with Daemon(root, config, settle="100ms") as daemon:
        daemon.wait_planned("p")
        key = (project / "viewrank/clusters.txt").read_text().split("\t")[0]
        export = project / "viewrank/micmac"
        (export / "ImSec").mkdir(parents=True)
        shutil.copytree(fixtures / "depthmaps/MM-Malt-Img-IMG_9394", export / f"MM-Malt-Img-{Path(key).stem}")
        daemon.wait(lambda: daemon.status("p")["state"] != "planned" or "still being matched" in str(daemon.status("p")), "the map to be seen")
        assert not daemon.status("p").get("done")
        (export / f"MM-Malt-Img-{Path(key).stem}" / "viewrank.recipe").write_text("recipe")
        daemon.wait(lambda: daemon.status("p").get("done") == 1, "the map to be measured")
        assert "counted" not in str(daemon.status("p").get("note")) and progress(project)["share"] is not None


def test_a_hundred_thousand_files_take_little_memory_and_are_no_projects(root, config, fixtures):
    """Half of them as images without a pose, half beside the project."""
    shutil.copytree(fixtures / "valley/sparse", root / "p/sparse")
    shutil.copytree(fixtures / "valley/images", root / "p/images")
    for folder in ("p/images/later", "notes"):
        (root / folder).mkdir()
        for number in range(50_000):
            (root / folder / f"{number:05}.jpg").touch()
    peak, end = [], time.monotonic() + PATIENCE
    with Daemon(root, config, "--once") as daemon:
        while daemon.process.poll() is None and time.monotonic() < end:
            peak += re.findall(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{daemon.process.pid}/status").read_text())
            time.sleep(0.02)
        assert daemon.process.returncode == 0 and daemon.status("p")["state"] == "planned"
    assert 0 < int(peak[-1]) < 200_000
    assert len(json.loads((root / "p/viewrank/manifest.json").read_text())["unregistered"]) == 50_000


FAKETIME = next(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"), None)


@pytest.mark.skipif(FAKETIME is None, reason="no libfaketime")
def test_the_clock_may_jump(root, config, fixtures, tmp_path):
    """Sets the clock back a month while a file is missing, and most of a year ahead when it is back."""
    shutil.copytree(fixtures / "valley/sparse", root / "p/sparse")
    clock, images = tmp_path / "clock", root / "p/sparse/0/images.bin"
    clock.write_text("+0")
    fake = {"LD_PRELOAD": str(FAKETIME), "FAKETIME_DONT_FAKE_MONOTONIC": "1", "FAKETIME_NO_CACHE": "1", "FAKETIME_TIMESTAMP_FILE": str(clock)}
    with Daemon(root, config, "--rescan", "2s", settle="300ms", environment=fake) as daemon:
        daemon.wait(lambda: daemon.status("p").get("state") == "planned", "a plan")
        clock.write_text("-30d")
        images.rename(tmp_path / "images.bin")
        daemon.wait(lambda: daemon.status("p")["state"] == "waiting", "the missing file to be seen")
        month = time.strftime("%Y-%m-%d", time.gmtime(time.time() - 20 * 86400))
        daemon.wait(lambda: any(json.loads(line)["timestamp"] < month for line in daemon.log.read_text().splitlines()), "that clock in the log")
        clock.write_text("+300d")
        (tmp_path / "images.bin").rename(images)
        (root / "p/viewrank.toml").write_text("partners.k = 3\n")
        daemon.wait(lambda: daemon.status("p").get("clusters", 0) and daemon.said("p", "planned") > 1, "another plan")
    manifest = json.loads((root / "p/viewrank/manifest.json").read_text())
    assert manifest["settings"]["partners"]["k"] == 3


def test_the_units_are_right():
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd")
    with tempfile.TemporaryDirectory() as folder:
        for name, user in (("viewrank-watch@", False), ("viewrank-watch-user@", True)):
            text = (ROOT / f"integrations/systemd/{name}.service").read_text()
            # verify looks for the program.
            unit = Path(folder) / f"{name}srv-projects.service"
            unit.write_text(re.sub(r"(?m)^ExecStart=\S+", f"ExecStart={shutil.which('true')}", text))
            command = ["systemd-analyze", "verify", "--man=no", *(["--user"] if user else []), str(unit)]
            done = subprocess.run(command, env=os.environ | {"XDG_RUNTIME_DIR": folder}, capture_output=True, text=True, check=False)
            assert done.returncode == 0 and unit.name not in done.stderr, done.stderr
