"""Errors, progress and Ctrl-C."""

import _thread
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import viewrank


def test_a_missing_project_is_a_read_error_with_its_path(tmp_path):
    with pytest.raises(viewrank.ReadError) as raised:
        viewrank.plan(tmp_path / "missing")
    assert raised.value.path == tmp_path / "missing" and raised.value.hint
    assert str(raised.value) == f"{raised.value.message}\nhint: {raised.value.hint}"
    assert isinstance(raised.value, viewrank.Error)


def test_what_is_printed_of_a_stranger_s_names_moves_no_cursor(valley, tmp_path):
    (tmp_path / "p").mkdir()
    shutil.copytree(valley / "sparse", tmp_path / "p/sparse")
    (tmp_path / "p/viewrank.toml").write_text('"a\\u001b[2J\\u009bä" = 1\n', encoding="utf-8")
    with pytest.raises(viewrank.SettingsError) as raised:
        viewrank.plan(tmp_path / "p")
    assert r"a\x1b[2J\x9bä" in str(raised.value) and "\x1b" in raised.value.message


@pytest.mark.parametrize(
    "keywords",
    [{"k": 0}, {"target": -0.5}, {"backend": "nothing"}, {"settings": {"partners.kk": 3}}, {"surface": "flat"}, {"time": "2h"}],
)
def test_a_wrong_setting_is_a_settings_error(valley, keywords):
    with pytest.raises(viewrank.SettingsError) as raised:
        viewrank.plan(valley, **keywords)
    assert raised.value.hint


def test_hints_name_keywords(valley):
    with pytest.raises(viewrank.SettingsError) as raised:
        viewrank.plan(valley, model="9")
    assert "model=" in raised.value.hint and "--model" not in raised.value.hint


def test_a_project_without_a_plan_cannot_be_loaded(tmp_path, valley):
    (tmp_path / "sparse").symlink_to(valley / "sparse")
    with pytest.raises(viewrank.ReadError) as raised:
        viewrank.load(tmp_path)
    assert raised.value.path == tmp_path / "viewrank" / "manifest.json"


@pytest.mark.parametrize("version", [1, 3])
def test_a_plan_of_another_version_says_so(tmp_path, valley, version):
    (tmp_path / "sparse").symlink_to(valley / "sparse")
    (tmp_path / "viewrank").mkdir()
    (tmp_path / "viewrank" / "manifest.json").write_text(f'{{"version": {version}, "order": []}}')
    with pytest.raises(viewrank.ReadError) as raised:
        viewrank.load(tmp_path)
    assert "written by another version" in raised.value.message and "viewrank plan" in raised.value.hint


def test_a_plan_of_a_model_that_has_changed_is_not_written(tmp_path, valley):
    project = tmp_path / "valley"
    shutil.copytree(valley, project, ignore=shutil.ignore_patterns("viewrank"))
    plan = viewrank.plan(project, backend="openmvs", confidence="none")
    points = project / "sparse" / "0" / "points3D.bin"
    os.utime(points, ns=(0, points.stat().st_mtime_ns + 1_000_000_000))
    for use in (plan.write, lambda: plan.export("openmvs")):
        with pytest.raises(viewrank.ReadError) as raised:
            use()
        assert "has changed since it was read" in raised.value.message and raised.value.hint
    assert not (project / "viewrank" / "manifest.json").exists()
    viewrank.plan(project, backend="openmvs", confidence="none").write()


def test_folders_without_depth_maps_are_an_evaluate_error(plan, tmp_path):
    with pytest.raises(viewrank.EvaluateError) as raised:
        viewrank.evaluate(plan, tmp_path)
    assert raised.value.path == tmp_path


def test_progress_comes_in_the_calling_thread_and_ends_each_stage(valley):
    calls = []
    caller = threading.get_ident()

    def progress(stage, done, total):
        assert threading.get_ident() == caller
        calls.append((stage, done, total))

    viewrank.plan(valley, confidence="geometric", progress=progress)
    stages = list(dict.fromkeys(stage for stage, _, _ in calls))
    assert {"surface", "visibility", "partners", "ranking"} <= set(stages)
    for stage in ("visibility", "ranking"):
        _, done, total = [call for call in calls if call[0] == stage][-1]
        assert done == total


def test_an_exception_of_the_callback_stops_the_call(valley):
    class Enough(Exception):
        pass

    seen = []

    def progress(stage, done, total):
        seen.append(stage)
        if stage == "visibility":
            raise Enough

    with pytest.raises(Enough):
        viewrank.plan(valley, confidence="geometric", progress=progress)
    assert "ranking" not in seen


@pytest.fixture
def heeds_control_c():
    """A shell ignores Ctrl-C in what it runs in the background, and Python then keeps it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_control_c_stops_the_call(valley, heeds_control_c):
    def progress(stage, done, total):
        if stage == "surface":
            _thread.interrupt_main()

    with pytest.raises(KeyboardInterrupt):
        viewrank.plan(valley, confidence="geometric", progress=progress)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_control_c_ends_the_program(valley):
    command = [str(Path(sys.executable).parent / "viewrank"), "plan", str(valley), "--dry-run"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stderr is not None and program.stderr.readline().startswith("reading the model")
        program.send_signal(signal.SIGINT)
        assert program.wait() == -signal.SIGINT


def test_other_threads_run_meanwhile(valley):
    beats = []
    stop = threading.Event()

    def beat():
        while not stop.is_set():
            beats.append(len(beats))
            stop.wait(0.001)

    thread = threading.Thread(target=beat)
    thread.start()
    before = len(beats)
    viewrank.plan(valley, confidence="geometric")
    after = len(beats)
    stop.set()
    thread.join()
    assert after > before
