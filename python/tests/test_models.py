"""Models in memory: arrays and pycolmap."""

import numpy as np
import pytest

import viewrank


def observations(scene):
    point = np.repeat(np.arange(len(scene.points)), np.diff(scene.track_offsets.astype(np.int64)))
    return np.stack([point, scene.track_views], axis=1)


def arrays(scene, **changes):
    """The arguments of Scene.from_arrays that make the scene again."""
    return {
        "names": scene.names,
        "cameras": scene.cameras,
        "camera": scene.camera,
        "cam_from_world": scene.cam_from_world,
        "points": scene.points,
        "observations": observations(scene),
        "pixels": scene.track_pixels,
        **changes,
    }


def test_the_arrays_of_a_scene_have_their_shapes_and_frames(scene):
    views, points = len(scene.names), len(scene.points)
    assert scene.names == sorted(scene.names) and scene.camera.shape == (views,)
    assert scene.cam_from_world.shape == (views, 3, 4) and scene.points.shape == (points, 3)
    assert scene.track_offsets.shape == (points + 1,) and scene.track_offsets[-1] == len(scene.track_views)
    # Points project to where they were measured: pinhole, pixels have their centres at 0.5.
    point, view = observations(scene).T
    pose = scene.cam_from_world[view]
    local = np.einsum("oij,oj->oi", pose[:, :, :3], scene.points[point]) + pose[:, :, 3]
    assert np.all(local[:, 2] > 0)
    fx, fy, cx, cy = scene.cameras[0].params[:4]
    pixels = local[:, :2] / local[:, 2:] * [fx, fy] + [cx, cy]
    assert np.median(np.linalg.norm(pixels - scene.track_pixels, axis=1)) < 1.0
    assert np.allclose(scene.centres, [-pose[:, :3].T @ pose[:, 3] for pose in scene.cam_from_world])


def test_a_plan_of_arrays_is_the_plan_of_the_project(valley, scene, plan):
    again = viewrank.plan(arrays(scene), backend="openmvs", k=5, target=0.9, confidence="geometric")
    assert [(c.key, c.partners) for c in again.ranking] == [(c.key, c.partners) for c in plan.ranking]
    of_scene = viewrank.plan(scene, backend="openmvs", k=5, target=0.9, confidence="geometric")
    assert of_scene.ranking == plan.ranking


def test_views_may_come_in_any_order(scene, plan):
    order = np.random.default_rng(0).permutation(len(scene.names))
    place = np.argsort(order)
    seen = observations(scene)
    shuffled = arrays(
        scene,
        names=[scene.names[v] for v in order],
        camera=scene.camera[order],
        cam_from_world=scene.cam_from_world[order],
        observations=np.stack([seen[:, 0], place[seen[:, 1]]], axis=1),
    )
    again = viewrank.plan(shuffled, backend="openmvs", k=5, target=0.9, confidence="geometric")
    assert [c.key for c in again.clusters] == [c.key for c in plan.clusters]


def test_pixels_may_be_left_out(scene):
    without = viewrank.Scene.from_arrays(**arrays(scene, pixels=None))
    assert np.median(np.linalg.norm(without.track_pixels - scene.track_pixels, axis=1)) < 1.0


def test_a_model_in_memory_is_written_where_a_folder_is_given(valley, scene, tmp_path):
    folder = tmp_path / "project"
    plan = viewrank.plan(arrays(scene), images=valley / "images", folder=folder, confidence="geometric")
    assert plan.write() == folder / "viewrank"
    assert viewrank.load(folder).ranking == plan.ranking
    assert viewrank.read(folder).images == valley / "images"
    # The same model again is no conflict, another one is.
    viewrank.Scene.from_arrays(**arrays(scene), images=valley / "images", folder=folder)
    with pytest.raises(viewrank.WriteError) as raised:
        viewrank.Scene.from_arrays(**arrays(scene, points=scene.points + 1.0), folder=folder)
    assert raised.value.path == folder


def test_a_model_without_a_folder_is_exported_but_not_written(valley, scene, tmp_path):
    plan = viewrank.plan(arrays(scene), images=valley / "images", confidence="geometric")
    assert plan.folder is None
    with pytest.raises(viewrank.WriteError) as raised:
        plan.write()
    assert "folder=" in raised.value.hint
    assert (plan.export("sgm", tmp_path / "sgm").folder / "export.json").is_file()
    assert plan.report(tmp_path / "page.html").is_file()


@pytest.mark.parametrize(
    "change",
    [
        {"cam_from_world": np.zeros((28, 3, 3))},
        {"cam_from_world": np.zeros((28, 3, 4))},
        {"observations": [[0, 99]]},
        {"observations": [[0, -1]]},
        {"names": ["a.jpg"] * 28},
        {"cameras": [("LENS", 1, 1, [1.0])]},
        {"points": np.zeros((4, 2))},
        {"pixels": [[0.0, 0.0]]},
    ],
)
def test_arrays_that_are_no_model_are_a_read_error(scene, change):
    with pytest.raises(viewrank.Error) as raised:
        viewrank.Scene.from_arrays(**arrays(scene, **change))
    assert raised.value.hint


def test_a_reconstruction_is_planned_as_its_project(valley, plan, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction(valley / "sparse" / "0" if (valley / "sparse" / "0").is_dir() else valley / "sparse")
    keywords = {"backend": "openmvs", "k": 5, "target": 0.9, "confidence": "geometric"}
    again = viewrank.plan(reconstruction, images=valley / "images", **keywords)
    assert again.ranking == plan.ranking and again.folder is None
    kept = viewrank.plan(reconstruction, images=valley / "images", folder=tmp_path / "kept", **keywords)
    assert kept.write() == tmp_path / "kept" / "viewrank" and viewrank.load(tmp_path / "kept").ranking == plan.ranking


def test_anything_else_is_a_type_error():
    with pytest.raises(TypeError):
        viewrank.plan(3)
