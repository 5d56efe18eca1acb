"""viewrank run: one command from a sparse model to depth maps, with the matcher that comes with viewrank and with a stub of OpenMVS."""
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import pytest


@pytest.fixture
def valley(fixtures, tmp_path):
    root = tmp_path / "my valley"
    shutil.copytree(fixtures / "valley", root, ignore=shutil.ignore_patterns("viewrank"))
    (root / "viewrank.toml").write_text("image_scale = 0.25\n")
    return root


@pytest.fixture
def run(viewrank):
    """Runs `viewrank run` with this Python and nothing else on the PATH but the system's tools."""
    program = viewrank("--version").args[0]
    environment = {**{name: value for name, value in os.environ.items() if name not in ("DENSIFY", "COLMAP", "SGM")}, "PYTHON": sys.executable, "PATH": "/usr/bin:/bin"}

    def start(*arguments, **variables):
        return subprocess.Popen([program, "run", *map(str, arguments)], env={**environment, **variables}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def done(*arguments, expect=0, **variables):
        process = start(*arguments, **variables)
        out, err = process.communicate()
        assert process.returncode == expect, out + err
        return out, err

    done.start = start
    return done


def test_one_command_plans_matches_and_reports(run, viewrank, valley):
    out, err = run(valley, "--backend", "sgm", "--budget", "3", "--no-report", "--format", "json")
    result = json.loads(out)
    assert (result["backend"], result["done"], result["tasks"], result["failed"]) == ("sgm", 3, 3, 0) and 0 < result["share"] <= 1
    assert result["target"] is None and not result["target_reached"], "three maps were asked for, and no share"
    maps = {path: path.stat().st_mtime_ns for path in (valley / "sgm/depth_maps").glob("*.npy")}
    assert len(maps) == 3
    status = json.loads(viewrank("status", valley, "--format", "json").stdout)
    assert (status["running"], [(of["project"], of["done"], of["clusters"]) for of in status["projects"]]) == (False, [(".", 3, 3)])
    # Again: nothing is computed twice, and the page is there.
    out, err = run(valley, "--backend", "sgm", "--budget", "3")
    assert {path: path.stat().st_mtime_ns for path in (valley / "sgm/depth_maps").glob("*.npy")} == maps
    assert (valley / "viewrank/report.html").is_file() and "3 of 28 depth maps: about " in out and "of the area that all 28 cover" in out
    assert "Computing 3 of 28 depth maps, 3 of them there already (--budget 3)" in out


def test_it_goes_on_from_the_maps_of_the_script(run, viewrank, valley):
    viewrank("plan", valley, "--backend", "sgm", "--budget", "3", "--confidence", "geometric")
    export = valley / "viewrank/sgm"
    match, _ = json.loads((export / "export.json").read_text())["commands"]
    subprocess.run([sys.executable, *match.split()[1:], "--stop-at", "2"], cwd=export, check=True, capture_output=True)
    of_script = {path: path.stat().st_mtime_ns for path in (valley / "sgm/depth_maps").glob("*.npy")}
    assert len(of_script) == len(list((export / "done").iterdir())) == 2
    done = lambda: json.loads(viewrank("status", valley, "--format", "json").stdout)["projects"][0].get("done", 0)
    assert done() == 2
    out, err = run(valley, "--backend", "sgm", "--budget", "3", "--no-report")
    assert "Computing 3 of 28 depth maps, 2 of them there already" in out + err
    assert {path: path.stat().st_mtime_ns for path in of_script} == of_script and done() == 3
    # Maps of another size are none of the plan's.
    shutil.rmtree(export / "done")
    subprocess.run([sys.executable, *match.split()[1:-1], "0.2"], cwd=export, check=True, capture_output=True)
    assert not (export / "done").exists()


def test_it_goes_on_where_maps_give_less_than_planned(run, valley, tmp_path):
    matcher = Path(__file__).resolve().parents[2] / "integrations/sgm/sgm.py"
    # The first six maps lose all but a quarter.
    program = tmp_path / "sgm.py"
    program.write_text(f"""import subprocess, sys
from pathlib import Path
import numpy as np
done = subprocess.run([sys.executable, {str(matcher)!r}, *sys.argv[1:]])
maps = [path for path in Path(sys.argv[sys.argv.index("--out") + 1]).glob("depth_maps/*.npy")]
if sys.argv[1] == "match" and len(maps) <= 6:
    for path in maps:
        depth = np.load(path)
        depth[:, : 3 * depth.shape[1] // 4] = 0
        np.save(path, depth)
sys.exit(done.returncode)
""")
    out, _ = run(valley, "--backend", "sgm", "--target", "85%", "--no-report", SGM=str(program))
    planned = [int(number) for number in re.findall(r"Computing up to (\d+) of 28", out)]
    assert planned == sorted(set(planned)) and len(planned) > 1, out
    assert "the target of 85 % is reached" in " ".join(out.split()), out


def test_the_plan_of_another_program_stays(run, viewrank, valley):
    viewrank("plan", valley, "--backend", "pairs", "--budget", "3")
    planned = (valley / "viewrank/manifest.json").read_bytes()
    _, err = run(valley, "--target", "60%", expect=1)
    assert "cannot run pairs view by view" in err and (valley / "viewrank/manifest.json").read_bytes() == planned, err
    # Named, it takes its place.
    out, _ = run(valley, "--backend", "sgm", "--budget", "2", "--no-report")
    assert "Backend: sgm (as named)" in out
    out, _ = run(valley, "--budget", "2", "--no-report")
    assert "Backend: sgm (as planned" in out or "Backend: sgm (no DensifyPointCloud" in out


def test_it_stops_at_the_target(run, valley):
    result = json.loads(run(valley, "--backend", "sgm", "--target", "60", "--no-report", "--format", "json")[0])
    assert result["target_reached"] or result["done"] == result["tasks"]
    assert result["tasks"] < 28


def test_ctrl_c_stops_and_the_same_command_goes_on(run, valley):
    process = run.start(valley, "--backend", "sgm", "--budget", "4", "--no-report")
    for line in process.stderr:
        if line.lstrip().startswith("2 of 4"):
            process.send_signal(signal.SIGINT)
            break
    out, err = process.communicate()
    assert process.returncode == 1 and "; stopped.\n" in out and "error" not in err
    assert f"to go on: viewrank run '{valley}' --backend sgm --budget 4" in out.splitlines()
    kept = {path: path.stat().st_mtime_ns for path in (valley / "sgm/depth_maps").glob("*.npy")}
    assert kept and (valley / "sgm/fused.ply").is_file() and "Point cloud:" in out, "what is there is fused"
    assert json.loads(run(valley, "--backend", "sgm", "--budget", "4", "--no-report", "--format", "json")[0])["done"] == 4
    assert all(path.stat().st_mtime_ns == time for path, time in kept.items())


def test_ctrl_c_before_the_second_map_is_no_error(run, valley):
    sgm = (valley, "--backend", "sgm", "--budget", "4", "--no-report")
    process = run.start(*sgm)
    assert process.stdout.readline().startswith("Backend") and process.stdout.readline().startswith("Computing")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 1 and "error" not in err and re.search(r"^stopped with [01] of 4 depth maps$", err, re.M), err
    assert f"to go on: viewrank run '{valley}' --backend sgm --budget 4" in err.splitlines()


def test_maps_of_another_size_are_made_again(run, valley):
    """The backend cannot fuse them with the others."""
    sgm = (valley, "--backend", "sgm", "--no-report", "--budget")
    _, err = run(*sgm, "6")
    cloud = "the cloud so far, updated from time to time: "
    assert err.count(cloud) == 1 and err.index(cloud) < err.index("6 of 6"), "before the last map"
    small = {path: path.read_bytes() for path in (valley / "sgm/depth_maps").glob("*.npy")}
    (valley / "viewrank.toml").write_text("image_scale = 0.2\n")
    out, err = run(*sgm, "6")
    assert "Computing 6 of 28 depth maps (--budget 6)" in out, "none of them is there already"
    assert re.search(r"\d+ depth maps that are there do not count for this plan: made again", err)
    large = {path: path.read_bytes() for path in (valley / "sgm/depth_maps").glob("*.npy")}
    assert sum(large[path] != small.get(path) for path in large) == 6
    result = json.loads(run(*sgm, "6", "--format", "json")[0])
    assert (result["done"], result["tasks"]) == (6, 6), "and now they are"


def test_no_other_plan_is_made_while_maps_are_computed(run, viewrank, valley):
    (valley / "viewrank.toml").write_text("image_scale = 0.5\n")
    process = run.start(valley, "--backend", "sgm", "--budget", "28", "--no-report")
    for line in process.stderr:
        if line.lstrip().startswith("1 of"):
            break
    before = (valley / "viewrank/manifest.json").read_bytes()
    for command in (("plan", valley, "--backend", "sgm", "--target", "50"), ("export", valley, "--backend", "sgm")):
        refused = viewrank(*command, expect=1)
        assert "at work in" in refused.stderr and "Ctrl-C" in refused.stderr, refused.stderr
    assert "at work in" in run(valley, "--backend", "sgm", "--budget", "2", expect=1)[1]
    watched = viewrank("watch", valley.parent, "--once", "--settle", "100ms", expect=1)
    assert "at work in" in watched.stdout + watched.stderr
    viewrank("export", valley, "--backend", "sgm", "--out", valley.parent / "elsewhere")
    assert (valley / "viewrank/manifest.json").read_bytes() == before
    process.send_signal(signal.SIGINT)
    process.communicate()
    viewrank("plan", valley, "--backend", "sgm", "--target", "50")


def test_the_backend_is_what_the_machine_has_and_the_summary_says_why(run, valley, tmp_path):
    densify = tmp_path / "bin/DensifyPointCloud"
    densify.parent.mkdir()
    densify.write_text("#!/bin/sh\necho no licence >&2\nexit 3\n")
    densify.chmod(0o755)
    out, err = run(valley, "--budget", "2", "--no-report", PATH=f"{densify.parent}:/usr/bin:/bin", expect=1)
    assert f"Backend: openmvs ({densify} is installed)" in out
    assert "no depth map of" in err
    assert "no such file" in run(tmp_path / "nowhere", expect=1)[1]


def test_plan_names_run_where_the_program_is(run, viewrank, valley, tmp_path):
    densify = tmp_path / "bin/DensifyPointCloud"
    densify.parent.mkdir()
    densify.write_text("")
    program = os.path.abspath(viewrank("--version").args[0])
    environment = {name: value for name, value in os.environ.items() if name not in ("DENSIFY", "COLMAP", "SGM")}

    def following(*options, path):
        done = subprocess.run([program, "plan", valley, *options], env={**environment, "PYTHON": "nowhere", "PATH": path}, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()[-1]

    here = f"{densify.parent}:/bin"
    assert following(path=here) == f"Next: viewrank run '{valley}'"
    assert following("--target", "80", "-k", "4", path=here) == f"Next: viewrank run '{valley}' --target 80 -k 4"
    assert following("--surface", "3d", path=here) == f"Next: viewrank export '{valley}' --backend openmvs", "run has no such option"
    assert following(path="/bin").startswith(f"Next: cd '{valley}/viewrank/openmvs'"), "the program of the plan before"
    shutil.rmtree(valley / "viewrank")
    assert following(path="/bin") == f"Next: viewrank export '{valley}' --backend sgm", "without a program and without Python"


def test_a_colmap_without_cuda_is_refused_before_planning(run, valley, tmp_path):
    colmap = tmp_path / "colmap"
    colmap.write_text("#!/bin/sh\necho \"$1\" >> \"$0.ran\"\necho '(Commit Unknown on Unknown without CUDA)'\n")
    colmap.chmod(0o755)
    out, err = run(valley, "--backend", "colmap", COLMAP=str(colmap), expect=1)
    assert f"{colmap} was built without CUDA" in err and "--backend sgm" in err
    assert (tmp_path / "colmap.ran").read_text() == "help\n" and not (valley / "viewrank").exists()


def test_images_of_half_the_size_are_matched_with_a_warning(run, valley):
    for path in (valley / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    _, err = run(valley, "--backend", "sgm", "--budget", "1", "--no-report")
    assert err.count("images of another size than their cameras: 28 of 28") == 1 and (valley / "sgm/fused.ply").stat().st_size > 10_000


def test_the_reason_of_a_failure_is_the_programs(run, valley):
    """Images without the table of quantisation, which a look at header and end does not show."""
    (valley / "viewrank.toml").write_text('confidence.source = "geometric"\n')
    for path in (valley / "images").iterdir():
        whole = path.read_bytes()
        at = whole.index(b"\xff\xdb")
        path.write_bytes(whole[:at] + whole[at + 2 + int.from_bytes(whole[at + 2 : at + 4], "big") :])
    _, err = run(valley, "--backend", "sgm", "--budget", "1", "--no-report", expect=1)
    said = err[err.index("error: ") :]
    assert re.search(r"^error: sgm made no depth map of (\S+): .*\1: no JPEG, PNG or TIFF of at most \d+ pixels that OpenCV can read\n", said) and "hint: check the images (viewrank doctor " in said, err


def test_a_python_without_the_packages_is_said(run, valley, tmp_path):
    bare = tmp_path / "python"
    bare.write_text("#!/bin/sh\necho \"ModuleNotFoundError: No module named 'numpy'\" >&2\nexit 1\n")
    bare.chmod(0o755)
    out, err = run(valley, "--backend", "sgm", "--no-report", PYTHON=str(bare), expect=1)
    assert "sgm computes no depth maps" in err and "No module named 'numpy'" in err and "PYTHON" in err
    assert not (valley / "viewrank").exists(), "found out before planning"


def test_a_program_in_the_current_folder_is_not_trusted(run, viewrank, valley):
    """It may have come with the project."""
    for name in ("DensifyPointCloud", "colmap"):
        (valley / name).write_text("#!/bin/sh\ntouch \"$0.ran\"\n")
        (valley / name).chmod(0o755)
    program = os.path.abspath(viewrank("--version").args[0])
    environment = {name: value for name, value in os.environ.items() if name not in ("DENSIFY", "COLMAP", "SGM")} | {"PATH": "/bin:"}
    start = lambda *words: subprocess.run([program, *words], cwd=valley, env=environment, capture_output=True, text=True)
    assert "Backend: sgm (no DensifyPointCloud" in start("plan", ".").stdout
    for words in (["run", ".", "--backend", "openmvs"], ["dispatch", ".", "--scheduler", "shell", "--backend", "openmvs"]):
        refused = start(*words)
        assert refused.returncode != 0 and "cannot find the program DensifyPointCloud" in refused.stderr
    assert not list(valley.glob("*.ran"))


def test_maps_of_another_program_are_none_of_this_plan(run, valley):
    run(valley, "--backend", "sgm", "--budget", "3", "--no-report", "--quiet")
    stub = valley.parent / "densify"
    stub.write_text("#!/bin/sh\nexit 1\n")
    stub.chmod(0o755)
    _, err = run(valley, "--backend", "openmvs", "--program", stub, "--budget", "1", "--no-report", expect=1)
    manifest = json.loads((valley / "viewrank/manifest.json").read_text())
    assert manifest["cut"]["clusters"] == 1, err


def test_a_run_follows_no_option_of_a_plan_that_names_files_elsewhere(run, viewrank, valley, tmp_path):
    viewrank("plan", valley, "--backend", "sgm", "--budget", "2", "--confidence", "geometric")
    path = valley / "viewrank/manifest.json"
    manifest = json.loads(path.read_text())
    private = tmp_path / "elsewhere/private"
    private.mkdir(parents=True)
    for key, option in [("surface.mesh", "--mesh"), ("pilot.maps", "--pilot"), ("region", "--region")]:
        path.write_text(json.dumps({**manifest, "typed": [*manifest["typed"], {"key": key, "value": str(private)}]}))
        _, err = run(valley, "--no-report", expect=2)
        assert f"{option} {private} of the last plan leads out of the project" in err
    # Another region, typed now, takes its place.
    _, err = run(valley, "--no-report", "--region", "auto")
    assert "--budget 2" in err and "private" not in path.read_text()


def test_a_run_goes_on_with_what_was_typed_for_its_plan(run, viewrank, valley):
    settings = lambda: json.loads((valley / "viewrank/manifest.json").read_text())["settings"]
    viewrank("plan", valley, "--backend", "sgm", "--gsd", "0.06", "-k", "8", "--budget", "2")
    _, err = run(valley, "--no-report")
    assert f"as typed for the last plan: -k 8 --budget 2 --gsd 0.06 (viewrank plan '{valley}' starts afresh)" in err
    first = settings()
    assert (first["target"]["gsd"], first["partners"]["k"], first["cut"]["budget"]) == (0.06, 8, "2")
    # Around the maps that are there, with another limit, and one number from the file.
    (valley / "viewrank.toml").write_text("partners.k = 6\n")
    _, err = run(valley, "--no-report", "--target", "60%")
    assert "as typed for the last plan: --gsd 0.06 (" in err
    then = settings()
    assert (then["target"]["gsd"], then["partners"]["k"], then["cut"]["budget"]) == (0.06, 6, None)
    viewrank("plan", valley)
    assert settings()["target"]["gsd"] < 0.06
