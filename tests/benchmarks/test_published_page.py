"""docs/published.md is what docs/published.json gives, with a record and a picture of every scene."""

import numpy as np
import pytest
from PIL import Image

from bstcad.report.drawing import HEAVIEST
from bstcad.scene.scene import load
from tests.benchmarks import accuracy, published

KNOWN = published.known()


def test_the_page_is_what_the_records_give():
    """Else: python -m tests.benchmarks.published --only, which writes it anew."""
    assert published.PAGE.read_text(encoding="utf-8") == published.page(KNOWN, accuracy.known())


def test_every_scene_is_recorded_with_its_picture():
    assert list(KNOWN) == list(published.CASES)
    for name in published.CASES:
        path = published.PICTURES / f"{name}.png"
        assert path.stat().st_size < HEAVIEST
        assert Image.open(path).size == (2 * published.SIDE + published.GAP, published.SIDE)


@pytest.mark.parametrize("name", published.CASES)
def test_the_independent_judge_and_the_report_agree(name):
    found = KNOWN[name]
    assert found["stated"] == pytest.approx(found["rrmsd"], rel=0.01)
    assert found["error"] < 0.01 * found["rrmsd"]


def test_the_sunlight_picture_stands_in_its_border(tmp_path):
    """A picture of the size of diffinytrace's, of which the middle square is shown."""
    values = np.full((1200, 1600), 10, np.uint8)
    values[:, 200:1400] = 200
    Image.fromarray(values).save(tmp_path / "given.png")
    made = np.asarray(published.bordered(tmp_path / "given.png"))
    assert made.shape == (256, 256) and (made[22:-22, 22:-22] == 200).all()
    made = made.astype(int)
    assert made.sum() == made[22:-22, 22:-22].sum()
    published.bordered(tmp_path / "given.png").save(tmp_path / "sun_picture.png")
    scene = tmp_path / "sun_picture.toml"
    scene.write_text(published.CASES[published.SUN].scene.read_text(encoding="utf-8"), encoding="utf-8")
    assert load(scene).target.irradiance().shape == (256, 256)


@pytest.mark.parametrize("name", [name for name in published.CASES if name != published.SUN])
def test_the_scenes_can_be_read(name):
    assert load(published.CASES[name].scene).target.irradiance().sum() > 0
