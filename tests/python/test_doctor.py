"""`viewrank doctor`: silent about healthy projects, correct about broken ones; 80 columns; exit codes."""
import json
import shutil

import cv2
import numpy as np
import pytest


def project(fixtures, folder):
    for part in ("sparse", "images"):
        shutil.copytree(fixtures / "valley" / part, folder / part)
    return folder


def test_a_healthy_project(viewrank, fixtures, tmp_path):
    done = viewrank("doctor", project(fixtures, tmp_path))
    assert "warning" not in done.stdout and "ERROR" not in done.stdout and done.stderr == ""


def test_what_plan_warns_of(viewrank, fixtures, tmp_path):
    """Bytes after the last point, and a second model."""
    folder = project(fixtures, tmp_path)
    shutil.copytree(folder / "sparse" / "0", folder / "sparse" / "1")
    points = folder / "sparse" / "0" / "points3D.bin"
    points.write_bytes(points.read_bytes() + b"more")
    viewrank("plan", folder, "--quiet")
    warnings = json.loads((folder / "viewrank" / "manifest.json").read_text())["warnings"]
    findings = json.loads(viewrank("doctor", folder, "--format", "json", expect=3).stdout)["findings"]
    # A warning has what to do behind a colon, where something is to be done.
    checks = [finding["check"] for warning in warnings for finding in findings if f"{warning}: ".startswith(f"{finding['what']}: ")]
    assert len(warnings) == 2 and checks == ["model-not-as-it-should-be", "model-copies"]


def test_masks_in_the_image_folder(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    masks = folder / "images" / "masks"
    masks.mkdir()
    names = [image.name for image in sorted((folder / "images").glob("*.jpg"))]
    for name in names:
        cv2.imwrite(str(masks / f"{name}.png"), np.full((45, 60), 0 if name == names[3] else 255, np.uint8))
    findings = json.loads(viewrank("doctor", folder, "--format", "json", expect=3).stdout)["findings"]
    assert [finding["check"] for finding in findings if finding["severity"] != "note"] == ["black-masks"], "masks are no images without a pose"
    viewrank("plan", folder, "--confidence", "geometric", "--quiet")
    views = json.loads((folder / "viewrank" / "manifest.json").read_text())["views"]
    assert [view["name"] for view in views if view.get("reason") == "not_matchable"] == [names[3]]


@pytest.mark.parametrize("name", ["valley", "caliterra", "lewis", "boruszyn"])
def test_the_data_sets_are_healthy(viewrank, data, name):
    report = json.loads(viewrank("doctor", data(name), "--format", "json").stdout)
    assert all(finding["severity"] == "note" for finding in report["findings"]), report


def test_partners_are_judged_among_views_with_an_image(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    images = sorted((folder / "images").iterdir())
    for image in images[6:]:
        image.unlink()
    found = {finding["check"]: finding for finding in json.loads(viewrank("doctor", folder, "--backend", "sgm", "--format", "json", expect=4).stdout)["findings"]}
    few = [finding for name, finding in found.items() if name in ("too-few-partners", "fewer-partners-than-k")]
    viewrank("plan", folder, "--backend", "sgm", "--target", "100", "--quiet")
    manifest = json.loads((folder / "viewrank" / "manifest.json").read_text())
    planned = {cluster["key"]: len(cluster["partners"]) for cluster in manifest["clusters"]}
    said = {view["name"]: view["why"] for finding in few for view in finding["views"]}
    assert planned and said.keys() == {image.name for image in images[:6]}, "five others at most, and fewer within the limits"
    for name, partners in planned.items():
        assert 1 <= int(said[name].split()[0]) <= partners and "without a usable image" in said[name], "a plan also has partners beyond the limits"


def test_missing_images_are_the_cure_only_where_they_are_the_cause(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    found = lambda expect: {finding["check"]: finding for finding in json.loads(viewrank("doctor", folder, "--backend", "sgm", "--format", "json", expect=expect).stdout)["findings"]}  # noqa: E731
    few = found(0)["fewer-partners-than-k"]
    (folder / "images/walk_027.jpg").unlink()
    assert found(3)["fewer-partners-than-k"]["cure"] == few["cure"], "no view has lost a partner that it needs"
    for image in sorted((folder / "images").iterdir())[3:]:
        image.unlink()
    most = found(4)
    assert most["missing-images"]["severity"] == "error"
    assert "of 3 views with a usable image have fewer than" in most["too-few-partners"]["what"]
    assert "replace the images that are missing" in most["too-few-partners"]["cure"]


def test_a_wrong_image_does_not_keep_partners_from_being_judged(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    image = min((folder / "images").iterdir())
    cv2.imwrite(str(image), np.zeros((100, 100), np.uint8))
    text = " ".join(viewrank("doctor", folder, expect=4).stdout.split())
    assert "ERROR" in text and "its units, partners of each view, weak links, image files" in text
    assert json.loads(viewrank("doctor", folder, "--format", "json", expect=4).stdout)["partners_judged"] is True


def test_what_is_wrong_is_said_at_80_columns_with_what_to_do(viewrank, fixtures, tmp_path, monkeypatch):
    folder = project(fixtures, tmp_path)
    # A long path stays whole, wider than the terminal.
    monkeypatch.chdir(folder)
    images = sorted((folder / "images").iterdir())
    for image in images[:9]:
        image.unlink()
    (folder / "sparse" / "0" / "images.txt").write_text("# no images\n")
    done = viewrank("doctor", ".", "--backend", "colmap", expect=3)
    assert all(len(line) <= 80 or " " not in line.strip() for line in done.stdout.splitlines()), done.stdout
    assert f"9 of {len(images)} images" in done.stdout and "and 3 more" in done.stdout
    assert "do      " in done.stdout and "2 warnings" in done.stdout and not done.stderr
    assert images[8].name in viewrank("doctor", folder, "--all", expect=3).stdout
    findings = json.loads(viewrank("doctor", folder, "--format", "json", expect=3).stdout)["findings"]
    assert {"missing-images", "colmap-bin-beats-txt"} <= {finding["check"] for finding in findings}
    assert all(finding["cure"] and finding["what"] for finding in findings)


def test_settings_that_cannot_be_true(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    (folder / "viewrank.toml").write_text("target.gsd = 40.0\n")
    assert "--gsd" in viewrank("doctor", folder, expect=3).stdout
    (folder / "viewrank.toml").write_text('frame.utm = "33N"\n')
    assert "not UTM coordinates" in viewrank("doctor", folder, expect=3).stdout
    (folder / "viewrank.toml").write_text("frame.origin = [48.0, 16.0, 200.0]\n")
    assert viewrank("doctor", folder).stdout.count("impossible") == 0
    assert viewrank("doctor", folder, "--backend", "nothing", expect=2).stdout == ""


def test_a_model_that_does_not_lie_on_the_earth_as_it_is_said_to(viewrank, fixtures, tmp_path):
    """A model rotated to y down, as COLMAP leaves it, or a thousand times too small."""
    pycolmap = pytest.importorskip("pycolmap")
    folder = project(fixtures, tmp_path)
    (folder / "viewrank.toml").write_text("frame.origin = [48.0, 16.0, 200.0]\n")
    upright = pycolmap.Reconstruction(folder / "sparse" / "0")
    turned = pycolmap.Sim3d(1.0, pycolmap.Rotation3d([2**-0.5, 0, 0, 2**-0.5]), [0, 0, 0])
    small = pycolmap.Sim3d(1e-3, pycolmap.Rotation3d(), [0, 0, 0])
    for change, check in ((turned, "impossible-frame"), (small, "impossible-units")):
        model = pycolmap.Reconstruction(upright)
        model.transform(change)
        model.write(folder / "sparse" / "0")
        done = viewrank("doctor", folder, "--format", "json", expect=3)
        assert check in {finding["check"] for finding in json.loads(done.stdout)["findings"]}


@pytest.mark.parametrize(("scale", "code"), [(1, 0), (1e-4, 3), (1e-7, 4)])
def test_units_that_cannot_be_true(viewrank, fixtures, tmp_path, scale, code):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(fixtures / "valley" / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), [0, 0, 0]))
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write(str(folder))
    (tmp_path / "images").symlink_to(fixtures / "valley" / "images")
    (tmp_path / "viewrank.toml").write_text('units = "metric"\n')
    done = viewrank("doctor", tmp_path, "--format", "json", expect=code)
    severity = {finding["check"]: finding["severity"] for finding in json.loads(done.stdout)["findings"]}
    assert severity.get("impossible-units") == {0: None, 3: "warning", 4: "error"}[code]


def test_a_model_without_images_is_an_error(viewrank, fixtures, tmp_path):
    folder = project(fixtures, tmp_path)
    (folder / "sparse" / "0" / "images.bin").write_bytes(bytes(8))
    (folder / "sparse" / "0" / "points3D.bin").write_bytes(bytes(8))
    for optional in ("rigs.bin", "frames.bin"):
        (folder / "sparse" / "0" / optional).unlink(missing_ok=True)
    done = viewrank("doctor", folder, expect=4)
    assert done.stdout.startswith("ERROR") and "\n1 error" in done.stdout and not done.stderr


def test_the_json_is_as_its_schema_says(viewrank, fixtures, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((fixtures.parent / "schema" / "doctor.schema.json").read_text())
    folder = project(fixtures, tmp_path)
    next((folder / "images").iterdir()).write_bytes(b"")
    (folder / "images" / "late.jpg").write_bytes(b"")
    report = json.loads(viewrank("doctor", folder, "--format", "json", expect=3).stdout)
    jsonschema.validate(report, schema)
    checks = {finding["check"]: finding for finding in report["findings"]}
    assert checks["unreadable-images"]["views"][0]["why"] == "empty"
    assert checks["unregistered-images"]["views"] == [{"name": "late.jpg", "why": ""}]
