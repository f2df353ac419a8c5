"""Radial surfaces: laws of their chart, crossings by rays beside solvers of their own, and light over a sphere."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.optimize import root

from bstcad.optics.lens.interfaces import Refract, deflect, intersect
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.sphere_light import SphereLight
from bstcad.optics.surfaces.charts import HEIGHTS, SphereChart
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.rays import Rays, Status
from tests.benchmarks import independent_trace

R, Z, HALF = 15.0, 2.0, math.radians(85.0)
CHART = SphereChart(R)
RIM = CHART.length(HALF)  # mm of the chart
EVERYWHERE = Circle(1e9)


def dome(height=None, m=33, reach=1.03):
    """Return the dome whose control points are height(x, y) mm farther from (0, 0, Z) than R."""
    ends = (-reach * RIM, reach * RIM)
    x = torch.linspace(*ends, m, dtype=torch.float64)
    h = torch.zeros((m, m), dtype=torch.float64) if height is None else height(x[:, None], x[None, :])
    return RadialSurface(Z, h, ends, ends, radius=R)


def waves(amplitude, per_mm=0.7, m=65):
    """Return a dome with waves."""
    return dome(lambda x, y: amplitude * torch.sin(per_mm * x + 0.3) * torch.cos(0.9 * per_mm * y), m)


def rays_from(origin, direction):
    """Return rays from points (3, n) relative to the centre (0, 0, Z) along vectors (3, n) of any length."""
    origin, direction = torch.broadcast_tensors(origin, direction)
    one = torch.ones_like(origin[0])
    return Rays(origin, direction / direction.norm(dim=0), one, torch.zeros_like(one, dtype=torch.uint8), z=Z)


def random_rays(n, spread, seed=0):
    """Return rays in all directions from normally distributed points, `spread` mm wide, inside the sphere of R / 2."""
    o, d = torch.randn((2, 3, n), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    o = spread * o
    return rays_from(o * (0.5 * R / o.norm(dim=0)).clamp(max=1.0), d)


def met(surface, rays, outline=EVERYWHERE):
    """Return (found, points (n, 3) relative to the centre, normals (n, 3)) of rays at a surface."""
    at, normal = intersect(surface, rays, outline, Status.VIGNETTED)
    return at.alive.numpy(), at.position.numpy().T, torch.stack(normal).numpy().T


def chart_points(n=500, largest=170.0, seed=3):
    """Return points (x, y) of the chart up to an angle (degrees) from the axis."""
    theta, psi = torch.rand((2, n), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    length = 2 * R * torch.tan(torch.deg2rad(theta * largest) / 2)
    return length * torch.cos(2 * math.pi * psi), length * torch.sin(2 * math.pi * psi)


# --- the chart --------------------------------------------------------------------------------------------------------


def test_the_chart_gives_its_coordinates_back_and_its_lengths_are_angles():
    x, y = chart_points()
    h = 0.1 * x / R
    back = CHART.coordinates(CHART.point(x, y, h))
    torch.testing.assert_close(torch.stack(back), torch.stack([x, y, h]), rtol=1e-12, atol=1e-12)
    theta = torch.acos(CHART.direction(x, y)[2])
    for length, angle in zip(torch.hypot(x, y)[:20].tolist(), theta[:20].tolist(), strict=True):
        assert SphereChart.angle(length, R) == pytest.approx(angle, abs=1e-9)
        assert CHART.length(angle) == pytest.approx(length, rel=1e-7)


def test_the_chart_is_conformal_with_the_stretch_that_it_states():
    """∂d/∂x and ∂d/∂y are perpendicular, of the length s / R, and along the local axes e_x and e_y."""
    x, y = chart_points()
    step = 1e-4
    along = [
        (CHART.direction(x + step * i, y + step * j) - CHART.direction(x - step * i, y - step * j)) / (2 * step)
        for i, j in ((1, 0), (0, 1))
    ]
    d = CHART.direction(x, y)
    local = torch.stack([CHART.local(3 * d, a) for a in along]) * R / CHART.stretch(3 * d)
    expected = torch.eye(3, dtype=torch.float64)[:2, :, None].expand_as(local)
    torch.testing.assert_close(local, expected, rtol=0, atol=1e-7)


def test_the_local_axes_are_orthonormal_and_right_handed_and_the_third_leads_outwards():
    position = CHART.point(*chart_points(), torch.tensor(1.0))
    unit = torch.eye(3, dtype=torch.float64)[:, :, None].expand(3, 3, position.shape[1])
    turn = torch.stack([CHART.local(position, vector) for vector in unit], dim=1)  # (axis, component, point)
    turn = turn.movedim(-1, 0)
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3).double().expand_as(turn), rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(len(turn)).double())
    torch.testing.assert_close(turn[:, 2], (position / position.norm(dim=0)).T)


def test_slopes_are_the_gradient_of_the_log_of_the_distance():
    """∇f, f = R log(ρ / R), by differences between neighbouring points of the surface."""
    surface, (x, y), step = waves(0.5), chart_points(largest=80.0), 1e-4

    def values(x, y):
        at_x, at_y, h = CHART.coordinates(surface.at(x, y).position)
        return torch.stack([at_x, at_y, R * torch.log1p(h / R)])

    def difference(i, j):
        return (values(x + i * step, y + j * step) - values(x - i * step, y - j * step)) / (2 * step)

    along_x, along_y = difference(1, 0), difference(0, 1)
    matrix = torch.stack([along_x[:2], along_y[:2]]).movedim(-1, 0)  # the points move a little beside their (x, y)
    gradient = torch.linalg.solve(matrix, torch.stack([along_x[2], along_y[2]], dim=-1))
    h, f_x, f_y = surface.relative_sag_and_slope(x, y)
    torch.testing.assert_close(torch.stack([f_x, f_y], dim=-1), gradient, rtol=0, atol=1e-6)
    torch.testing.assert_close(h, CHART.coordinates(surface.at(x, y).position)[2], rtol=0, atol=1e-13)


def test_equal_distances_make_a_sphere_but_for_the_stated_radial_error():
    """The error R (pitch / R)² / 4 s² is radial; all other errors are of the third order."""
    x, y = chart_points(largest=75.0)
    rests = []
    for m in (33, 65, 129):
        surface = dome(m=m)
        at = surface.at(x, y)
        rho = at.position.norm(dim=0)
        pitch = surface.pitch[0]
        stated = R * (pitch / R) ** 2 / 4 * CHART.stretch(at.position) ** 2
        across = (at.position / rho - CHART.direction(x, y)).norm(dim=0)
        rests.append((float((R - rho - stated).abs().max()), float(across.max())))
        assert float((R - rho).abs().max()) > 10 * max(rests[-1])
    for coarse, fine in zip(rests, rests[1:], strict=False):
        assert all(7 < a / b < 10 for a, b in zip(coarse, fine, strict=True))


# --- poles ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(17, 17), (17, 23)])
def test_control_points_give_the_surface_back(shape):
    h = 0.3 * torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    surface = RadialSurface(Z, h, (-20.0, 21.0), (-17.0, 19.0), radius=R)
    back = RadialSurface.from_control_points(surface.control_points(), Z)
    assert np.abs(back.control_points() - surface.control_points()).max() < 1e-12 * R
    x, y = torch.tensor([-13.0, 0.5, 20.0]).double(), torch.tensor([7.0, -3.0, -16.0]).double()
    scale = back.radius / R
    torch.testing.assert_close(back.at(scale * x, scale * y).position, surface.at(x, y).position, rtol=0, atol=1e-12)
    assert (surface.with_potential(surface.potential).heights - h).abs().max() < 1e-12


@pytest.mark.parametrize("fault", ["shifted", "another centre", "height field", "not a number"])
def test_a_net_that_is_not_radial_is_refused(fault):
    net, z = dome(lambda x, y: 0.01 * x * y).control_points(), Z
    if fault == "shifted":
        net[7, 9, 0] += 1e-7
    elif fault == "another centre":
        z += 1e-6
    elif fault == "height field":
        net[..., :2] *= 2.0
    else:
        net[3, 3, 1] = math.nan
    with pytest.raises(ValueError, match="radial"):
        RadialSurface.from_control_points(net, z)


# --- crossings --------------------------------------------------------------------------------------------------------


def by_scipy(surface, origin, direction, start):
    """Return the point at which a line meets the B-spline of the control points, by MINPACK from a point near it."""
    net = surface.control_points() - (0.0, 0.0, surface.z)
    knots = [independent_trace.uniform_knots(count) for count in net.shape[:2]]

    def point(t):
        along = BSpline(knots[1], np.moveaxis(BSpline(knots[0], net, 2)(t[0]), 0, 0), 2)
        return along(t[1])

    def off(q):
        return point(q[:2]) - origin - q[2] * direction

    grid = np.linspace(0, len(net) - 2, 32)
    places = np.array([[point((u, v)) for v in grid] for u in grid])
    i, j = np.unravel_index(((places - start) ** 2).sum(-1).argmin(), places.shape[:2])
    found = root(off, [grid[i], grid[j], np.dot(places[i, j] - origin, direction)], tol=1e-15)
    assert np.abs(found.fun).max() < 1e-12 * R
    return point(found.x[:2])


@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_points_are_on_the_surface_and_on_the_ray(spread):
    surface, rays = waves(0.3), random_rays(200, spread)
    found, points, normals = met(surface, rays)
    o, d = rays.position.numpy().T, rays.direction.numpy().T
    path = ((points - o) * d).sum(1)
    assert 70 < found.sum() < 130 and (path[found] > 0).all()
    assert np.abs(points - o - path[:, None] * d)[found].max() < 1e-12 * R
    x, y, _ = CHART.coordinates(torch.from_numpy(points[found].T.copy()))
    for k in np.flatnonzero(found)[:3]:
        assert np.abs(by_scipy(surface, o[k], d[k], points[k]) - points[k]).max() < 1e-12 * R
    net, work = independent_trace.dome_of(surface.control_points(), (0, 0, Z)), np.empty((7, 3))
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    for k, p in enumerate(o + (0, 0, Z)):
        meets, _, point, normal = independent_trace.on_dome(net, *independent_trace.start(net, p, d[k]), p, d[k], work)
        assert meets == found[k]
        if meets:
            assert np.abs(np.subtract(point, (0, 0, Z)) - points[k]).max() < 1e-12 * R
            assert np.abs(normal - unit[k]).max() < 1e-11


def test_rays_through_the_centre_meet_the_surface_in_their_direction():
    surface, d = waves(0.5), random_rays(200, 0.0).direction
    straight = met(surface, rays_from(torch.zeros_like(d), d))
    through = met(surface, rays_from(-0.4 * R * d, d))
    assert (straight[0] == through[0]).all()
    found, points, _ = straight
    assert np.abs(through[1] - points)[found].max() < 1e-12 * R
    assert np.abs(np.cross(points, d.numpy().T))[found].max() < 1e-12 * R


@pytest.mark.parametrize("beyond", [-1e-5, 1e-5])
def test_rays_that_graze_the_rim_are_told_apart(beyond):
    """A net that reaches two spans past the rim; its points are 3e-6 beside their directions in the chart."""
    theta, psi = HALF + beyond, torch.linspace(0, 2 * math.pi, 41, dtype=torch.float64)
    d = torch.stack([math.sin(theta) * torch.cos(psi), math.sin(theta) * torch.sin(psi), math.cos(theta) + 0 * psi])
    found, *_ = met(dome(m=65, reach=64 / 60), rays_from(torch.zeros_like(d), d), Circle(RIM))
    assert (found == (beyond < 0)).all()


def test_rays_from_outside_and_rays_that_lead_downwards_miss():
    """Light from outside meets the surface from behind; on its way out it has not come from the glass."""
    surface = waves(0.5)
    point = surface.at(torch.tensor([3.0, 10.0]).double(), torch.tensor([-4.0, 8.0]).double()).position
    above = 1.3 * point
    for direction in (-point, torch.tensor([[0.1], [0.2], [-1.0]]).double()):
        assert not met(surface, rays_from(above, direction))[0].any()
    sideways = torch.tensor([[1.0], [0.0], [0.05]]).double()  # across the whole dome, from outside
    assert not met(surface, rays_from(torch.tensor([[-30.0], [1.0], [3.0]]).double(), sideways))[0].any()
    assert met(surface, rays_from(0.999 * point, point))[0].all()
    assert not met(surface, rays_from(1.001 * point, point))[0].any()
    assert not met(surface, rays_from(torch.zeros_like(point), -point))[0].any()


def test_the_first_of_several_crossings_is_met():
    """Waves so steep that rays from near the surface cross them several times, beside Newton from many places."""
    surface, count, near = waves(1.2, 1.2), 80, 24
    o, d = torch.randn((2, 3, count), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    o = torch.stack([*o[:2], o[2].abs()]) / torch.stack([*o[:2], o[2].abs()]).norm(dim=0)
    rays = rays_from(0.85 * R * o, d - 0.8 * (d * o).sum(0) * o)  # along the surface rather than towards it
    found, points, _ = met(surface, rays)
    o, d = rays.position.numpy().T, rays.direction.numpy().T
    net, work, several = independent_trace.dome_of(surface.control_points() - (0, 0, Z)), np.empty((7, 3)), 0
    spans = np.linspace(0, 63, 64)
    places = independent_trace.places_of(net.poles, (net.knots_u, net.knots_v), spans, spans).reshape(-1, 3)
    for k in range(count):
        chosen = np.linalg.norm(np.cross(places - o[k], d[k]), axis=1).argsort()[:near]
        starts = zip(spans[chosen // 64], spans[chosen % 64], strict=True)
        crossings = [independent_trace.on_dome(net, *at, o[k], d[k], work) for at in starts]
        paths = np.unique([round(path, 9) for meets, path, *_ in crossings if meets])
        if not len(paths):
            assert not found[k]
            continue
        several += len(paths) > 1
        before = o[k] + np.linspace(0, paths[0], 50)[:, None] * d[k]
        x, y, _ = CHART.coordinates(torch.from_numpy(before.T.copy()))
        if found[k]:
            assert np.dot(points[k] - o[k], d[k]) == pytest.approx(paths[0], abs=1e-8)
        else:  # it left beside the net
            assert float(torch.maximum(x.abs(), y.abs()).max()) > surface.x[1]
    assert several > 5  # else nothing was tested


def test_the_gradient_is_that_of_the_crossing():
    """Position, normal and refracted direction, in heights, origins and directions."""
    base = dome(lambda x, y: 0.4 * torch.sin(0.3 * x) * torch.cos(0.2 * y), m=6)
    o = torch.tensor([[0.0, 1.0, -2.0], [0.0, 2.0, 0.5], [0.0, -1.0, 0.3]]).double()
    d = torch.tensor([[0.2, 0.9, -0.8], [0.1, 0.3, 0.9], [1.0, 0.6, 0.15]]).double()

    def behind(heights, o, d):
        surface = RadialSurface(Z, heights, base.x, base.y, radius=R)
        at, normal = intersect(surface, rays_from(o, d), EVERYWHERE, Status.VIGNETTED)
        assert at.alive.all()
        hit = deflect(at, normal, Refract(1.3, 1.0))
        return at.position, torch.stack(normal), hit.rays.direction

    inputs = [p.clone().requires_grad_() for p in (base.heights, o, d)]
    assert torch.autograd.gradcheck(behind, inputs, eps=1e-6, atol=1e-7)


def test_a_missed_ray_has_no_gradient_and_takes_none_from_others():
    surface = dome()
    heights = surface.heights.clone().requires_grad_()
    d = torch.tensor([[0.0, 0.3], [0.0, 0.1], [-1.0, 1.0]]).double().requires_grad_()
    rays = rays_from(torch.zeros((3, 2)).double(), d)
    at, normal = intersect(
        RadialSurface(Z, heights, surface.x, surface.y, radius=R), rays, EVERYWHERE, Status.VIGNETTED
    )
    (torch.where(at.alive, at.position, 0.0).sum() + torch.stack(normal).sum()).backward()
    assert at.alive.tolist() == [False, True]
    assert torch.isfinite(heights.grad).all() and torch.isfinite(d.grad).all()
    assert not d.grad[:, 0].any() and d.grad[:, 1].any() and at.chart is not HEIGHTS


# --- light over a sphere ----------------------------------------------------------------------------------------------


def sphere_light(profile, position, half=HALF):
    """Return the light of a point at a position relative to the centre, within `half` of +z."""
    x, y, z = position
    angle = {"half_angle": 80.0} if profile == "uniform" else {}
    return SphereLight(PointSource((x, y, z + Z), profile=profile, **angle), Z, CHART, half)


def flux_over_chart(light, n=600):
    """Return the sum of the irradiance over the chart."""
    side = 2 * CHART.length(light.half_angle)
    line = (torch.arange(n, dtype=torch.float64) + 0.5) * side / n - side / 2
    x, y = torch.meshgrid(line, line, indexing="ij")
    return float(light.irradiance(x, y, 0.0).sum()) * (side / n) ** 2


def emitted_directions(profile, n, seed=0):
    """Return n unit vectors (n, 3) of equal flux of a Lambertian lamp or of a uniform cone of 80°."""
    random = np.random.default_rng(seed)
    given = (np.arange(n) + random.random(n)) / n
    cos = np.sqrt(1 - given) if profile == "lambertian" else 1 - given * (1 - math.cos(math.radians(80.0)))
    sin, psi = np.sqrt(1 - cos**2), 2 * math.pi * random.random(n)
    return np.stack([sin * np.cos(psi), sin * np.sin(psi), cos], axis=1)


def leaving_points(position, d):
    """Return the points (n, 3) at which rays from a position leave the sphere of R, by the quadratic equation."""
    p = np.array(position)
    b = d @ p
    return p + (np.sqrt(b * b - p @ p + R * R) - b)[:, None] * d


@pytest.mark.parametrize("height", [0.0, 2.0, -1.5])
@pytest.mark.parametrize("half", [60.0, 75.0])
def test_the_flux_over_the_chart_is_that_within_the_half_angle(half, height):
    """A Lambertian lamp on the axis sends sin² θ within θ, a uniform one (1 - cos θ) / (1 - cos 80°)."""
    edge = math.radians(half)
    theta = math.atan2(R * math.sin(edge), R * math.cos(edge) - height)  # seen from the lamp
    flux = flux_over_chart(sphere_light("lambertian", (0.0, 0.0, height), edge))
    assert flux == pytest.approx(math.sin(min(theta, math.pi / 2)) ** 2, abs=1e-3)
    flux = flux_over_chart(sphere_light("uniform", (0.0, 0.0, height), edge))
    expected = min((1 - math.cos(theta)) / (1 - math.cos(math.radians(80.0))), 1.0)
    assert flux == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("profile", ["lambertian", "uniform"])
def test_irradiance_is_the_flux_per_area_of_counted_rays(profile):
    """Rays of a lamp beside the centre, counted where they leave the sphere."""
    position, n, cells = (1.5, -0.7, 0.4), 1 << 18, 8
    light = sphere_light(profile, position, math.radians(70.0))
    q = leaving_points(position, emitted_directions(profile, n))
    within = q[:, 2] > R * math.cos(light.half_angle)
    assert flux_over_chart(light) == pytest.approx(within.mean(), abs=1.5e-3)
    side = CHART.length(light.half_angle) / math.sqrt(2)  # a square inside the disc
    x, y, _ = CHART.coordinates(torch.from_numpy(q.T.copy()))
    counted = np.histogram2d(x.numpy(), y.numpy(), cells, ((-side, side),) * 2)[0]
    parts = 12
    line = ((torch.arange(cells * parts, dtype=torch.float64) + 0.5) / (cells * parts) * 2 - 1) * side
    e = light.irradiance(
        line[:, None].expand(-1, len(line)).contiguous(), line[None].expand(len(line), -1).contiguous(), 0.0
    )
    expected = n * (e * (2 * side / len(line)) ** 2).reshape(cells, parts, cells, parts).sum((1, 3)).numpy()
    misfit = (counted - expected) / np.sqrt(expected)
    assert np.abs(misfit).max() < 4.5 and np.sqrt((misfit**2).mean()) < 1.25  # 64 cells of some 2500 rays


def test_rays_lead_from_the_lamp_through_their_points_of_the_sphere():
    light = sphere_light("lambertian", (1.5, -0.7, 0.4))
    x, y = chart_points(largest=84.0)
    rays = light.rays_through(x, y, 0.0, 2.0)
    q = CHART.point(x, y, torch.tensor(0.0))
    start = torch.tensor([1.5, -0.7, 0.4], dtype=torch.float64)[:, None]
    torch.testing.assert_close(rays.position + Z * 0, start.expand_as(q))
    torch.testing.assert_close(rays.direction, (q - start) / (q - start).norm(dim=0), rtol=0, atol=1e-14)
    torch.testing.assert_close(rays.flux, 2.0 * light.irradiance(x, y, 0.0))
    found, points, _ = met(dome(m=129), rays)
    assert rays.z == Z and found.all()
    assert np.abs(np.linalg.norm(points, axis=1) - R).max() < 0.02  # the sphere's own net
