"""The workbench of a notebook, driven by its widgets as a person's mouse does it."""

from __future__ import annotations

import numpy as np
import pytest

import bstcad
from bstcad.scene.scene import load
from tests.app.conftest import SMALL


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


def test_a_widget_changes_scene_text_and_preview(path):
    bench = bstcad.workbench(path)
    light = bench.preview.pictures[0][1]
    bench.controls["target.z"].value = 60.0
    assert bench.scene.target.z == 60.0 and bench.text == SMALL.replace("z = 100.0", "z = 60.0")
    assert not np.array_equal(bench.preview.pictures[0][1], light)
    assert path.read_text() == SMALL  # a file is written by `save` alone
    saved = bench.save(path.with_name("other.toml"))
    assert load(saved) == bench.scene


def test_a_wrong_value_is_said_and_the_scene_stays(path):
    bench = bstcad.workbench(path)
    before = bench.scene
    bench.controls["target.z"].value = 50.0  # the lowest of the slider
    with pytest.raises(bstcad.SceneError, match=r"target\.z: the target at z = 1 is not behind the lens"):
        bench.set("target.z", 1.0)
    assert bench.scene == before.changed({"target.z": 50.0})


def test_a_scene_with_a_picture_of_its_own_comes_back_with_it(path, tmp_path):
    picture = np.add.outer(np.arange(32.0), np.arange(32.0))
    scene = load(path).changed({"target.image": picture, "target.outline": None})
    bench = bstcad.workbench(scene)
    bench.set("lens.material", "PC")
    assert bench.scene.target.image == scene.target.image and bench.scene.lens.material == "PC"
    kept = load(bench.save(tmp_path / "kept.toml"))
    assert np.array_equal(kept.target.irradiance(), scene.target.irradiance())
    bundle = bench._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in (bundle[0] if isinstance(bundle, tuple) else bundle)
