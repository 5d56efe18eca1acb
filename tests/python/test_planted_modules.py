"""Scripts of an export are started in a folder that may be a stranger's. What he put beside them is not imported."""
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

INTEGRATIONS = Path(__file__).parents[2] / "integrations"
SCRIPTS = ["openmvs/run.py", "openmvs/unscale.py", "alicevision/finished.py", "mvsnet/finished.py", "realityscan/switch.py", "metashape/depth_maps.py"]


@pytest.mark.parametrize("script", SCRIPTS)
def test_planted_modules_are_not_imported(script, tmp_path):
    text = (INTEGRATIONS / script).read_text()
    names = set(re.findall(r"^(?:import|from) (\w+)", text, re.MULTILINE)) - {"os", "sys"}
    assert names, "it imports something"
    shutil.copy(INTEGRATIONS / script, tmp_path / "script.py")
    trap = tmp_path / "trapped"
    for name in names:
        (tmp_path / f"{name}.py").write_text(f"open({str(trap)!r}, 'w').close()")
    done = subprocess.run([sys.executable, "script.py", "--help"], cwd=tmp_path, capture_output=True, text=True)
    assert not trap.exists() and "has no attribute" not in done.stderr and "cannot import" not in done.stderr, done.stderr
