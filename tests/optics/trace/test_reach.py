"""Reach of a face: the critical angle, the slope of a mirror, tilted planes, and the law itself."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.optics.lens.interfaces import Reflect, Refract
from bstcad.optics.receivers.goal import restricted
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.trace.reach import (
    MAX_EXIT_ANGLE,
    MAX_SLOPE,
    grazing_of,
    largest_deflection,
    limit_refraction,
    reach_margin,
    wanted_slopes,
)
from tests.by_slope import deflect
from tests.lenses import bundle

INDEX = 1.4936
GLASS = Refract(INDEX, 1.0)
DISTANCE = 200.0


def ray(direction=(0.0, 0.0, 1.0), sense=1, n=1):
    """n rays at the origin."""
    return replace(bundle(torch.zeros(n, 3), direction), sense=sense)


def at(*angles):
    """Places (2, n) of the plane z = DISTANCE that are seen under these angles (degrees) from the origin."""
    x = torch.tensor([DISTANCE * math.tan(math.radians(a)) for a in angles], dtype=torch.float64)
    return torch.stack([x, torch.zeros_like(x)])


def test_a_ring_about_the_largest_deflection_is_half_within_reach():
    """Light along the axis: δ = θ' - asin(sin θ' / n) at θ' = 85°, 43.2° at n = 1.4936; 48° at the critical angle."""
    most = math.degrees(largest_deflection(INDEX))
    assert most == pytest.approx(43.16, abs=0.01) and most < math.degrees(math.acos(1 / INDEX)) < 48.0
    turned = torch.linspace(0, 2 * math.pi, 13, dtype=torch.float64)[:-1]
    for off, reached in ((-1e-3, True), (1e-3, False)):
        radius = DISTANCE * math.tan(math.radians(most + off))
        ring = radius * torch.stack([torch.cos(turned), torch.sin(turned)])
        rest = reach_margin(ray(n=12), ring, LevelPlane(DISTANCE), GLASS)
        assert ((rest >= 0) == reached).all()


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("law", [GLASS, Reflect()], ids=["glass", "mirror"])
def test_slopes_that_would_reflect_all_are_turned_back_to_grazing_light(law, sense):
    """Beyond the angle light leaves at it, in the plane of ray and normal as before; all other slopes stay."""
    generator = torch.Generator().manual_seed(3)
    z_x, z_y = 1.2 * torch.randn((2, 400), dtype=torch.float64, generator=generator)
    rays = ray((0.2, -0.1, sense * math.sqrt(0.95)), sense=sense, n=400)
    kept = limit_refraction(rays, (z_x, z_y), law)
    before, after = (deflect(rays, *slopes, law) for slopes in ((z_x, z_y), kept))
    moved = (kept[0] != z_x) | (kept[1] != z_y)
    assert after.rays.alive.all()
    if law is not GLASS:
        assert not moved.any()
        return
    assert 0.1 < moved.double().mean() < 0.9 and (before.cos_out[~moved] >= math.cos(MAX_EXIT_ANGLE) - 1e-9).all()
    assert after.cos_out[moved] == pytest.approx(math.cos(MAX_EXIT_ANGLE), abs=1e-9)
    d = rays.direction[:, moved]
    normals = [torch.stack([-x[moved], -y[moved], torch.ones_like(x[moved])]) for x, y in ((z_x, z_y), kept)]
    assert torch.linalg.cross(d, normals[0], dim=0).mul(normals[1]).sum(0).abs().max() < 1e-9


@pytest.mark.parametrize(
    "plane", [LevelPlane(DISTANCE), TiltedPlane((30.0, -20.0, DISTANCE), (25.0, -40.0))], ids=["level", "tilted"]
)
@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.3, -0.1, math.sqrt(0.9))], ids=["along the axis", "oblique"])
def test_what_is_within_reach_is_what_snells_law_brings_there(plane, direction):
    """Targets within reach have a slope that sends the ray to its aim short of MAX_EXIT_ANGLE; others have none."""
    line = torch.linspace(-600.0, 600.0, 41, dtype=torch.float64)
    aim = torch.stack([t.reshape(-1) for t in torch.meshgrid(line, line, indexing="ij")])
    rays = ray(direction, n=aim.shape[1])
    inside = reach_margin(rays, aim, plane, GLASS) > 1e-9
    z_x, z_y = wanted_slopes(rays, aim, plane, GLASS)
    hit = deflect(rays, z_x, z_y, GLASS)
    way = hit.rays.direction
    point = torch.stack(plane.point(*aim))
    arrives = ((way * point).sum(0) / point.norm(dim=0)) > 1 - 1e-12
    assert 0.05 < inside.double().mean() < 0.9
    assert arrives[inside].all() and (hit.cos_out[inside] >= math.cos(MAX_EXIT_ANGLE) - 1e-9).all()
    assert not (arrives & ~inside & hit.rays.alive & (hit.cos_out > math.cos(MAX_EXIT_ANGLE) + 1e-9)).any()


def test_a_mirror_reaches_as_far_as_its_slope():
    """Light from above, thrown back by a slope of s: it leaves under twice the angle."""
    steepest = math.degrees(math.atan(MAX_SLOPE))
    down = ray((0.0, 0.0, -1.0), sense=-1, n=3)
    rest = reach_margin(down, at(0.0, 60.0, 89.0), LevelPlane(DISTANCE), Reflect())
    assert (rest >= 0).all() and steepest > 45.0  # twice 45° is level: all that lies above is within reach
    behind = LevelPlane(-DISTANCE)  # the mirror
    assert float(reach_margin(down, at(10.0)[:, :1].expand(2, 3), behind, Reflect()).max()) < 0


def test_other_lines_and_a_source_of_some_size_take_from_the_reach():
    """No other line may be reflected where the main one leaves, nor light that comes aslant to it."""
    assert grazing_of(INDEX, [INDEX]) == pytest.approx(MAX_EXIT_ANGLE, abs=1e-12)
    blue = 1.51
    angle = grazing_of(INDEX, [INDEX, blue])
    assert math.sin(angle) / INDEX * blue == pytest.approx(math.sin(MAX_EXIT_ANGLE))
    aslant = grazing_of(INDEX, [INDEX], spread=math.radians(0.1))
    inside = math.asin(math.sin(aslant) / INDEX) + math.radians(0.1)
    assert INDEX * math.sin(inside) == pytest.approx(math.sin(MAX_EXIT_ANGLE))


def test_a_picture_keeps_its_light_on_the_part_within_reach():
    picture, part = np.array([[0.5, 0.1], [0.1, 0.3]]), np.array([[True, False], [True, True]])
    kept = restricted(picture, part)
    assert kept.sum() == pytest.approx(1.0) and kept[0, 1] == 0 and kept[0, 0] / kept[1, 1] == pytest.approx(5 / 3)
    assert restricted(picture, None) is picture
