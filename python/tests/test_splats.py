"""Plans for programs that use the images themselves."""

import numpy as np
import pytest

import viewrank


def test_a_plan_for_images_counts_no_pairs(valley):
    plan = viewrank.plan(valley, backend="splat", budget=7, confidence="geometric")
    curve = plan.curve
    assert np.allclose(curve["fulfilment"], np.cumsum([cluster.gain for cluster in plan.ranking]))
    assert np.array_equal(curve["fulfilment"], curve["kept"]) and not curve["pairs"].any() and not curve["points"].any()
    assert repr(plan) == f"Plan(7 of 28 images, share {plan.cut['share']:.3f}, for splat)"
    assert "depth map" not in plan._repr_html_().split("</svg>")[0]


def test_settings_without_sense_are_refused(valley):
    with pytest.raises(viewrank.SettingsError) as raised:
        viewrank.plan(valley, backend="splat", points="1M")
    assert "budget=" in raised.value.hint
