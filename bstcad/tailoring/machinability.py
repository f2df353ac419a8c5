"""Bounds on the back (scene/blank.py) that it keeps to while it is tailored, and the room that it leaves to the front.

A back that would come too near to the front, or cross it, is moved along +z as a whole: the slopes of a face make the
picture, its height hardly does, and the rounds of stage 1 take the change into account.

Stage 2 adds to its merit the mean of the squared excess over the bounds, on a grid of knot spans four times finer than
the net.  Few spans reach a bound, and a difference of control points tells which; the others cost nothing.  The excess
that is left then is taken away by the same penalty alone, which hardly changes the picture (`kept`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bstcad.optics.bspline import (
    QUARTERS,
    SPANS,
    BSplineSurface,
    Jet,
    Spans,
    curvature_bounds,
    reached_by,
    slope_bounds,
)
from bstcad.optics.kernels.reductions import total
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.sampling import rim
from bstcad.scene.blank import Bounds
from bstcad.scene.errors import SceneError
from bstcad.tailoring.merit import SobolevVariable
from bstcad.tailoring.minimise import lbfgs, minimise

PLACES = 513  # points each way at which the thickness is looked at
RIM = 1025  # times four: points along the rim
RELIEF_SPARE = 0.02  # of the relief of the back, which stage 2 may still take
BOUNDED, UNBOUNDED = "bounds on the back", "the same without bounds"  # names of parts of a design
MARGIN = 0.01  # of a bound, by which the penalty begins before it
SPARE = 1e-3  # of a bound, kept for the digits of a file and for places in between
# Of the mean squared excess, relative to the bound, beside RRMSD²: in a stage's last round, the one before and so on,
# and in its only one.  (A heavy one from the start holds the search to where it began: the small lens of the tests,
# bound to 50 mm where it would take 20, ends at 0.015 by 1000 throughout, and at 0.0033 by 10.)
WEIGHTS, ALONE = (1000.0, 100.0, 10.0), 100.0
REPAIR = 100  # evaluations of the penalty alone, at most
HALVINGS = 10  # of the way from a back that exceeds the bounds to a back that keeps to them


@torch.no_grad()
def moved_clear(lens: Lens, z: float, least: float, bounds: Bounds | None = None) -> Lens:
    """The lens with its back's plane at `z` (mm), or as little behind it as leaves `least` mm of glass everywhere.

    With bounds, the rim's least thickness and the greatest thickness anywhere hold, too; where they exclude each other
    the back exceeds both by the same length.
    """
    x, y = thickness_places(lens)
    relative = lens.back.relative_sag_and_slope(x, y)[0]
    glass = z - lens.front.z + relative - lens.front.relative_sag_and_slope(x, y)[0]
    relief = float(relative.max() - relative.min())
    if bounds is None:
        thinnest = float(glass.min())
        if thinnest < least:
            z += least - thinnest + RELIEF_SPARE * relief
        return lens.with_back(lens.back.moved(z))
    x, y = on_rim(lens)
    edge = z + lens.back.relative_sag_and_slope(x, y)[0] - lens.front.sag_and_slope(x, y)[0]
    short = max(least, bounds.thinnest or least) - float(torch.minimum(glass.min(), edge.min()))
    if bounds.edge is not None:
        short = max(short, bounds.edge - float(edge.min()))
    room = math.inf if bounds.thickest is None else bounds.thickest - float(torch.maximum(glass.max(), edge.max()))
    spare = min(RELIEF_SPARE * relief, max(room - short, 0.0) / 2)
    shift = max(short + spare, 0.0) + min(room - spare, 0.0) if short <= room else (short + room) / 2
    return lens.with_back(lens.back.moved(z + shift))


def thickness_places(lens: Lens) -> tuple[Tensor, Tensor]:
    """Points inside the outline (mm) at which the thickness is looked at."""
    x, y = torch.meshgrid(
        *(torch.linspace(-half, half, PLACES, dtype=torch.float64) for half in lens.outline.half_extent), indexing="ij"
    )
    inside = lens.outline.contains(x, y)
    return tuple(p[inside].to(lens.like) for p in (x, y))


def on_rim(lens: Lens) -> tuple[Tensor, Tensor]:
    """Points along the rim (mm) at which the thickness is looked at."""
    return tuple(p.to(lens.like) for p in rim(lens.outline, RIM))


def weight(number: int, rounds: int) -> float:
    """Weight of the excess in one of the rounds."""
    return ALONE if rounds == 1 else WEIGHTS[min(rounds - 1 - number, len(WEIGHTS) - 1)]


@dataclass(frozen=True)
class Excess:
    """The excess of a back over bounds."""

    mean_square: float  # over the places, relative to the bounds and from MARGIN before them on
    gradient: Tensor  # (m, n) of that in the heights (1/mm)
    worst: float  # largest excess, relative to its bound; negative: there is none


def excess(lens: Lens, bounds: Bounds) -> Excess:
    """The excess of curvature, slope and thickness everywhere inside the outline; the front stays as it is.

    The sums go in fixed parts: no bit depends on the number of threads.
    """
    back = lens.back.to(torch.float64)
    square, worst, gradient = 0.0, -MARGIN, torch.zeros_like(back.heights)
    for spans, held, bound, quantity in _near(back, lens.outline, bounds):
        leaf = spans.heights.detach().requires_grad_()
        relative = torch.where(held, quantity(replace(spans, heights=leaf).jet(QUARTERS)) / bound - 1, -MARGIN)
        squared = total(torch.relu(relative + MARGIN) ** 2)
        gradient += spans.scattered(*torch.autograd.grad(squared, leaf))
        square, worst = square + float(squared.detach()), max(worst, float(relative.detach().max()))
    count = math.prod(len(QUARTERS) * (points - 2) for points in back.shape)
    square, gradient = square / count, gradient / count
    if bounds.thickest is not None:
        squared, own, thick = _of_thickness(lens.with_back(back), bounds)
        square, gradient, worst = square + squared, gradient + own, max(worst, thick)
    return Excess(square, gradient.to(lens.back.heights), worst)


def _near(
    back: BSplineSurface, outline: Outline, bounds: Bounds
) -> Iterator[tuple[Spans, Tensor, float, Callable[[Jet], Tensor]]]:
    """Spans that may come near a bound, some at a time: which places the outline holds, the bound, its quantity."""
    for bound, most, quantity in (
        (bounds.concave, partial(curvature_bounds, back, 1.0), lambda jet: jet.curvatures[0]),
        (bounds.convex, partial(curvature_bounds, back, -1.0), lambda jet: -jet.curvatures[1]),
        (bounds.slope, partial(slope_bounds, back), lambda jet: jet.slope),
    ):
        if bound is None:
            continue
        near = torch.nonzero(most() > (1 - MARGIN) * bound)
        for i, j in (part.T for part in near.split(SPANS) if len(part)):
            yield Spans.of(back, i, j), reached_by(back, outline, i=i, j=j, s=QUARTERS), bound, quantity


def _of_thickness(lens: Lens, bounds: Bounds) -> tuple[float, Tensor, float]:
    """(mean square, gradient, worst) of the thickness beyond its bounds.

    As parts of the room between them, or of the back's relief where that is less: a shift along z then keeps to both.
    """
    x, y = thickness_places(lens)
    heights = lens.back.relative_sag_and_slope(x, y)[0]
    room = min(bounds.thickest - bounds.thinnest, float(heights.max() - heights.min())) or 1.0
    leaf = lens.back.heights.detach().requires_grad_()
    back, square, worst = replace(lens.back, heights=leaf), 0.0, -MARGIN
    for x, y, least in (
        (*thickness_places(lens), bounds.thinnest),
        (*on_rim(lens), max(bounds.thinnest, bounds.edge or 0.0)),
    ):
        glass = back.sag_and_slope(x, y)[0] - lens.front.sag_and_slope(x, y)[0]
        relative = torch.maximum(glass - bounds.thickest, least - glass) / room
        square = square + total(torch.relu(relative + MARGIN) ** 2) / len(x)
        worst = max(worst, float(relative.detach().max()))
    return float(square.detach()), *torch.autograd.grad(square, leaf), worst


def kept(lens: Lens, bounds: Bounds) -> Lens:
    """The lens with its back moved and bent as little as it takes to keep to the bounds everywhere.

    By the penalty alone, in the variable of stage 2; if REPAIR evaluations do not suffice, by a back with less relief.
    SceneError if even a flat back exceeds a bound.
    """
    lens = _placed(lens, bounds)
    if not _exceeds(lens, bounds):
        return lens
    bent = _placed(_bent(lens, bounds), bounds)
    if not _exceeds(bent, bounds):
        return _nearest(lens, bent, bounds)
    flat = _placed(_with_heights(lens, torch.zeros_like(lens.back.heights)), bounds)
    if _exceeds(flat, bounds):
        raise SceneError(
            "lens.max_thickness: with this front not even a flat back keeps to it and to lens.edge_thickness; "
            "allow more, or ask for less at the edge"
        )
    return _nearest(bent, flat, bounds)


def _nearest(wanted: Lens, known: Lens, bounds: Bounds) -> Lens:
    """The lens nearest to `wanted`, which exceeds the bounds, on the way to `known`, which keeps to them."""
    start, way = wanted.back.heights, known.back.heights - wanted.back.heights
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        share = (low + high) / 2
        tried = _placed(_with_heights(wanted, start + share * way), bounds)
        if _exceeds(tried, bounds):
            low = share
        else:
            high, known = share, tried
    return known


def _with_heights(lens: Lens, heights: Tensor) -> Lens:
    return lens.with_back(lens.back.with_parameters(heights=heights))


def _placed(lens: Lens, bounds: Bounds) -> Lens:
    return moved_clear(lens, lens.back.z, bounds.thinnest, bounds)


def _exceeds(lens: Lens, bounds: Bounds) -> bool:
    return excess(lens, bounds).worst > -SPARE


def _bent(lens: Lens, bounds: Bounds) -> Lens:
    """The first back of the penalty's search that exceeds no bound, or else the back that exceeds them least."""
    back = lens.back
    variable = SobolevVariable.of(back, torch.ones_like(back.heights))

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        over = excess(_with_heights(lens, back.heights + variable.heights(parameters[0].detach())), bounds)
        return over.mean_square, [variable.adjoint(over.gradient)], over.worst

    for reached in minimise(in_c, lbfgs([torch.zeros_like(back.heights)], REPAIR), REPAIR):
        if reached.best.figure <= -SPARE:
            break
    return _with_heights(lens, back.heights + variable.heights(reached.best.parameters[0]))
