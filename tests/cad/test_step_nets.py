"""Large control nets written as text say the same as OCC's own writer, entity by entity."""

import re

import numpy as np
import pytest

from bstcad.cad import patches, step_writing
from bstcad.designs import folder
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.scene.scene import load

M = 67  # control points a side: more than patches.SMALL_NET in all


def statements(text: str) -> list[str]:
    """Return the text of each entity in the file's order, with each point in place of the reference to it."""
    said = dict(re.findall(r"#(\d+)=(.*?);", re.sub(r"\s+", "", text[text.index("DATA;") + 5 :])))
    others = {name: f"#{k}" for k, name in enumerate(n for n, body in said.items() if "CARTESIAN_POINT" not in body)}
    return [re.sub(r"#(\d+)", lambda hit: others.get(hit[1]) or said[hit[1]], said[name]) for name in others]


@pytest.mark.parametrize("outline", [Circle(9.0), Rectangle(18.0, 14.0)])
def test_a_file_says_what_occ_alone_would_write(make_lens, tmp_path, monkeypatch, outline):
    lens = make_lens(outline=outline, m=M)
    step_writing.write_lens(lens, tmp_path / "ours.step", "lens")
    monkeypatch.setattr(patches, "SMALL_NET", 10**9)
    step_writing.write_lens(lens, tmp_path / "occ.step", "lens")
    ours, occ = (statements((tmp_path / name).read_text()) for name in ("ours.step", "occ.step"))
    assert len(ours) > 100 and ours == occ


def test_numbers_of_any_size_survive(tmp_path):
    """Points near zero and far away are written with an exponent, as OCC does, beside others that are not."""
    net = np.stack(np.meshgrid(np.linspace(-2e4, 2e4, M), np.linspace(-3.0, 3.0, M), indexing="ij"), axis=-1)
    net = np.dstack([net, 1e-7 * np.arange(M * M).reshape(M, M)])
    words = [step_writing.step_nets._format_reals(net[..., axis].ravel()) for axis in range(3)]
    assert np.abs(np.array(words, dtype=np.float64).T.reshape(net.shape) - net).max() < 1e-14 * 2e4
    assert words[2][0] == "0.0000000000000000E+00" and words[0][-1] == "2.0000000000000000E+04"


@pytest.mark.parametrize("m", [67, 129])
def test_the_size_said_before_is_that_of_the_file(tmp_path, m):
    scene = load("templates/thu.toml", {"lens.back.control_points": m})
    step_writing.write_lens(scene.flat_lens(m), tmp_path / "lens.step", scene.name)
    assert folder.step_size(scene) == pytest.approx((tmp_path / "lens.step").stat().st_size, rel=0.03)
    assert f"{m // 2 + 1} would" in folder.size_sentence(scene)
