"""integrations/openmvs/run.py with depth maps of both kinds that OpenMVS writes, `DR` and `D2`, and of one that came later."""

import importlib.util
import struct

import pytest
from test_openmvs_runner import RUNNER, folder, make, maps, run, scenes  # noqa: F401

ALL = range(3)


def of_kind(kind, **more):
    return {f"k{i}": [dict(ids=[10 + i, 2, 1], range=[90, 220], depth=150, kind=kind, **more)] for i in ALL}


@pytest.mark.parametrize("kind", ["DR", "D2"])
def test_maps_of_both_kinds_are_checked_kept_and_fused(folder, kind):
    make(folder, **of_kind(kind))
    done, calls, report = run(folder)
    assert done.returncode == 0 and len(scenes(calls)) == 4 and scenes(calls)[-1] == "fusing.mvs", done.stderr
    assert {(row["kind"], row["filled"], *row["range"], *row["size"]) for row in report.values()} == {(kind, 1.0, 90, 220, 4, 4)}
    assert scenes(run(folder)[1]) == ["fusing.mvs"], "nothing is made again"


def test_a_map_of_the_new_kind_without_depths_or_cut_off_is_not_fused(folder):
    changed = {**of_kind("D2"), "k0": [dict(ids=[10, 1, 2], range=[90, 220], depth=0, kind="D2")], "k1": [dict(ids=[11, 1, 2], range=[90, 220], depth=150, kind="D2", bytes=20)]}
    make(folder, **changed)
    done, _, report = run(folder)
    assert done.returncode == 1
    assert report["k0"]["problems"] == ["only 0.0 % of the pixels have a depth"]
    assert report["k1"]["problems"][0] == "unreadable depth map: cut off" and not report["k2"]["problems"]


@pytest.mark.parametrize("kind", ["D3", "XY"])
def test_a_map_that_came_after_the_runner_is_newer_and_not_damaged(folder, kind):
    make(folder, **of_kind(kind))
    done, calls, report = run(folder)
    assert done.returncode == 1 and scenes(calls) == ["clusters/0.mvs"] and not report, "no other is computed for nothing"
    assert f"depth map of kind {kind} " in done.stderr and "newer than this run.py" in done.stderr and "unreadable" not in done.stdout + done.stderr
    assert maps(folder)["depth0010.dmap"][:2] == kind.encode(), "kept for a viewrank that reads it"


@pytest.mark.parametrize("words", [[], ["--rank", "2"]])
def test_maps_of_two_kinds_are_not_mixed(folder, words):
    make(folder, **of_kind("DR"))
    run(folder, "--stop-at", "1")
    before = maps(folder)
    make(folder, **of_kind("D2"))
    done, calls, _ = run(folder, *words)
    assert done.returncode == 1 and scenes(calls) == ["clusters/1.mvs"]
    assert "writes maps of kind D2" in done.stderr and "depth0010.dmap is of kind DR" in done.stderr
    assert maps(folder) == before
    for again in (words, ["--stop-at", "0"]):
        done, calls, _ = run(folder, *again)
        assert done.returncode == 1 and "writes maps of kind D2" in done.stderr and not calls, "no other is computed for nothing"
    (folder / "kinds.json").unlink()
    make(folder, **of_kind("DR"))
    assert run(folder)[0].returncode == 0


def test_maps_of_two_kinds_are_not_fused(folder):
    make(folder, **of_kind("D2"))
    run(folder)
    path = folder / "depth0012.dmap"
    path.unlink()
    make(folder, **of_kind("DR"))
    for name in ("depth0010.dmap", "depth0011.dmap"):
        (folder / name).rename(folder.parent / name)
    (folder / "kinds.json").unlink()
    assert run(folder, "--rank", "3")[0].returncode == 0 and path.read_bytes()[:2] == b"DR"
    for name in ("depth0010.dmap", "depth0011.dmap"):
        (folder.parent / name).rename(folder / name)
    (folder / "kinds.json").unlink()
    done, calls, _ = run(folder, "--stop-at", "0")
    assert done.returncode == 1 and not calls and "maps of the kinds D2 and DR" in done.stdout


def test_enlarging_a_map_of_the_new_kind(tmp_path):
    spec = importlib.util.spec_from_file_location("runner", RUNNER)
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    k = [500.0, 0, 1.5, 0, 510.0, 1.0, 0, 0, 1]
    head = b"D2" + bytes([15, 3]) + struct.pack("<4I3f", 4, 3, 4, 3, 1, 9, 1.0) + struct.pack("<H", 1) + b"a" + struct.pack("<I2I", 2, 10, 1)
    confidences = [0, 128, 230, 242, *[255] * 8]  # 0, 0.5, 0.9, 0.95 and 1
    planes = struct.pack("<12e", *range(1, 13)) + struct.pack("<24h", *range(24)) + bytes(confidences) + struct.pack("<12I", *range(12))
    path = tmp_path / "depth0010.dmap"
    path.write_bytes(head + struct.pack("<21d", *k, *range(12)) + planes)
    large = runner.enlarged(path, [8, 6])
    start = len(head) + 168
    assert len(large) == start + 48 * 11 and struct.unpack_from("<4I", large, 4) == (8, 6, 8, 6)
    assert struct.unpack_from("<24e", large, start)[:16] == (1, 1, 2, 2, 3, 3, 4, 4) * 2
    assert struct.unpack_from("<8h", large, start + 96) == (0, 1, 0, 1, 2, 3, 2, 3)
    found = [byte / 255 for byte in large[start + 96 + 192 : start + 96 + 192 + 48]]
    first = [0, 0, 0, 0, 0.6, 0.6, 0.8, 0.8]
    assert found == pytest.approx([*first, *first, *[1] * 32], abs=0.01)
    assert struct.unpack_from("<4I", large, start + 96 + 192 + 48) == (0, 0, 1, 1)
    assert struct.unpack_from("<9d", large, len(head))[:3] == (1000.0, 0, 3.5)
