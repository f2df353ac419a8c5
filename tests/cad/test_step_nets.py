"""Large control nets written as text say the same as OCC's own writer, entity by entity."""

import re

import numpy as np
import pytest

from bstcad import folder
from bstcad.cad import patches, step_reading, step_writing
from bstcad.optics.bspline import knots
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.scene.scene import load
from bstcad.step_text import part21

M = 67  # control points a side: more than patches.FEW in all


def statements(text: str) -> list[str]:
    """What each entity says, in the file's order, each reference by what it refers to if that is a point."""
    said = dict(re.findall(r"#(\d+)=(.*?);", re.sub(r"\s+", "", text[text.index("DATA;") + 5 :])))
    others = {name: f"#{k}" for k, name in enumerate(n for n, body in said.items() if "CARTESIAN_POINT" not in body)}
    return [re.sub(r"#(\d+)", lambda hit: others.get(hit[1]) or said[hit[1]], said[name]) for name in others]


@pytest.mark.parametrize("outline", [Circle(9.0), Rectangle(18.0, 14.0)])
def test_a_file_says_what_occ_alone_would_write(make_lens, tmp_path, monkeypatch, outline):
    lens = make_lens(outline=outline, m=M)
    step_writing.write_lens(lens, tmp_path / "ours.step", "lens")
    monkeypatch.setattr(patches, "FEW", 10**9)
    step_writing.write_lens(lens, tmp_path / "occ.step", "lens")
    ours, occ = (statements((tmp_path / name).read_text()) for name in ("ours.step", "occ.step"))
    assert len(ours) > 100 and ours == occ


def test_no_stand_in_is_left_in_a_file(make_lens, tmp_path):
    step_writing.write_lens(make_lens(outline=Circle(9.0), m=M), tmp_path / "lens.step", "lens")
    text = (tmp_path / "lens.step").read_text()
    points = re.findall(r"= CARTESIAN_POINT\('',\((.*?),", text)
    assert len(points) > M**2 and max(abs(float(x)) for x in points) < 1e3
    assert len(set(re.findall(r"^#(\d+) =", text, re.MULTILINE))) == len(re.findall(r"^#\d+ =", text, re.MULTILINE))


def test_numbers_of_any_size_survive(tmp_path):
    """Points near zero and far away are written with an exponent, as OCC does, beside others that are not."""
    net = np.stack(np.meshgrid(np.linspace(-2e4, 2e4, M), np.linspace(-3.0, 3.0, M), indexing="ij"), axis=-1)
    net = np.dstack([net, 1e-7 * np.arange(M * M).reshape(M, M)])
    words = [step_writing.step_nets._reals(net[..., axis].ravel()) for axis in range(3)]
    assert np.abs(np.array(words, dtype=np.float64).T.reshape(net.shape) - net).max() < 1e-14 * 2e4
    assert words[2][0] == "0.0000000000000000E+00" and words[0][-1] == "2.0000000000000000E+04"


def test_nets_go_to_occ_and_back_to_the_last_bit():
    rng = np.random.default_rng(0)
    net = rng.normal(size=(M, M + 5, 3))
    surface = patches.bspline_surface(net, knots(M), knots(M + 5))
    assert np.array_equal(patches.net_of(surface), net)
    assert all(np.array_equal(a, b) for a, b in zip(patches.knots_of(surface), (knots(M), knots(M + 5)), strict=True))
    pole = surface.Pole(M, 7)
    assert (pole.X(), pole.Y(), pole.Z()) == tuple(net[M - 1, 6])


def test_the_re_read_net_is_that_of_both_readers(make_lens, tmp_path):
    lens, path = make_lens(outline=Rectangle(18.0, 14.0), m=M), tmp_path / "lens.step"
    step_writing.write_lens(lens, path, "lens")
    assert np.array_equal(step_reading.read(path).control_points, part21.read_lens(path).surface.control_points)


@pytest.mark.parametrize("m", [67, 129, 257])
def test_the_size_said_before_is_that_of_the_file(tmp_path, m):
    scene = load("templates/thu.toml", {"lens.back.control_points": m})
    step_writing.write_lens(scene.flat_lens(m), tmp_path / "lens.step", scene.name)
    assert folder.step_size(scene) == pytest.approx((tmp_path / "lens.step").stat().st_size, rel=0.03)
    assert f"{m // 2 + 1} would" in folder.said_of_sizes(scene)
