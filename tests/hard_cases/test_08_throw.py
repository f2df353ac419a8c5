"""8. Throws from 0.1 mm to 10 km, and the whole scene shifted by a kilometre.

A landing is an angle times the throw, and a hit is a difference of heights: mitsuba3 (#61, #219) holds all places from
one origin in float32, whose steps are 0.06 mm at a kilometre, and loses self-intersections and thin parts.  Here a
bundle of rays says which plane its heights count from (rays.Rays.z), each face counts from its own plane, and planes
meet only as differences of Python's numbers; so a shift changes no bit, and a throw costs what an angle's last digit
costs.  The truth is the trace in sixty digits (exact.py), with the numbers as the program has them.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import tubes
from tests.hard_cases import exact
from tests.hard_cases.lenses import DTYPES, NAMES, engines, eps
from tests.lenses import lens_of, uniform, wavy
from tests.tracing import simulated

THROWS = (0.1, 1.0, 100.0, 1e3, 1e5, 1e7)
SHIFTS = (0.0, 1e6, -1e6)
OPERATIONS = 40  # between a ray's start and its landing
UNITS = OPERATIONS**0.5  # each is wrong by half a unit at most, and their signs are as good as random
RAYS = 8


def scene(dtype, shift=0.0, kind="point", distance=15.0) -> tuple:
    """(source, lens): sags within 0.05 mm, so that even the nearest screen lies behind the lens."""
    back = wavy(dtype, m=9, depth=-0.04, ripple=0.01, z=20.0 + shift)
    start = 15.0 + shift - distance
    source = PointSource((0.25, -0.5, start)) if kind == "point" else CollimatedSource(Circle(12.0), z=start)
    return source, lens_of(back, Sphere(15.0 + shift, -0.02))


def points(dtype):
    return uniform((2, RAYS), 3, -7.0, 7.0).to(dtype)


def exactly(source, lens: Lens, x, y, z: float) -> list:
    """Landings (x, y) in sixty digits of the rays through (x, y) of the plane of the front's vertex."""
    found = []
    for p, q in zip(x, y, strict=True):
        if isinstance(source, PointSource):
            start, through = source.position, (p, q, lens.front.z)
            way = [exact.number(b) - exact.number(a) for a, b in zip(start, through, strict=True)]
        else:
            start, way = (p, q, source.z), (0.0, 0.0, 1.0)
        found.append(exact.landing(start, way, lens, z))
    return found


def off(position, truth) -> float:
    """Largest distance from the truth along x or y (mm)."""
    pairs = zip(position.T.tolist(), truth, strict=True)
    return float(max(abs(exact.number(a) - b) for pair in pairs for a, b in zip(*pair, strict=True)))


def unit(lens: Lens, throw: float, dtype) -> float:
    """Return the shift of a landing (mm) by half a unit in the last place: of a direction or slope, and of a position.

    A direction turns a ray by itself, slopes are differences of heights over a pitch; the steepest ray is some 35° off
    the axis, where a turn moves the landing by throw / cos², less than twice the throw.
    """
    slope = 1 + float(lens.back.heights.abs().max()) / lens.back.pitch[0]
    return eps(dtype) / 2 * (2 * slope * throw + 10.0)


CASES = [(kind, throw, 15.0) for kind in ("point", "collimated") for throw in THROWS]


@DTYPES
@pytest.mark.parametrize(("kind", "throw", "distance"), [*CASES, ("point", 1e3, 1e3), ("point", 1e3, 1e6)])
def test_a_landing_is_wrong_by_the_last_digits_of_an_angle(kind, throw, distance, dtype, holds):
    """A path of a kilometre is known to 0.06 mm in float32; where it meets the lens is known by its direction."""
    for shift in SHIFTS if distance == 15.0 else (0.0,):
        source, lens = scene(dtype, shift, kind, distance)
        x, y = points(dtype)
        z = lens.back.z + throw
        truth = exactly(source, lens, x, y, z)
        for _, landed in engines(source, lens, x, y, z):
            assert landed.alive.all()
            error, bound = off(landed.position, truth), UNITS * unit(lens, throw, dtype)
            figure = f"landing error, divided by the shift due to rounding in the last place, {NAMES[dtype]}"
            holds(figure, error / bound * UNITS, UNITS)
            if throw in (0.1, 1e3, 1e7) and distance == 15.0:
                holds(f"landing error, throw {throw:g} mm, {NAMES[dtype]}", error, bound, "mm")


@DTYPES
@pytest.mark.parametrize("kind", ["point", "collimated"])
@pytest.mark.parametrize("throw", [0.125, 1000.0, 1e7])
def test_a_shift_changes_no_bit(throw, kind, dtype):
    """Planes at multiples of 1/8 mm, which floats hold exactly a kilometre away too: rays, pictures and flux tubes."""
    results = []
    for shift in SHIFTS:
        source, lens = scene(dtype, shift, kind)
        x, y = points(dtype)
        z = lens.back.z + throw
        found = [landed.position for _, landed in engines(source, lens, x, y, z)]
        screen = Screen(z, (-0.6 * throw - 8, 0.7 * throw + 8), (-0.5 * throw - 8, 0.5 * throw + 8), 16)
        told = simulated(source, lens, screen, 64, 0)
        sheet = tubes.launch_tubes(source, lens, 12)
        picture = tubes.picture(source, lens, screen, 12)
        results.append([*found, told.box, told.tent, sheet.flux, sheet.landing(lens, LevelPlane(z)).position, picture])
        assert float(picture.sum()) > 0.1
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@DTYPES
@pytest.mark.parametrize("scale", [2.0**-10, 2.0**10])
def test_a_scene_scaled_by_a_power_of_two_lands_scaled_to_the_bit(scale, dtype):
    results = []
    for s in (1.0, scale):
        back, ends = wavy(dtype, m=17, depth=0.7, ripple=0.03, z=20.0 * s), (-12.0 * s, 12.0 * s)
        back = replace(back, heights=s * back.heights, x=ends, y=ends)
        lens = lens_of(back, Sphere(15.0 * s, -0.02 / s), Rectangle(20.0 * s, 20.0 * s))
        x, y = s * uniform((2, 100), 3, -8.0, 8.0).to(dtype)
        results.append([landed.position / s for _, landed in engines(PointSource(), lens, x, y, 500.0 * s)])
    assert all(torch.equal(a, b) and torch.isfinite(a).all() for a, b in zip(*results, strict=True))
