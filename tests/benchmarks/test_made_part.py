"""A made part of the letters, measured with 300 000 noisy points: how exact its form and light come out, how fast."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad import folder as folders
from bstcad.measured import cloud as clouds
from bstcad.measured import made_part
from bstcad.optics.measure import Effort, measure
from bstcad.pipeline import design
from bstcad.scene.scene import load
from tests.benchmarks.cold import TEMPLATES
from tests.measured.synthetic import SHIFT, cloud, with_form_error

LETTERS = TEMPLATES / "thu.toml"
POINTS = 300_000
SECONDS = 20.0
EFFORT = Effort(witness=False)


@pytest.mark.bench
def test_a_made_part_of_the_letters(tmp_path):
    found = design(load(LETTERS, {"tailoring.quality": "draft"}), device="cpu")
    nominal = folders.nominal(found.scene, found.lens, found.target)
    made = with_form_error(found.lens, 5e-4, 3.0)
    np.savetxt(tmp_path / "cloud.csv", cloud(made, POINTS, 5e-5), delimiter=",", fmt="%.9f")
    began, spent = time.perf_counter(), time.process_time()
    given = clouds.load(tmp_path / "cloud.csv", found.lens.outline)
    part = made_part.judge(given, found.lens, nominal, EFFORT)
    seconds = time.perf_counter() - began
    x, y = (t.ravel() for t in np.meshgrid(part.deviation.x, part.deviation.y))
    here = torch.from_numpy(x), torch.from_numpy(y)
    (z, z_x, z_y), (true, *_) = (lens.back.sag_and_slope(*here) for lens in (found.lens, made))
    wanted = ((true - z) / torch.sqrt(1 + z_x**2 + z_y**2)).numpy()
    off = np.sqrt(np.mean((part.deviation.form.ravel() - wanted) ** 2) / np.mean(wanted**2))
    light = measure(made, nominal.channels, nominal.screen, nominal.target, EFFORT).rrmsd
    predicted, dx = part.facts["rrmsd_predicted"], part.facts["alignment"]["dx"]
    print(f"form error recovered to {off:.2%} RMS, RRMSD {predicted:.4f} where it is {light:.4f},")
    print(f"decentre to {1e3 * (dx - SHIFT[0]):+.3f} µm, in {seconds:.1f} s ({time.process_time() - spent:.1f} s CPU)")
    assert off < 0.05 and predicted == pytest.approx(light, rel=0.05) and seconds < SECONDS

    straight = cloud(found.lens, POINTS, 5e-5, (0.01, 0.0, 0.0), (0.0, 0.0, 0.0))
    part = made_part.judge(replace(given, points=straight), found.lens, nominal, Effort(96))
    assert part.facts["alignment"]["dx"] == pytest.approx(0.01, abs=1e-4)
