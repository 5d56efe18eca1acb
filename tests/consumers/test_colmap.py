"""COLMAP with CUDA (COLMAP_BIN): `run.sh` as printed, against `patch_match_stereo` with automatic source images for the same key views."""
import subprocess

import numpy as np
import pytest

from conftest import call, clusters_of
from measure import assert_as_good, measure


def read_map(path):
    data = path.read_bytes()
    width, height, channels, values = data.split(b"&", 3)
    assert channels == b"1"
    return np.frombuffer(values, "<f4", int(width) * int(height)).reshape(int(height), int(width))


def test_maps_are_as_good_as_automatic_sources(planned, program, views, tmp_path):
    colmap = program("COLMAP_BIN", "colmap")
    if b"without CUDA" in subprocess.run([colmap, "-h"], capture_output=True, check=False).stdout:
        pytest.skip("this COLMAP has no CUDA, which patch_match_stereo needs: COLMAP_BIN is the folder of one that has")
    _, export = planned("colmap")
    keys = [key for key, _ in clusters_of(export / "stereo/viewrank")[0]]
    call(["stereo/viewrank/run.sh"], export, PATH=f"{colmap.parent}:/usr/bin:/bin")
    maps = export / "stereo/depth_maps"
    ours = {key: read_map(maps / f"{key}.photometric.bin") for key in keys}
    size = str(max(next(iter(ours.values())).shape))
    for path in maps.glob("**/*.bin"):
        path.unlink()
    (export / "stereo/patch-match.cfg").write_text("".join(f"{key}\n__auto__, 20\n" for key in keys))
    options = ["--PatchMatchStereo.geom_consistency", "0", "--PatchMatchStereo.filter", "1", "--PatchMatchStereo.max_image_size", size]
    call([colmap, "patch_match_stereo", "--workspace_path", str(export), *options], export)
    default = {key: read_map(maps / f"{key}.photometric.bin") for key in keys}
    assert_as_good(measure(views, ours), measure(views, default))
