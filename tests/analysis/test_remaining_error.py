"""Where an error sits, of errors put in a known place and of waves of a known length."""

import numpy as np
import pytest

from bstcad.analysis.remaining_error import places, remaining

SHAPE = (96, 128)
RAMP = np.linspace(1.0, 2.0, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
PER_MM = (2.0, 2.0)


def of(error, target=RAMP):
    found = remaining(target + error, target, PER_MM)
    return {part.name: part for part in found.parts}, found.octaves


def wave(along_rows, along_columns):
    """A cosine with so many half waves over each side."""
    rows, columns = ((np.arange(side) + 0.5) / side * np.pi for side in SHAPE)
    return np.cos(along_rows * rows)[:, None] * np.cos(along_columns * columns)


@pytest.mark.parametrize("target", [RAMP, np.ones(SHAPE), (RAMP > 1.8).astype(float), RAMP[:1], RAMP[:, :1]])
def test_each_pixel_is_of_one_part(target):
    assert (sum(place.astype(int) for place in places(target).values()) == 1).all()
    noise = np.random.default_rng(0).normal(size=target.shape)
    parts, octaves = of(noise - noise.mean(), target)
    assert sum(part.error for part in parts.values()) == pytest.approx(1)
    assert sum(part.pixels for part in parts.values()) == pytest.approx(1)
    assert sum(octave.error for octave in octaves) == pytest.approx(1)


@pytest.mark.parametrize(
    ("name", "row", "column"), [("rim", 0, 64), ("rim", 50, 127), ("darkest", 4, 60), ("brightest", 90, 60)]
)
def test_an_error_in_one_pixel_is_found(name, row, column):
    error = np.zeros(SHAPE)
    error[row, column] = 0.1
    parts, _ = of(error)
    assert parts[name].error == pytest.approx(1)


def test_an_edge_is_where_the_picture_jumps():
    letters = np.zeros(SHAPE)
    letters[30:60, 40:80] = 1.0
    found = places(letters)
    assert found["edges"][30, 60] and found["edges"][29, 60] and not found["edges"][45, 60]
    assert found["brightest"][45, 60] and found["darkest"][10, 10] and not found["rest"].any()


def test_an_even_target_has_no_edges_and_nothing_dark():
    found = places(np.ones(SHAPE))
    assert not any(found[name].any() for name in ("edges", "darkest", "brightest"))


@pytest.mark.parametrize(
    ("halves", "cycles"), [((0, 64), 0.25), ((48, 0), 0.25), ((3, 4), 2**0.5 / 64), ((0, 1), 1 / 256)]
)
def test_a_wave_is_in_the_octave_of_its_length(halves, cycles):
    """Half waves over n pixels are halves / 2n cycles a pixel."""
    _, octaves = of(wave(*halves))
    [found] = [octave for octave in octaves if octave.error > 0.999]
    assert found.frequency[0] <= cycles < found.frequency[1]
    assert found.period == pytest.approx(tuple(1 / (2 * f) for f in found.frequency))  # two pixels a mm


def test_a_checkerboard_is_in_the_finest_octave():
    _, octaves = of((-1.0) ** np.add.outer(*map(np.arange, SHAPE)))
    assert octaves[-1].error > 0.9


def test_a_picture_without_error_has_none_anywhere():
    parts, octaves = of(np.zeros(SHAPE))
    assert {part.error for part in parts.values()} == {octave.error for octave in octaves} == {0.0}
