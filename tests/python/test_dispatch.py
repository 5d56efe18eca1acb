"""viewrank dispatch: the clusters of the fixture, matched by integrations/sgm, in a shell and in a real SLURM.

The SLURM is a controller and two nodes on the loopback device. It needs Debian's packages slurmctld, slurmd and slurm-client (nothing has
to be set up or running); the tests that need it are skipped where they are not installed:

    python -m pytest tests/python/test_dispatch.py
"""
import json
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from conftest import LONG
from test_run_scripts import COLMAP, INTERPRETER

pytestmark = pytest.mark.usefixtures("without_pilot")

ROOT = Path(__file__).resolve().parents[2]
SGM = ROOT / "integrations/sgm/sgm.py"
DAEMONS = [f"{folder}/{name}" for name in ("slurmctld", "slurmd") for folder in ("/usr/sbin", "/usr/local/sbin") if Path(folder, name).exists()]
RANKS = 4
MAX_INDEX = 2  # of an array, so that the ranks need two


# Stands before sgm.py: notes each start, and waits while a file says so.
FRONT = """
import os, runpy, sys, time
from pathlib import Path
here, rank = Path(__file__).parent, None
if __name__ == "__main__" and "--rank" in sys.argv:
    rank = sys.argv[sys.argv.index("--rank") + 1]
    with open(here / "calls", "a") as calls:
        calls.write(f"{{rank}} {{os.getpid()}}\\n")
    begin = time.time()
    while (here / f"hold-{{rank}}").exists() and time.time() - begin < 120:
        time.sleep(0.05)
if __name__ == "__main__":
    sys.path.insert(0, {folder!r})
    sys.argv[0] = {program!r}
    runpy.run_path({program!r}, run_name="__main__")
"""


class Work:
    """A planned copy of the fixture, with the records of its tasks."""

    def __init__(self, folder, viewrank, fixtures, target):
        self.folder, self.viewrank, self.project = folder, viewrank, folder / "my valley"
        shutil.copytree(fixtures / "valley", self.project)
        (self.project / "viewrank.toml").write_text("image_scale = 0.25\n")
        viewrank("plan", self.project, "--backend", "sgm", "--target", target, "--quiet")
        self.front = folder / "front.py"
        self.front.write_text(FRONT.format(folder=str(SGM.parent), program=str(SGM)))

    def dispatch(self, scheduler, *options):
        done = self.viewrank("dispatch", self.project, "--scheduler", scheduler, "--backend", "sgm", "--program", self.front, "--budget", RANKS, "--format", "json", *options)
        return json.loads(done.stdout)

    def task(self, *which, program=None, backend="sgm", **options):
        """What a process of a queue does: the depth map of a rank, or the cloud."""
        command = [self.viewrank.program, "run", self.project, "--backend", backend, "--budget", RANKS, "--program", program or self.front, *which]
        return subprocess.run([str(word) for word in command], check=options.pop("check", True), capture_output=True, text=True, **options)

    def compute(self, *ranks):
        for rank in ranks:
            self.task("--rank", rank, cwd="/")

    def calls(self):
        """Returns (rank, process) of each computation, in the order of their starts."""
        text = (self.folder / "calls").read_text() if (self.folder / "calls").exists() else ""
        return [tuple(map(int, line.split())) for line in text.splitlines()]

    def ranks(self):
        return [rank for rank, _ in self.calls()]

    def process(self, rank):
        return wait_for(lambda: next((p for r, p in reversed(self.calls()) if r == rank), None), f"rank {rank} to start")

    def hold(self, *ranks):
        for rank in ranks:
            (self.folder / f"hold-{rank}").touch()

    def release(self, *ranks):
        for rank in ranks:
            (self.folder / f"hold-{rank}").unlink()

    def maps(self):
        return sorted(path.name for path in (self.project / "sgm/depth_maps").rglob("*.npy"))

    def keys(self, count):
        return sorted(line.split("\t")[0] + ".npy" for line in (self.project / "viewrank/sgm/clusters.txt").read_text().splitlines()[:count])

    def reach(self, count):
        """Says that the target is reached with the depth maps of the first key views, there or not."""
        finished = [key.removesuffix(".npy") for key in self.keys(count)]
        (self.project / "viewrank/progress.json").write_text(json.dumps({"target_reached": True, "finished": finished}))

    def reported(self):
        return sorted(row["key"] + ".npy" for row in json.loads((self.project / "sgm/report.json").read_text())["clusters"])


def wait_for(condition, what, seconds=60):
    begin = time.time()
    while not (found := condition()):
        assert time.time() - begin < seconds, f"waited for {what}"
        time.sleep(0.1)
    return found


@pytest.fixture
def work(tmp_path, viewrank, fixtures, monkeypatch):
    monkeypatch.setenv("PYTHON", sys.executable)
    return Work(tmp_path, viewrank, fixtures, "99%")


def test_a_plain_loop_computes_each_rank_once(work):
    report = work.dispatch("shell")
    assert report["tasks"] == RANKS and report["done"] == 0 and work.ranks() == []
    work.compute(*range(1, RANKS + 1))
    assert work.ranks() == list(range(1, RANKS + 1))
    work.task("--fuse", cwd="/")
    assert work.maps() == work.keys(RANKS) == work.reported()
    assert all("nothing to do" in work.task(*which).stderr for which in (["--rank", 3], ["--fuse"]))
    (work.project / "sgm/depth_maps" / work.keys(RANKS)[0]).unlink()
    work.compute(*range(1, RANKS + 1))
    assert f"the list ends at rank {RANKS}" in work.task("--rank", RANKS + 1, check=False).stderr
    assert len(work.ranks()) == RANKS + 1, "only the lost map is made again"
    assert work.dispatch("shell")["done"] == RANKS


def test_a_killed_task_is_done_again_and_a_reached_target_ends(work):
    work.dispatch("shell")
    work.hold(1)
    running = threading.Thread(target=work.task, args=("--rank", 1), kwargs={"check": False, "start_new_session": True})
    running.start()
    os.killpg(os.getsid(work.process(1)), signal.SIGKILL)
    running.join()
    work.release(1)
    work.compute(1)
    assert work.ranks() == [1, 1] and work.maps() == work.keys(1)
    work.reach(1)
    assert "the target is reached" in work.task("--rank", 2).stderr
    assert work.ranks() == [1, 1]


@pytest.mark.parametrize("counted", [0, 2])
def test_a_target_reached_with_maps_that_are_not_there_ends_nothing(work, counted):
    work.dispatch("shell")
    work.compute(1)
    work.reach(counted)
    assert "progress.json says that the target is reached, but" in work.task("--rank", 2).stderr
    assert work.ranks() == [1, 2]


def test_two_processes_compute_a_key_view_once(work):
    work.dispatch("shell")
    work.hold(1)
    both = [threading.Thread(target=work.compute, args=(1,)) for _ in range(2)]
    for one in both:
        one.start()
    work.process(1)
    time.sleep(0.5)
    work.release(1)
    for one in both:
        one.join()
    assert work.ranks() == [1] and work.maps() == work.keys(1)
    assert [len(list((work.project / "viewrank" / name).iterdir())) for name in ("sgm/done", "dispatch/sgm/locks")] == [1, 1]


def test_a_program_that_outlives_its_task_is_waited_for(work):
    work.dispatch("shell")
    work.hold(1)
    command = [work.viewrank.program, "run", work.project, "--budget", RANKS, "--program", work.front, "--rank", "1"]
    killed = subprocess.Popen(list(map(str, command)), stderr=subprocess.DEVNULL)
    work.process(1)
    killed.kill()
    killed.wait()
    again = threading.Thread(target=work.compute, args=(1,))
    again.start()
    time.sleep(1)
    assert work.ranks() == [1]
    work.release(1)
    again.join()
    assert work.ranks() == [1] and work.maps() == work.keys(1), "its map has its mark"


def test_another_plan_makes_only_what_is_new(work):
    work.dispatch("shell")
    work.compute(1, 2, 3)
    # A share that the maps of the first plan do not reach, which it keeps.
    work.viewrank("plan", work.project, "--backend", "sgm", "-k", "3", "--target", "100%", "--quiet")
    assert work.dispatch("shell")["done"] == 3 < RANKS
    work.compute(*range(1, RANKS + 1))
    assert work.ranks() == list(range(1, RANKS + 1)) and work.dispatch("shell")["done"] == RANKS


def test_maps_of_a_model_that_moved_are_made_anew(work):
    pycolmap = pytest.importorskip("pycolmap")
    work.dispatch("shell")
    work.compute(1, 2)
    assert work.dispatch("shell")["done"] == 2
    model = pycolmap.Reconstruction(work.project / "sparse/0")
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), [0, 0, 0]))
    model.write(work.project / "sparse/0")
    work.viewrank("plan", work.project, "--backend", "sgm", "--target", "99%", "--quiet")
    assert work.dispatch("shell")["done"] == 0
    work.compute(1)
    assert work.ranks() == [1, 2, 1] and work.dispatch("shell")["done"] == 1


def test_the_project_by_any_path(work, tmp_path):
    """A relative path or a link means the same project, and the same commands."""
    (tmp_path / "link").symlink_to(work.project)
    said = lambda: work.viewrank("dispatch", work.project, "--scheduler", "shell", "--program", work.front, "--budget", RANKS).stdout
    first = said()
    for work.project in (Path(os.path.relpath(work.project)), tmp_path / "link"):
        assert said() == first
    work.compute(1)
    assert work.maps() == work.keys(1)


def test_a_target_beyond_the_plan_is_refused(work):
    done = work.viewrank("dispatch", work.project, "--scheduler", "shell", "--program", work.front, "--target", "100%", expect=2)
    assert "plan again with --target 100%" in done.stderr


@pytest.mark.parametrize("way", ["one by one", pytest.param("with parallel", marks=pytest.mark.skipif(not shutil.which("parallel"), reason="GNU parallel is not installed"))])
@pytest.mark.parametrize("name", ["my valley", '{= system("touch pwned") =}{}', "a\u3164'; touch pwned #", "%s\x1b\\"])
def test_the_printed_commands(way, name, work, tmp_path):
    project = tmp_path / name
    if not project.exists():
        work.project.rename(project)
    work.project = project
    program = tmp_path / "a colmap"
    program.write_text(COLMAP.replace("PYTHON", INTERPRETER))
    program.chmod(0o755)
    said = work.viewrank("dispatch", project, "--scheduler", "shell", "--backend", "colmap", "--program", program, "--budget", RANKS).stdout
    (command,) = [line.split(way)[1] for line in said.splitlines() if way in line]
    assert command.isprintable()
    for shell in (["sh"], ["bash"], ["zsh"], ["busybox", "sh"]):
        if shutil.which(shell[0]):
            made = "viewrank/colmap/stereo/depth_maps/*.bin", "viewrank/dispatch/colmap/fused"
            for path in (*project.glob(made[0]), *project.glob(made[1])):
                path.unlink()
            subprocess.run([*shell, "-c", command], cwd=tmp_path, check=True)
            assert len(list(project.glob(made[0]))) == RANKS and len(list(project.glob(made[1]))) == 1
    assert not list(tmp_path.rglob("pwned"))


def test_dry_run_writes_nothing(work):
    before = sorted(work.project.rglob("*"))
    done = work.viewrank("dispatch", work.project, "--scheduler", "slurm", "--backend", "openmvs", "--dry-run", "--time", "90min", "--memory", "2G", "--gpus", "1", "--at-once", "3", "--partition", "night", "--option=--exclusive")
    assert sorted(work.project.rglob("*")) == before
    for word in ("--time=90", "--mem=2048M", "--gres=gpu:1", "%3", "--partition=night", "--exclusive", "--dependency=afterany:JOB1", "--rank $((0 + SLURM_ARRAY_TASK_ID))", "--fuse", "--backend openmvs"):
        assert word in done.stdout, word


def test_a_percent_sign_in_a_folder_stays_one_in_names_of_logs(viewrank, fixtures, tmp_path):
    project = tmp_path / "100%u"
    shutil.copytree(fixtures / "valley", project)
    viewrank("plan", project, "--backend", "openmvs", "--confidence", "none", "--quiet")
    done = viewrank("dispatch", project, "--scheduler", "slurm", "--dry-run")
    logs = str(project / "viewrank/dispatch/openmvs/logs")
    assert f"--output={logs.replace('%', '%%')}/%A_%a.log" in done.stdout and f"--output={logs}/" not in done.stdout


class Slurm:
    """A controller and two nodes of this machine, in a folder."""

    def __init__(self, folder):
        self.folder, self.daemons, self.nodes = folder, [], {}
        for name in ("log", "state", "spool-n1", "spool-n2"):
            (folder / name).mkdir()
        user = pwd.getpwuid(os.getuid()).pw_name
        ports = free_ports(3)
        (folder / "slurm.conf").write_text(CONFIGURATION.format(folder=folder, user=user, ports=ports, max_array=MAX_INDEX + 1))
        self.environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf"), "PATH": f"{os.environ['PATH']}:/usr/sbin"}
        self.start("slurmctld", "-D")
        for node in ("n1", "n2"):
            self.nodes[node] = self.start("slurmd", "-D", "-N", node)
        wait_for(lambda: self.ask("sinfo", "-h", "-o", "%T %D") == "idle 2", "two idle nodes", 30)

    def start(self, *command):
        with open(self.folder / "log" / f"{command[-1]}.out", "wb") as log:
            daemon = subprocess.Popen(command, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        self.daemons.append(daemon)
        return daemon

    def ask(self, *command):
        return subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False).stdout.strip()

    def queue(self, form="%i %T"):
        return self.ask("squeue", "-h", "-r", "-o", form).splitlines()

    def drained(self):
        wait_for(lambda: not self.queue(), "the queue to drain", 120)

    def stop(self):
        subprocess.run(["scancel", "-u", str(os.getuid())], env=self.environment, check=False)
        try:
            wait_for(lambda: not self.queue(), "the queue to be empty", 10)
        finally:
            for daemon in self.daemons:
                daemon.terminate()
            for daemon in self.daemons:
                try:
                    daemon.wait(5)
                except subprocess.TimeoutExpired:
                    daemon.kill()


CONFIGURATION = """ClusterName=ci
SlurmctldHost=localhost(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmctldPort={ports[0]}
SlurmctldPidFile={folder}/slurmctld.pid
SlurmctldLogFile={folder}/log/slurmctld.log
StateSaveLocation={folder}/state
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmdLogFile={folder}/log/slurmd-%n.log
SlurmdSpoolDir={folder}/spool-%n
SlurmdTimeout=5
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerType=sched/backfill
PriorityType=priority/basic
SchedulerParameters=batch_sched_delay=0,sched_interval=1,bf_interval=1
ReturnToService=2
SlurmdParameters=config_overrides
KillWait=2
MaxArraySize={max_array}
NodeName=n1 NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=1000
NodeName=n2 NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=1000
PartitionName=mvs Nodes=n1,n2 Default=YES State=UP
"""


def free_ports(count):
    sockets = [socket.socket() for _ in range(count)]
    for opened in sockets:
        opened.bind(("127.0.0.1", 0))
    ports = [opened.getsockname()[1] for opened in sockets]
    for opened in sockets:
        opened.close()
    return ports


@pytest.fixture
def slurm(tmp_path_factory, monkeypatch):
    if len(DAEMONS) < 2 or not shutil.which("sbatch"):
        pytest.skip("SLURM is not installed: apt-get install slurmctld slurmd slurm-client")
    cluster = Slurm(tmp_path_factory.mktemp("slurm"))
    monkeypatch.setenv("SLURM_CONF", cluster.environment["SLURM_CONF"])
    yield cluster
    cluster.stop()


def test_slurm_in_rank_order_and_nothing_twice(work, slurm):
    report = work.dispatch("slurm", "--at-once", "1", "--memory", "500M")
    assert report["ranks"] == list(range(1, RANKS + 1)) and len(report["jobs"]) == 3, "two arrays and the fusion"
    work.process(1)
    during = work.dispatch("slurm", "--at-once", "1", "--memory", "500M")
    assert during["ranks"] == [] and during["jobs"] == [], "all are on their way"
    slurm.drained()
    assert work.ranks() == list(range(1, RANKS + 1))
    assert work.maps() == work.keys(RANKS) == work.reported()
    after = work.dispatch("slurm")
    assert after["done"] == RANKS and after["jobs"] == []
    work.viewrank("evaluate", work.project, "--depth-maps", work.project / "sgm", "--quiet")


def test_slurm_submits_a_killed_task_again(work, slurm):
    work.hold(2)
    work.dispatch("slurm", "--at-once", "2")
    os.kill(work.process(2), signal.SIGKILL)
    work.release(2)
    slurm.drained()
    assert sorted(work.ranks()) == list(range(1, RANKS + 1)) and work.keys(RANKS) != work.maps()
    assert work.reported() == work.maps(), "what is there is joined"
    again = work.dispatch("slurm")
    assert again["ranks"] == [2]
    slurm.drained()
    assert sorted(work.ranks()) == sorted([2, *range(1, RANKS + 1)]) and work.maps() == work.keys(RANKS) == work.reported()


@pytest.mark.skipif(not LONG, reason="the queue waits before it gives a lost task to another node: VIEWRANK_LONG=1")
def test_slurm_loses_a_node(work, slurm):
    work.hold(1, 2)
    work.dispatch("slurm", "--cpus", "2")
    lost = work.process(1)
    work.process(2)
    running = (line.split() for line in slurm.queue("%i %A %T %N") if " RUNNING " in line)
    task, job, _, node = next(line for line in running if line[0].endswith("_1"))
    take_away(slurm.nodes[node], lost)
    wait_for(lambda: f"{task} PENDING" in slurm.queue(), "the queue to see it")
    assert work.dispatch("slurm", "--cpus", "2")["ranks"] == [], "it is on its way"
    assert slurm.ask("scontrol", "update", f"JobId={job}", "StartTime=now") == ""
    work.release(1, 2)
    slurm.drained()
    assert sorted(work.ranks()) == sorted([1, *range(1, RANKS + 1)]), "only the lost one twice"
    assert work.maps() == work.keys(RANKS) == work.reported()


def take_away(daemon, process):
    """Kills a node, like a power failure: daemon, step and work."""
    daemon.kill()
    daemon.wait()
    parents = [process]
    while parents[-1] > 1:
        if "slurmstepd" in Path(f"/proc/{parents[-1]}/cmdline").read_text():
            break
        parents.append(int(Path(f"/proc/{parents[-1]}/stat").read_text().rsplit(")", 1)[1].split()[1]))
    assert parents[-1] > 1, "the step was found"
    for pid in reversed(parents):
        os.kill(pid, signal.SIGKILL)


def test_slurm_ends_when_the_target_is_reached(tmp_path, viewrank, fixtures, slurm, monkeypatch):
    monkeypatch.setenv("PYTHON", sys.executable)
    work = Work(tmp_path, viewrank, fixtures, "20%")
    work.hold(3)
    work.dispatch("slurm", "--at-once", "1")
    work.process(3)
    report = work.dispatch("slurm", "--at-once", "1")
    assert report["target_reached"] and report["ranks"] == []
    assert len(slurm.queue()) == 2, "the running task and the fusion after it"
    work.release(3)
    slurm.drained()
    assert work.ranks() == [1, 2, 3] and work.maps() == work.keys(3) == work.reported()
    assert work.dispatch("slurm")["jobs"] == []


def test_slurm_tasks_see_the_target_themselves(work, slurm):
    work.hold(2)
    work.dispatch("slurm", "--at-once", "1")
    work.process(2)
    work.reach(1)
    work.release(2)
    slurm.drained()
    assert work.ranks() == [1, 2] and work.maps() == work.keys(2) == work.reported()


def test_slurm_follows_a_new_plan(work, slurm):
    work.hold(1)
    work.dispatch("slurm", "--at-once", "1")
    work.process(1)
    work.viewrank("plan", work.project, "--backend", "sgm", "-k", "3", "--target", "99%", "--quiet")
    report = work.dispatch("slurm", "--at-once", "1")
    assert len(report["commands"][0]) >= 3 and report["commands"][0][0] == "scancel"
    work.release(1)
    slurm.drained()
    work.dispatch("slurm")
    slurm.drained()
    assert work.dispatch("slurm")["done"] == RANKS and set(work.keys(RANKS)) <= set(work.maps())
