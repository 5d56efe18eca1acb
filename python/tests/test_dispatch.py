"""What a queue is told starts this installation again, which is a Python and a script."""
import shlex
import shutil
import subprocess
import sysconfig
from pathlib import Path

FIXTURE = Path(__file__).resolve().parents[2] / "fixtures/valley"


def test_the_printed_commands_start_this_installation(tmp_path):
    program = Path(sysconfig.get_path("scripts")) / "viewrank"
    project = tmp_path / "project"
    shutil.copytree(FIXTURE, project, ignore=shutil.ignore_patterns("viewrank"))
    subprocess.run([program, "plan", project, "--backend", "sgm", "--confidence", "none", "--budget", "2", "--quiet"], check=True)
    said = subprocess.run([program, "dispatch", project, "--scheduler", "shell"], check=True, capture_output=True, text=True).stdout
    command = said.split("do ")[1].split(" --rank")[0]
    done = subprocess.run([*shlex.split(command), "--rank", "3"], cwd=project, capture_output=True, text=True)
    assert done.returncode == 2 and "the list ends at rank 2" in done.stderr
