"""A design that goes on from any place where it could be left ends as if it had never stopped, to the bit."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from bstcad.designs.pipeline import DesignOptions, DesignState, design
from bstcad.runs import checkpoint
from bstcad.scene.scene import load
from bstcad.tailoring.driver import Hooks
from bstcad.tailoring.minimise import AdamState, Best, LbfgsState, adam, lbfgs, minimise
from tests import suite, two_faces
from tests.efforts import FEW_RAYS, LITTLE
from tests.scenes import DISK, DOME, SMALL

TINY = SMALL | {"tailoring.rays": 64, "target.pixels": 32, "tailoring.transport_grid": 32, "tailoring.rounds": 3}
SCENES = {
    "least squares, within bounds": TINY | {"tailoring.stage2_iterations": 40, "lens.tool_radius": 50.0},
    "short rounds": TINY | {"tailoring.rays": 96, "tailoring.stage2_iterations": 60},
    "free front": TINY | {"lens.front": {"kind": "sphere", "z": 15.0, "curvature": 0.002, "optimise": True}},
    "extended source": TINY | {"source.diameter": 1.0, "tailoring.source_points": 4, "tailoring.stage2_iterations": 12},
    "two faces, two pictures": two_faces.SMALL,
    "dome": DOME,
    "front alone": two_faces.SMALL | {"target": two_faces.CHANGES["target"][:1], "lens.back.optimise": False},
    "two faces, picture and wave": two_faces.SMALL
    | two_faces.WITH_WAVE
    | {"tailoring": two_faces.SMALL["tailoring"] | {"rounds": 2, "stage2_iterations": 12}},
    "paper": TINY
    | {
        "tailoring.quality": "paper",
        "tailoring.levels": [17, 33],
        "tailoring.stage1_iterations": 8,
        "tailoring.stage2_iterations": 6,
        "lens.front": {"kind": "sphere", "z": 15.0, "curvature": 0.002, "optimise": True},
    },
}


# The law is one of bits, whatever the effort; the map of a dome lies on its back only with more rays than LITTLE has.
OPTIONS = DesignOptions(effort=LITTLE)
DOME_OPTIONS = DesignOptions(effort=FEW_RAYS)
QUICK = (
    "dome",
    "least squares, within bounds",
    "short rounds",
    "two faces, picture and wave",
    "paper",
)  # the others are run by `make bench`


def valley(parameters):
    """Rosenbrock's, in several dimensions."""
    x = parameters[0].detach().clone().requires_grad_()
    merit = (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()
    (gradient,) = torch.autograd.grad(merit, x)
    return float(merit.detach()), [gradient], float(merit.detach())


START = [torch.linspace(-1.2, 1.5, 20, dtype=torch.float64)]


@dataclass(frozen=True)
class Left:
    """A minimisation that was left."""

    best: Best
    search: LbfgsState | AdamState


def by_lbfgs(left):
    return minimise(valley, lbfgs(START, 90, left and left.search), 90, left.best if left else Best())


def by_adam(left):
    return minimise(valley, adam(START, [0.05], 60, left and left.search), 60, left.best if left else Best())


@pytest.mark.parametrize("minimiser", [by_lbfgs, by_adam])
def test_a_minimiser_goes_on_from_every_step(minimiser, tmp_path):
    *reached, last = minimiser(None)
    states = [Left(r.best, r.state) for r in reached if r.state is not None]
    assert len(states) > 20
    for state in states[::7]:
        checkpoint.write(tmp_path / "c", {}, state)
        *_, again = minimiser(checkpoint.read(tmp_path / "c", Left)[1])
        assert torch.equal(again.best.parameters[0], last.best.parameters[0]) and again.reason == last.reason
        assert again.best.evaluations == last.best.evaluations and again.best.merit == last.best.merit
        if last.parameters:
            assert torch.equal(again.parameters[0], last.parameters[0])


def heights_of(made):
    """Return the nets of a lens, and the planes from which their heights are measured."""
    return [t for net in made.lens.nets for t in (net.heights, torch.tensor(net.z))]


@pytest.mark.parametrize(
    "name",
    [
        *suite.in_turns(QUICK, len(QUICK)),
        *(pytest.param(name, marks=pytest.mark.bench) for name in SCENES if name not in QUICK),
    ],
)
def test_a_design_goes_on_from_wherever_it_was_left(name, tmp_path):
    scene, options = load(DISK, SCENES[name]), DOME_OPTIONS if name == "dome" else OPTIONS
    kept = []

    def save(state):
        checkpoint.write(tmp_path / f"{len(kept)}", {}, state)
        kept.append((1 + (state.followed is not None) + (state.lens is not None), tmp_path / f"{len(kept)}"))

    whole = design(scene, device="cpu", options=options, hooks=Hooks(save=save))
    assert {stage for stage, _ in kept} == {1, 2, 3}
    chosen = [[path for s, path in kept if s == stage] for stage in (1, 2, 3)]
    for path in (*(paths[len(paths) // 2] for paths in chosen), kept[-1][1]):
        again = design(scene, device="cpu", options=options, start=checkpoint.read(path, DesignState)[1])
        assert all(map(torch.equal, heights_of(again), heights_of(whole))), path
        assert again.lens.front.is_net or again.lens.front == whole.lens.front
        assert [point.rrmsd for point in again.course.history] == [point.rrmsd for point in whole.course.history]
        assert [(s.name, s.rrmsd) for s in again.course.stages] == [(s.name, s.rrmsd) for s in whole.course.stages]
        for entry in ("stopped", "skipped_steps", "twins", "transport"):
            assert getattr(again.course, entry) == getattr(whole.course, entry)
        assert again.transport.plane == whole.transport.plane == ("entrance" if name == "paper" else "back")
        assert np.array_equal(again.transport.source, whole.transport.source)


@suite.in_turn(0, 3)
def test_an_interrupt_anywhere_gives_a_lens_and_loses_nothing():
    """Asked at every look: before the first round there is no lens; later the best so far, and the way on."""
    scene = load(DISK, SCENES["paper"])
    looks = []
    whole = design(scene, device="cpu", options=OPTIONS, hooks=Hooks(interrupted=lambda: bool(looks.append(1))))
    early, lenses = 0, 0
    for after in range(1, len(looks), max(1, len(looks) // 4)):
        count, kept = itertools.count(), []
        try:
            hooks = Hooks(save=kept.append, interrupted=lambda: next(count) >= after)  # noqa: B023
            found = design(scene, device="cpu", options=OPTIONS, hooks=hooks)
        except KeyboardInterrupt:
            early += 1
            assert not kept
            continue
        lenses += 1
        assert found.course.stopped == "interrupt" and bool(torch.isfinite(found.lens.back.heights).all())
        assert found.lens.back.m == whole.lens.back.m
        again = design(scene, device="cpu", options=OPTIONS, start=kept[-1] if kept else None)
        assert torch.equal(again.lens.back.heights, whole.lens.back.heights)
        assert again.course.stopped == whole.course.stopped
    assert lenses > 2 and early < 3
