"""Scripts of an export are started in a folder that may be a stranger's. What he put beside them is not imported."""
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("without_pilot")

PROGRAM = os.path.abspath(os.environ.get("VIEWRANK", "target/debug/viewrank"))
INTEGRATIONS = Path(__file__).parents[2] / "integrations"
SCRIPTS = ["openmvs/run.py", "openmvs/unscale.py", "realityscan/switch.py", "metashape/depth_maps.py", "sure/ground.py"]
# These take their modules from their own folder.
OF_A_FOLDER = ["sgm/sgm.py", "sgm/measure.py", "sgm/experiments.py"]


@pytest.mark.parametrize("script", [*SCRIPTS, *OF_A_FOLDER])
def test_planted_modules_are_not_imported(script, tmp_path):
    """Neither from the script's folder nor, where PYTHONPATH has an empty entry, from the current one."""
    text = (INTEGRATIONS / script).read_text()
    names = set(re.findall(r"^(?:import|from) (\w+)", text, re.MULTILINE)) - {"os", "sys"}
    assert names, "it imports something"
    shutil.copy(INTEGRATIONS / script, tmp_path / "script.py")
    trap = tmp_path / "trapped"
    for name in names:
        (tmp_path / f"{name}.py").write_text(f"open({str(trap)!r}, 'w').close()")
    for path in [tmp_path / "script.py", INTEGRATIONS / script][script in OF_A_FOLDER :]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep}
        done = subprocess.run([sys.executable, path, "--help"], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert not trap.exists() and "has no attribute" not in done.stderr and "cannot import" not in done.stderr, done.stderr


@pytest.mark.parametrize("backend", ["openmvs", "realityscan"])
def test_commands_of_an_export_run_no_planted_start_file(backend, fixtures, tmp_path):
    """Python runs a sitecustomize.py of its path before the script, which cannot refuse it."""
    project, trap = tmp_path / "valley", tmp_path / "trapped"
    shutil.copytree(fixtures / "valley", project)
    subprocess.run([PROGRAM, "plan", project, "--backend", backend, "--quiet", "--confidence", "none"], check=True)
    export = project / "viewrank" / backend
    (export / "sitecustomize.py").write_text(f"open({str(trap)!r}, 'w').close()")
    (export / "usercustomize.py").write_text(f"open({str(trap)!r}, 'w').close()")
    record = json.loads((export / "export.json").read_text())
    scripts = [path.name for path in export.glob("run.sh")]
    for command in [f"./{script}" for script in scripts] or record["commands"]:
        done = subprocess.run(["sh", "-c", command], cwd=export, env={**os.environ, "PYTHONPATH": os.pathsep}, capture_output=True, text=True)
        assert not trap.exists(), done.stderr
    assert any("python3" in text for text in [*record["commands"], *((export / script).read_text() for script in scripts)])


def test_all_scripts_print_alike():
    """They have no module in common, as each lies alone in an export."""
    own = {re.search(r"^class Printable:.*?(?=^if __name__)", (INTEGRATIONS / script).read_text(), re.MULTILINE | re.DOTALL)[0] for script in [*SCRIPTS, "sgm/sgm.py"]}
    assert len(own) == 1


def test_workers_of_sgm_import_nothing_planted(fixtures, tmp_path):
    project = tmp_path / "valley"
    shutil.copytree(fixtures / "valley", project)
    subprocess.run([PROGRAM, "plan", project, "--backend", "sgm", "--quiet", "--confidence", "none"], check=True)
    export, trap = project / "viewrank/sgm", tmp_path / "trapped"
    (export / "multiprocessing").mkdir()
    (export / "multiprocessing/__init__.py").write_text(f"open({str(trap)!r}, 'w').close()")
    # A Python before 3.11 has no PYTHONSAFEPATH; it must hold without.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"} | {"PYTHONPATH": os.pathsep}
    command = [sys.executable, "sgm.py", "match", "../..", "--clusters", "clusters.txt", "--out", "depth_maps", "--image-scale", "0.2", "--stop-at", "1"]
    done = subprocess.run(command, cwd=export, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and not trap.exists(), done.stderr
    assert list(export.rglob("depth_maps/**/*.npy")), "a worker has computed a map"
