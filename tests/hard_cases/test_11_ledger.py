"""11. Light beside the screen, through the sides, past the lens, totally reflected.

DiffOptics' caustic example clamps pixel indices, so that light beside the screen piles up on its border pixels and the
optimiser pulls at it; optiland #870 lost rays without saying so.  Here every ray ends in one line of a ledger that is
held to the whole, and a pixel on the border holds what the same pixel of a larger screen holds.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.point import PointSource
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers import irradiance
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Landed, Status
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import trace, tubes
from tests.tracing import from_first_net_plain, launch, simulated, simulated_plain, stratified

SOURCE = PointSource(position=(1.0, -2.0, 3.0), profile="gaussian", half_angle_1e2=30.0)
LINES = {  # fates of rays by line of the ledger
    "on target": (Status.ALIVE,),
    "off target": (Status.ALIVE, Status.TURNED_BACK),
    "missed the lens": (Status.MISSED_FRONT,),
    "lost through the sides": (Status.VIGNETTED,),
    "total internal reflection": (Status.TOTAL_REFLECTION,),
}
PIXEL, SIDE, FIRST = 4.0, 64, (90, 100)  # mm; pixels of the small screen; its first column and row on the large one
LARGE = Screen(400.0, (-512.0, 512.0), (-512.0, 512.0), 256)
SMALL = Screen(
    400.0, (FIRST[0] * PIXEL - 512, (FIRST[0] + SIDE) * PIXEL - 512),
    (512 - (FIRST[1] + SIDE) * PIXEL, 512 - FIRST[1] * PIXEL), SIDE,
)  # fmt: skip
RAYS = 400  # each way
PRECISION = pytest.mark.parametrize("dtype", (torch.float32, torch.float64), ids=str)
FORMS = pytest.mark.parametrize("form", (simulated, simulated_plain))


def lens(dtype=torch.float64) -> Lens:
    """A bowl so steep at its rim that some rays are totally reflected, behind a front that lets some out sideways."""
    line = torch.linspace(-1, 1, 17, dtype=torch.float64)
    x, y = line[:, None], line[None, :]
    h = 4.0 * (x**2 + 0.8 * y**2) + 0.2 * torch.sin(5 * x) * torch.cos(4 * y + 0.3)
    back = BSplineSurface(22.0, h.to(torch.float32).to(dtype), (-11.0, 11.0), (-10.5, 10.5))
    return Lens.between(Sphere(15.0, 0.02), back, Rectangle(20.0, 20.0), 1.6)


def cut(picture: torch.Tensor) -> torch.Tensor:
    """The small screen's pixels of a picture on the large one."""
    return picture[FIRST[1] : FIRST[1] + SIDE, FIRST[0] : FIRST[0] + SIDE]


def border(picture: torch.Tensor) -> torch.Tensor:
    """The outermost pixels."""
    return torch.cat([picture[0], picture[-1], picture[:, 0], picture[:, -1]])


def traced(dtype) -> Landed:
    """Every ray of `simulate` with its fate, by the plain form."""
    held = lens(dtype)
    return from_first_net_plain(trace.to_first_net(launch(SOURCE, held, RAYS, 0), held), held, SMALL.receiver)


def counted(rays: Landed, screen: Screen) -> dict[str, float]:
    """The ledger, ray by ray."""
    x, y = rays.position.double()
    here = (x >= screen.x[0]) & (x <= screen.x[1]) & (y >= screen.y[0]) & (y <= screen.y[1])
    lines = {}
    for name, fates in LINES.items():
        at = sum(rays.status == int(fate) for fate in fates).bool()
        if name in ("on target", "off target"):
            at &= (here == (name == "on target")) | (rays.status == int(Status.TURNED_BACK))
        lines[name] = math.fsum(rays.flux[at].double().tolist())
    return lines


def wrong(found: dict[str, float], wanted: dict[str, float]) -> float:
    """The largest difference of a line."""
    assert list(found) == list(wanted) == list(LINES)
    return max(abs(found[name] - wanted[name]) for name in LINES)


@PRECISION
def test_every_ray_is_in_its_line(holds, dtype):
    """1.6e5 additions in blocks, each rounded by 1.1e-16 of at most the whole: 1e-13 if half of them cancel."""
    rays = traced(dtype)
    wanted = counted(rays, SMALL)
    assert all(value > 0.003 for value in wanted.values()), wanted  # none of the lines is empty
    found = irradiance.ledger(rays, SMALL)
    holds("difference between a line of the ledger and the sum over its rays", wrong(found, wanted), 1e-12)
    closure = abs(math.fsum(found.values()) - math.fsum(rays.flux.double().tolist()))
    holds("difference between the ledger's sum and the launched light", closure, 1e-12)
    off = abs(found["on target"] - float(irradiance.box(rays, SMALL).sum()))
    holds("difference between the ledger's light on the target and the picture's", off, 1e-12)


@FORMS
def test_the_ledger_of_a_simulation(holds, form):
    """Rays that were not launched missed the lens: those lines sum to 1."""
    found, rays = form(SOURCE, lens(), SMALL, RAYS, 0), traced(torch.float64)
    wanted = counted(rays, SMALL)
    wanted["missed the lens"] += 1 - math.fsum(wanted.values())
    holds("difference between a line of the ledger and the sum over its rays", wrong(found.flux, wanted), 1e-12)
    holds("sum of the ledger of a simulation, minus 1", abs(math.fsum(found.flux.values()) - 1), 1e-12)


PICTURES = {
    "rays, box": lambda screen, form: form(SOURCE, lens(), screen, RAYS, 0).box,
    "rays, tent": lambda screen, form: form(SOURCE, lens(), screen, RAYS, 0).tent,
    "tubes": lambda screen, form: tubes.picture(SOURCE, lens(), screen, 300 if form is simulated else 100),
}


@FORMS
@pytest.mark.parametrize("light", PICTURES)
def test_nothing_is_piled_on_the_border(holds, monkeypatch, light, form):
    """Rays are in the same pixels; tubes are cut at the border, which leaves rounding of a few tubes' flux."""
    monkeypatch.setattr(kernel_choice, "ENABLED", form is simulated)
    small, large = (PICTURES[light](screen, form) for screen in (SMALL, LARGE))
    assert float(large.sum()) > 1.1 * float(small.sum())  # light does leave the small screen
    piled = (border(small) - border(cut(large))).abs().max()
    figure = f"difference of border pixels from those of a larger screen, {light.split(',')[0]}"
    holds(figure, float(piled / small.max()), 1e-12, "of the brightest")


@PRECISION
def test_light_that_left_pulls_at_no_pixel(dtype):
    """The gradient of any pixel in a ray beyond the border is zero; the pull on such light is a sum of its own."""
    x, y = (p.reshape(-1) for p in stratified(Rectangle(900.0, 900.0), 60, 1, dtype))
    position = torch.stack([x, y]).requires_grad_()
    rays = Landed(position, torch.ones_like(x), torch.zeros(x.shape, dtype=torch.uint8))
    column, row = SMALL.pixel(x, y)
    gone = (column < -0.5) | (column > SIDE + 0.5) | (row < -0.5) | (row > SIDE + 0.5)
    assert 0 < int(gone.sum()) < gone.numel()
    weight = torch.rand((SIDE, SIDE), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for form in (irradiance.collect, lambda r, s: irradiance.collect_plain(r.position, r.flux, s)):
        image, outside = form(rays, SMALL)
        (of_pixels,) = torch.autograd.grad((image * weight).sum(), position, retain_graph=True)
        (of_pull,) = torch.autograd.grad(outside, position)
        assert bool((of_pixels[:, gone] == 0).all()) and bool((of_pixels[:, ~gone] != 0).any())
        assert bool((of_pull[:, gone] != 0).any(0).all())


def test_a_ray_on_the_rim_is_on_the_screen_and_the_next_float_is_not():
    """Four sides, the rim and one rounding beyond it; far away and at no place at all."""
    left, right, low, high = *SMALL.x, *SMALL.y
    on = [(left, 0.0), (right, 0.0), (0.0, low), (0.0, high), (left, low), (right, high)]
    beside = [(np.nextafter(left, -999), 0), (np.nextafter(right, 999), 0), (0, np.nextafter(low, -999))]
    beside += [(0, np.nextafter(high, 999)), (1e12, 0), (0, -1e300), (-np.inf, 0), (0, np.inf)]
    for places, line in ((on, "on target"), (beside, "off target")):
        position = torch.tensor(places, dtype=torch.float64).T.contiguous()
        n = len(places)
        rays = Landed(position, torch.ones(n, dtype=torch.float64), torch.zeros(n, dtype=torch.uint8))
        assert irradiance.ledger(rays, SMALL)[line] == n
        assert float(irradiance.box(rays, SMALL).sum()) == (n if line == "on target" else 0)
