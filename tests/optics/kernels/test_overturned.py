"""The kernel of the penalty on folds equals the plain form, also where a lack of area is too large for a gradient."""

import pytest
import torch

from bstcad.optics.numerics import kernel_choice
from bstcad.tailoring import folds

UNIT = (0.0, 0.0, 1.0, -1.0)  # pixels of one unit


def penalty(corner, flux):
    return folds.fold_penalty(corner, flux, float(flux.sum()), UNIT, peak=1 / flux.numel())


@pytest.mark.parametrize("jump", [0.3, 1.2, 9.0])
@pytest.mark.parametrize("rows", [1, 9, 40])
def test_the_kernel_is_the_plain_form(rows, jump, monkeypatch):
    """More rows than a strip has, and corners that jump further than MOST_LACK: value and gradient are the same."""
    chance = torch.Generator().manual_seed(rows)
    grid = torch.stack(torch.meshgrid(torch.arange(rows + 1.0), torch.arange(8.0), indexing="ij")).double()
    corner = (grid + jump * torch.randn(grid.shape, generator=chance, dtype=torch.float64)).requires_grad_()
    flux = torch.rand((rows, 7), generator=chance, dtype=torch.float64)
    flux[:, 2] = 0.0
    found = []
    for enabled in (True, False):
        monkeypatch.setattr(kernel_choice, "ENABLED", enabled)
        value = penalty(corner, flux)
        found.append((value.detach(), *torch.autograd.grad(value, corner)))
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-12, atol=1e-15)
    assert jump < 1.0 or float(found[0][0]) > 0.0


def test_a_tube_that_is_overturned_too_far_has_no_gradient():
    """Triangles that lack more than MOST_LACK times the area of even light have a constant penalty."""
    x, y = torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij")
    corner, flux = torch.stack([x, y]).double(), torch.ones((3, 3), dtype=torch.float64)
    corner[0, 1:3, 1:3] = corner[0, 1:3, 1:3].flip(0) * 4.0  # the tube in the middle is mirrored and made wider
    corner.requires_grad_()
    flux[0], flux[2], flux[:, 0], flux[:, 2] = 0.0, 0.0, 0.0, 0.0  # the others may fold
    value = folds.fold_penalty(corner, flux, 1.0, UNIT, peak=4.0)
    (gradient,) = torch.autograd.grad(value, corner)
    assert value.item() == pytest.approx(folds.MOST_LACK**2) and not gradient.any()
