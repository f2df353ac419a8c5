"""Bounds on the tailored faces (scene/blank.py): curvature, slope and thickness, in stage 1, in stage 2 and at the end.

A back that would be too near to the front, or cross it, is shifted along +z: the light depends on its slopes, hardly on
its height, and the next rounds of stage 1 start from the shifted back.  If the front is tailored, a shift changes the
picture.  Then the minimum thickness is a bound like the others (clearance.py), even if the scene has no bounds, and the
back is shifted only if changes of both faces do not suffice.

Stage 2 adds to its merit the mean squared excess over the bounds, on a grid four times finer than the knot spans.  Few
spans are near a bound; differences of control points show which, and only these are evaluated.  Excess that is left
after stages 1 and 2 is removed by minimising this penalty alone, which hardly changes the picture (`enforce_bounds`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import torch
from torch import Tensor

from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.numerics.reductions import total
from bstcad.optics.surfaces import bspline
from bstcad.optics.surfaces.bspline import BSplineSurface, Jet, Spans
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.sampling import sample_rim
from bstcad.runs.files import SceneError
from bstcad.tailoring.clearance import PENALTY_MARGIN, QUARTER_RIM_POINTS, clearance
from bstcad.tailoring.merit import SobolevVariable
from bstcad.tailoring.minimise import lbfgs, minimise
from bstcad.tailoring.settings import Bounds

THICKNESS_POINTS = 513  # points per side at which the thickness is computed
RELIEF_RESERVE = 0.02  # additional thickness for the changes of stage 2, relative to the sag range (PV) of the back
BOUNDS_STAGE = "bounds on the back"  # name, in the record of a design, of the stage that enforces the bounds
BOUND_RESERVE = 1e-3  # distance kept from a bound, relative like PENALTY_MARGIN: files are rounded, grids miss extremes
# Weights of the mean squared relative excess, relative to RRMSD²: by round, from the last one of a stage backwards,
# and for a stage of one round.  (A large weight from the start keeps the search near its start: a small lens that
# needs a radius of 20 mm but has a minimum of 50 mm ends at an RRMSD of 0.015 with 1000, and at 0.0033 with 10.)
ROUND_WEIGHTS, ONLY_WEIGHT = (1000.0, 100.0, 10.0), 100.0
REPAIR_EVALUATIONS = 100  # largest number of evaluations of the penalty alone
HALVINGS = 10  # number of bisection steps between a lens that exceeds the bounds and a lens that meets them


@torch.no_grad()
def place_back(lens: Lens, z: float, least: float, bounds: Bounds | None = None) -> Lens:
    """Return the lens with the plane of its back at `z` (mm), or as far above as a thickness of `least` mm requires.

    With bounds, the minimum thickness at the rim and the maximum thickness are met too, the latter also by a plane
    below `z`.  If the bounds are incompatible, the thickness violates minimum and maximum by equal lengths.
    """
    if not lens.back.chart.flat:  # its vertex stays
        return lens
    x, y = thickness_points(lens)
    relative = lens.back.relative_sag_and_slope(x, y)[0]
    glass = z - lens.front.z + relative - lens.front.relative_sag_and_slope(x, y)[0]
    relief = float(relative.max() - relative.min())
    if bounds is None:
        thinnest = float(glass.min())
        if thinnest < least:
            z += least - thinnest + RELIEF_RESERVE * relief
        return lens.with_back(lens.back.moved(z))
    x, y = rim_points(lens)
    edge = z + lens.back.relative_sag_and_slope(x, y)[0] - lens.front.sag_and_slope(x, y)[0]
    short = max(least, bounds.thinnest or least) - float(torch.minimum(glass.min(), edge.min()))
    if bounds.edge is not None:
        short = max(short, bounds.edge - float(edge.min()))
    room = math.inf if bounds.thickest is None else bounds.thickest - float(torch.maximum(glass.max(), edge.max()))
    spare = min(RELIEF_RESERVE * relief, max(room - short, 0.0) / 2)
    shift = max(short + spare, 0.0) + min(room - spare, 0.0) if short <= room else (short + room) / 2
    return lens.with_back(lens.back.moved(z + shift))


def thickness_points(lens: Lens) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of the points inside the outline at which the thickness is computed."""
    x, y = _points_inside(lens.outline)
    return x.to(lens.like), y.to(lens.like)


@lru_cache(maxsize=1)  # one design asks for its points some hundred times
def _points_inside(outline: Outline) -> tuple[Tensor, Tensor]:
    axes = (torch.linspace(-half, half, THICKNESS_POINTS, dtype=torch.float64) for half in outline.half_extent)
    x, y = torch.meshgrid(*axes, indexing="ij")
    inside = outline.contains(x, y)
    return x[inside], y[inside]


def rim_points(lens: Lens) -> tuple[Tensor, Tensor]:
    """Return x and y (mm) of the points along the rim at which the thickness is computed."""
    x, y = sample_rim(lens.outline, QUARTER_RIM_POINTS)
    return x.to(lens.like), y.to(lens.like)


def round_weight(number: int, rounds: int) -> float:
    """Return the weight of the excess in round `number`, from 0, of the `rounds` rounds of a stage."""
    return ONLY_WEIGHT if rounds == 1 else ROUND_WEIGHTS[min(rounds - 1 - number, len(ROUND_WEIGHTS) - 1)]


def active_bounds(lens: Lens, bounds: Bounds | None, least: float) -> Bounds | None:
    """Return the bounds on the tailored faces; None: there are none.

    These are the bounds of the scene; without them a tailored front still requires a thickness of `least` mm.
    """
    return Bounds(thinnest=least) if bounds is None and lens.is_tailored(FRONT) else bounds


@dataclass(frozen=True)
class Excess:
    """Excess of the tailored faces of a lens over their bounds."""

    mean_square: float  # penalty E of `excess`
    gradients: tuple[Tensor, ...]  # gradients of the penalty in the heights (1/mm), (m, n) for each of Lens.nets
    worst: float  # largest excess, relative to its bound (thickness: see PENALTY_MARGIN); negative: every bound is met


def excess(lens: Lens, bounds: Bounds) -> Excess:
    """Return the excess of curvature, slope and thickness everywhere inside the outline.

    The penalty is E = Σ mean max(q_f / b_f - 1 + m, 0)², m = PENALTY_MARGIN, over the tailored faces f and the bounds
    b_f > 0 on their quantities q_f, plus the penalty on the thickness.  A tool reaches the back from +z, where a
    valley of radius R has the curvature κ = 1 / R of z.  It reaches the front from -z, from where the heights are -z
    and the curvatures have the opposite sign: a valley of the front is a ridge of z, with κ = -1 / R.  |∇z| stays the
    same.

    Sums have fixed parts, so that no bit depends on the number of threads.
    """
    nets = {k: net.to(torch.float64) for k, net in zip(lens.tailored_numbers, lens.nets, strict=True)}
    square, worst = 0.0, -PENALTY_MARGIN
    gradients = {k: net.heights.new_zeros(()).expand_as(net.heights) for k, net in nets.items()}
    for squared, changes, largest in _parts(lens, nets, bounds):
        square, worst = square + squared, max(worst, largest)
        gradients |= {k: gradients[k] + changes[k] for k in changes.keys() & nets.keys()}
    heights = (net.heights for net in lens.nets)
    given = tuple(g.to(h) for g, h in zip(gradients.values(), heights, strict=True))  # in the precision of the lens
    return Excess(square, given, worst)


PartExcess = tuple[float, dict[int, Tensor], float]  # mean square, its gradients by face number, largest excess


def _parts(lens: Lens, nets: dict[int, BSplineSurface], bounds: Bounds) -> Iterator[PartExcess]:
    """Yield the excess of each tailored face, then the excess of the thickness; nets: in float64, by face number."""
    if (bounds.concave, bounds.convex, bounds.slope) != (None, None, None):
        for k, from_above in _bounds_from_above(lens, bounds).items():
            squared, gradient, worst = _shape_excess(nets[k], lens.outline, from_above)
            yield squared, {k: gradient}, worst
    if lens.is_tailored(FRONT):
        yield clearance(lens.to(torch.float64), bounds)
    elif bounds.thickest is not None and (back := lens.number_of(BACK)) in nets:
        squared, gradient, worst = _thickness_excess(lens.with_back(nets[back]), bounds)
        yield squared, {back: gradient}, worst


def _bounds_from_above(lens: Lens, bounds: Bounds) -> dict[int, Bounds]:
    """Return the bounds on z(x, y), seen from +z, for each tailored face, by its number."""
    turned = replace(bounds, concave=bounds.convex, convex=bounds.concave)  # bounds of a face that is seen from -z
    highest = lens.faces[-1].name
    return {lens.number_of(f.name): bounds if f.name == highest else turned for f in lens.tailored_faces}


def _shape_excess(net: BSplineSurface, outline: Outline, bounds: Bounds) -> tuple[float, Tensor, float]:
    """Return (penalty, its gradient, largest excess) of curvature and slope of a face over its bounds."""
    square, worst, gradient = 0.0, -PENALTY_MARGIN, torch.zeros_like(net.heights)
    for spans, reached, bound, quantity in _spans_near_bounds(net, outline, bounds):
        leaf = spans.heights.detach().requires_grad_()
        ratio = quantity(replace(spans, heights=leaf).jet(bspline.QUARTERS)) / bound
        relative = torch.where(reached, ratio - 1, -PENALTY_MARGIN)
        squared = total(torch.relu(relative + PENALTY_MARGIN) ** 2)
        gradient += spans.scattered(*torch.autograd.grad(squared, leaf))
        square, worst = square + float(squared.detach()), max(worst, float(relative.detach().max()))
    count = math.prod(len(bspline.QUARTERS) * (points - 2) for points in net.shape)
    return square / count, gradient / count, worst


def _spans_near_bounds(
    net: BSplineSurface, outline: Outline, bounds: Bounds
) -> Iterator[tuple[Spans, Tensor, float, Callable[[Jet], Tensor]]]:
    """Yield (spans near a bound, mask of their points inside the outline, bound, function: Jet -> limited quantity)."""
    for bound, upper_limit, quantity in (
        (bounds.concave, partial(bspline.curvature_bounds, net, 1.0), lambda jet: jet.curvatures[0]),
        (bounds.convex, partial(bspline.curvature_bounds, net, -1.0), lambda jet: -jet.curvatures[1]),
        (bounds.slope, partial(bspline.slope_bounds, net), lambda jet: jet.slope),
    ):
        if bound is None:
            continue
        near = torch.nonzero(upper_limit() > (1 - PENALTY_MARGIN) * bound)
        for i, j in (part.T for part in near.split(bspline.SPANS_AT_A_TIME) if len(part)):
            yield Spans.of(net, i, j), bspline.near_outline(net, outline, i=i, j=j, s=bspline.QUARTERS), bound, quantity


def _thickness_excess(lens: Lens, bounds: Bounds) -> tuple[float, Tensor, float]:
    """Return (penalty, its gradient, largest excess) of the thickness over its bounds, for a lens with one net.

    The unit of the excess is the smaller of the difference of the bounds and the sag range (PV) of the back.
    """
    assert bounds.thickest is not None, "without a maximum thickness a shift of the back meets the bounds"
    net, leaf = lens.back_net, lens.back_net.heights.detach().requires_grad_()
    back, square, worst, room = replace(net, heights=leaf), torch.zeros(()), -PENALTY_MARGIN, 0.0
    rim = rim_points(lens), max(bounds.thinnest, bounds.edge or 0.0)
    for (x, y), least in ((thickness_points(lens), bounds.thinnest), rim):
        heights = back.relative_sag_and_slope(x, y)[0]
        if not room:  # everywhere comes first
            sag_range = float((heights.max() - heights.min()).detach())
            room = min(bounds.thickest - bounds.thinnest, sag_range) or 1.0
        glass = (back.z + heights) - lens.front.sag_and_slope(x, y)[0]
        relative = torch.maximum(glass - bounds.thickest, least - glass) / room
        worst = max(worst, float(relative.detach().max()))
        square = square + total(torch.relu(relative + PENALTY_MARGIN) ** 2) / len(x)
    if worst <= -PENALTY_MARGIN:  # no thickness is near its bound
        return 0.0, torch.zeros_like(net.heights), worst
    (gradient,) = torch.autograd.grad(square, leaf)
    return float(square.detach()), gradient, worst


def enforce_bounds(lens: Lens, bounds: Bounds, evaluations: int = REPAIR_EVALUATIONS) -> Lens:
    """Return the lens with its tailored faces and the position of its back changed as little as the bounds require.

    The penalty alone is minimised, in Sobolev variables (merit.py).  If so many evaluations do not suffice, the
    faces are flattened.  If the front is tailored, the back is shifted only if changes of the faces do not suffice,
    since a shift changes the picture.  SceneError if even a flat back exceeds a bound.
    """
    for place in (_unmoved, _with_back_moved) if lens.is_tailored(FRONT) else (_with_back_moved,):
        lens = place(lens, bounds)
        if not _exceeds(lens, bounds):
            return lens
        bent = place(_reduce_excess(lens, bounds, evaluations), bounds)
        if not _exceeds(bent, bounds):
            return _nearest(lens, bent, bounds, place)
        lens = bent
    flat = _with_back_moved(_flat(lens, bounds), bounds)
    if _exceeds(flat, bounds):
        raise SceneError(
            "lens.max_thickness: with this front, not even a flat back meets both lens.max_thickness and the minimum "
            "thickness; raise lens.max_thickness, or lower lens.edge_thickness or lens.min_thickness"
        )
    return _nearest(lens, flat, bounds, _with_back_moved)


def _nearest(lens: Lens, valid: Lens, bounds: Bounds, place: Callable[[Lens, Bounds], Lens]) -> Lens:
    """Return the lens nearest to `lens` that meets the bounds, on the line of heights from `lens` to `valid`."""
    start = _heights(lens)
    changes = [end - begin for end, begin in zip(_heights(valid), start, strict=True)]
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        fraction = (low + high) / 2
        trial = place(lens.with_heights(h + fraction * d for h, d in zip(start, changes, strict=True)), bounds)
        if _exceeds(trial, bounds):
            low = fraction
        else:
            high, valid = fraction, trial
    return valid


def _heights(lens: Lens) -> list[Tensor]:
    return [net.heights for net in lens.nets]


def _flat(lens: Lens, bounds: Bounds) -> Lens:
    faces, nets = _bounds_from_above(lens, bounds), zip(lens.tailored_numbers, _heights(lens), strict=True)
    return lens.with_heights(torch.zeros_like(h) if k in faces else h for k, h in nets)


def _unmoved(lens: Lens, bounds: Bounds) -> Lens:
    return lens


def _with_back_moved(lens: Lens, bounds: Bounds) -> Lens:
    return place_back(lens, lens.back.z, bounds.thinnest, bounds)


def _exceeds(lens: Lens, bounds: Bounds) -> bool:
    return excess(lens, bounds).worst > -BOUND_RESERVE


def _reduce_excess(lens: Lens, bounds: Bounds, evaluations: int) -> Lens:
    """Minimise the penalty; return the first lens that exceeds no bound, or else the lens of the smallest penalty."""
    start = _heights(lens)
    variables = [SobolevVariable.of(net, torch.ones_like(net.heights)) for net in lens.nets]

    def at(c: Sequence[Tensor]) -> Lens:
        return lens.with_heights(h + v.heights(p.detach()) for h, v, p in zip(start, variables, c, strict=True))

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        over = excess(at(parameters), bounds)
        gradients = [v.adjoint(g) for v, g in zip(variables, over.gradients, strict=True)]
        return over.mean_square, gradients, over.worst

    for reached in minimise(in_c, lbfgs([v.zero() for v in variables], evaluations), evaluations):
        if reached.best.figure <= -BOUND_RESERVE:
            break
    return at(reached.best.parameters)
