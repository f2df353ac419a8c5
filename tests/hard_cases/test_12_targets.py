"""12. Targets with dark parts, islands, one bright pixel, no light; transport that stalls.

Entropic solvers return NaN or never end on such pairs (ott #185, POT #126, #386, geomloss #25), and a black picture
divides by zero.  Here densities are normalised when they are made, a black one is refused in a sentence, holes are
lifted to a stated floor, a solve ends on a plateau, and the mass error says what a map is worth: it is at most 2, all
of the light in wrong cells, since no step is taken that raises it.
"""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from bstcad.designs import pipeline
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from bstcad.tailoring.driver import Hooks
from bstcad.transport import Density, TransportStep, back_and_forth, mass_error, solve
from bstcad.transport.mapping import FLOOR, STEPS_PER_GRID
from bstcad.transport.monge_ampere import MAX_STEPS_FACTOR, newton_on_grids
from tests import suite
from tests.scenes import DISK, SMALL

N = 64
RANDOM = np.random.default_rng(0)


def cells(*spots: tuple[slice | int, slice | int, float], ground: float = 0.0) -> np.ndarray:
    """(N, N) of one grey, with spots of others."""
    values = np.full((N, N), ground)
    for x, y, value in spots:
        values[x, y] = value
    return values


# What, and the most of the light that may go astray, half the mass error: all of it for what is as fine as the grid (a
# map is held at corners, which average four pixels); a tenth for islands of five cells and a line, whose rims are a
# large part of them; where there is one wide island, what the solver's tolerance and its eight steps leave.
TARGETS = {
    "half of the target dark": (cells((slice(0, N // 2), slice(None), 1.0)), 0.005),
    "islands": (cells((slice(5, 10), slice(5, 10), 1.0), (slice(50, 55), slice(45, 50), 2.0), (30, 30, 0.5)), 0.1),
    "a line": (cells((N // 2, slice(None), 1.0)), 0.1),
    "every other pixel": (np.add.outer(np.arange(N), np.arange(N)) % 2.0, 1.0),
    "speckle": (RANDOM.random((N, N)) ** 20, 1.0),
    "a bright pixel on a dim ground": (cells((35, 20, 1.0), ground=1e-6), 1.0),
    "one bright pixel": (cells((35, 20, 1.0)), 1.0),
    "one bright corner": (cells((0, 0, 1.0)), 1.0),
    "irradiance of 1e-300": (cells((slice(9, 40), slice(3, 50), 3e-300), ground=1e-300), 0.01),
    "irradiance of 1e308": (cells((slice(9, 40), slice(3, 50), 1e308), ground=1e300), 0.01),
}
SOURCES = {
    "disc": Density.from_function(lambda x, y: 1.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.25), N),
    "even": Density.from_values(np.ones((N, N))),
}


@pytest.mark.parametrize("source", suite.in_turns(SOURCES, 2))
@pytest.mark.parametrize("target", TARGETS)
def test_any_target_gets_a_finite_map_and_a_mass_error(holds, source, target):
    values, astray = TARGETS[target]
    mapping = solve(SOURCES[source], Density.from_values(values))
    transport = mapping.transport
    for array in (transport.phi, transport.psi, mapping.x, mapping.y, *mapping(*RANDOM.random((2, 500)))):
        assert np.isfinite(array).all()
    errors = transport.mass_error
    assert len(errors) <= MAX_STEPS_FACTOR * STEPS_PER_GRID + 1 and all(np.diff(errors) <= 0)
    assert transport.reason in ("converged", "plateau", "iterations")
    assert mass_error(mapping) == pytest.approx(errors[-1], rel=1e-9)  # as reported, so it is
    assert mapping.target.values.min() >= FLOOR / (1 + FLOOR)  # lifted, then made of mean 1 again
    holds(f"light in wrong cells, {target}", errors[-1] / 2, astray, "of the light")


@pytest.mark.parametrize("factor", (2.0**-900, 0.25, 2.0**900))
def test_an_unequal_mass_changes_no_bit(factor):
    """A target counts by its shape alone."""
    values = TARGETS["islands"][0]
    one, other = (solve(SOURCES["disc"], Density.from_values(values * f)) for f in (1.0, factor))
    assert np.array_equal(one.transport.phi, other.transport.phi)


@pytest.mark.parametrize("target", ("islands", "every other pixel", "speckle", "one bright pixel"))
def test_back_and_forth_comes_to_rest(target):
    """Asked for no error at all and given 5000 iterations: a plateau of 5 is found within some 20, thrice."""
    seen: list[TransportStep] = []
    found = back_and_forth(
        SOURCES["disc"], Density.from_values(TARGETS[target][0]), iterations=5000, tolerance=0.0, progress=seen.append
    )
    assert found.reason == "plateau" and found.iterations < 100
    assert np.isfinite(found.phi).all() and all(0 <= error <= 2 + 1e-9 for error in found.mass_error)
    assert all(np.diff(found.dual) >= -1e-12)  # it only rises
    assert seen[-1].mass_error == found.mass_error[-2]


def test_newton_that_stalls_says_plateau():
    """Newton's method begins at a potential that folds everywhere, so that no step may gain: the first one is kept."""
    source, target = SOURCES["disc"], Density.from_values(TARGETS["speckle"][0]).lifted(FLOOR)
    start = 3.0 * RANDOM.standard_normal((N, N))
    phi, errors, reason = newton_on_grids([(source, target)], start, steps=50, tolerance=0.0)
    assert reason == "plateau" and len(errors) < 50
    assert np.isfinite(phi).all() and np.isfinite(errors).all() and all(np.diff(errors) <= 0)


# --- the same from a picture ------------------------------------------------------------------------------------------


def scene_of(picture: np.ndarray, folder):
    """The small scene with this picture, of 16 bits."""
    Image.fromarray(picture.astype(np.uint16)).save(folder / "picture.png")
    return load(DISK, SMALL | {"target.image": str(folder / "picture.png")})


def test_a_picture_without_light_is_refused_before_any_work(tmp_path):
    """All black; and black wherever the target's outline lets light through."""
    steps = []
    for picture in (cells(), cells((0, 0, 65535), (63, 63, 65535))):
        with pytest.raises(SceneError, match="target.image: the picture is black"):
            hooks = Hooks(progress=lambda *step: steps.append(step))
            pipeline.design(scene_of(picture, tmp_path), device="cpu", hooks=hooks)
    assert steps == []
