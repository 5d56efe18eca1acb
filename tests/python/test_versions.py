"""benches/versions.py on sources that are made up."""

import importlib.util
import subprocess
import sys

import pytest

from conftest import ROOT

SCRIPT = ROOT / "benches/versions.py"
spec = importlib.util.spec_from_file_location("versions", SCRIPT)
versions = importlib.util.module_from_spec(spec)
sys.modules["versions"] = versions
spec.loader.exec_module(versions)

COLMAP = {
    "README.md": "COLMAP",
    "src/colmap/util/version.cc.in": '"with CUDA" "with HIP" "without GPU support"',
    "src/colmap/mvs/patch_match_cuda.cu": "memcpy(dest, bitmap.GetScanline(r), image.GetWidth());",
    "src/colmap/mvs/fusion.h": "int min_num_pixels = 5;\nint check_num_images = 50;",
    "src/colmap/mvs/patch_match_options.h": "double filter_min_triangulation_angle = 3.0f;",
    "src/colmap/mvs/model.cc": "kMinPercentile = 0.01f;\nkMaxPercentile = 0.99f;\nkStretchRatio = 0.25f;",
    "src/colmap/mvs/patch_match.cc": '"__auto__" "__all__"',
    "src/colmap/exe/mvs.cc": "mvs::WritePointsVisibility(",
    "src/colmap/controllers/option_manager.cc": '"PatchMatchStereo.geom_consistency" "PatchMatchStereo.max_image_size" "PatchMatchStereo.filter" "StereoFusion.min_num_pixels" "StereoFusion.check_num_images"',
}


def check(folder, *words):
    done = subprocess.run([sys.executable, SCRIPT, folder, *words], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.splitlines()


@pytest.fixture
def sources(tmp_path):
    for name, text in COLMAP.items():
        path = tmp_path / "colmap" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_what_we_say_is_said(sources):
    assert [fault for statements in versions.PROGRAMS.values() for fault in map(versions.unsaid, statements) if fault] == []
    code, lines = check(sources)
    assert code == 0 and "colmap the files there: 16 statements, 0 untrue or not to be checked" in lines
    assert sum("no sources" in line for line in lines) == len(versions.PROGRAMS) - 1


@pytest.mark.parametrize(
    "name, before, after, fault",
    [
        ("src/colmap/mvs/fusion.h", "= 50", "= 60", "untrue: fusion compares with 50 views"),
        ("src/colmap/mvs/patch_match_cuda.cu", "bitmap.GetScanline(r)", "bitmap.RowMajorData()", "untrue: narrower partners are copied row by row since 4.2.0"),
        ("src/colmap/mvs/model.cc", None, None, "cannot tell whether the depth range is of 1 to 99 % of the points: no src/colmap/mvs/model.cc"),
    ],
)
def test_what_has_become_untrue_is_listed(sources, name, before, after, fault):
    path = sources / "colmap" / name
    path.unlink() if before is None else path.write_text(path.read_text().replace(before, after))
    code, lines = check(sources)
    assert code == 1 and any(line.strip().startswith(fault) for line in lines)


def test_a_revision_of_a_clone_is_read(sources):
    git = ["git", "-C", sources / "colmap", "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "one"], ["tag", "4.2.0"]):
        subprocess.run([*git, *words], check=True)
    (sources / "colmap/src/colmap/mvs/fusion.h").write_text("")
    assert check(sources)[0] == 1
    code, lines = check(sources, "colmap=4.2.0")
    assert code == 0 and any(line.startswith("colmap 4.2.0 (") for line in lines)
    assert check(sources, "colmap=5.0")[1].count("colmap: no sources, 16 statements not checked") == 1
    assert check(sources, "Colmap=4.2.0")[0] == 2
