"""Laws of the spline and of refraction, at numbers that nobody chose.

Hypothesis draws the numbers, the same ones in every run.  R + T = 1 is not among the laws: Fresnel losses are not
built, a ray is through or reflected with all that it carries, and what sums to 1 is the ledger.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bstcad.optics import interfaces, spline_basis
from bstcad.optics.interfaces import Refract
from bstcad.optics.rays import Status
from tests.hard_cases.lenses import bundle, eps, examples, largest, uniform

EPS = eps(torch.float64)
FORMS = (spline_basis.evaluate, spline_basis.evaluate_plain)


# The spline

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
    first, other = (spline_basis.basis(p, m)[0] for p in (u, v))
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


# Refraction

ANGLE = st.floats(-1.5, 1.5)
TURN = st.floats(0.0, 2 * math.pi)
SLOPE = st.floats(-3.0, 3.0)
INDEX = st.floats(1.0, 4.0)


def meeting(angle, turn, z_x, z_y):
    """(ray, slopes, normal); only rays that come from before the face are of interest."""
    way = (math.sin(angle) * math.cos(turn), math.sin(angle) * math.sin(turn), math.cos(angle))
    slopes = torch.tensor([[z_x], [z_y]], dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.tensor([-z_x, -z_y, 1.0], dtype=torch.float64), dim=0)[:, None]
    return bundle((0.0, 0.0, 0.0), way), slopes, normal


@given(ANGLE, TURN, SLOPE, SLOPE, INDEX, INDEX)
@examples(200)
def test_snell(angle, turn, z_x, z_y, n_in, n_out):
    """n sin θ is kept as a vector; unit length; one plane; the flag is right; the flux is kept."""
    rays, slopes, normal = meeting(angle, turn, z_x, z_y)
    after = interfaces.turn(rays, *slopes, Refract(n_in, n_out)).rays
    before = torch.linalg.cross(rays.direction, normal, dim=0)
    along = float((rays.direction * normal).sum())
    sine = n_in / n_out * float(before.norm())
    if abs(sine - 1) > 8 * EPS * 16 and abs(along) > 8 * EPS:  # η² times some units
        assert (after.status.item() == Status.ALIVE) is (sine < 1 and along > 0)
    assert torch.equal(after.flux, rays.flux)
    assert abs(float(after.direction.norm()) - 1) <= 16 * EPS * max(1.0, n_in / n_out) ** 2
    if not after.alive.all():
        assert torch.equal(after.direction, rays.direction)
        return
    refracted = torch.linalg.cross(after.direction, normal, dim=0)
    assert largest(n_out * refracted - n_in * before) <= 16 * EPS * n_in
    assert abs(float((refracted * rays.direction).sum())) <= 16 * EPS
    # cos θ' > 0, where its square is more than rounding
    assert float((after.direction * normal).sum()) > -math.sqrt(16 * EPS) * max(1.0, n_in / n_out)


@given(ANGLE, TURN, SLOPE, SLOPE, INDEX, INDEX)
@examples(100)
def test_refraction_can_be_reversed(angle, turn, z_x, z_y, n_in, n_out):
    """Seen in the mirror z -> -z, the reversed ray meets the mirrored face and leaves as the reversed original."""
    rays, slopes, normal = meeting(angle, turn, z_x, z_y)
    after = interfaces.turn(rays, *slopes, Refract(n_in, n_out)).rays
    cosines = [float((r.direction * normal).sum()) for r in (rays, after)]
    if not after.alive.all() or min(cosines) < 1e-3:  # grazing: the way back is over the critical angle by a rounding
        return
    mirror = torch.tensor([[-1.0], [-1.0], [1.0]], dtype=torch.float64)
    back = interfaces.turn(
        replace(after, direction=after.direction * mirror), -slopes[0], -slopes[1], Refract(n_out, n_in)
    ).rays
    assert back.alive.all()
    # a cosine c is known to a unit over c, both ways, times the ratio of the indices
    bound = 32 * EPS * (max(n_in, n_out) / min(n_in, n_out)) ** 2 / min(cosines) ** 2
    assert largest(back.direction * mirror - rays.direction) <= bound
