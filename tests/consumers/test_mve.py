"""MVE's dmrecon and scene2pset (MVE_BIN): `run.sh` as printed, against dmrecon choosing among all views with its own numbers."""
import numpy as np

from conftest import call, clusters_of
from measure import assert_as_good, measure, read_mvei, read_ply


def write_scene(views, source, folder):
    """All views and all tracks as MVE's own importers write them: image plane in units of the larger side, views by position."""
    names = views.names()
    position = {name: i for i, name in enumerate(names)}
    cameras = []
    for i, name in enumerate(names):
        camera, pose = views.camera(name), views.pose(name)
        k = camera.calibration_matrix()
        focal = k[0, 0] / max(camera.width, camera.height)
        view = folder / f"views/view_{i:04}.mve"
        view.mkdir(parents=True)
        row = lambda values: " ".join(str(value) for value in np.ravel(values))
        (view / "meta.ini").write_text(
            f"[camera]\nfocal_length = {focal}\npixel_aspect = {k[1, 1] / k[0, 0]}\nprincipal_point = {k[0, 2] / camera.width} {k[1, 2] / camera.height}\n"
            f"rotation = {row(pose[:, :3])}\ntranslation = {row(pose[:, 3])}\n[view]\nid = {i}\nname = {name}\n"
        )
        (view / "undistorted.jpg").symlink_to(source / "images" / name)
        cameras.append(f"{focal} 0 0\n" + "".join(row(pose[r, :3]) + "\n" for r in range(3)) + row(pose[:, 3]) + "\n")
    tracks = []
    for n, point in enumerate(views.model.points3D.values()):
        seen = sorted({position[views.model.images[e.image_id].name] for e in point.track.elements})
        tracks.append(f"{row(point.xyz)}\n{row(point.color)}\n{len(seen)} " + " ".join(f"{i} {n} 0" for i in seen) + "\n")
    (folder / "synth_0.out").write_text(f"drews 1.0\n{len(names)} {len(tracks)}\n" + "".join(cameras) + "".join(tracks))
    return position


def test_maps_are_as_good_as_dmrecons_own_choice(planned, program, views, source, tmp_path):
    dmrecon = program("MVE_BIN", "dmrecon")
    _, export = planned("mve")
    call(["./run.sh"], export, PATH=f"{dmrecon.parent}:/usr/bin:/bin")
    clusters, record = clusters_of(export)
    keys = [key for key, _ in clusters]
    scale = next(word[2:] for command in record["commands"] for word in command.split() if command.startswith("dmrecon") and word.startswith("-s"))
    folders = {meta.read_text().rsplit("name = ", 1)[1].strip(): meta.parent for meta in export.glob("views/*/meta.ini")}
    ours = {key: views.depths(key, read_mvei(folders[key] / f"depth-L{scale}.mvei")) for key in keys}
    assert len(read_ply(export / "fused.ply")) > 1000

    position = write_scene(views, source, tmp_path / "default")
    for key in keys:
        call([dmrecon, f"-s{scale}", f"-m{position[key]}", "."], tmp_path / "default")
    default = {key: views.depths(key, read_mvei(tmp_path / f"default/views/view_{position[key]:04}.mve/depth-L{scale}.mvei")) for key in keys}
    assert_as_good(measure(views, ours), measure(views, default))
