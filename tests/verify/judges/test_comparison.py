"""Programs not written here against ray tubes: they agree where the lens is the same, and a wrong lens shows."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.optics.light.channels import Channel
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.trace.measure import Effort, tubes_picture
from bstcad.scene.errors import MachineError, SceneError
from bstcad.verify.judges import comparison
from bstcad.verify.judges.comparison import JudgeEffort
from bstcad.verify.judges.faces import FaceError, Traced
from tests.conftest import quick_effort
from tests.verify.judges.lenses import CASES, SCREEN

# They come with the extra `judges`, a renderer of 100 MB among them, which `make bench` installs, not the suite.
with_others = pytest.mark.bench


LITTLE = JudgeEffort(1 << 12, Effort(512, accuracy=0.0, witness=False, cells=1))


def compared(name, case="a beam", rays=1 << 18):
    glass, source, screen = CASES[case]
    channels = (Channel(source, glass.index),)
    target = tubes_picture(glass, channels, screen, 256).numpy()
    goal, effort = Goal("target", screen, target), replace(LITTLE, rays=rays)
    return comparison.compare(name, glass, channels, goal, effort=effort, seed=3)


def passed(found):
    return [check.passed for check in found.checks]


class TestStandIn:
    """A judge of our own, which draws photons from the picture computed with flux tubes."""

    @pytest.fixture
    def judge(self, monkeypatch):
        """Return a judge whose attributes may be changed; numpy is a distribution that has a version."""

        def trace(glass, channels, screen, rays, seed):
            picture, random = tubes_picture(glass, channels, screen, 256).numpy(), np.random.default_rng(seed)
            halves = random.poisson(np.stack([picture] * 2) * rays / 2) / (rays / 2)
            return Traced(halves, rays, FaceError(1e-6, 1e-5))

        found = SimpleNamespace(cannot=lambda *a: "", light=lambda glass, channels: tuple(channels), trace=trace)
        monkeypatch.setitem(sys.modules, "stand_in", found)
        monkeypatch.setitem(comparison.JUDGES, "numpy", "stand_in")
        return found

    def test_a_judge_of_the_same_light_agrees_within_its_noise(self, judge):
        found = compared("numpy")
        facts = found.judge
        assert facts.agrees and (facts.rays, facts.pixels, facts.losses) == (1 << 18, (48, 32), "none")
        assert facts.over_noise == pytest.approx(1.0, abs=0.3) and facts.rrmsd > facts.rrmsd_ours
        assert facts.moved_by == pytest.approx(1e-5 * 0.49 * 380.0 * 0.8, rel=1e-3)  # slope, n - 1, mm, pixels a mm
        assert found.theirs.sum() == pytest.approx(found.target.sum())

    @pytest.mark.parametrize(
        ("wrong", "wanted"),
        [("a turned lens", [False, True]), ("lost light", [True, False]), ("no light", [False, False])],
    )
    def test_a_wrong_judge_fails(self, judge, wrong, wanted):
        honest = judge.trace

        def trace(glass, channels, screen, rays, seed):
            if wrong == "a turned lens":
                glass = glass.with_back(replace(glass.back, heights=glass.back.heights.T.contiguous()))
            traced = honest(glass, channels, screen, rays, seed)
            return replace(traced, halves=traced.halves * {"lost light": 0.99, "no light": 0.0}.get(wrong, 1.0))

        judge.trace = trace
        found = compared("numpy", rays=1 << 20)
        assert passed(found) == wanted and found.judge.agrees is False

    def test_a_judge_that_declines_says_why_and_has_no_checks(self, judge):
        judge.cannot = lambda *a: "it is too dark"
        found = compared("numpy")
        assert found.checks == () and found.judge.rays is None and found.judge.declined == "it is too dark"

    def test_each_judge_is_asked_in_turn(self, judge):
        told, (glass, source, screen) = [], CASES["a beam"]
        given = glass, (Channel(source, glass.index),), Goal("target", screen, np.ones(screen.shape)), 0
        found = comparison.run_judges(["numpy"], *given, lambda *a: told.append(a), LITTLE)
        assert [each.judge.rays for each in found] == [1 << 12]
        assert told == [("judges", 0, 1, "numpy"), ("judges", 1, 1, "")]


@with_others
@pytest.mark.parametrize("case", CASES)
def test_batoid_traces_the_light_of_ray_tubes(case):
    found = compared("batoid", case)
    assert passed(found) == [True, True] and found.judge.noise < 0.05 and found.judge.moved_by < 0.01
    assert found.judge.on_target == pytest.approx(found.judge.on_target_ours, abs=1e-3)


@with_others
@pytest.mark.parametrize("wrong", ["10 µm of astigmatism", "index", "turned"])
def test_a_wrong_lens_fails(monkeypatch, wrong):
    from bstcad.verify.judges import batoid

    def other(glass, channels):
        if wrong == "index":
            return glass, [replace(channel, index=channel.index + 0.01) for channel in channels]
        heights, along = glass.back.heights, torch.linspace(-1, 1, glass.back.m, dtype=torch.float64)
        off = 0.005 * (along[:, None] ** 2 - along**2) if wrong != "turned" else heights.T - heights
        return glass.with_back(replace(glass.back, heights=heights + off)), channels

    trace = batoid.trace
    monkeypatch.setattr(
        batoid, "trace", lambda glass, channels, *given, **how: trace(*other(glass, channels), *given, **how)
    )
    assert passed(compared("batoid")) == [False, True]


@with_others
@pytest.mark.parametrize("case", list(CASES)[1:])
def test_mitsuba_traces_the_light_of_ray_tubes(case):
    found = compared("mitsuba", case)
    assert passed(found) == [True, True] and found.judge.noise < 0.1 and found.judge.moved_by < 0.05
    assert (found.judge.losses == "none") is (case == "a mirror")


@pytest.mark.parametrize(
    "screen", [SCREEN, replace(SCREEN, pixels=(512, 341)), Screen(1.0, (0.0, 7.3), (0.0, 11.1), 300)]
)
def test_coarse_pixels_are_square_and_keep_the_light(screen):
    raster = comparison.coarse_screen(screen)
    across, up = raster.per_unit
    assert across == pytest.approx(up, rel=1e-3) and max(raster.shape) <= comparison.MAX_COMPARED_PIXELS
    picture = np.random.default_rng(0).random(screen.shape)
    coarse = comparison.resample(picture, raster.shape)
    assert coarse.shape == raster.shape and coarse.sum() == pytest.approx(picture.sum())
    even = comparison.resample(np.ones(screen.shape), raster.shape)
    np.testing.assert_allclose(even, even.mean())


def test_the_noise_is_borne_by_the_pixels_that_have_it():
    """All of them for normal noise (to 5 %, the scatter of a fourth moment), one for a single bright pixel."""
    noise = np.random.default_rng(0).normal(size=(128, 128))
    assert comparison._effective_pixels(noise) == pytest.approx(128**2, rel=0.05)
    alone = np.zeros((128, 128))
    assert comparison._effective_pixels(alone) == 128**2
    alone[3, 5] = 1.0
    assert comparison._effective_pixels(alone) == 3.0


def test_an_unknown_judge_is_named_and_a_missing_program_says_how_to_install_it(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="'batiod' is not a known program; did you mean 'batoid'?"):
        commands.verify(tmp_path, against=("batiod",))
    monkeypatch.setattr(comparison.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MachineError, match=r"pip install 'bstcad\[judges\]'"):
        commands.verify(tmp_path, against=("mitsuba",))
    monkeypatch.setattr(comparison.importlib.util, "find_spec", lambda name: name)
    assert comparison.choose_judges(["mitsuba", "batoid", "mitsuba"]) == ("mitsuba", "batoid")


@with_others
def test_a_step_file_by_itself_has_no_light(small_design, tmp_path):
    shutil.copy(small_design.folder / "lens.step", alone := tmp_path / "alone.step")
    with pytest.raises(SceneError, match="give the design's folder"):
        commands.verify(alone, against=("batoid",))


@with_others
def test_the_report_holds_the_judge(small_design, tmp_path, monkeypatch):
    monkeypatch.setattr("bstcad.figures.rendering.lens_picture", lambda mesh: None)
    folder = shutil.copytree(small_design.folder, tmp_path / "small")
    options = ProofOptions(quick_effort(), judges=replace(LITTLE, rays=1 << 18))
    report = commands.verify(folder, against=("batoid",), options=options).facts
    [judge] = report["judges"]
    assert report["passed"] and judge["name"] == "batoid" and judge["agrees"]
    assert judge["over_noise"] in [c["value"] for c in report["checks"] if c["name"].startswith("irradiance by batoid")]
    assert json.loads((folder / "report.json").read_text())["judges"][0]["rays"] == judge["rays"]
    page = (folder / "report.html").read_text()
    assert "Other programs" in page and (folder / "figures" / "judge_batoid.png").exists()
    page = (small_design.folder / "report.html").read_text()  # where nobody asked for it
    assert "judges" not in small_design.report and "Other programs" not in page
