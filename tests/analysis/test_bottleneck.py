"""What limits a design, of made-up ones in which it is plain."""

from dataclasses import dataclass

import pytest

from bstcad.analysis.bottleneck import limits
from bstcad.analysis.convergence import Ending


@dataclass
class Cells:
    """What control cells leave of a target, now and with twice as many a side."""

    least: float
    finer: float
    median = scarce = 1.0

    def floor(self, finer=1.0):
        return self.least if finer == 1 else self.finer


PLENTY, SCARCE = Cells(0.0, 0.0), Cells(0.09, 0.03)


def curve(power, rrmsd=0.1):
    return Ending(rrmsd, 1.0, 0.1, power, 1.0, None)


def found(*given, **more):
    return {limit.by: limit.rrmsd for limit in limits(*given, **more)}


@pytest.mark.parametrize(
    ("by", "given", "more"),
    [
        ("evaluations", (0.1, curve(0.5), 0.1, PLENTY), {}),
        ("control points", (0.1, curve(0.1), 0.1, SCARCE), {}),
        ("tubes", (0.1, curve(0.1), 0.05, PLENTY), {}),
        ("source size", (0.1, curve(0.1), 0.1, PLENTY, (0.03, 0.06, 0.1)), {}),
        ("precision", (0.1, curve(0.1), 0.1, PLENTY), {"singles": (0.1, 0.05)}),
    ],
)
def test_the_largest_gain_comes_first(by, given, more):
    first, *others = limits(*given, **more)
    assert first.by == by and all(first.rrmsd < other.rrmsd <= 1 for other in others)


def test_where_the_cells_leave_all_of_the_error_it_falls_as_they_do():
    assert found(0.09, None, None, SCARCE) == {"control points": pytest.approx(1 / 3)}
    assert found(0.05, None, None, SCARCE) == {"control points": pytest.approx(1 / 3)}  # the estimate is no bound
    assert found(0.18, None, None, SCARCE) == {"control points": pytest.approx(2 / 3)}


def test_evaluations_make_smaller_only_what_the_tubes_see():
    assert found(0.1, curve(1.0), 0.1, PLENTY)["evaluations"] == pytest.approx(0.5)
    assert found(0.1, curve(1.0), 0.06, PLENTY)["evaluations"] == pytest.approx((0.03**2 + 0.08**2) ** 0.5 / 0.1)
    assert found(0.1, curve(1.0), 0.1, PLENTY, anew=True)["evaluations"] == pytest.approx(0.5**0.5)


def test_no_knob_undoes_the_blur_of_the_source():
    """Four points of a source see an RRMSD of 0.006 where all of it has 0.1, and the target blurred by it 0.09."""
    given = (0.1, curve(1.0), 0.006, SCARCE, (0.03, 0.06, 0.1), (0.1, 0.05))
    free, bound = found(*given), found(*given, blurred=0.09)
    assert free["tubes"] == pytest.approx(0.06)
    assert bound.pop("source size") == free.pop("source size") < 0.9
    assert bound == {by: pytest.approx(max(left, 0.9)) for by, left in free.items()}
    better = found(*given, blurred=0.2)  # the lens overlays images of the source that are nearer to it than the blur
    assert better.pop("source size") < 1 and set(better.values()) == {1.0}


def test_nothing_is_said_of_what_is_not_known():
    assert set(found(0.1, curve(None), None, PLENTY)) == {"control points"}
    assert set(found(0.1, curve(0.1), 0.2, PLENTY, (0.03, 0.06))) == {"control points", "evaluations", "tubes"}
    assert found(0.1, curve(0.1), 0.2, PLENTY)["tubes"] == 1.0  # by chance coarser tubes see more
