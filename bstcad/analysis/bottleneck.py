"""What limits a design: what its RRMSD would become by one step more of each thing that costs time or size.

One step is twice the evaluations, twice the tubes, twice the control points a side, half the source, float64 instead of
float32.  All are estimates from what a finished design knows anyway:

- evaluations: the power law at the end of the convergence curve, after twice the time;
- control points: the least error that the cells leave of the target (control_cells.py), by which it falls in proportion
  as that does where it is as large as the error, and less where it is smaller;
- tubes: what the tubes that tailored the lens say of it, against independent rays: what they did not see could be
  mended;
- source size: what there was before the source had grown.

Of a source of some size none but the last leads below the RRMSD of the target blurred by the source's image.

tests/benchmarks/test_bottleneck.py holds the largest of them to designs that take the step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bstcad.analysis.control_cells import ControlCells
from bstcad.analysis.convergence import Ending

HALF = 0.5  # of what going on would gain, in logarithms: so much is left if the search begins anew
WORTH = 0.95  # times the RRMSD: what would leave more of it is no remedy


@dataclass(frozen=True)
class Limit:
    """What one step more of something would bring, and the figures that say so."""

    by: str  # "evaluations", "control points", "tubes", "source size" or "precision"
    rrmsd: float  # that there would be, over what there is
    figures: Mapping[str, float]


def limits(
    rrmsd: float,
    curve: Ending | None,
    own: float | None,
    cells: ControlCells,
    grown: Sequence[float] = (),
    singles: tuple[float, float] | None = None,
    anew: bool = False,
    blurred: float = 0.0,
) -> tuple[Limit, ...]:
    """Of a design of this RRMSD, what would bring most first; a thing nothing is known of is left out.

    curve: None: the irradiance was never tailored.  own: RRMSD by the tubes that tailored it, which these alone could
    flatter; None: it was by other rays each time.  grown: RRMSD after each size of an extended source: a third, two
    thirds, all of it.  singles: RRMSD by float32, in which it was tailored, and by float64, after a few evaluations;
    None: it was by float64.  anew: would more evaluations be shared out anew, instead of going on where they ended?
    blurred: RRMSD of the target blurred by the source's size, below which only a smaller source is said to lead.
    """
    found = [_control_points(rrmsd, cells)]
    if curve is not None and curve.power is not None:
        found.append(_evaluations(rrmsd, own, curve.doubled ** (HALF if anew else 1.0), curve.power))
    if own is not None:
        found.append(Limit("tubes", min(own / rrmsd, 1.0), {"own": own, "finer": rrmsd}))
    size = None
    if len(grown) == 3:
        third, most, whole = grown
        figures = {"third": third, "two thirds": most, "whole": whole}
        size = Limit("source size", min(math.sqrt(third * most) / whole, 1.0), figures)
    if singles is not None:
        single, double = singles
        found.append(Limit("precision", min(double / single, 1.0), {"float32": single, "float64": double}))
    found = [_at_least(limit, blurred, rrmsd) for limit in found] + ([] if size is None else [size])
    return tuple(sorted(found, key=lambda limit: limit.rrmsd))


def _at_least(limit: Limit, blurred: float, rrmsd: float) -> Limit:
    """The same where the source's blur, which no knob undoes, leaves its part of the error."""
    least = min(blurred / rrmsd, 1.0)
    return limit if limit.rrmsd >= least else Limit(limit.by, least, {**limit.figures, "blurred": blurred})


def _evaluations(rrmsd: float, own: float | None, gain: float, power: float) -> Limit:
    """They make smaller what the tubes see; the rest adds to it as squares do, and stays."""
    seen = 1.0 if own is None else min(own / rrmsd, 1.0)
    return Limit("evaluations", math.hypot(seen * gain, math.sqrt(1 - seen**2)), {"power": power})


def _control_points(rrmsd: float, cells: ControlCells) -> Limit:
    """The least error by the cells is the part of it that finer ones can take away, as far as they do."""
    floor, finer = cells.floor(), cells.floor(2.0)
    part = min(floor / rrmsd, 1.0)
    gain = part * (1 - finer / floor) if floor > 0 else 0.0
    figures = {"floor": floor, "finer": finer, "median": cells.median, "scarce": cells.scarce}
    return Limit("control points", 1 - gain, figures)
