"""The command line: names of projects, images, amounts, misspellings, read-only data, JSON, exit codes."""
import json
import os
import shutil
import struct
import subprocess
import threading

import cv2
import numpy as np
import pytest

PLAN = ["--confidence", "none", "--backend", "sgm"]  # quick, and independent of what is installed


@pytest.fixture
def valley(fixtures, tmp_path):
    """A copy of the fixture as COLMAP lays it out."""
    root = tmp_path / "my valley"
    shutil.copytree(fixtures / "valley", root, ignore=shutil.ignore_patterns("viewrank"))
    (root / "database.db").write_bytes(b"")
    return root


def manifest(root):
    return json.loads((root / "viewrank/manifest.json").read_text())


@pytest.mark.parametrize("part", ["sparse", "sparse/0", "sparse/0/points3D.bin", "sparse/0/images.bin", "database.db", "images"])
def test_a_part_of_a_project_leads_to_it(viewrank, valley, part):
    done = viewrank("inspect", valley / part, "--format", "json")
    assert json.loads(done.stdout)["path"] == str(valley / "sparse/0")
    done = viewrank("plan", valley / part, *PLAN, "--quiet")
    assert f"belongs to the project {valley}" in done.stderr
    assert manifest(valley) and not (valley / "sparse/0/viewrank").exists()


@pytest.mark.parametrize("typed", ["80%", "80", "0.8", "80 %", ".8"])
def test_shares_are_read_as_people_write_them(viewrank, valley, typed):
    viewrank("plan", valley, *PLAN, "--quiet", "--target", typed)
    assert manifest(valley)["settings"]["cut"]["target"] == "80%"


def test_lengths_have_units_where_the_model_has(viewrank, valley):
    refused = viewrank("plan", valley, *PLAN, "--gsd", "2cm", expect=2).stderr
    assert "the model's unit of length is unknown" in refused and 'units = "metric"' in refused
    assert "with a decimal point" in viewrank("plan", valley, *PLAN, "--gsd", "0,02", expect=2).stderr
    (valley / "viewrank.toml").write_text('units = "metric"\n')
    viewrank("plan", valley, *PLAN, "--quiet", "--gsd", "5cm", "--accuracy", "40 mm")
    assert (manifest(valley)["settings"]["target"]["gsd"], manifest(valley)["settings"]["target"]["accuracy"]) == (0.05, 0.04)


def test_shares_of_a_program_that_was_never_measured_are_called_a_guess(viewrank, valley):
    guess = "Its depth maps were never compared with a plan"
    assert guess in viewrank("plan", valley, "--confidence", "none", "--backend", "acmm").stdout
    assert guess not in viewrank("plan", valley, "--confidence", "none", "--backend", "openmvs").stdout


NEAR_MISSES = [
    (["rank", "x"], "'plan'"), (["order", "x"], "'plan'"), (["paln", "x"], "'plan'"), (["select", "x"], "'plan'"), (["Rank", "x"], "'plan'"),
    (["match", "x"], "'run'"), (["densify", "x"], "'run'"), (["start", "x"], "'run'"), (["info", "x"], "'inspect'"), (["show", "x"], "'inspect'"),
    (["check", "x"], "'doctor'"), (["settings"], "'config'"), (["html", "x"], "'report'"), (["eval", "x"], "'evaluate'"), (["convert", "x"], "'export'"),
    (["programs"], "'backends'"), (["rectify", "x"], "'undistort'"), (["slurm", "x"], "'dispatch'"), (["learn", "x"], "'train'"), (["daemon", "x"], "'watch'"),
    (["plan", "x", "--image_path", "y"], "--images"), (["plan", "x", "--photos", "y"], "--images"), (["plan", "x", "--output", "y"], "--out"),
    (["plan", "x", "--quality", "80"], "--target"), (["plan", "x", "--max-views", "80"], "--budget"), (["plan", "x", "--resolution", "1"], "--gsd"),
    (["plan", "x", "--neighbors", "4"], "-k"), (["plan", "x", "--engine", "colmap"], "--backend"), (["plan", "x", "--roi", "auto"], "--region"),
    (["plan", "x", "--memory", "8G"], "--max-memory"), (["plan", "x", "--jobs", "2"], "--threads"), (["plan", "x", "--json"], "--format json"),
    (["plan", "x", "--dryrun"], "--dry-run"), (["plan", "x", "--traget", "80"], "--target"), (["plan", "x", "--bakend", "sgm"], "--backend"),
    (["plan", "x", "--k", "5"], "the option is -k"), (["evaluate", "x", "maps"], "--depth-maps"), (["config", "--get", "x"], "viewrank config --help"),
    (["report", "x", "--output", "y"], "--out"), (["watch", "x", "--log-formt", "json"], "--log-format"),
]


@pytest.mark.parametrize("typed, meant", NEAR_MISSES, ids=lambda value: " ".join(value) if isinstance(value, list) else None)
def test_near_misses_get_the_right_suggestion(viewrank, typed, meant):
    tip = [line for line in viewrank(*typed, expect=2).stderr.splitlines() if "tip:" in line]
    assert len(tip) == 1 and meant in tip[0]


WRONG = [
    (["--target", "180"], 2, "is not a share above 0% and up to 100%"), (["--target", "1"], 2, "write 1% or 100%"), (["--target", "-5"], 2, "--target"),
    (["--target", "high"], 2, "is not a share"), (["--budget", "0"], 2, "is not a whole number"), (["--budget", "4.5"], 2, "is not a whole number"),
    (["-k", "0"], 2, "must be at least 1"), (["-k", "many"], 2, "must be a whole number"), (["--gsd", "0"], 2, "must be above 0"),
    (["--gsd", "fine"], 2, "must be a number"), (["--time", "2"], 2, "is not a time"), (["--points", "50 million"], 2, "is not a number such as"),
    (["--max-memory", "lots"], 2, "is not a size"), (["--backend", "colmpa"], 2, "did you mean colmap?"), (["--model", "7"], 2, "no sub-model"),
    (["--images", "nowhere"], 2, "no such folder of images"), (["--region", "1,2,3"], 2, "is not auto, a box"), (["--up", "z"], 2, "three numbers"),
    (["--threads", "0"], 2, "--threads"), (["--surface", "2d"], 2, "possible values"), (["--mesh", "nowhere.ply"], 1, "nowhere.ply"),
]


@pytest.mark.parametrize("options, code, phrase", WRONG, ids=lambda value: " ".join(value) if isinstance(value, list) else None)
def test_wrong_values_are_named_and_nothing_is_written(viewrank, valley, options, code, phrase):
    assert phrase in viewrank("plan", valley, *options, expect=code).stderr
    assert not (valley / "viewrank").exists()


def test_paths_with_blanks_and_quotes(viewrank, valley):
    spaced = valley.rename(valley.with_name("two words"))
    first, second = str(spaced).rsplit(" ", 1)
    assert f"quote a path with blanks: '{spaced}'" in viewrank("plan", first, second, expect=2).stderr
    for quoted in (f"'{spaced}'", f'"{spaced}"'):
        assert f"without them it is there: '{spaced}'" in viewrank("plan", quoted, expect=1).stderr
    assert "name the project folder" in viewrank("plan", "'nowhere'", expect=1).stderr


def test_a_folder_of_other_images_is_refused(viewrank, valley, tmp_path):
    (tmp_path / "empty").mkdir()
    refused = viewrank("plan", valley, "--images", tmp_path / "empty", expect=2).stderr
    assert f"{tmp_path / 'empty'}: no image of the model is in this folder" in refused and "--images" in refused
    assert not (valley / "viewrank").exists()


def test_an_export_in_place_of_its_project(viewrank, valley):
    viewrank("plan", valley, *PLAN, "--quiet")
    viewrank("export", valley, "--backend", "openmvs,colmap")
    for name in ("openmvs", "colmap"):
        done = viewrank("plan", valley / "viewrank" / name, *PLAN, "--dry-run")
        assert f"belongs to the project {valley}" in done.stderr


def test_a_file_means_what_is_beside_it(viewrank, valley):
    notes = valley.with_name("notes.txt")
    notes.write_text("")
    assert "this file is no sparse model, and none is beside it" in viewrank("plan", notes, expect=1).stderr


def test_a_project_in_place_of_a_subcommand(viewrank, valley):
    assert f"viewrank plan '{valley}'" in viewrank(valley, expect=2).stderr


def test_images_are_found_elsewhere_and_said(viewrank, valley):
    (valley / "images").rename(valley / "photos")
    for image in (valley / "photos").iterdir():
        image.rename(image.with_suffix(".JPG"))
    done = viewrank("plan", valley, "--backend", "sgm,gipuma", "--confidence", "none")
    said = " ".join(done.stdout.split())
    assert f"The images are in {valley / 'photos'}" in said and "28 images have another name there" in said
    links = sorted((valley / "viewrank/gipuma/images").iterdir())
    assert links and all(link.suffix == ".jpg" and link.resolve().suffix == ".JPG" for link in links)
    assert not [view for view in manifest(valley)["views"] if view.get("reason") == "no_image"]


def test_images_in_a_deeper_folder(viewrank, valley):
    (valley / "images").rename(valley / "flight")
    (valley / "images").mkdir()
    (valley / "flight").rename(valley / "images/flight 1")
    found = json.loads(viewrank("inspect", valley, "--format", "json").stdout)
    assert found["image_folder"] == str(valley / "images/flight 1")


def test_images_are_where_the_user_says(viewrank, valley, tmp_path):
    (valley / "images").rename(tmp_path / "elsewhere")
    viewrank("plan", valley, *PLAN, "--quiet", "--images", tmp_path / "elsewhere")
    exported = json.loads(viewrank("export", valley, "--backend", "gipuma", "--format", "json").stdout)
    assert exported and list((valley / "viewrank/gipuma/images").iterdir()), "the plan knows the folder"


def test_views_without_an_image_take_no_part(viewrank, valley):
    viewrank("plan", valley, *PLAN, "--quiet")
    first = manifest(valley)["clusters"][0]["key"]
    (valley / "images" / first).unlink()
    done = viewrank("plan", valley, *PLAN)
    assert "1 view has no usable image" in done.stdout
    after = manifest(valley)
    assert all(first != cluster["key"] and first not in cluster["partners"] for cluster in after["clusters"])
    assert next(view for view in after["views"] if view["name"] == first)["reason"] == "no_image"
    (valley / "images" / first).write_bytes(bytes(range(100)))
    assert "1 view has no usable image" in viewrank("plan", valley, *PLAN).stdout
    assert manifest(valley) == after | {"input": manifest(valley)["input"], "warnings": manifest(valley)["warnings"]}, "as if it were missing"


def damage(image):
    """Puts a PNG with a wrong checksum in place of an image."""
    png = bytearray(cv2.imencode(".png", cv2.imread(str(image)))[1].tobytes())
    png[len(png) // 2] ^= 1
    image.write_bytes(png)


def with_view(manifest, names):
    """The clusters of which one of these views is a part."""
    return [cluster for cluster in manifest["clusters"] if set(names) & {cluster["key"], *cluster["partners"]}]


def test_views_with_a_damaged_picture_take_no_part(viewrank, valley):
    viewrank("plan", valley)
    sound = manifest(valley)
    first = sound["clusters"][0]["key"]
    image = valley / "images" / first
    jpeg = image.read_bytes()
    damage(image)
    done = viewrank("plan", valley)
    assert "1 view has no usable image" in done.stdout and "CRC" in done.stderr
    after = manifest(valley)
    assert not with_view(after, [first]) and all(len(cluster["partners"]) == 5 for cluster in after["clusters"])
    assert next(view for view in after["views"] if view["name"] == first)["reason"] == "no_image"
    assert any(first in warning and "neither matched nor planned" in warning for warning in after["warnings"])
    viewrank("plan", valley)
    assert manifest(valley) == after, "also from what is kept"
    image.unlink()
    viewrank("plan", valley)
    missing = manifest(valley)
    assert {cluster["key"] for cluster in missing["clusters"]} == {cluster["key"] for cluster in after["clusters"]}
    image.write_bytes(jpeg)
    viewrank("plan", valley)
    assert manifest(valley)["clusters"] == sound["clusters"], "nothing that is kept lacks the view"


def test_an_unreadable_image_is_named_once(viewrank, valley):
    first, second = sorted((valley / "images").iterdir())[:2]
    first.write_bytes(first.read_bytes()[:400])
    second.write_bytes(second.read_bytes()[: second.stat().st_size * 9 // 10])
    for _ in range(2):
        done = viewrank("plan", valley)
        assert "2 views have no usable image" in done.stdout
        assert done.stderr.count(first.name) == 1 and second.name not in done.stderr
        assert len([view for view in manifest(valley)["views"] if view.get("reason") == "no_image"]) == 2


def test_without_a_readable_image_the_next_step_is_to_get_them(viewrank, valley):
    for image in (valley / "images").iterdir():
        image.unlink()
    done = viewrank("plan", valley, "--target", "50%")
    assert f"put the images into '{valley / 'images'}'" in done.stdout and "predicted from geometry alone" in done.stdout
    bands = manifest(valley)["cut"]["share_band"]
    viewrank("plan", valley, "--target", "50%", "--confidence", "geometric")
    assert manifest(valley)["cut"]["share_band"] == bands


def test_masks_of_several_folders(viewrank, valley):
    names = [image.name for image in sorted((valley / "images").iterdir())]
    for folder, name, grey in [("masks", names[0], 255), ("images/masks", names[0], 0), ("images/masks", names[1], 0)]:
        (valley / folder).mkdir(exist_ok=True)
        cv2.imwrite(str(valley / folder / f"{name}.png"), np.full((45, 60), grey, np.uint8))
    assert f"masks (as in {valley / 'masks'}) are not passed on" in " ".join(viewrank("plan", valley, "--backend", "openmvs", "--target", "100%").stderr.split())
    done = viewrank("plan", valley, "--backend", "sgm", "--target", "100%")
    assert "passed on" not in done.stderr, "sgm finds them"
    ranked = {cluster["key"] for cluster in manifest(valley)["clusters"]}
    assert names[0] in ranked and names[1] not in ranked, "the project's own folder comes first"
    findings = json.loads(viewrank("doctor", valley, "--format", "json", expect=3).stdout)["findings"]
    assert "stray-masks" not in {finding["check"] for finding in findings}
    for name in names:
        (valley / "images" / name).rename(valley / name)
    (valley / "images/masks").rename(valley.parent / "masks")
    shutil.rmtree(valley / "images")
    viewrank("plan", valley, "--target", "100%")
    assert names[1] in {cluster["key"] for cluster in manifest(valley)["clusters"]}, "the folder above the project is not its own"


def test_damage_counts_as_soon_as_pictures_are_compared(viewrank, valley):
    """Without a pair of pictures nothing speaks for one view against another."""
    images = sorted((valley / "images").iterdir())
    kept = {image: image.read_bytes() for image in images}
    for image in images[:-1]:
        cv2.imwrite(str(image), np.zeros((50, 500), np.uint8))
    viewrank("plan", valley)
    for image in images[:5]:
        damage(image)
    done = viewrank("plan", valley)
    assert "neither matched nor planned" not in done.stderr and "not compared" in done.stderr
    assert "2 more like these: the image is not compared" in " ".join(done.stderr.split()), done.stderr
    assert "another aspect ratio than their cameras: 27 of 28" in done.stderr, done.stderr
    for image in images[5:]:
        image.write_bytes(kept[image])
    done = viewrank("plan", valley)
    assert "2 more like these: the image is neither matched nor planned" in " ".join(done.stderr.split())
    assert not with_view(manifest(valley), [image.name for image in images[:5]])
    for image in images[:-1]:
        image.write_bytes(kept[image])
        damage(image)
    viewrank("plan", valley, "--quiet")
    assert len(manifest(valley)["clusters"]) == len(images), "no pair of sound pictures is left"


def test_a_model_replaced_while_it_is_planned_gets_no_plan(viewrank, valley):
    model, copy = valley / "sparse/0/points3D.bin", valley / "copy.bin"
    is_planned = threading.Event()

    def replace():
        while not is_planned.wait(0.05):
            shutil.copyfile(model, copy)
            copy.replace(model)

    replacing = threading.Thread(target=replace)
    replacing.start()
    try:
        refused = viewrank("plan", valley, *PLAN, expect=1)
    finally:
        is_planned.set()
        replacing.join()
    assert "has changed since it was read" in refused.stderr and not (valley / "viewrank/manifest.json").exists()


def test_a_camera_that_no_view_can_have_had_is_suspected(viewrank, valley):
    path = valley / "sparse/0/cameras.bin"
    cameras = bytearray(path.read_bytes())
    # The first focal length: after the number of cameras, id, model, width and height.
    struct.pack_into("<d", cameras, 8 + 4 + 4 + 8 + 8, 1e300)
    path.write_bytes(cameras)
    assert "viewrank doctor" in viewrank("plan", valley, *PLAN, expect=1).stderr
    assert "is impossible" in viewrank("doctor", valley, expect=4).stdout


def read_only(root):
    for path in [root, *root.rglob("*")]:
        path.chmod(path.stat().st_mode & ~0o222)


def test_a_project_that_must_not_be_written_to_is_planned_elsewhere(viewrank, valley, tmp_path):
    before = sorted(path for path in valley.rglob("*"))
    read_only(valley)
    if os.geteuid() != 0:
        assert f"viewrank plan '{valley}' --out DIR" in viewrank("plan", valley, *PLAN, expect=1).stderr
    out = tmp_path / "plans"
    viewrank("plan", valley, *PLAN, "--out", out, "--quiet")
    assert manifest(out)["input"]["views"] == 28
    # The folder takes the place of the project.
    viewrank("export", out, "--backend", "gipuma")
    viewrank("report", out, "--quiet")
    viewrank("report", out, "--out", tmp_path / "page", "--quiet")
    assert (out / "viewrank/gipuma/images").is_dir() and (out / "viewrank/report.html").is_file() and (tmp_path / "page/report.html").is_file()
    assert "planned depth maps finished" in viewrank("status", out).stdout
    refused = viewrank("run", out, expect=2)
    assert f"viewrank run '{valley}'" in refused.stderr and f"viewrank dispatch {out}" in refused.stderr
    viewrank("plan", out, *PLAN, "--quiet")
    assert sorted(path for path in valley.rglob("*")) == before


def test_an_export_that_was_asked_for_and_not_written_is_a_failure(viewrank, valley):
    shutil.rmtree(valley / "images")
    failed = viewrank("plan", valley, "--confidence", "none", "--backend", "gipuma", expect=1)
    assert "the plan is complete, but did not export to gipuma" in failed.stderr and manifest(valley)
    viewrank("plan", valley, "--confidence", "none", "--quiet")


@pytest.mark.parametrize("typed, code", [(["plan", "nowhere"], 1), (["rank", "x"], 2), (["plan", "x", "--traget", "1"], 2), (["report", "nowhere"], 1),
                                         (["doctor", "nowhere"], 1), (["export", "nowhere"], 1), (["status", "/"], 1), (["predict", "nowhere", "--out", "y"], 1)])
def test_errors_are_json_where_results_are(viewrank, typed, code):
    done = viewrank(*typed, "--format", "json", expect=code)
    error = json.loads(done.stdout)
    assert error["exit"] == code and error["error"] and error["error"] in done.stderr


def test_errors_and_warnings_have_colour_as_clap_has(viewrank):
    program = viewrank("--version").args[0]
    run = lambda **variables: subprocess.run([program, "plan", "nowhere"], capture_output=True, text=True, check=False, env={**os.environ, **variables}).stderr
    assert "\x1b[1m" in run(CLICOLOR_FORCE="1") and "\x1b[" not in run()
    assert "\x1b[" not in run(CLICOLOR_FORCE="1", NO_COLOR="1")


def test_what_a_backend_does_not_honour_is_no_warning_of_a_plan(viewrank, valley):
    done = viewrank("plan", valley, "--confidence", "none", "--backend", "openmvs")
    assert "not honoured" not in done.stderr + done.stdout
    assert "order of partners" in viewrank("backends", "openmvs").stdout


def test_a_watched_folder_s_settings_and_options_count_for_its_projects(viewrank, valley):
    root = valley.parent
    (root / "viewrank.toml").write_text('confidence.source = "none"\npartners.k = 3\nbackends = ["sgm"]\n')
    viewrank("watch", root, "--once", "--settle", "10ms")
    assert (manifest(valley)["settings"]["partners"]["k"], manifest(valley)["backend"]) == (3, "sgm")
    viewrank("watch", root, "--once", "--settle", "10ms", "--backend", "gipuma", "-k", "4", "--target", "70")
    settings = manifest(valley)["settings"]
    assert (settings["partners"]["k"], settings["cut"]["target"], manifest(valley)["backend"]) == (4, "70%", "gipuma")
    assert "did you mean" in viewrank("watch", root, "--once", "--backend", "gipum", expect=2).stderr
