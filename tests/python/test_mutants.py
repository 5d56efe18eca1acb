"""tests/mutants.txt keeps up with the code; tests/mutants.py itself builds and runs for long."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

import mutants


def test_each_mutant_has_its_place_in_the_code():
    listed = mutants.read_list()
    assert len(listed) > 150
    for mutant in listed:
        # Ends the program where there is none, or more than one.
        mutant.place((ROOT / mutant.file).read_text())
