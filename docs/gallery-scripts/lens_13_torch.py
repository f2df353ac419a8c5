"""
A lens of one's own optimiser
=============================

The picture that a lens throws is differentiable in the heights of its control points. Twenty lines of torch turn an
evenly lit disc into a disc that is brighter on the right: L-BFGS in the cosine transform of the heights, in which
coarse and fine waves count alike.

Tubes are cut at the outline of the lens that they are launched for. As the back moves along the axis other light meets
its rim, so that the tubes of the lens before the fit end at an RRMSD of 0.07 where rays find 0.11. A second round
launches the tubes again, for the lens of the first round.
"""

from pathlib import Path

import numpy as np
import scipy.fft
import torch

import bstcad

design = bstcad.design("lens_13_torch.toml", progress=False)
lens, channels, screen = design.lens, design.scene.channels(), design.scene.target.screen
target = torch.from_numpy(design.target) * torch.linspace(0.4, 1.6, design.target.shape[1], dtype=torch.float64)
target = target / target.sum()

m = lens.back.m
cosine = torch.from_numpy(scipy.fft.dct(np.eye(m), axis=0, norm="ortho"))  # rows: the cosines along an axis of the net
waves = 2 - 2 * torch.cos(torch.pi * torch.arange(m, dtype=torch.float64) / m)
scale = (waves[:, None] + waves).clamp(min=waves[1]) ** -0.5
amplitudes = torch.zeros(m, m, dtype=torch.float64, requires_grad=True)


def shaped():
    return lens.with_heights([lens.back.heights + cosine.T @ (scale * amplitudes) @ cosine])


def merit():
    optimiser.zero_grad()
    picture = tubes.picture(shaped(), screen)  # (rows, columns), differentiable in the heights
    value = (picture / picture.sum() - target).square().sum() / target.square().sum()
    value.backward()
    history.append(value.item() ** 0.5)
    return value.detach()


history = []
for _ in range(2):
    tubes = bstcad.RayTubes.launched(shaped(), channels, 128)  # a side; of all light that gets through the lens
    optimiser = torch.optim.LBFGS([amplitudes], max_iter=25, line_search_fn="strong_wolfe")
    optimiser.step(merit)
print(f"RRMSD {history[0]:.3f} before, {history[-1]:.3f} after {len(history)} evaluations")

# %%
# Eight sets of rays that the optimiser never saw judge the lens, which goes back into bstcad, to be written and made:

fitted = design.with_heights(shaped().back.heights)
light = bstcad.measure(fitted.lens, channels, screen, target.numpy(), bstcad.Effort(rays=724))
print(f"RRMSD {light.rrmsd:.3f} ± {light.standard_error:.3f} by {light.rays} rays")
Path("outputs/lens_13_torch").mkdir(parents=True, exist_ok=True)
fitted.picture("outputs/lens_13_torch/wall.png")
