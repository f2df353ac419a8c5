"""The model's algebra: the values that numpy finds by BLAS, and the same bits for any number of threads."""

from __future__ import annotations

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from bstcad.tolerance.superposition import gram, main_axes, product


def rows(n=7, length=50_001):
    found = np.random.default_rng(5).standard_normal((n, length))
    found[3] = found[2] + 1e-6 * found[3]  # nearly alike: one axis of hardly any strength
    return found


def test_products_are_those_of_matrices():
    a = rows()
    np.testing.assert_allclose(gram(a), a @ a.T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(product(a.T[:9], gram(a)), a.T[:9] @ (a @ a.T), rtol=0, atol=1e-8)


def test_main_axes_take_a_matrix_apart():
    known = gram(rows())
    values, axes = main_axes(known)
    assert (np.diff(values) <= 0).all()
    np.testing.assert_allclose(axes.T @ axes, np.eye(7), rtol=0, atol=1e-14)
    np.testing.assert_allclose((axes * values) @ axes.T, known, rtol=0, atol=1e-10 * values[0])


def test_no_bit_depends_on_the_number_of_threads():
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            with threadpool_limits(count):
                known = gram(rows(60, 2_001))
                values, axes = main_axes(known)
                found.append((known, values, axes, product(rows(60, 60), axes)))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(found[0], other, strict=True))
