"""The commands for a finished lens of two tailored faces and two targets: each of them serves both."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import bstcad
from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.figures.figure_jobs import NoPictures
from bstcad.optics.surfaces.surfaces import sag
from bstcad.optics.trace.measure import Effort
from bstcad.verify.judges.comparison import JudgeEffort
from bstcad.verify.judges.faces import FaceError, Traced
from tests import suite
from tests.conftest import flat_pictures, quick_effort
from tests.two_faces import made_of, scene_of


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The design of both faces in a folder."""
    folder = tmp_path_factory.mktemp("two") / "faces"
    made = made_of(scene_of())
    commands.write(made, folder, ProofOptions(quick_effort(), NoPictures))
    return SimpleNamespace(made=made, folder=folder, design=bstcad.open(folder))


# ---- show ------------------------------------------------------------------------------------------------------------


def test_rays_go_to_the_furthest_target_and_light_each_picture_on_their_way(two):
    shown = commands.light_path_in(two.folder)
    near, far = (target.z for target in two.made.scene.targets)
    assert [screen[:, 2].tolist() for screen in shown.screens] == [[near] * 4, [far] * 4]
    assert [picture.shape for picture in shown.pictures] == [(16, 16), (18, 24)]
    assert shown.rays[:, -1, 2] == pytest.approx(far)
    assert "Targets 10 × 10 mm at z = 60 mm, 16 × 12 mm at z = 150 mm" in shown.words
    before, after = shown.rays[:, -2], shown.rays[:, -1]
    for screen, picture in zip(shown.screens, shown.pictures, strict=True):
        share = (screen[0, 2] - before[:, 2]) / (after[:, 2] - before[:, 2])
        place = before + share[:, None] * (after - before)
        (low, high), (rows, columns) = screen[[0, 2], :2], picture.shape
        across, up = ((place[:, :2] - low) / (high - low)).T
        inside = (across > 0) & (across < 1) & (up > 0) & (up < 1)
        row, column = ((1 - up[inside]) * rows).astype(int), (across[inside] * columns).astype(int)
        assert inside.mean() > 0.8 and (picture[row, column] > 60).mean() > 0.95


# ---- pictures in Python ----------------------------------------------------------------------------------------------


def test_each_target_has_a_picture_and_a_figure_in_a_notebook(two):
    assert [two.design.picture(target=k).shape for k in (0, 1)] == [(16, 16), (18, 24)]
    assert np.array_equal(two.design.picture(), two.design.picture(target=0))
    with pytest.raises(bstcad.SceneError, match=r"^target: there is no target\[2\]; give a number from 0 to 1"):
        two.design.picture(target=2)
    assert two.design._repr_html_().count("data:image/png;base64,iVBOR") == 2
    first, second = (figures.rrmsd for figures in two.design.report.goals)
    assert f"RRMSD {first:.3g}, {second:.3g}" in repr(two.design)


# ---- other programs, a made part -------------------------------------------------------------------------------------


class Tracer:
    """A judge that sees what bstcad sees, but for a target that it is wrong about."""

    name, version = "tracer", "1"

    def __init__(self, wrong_at=()):
        self.asked, self.wrong_at = [], wrong_at

    def cannot(self, lens, channels):
        return ""

    def light(self, lens, channels):
        return channels

    def trace(self, lens, channels, screen, rays, seed):
        self.asked.append(screen.z)
        even = np.full(screen.shape, 1 / np.prod(screen.shape))
        light = bstcad.measure(lens, channels, screen, even, effort=quick_effort())
        noise = 0.02 * np.random.default_rng(seed).normal(size=screen.shape)
        halves = light.picture * light.flux["on target"] * np.stack([1 + noise, 1 - noise])
        if screen.z in self.wrong_at:
            halves = halves[:, ::-1] * np.linspace(0.5, 1.5, screen.columns)
        return Traced(halves, rays, FaceError(0.0, 0.0))


@pytest.fixture(scope="module")
def verified(two, tmp_path_factory):
    """The report of one verification by a program that is wrong about the second target, and of a made part."""
    place, far = tmp_path_factory.mktemp("verified"), two.made.scene.targets[1].z
    x, y = (p.ravel() for p in np.meshgrid(np.linspace(-3.9, 3.9, 90), np.linspace(-3.9, 3.9, 90)))
    cloud, tracer = place / "cloud.csv", Tracer(wrong_at=(far,))
    waved = sag(two.design.lens.back, x, y) + 0.002 * np.cos(1.5 * x)
    np.savetxt(cloud, np.stack([x, y, waved], axis=-1), delimiter=",")
    drawn = []

    class Drawing(flat_pictures()):
        def begin(self, draw, *given, number=0):
            drawn.append((draw.__name__, number))
            super().begin(draw, *given, number=number)

    effort = JudgeEffort(own=replace(quick_effort(), witness=False))
    options = ProofOptions(quick_effort(), Drawing, judges=effort)
    found = commands.verify(two.folder, against=[tracer], measured=cloud, options=options, place=place / "part")
    page = (place / "part" / "report.html").read_text(encoding="utf-8")
    figures = {path.stem for path in (place / "part" / "figures").iterdir()}
    return SimpleNamespace(report=found, tracer=tracer, page=page, figures=figures, drawn=drawn)


@suite.in_turn(1, 2)
def test_another_program_traces_each_target(two, verified):
    near, far = (target.z for target in two.made.scene.targets)
    assert verified.tracer.asked == [near, far]
    assert [(judge.target, judge.figure) for judge in verified.report.contents.judges] == [
        ("target[0]", "judge_tracer"), ("target[1]", "judge_tracer_2"),
    ]  # fmt: skip
    checks = {check.name: check.passed for check in verified.report.checks if check.id.startswith("judge")}
    assert checks["irradiance by tracer: difference from bstcad's, relative to the noise, target[1]"] is False
    assert sum(checks.values()) == len(checks) - 1 == 3
    assert {"judge_tracer", "judge_tracer_2"} <= verified.figures
    assert [number for name, number in verified.drawn if name == "draw_judges"] == [0, 1]
    assert "tracer 1, target[0]" in verified.page and "tracer 1, target[1]" in verified.page


@suite.in_turn(1, 2)
def test_a_made_part_is_judged_on_each_target(two, verified):
    part = verified.report.measured
    assert [each["key"] for each in part.facts["goals"]] == ["target[0]", "target[1]"]
    predicted = [each["rrmsd_predicted"] for each in part.facts["goals"]]
    assert part.facts["rrmsd_predicted"] == max(predicted)
    designed = [figures.rrmsd for figures in two.design.report.goals]
    assert all(abs(found / own - 1) > 1e-3 for found, own in zip(predicted, designed, strict=True))
    names = [check.name for check in part.checks if check.id.startswith("made-rrmsd")]
    assert [name.partition("target")[2][:3] for name in names] == ["[0]", "[0]", "[1]", "[1]"]
    assert [picture.shape for picture in part.irradiances] == [(16, 16), (18, 24)]
    assert {"made_part", "made_part_2"} <= verified.figures
    assert " on target[0]." in verified.page and " on target[1]." in verified.page


@suite.in_turn(0, 2)
def test_a_made_part_is_held_to_the_wave_that_is_asked_for(tmp_path):
    """A wave of form error of 1 µm at an index of 1.49 is about 0.8 waves up and down, 0.5 RMS."""
    one = scene_of().target.model_dump(mode="json", exclude_none=True)
    made = made_of(scene_of(target=one, wavefront={"kind": "plane", "z": 60.0}), front=0.0, back=0.0)
    folder, few = tmp_path / "plate", Effort(96, places=65, points=1024, tubes=97)
    commands.write(made, folder, ProofOptions(few, NoPictures))
    x, y = (p.ravel() for p in np.meshgrid(np.linspace(-3.9, 3.9, 90), np.linspace(-3.9, 3.9, 90)))
    np.savetxt(tmp_path / "cloud.csv", np.stack([x, y, 14.0 + 1e-3 * np.cos(2 * x)], axis=-1), delimiter=",")
    found = commands.verify(
        folder,
        measured=tmp_path / "cloud.csv",
        options=ProofOptions(few, NoPictures),
        place=tmp_path / "part",
    )
    [wave] = [check for check in found.measured.checks if check.id == "made-wavefront"]
    known = (made.scene.index - 1) * 1e-3 / 633e-6 / 2**0.5
    assert wave.value == pytest.approx(known, rel=0.1) and wave.limit is None
