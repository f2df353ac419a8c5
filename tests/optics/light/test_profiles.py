"""Profiles of sources: fluxes by closed forms and by sums, splines by their sums, points by their intensities."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.profiles import Net, Profile
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import EVERYWHERE, Circle, Rectangle, Rounded
from tests import suite
from tests.lenses import Measured

APERTURES = [Circle(5.0), Rectangle(8.0, 3.0), Rounded(9.0, 7.0, corner_radius=2.0)]
PROFILES = {
    "wide": Profile((9.0, 4.0), rotate=30.0),
    "inside": Profile((0.5, 0.2), rotate=-70.0),
    "thin": Profile((6.0, 0.1), rotate=10.0),
    "flat": Profile((3.0, 2.5), order=12.0),
    "annular": Profile(inner=1.2),
    "net": Profile(net=Net(np.random.default_rng(0).random((20, 30)), (-4.0, 4.5), (-3.0, 5.0)), rotate=15.0),
}


def summed(law, outline, n=3000):
    x, y = sampling.grid(Rectangle(*(2 * half for half in outline.half_extent)), n)
    light = torch.where(outline.contains(x, y), law.density(x, y), 0.0)
    return float(light.sum()) * 4 * math.prod(outline.half_extent) / n**2


@pytest.mark.parametrize("outline", APERTURES, ids=str)
@pytest.mark.parametrize("name", suite.in_turns(PROFILES, 3))
def test_the_flux_inside_an_outline_is_the_sum_over_small_cells(name, outline):
    assert PROFILES[name].flux(outline) == pytest.approx(
        summed(PROFILES[name], outline), rel=2e-3
    )  # a net ends on its rim


def test_the_flux_of_a_gaussian_is_its_closed_form_where_no_rim_cuts_it():
    """π w_u w_v / 2, also by quadrature, whose outline just cuts the ellipse of 1e-14 of the peak."""
    law = Profile((2.0, 0.5), rotate=20.0)
    assert law.flux(EVERYWHERE) == pytest.approx(math.pi / 2, rel=1e-15)
    assert law.flux(Circle(7.5)) == pytest.approx(math.pi / 2, rel=1e-12)
    cut = 2 * math.pi * (1 - math.exp(-2.0))  # of a round one of radius 2, inside its radius
    assert Profile((2.0, 2.0)).flux(Circle(2.0)) == pytest.approx(cut, rel=1e-12)


@pytest.mark.parametrize("sides", [(5, 5), (6, 9), (33, 20)])
def test_the_flux_of_a_net_is_the_integral_of_its_spline(sides):
    net = Net(np.random.default_rng(1).random(sides), (-3.0, 5.0), (1.0, 2.0))
    law = Profile(net=Net(net.values.numpy(), (-4.0, 4.0), (-0.5, 0.5)))
    assert law.flux(EVERYWHERE) == pytest.approx(net.flux, rel=1e-12)
    assert law.flux(Rectangle(8.0, 1.0)) == pytest.approx(net.flux, rel=2e-5)
    even = Net(np.ones(sides), (-3.0, 5.0), (1.0, 2.0))
    assert even.flux == pytest.approx(8.0, rel=1e-14)
    x, y = torch.tensor([-3.0, 0.3, 5.0, 5.1]).double(), torch.tensor([1.0, 1.7, 2.0, 1.5]).double()
    torch.testing.assert_close(even.at(x, y), torch.tensor([1.0, 1.0, 1.0, 0.0]).double())


def test_two_equal_radii_are_one():
    """The general profile against the closed forms of round beams, parallel and from a point, tilted and not."""
    x, y = (torch.rand(500, generator=torch.Generator().manual_seed(k), dtype=torch.float64) * 8 - 4 for k in (0, 1))
    for one in (
        CollimatedSource(Circle(4.5), profile="gaussian", radius_1e2=3.0),
        CollimatedSource(Rectangle(9.0, 7.0), profile="gaussian", radius_1e2=3.0, tilt=(5.0, 3.0)),
        PointSource((0.5, 0.0, -6.0), profile="gaussian", half_angle_1e2=25.0),
        PointSource((0.5, 0.0, -6.0), profile="gaussian", half_angle_1e2=25.0, tilt=(-20.0, 10.0)),
        PointSource((0.5, 0.0, 6.0), profile="gaussian", half_angle_1e2=25.0, tilt=(-20.0, 10.0)),
    ):
        key = "radius_1e2" if one.parallel else "half_angle_1e2"
        width = getattr(one, key)
        two = replace(one, **{key: (width, width * (1 + 1e-12))})
        assert two.law is not None
        torch.testing.assert_close(two.irradiance(x, y, 0.0), one.irradiance(x, y, 0.0), rtol=1e-9, atol=0)


@pytest.mark.parametrize("tilt", [None, (15.0, -10.0)])
def test_all_light_of_an_elliptical_cone_crosses_a_plane(tilt):
    source = PointSource((0.0, 0.0, -10.0), profile="gaussian", half_angle_1e2=(35.0, 10.0), rotate=40.0, tilt=tilt)
    x, y = sampling.grid(Rectangle(120.0, 120.0), 1500)
    light = source.irradiance(x, y, 0.0)
    assert float(light.sum()) * 120**2 / 1500**2 == pytest.approx(1, rel=1e-6)
    if tilt is None:  # the ellipse of its second moments, turned from x towards y
        xx, yy, xy = (float((light * p).sum() / light.sum()) for p in (x * x, y * y, x * y))
        assert math.degrees(0.5 * math.atan2(2 * xy, xx - yy)) == pytest.approx(40.0, abs=0.01)
        wide = math.sqrt((xx + yy) / 2 + math.hypot((xx - yy) / 2, xy))
        assert 2 * wide == pytest.approx(10 * math.tan(math.radians(35.0)), rel=1e-4)


@pytest.mark.parametrize("tilt", [None, (25.0, -40.0)])
def test_an_intensity_over_stereographic_coordinates_lights_a_plane_as_its_closed_form(tilt):
    """A Lambertian: cos θ = (1 - t²) / (1 + t²), t = tan(θ / 2), sampled as finely as tables of files are."""
    half = 1.02
    u, v = np.meshgrid(*2 * (np.linspace(-half, half, 513),), indexing="ij")
    r2 = u * u + v * v
    net = Net(np.maximum((1 - r2) / (1 + r2), 0.0), (-half, half), (-half, half))
    point = PointSource((1.0, -2.0, 3.0), tilt=tilt)
    table = replace(point, intensity=Measured(Profile(net=net, stereographic=True, whole=math.pi)))
    for z in (13.0, -7.0):
        x, y = sampling.grid(Rectangle(40.0, 40.0), 100)
        light = point.irradiance(x, y, z)
        assert (table.irradiance(x, y, z) - light).abs().max() < 5e-4 * light.max()  # where the half space ends
