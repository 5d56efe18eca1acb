"""Plans for programs that use the images themselves, and the lines of integrations/splat/README.md."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import viewrank

README = Path(__file__).resolve().parents[2] / "integrations/splat/README.md"


def test_the_lines_of_the_readme_plan_and_export(valley, tmp_path, monkeypatch):
    (lines,) = re.findall("```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(lines.splitlines()) <= 10
    shutil.copytree(valley, tmp_path / "room", ignore=shutil.ignore_patterns("viewrank"))
    monkeypatch.chdir(tmp_path)
    trained = []
    monkeypatch.setattr(subprocess, "run", lambda command, **options: trained.append((command, options)))
    exec(compile(lines, str(README), "exec"), {})
    ((command, options),) = trained
    folder = Path(options["cwd"])
    assert command.startswith("ns-train ") and folder.samefile(tmp_path / "room/viewrank/splat")
    names = sorted(path.name for path in (tmp_path / "room/images").iterdir())
    train = (folder / "train_list.txt").read_text().splitlines()
    assert (folder / "test_list.txt").read_text().splitlines() == names[::8]
    assert len(train) == (len(names) - len(names[::8])) // 4 and not set(train) & set(names[::8])


def test_a_plan_for_images_counts_no_pairs(valley):
    plan = viewrank.plan(valley, backend="splat", budget=7, confidence="geometric")
    curve = plan.curve
    assert np.allclose(curve["fulfilment"], np.cumsum([cluster.gain for cluster in plan.ranking]))
    assert np.array_equal(curve["fulfilment"], curve["kept"]) and not curve["pairs"].any() and not curve["points"].any()
    assert repr(plan) == f"Plan(7 of 28 images, share {plan.cut['share']:.3f}, for splat)"
    assert "depth map" not in plan._repr_html_().split("</svg>")[0]


def test_settings_without_sense_count_as_not_set(valley):
    plan = viewrank.plan(valley, backend="splat", confidence="geometric", points="1M")
    assert any("cut.points counts as not set" in warning for warning in plan.warnings)
    plan = viewrank.plan(valley, backend="openmvs", confidence="geometric", test_every=8)
    assert any("test_every counts as not set" in warning for warning in plan.warnings) and plan.settings.get("test_every") is None
    with pytest.raises(viewrank.SettingsError):
        viewrank.plan(valley, backend="splat", test_every=1)


def test_test_images_are_neither_ranked_nor_exported_for_training(valley, tmp_path):
    plan = viewrank.plan(valley, backend="splat", confidence="geometric", target=1, test_every=4)
    kept = set(plan.names[::4])
    assert not kept & {cluster.key for cluster in plan.ranking} and plan.settings["test_every"] == 4
    export = plan.export("splat", tmp_path / "splat")
    splits = json.loads((export.folder / "transforms.json").read_text())
    assert {f"images/{name}" for name in kept} == set(splits["test_filenames"])
    assert not kept & set((export.folder / "train_list.txt").read_text().splitlines())
