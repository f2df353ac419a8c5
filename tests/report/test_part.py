"""What a machine shop asks of a part, against plates and caps whose answers are known in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Conic, Plane, Sphere
from bstcad.report.step_part import part

WIDE = Rectangle(24.0, 16.0)


def plate(front, back_z=20.0, outline=WIDE, heights=None):
    heights = torch.zeros((33, 33), dtype=torch.float64) if heights is None else heights
    reach = 32 / 28 if isinstance(outline, Circle) else 1.0  # the net of a round lens goes on past the rim
    half_x, half_y = (reach * half for half in outline.half_extent)
    return Lens(front, BSplineSurface(back_z, heights, (-half_x, half_x), (-half_y, half_y)), outline, 1.5)


def test_a_flat_plate():
    found = part(plate(Plane(15.0)))
    assert found["Overall size"] == "24 × 16 × 5 mm (x, y, z)"
    assert found["Lies at"] == "x = ±12, y = ±8, z = 15 to 20 mm"
    assert found["Centre thickness"] == "5 mm" and found["Edge thickness"] == "5 to 5 mm"
    assert found["Volume"] == "1.92 cm³" and found["Mass"].startswith("1.92 g for each g/cm³")
    assert found["Smallest radii of the back"] == "concave none, convex none"
    assert found["Front"] == "plane at z = 15 mm" and "enters the front" in found["Orientation"]


def test_the_mass_is_volume_times_the_stated_density():
    found = part(plate(Plane(15.0)), density=1.18)
    assert found["Mass"] == "2.266 g, by the density of 1.18 g/cm³ that the file states"


def test_a_tilted_back():
    """One in four along x."""
    slope = torch.linspace(-1, 1, 33, dtype=torch.float64)[:, None].expand(33, 33) * 12 / 4
    found = part(plate(Plane(10.0), heights=slope.contiguous()))
    assert found["Overall size"] == "24 × 16 × 13 mm (x, y, z)" and found["Edge thickness"] == "7 to 13 mm"
    assert found["Steepest slope of the back"] == f"{math.degrees(math.atan(0.25)):.0f}°"


@pytest.mark.parametrize(("sign", "bent", "low"), [(1, "convex", 15.0), (-1, "concave", 13.99)])
def test_a_spherical_front(sign, bent, low):
    found = part(plate(Sphere(15.0, sign / 50.0), outline=Circle(10.0)))
    assert found["Front"] == f"sphere, {bent}, radius 50 mm; its vertex is at z = 15 mm"
    assert found["Outline"] == "round, diameter 20 mm"
    assert f"z = {low:g} to 20 mm" in found["Lies at"]
    rise = 50 - math.sqrt(2400)
    assert found["Edge thickness"].endswith(f" {5 - sign * rise:.2f} mm")


@pytest.mark.parametrize(
    ("constant", "words"),
    [
        (0.0, "sphere, concave, radius 40 mm;"), (-0.5, "ellipsoid, concave, radius 40 mm, conic constant -0.5;"),
        (2.0, "ellipsoid, concave, radius 40 mm, conic constant 2;"), (-1.0, "paraboloid, concave, radius 40 mm, con"),
        (-1 + 1e-12, "paraboloid, concave"), (-2.25, "hyperboloid, concave, radius 40 mm, conic constant -2.25;"),
    ],
)  # fmt: skip
def test_a_conic_front(constant, words):
    found = part(plate(Conic(15.0, -1 / 40.0, constant), outline=Circle(10.0)))
    assert found["Front"].startswith(words)
    bend = (1 + constant) / 1600
    fall = 100 / 40 / (1 + math.sqrt(1 - bend * 100))
    assert float(found["Edge thickness"].split()[0]) == pytest.approx(5 + fall, abs=1e-3)


def test_a_freeform_front():
    slope = torch.linspace(-1, 1, 33, dtype=torch.float64)[:, None].expand(33, 33).contiguous()
    found = part(plate(BSplineSurface(15.0, slope, (-12.0, 12.0), (-8.0, 8.0))))
    assert found["Front"] == "freeform, 33 × 33 control points; crosses the axis at z = 15 mm"
    assert found["Edge thickness"] == "4 to 6 mm" and found["Volume"] == "1.92 cm³"


@pytest.mark.parametrize(
    ("front", "place"),
    [(3.0, "3 mm before the vertex of the front"), (0.0, "at the vertex of the front"),
     (-2.0, "in the lens, 2 mm behind the vertex of the front"), (-9.0, "4 mm behind the vertex of the back")],
)  # fmt: skip
def test_where_the_origin_lies(front, place):
    assert place in part(plate(Plane(front), front + 5.0))["Origin of the file"]
