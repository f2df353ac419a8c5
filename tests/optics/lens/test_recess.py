"""A front with an outline of its own: a dome in a flat underside.  Its equation, its light, and the light beside it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.charts import SphereChart
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Conic, Recess, Sphere
from bstcad.optics.trace.trace import UNDERSIDE, on_underside, simulate, simulate_plain, to_first_net, trace
from tests.lenses import net

RADIUS, EDGE, RIM = 12.0, 10.0, 25.0  # mm: of the dome, of its outline, of the lens
PLANE = math.sqrt(RADIUS**2 - EDGE**2)  # z of the underside, the centre of the dome at 0
DOME = Recess(Sphere(RADIUS, -1 / RADIUS), Circle(EDGE))
ROUND = Circle(RIM)
SCREEN = Screen(500.0, (-1e4, 1e4), (-1e4, 1e4), 16)


def lens(front=DOME, outline=ROUND):
    """A back that falls towards the rim, so that light of 60 degrees meets it."""
    return Lens.between(front, net(lambda x, y: -6 * (x**2 + y**2) / 35**2, 24.0, half=35.0), outline, 1.5)


@pytest.mark.parametrize("face", [DOME.face, Conic(8.0, 0.05, -2.0)], ids=lambda face: face.kind)
def test_inside_it_is_its_optical_part_and_beyond_a_plane_through_the_rim(face):
    front = Recess(face, Circle(EDGE))
    x, y = 40 * (torch.rand((2, 1000), generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5)
    inside = x * x + y * y <= EDGE**2
    for found, own in zip(front.sag_and_slope(x, y), face.sag_and_slope(x, y), strict=True):
        assert torch.equal(found[inside], own[inside])
    z, z_x, z_y = (part[~inside] for part in front.sag_and_slope(x, y))
    rim, _, _ = face.sag_and_slope(*torch.tensor([[EDGE], [0.0]], dtype=torch.float64))
    assert float((z - rim).abs().max()) < 1e-12 and not z_x.any() and not z_y.any()
    assert front.around.z == pytest.approx(float(rim), abs=1e-12) and front.around.level
    assert front.sags(Circle(RIM)) == face.sags(Circle(EDGE)) and front.sags(Circle(2.0)) == face.sags(Circle(2.0))
    assert front.moved(3.0).with_parameters(curvature=0.01).parameters()["curvature"] == 0.01


def test_a_ray_crosses_the_dome_inside_its_outline_alone():
    """Rays from the centre go on undeflected; a micron outside the rim they are lost."""
    r = torch.tensor([0.0, 5.0, EDGE - 1e-6, EDGE + 1e-6, 20.0], dtype=torch.float64)
    rays = PointSource().rays_through(r * RADIUS / PLANE, 0 * r, RADIUS, 1.0)  # through r of the underside's plane
    behind = to_first_net(rays, lens())
    assert behind.alive.tolist() == [True, True, True, False, False]
    assert set(behind.status[3:].tolist()) == {int(Status.MISSED_FRONT)}
    torch.testing.assert_close(behind.direction[:, :3], rays.direction[:, :3], rtol=0, atol=1e-12)
    assert bool((behind.position[:2, :3].norm(dim=0) <= EDGE).all())
    beam = to_first_net(CollimatedSource(Circle(RIM), z=-5.0).rays_through(r, 0 * r, RADIUS, 1.0), lens())
    assert beam.alive.tolist() == [True, True, True, False, False]  # also where the way needs no search


@pytest.mark.parametrize("rays", ["kernel", "plain"])
@pytest.mark.parametrize("half_angle", [None, 60.0])
def test_the_light_beside_the_dome_is_a_line_of_the_ledger(rays, half_angle):
    """A Lambertian point sends r² / (r² + d²) through a disc at the distance d, over sin² of the cone's half angle."""

    def within(r):
        whole = 1.0 if half_angle is None else math.sin(math.radians(half_angle)) ** 2
        return min(r * r / (r * r + PLANE**2) / whole, 1.0)

    through = simulate if rays == "kernel" else simulate_plain
    [light] = through([(1.0, PointSource(half_angle=half_angle), lens(), 1)], [SCREEN], 400)
    assert math.fsum(light.flux.values()) == pytest.approx(1, abs=1e-12)
    assert light.flux[UNDERSIDE] == pytest.approx(within(RIM) - within(EDGE), abs=3e-4)
    assert light.flux["missed the lens"] == pytest.approx(1 - within(RIM), abs=1e-3)
    enters = 1 - light.flux["missed the lens"] - light.flux[UNDERSIDE]
    assert enters == pytest.approx(within(EDGE), abs=1e-3)
    [unsplit] = through([(1.0, PointSource(half_angle=half_angle), lens(), 1)], [SCREEN], 400, splits_missed=False)
    assert torch.equal(unsplit.box, light.box) and UNDERSIDE not in unsplit.flux
    assert unsplit.flux["missed the lens"] == pytest.approx(light.flux["missed the lens"] + light.flux[UNDERSIDE])


def test_the_underside_of_a_dome_ends_at_its_rim_in_space():
    """The outline of a dome is a circle of its chart, 30.7 mm here; seen along the axis its rim has 20 mm sin 75°."""
    lit = SphereChart(20.0).length(math.radians(75.0))
    back = RadialSurface.sphere(0.0, 20.0, (1.1 * lit, 1.1 * lit), (33, 33))
    dome = Lens.between(DOME, back, Circle(lit), 1.5, clear=(Circle(EDGE), Circle(lit)))
    [light] = simulate_plain([(1.0, PointSource(), dome, 1)], [SCREEN], 200)
    rim = 20.0 * math.sin(math.radians(75.0))
    within = [r * r / (r * r + PLANE**2) for r in (rim, EDGE)]
    assert light.flux[UNDERSIDE] == pytest.approx(within[0] - within[1], abs=3e-4)


def test_a_source_in_the_dome_lights_no_underside():
    assert on_underside(PointSource((0.0, 0.0, PLANE + 0.5)), DOME, Circle(RIM)) == 0.0
    bulge = Recess(Sphere(3.0, 1 / RADIUS), Circle(EDGE))  # towards the source: what meets it is not behind it too
    beside = on_underside(PointSource((0.0, 0.0, -30.0)), bulge, Rectangle(50.0, 50.0))
    d = 30.0 + bulge.around.z
    assert 0.2 < beside < 50**2 / math.pi / d**2 - EDGE**2 / (EDGE**2 + d**2)


def test_the_kernel_traces_a_dome_as_the_plain_form_does(monkeypatch):
    source, wide = PointSource((0.5, -1.0, 1.0), half_angle=70.0), replace(lens(), outline=Rectangle(50.0, 40.0))
    [fast] = simulate([(1.0, source, wide, 3)], [SCREEN], 300)
    [plain] = simulate_plain([(1.0, source, wide, 3)], [SCREEN], 300)
    torch.testing.assert_close(fast.box, plain.box, rtol=0, atol=1e-13)
    assert fast.flux == pytest.approx(plain.flux, abs=1e-12)
    x = torch.linspace(-15, 15, 40, dtype=torch.float64)
    rays = source.rays_through(*torch.meshgrid(x, x, indexing="ij"), RADIUS, 1.0)
    first = trace(rays, wide, LevelPlane(500.0))
    monkeypatch.setattr(kernel_choice, "ENABLED", False)
    second = trace(rays, wide, LevelPlane(500.0))
    assert torch.equal(first.status, second.status) and 100 < int(first.alive.sum()) < 1500
    alive = first.alive
    torch.testing.assert_close(first.position[:, alive], second.position[:, alive], rtol=1e-10, atol=1e-9)
