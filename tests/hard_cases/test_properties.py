"""Laws of the spline at numbers that nobody chose: hypothesis draws them, the same ones in every run."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bstcad.optics import bspline
from tests.hard_cases.lenses import eps, examples, largest, uniform

EPS = eps(torch.float64)
FORMS = (bspline.evaluate, bspline.evaluate_plain)


SIZES = st.integers(5, 60)
SEEDS = st.integers(0, 2**31)
WHERE = st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), min_size=1, max_size=12)


def on_net(where, m: int) -> tuple[torch.Tensor, torch.Tensor]:
    u, v = torch.tensor(where, dtype=torch.float64).T * (m - 1)
    return u.contiguous(), v.contiguous()


def heights_of(m: int, seed: int) -> torch.Tensor:
    return uniform((m, m), seed, -1.0, 1.0)


@given(SIZES, SEEDS, WHERE, *[st.floats(-3.0, 3.0)] * 4)
@examples(40)
def test_affine_maps_of_the_net_are_those_of_the_surface(m, seed, where, a, b, c, d):
    heights, (u, v) = heights_of(m, seed), on_net(where, m)
    i = torch.arange(m, dtype=torch.float64)
    moved = a * heights + b * i[:, None] / m + c * i / m + d
    for form in FORMS:
        h, h_u, h_v = form(heights, u, v)
        g, g_u, g_v = form(moved, u, v)
        # sums of nine products of numbers up to 12; slopes are differences of them, by 2 per unit of u
        assert largest(g - (a * h + b * u / m + c * v / m + d)) <= 32 * 12 * EPS
        assert largest(g_u - (a * h_u + b / m)) <= 64 * 12 * EPS
        assert largest(g_v - (a * h_v + c / m)) <= 64 * 12 * EPS


@given(SIZES, SEEDS, WHERE, SEEDS)
@examples(40)
def test_a_control_point_moves_its_own_place_only(m, seed, where, which):
    """Locality: three spans each way; elsewhere not a bit changes."""
    heights, (u, v) = heights_of(m, seed), on_net(where, m)
    i, j = which % m, which // m % m
    moved = heights.clone()
    moved[i, j] += 1.0
    first, other = (bspline.basis(p, m)[0] for p in (u, v))
    near = (i >= first) & (i <= first + 2) & (j >= other) & (j <= other + 2)
    for form in FORMS:
        for before, after in zip(form(heights, u, v), form(moved, u, v), strict=True):
            assert torch.equal(before[~near], after[~near])


@given(SIZES, SEEDS, WHERE)
@examples(40)
def test_the_gradient_is_the_transpose(m, seed, where):
    """⟨g, E h⟩ = ⟨Eᵀ g, h⟩ for value and slopes; and both forms give it."""
    heights, (u, v) = heights_of(m, seed).requires_grad_(), on_net(where, m)
    weights = uniform((3, u.numel()), seed + 1, -1.0, 1.0)
    found = []
    for form in FORMS:
        merit = sum((w * t).sum() for w, t in zip(weights, form(heights, u, v), strict=True))
        (g,) = torch.autograd.grad(merit, heights)
        found.append(g)
        # sums of nine products a point, slopes of 2 among them
        assert float(merit.detach() - (g * heights.detach()).sum()) == pytest.approx(0, abs=64 * EPS * u.numel())
    assert largest(found[0] - found[1]) <= 64 * EPS * u.numel()
