"""Point-by-point integration: exact to second order where a surface follows the map; what it leaves where none does."""

from dataclasses import replace

import pytest
import torch

from bstcad.designs import pipeline
from bstcad.optics.lens.interfaces import Reflect, Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.optics.trace.trace import to_first_net
from bstcad.scene import scene
from bstcad.scene.errors import SceneError
from bstcad.tailoring import stage1
from bstcad.tailoring.baselines import integration
from bstcad.tailoring.baselines.integration import FINEST_FIT, fit_heights, march
from bstcad.tailoring.driver import Driver, Task
from tests import suite
from tests.by_slope import deflect, intersect
from tests.lenses import net

WIDE, LEVEL = Rectangle(40.0, 40.0), LevelPlane(900.0)
TILTED = TiltedPlane((40.0, -9.0, 900.0), (35.0, -50.0))
LENS = Refract(1.488, 1.0)
SMALL = {
    "lens.back.control_points": "65",
    "target.pixels": "64",
    "tailoring.rays": "200",
    "tailoring.transport_grid": "128",
    "tailoring.method": "integration",
}


class Known:
    """A face with known sag, the light on its way to it, and where that lands: a map that this face follows."""

    def __init__(self, face, source, front=None, law=LENS, plane=LEVEL):
        self.face, self.source, self.front, self.law, self.plane = face, source, front, law, plane

    def rays(self, n):
        """Through n x n points from rim to rim, one of them on the axis."""
        line = torch.linspace(-5.0, 5.0, n, dtype=torch.float64)
        x, y = torch.meshgrid(line, line, indexing="ij")
        if self.front is None:
            return self.source.rays_through(x, y, self.face.z, 1.0)
        lens = Lens.between(self.front, net(z=self.face.z), WIDE, self.law.n_in)
        return to_first_net(self.source.rays_through(x, y, self.front.z, 1.0), lens)

    def aims(self, coming):
        """Return the points (2, n, n) (mm) to which the face sends the rays, and where the rays meet the face."""
        at, z_x, z_y = intersect(self.face, coming, WIDE, Status.VIGNETTED)
        landed = self.plane.to(deflect(at, z_x, z_y, self.law).rays)
        assert landed.alive.all()
        return torch.stack(tuple(self.plane.coordinates(landed))), at

    def error(self, n, first="x"):
        """Largest distance (mm) along z of the points that come of its own map from the face itself."""
        coming = self.rays(n)
        aim, at = self.aims(coming)
        middle = at.above(0.0)[n // 2, n // 2].item()
        points = march(coming, aim, self.plane, self.law, middle, first)
        x, y, z = points.position
        assert points.reached.all()
        return float((z + middle - self.face.sag_and_slope(x, y)[0]).abs().max())


LENSES = {
    "collimated": Known(Conic(20.0, -0.03, -0.5), CollimatedSource(Circle(9.0))),
    "point": Known(Conic(20.0, -0.04, -0.5), PointSource(), Sphere(15.0, 0.02)),
    "point, off axis": Known(Sphere(20.0, -0.02), PointSource((1.0, -2.0, 0.0)), Plane(15.0)),
    "tilted target": Known(Sphere(20.0, -0.03), PointSource(), Plane(15.0), plane=TILTED),
    "mirror": Known(Sphere(20.0, 0.01), PointSource((30.0, 0.0, 300.0)), law=Reflect(), plane=LEVEL),
}  # fmt: skip


@pytest.mark.parametrize("first", ["x", "y"])
@pytest.mark.parametrize("known", LENSES.values(), ids=LENSES)
def test_where_a_surface_follows_the_map_half_the_step_leaves_a_quarter_of_the_error(known, first):
    errors = [known.error(n, first) for n in (17, 33, 65)]
    for coarse, fine in zip(errors, errors[1:], strict=False):
        assert 3.5 < coarse / fine < 4.5  # second order; the first one would give 2
    assert errors[-1] < 2e-5  # mm, of a sag of about 0.5 mm


def test_only_a_map_that_is_a_surfaces_gives_the_same_heights_on_both_ways():
    """Aims turned about the axis by 3 degrees: as good a map of the light, and no surface's."""
    known, n = LENSES["collimated"], 65
    coming = known.rays(n)
    aim, _ = known.aims(coming)
    c, s = torch.cos(torch.tensor(0.05)).double(), torch.sin(torch.tensor(0.05)).double()
    turned = torch.stack([c * aim[0] - s * aim[1], s * aim[0] + c * aim[1]])

    def apart(aim):
        ways = [march(coming, aim, known.plane, LENS, 20.0, first).position[2] for first in ("x", "y")]
        return float((ways[0] - ways[1]).abs().max())

    assert apart(aim) < 1e-4  # mm: what the steps leave
    # the slopes' curl: turned by α a slope field -κ (x, y) has 2 κ α; over a quadrant it adds up to 2 κ α x y
    slope = -known.face.sag_and_slope(torch.tensor([5.0]).double(), torch.zeros(1).double())[1].item() / 5.0
    assert apart(turned) == pytest.approx(2 * slope * 0.05 * 25.0, rel=0.1)


def test_lost_rays_end_their_lines_and_change_no_other_point():
    known, n = LENSES["point"], 33
    coming = known.rays(n)
    aim, _ = known.aims(coming)
    whole = march(coming, aim, known.plane, LENS, 20.0)
    lost = torch.zeros((n, n), dtype=torch.bool)
    lost[:4, :] = lost[20, 25] = True  # a rim, where the first line ends early; one in the middle of a line
    junk = torch.where(lost, torch.nan, 1.0)
    status = coming.lose(lost, Status.MISSED_FRONT)
    broken = replace(coming, position=coming.position * junk, direction=coming.direction * junk, status=status)
    holed = march(broken, aim, known.plane, LENS, 20.0)
    wanted = torch.ones((n, n), dtype=torch.bool)
    wanted[:4, :] = wanted[20, 25:] = False
    assert torch.equal(holed.reached, wanted) and torch.isfinite(holed.position).all()
    assert torch.equal(holed.position[:, wanted], whole.position[:, wanted])


def test_a_middle_ray_that_is_lost_is_said():
    known = LENSES["collimated"]
    coming = known.rays(9)
    status = coming.status.clone()
    status[4, 4] = int(Status.MISSED_FRONT)
    with pytest.raises(SceneError, match="^source: "):
        march(replace(coming, status=status), torch.zeros((2, 9, 9)).double(), LEVEL, LENS, 20.0)


def test_the_net_is_as_near_to_points_as_splines_of_third_order_are():
    x, y = (p.reshape(-1) for p in sampling.grid(Rectangle(20.0, 20.0), 199))
    wave, inner = 0.2 * torch.sin(0.4 * x) * torch.cos(0.3 * y), torch.maximum(x.abs(), y.abs()) < 8.0

    def error(m):
        sag, _, _ = fit_heights(net(m=m), x, y, wave, *FINEST_FIT).relative_sag_and_slope(x, y)
        return float((sag - wave)[inner].abs().max())

    assert error(65) < error(33) / 6 and error(65) < 1e-5  # mm


def small(name, **more):
    """(task, blank lens) of a template at toy size."""
    front = {"lens.front.optimise": "false"} if name == "portrait" else {}
    wanted = scene.load(f"templates/{name}.toml", SMALL | front | more)
    settings = wanted.tailoring.resolved(wanted.lens.back.control_points)
    task = Task(wanted.channels(), wanted.goals, settings, wanted.lens.min_thickness)
    return task, wanted.flat_lens(settings.levels[0])


def followed(task, lens, steps):
    """The lens after a first stage."""
    return Driver().run(steps(task, lens), task, lambda state: state, lambda: "").lens


@pytest.mark.parametrize(("name", "worse"), suite.in_turns([("thu", 2.0), ("portrait", 1.3)], 2))
def test_off_axis_and_from_a_point_it_leaves_far_more_error_than_stage_1(name, worse):
    task, lens = small(name)
    points, slopes = (task.rrmsd(followed(task, lens, steps)) for steps in (integration.steps, stage1.steps))
    assert points > worse * slopes


def test_no_bit_of_it_depends_on_the_threads():
    task, lens = small("thu", **{"lens.back.control_points": "33", "tailoring.rays": "130"})
    before, heights = torch.get_num_threads(), []
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            heights.append(followed(task, lens, integration.steps).back.heights)
            assert torch.get_num_threads() == n
    finally:
        torch.set_num_threads(before)
    assert torch.equal(heights[0], heights[1]) and torch.equal(heights[0], heights[2])


@suite.in_turn(0, 2)
def test_a_back_that_would_meet_the_front_begins_further_off():
    task, lens = small("thu", **{"lens.front.z": "17.0"})
    made = followed(task, lens, integration.steps)
    assert made.back.z > 20.0
    assert task.rrmsd(made) == pytest.approx(task.rrmsd(followed(*small("thu"), integration.steps)), rel=0.1)


@suite.in_turn(1, 2)
def test_a_design_by_it_has_its_stage_and_no_other():
    wanted = scene.load("templates/disk.toml", SMALL | {"source.diameter": "0.5"})
    found = pipeline.design(wanted, device="cpu")
    assert [stage.name for stage in found.course.stages[:3]] == ["loading", "transport", "integration"]
    assert not any(stage.name.startswith(("stage 1", "stage 2", "stage 3")) for stage in found.course.stages)
    assert found.lens.back.m == 65 and found.course.stages[2].rrmsd < 1.0
    single = pipeline.design(wanted.changed({"tailoring.precision": "float32"}), device="cpu")
    torch.testing.assert_close(single.lens.back.heights, found.lens.back.heights, rtol=0, atol=2e-6)  # a digit of it
