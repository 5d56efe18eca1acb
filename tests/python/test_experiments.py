"""The paper's experiments on a fixture, and their tables."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = Path(os.environ.get("VIEWRANK", ROOT / "target/debug/viewrank"))
sys.path.insert(0, str(ROOT / "benches"))

import paper


@pytest.mark.skipif(not PROGRAM.with_name("viewrank-bench").exists(), reason="needs viewrank-bench: cargo build -p viewrank-bench")
def test_one_command_makes_all_tables(tmp_path):
    script, project = ROOT / "integrations/sgm/experiments.py", ROOT / "fixtures/valley"
    options = ["--image-scale", "0.25", "-k", "2,5", "--rules", "ours,maxcon", "--jobs", "2", "--viewrank", PROGRAM]
    subprocess.run([sys.executable, script, project, "--out", tmp_path / "out", *options], check=True)
    results = json.loads((tmp_path / "out/experiments.json").read_text())
    assert results["reference"] == "maps with 22 partners"
    for kind in results["ranking"]["needed"].values():
        for needed in kind.values():
            assert needed == sorted(needed), "more maps for more of the scene"
    by_fulfilment = results["ranking"]["needed"]["f_o"]
    assert all(best <= other for best, other in zip(by_fulfilment["optimum"], by_fulfilment["random"]))
    tables = paper.tables([results])
    assert {"ranking-valley", "partners-valley", "full-valley", "gap", "matching"} == set(tables)
    tables["planning"] = paper.planning({"valley": results["time"]["planning"]})
    for lines in tables.values():
        assert len({line.count("|") for line in lines}) == 1, "as many cells in each row"
    assert {path.name for path in (tmp_path / "out").glob("*.svg")} == {"orders.svg", "partners.svg", "full.svg", "gap.svg"}
