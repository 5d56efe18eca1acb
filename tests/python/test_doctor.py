"""`viewrank doctor` as its users meet it: silent about healthy projects, right about broken ones; 80 columns; exit codes."""
import json
import shutil

import pytest


def project(fixtures, folder):
    for part in ("sparse", "images"):
        shutil.copytree(fixtures / "valley" / part, folder / part)
    return folder


def test_a_healthy_project(viewrank, fixtures, tmp_path):
    done = viewrank("doctor", project(fixtures, tmp_path))
    assert "warning" not in done.stdout and "ERROR" not in done.stdout and done.stderr == ""


@pytest.mark.parametrize("name", ["valley", "caliterra", "lewis", "boruszyn"])
def test_the_data_sets_are_healthy(viewrank, data, name):
    report = json.loads(viewrank("doctor", data / name, "--format", "json").stdout)
    assert all(finding["severity"] == "note" for finding in report["findings"]), report


def test_what_is_wrong_is_said_at_80_columns_with_what_to_do(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    images = sorted((folder / "images").iterdir())
    for image in images[:9]:
        image.unlink()
    (folder / "sparse" / "0" / "images.txt").write_text("# no images\n")
    done = viewrank("doctor", folder, "--backend", "colmap", expect=3)
    assert all(len(line) <= 80 or " " not in line.strip() for line in done.stdout.splitlines()), done.stdout
    assert f"9 of {len(images)} images" in done.stdout and "and 3 more" in done.stdout
    assert "do      " in done.stdout and done.stderr.startswith("error: errors: 0, warnings: 2")
    assert images[8].name in viewrank("doctor", folder, "--all", expect=3).stdout
    findings = json.loads(viewrank("doctor", folder, "--format", "json", expect=3).stdout)["findings"]
    assert {"missing-images", "colmap-bin-beats-txt"} <= {finding["check"] for finding in findings}
    assert all(finding["cure"] and finding["what"] for finding in findings)


def test_units_that_cannot_be_true_are_an_error(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    (folder / "viewrank.toml").write_text("target.gsd = 40.0\n")
    assert "--gsd" in viewrank("doctor", folder, expect=3).stdout
    assert viewrank("doctor", folder, "--backend", "nothing", expect=2).stdout == ""
