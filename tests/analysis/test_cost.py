"""The end of known curves, errors in known places, cells of a plate over pixels."""

import numpy as np
import pytest

from bstcad.analysis.cost import TILE_PIXELS, ControlCells, ending, masks, remaining


class TestEnding:
    """Curves of stage 2, a point a second, after the picture and stage 1."""

    STAGES = [(1.0, None), (3.0, 0.4), (100.0, 0.05)]  # picture, stage 1, stage 2

    @staticmethod
    def curve(value, count=100):
        """Stage 1's judgement, the points of stage 2, and its own judgement."""
        return [(4.0, 0.4), *((4.0 + t, value(t)) for t in range(1, count + 1)), (104.0, 0.05)]

    def test_a_power_law_has_a_last_tenth_and_a_price_of_half_the_error(self):
        found = ending(self.curve(lambda t: 0.3 * t**-0.5), self.STAGES)
        assert found.power == pytest.approx(0.5, abs=1e-6) and found.fit == pytest.approx(1.0)
        assert found.halving == pytest.approx(4.0, rel=1e-5)
        # t^-1/2 is 1.1 times its end at t / 1.21, to a step; the median of the last twentieth stands for the end
        assert found.last_tenth_seconds == pytest.approx(100 - 98 / 1.21, abs=1.5)
        assert found.last_tenth == pytest.approx(found.last_tenth_seconds / 104)
        assert found.last_gain == pytest.approx(1 - 0.95**0.5)  # from 95 to 100 evaluations

    def test_a_curve_without_a_power_law_offers_no_halving(self):
        rests = ending(self.curve(lambda t: 0.03 + 0.3 * 0.8**t), self.STAGES)
        noise = ending(self.curve(lambda t: 0.03 * (1.3 if t % 2 else 1.0)), self.STAGES)
        rises = ending(self.curve(lambda t: 0.03 * t**0.5), self.STAGES)
        few = ending(self.curve(lambda t: 0.3 * t**-0.5, count=3), self.STAGES)
        assert rests.power < 0.01 and rests.last_tenth > 0.7 and noise.fit < 0.1
        assert rises.power == 0.0 and few.power is None
        assert rises.last_gain == 0.0 and few.last_gain is None
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
    """Errors in a known position, and waves of a known length."""

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
    """An even plate of 32 x 32 cells before 64 x 64 pixels."""

    NOISE = np.random.default_rng(0).random((64, 64))

    def cells(self, side, target):
        return ControlCells(np.full(target.shape, side**2 / 64**2), target)

    def test_a_wave_needs_the_cells_that_its_cosine_takes(self):
        """A quarter of the cosines, those of up to 2√(64 / π) = 9.03 half waves a tile."""
        x = (np.arange(64) + 0.5) / TILE_PIXELS * np.pi
        floors = [self.cells(32, np.tile(1 + 0.5 * np.cos(k * x), (64, 1))).floor() for k in (8, 10)]
        size = 0.5**0.5 * 0.5 / (1 + 0.125) ** 0.5
        assert floors == pytest.approx([0.0, size], abs=1e-6)

    def test_more_cells_leave_less_and_enough_of_them_nothing(self):
        """Cells as many as tiles make an even picture, cells as many as pixels any picture, to rounding."""
        assert self.cells(4, np.ones((64, 64))).floor(1.01) == self.cells(32, self.NOISE).floor(2.02) == 0.0
        floors = [self.cells(32, self.NOISE[:50]).floor(finer) for finer in (0.2, 0.5, 1.0, 1.5)]
        assert floors == sorted(floors, reverse=True) and 0 < floors[-1] < floors[0] < 1
