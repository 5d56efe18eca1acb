"""Names, settings and files of a project that hold terminal sequences, in every subcommand on a real pseudo-terminal: what arrives there is
printable text, line breaks, and the colours and progress bars of viewrank itself."""
import fcntl
import json
import os
import pty
import re
import shlex
import shutil
import signal
import struct
import subprocess
import termios
import time
import tomllib

import numpy
import pycolmap
import pytest
from conftest import LONG, spread

PROGRAM = os.path.abspath(os.environ.get("VIEWRANK", "target/debug/viewrank"))
# Title, colour, clearing; the same by one character; directions; separators and blanks without width; backspace, return, end of line.
FORGED = "\x1b]0;title\x07\x1b[38;5;123m\x1b[2J\u009b31m\u009d\u202e\u2066\u200b\u2028\u2029\ufeff\u00ad\x7f\b\t\v\r\nerror:FORGED"
# Bars of indicatif clear their line; the kernel's terminal adds the carriage return to a line break.
BAR = re.compile("\r?\x1b\\[2K|\x1b\\[1?A|\x1b\\[0?G|\r(?=\n)")
COLOUR = re.compile("\x1b\\[[0-9;]*m")


def on_terminal(*arguments, limit=120, **variables):
    """Runs a command whose standard streams are a terminal of 80 columns; returns its exit code and what it printed there."""
    terminal, end = pty.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    environment = {**os.environ, "TERM": "xterm-256color", **variables}
    process = subprocess.Popen([PROGRAM, *map(str, arguments)], stdin=end, stdout=end, stderr=end, env=environment, start_new_session=True)
    os.close(end)
    since, printed = time.monotonic(), b""
    os.set_blocking(terminal, False)
    while True:
        ended = process.poll() is not None
        try:
            while part := os.read(terminal, 1 << 16):
                printed += part
        except BlockingIOError:
            pass
        except OSError:
            ended = True
        if ended:
            break
        if time.monotonic() - since > limit:
            process.send_signal(signal.SIGTERM)
        time.sleep(0.01)
    os.close(terminal)
    return process.wait(), printed


def check(arguments, printed):
    """Fails if something else than printable text, line breaks and viewrank's own sequences was printed."""
    text = BAR.sub("", printed.decode())
    assert "38;5;123" not in "".join(COLOUR.findall(text)), f"{arguments}: a colour of the project: {printed}"
    text = COLOUR.sub("", text)
    wrong = {c for c in text if c != "\n" and not c.isprintable()}
    assert not wrong, f"{arguments}: {wrong} in {printed}"
    forged = [line for line in text.split("\n") if re.match(r"\W*(error:)?FORGED", line)]
    assert not forged, f"{arguments}: {forged} is no line of viewrank's: {printed}"
    return text


def checked(*arguments, **options):
    code, printed = on_terminal(*arguments, **options)
    assert code in (0, 1, 2, 3, 4, -signal.SIGTERM), f"{arguments}: {code}, {printed}"
    return check(arguments, printed)


def make(fixtures, root, forged):
    """fixtures/valley with these characters in the names of the folder, the images and the masks."""
    project = root / f"a{forged}" / f"b{forged}"
    model = pycolmap.Reconstruction(fixtures / "valley/sparse/0")
    for folder in ("images", "masks", "sparse/0"):
        (project / folder).mkdir(parents=True)
    for i, image in enumerate(model.images.values()):
        name = f"{i}{forged}.jpg"
        shutil.copy(fixtures / "valley/images" / image.name, project / "images" / name)
        (project / "masks" / f"{name}.png").write_bytes(b"no image")
        image.name = name
    (project / "images" / f"stranger{forged}.jpg").write_bytes(b"no image")
    model.write_binary(project / "sparse/0")
    return project


def names(project):
    return sorted(path.name for path in (project / "images").iterdir() if not path.name.startswith("stranger"))


def make_maps(project, forged):
    folder = project / f"maps{forged}"
    folder.mkdir()
    for name in names(project)[:6]:
        numpy.save(folder / f"{name}.npy", numpy.full((30, 40), 10, numpy.float32))
    (folder / f"{names(project)[6]}.npy").write_bytes(b"no array")
    numpy.save(folder / f"stranger{forged}.jpg.npy", numpy.full((30, 40), 10, numpy.float32))
    return folder


def program(folder, forged):
    """A matcher that says such things and fails."""
    path = folder / f"match{forged}"
    path.write_text(f"#!/bin/sh\nprintf %s\\\\n {shlex.quote(forged)} >&2\nexit 3\n")
    path.chmod(0o755)
    return path


def backends():
    listed = json.loads(subprocess.run([PROGRAM, "backends", "--format", "json"], capture_output=True, check=True).stdout)
    return [backend["name"] for backend in listed]


def subcommands():
    text = subprocess.run([PROGRAM, "--help"], capture_output=True, text=True, check=True).stdout
    return re.findall(r"^  ([a-z]+) ", text.split("Commands:")[1].split("Options:")[0], re.M)


def options(subcommand):
    text = subprocess.run([PROGRAM, subcommand, "--help"], capture_output=True, text=True, check=subcommand != "help").stdout
    return re.findall(r"^ +(?:-\w, )?(--[a-z-]+|-\w)\b", text, re.M)


def calls(subcommand, project, maps, matcher, forged):
    """The ways to call a subcommand; a new one has to be added."""
    out = ["--out", project.parent / f"out{forged}"]
    every = {
        "plan": [["--budget", "3"], ["--backend", "openmvs", "--report"], ["--dry-run", "--format", "json"], ["--finished", maps, "--backend", "sgm"]],
        "pilot": [[], ["--backend", "openmvs"], out],
        "run": [["--backend", "openmvs", "--program", matcher], ["--backend", "openmvs", "--program", matcher, "--rank", "1"], ["--program", matcher, "--fuse"], ["--backend", "colmap", "--program", matcher, "--format", "json"], ["--backend", "mve"]],
        "evaluate": [["--depth-maps", maps], ["--depth-maps", maps, "--format", "json"], ["--depth-maps", maps, "--baselines"]],
        "train": [["--depth-maps", maps], ["--depth-maps", maps, "--format", "json"]],
        "predict": [out, [*out, "--format", "json"]],
        "export": [[*more, "--backend", backend] for backend in backends() for more in ([], ["--dry-run"])] + [["--format", "json"], ["--tiles", "2", *out]],
        "report": [[], ["--format", "json"], out],
        "doctor": [[], ["--all"], ["--format", "json"], ["--backend", ",".join(backends())]],
        "undistort": [[], ["--format", "json"], [*out, "--max-image-size", "40"]],
        "config": [[], ["--format", "json"]],
        "dispatch": [["--scheduler", "shell", *more, "--program", matcher] for more in ([], ["--dry-run"], ["--format", "json"])] + [["--scheduler", "slurm", "--dry-run"]],
        "inspect": [[], ["--format", "json"]],
        "watch": [["--once", "--settle", "10ms", *more] for more in ([], ["--log-format", "json"], ["--backend", "openmvs"], ["--replan"])],
        "status": [[], ["--format", "json"]],
        "backends": None, "completions": None, "man": None, "help": None,
    }
    if every[subcommand] is None:
        return [[subcommand], [subcommand, forged], [subcommand, "plan"], [subcommand, "bash"], [subcommand, "colmap"]]
    of = project.parent if subcommand in ("watch", "status") else project
    return [[subcommand, of, *map(str, call)] for call in every[subcommand]]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


# With and without line breaks, at which some readers and writers stop.
FORMS = {"lines": FORGED, "one line": re.sub("[\t\v\r\n]", "", FORGED)}


@pytest.fixture(scope="module")
def forged(request):
    return FORMS[request.param]


def in_turn(start):
    """Each subcommand with one of the forms, in turn, or with both with VIEWRANK_LONG=1."""
    cases = [(form, subcommand) for j, form in enumerate(FORMS) for i, subcommand in enumerate(subcommands(), start) if LONG or (i + j) % 2 == 0]
    return pytest.mark.parametrize("forged, subcommand", cases, indirect=["forged"])


both = pytest.mark.parametrize("forged", FORMS, indirect=True)


@pytest.fixture(scope="module")
def world(fixtures, tmp_path_factory, forged):
    root = tmp_path_factory.mktemp("terminal")
    project = make(fixtures, root, forged)
    (project / "viewrank.toml").write_text("image_scale = 0.25\n")
    return root, project, make_maps(project, forged), program(root, forged)


@in_turn(0)
def test_every_subcommand(world, forged, subcommand):
    _, project, maps, matcher = world
    if not (project / "viewrank").exists():
        checked("plan", project, "--backend", "sgm", "--confidence", "none", "--budget", "3")
    said = [checked(*call) for call in calls(subcommand, project, maps, matcher, forged)]
    assert any(said), "something is said"


@in_turn(1)
def test_arguments(world, forged, subcommand):
    root, project, *_ = world
    checked(subcommand, root / f"nowhere{forged}")
    checked(subcommand, forged)
    checked(f"{subcommand}{forged}")
    for i, option in enumerate(options(subcommand)):
        ways = [root / "nowhere", option, forged], [project, f"{option}={forged}"], [project, option + forged]
        # One way of each option without VIEWRANK_LONG=1.
        for words in ways if LONG else [ways[i % 3]]:
            checked(subcommand, *words, limit=1 if subcommand == "watch" else 20)


@both
def test_settings(fixtures, tmp_path, forged):
    """Each setting with such a value, which is refused or used, and printed again as a settings file of the same value."""
    project = tmp_path / "project"
    shutil.copytree(fixtures / "valley", project)
    keys = [key["key"] for key in json.loads(subprocess.run([PROGRAM, "config", "--format", "json"], capture_output=True, check=True).stdout)]
    assert len(keys) > 40
    basic = "".join(c if c.isascii() and c.isprintable() and c not in "\"\\" else f"\\U{ord(c):08x}" for c in forged)
    broken = [f'"{basic}" = 1', f"[{forged}", f'seed = "{forged}"', f'partners."{basic}" = 2']
    accepted = 0
    typed = [f"{key} = {value}" for key in keys for value in (f'"{basic}"', f'["{basic}"]')]
    # Half of them with each of the forms without VIEWRANK_LONG=1.
    typed = [text for i, text in enumerate(typed) if LONG or (i // 2 + i + (forged == FORGED)) % 2]
    for text in typed + broken:
        (project / "viewrank.toml").write_text(text)
        code, printed = on_terminal("config", project)
        shown = check(text, printed)
        if code == 0:
            accepted += 1
            key, value = text.split(" = ")[0].split("."), tomllib.loads(text)
            for part in key:
                value = value[part]
            again = tomllib.loads(shown)
            for part in key:
                again = again.get(part, {}) if isinstance(again, dict) else again
            # Paths are printed whole, commands as comments.
            assert again in (value, {}) or again.endswith(value), (text, again)
            checked("plan", project, "--dry-run", "--confidence", "none", "--budget", "2")
            checked("doctor", project)
    assert accepted


def replaced(value, name, forged):
    """The JSON value with such characters at the end of all strings of this name."""
    match value:
        case dict():
            return {key: replaced(item, name, forged) if key != name or not isinstance(item, str) else item + forged for key, item in value.items()}
        case list():
            return [item + forged if isinstance(item, str) else replaced(item, name, forged) for item in value]
    return value


def keys_of(value):
    match value:
        case dict():
            return {key for key, item in value.items() if isinstance(item, str)}.union(*map(keys_of, value.values()))
        case list():
            return set().union(*map(keys_of, value))
    return set()


@both
def test_earlier_files(fixtures, tmp_path, forged):
    """Strings of each file that viewrank wrote."""
    project = tmp_path / "project"
    shutil.copytree(fixtures / "valley", project)
    checked("watch", tmp_path, "--once", "--settle", "10ms", "--backend", "openmvs")
    maps = make_maps(project, "")
    checked("evaluate", project, "--depth-maps", maps)
    files = [path for path in tmp_path.rglob("*.json") if path.is_file() and ".sets" not in path.parts]
    assert {"manifest.json", "status.json", "export.json"} <= {path.name for path in files}
    for path in files:
        whole = path.read_bytes()
        value = json.loads(whole)
        for name in spread([*sorted(keys_of(value)), None], 2):
            path.write_text(json.dumps(replaced(value, name, forged)))
            for command in (["status", tmp_path], ["status", project, "--json"], ["doctor", project], ["export", project, "--dry-run"],
                            ["dispatch", project, "--dry-run", "--backend", "openmvs"]):
                checked(*command)
        path.write_bytes(whole)
    failed = {"project": f"p{forged}", "state": "failed", "reason": f"why{forged}", "hint": f"do{forged}", "retry_after_s": 1, "since": 0}
    status = json.loads((tmp_path / "viewrank/status.json").read_text())
    (tmp_path / "viewrank/status.json").write_text(json.dumps({**status, "host": f"h{forged}", "notices": [forged], "projects": [failed]}))
    assert "why" in checked("status", tmp_path) and "do" in checked("status", tmp_path)
    checked("status", tmp_path, "--follow", limit=1.5)


@both
def test_models_of_other_programs(fixtures, tmp_path, forged):
    """Words of text formats, each in place of those of a fixture."""
    read = 0
    for path in sorted(path for path in (fixtures / "formats").rglob("*") if path.suffix in (".txt", ".json", ".xml", ".nvm", ".sfm", ".ori", ".out")):
        folder = tmp_path / str(read)
        shutil.copytree(path.parent, folder)
        text = path.read_text(errors="surrogateescape")
        words = sorted(set(re.findall(r"[A-Za-z_][A-Za-z_0-9.]{3,}", text)), key=lambda word: (len(word), word))
        for word in spread(words, 2):
            (folder / path.name).write_text(text.replace(word, word + forged), errors="surrogateescape")
            checked("inspect", folder)
        read += 1
    assert read > 40


def test_errors_and_hints_wrap_at_words(tmp_path):
    _, printed = on_terminal("plan", tmp_path)
    lines = COLOUR.sub("", printed.decode()).replace("\r", "").splitlines()
    assert lines[0].startswith("error: no sparse model") and len(lines) > 3 and all(len(line) <= 80 or " " not in line.strip() for line in lines)
