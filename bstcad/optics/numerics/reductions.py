"""Sums and functions in fixed parts, whose results do not depend on the number of threads, to the last bit.

Rounding depends on the order of a sum, and the line searches of tailoring amplify rounding into a different lens of the
same merit.  So a net or picture to which many rays add is summed in parts whose number depends only on the number of
rays; threads compute the parts, and the parts are added in their order.  Neighbouring rays touch only a few rows of the
net or the picture: a part clears a row when it first touches it, and only touched rows are merged.

BLAS divides a product of dense matrices among its threads, so such products are avoided.  exp, sin and cos may round
differently for the last few numbers of a thread's part (`elementary`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bstcad.optics.numerics import kernel_choice
from bstcad.optics.numerics.compiling import MIN_PART, compiled

MAX_PARTS = 16  # maximum number of parts; a power of two, so that two, four or eight threads have equal work
ROW_LENGTH = 4096  # count of numbers summed by one thread
ELEMENTARY = 1024  # count of numbers whose exp, sin or cos one thread of torch computes; torch divides 2048 or more


def parts(n: int) -> int:
    """Return the number of parts of n rays: 1, 2, 4 … MAX_PARTS."""
    return min(MAX_PARTS, 1 << max(0, (n // MIN_PART).bit_length() - 1))


def total(t: Tensor) -> Tensor:
    """Return Σ t, differentiable: torch divides one long sum among its threads, but not the sum of a row."""
    flat = t.reshape(-1)
    whole = flat.numel() // ROW_LENGTH * ROW_LENGTH
    return flat[:whole].view(-1, ROW_LENGTH).sum(1).sum() + flat[whole:].sum()


def quotient(t: Tensor, whole: Tensor) -> Tensor:
    """Return t / whole for a scalar `whole`, differentiable in both, with all sums in fixed parts."""
    return Quotient.apply(t, whole)


class Quotient(torch.autograd.Function):
    """Map (t, scalar whole) to t / whole; the gradient in `whole` is a sum in fixed parts, unlike torch's own."""

    @staticmethod
    def forward(ctx: Any, t: Tensor, whole: Tensor) -> Any:  # noqa: D102
        ctx.save_for_backward(whole, divided := t / whole)
        return divided

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g: Tensor) -> Any:  # noqa: D102
        whole, divided = ctx.saved_tensors
        return g / whole, -total(g * divided) / whole


def elementary(function: Callable[..., Tensor], *t: Tensor) -> Tensor:
    """Apply exp, sin, atan2 … to each number of t, or to numbers of tensors of one shape; differentiable.

    The rounding is the same for any number of threads.
    """
    if t[0].device.type != "cpu" or t[0].numel() <= ELEMENTARY:
        return function(*t)
    parts = zip(*(each.reshape(-1).split(ELEMENTARY) for each in t), strict=True)
    return torch.cat([function(*part) for part in parts]).view(t[0].shape)


def dot(a: Tensor, b: Tensor) -> float:
    """Return Σ a b of two vectors without gradient: summed in float64 by the kernel, else in their precision."""
    fast = kernel_choice.kernel("reductions.dot", a)
    return fast(a, b) if fast else float(total(a * b))


def dot_of_arrays(a: Tensor, b: Tensor) -> float:
    """Return `dot` on the CPU, as a sum of MAX_PARTS sums."""
    sums = np.empty(MAX_PARTS)
    _dot(a.detach().numpy(), b.detach().numpy(), sums)
    return float(sums.sum())


@compiled(threads_by="a", fastmath={"reassoc", "contract"})
def _dot(a, b, sums):
    for c in prange(sums.size):
        part = 0.0
        for k in range(c * a.size // sums.size, (c + 1) * a.size // sums.size):
            part += np.float64(a[k]) * np.float64(b[k])
        sums[c] = part


def shift(q: Tensor, y: Tensor, factor: float, along: Tensor, scale: float = 1.0) -> float:
    """Replace q by scale q + factor y, in place, and return its `dot` with `along`; vectors without gradient."""
    if kernel_choice.kernel("reductions.dot", q, y, along):
        sums = np.empty(MAX_PARTS)
        _shift(q.numpy(), y.numpy(), factor, along.numpy(), scale, sums)
        return float(sums.sum())
    q.mul_(scale).add_(factor * y)
    return dot(q, along)


@compiled(threads_by="q", fastmath={"reassoc", "contract"})
def _shift(q, y, factor, along, scale, sums):
    for c in prange(sums.size):
        part = 0.0
        for k in range(c * q.size // sums.size, (c + 1) * q.size // sums.size):
            value = np.float64(scale) * np.float64(q[k]) + np.float64(factor) * np.float64(y[k])
            q[k] = value
            part += value * np.float64(along[k])
        sums[c] = part


@njit(inline="always")
def clear(own, touched, first, last):
    """Clear the rows first … last - 1 of a part that lie outside the range `touched` (2,), and extend the range."""
    if first < touched[0] or last > touched[1]:
        _widen(own, touched, first, last)


@njit
def _widen(own, touched, first, last):
    if touched[0] == touched[1]:
        touched[0] = touched[1] = first
    for row in range(first, touched[0]):
        own[row, :] = 0.0
    for row in range(touched[1], last):
        own[row, :] = 0.0
    touched[0], touched[1] = min(touched[0], first), max(touched[1], last)


@compiled(threads_by="out")
def _merge(own, touched, out):
    for row in prange(out.shape[0]):
        for c in range(own.shape[0]):
            if touched[c, 0] <= row < touched[c, 1]:
                for column in range(out.shape[1]):
                    out[row, column] += own[c, row, column]


def shares(n: int, block: int) -> list[tuple[int, int]]:
    """Return (first, last + 1) of the rays of each part; all parts begin at multiples of `block`."""
    count, blocks = parts(n), -(-n // block)
    ends = [min(n, k * blocks // count * block) for k in range(count + 1)]
    return list(zip(ends, ends[1:], strict=False))


def on_threads(work: Callable[..., None], tasks: Sequence[tuple[Any, ...]]) -> None:
    """Call work(*task) for each task, on as many Python threads as torch has.

    The kernels release Python's lock, and without numba's own threads they compile in half the time.
    """
    threads = torch.get_num_threads()
    if len(tasks) == 1 or threads == 1:
        for task in tasks:
            work(*task)
        return
    list(_pool(threads).map(lambda task: work(*task), tasks))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the pool of threads; starting threads takes longer than tracing the few rays of a preview."""
    return ThreadPoolExecutor(threads)


def buffers(count: int, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (own (count, rows, columns), touched (count, 2)): a buffer for each part, and the range of used rows."""
    own = torch.empty((count, rows, columns), dtype=torch.float64)  # numpy would use huge pages, which are cleared
    return own.numpy(), np.zeros((count, 2), np.int64)


def merged(own: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """Return the sum (rows, columns) of the parts, added in their order."""
    out = np.zeros(own.shape[1:])
    _merge(own, touched, out)
    return out
