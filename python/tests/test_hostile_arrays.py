"""Arrays that are not what they should be: a typed error or a plan, never a crash."""

import numpy as np
import pytest
from test_models import arrays

import viewrank

NUMBERS = ["cam_from_world", "points", "pixels"]
INTEGERS = ["camera", "observations"]
SPECIAL = [np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, -1.0, 0.0]
HUGE = [-1, 2**31, 2**32, 2**62, -(2**63), 2**63 - 1]
ALLOWED = (viewrank.Error, ValueError, TypeError, OverflowError)


def try_plan(given):
    """Reads and plans; true if both are done."""
    try:
        scene = viewrank.Scene.from_arrays(**given)
        plan = viewrank.plan(scene, confidence="geometric", backend="sgm", budget=3)
    except ALLOWED as error:
        assert str(error)
        return False
    assert np.all(np.isfinite(plan.curve["share"] if isinstance(plan.curve, dict) else [0.0]))
    return True


def of(scene, name):
    return np.array(arrays(scene)[name])


@pytest.mark.parametrize("name", NUMBERS + INTEGERS)
def test_other_shapes_are_errors(scene, name):
    given = of(scene, name)
    shapes = [given[..., None], given[0], given.reshape(-1)[:-1], given[:-1], given[:0], given.T.copy() if given.ndim > 1 else given[None], np.array(1.0)]
    for wrong in shapes:
        # Pixels are optional: none at all are as good as not given.
        if name == "points" and wrong.shape == given[:-1].shape or wrong.shape == given.shape or (name == "pixels" and len(wrong.shape) == 2 and not len(wrong)):
            continue
        assert not try_plan(arrays(scene, **{name: wrong})), wrong.shape


@pytest.mark.parametrize("name", NUMBERS + INTEGERS)
@pytest.mark.parametrize("kind", ["f4", "f8", "f2", "i1", "i8", "u1", "u8", "c16", "b1", "O", "U8", "S8", "M8[s]", ">f8", ">i4"])
def test_other_types_are_errors_or_the_same(scene, name, kind):
    try:
        other = of(scene, name).astype(kind)
    except (TypeError, ValueError):
        return
    try_plan(arrays(scene, **{name: other}))


@pytest.mark.parametrize("name", NUMBERS)
def test_special_numbers_anywhere(scene, name):
    random = np.random.default_rng(1)
    for value in SPECIAL:
        given = of(scene, name)
        given.reshape(-1)[random.integers(given.size, size=1 + random.integers(5))] = value
        done = try_plan(arrays(scene, **{name: given}))
        assert not (done and np.isnan(value)), "nan is no number"
        try_plan(arrays(scene, **{name: np.full_like(of(scene, name), value)}))


@pytest.mark.parametrize("name", INTEGERS)
def test_indices_out_of_range_are_errors(scene, name):
    random = np.random.default_rng(2)
    for value in HUGE:
        given = of(scene, name).astype(np.int64)
        given.reshape(-1)[random.integers(given.size)] = value
        assert not try_plan(arrays(scene, **{name: given})), value


def test_strides_do_not_matter(scene):
    strided = {name: np.repeat(of(scene, name), 2, axis=0)[::2] for name in NUMBERS + INTEGERS}
    backwards = {name: of(scene, name)[::-1].copy()[::-1] for name in NUMBERS + INTEGERS}
    for given in (strided, backwards):
        again = viewrank.Scene.from_arrays(**arrays(scene, **given))
        assert np.array_equal(again.points, scene.points) and np.array_equal(again.track_pixels, scene.track_pixels)


@pytest.mark.parametrize(
    "changes",
    [
        {"names": []},
        {"names": ["a"]},
        {"names": [""] * 28},
        {"names": ["same"] * 28},
        {"names": [f"a\0{i}" for i in range(28)]},
        {"names": [f"\ud800{i}" for i in range(28)]},
        {"names": list(range(28))},
        {"names": "a string of 28 letters......"},
        {"cameras": []},
        {"cameras": [("NOTHING", 10, 10, [1.0])]},
        {"cameras": [("PINHOLE", 10, 10, [1.0])]},
        {"cameras": [("PINHOLE", 2**32, 10, [1.0, 1.0, 1.0, 1.0])]},
        {"cameras": [("PINHOLE", -1, 10, [1.0, 1.0, 1.0, 1.0])]},
        {"cameras": [("PINHOLE", 10, 10, [float("nan")] * 4)]},
        {"cameras": [("PINHOLE", 10, 10, [0.0] * 4)]},
        {"cameras": [("PINHOLE", 10, 10, None)]},
        {"points": None},
        {"observations": None},
        {"cam_from_world": [[["a"]]]},
    ],
)
def test_what_is_no_model_is_an_error(scene, changes):
    assert not try_plan(arrays(scene, **changes))


@pytest.mark.parametrize("seed", range(20))
def test_random_models_are_errors_or_plans(seed):
    random = np.random.default_rng(seed)
    views, points = random.integers(0, 6), random.integers(0, 12)
    count = random.integers(0, 40)
    scale = 10.0 ** random.integers(-200, 200)
    try_plan(
        {
            "names": [f"{i}.jpg" for i in range(views)],
            "cameras": [viewrank.Camera("PINHOLE", 100, 80, (90.0, 90.0, 50.0, 40.0))] if hasattr(viewrank, "Camera") else [("PINHOLE", 100, 80, [90.0, 90.0, 50.0, 40.0])],
            "camera": np.zeros(views, np.int64),
            "cam_from_world": np.concatenate([np.broadcast_to(np.eye(3), (views, 3, 3)), scale * random.normal(size=(views, 3, 1))], axis=2),
            "points": scale * random.normal(size=(points, 3)),
            "observations": np.stack([random.integers(0, max(points, 1), count), random.integers(0, max(views, 1), count)], axis=1),
            "pixels": random.uniform(-10, 110, size=(count, 2)),
        }
    )
