"""Stage 2 on any number of nets: of a lens front, back or both, of two mirrors, of a mirror and its cover glass."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bstcad.analysis.shape import thickness_range
from bstcad.optics.lens.interfaces import Interface, Reflect, Refract
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import MIRROR, Pass, Passes
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import EVERYWHERE, Rectangle
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.source_images import images
from bstcad.scene.quality import Tailoring
from bstcad.tailoring.driver import Parameters, Task
from bstcad.tailoring.machinability import active_bounds, enforce_bounds
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.stage2 import Problem, minimise_merit, steps, variables_of, with_best_nets
from tests import lenses

N, M, HALF, EVALUATIONS = 1.5, 33, 10.0, 40
# Square outline, and the beam inside it: the rim of the light moves on the back.
SQUARE, BEAM = Rectangle(2 * HALF, 2 * HALF), CollimatedSource(Rectangle(1.9 * HALF, 1.9 * HALF))
SCREEN = Screen(120.0, (-12.1, 12.0), (-12.2, 12.1), 48)  # no corner of a tube lies on a pixel's border


def net(z, size=0.0):
    return lenses.net(lambda x, y: size * torch.cos(0.2 * x + 1) * torch.cos(0.3 * y), z, M, HALF)


def picture():
    """A bright disc on a grey ground."""
    u = (torch.arange(48, dtype=torch.float64) + 0.5) / 24 - 1
    lit = 1 + 1.5 * torch.sigmoid((0.45 - torch.hypot(u[:, None], u)) / 0.05)
    return (lit / lit.sum()).numpy()


FRONTS = {  # a lens, and the light that meets it
    "front, a net behind it": (Lens.between(net(0.0), net(8.0, 0.05), SQUARE, N, tailored=(0,)), BEAM),
    "both": (Lens.between(net(0.0), net(8.0), SQUARE, N, tailored=(0, 1)), BEAM),
    "both, a point": (
        Lens.between(net(0.0), net(8.0), SQUARE, N, tailored=(0, 1)), PointSource((0.5, 0.0, -600.0)),
    ),
}  # fmt: skip
ABOVE = CollimatedSource(Rectangle(1.9 * HALF, 1.9 * HALF), z=250.0)  # a beam that comes down
MANGIN = Passes((Pass("front", Refract), Pass("back", Reflect), Pass("front", Refract)))
BODIES = {  # bodies of mirrors: light comes down to the back, whose front is dark; but up to a Mangin mirror's front
    "two mirrors": (  # after the second light goes down, past the first, to z = -60
        Lens.between(
            Plane(-5.0), net(0.0), SQUARE, 1.0, passes=MIRROR,
            behind=(Interface(net(60.0), SQUARE, Reflect(), Status.VIGNETTED),), tailored=(0, 1),
        ),
        replace(SCREEN, z=-60.0),
    ),
    "a mirror behind a glass with a net": (  # which light meets once, as where it leaves the mirror at another angle
        Lens.between(
            Plane(-5.0), net(0.0), SQUARE, 1.0, passes=MIRROR,
            before=(
                Interface(net(8.0), SQUARE, Refract(1.0, N), Status.MISSED_FRONT),
                Interface(Plane(4.0), EVERYWHERE, Refract(N, 1.0), Status.VIGNETTED),
            ),
            tailored=(0, 2),
        ),
        SCREEN,
    ),
    "a Mangin mirror": (  # whose front light crosses twice
        Lens.between(net(0.0), net(8.0), SQUARE, N, passes=MANGIN, tailored=(0, 1)), replace(SCREEN, z=-120.0),
    ),
}  # fmt: skip
MOVED = {
    CollimatedSource: {"tilt": (1.0, 0.0)},
    PointSource: {"position": (1.5, 0.0, -600.0)},
}  # another point of the source


def problem_of(name):
    lens, source = FRONTS[name]
    settings = Tailoring(rays=96, levels=(M,), stage2_iterations=EVALUATIONS, overshoot=0.03).resolved(M)
    task = Task((Channel(source, N),), (Goal("target", SCREEN, picture()),), settings)
    merit = Merit.of(task.channels, lens, 96, task.goals, 0.03)
    return task, lens, Problem(lens, merit)


@pytest.mark.parametrize("name", FRONTS)
def test_what_is_searched_changes_no_image_of_a_source(name):
    """Seen through places of the back, whichever nets are free."""
    lens, source = FRONTS[name]
    lens = lens.with_front(net(0.0, 0.1))
    free, back = (
        images((Channel(source, N, 0.5), Channel(replace(source, **MOVED[type(source)]), N, 0.5)), each, SCREEN, 9)
        for each in (lens, replace(lens, tailored=(1,)))
    )
    assert free.width() > 0 and free.width() == back.width()


@pytest.mark.parametrize("name", FRONTS)
def test_the_merit_of_any_nets_falls_strongly(name):
    task, lens, problem = problem_of(name)
    begun, variables = problem([n.heights for n in lens.nets]), variables_of(task, lens)
    assert len(variables.blocks) == len(lens.tailored_numbers)
    *_, last = minimise_merit(lens, problem, variables, EVALUATIONS)
    found = with_best_nets(lens, variables, last.best)
    assert last.best.merit < begun[0] / 50 and last.best.figure < begun[2] / 6
    for k, interface in enumerate(found.interfaces):  # what is not free stays
        assert (interface.surface is lens.interfaces[k].surface) == (k not in lens.tailored_numbers)
    assert problem([n.heights for n in found.nets])[0] == pytest.approx(last.best.merit, rel=1e-9)


def test_stage_2_shapes_a_front_and_goes_on_from_where_it_was_left():
    task, lens, _ = problem_of("both")
    begun, (*on_the_way, last) = task.rrmsd(lens), list(steps(task, lens))
    assert task.rrmsd(last.lens) < begun / 2
    state = [step.state for step in on_the_way if step.state is not None][5]
    *_, again = steps(task, lens, state)
    assert all(torch.equal(a.heights, b.heights) for a, b in zip(again.lens.nets, last.lens.nets, strict=True))


@pytest.mark.parametrize("name", BODIES)
def test_stage_2_alone_shapes_two_nets_of_a_body_with_mirrors(name):
    lens, screen = BODIES[name]
    settings = Tailoring(rays=96, levels=(M,), stage2_iterations=2 * EVALUATIONS, overshoot=0.03).resolved(M)
    source = ABOVE if lens.passes.sense < 0 else BEAM
    task = Task((Channel(source, lens.index),), (Goal("target", screen, picture()),), settings)
    begun, (*_, last) = task.rrmsd(lens), steps(task, lens)
    assert task.rrmsd(last.lens) < begun / 2
    one, two = (found.heights for found in last.lens.nets)
    for alone in ((0 * one, two), (one, 0 * two)):  # both nets work: neither alone makes this picture
        assert task.rrmsd(lens.with_heights(alone)) > 1.2 * task.rrmsd(last.lens)


def test_stage_2_keeps_the_least_thickness_and_finds_the_picture():
    """The faces come within 0.542 mm of each other if they may."""
    task, lens, _ = problem_of("both")
    task = replace(task, settings=replace(task.settings, stage2_iterations=80))
    near = lens.with_back(lens.back.moved(0.6))
    (*_, free), (*_, bound) = (steps(replace(task, min_thickness=least), near) for least in (0.01, 0.55))
    assert thickness_range(free.lens)[0] < 0.545 and task.rrmsd(free.lens) < 0.05
    found = enforce_bounds(bound.lens, active_bounds(bound.lens, None, 0.55))
    assert thickness_range(found)[0] >= 0.55 and found.back.z == 0.6
    assert task.rrmsd(found) < 0.06  # 0.045, and 0.037


def test_every_free_net_has_its_entry():
    lens = Lens.between(lenses.net(z=15.0, m=9), lenses.net(m=9), SQUARE, N, tailored=(0, 1))
    shaped = lens.with_heights((torch.rand((9, 9), dtype=torch.float64), torch.rand((17, 17), dtype=torch.float64)))
    parameters = Parameters.of(shaped)
    assert [entry.z for entry in parameters.nets] == [15.0, 20.0] and parameters.front == {}
    assert parameters.apply_to(lens) == shaped
