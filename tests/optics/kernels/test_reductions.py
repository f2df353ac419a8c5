"""Sums in parts: the right sum, its gradient, and the same bits from any number of threads."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.numerics import reductions


@pytest.fixture
def threads():
    """Each number of threads in turn; put back afterwards."""
    before = torch.get_num_threads()
    yield lambda: (torch.set_num_threads(n) or n for n in (1, 2, 3, 5))
    torch.set_num_threads(before)


def noise(*shape, dtype=torch.float64):
    """Numbers of either sign and of many sizes."""
    random = torch.Generator().manual_seed(len(shape))
    return (torch.randn(shape, generator=random, dtype=torch.float64) ** 5).to(dtype)


def test_as_many_parts_as_the_rays_ask_for():
    assert [reductions.parts(n) for n in (0, 1, 2**14, 2**15, 2**16 - 1, 2**18, 10**9)] == [1, 1, 1, 2, 2, 16, 16]


@pytest.mark.parametrize("shape", [(), (0,), (3,), (4096,), (100_003,), (300, 401)], ids=str)
def test_total_is_the_sum_and_its_gradient_is_one(shape):
    t = noise(*shape).requires_grad_()
    found = reductions.total(t)
    assert torch.equal(torch.autograd.grad(found, t)[0], torch.ones_like(t))
    found = found.detach()
    size = float(t.detach().abs().sum())
    assert float(found) == pytest.approx(math.fsum(t.detach().reshape(-1).tolist()), abs=1e-14 * size)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_bit_depends_on_the_number_of_threads(threads, dtype):
    a, b = noise(1_000_003, dtype=dtype), noise(1_000_003, 1, dtype=dtype).view(-1)
    assert len({float(reductions.total(a)) for _ in threads()}) == 1
    assert len({reductions.dot(a, b) for _ in threads()}) == 1
    exact = math.fsum((a.double() * b.double()).tolist())
    assert reductions.dot(a, b) == pytest.approx(exact, abs=1e-14 * float((a.double() * b.double()).abs().sum()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_shift_adds_and_tells_the_next_product(threads, dtype):
    q, y, along = (noise(*shape, dtype=dtype).reshape(-1) for shape in ((70_001,), (70_001, 1), (1, 70_001, 1)))
    wanted = 0.7 * q.double() - 1.3 * y.double()
    found = []
    for _ in threads():
        moved = q.clone()
        found.append((reductions.shift(moved, y, -1.3, along, scale=0.7), moved))
    assert all(product == found[0][0] and torch.equal(moved, found[0][1]) for product, moved in found)
    terms = 0.7 * q.double().abs() + 1.3 * y.double().abs()
    assert bool(((found[0][1].double() - wanted).abs() <= 2 * torch.finfo(dtype).eps * terms).all())
    assert found[0][0] == pytest.approx(float((wanted * along.double()).sum()), rel=1e-6)


def test_a_quotient_has_the_gradient_of_torchs_own_from_any_number_of_threads(threads):
    t, weight = noise(700, 600), noise(600, 700).T
    whole = torch.tensor(1.3, dtype=torch.float64)

    def gradients(of):
        leaves = [t.clone().requires_grad_(), whole.clone().requires_grad_()]
        return torch.autograd.grad(reductions.total(of(*leaves) * weight), leaves)

    found = [gradients(reductions.quotient) for _ in threads()]
    assert all(torch.equal(g, own) for each in found for g, own in zip(each, found[0], strict=True))
    for g, own in zip(found[0], gradients(torch.div), strict=True):
        torch.testing.assert_close(g, own, rtol=1e-12, atol=0)


def test_parts_that_reach_some_rows_and_parts_that_reach_none():
    """Buffers are not clear before they are reached: here they are full of what was there before."""
    rows = [[], [(4, 6), (9, 10), (2, 5)], [(0, 3)], [(11, 12), (7, 8)]]
    own, touched = reductions.buffers(len(rows), 12, 5)
    own[:] = np.nan
    expected = np.zeros((12, 5))
    for c, spans in enumerate(rows):
        for first, last in spans:
            reductions.clear(own[c], touched[c], first, last)
            own[c, first:last] += c
            expected[first:last] += c
    assert np.array_equal(reductions.merged(own, touched), expected)
