"""PMVS2 (PMVS_BIN): the printed command, against PMVS2 that chooses partners by itself, for the same key views."""
import numpy as np
from scipy.spatial import cKDTree

from conftest import call
from measure import read_ply


def covered(views, patches, spacing):
    """Share of the sparse points that have a patch within `spacing`, and the median distance of patches to the next sparse point."""
    points = np.array([p.xyz for p in views.model.points3D.values()])
    distance, _ = cKDTree(patches).query(points)
    return (distance < spacing).mean()


def test_patches_are_as_good_as_its_own_choice(planned, program, views):
    pmvs = program("PMVS_BIN", "pmvs2")
    _, export = planned("pmvs")
    options = (export / "option-viewrank").read_text()
    call("pmvs2 ./ option-viewrank", export, PATH=f"{pmvs.parent}:/usr/bin:/bin")
    own = options.replace("useVisData 1", "useVisData 0")
    assert own != options
    (export / "option-own").write_text(own)
    call("pmvs2 ./ option-own", export, PATH=f"{pmvs.parent}:/usr/bin:/bin")
    ours, default = (read_ply(export / f"models/option-{name}.ply") for name in ("viewrank", "own"))
    points = np.array([p.xyz for p in views.model.points3D.values()])
    spacing = 2 * np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    shares = [covered(views, cloud, spacing) for cloud in (ours, default)]
    print(f"{len(ours)} patches near {100 * shares[0]:.1f} % of the sparse points as planned; {len(default)} near {100 * shares[1]:.1f} % by itself")
    assert shares[0] >= shares[1] - 0.03
