"""Lenses, rays and the ways to trace them that the hard cases of the optics share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest import mock

import pytest
import torch
from hypothesis import HealthCheck, settings

from bstcad.optics.kernels import forward
from bstcad.optics.lens.lens import Lens
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.rays import Landed, Rays
from bstcad.optics.trace import trace
from tests.tracing import from_first_net_plain

DTYPES = pytest.mark.parametrize("dtype", (torch.float32, torch.float64), ids=("float32", "float64"))
ENGINES = pytest.mark.parametrize("engine", ("plain", "mixed", "fused"))
NAMES = {torch.float32: "float32", torch.float64: "float64"}


@contextmanager
def tracing(engine: str) -> Iterator[Callable[[Rays, Lens, float], Landed]]:
    """Trace from the glass to the screen: plain torch; plain torch on the fused spline; the fused back face."""
    form = trace.from_first_net if engine == "fused" else from_first_net_plain
    with mock.patch.object(kernel_choice, "ENABLED", kernel_choice.ENABLED and engine != "plain"):
        yield lambda rays, lens, z: form(rays, lens, LevelPlane(z))


def engines(source, lens: Lens, x, y, z: float) -> Iterator[tuple[str, Landed]]:
    """(name, landed) by every way to trace."""
    for engine in ("plain", "mixed", "fused"):
        with tracing(engine) as through_back:
            yield engine, through_back(trace.to_first_net(source.rays_through(x, y, lens.front.z, 1.0), lens), lens, z)
    if x.dtype == torch.float64:
        yield "forward", forward.land(source, lens, LevelPlane(z), x, y)


def examples(count: int) -> settings:
    """Return hypothesis settings of a law: the same numbers in every run, and no clock."""
    quiet = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    return settings(max_examples=count, derandomize=True, deadline=None, suppress_health_check=quiet)


def eps(dtype: torch.dtype) -> float:
    """A rounding unit of numbers of order 1."""
    return torch.finfo(dtype).eps


def landing_gradient(rays: Rays, lens: Lens, z: float, engine: str) -> tuple[Landed, torch.Tensor]:
    """(rays on the plane z, gradient in the net of the sum of x + y over those that land)."""
    heights = lens.back.heights.detach().clone().requires_grad_()
    with tracing(engine) as through_back:
        landed = through_back(rays, lens.with_heights([heights]), z)
    whole = torch.where(landed.alive, landed.position.sum(0), 0.0).sum()
    return landed, torch.autograd.grad(whole, heights)[0]


def largest(values: torch.Tensor) -> float:
    """The largest magnitude; not a number if any is not."""
    values = values.detach().abs().double().reshape(-1)
    return float(values.max()) if values.numel() else 0.0


def first_crossing(back: BSplineSurface, rays: Rays, steps: int = 1500) -> tuple[torch.Tensor, torch.Tensor]:
    """(t, crest), each (n,): path to the first crossing of a spline from below, by small steps and then bisection.

    t is not a number where there is none over the net; crest is the largest local maximum of F (mm, negative) before
    it, or on all of the way.  Not Newton's method, no bound on slopes: float64, whatever the rays are in.
    """
    back = back.to(torch.float64)
    start, way = torch.stack([*rays.position[:2].double(), rays.above(back.z).double()]), rays.direction.double()

    def residual(t: torch.Tensor) -> torch.Tensor:
        x, y, z = start + t * way
        return z - back.relative_sag_and_slope(x, y)[0]

    across = way[:2].norm(dim=0).clamp(min=1e-9)
    up = float(back.heights.max()) - start[2] + 1e-3
    farthest = torch.minimum(torch.full_like(across, 4 * back.x[1]) / across, up / way[2].clamp(min=1e-3))
    low, high = torch.zeros_like(farthest), torch.full_like(farthest, torch.nan)
    f = residual(low)
    under_way, rising = f < 0, torch.zeros_like(f, dtype=torch.bool)
    crest = torch.full_like(f, -torch.inf)
    for k in range(1, steps + 1):
        t = farthest * k / steps
        before, f = f, residual(t)
        crest = torch.where(under_way & rising & (f < before), torch.maximum(crest, before), crest)
        rising = f > before
        high = torch.where(under_way & (f >= 0), t, high)
        under_way &= high.isnan()
        low = torch.where(under_way, t, low)
    for _ in range(60):
        middle = (low + high) / 2
        below = residual(middle) < 0
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    x, y, _ = start + high * way
    inside = (x >= back.x[0]) & (x <= back.x[1]) & (y >= back.y[0]) & (y <= back.y[1])
    return torch.where(inside, high, torch.nan), crest
