"""The end of known curves, errors in known places, cells of a plate over pixels, limits where they are plain."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from bstcad.analysis.cost import TILE, Ending, control_cells, ending, limits, masks, remaining
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.collimated import Collimated
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.surfaces import Plane


class TestEnding:
    """Of curves of stage 2, a point a second, after the picture and stage 1."""

    STAGES = [(1.0, None), (3.0, 0.4), (100.0, 0.05)]  # picture, stage 1, stage 2

    @staticmethod
    def curve(value, count=100):
        """Stage 1's judgement, the points of stage 2, and its own judgement."""
        return [(4.0, 0.4), *((4.0 + t, value(t)) for t in range(1, count + 1)), (104.0, 0.05)]

    def test_a_power_law_has_a_last_tenth_and_a_price_of_half_the_error(self):
        found = ending(self.curve(lambda t: 0.3 * t**-0.5), self.STAGES)
        assert found.power == pytest.approx(0.5, abs=1e-6) and found.fit == pytest.approx(1.0)
        assert found.halving == pytest.approx(4.0, rel=1e-5) and found.doubled == pytest.approx(0.5**0.5)
        # t^-1/2 is 1.1 times its end at t / 1.21, to a step; the median of the last twentieth stands for the end
        assert found.last_tenth_seconds == pytest.approx(100 - 98 / 1.21, abs=1.5)
        assert found.last_tenth == pytest.approx(found.last_tenth_seconds / 104)

    def test_a_curve_without_a_power_law_offers_no_halving(self):
        rests = ending(self.curve(lambda t: 0.03 + 0.3 * 0.8**t), self.STAGES)
        noise = ending(self.curve(lambda t: 0.03 * (1.3 if t % 2 else 1.0)), self.STAGES)
        rises = ending(self.curve(lambda t: 0.03 * t**0.5), self.STAGES)
        few = ending(self.curve(lambda t: 0.3 * t**-0.5, count=3), self.STAGES)
        assert rests.power < 0.01 and rests.last_tenth > 0.7 and noise.fit < 0.1
        assert (rises.power, rises.doubled) == (0.0, 1.0) and (few.power, few.doubled) == (None, 1.0)
        assert rests.halving is noise.halving is rises.halving is few.halving is None
        assert ending([(4.0, 0.4)], self.STAGES[:2]) is None and ending([], []) is None

    def test_the_power_counts_the_last_round_since_the_light_changed(self):
        """Another round has other tubes, and so another level of its curve; the time goes on."""
        rounds = [(1.0, None), (3.0, 0.4), (60.0, 0.21), (40.0, 0.05)]
        found = ending(self.curve(lambda t: (0.3 if t <= 60 else 0.5) * t**-0.5), rounds)
        changed = ending(
            [(30.0, 0.2), *((4.0 + t, 0.3 * (t - 60) ** -0.5) for t in range(61, 101))], rounds, since=64.0
        )
        assert (found.power, changed.power) == pytest.approx((0.5, 0.5), abs=1e-6)


class TestRemaining:
    """Of errors put in a known place and of waves of a known length."""

    SHAPE = (96, 128)
    RAMP = np.linspace(1.0, 2.0, 96 * 128).reshape(96, 128)

    def of(self, error, target=RAMP):
        found = remaining(target + error, target, (2.0, 2.0))  # two pixels a mm
        return {part["name"]: part for part in found["parts"]}, found["octaves"]

    @pytest.mark.parametrize("target", [RAMP, np.ones(SHAPE), (RAMP > 1.8).astype(float)])
    def test_each_pixel_is_of_one_part(self, target):
        assert (sum(mask.astype(int) for mask in masks(target).values()) == 1).all()
        noise = np.random.default_rng(0).normal(size=target.shape)
        parts, octaves = self.of(noise - noise.mean(), target)
        assert sum(part["error"] for part in parts.values()) == pytest.approx(1)
        assert sum(part["pixels"] for part in parts.values()) == pytest.approx(1)
        assert sum(octave["error"] for octave in octaves) == pytest.approx(1)

    @pytest.mark.parametrize(
        ("name", "row", "column"), [("rim", 0, 64), ("rim", 50, 127), ("darkest", 4, 60), ("brightest", 90, 60)]
    )
    def test_an_error_in_one_pixel_is_found(self, name, row, column):
        error = np.zeros(self.SHAPE)
        error[row, column] = 0.1
        assert self.of(error)[0][name]["error"] == pytest.approx(1)

    def test_an_edge_is_where_the_picture_jumps(self):
        letters = np.zeros(self.SHAPE)
        letters[30:60, 40:80] = 1.0
        found = masks(letters)
        assert found["edges"][30, 60] and found["edges"][29, 60] and not found["edges"][45, 60]
        assert found["brightest"][45, 60] and found["darkest"][10, 10] and not found["rest"].any()
        even = masks(np.ones(self.SHAPE))
        assert not any(even[name].any() for name in ("edges", "darkest", "brightest"))

    @pytest.mark.parametrize(
        ("halves", "cycles"), [((0, 64), 0.25), ((48, 0), 0.25), ((3, 4), 2**0.5 / 64), ((0, 1), 1 / 256)]
    )
    def test_a_wave_is_in_the_octave_of_its_length(self, halves, cycles):
        """Half waves over n pixels are halves / 2n cycles a pixel."""
        rows, columns = ((np.arange(side) + 0.5) / side * np.pi for side in self.SHAPE)
        _, octaves = self.of(np.cos(halves[0] * rows)[:, None] * np.cos(halves[1] * columns))
        [found] = [octave for octave in octaves if octave["error"] > 0.999]
        assert found["frequency"][0] <= cycles < found["frequency"][1]
        assert found["period"] == pytest.approx(tuple(1 / (2 * f) for f in found["frequency"]))

    def test_no_error_is_in_no_part_and_in_no_octave(self):
        parts, octaves = self.of(np.zeros(self.SHAPE))
        assert {each["error"] for each in (*parts.values(), *octaves)} == {0.0}


class TestControlCells:
    """Of a plate between two planes, whose light goes straight on; its net is as wide as the beam."""

    SCREEN = Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), 64)
    BEAM = Channel(Collimated(Rectangle(16.0, 16.0)), 1.5)
    NOISE = np.random.default_rng(0).random((64, 64))

    def cells(self, points, target, screen=SCREEN):
        heights = torch.zeros((points, points), dtype=torch.float64)
        back = BSplineSurface(9.0, heights, (-8.0, 8.0), (-8.0, 8.0))
        return control_cells(self.BEAM, Lens(Plane(5.0), back, Rectangle(16.0, 16.0), 1.5), screen, target)

    def test_all_cells_are_counted_and_lie_evenly(self):
        found = self.cells(33, np.ones((64, 64)))
        assert found.a_pixel.sum() == pytest.approx(32**2, rel=1e-6)
        np.testing.assert_allclose(found.a_pixel, 32**2 / 64**2, rtol=1e-6)
        assert found.median == pytest.approx(found.scarce) == pytest.approx(0.25)

    def test_a_wave_needs_the_cells_that_its_cosine_takes(self):
        """A quarter of the cosines, those of up to 2√(64 / π) = 9.03 half waves a tile."""
        x = (np.arange(64) + 0.5) / TILE * np.pi
        floors = [self.cells(33, np.tile(1 + 0.5 * np.cos(k * x), (64, 1))).floor() for k in (8, 10)]
        size = 0.5**0.5 * 0.5 / (1 + 0.125) ** 0.5
        assert floors == pytest.approx([0.0, size], abs=1e-6)

    def test_more_cells_leave_less_and_enough_of_them_nothing(self):
        """As many cells as tiles make an even picture, as many as pixels any; to rounding."""
        assert self.cells(5, np.ones((64, 64))).floor(1.01) == self.cells(33, self.NOISE).floor(2.02) == 0.0
        oblong = Screen(100.0, (-8.0, 8.0), (-8.0, 8.0), (64, 50))
        found = self.cells(33, self.NOISE[:50], oblong)
        floors = [found.floor(finer) for finer in (0.2, 0.5, 1.0, 1.5)]
        assert floors == sorted(floors, reverse=True) and 0 < floors[-1] < floors[0] < 1


@dataclass
class Cells:
    """The least error that control cells leave of a target, now and with twice as many a side."""

    least: float
    finer: float
    median = scarce = 1.0

    def floor(self, finer=1.0):
        return self.least if finer == 1 else self.finer


class TestLimits:
    PLENTY, SCARCE = Cells(0.0, 0.0), Cells(0.09, 0.03)

    @staticmethod
    def curve(power):
        return Ending(0.1, 1.0, 0.1, power, fit=1.0, halving=None)

    def left(self, rrmsd, cells, power=None, **more):
        curve = None if power is None else self.curve(power)
        return {limit.by: limit.rrmsd for limit in limits(rrmsd, cells, curve=curve, **more)}

    @pytest.mark.parametrize(
        ("by", "cells", "power", "more"),
        [
            ("evaluations", PLENTY, 0.5, {"own": 0.1}),
            ("control points", SCARCE, 0.1, {"own": 0.1}),
            ("tubes", PLENTY, 0.1, {"own": 0.05}),
            ("source size", PLENTY, 0.1, {"own": 0.1, "grown": (0.03, 0.06, 0.1)}),
            ("precision", PLENTY, 0.1, {"own": 0.1, "singles": (0.1, 0.05)}),
        ],
    )
    def test_the_largest_gain_comes_first(self, by, cells, power, more):
        first, *others = limits(0.1, cells, curve=self.curve(power), **more)
        assert first.by == by and all(first.rrmsd < other.rrmsd <= 1 for other in others)

    @pytest.mark.parametrize(("rrmsd", "left"), [(0.09, 1 / 3), (0.05, 1 / 3), (0.18, 2 / 3)])
    def test_where_the_cells_leave_all_of_the_error_it_falls_as_they_do(self, rrmsd, left):
        assert self.left(rrmsd, self.SCARCE) == {"control points": pytest.approx(left)}

    @pytest.mark.parametrize(("finer_tubes", "by_tubes"), [(1.0, 1.0), (2**0.25, 0.8), (2**0.5, 0.64), (2.0, 0.64)])
    def test_a_finer_net_has_the_gain_of_the_tubes_that_come_with_it(self, finer_tubes, by_tubes):
        """Twice the tubes, by a factor of 2^(1/2) a side, let them see all of the error."""
        left = self.left(0.09, self.SCARCE, own=0.64 * 0.09, finer_tubes=finer_tubes)
        assert left["control points"] == pytest.approx(by_tubes / 3)

    def test_evaluations_make_smaller_only_what_the_tubes_see(self):
        assert self.left(0.1, self.PLENTY, 1.0, own=0.1)["evaluations"] == pytest.approx(0.5)
        half_seen = self.left(0.1, self.PLENTY, 1.0, own=0.06)["evaluations"]
        assert half_seen == pytest.approx((0.03**2 + 0.08**2) ** 0.5 / 0.1)
        assert self.left(0.1, self.PLENTY, 1.0, own=0.1, anew=True)["evaluations"] == pytest.approx(0.5**0.5)

    def test_no_knob_undoes_the_blur_of_the_source(self):
        """Four points of a source see an RRMSD of 0.006 where all of it has 0.1, and the target blurred by it 0.09."""
        given = {"power": 1.0, "own": 0.006, "grown": (0.03, 0.06, 0.1), "singles": (0.1, 0.05)}
        free, bound = self.left(0.1, self.SCARCE, **given), self.left(0.1, self.SCARCE, **given, blurred=0.09)
        assert free["tubes"] == pytest.approx(0.06)
        assert bound.pop("source size") == free.pop("source size") < 0.9
        assert bound == {by: pytest.approx(max(left, 0.9)) for by, left in free.items()}
        # the lens overlays images of the source that are nearer to it than the blur
        better = self.left(0.1, self.SCARCE, **given, blurred=0.2)
        assert better.pop("source size") < 1 and set(better.values()) == {1.0}

    def test_nothing_is_said_of_what_is_not_known(self):
        assert set(self.left(0.1, self.PLENTY)) == {"control points"}
        assert {limit.by for limit in limits(0.1, self.PLENTY, curve=self.curve(None))} == {"control points"}
        few = self.left(0.1, self.PLENTY, 0.1, own=0.2, grown=(0.03, 0.06))
        assert set(few) == {"control points", "evaluations", "tubes"}
        assert few["tubes"] == 1.0  # by chance coarser tubes see more
