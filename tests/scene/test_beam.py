"""Measured beams: moments of known beams under noise, and the light of a scene with one, from its file to its copy."""

from __future__ import annotations

import io
import math
import random
import struct
import tracemalloc

import numpy as np
import pytest
import torch
from PIL import Image, ImageFile

import bstcad
from bstcad.optics.surfaces.outlines import EVERYWHERE
from bstcad.scene import beam
from bstcad.scene.beam import MeasuredBeam, background, lit, moments, read_beam
from bstcad.scene.errors import SceneError

SIDE, WIDTH = 400, 12.0  # pixels, mm


def camera(w=(1.5, 0.8), turn=30.0, at=(0.4, -0.7), rows=300):
    """A Gaussian in 12 bits over a background of 40 with noise of 3; row 0 at the top."""
    pitch = WIDTH / SIDE
    x, y = np.meshgrid((np.arange(SIDE) - (SIDE - 1) / 2) * pitch, ((rows - 1) / 2 - np.arange(rows)) * pitch)
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    u, v = cos * (x - at[0]) + sin * (y - at[1]), cos * (y - at[1]) - sin * (x - at[0])
    light = 3000 * np.exp(-2 * (u**2 / w[0] ** 2 + v**2 / w[1] ** 2))
    return light + 40 + 3 * np.random.default_rng(0).standard_normal(light.shape)


@pytest.mark.parametrize("turn", [30.0, -40.0, 0.0])
def test_moments_are_those_of_the_gaussian_under_the_noise(turn):
    """d4σ = 2 w along both axes; what lies below three standard deviations of the background is lost."""
    picture = camera(turn=turn)
    mean, deviation = background(picture)
    assert (mean, deviation) == (pytest.approx(40, abs=0.3), pytest.approx(3, rel=0.05))
    found = moments(lit(picture), WIDTH)
    assert found.centre == pytest.approx((0.4, -0.7), abs=0.005)
    assert found.widths == pytest.approx((3.0, 1.6), rel=0.02)
    assert found.rotate == pytest.approx(turn, abs=0.5)
    assert found.words.startswith("2.98 × 1.59 mm") or found.words.startswith("2.97")


def scene(folder, name, **more):
    asked = {"source.profile": {"image": str(folder / name), "width": WIDTH, **more}, "target.uniform": True}
    return bstcad.load("templates/thu.toml").changed(asked)


def test_the_light_of_a_scene_is_the_picture_of_the_beam(tmp_path):
    """A picture of 16 bits and a table give it upright, on its centroid, and the same from its copy."""
    picture = camera()
    Image.fromarray(np.clip(picture * 16, 0, 65535).astype(np.uint16)).save(tmp_path / "beam.tif")
    np.savetxt(tmp_path / "beam.csv", picture, delimiter=",", fmt="%.1f")
    lights = []
    for name in ("beam.tif", "beam.csv"):
        source = scene(tmp_path, name).source
        x, y = torch.meshgrid(*2 * (torch.linspace(-4, 4, 321, dtype=torch.float64),), indexing="ij")
        light = source.irradiance(x, y, 0.0)
        assert float(light.sum()) * (8 / 320) ** 2 == pytest.approx(1, abs=0.01)
        lights.append(light)
        peak = np.unravel_index(int(light.argmax()), light.shape)
        assert (float(x[peak]), float(y[peak])) == pytest.approx((0.0, 0.0), abs=0.1)
        cos, sin = math.cos(math.pi / 6), math.sin(math.pi / 6)
        places = (torch.tensor([0.7 * cos, 0.7 * cos]), torch.tensor([0.7 * sin, -0.7 * sin]))
        along = source.irradiance(*places, 0.0)
        assert along[0] > 1.3 * along[1]  # the long axis rises to the right
        assert "centroid at (0.4, -0.7) mm" in source.words(0.0)
    torch.testing.assert_close(*lights, rtol=0.02, atol=1e-3)
    there = scene(tmp_path, "beam.tif", origin="picture").source
    assert float(there.irradiance(torch.tensor(0.4), torch.tensor(-0.7), 0.0)) > 0.99 * float(lights[0].max())


def test_an_array_is_a_measured_beam(tmp_path):
    picture = np.maximum(camera() - 40, 0.0)
    made = bstcad.load("templates/thu.toml").changed({"source.profile": {"image": picture, "width": WIDTH}})
    assert made.source.law.flux(EVERYWHERE) > 0
    (tmp_path / "scene.toml").write_text(made.toml(), encoding="utf-8")
    for name, content in made.files.items():
        (tmp_path / name).write_bytes(content.copy)
    again = bstcad.load(tmp_path / "scene.toml")
    x = torch.linspace(-3, 3, 50, dtype=torch.float64)
    assert torch.equal(again.source.irradiance(x, 0 * x, 0.0), made.source.irradiance(x, 0 * x, 0.0))


def test_a_beam_and_a_picture_may_have_one_name(tmp_path):
    """Files of one name in two folders, and two arrays: each copy has its own name."""
    light = np.maximum(camera() - 40, 0.0)
    made = bstcad.load("templates/thu.toml").changed({
        "source.profile": {"image": light, "width": WIDTH}, "target.image": light.T,
    })  # fmt: skip
    assert len(made.files) == 2 and len({content.data for content in made.files.values()}) == 2


def test_an_off_centre_beam_that_the_aperture_does_not_show_is_refused(tmp_path):
    light = np.maximum(camera(w=(0.2, 0.2), at=(4.0, 3.0)) - 60, 0.0)
    profile = {"image": light, "width": WIDTH, "origin": "picture"}
    with pytest.raises(SceneError, match=r"^source\.profile: the beam has no light inside source\.aperture"):
        bstcad.load("templates/thu.toml").changed({"source.aperture.radius": 2.0, "source.profile": profile})


@pytest.mark.parametrize(("content", "sentence"), [
    (b"1,2,3\n4,5\n", "is not a table of numbers"),
    (b"a,b\n", "is not a table of numbers"),
    (b"\n".join([b"1e308,7,7,7,7,7,7,7"] * 8), r"numbers up to 1e\+100"),  # sums and squares would be infinite
    (b"\n".join([b"1e999,7,7,7,7,7,7,7"] * 8), "all finite"),
    (b"1\n" * 25_000_000, "at least 5 x 5"),
    (b"1 " * 5_000_000, "is not a table of numbers"),
    (b"1 2\n3 4\n", "at least 5 x 5"),
    (b"\n".join([b"7,7,7,7,7,7,7,7"] * 8), "shows no light above its background"),
    (b"\n".join([b"nan,7,7,7,7,7,7,7"] * 8), "all finite"),
    (b"\n".join([b",".join([*[b"0"] * 1400, *[b"9"] * 200, *[b"0"] * 1400])] * 5), "fewer than 5 rows"),
])  # fmt: skip
def test_wrong_tables_are_refused(content, sentence, tmp_path):
    (tmp_path / "beam.csv").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(SceneError, match=rf"^source\.profile\.image: 'beam.csv' .*{sentence}"):
            scene(tmp_path, "beam.csv")
        assert tracemalloc.get_traced_memory()[1] < 16 * len(content) + 100e6
    finally:
        tracemalloc.stop()


def test_a_table_of_too_many_numbers_is_refused(tmp_path, monkeypatch):
    (tmp_path / "beam.csv").write_bytes(b"1 1 1 1 9\n" * 21)
    monkeypatch.setattr(beam, "MAX_BEAM_PIXELS", 100)
    with pytest.raises(SceneError, match=r"^source\.profile\.image: .*at most"):
        scene(tmp_path, "beam.csv")


def claimed(form):
    """A file of some bytes, of which a decoder makes a picture of 64 million pixels."""
    if form == "gif":  # one pixel on a canvas
        head, frame = b"GIF89a" + struct.pack("<HH", 65535, 970), b"," + bytes(4) + b"\1\0\1\0\0"
        return head + b"\x80\0\0" + bytes(3) + b"\xff" * 3 + frame + b"\2\2D\1\0;"
    file = io.BytesIO()
    Image.new("L", (8000, 8000)).save(file, form, **({"compression": "tiff_deflate"} if form == "tiff" else {}))
    return file.getvalue()


@pytest.mark.parametrize("form", ["gif", "png", "tiff", "bmp"])
def test_a_beam_of_too_many_pixels_is_refused_before_they_are_decoded(form, tmp_path, monkeypatch):
    (tmp_path / f"beam.{form}").write_bytes(claimed(form))
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda image: pytest.fail("the pixels are decoded"))
    with pytest.raises(SceneError, match=r"^source\.profile\.image: .* pixels, more than 16 million.*; shrink it"):
        scene(tmp_path, f"beam.{form}")


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"source.profile": "super_gaussian", "source.radius_1e2": 8.0}, r"source\.order: missing"),
    ({"source.profile": "annular"}, r"source\.inner_radius: missing"),
    ({"source.profile": "annular", "source.inner_radius": 90.0}, r"source\.inner_radius: the dark centre reaches"),
    ({"source.rotate": 10.0}, r"source\.rotate: the profile is round"),
    ({"source.profile": "gaussian", "source.radius_1e2": [8.0, 4.0, 2.0]}, r"source\.radius_1e2: .*"),
    ({"source.profile": "gausian"}, r"source\.profile: 'gausian' is not possible; did you mean 'gaussian'"),
    ({"source.profile": {"image": "none.tif", "width": 12.0}}, r"source\.profile\.image: .* not found"),
    ({"source.profile": {"image": "none.tif"}}, r"source\.profile\.image: .* not found|source\.profile\.width"),
])  # fmt: skip
def test_wrong_profiles_are_refused(changes, sentence):
    with pytest.raises(SceneError, match=f"^{sentence}"):
        bstcad.load("templates/thu.toml").changed(changes)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".csv"])
def test_damaged_beams_are_refused_in_a_sentence_or_are_beams(suffix, tmp_path):
    """Files cut short, with bytes changed, or with lines lost; memory does not follow what a damaged header claims."""
    light, path, chance = camera()[::8, ::8].clip(0), tmp_path / f"beam{suffix}", random.Random(3)
    if suffix == ".csv":
        np.savetxt(path, light, delimiter=",", fmt="%.1f")
    else:
        Image.fromarray(light.astype(np.uint16)).save(path)
    whole, refused = path.read_bytes(), 0
    tracemalloc.start()
    for _ in range(80):
        bad = bytearray(whole[: chance.randrange(len(whole))] if chance.random() < 0.5 else whole)
        for _ in range(chance.randrange(1, 20)):
            if bad:
                bad[chance.randrange(min(len(bad), 200 if chance.random() < 0.7 else len(bad)))] = chance.randrange(256)
        path.write_bytes(bad)
        try:
            found = MeasuredBeam(image=read_beam(path), width=WIDTH).law
        except SceneError as fault:
            refused += 1
            words = str(fault)
            assert words.startswith("source.profile") and words.isprintable() and len(words) < 400
        else:
            assert np.isfinite(found.net.values.numpy()).all() and found.net.flux > 0
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert refused >= 50 and most < 100e6
