"""The table [wavefront]: read into the records of optics, written back, and absent unless it is asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from bstcad.optics.light.wavefront import PlaneWave, SphericalWave, ZernikeWave
from bstcad.scene.scene import load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
WAVES = {
    'kind = "plane"\nz = 40.0': PlaneWave(40.0),
    'kind = "plane"\nz = 40.0\ndirection = [0.0, 1.0, 2.0]\nweight = 3.0': PlaneWave(40.0, (0.0, 1.0, 2.0), 3.0),
    'kind = "sphere"\nz = 40.0\nfocus = [1.0, 2.0, 300.0]': SphericalWave((1.0, 2.0, 300.0), 40.0),
    'kind = "sphere"\nz = 40.0\nfocus = [1.0, 2.0, -30.0]': SphericalWave((1.0, 2.0, -30.0), 40.0),
    'kind = "zernike"\nz = 40.0\nradius = 9.0\ncoefficients = [0.0, 0.0, 0.0, 1.5]\ncentre = [1.0, 0.0]': ZernikeWave(
        (0.0, 0.0, 0.0, 1.5), 9.0, 40.0, centre=(1.0, 0.0)
    ),
    'kind = "zernike"\nz = 40.0\nradius = 9.0\ncoefficients = [0.0, 0.0]': ZernikeWave((0.0, 0.0), 9.0, 40.0),
}


@pytest.mark.parametrize("text", WAVES)
def test_a_wave_is_read_and_written_back(text, tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(f"{(TEMPLATES / 'thu.toml').read_text()}\n[wavefront]\n{text}\n")
    scene = load(file, {"accept.wavefront": "0.25"})
    assert scene.wavefront == WAVES[text] and scene.accept.wavefront == 0.25
    file.write_text(scene.toml())
    assert load(file).wavefront == scene.wavefront


def test_a_scene_is_changed_by_the_record_itself():
    scene = load(TEMPLATES / "thu.toml")
    wave = SphericalWave((0.0, 0.0, 300.0), 40.0)
    changed = scene.changed({"wavefront": wave})
    assert changed.wavefront == wave
    assert changed.changed({"wavefront.weight": 2.0}).wavefront.weight == 2.0
    assert changed.changed({"wavefront": None}).wavefront is None
