"""Bounds (scene/blank.py) that the tailored faces keep to, and the room that they leave to each other.

A back that would come too near to the front, or cross it, is moved along +z as a whole: the slopes of a face make the
picture, its height hardly does, and the rounds of stage 1 take the change into account.  A front that is tailored makes
the picture together with the glass behind it: there the least thickness is a bound of the faces like the others
(clearance.py), even where the scene has none, and the back is moved only where bending both faces does not do.

Stage 2 adds to its merit the mean of the squared excess over the bounds, on a grid of knot spans four times finer than
the net.  Few spans reach a bound, and a difference of control points tells which; the others cost nothing.  The excess
that is left then is taken away by the same penalty alone, which hardly changes the picture (`kept`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
from bstcad.optics.lens import Face, Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.sampling import rim
from bstcad.scene.blank import Bounds
from bstcad.scene.errors import SceneError
from bstcad.tailoring.clearance import MARGIN, RIM, clearance
from bstcad.tailoring.merit import SobolevVariable
from bstcad.tailoring.minimise import lbfgs, minimise

PLACES = 513  # points each way at which the thickness is looked at
RELIEF_SPARE = 0.02  # of the relief of the back, which stage 2 may still take
BOUNDED = "bounds on the back"  # name of a part of a design
SPARE = 1e-3  # of a bound, kept for the digits of a file and for places in between
# Of the mean squared excess, relative to the bound, beside RRMSD²: in a stage's last round, the one before and so on,
# and in its only one.  (A heavy one from the start holds the search to where it began: the small lens of the tests,
# bound to 50 mm where it would take 20, ends at 0.015 by 1000 throughout, and at 0.0033 by 10.)
WEIGHTS, ALONE = (1000.0, 100.0, 10.0), 100.0
REPAIR = 100  # evaluations of the penalty alone, at most
HALVINGS = 10  # of the way from a lens that exceeds the bounds to a lens that keeps to them


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


def held(lens: Lens, asked: Bounds | None, least: float) -> Bounds | None:
    """The bounds that the tailored faces of a lens keep to: those asked for; None: there are none.

    Where the front is tailored, `least` mm of glass is a bound even if none is asked for.
    """
    return Bounds(thinnest=least) if asked is None and lens.shapes("front") else asked


@dataclass(frozen=True)
class Excess:
    """The excess of the tailored faces of a lens over bounds."""

    mean_square: float  # over the places of each face, relative to the bounds and from MARGIN before them on
    gradients: tuple[Tensor, ...]  # of that in the heights (1/mm), (m, n) of each of Lens.nets
    worst: float  # largest excess, relative to its bound; negative: there is none


def excess(lens: Lens, bounds: Bounds) -> Excess:
    """The excess of curvature, slope and thickness everywhere inside the outline; other faces stay as they are.

    E = Σ_f mean max(q_f / b_f - 1 + MARGIN, 0)² over the tailored faces f and the bounds b_f > 0 on their quantities
    q_f, plus that of the thickness.  A tool comes to the back from +z, where a valley of radius R is a curvature
    κ = 1 / R of z.  It comes to the front from -z and sees the heights -z, whose curvatures are those of z with the
    other sign: there a valley, which bulges into the glass, is a ridge of z, κ = -1 / R.  A slope |∇z| is the same
    from both sides.

    The sums go in fixed parts: no bit depends on the number of threads.
    """
    nets = {k: net.to(torch.float64) for k, net in zip(lens.freeform, lens.nets, strict=True)}
    square, worst = 0.0, -MARGIN
    gradients = {k: net.heights.new_zeros(()).expand_as(net.heights) for k, net in nets.items()}  # of no memory
    for squared, own, far in _parts(lens, nets, bounds):
        square, worst = square + squared, max(worst, far)
        gradients |= {k: gradients[k] + own[k] for k in own.keys() & nets.keys()}
    heights = (net.heights for net in lens.nets)
    given = tuple(g.to(h) for g, h in zip(gradients.values(), heights, strict=True))  # in the precision of the lens
    return Excess(square, given, worst)


Part = tuple[float, dict[int, Tensor], float]  # mean square, gradients by the number of the face, worst


def _parts(lens: Lens, nets: dict[int, BSplineSurface], bounds: Bounds) -> Iterator[Part]:
    """The excess of the shape of each tailored face, then that of the thickness; nets: in float64, by their numbers."""
    if (bounds.concave, bounds.convex, bounds.slope) != (None, None, None):
        for k, from_above in _from_above(lens, bounds).items():
            squared, gradient, worst = _of_shape(nets[k], lens.outline, from_above)
            yield squared, {k: gradient}, worst
    if lens.shapes("front"):
        yield clearance(lens.to(torch.float64), bounds)
    elif bounds.thickest is not None and (back := lens.number_of("back")) in nets:
        squared, gradient, worst = _of_thickness(lens.with_back(nets[back]), bounds)
        yield squared, {back: gradient}, worst


def _from_above(lens: Lens, bounds: Bounds) -> dict[int, Bounds]:
    """The bounds on z(x, y) as seen from +z of each tailored face of the solid, by its number."""
    front = replace(bounds, concave=bounds.convex, convex=bounds.concave)
    faces: dict[Face, Bounds] = {"back": bounds, "front": front}
    return {lens.number_of(face): own for face, own in faces.items() if lens.shapes(face)}


def _of_shape(net: BSplineSurface, outline: Outline, bounds: Bounds) -> tuple[float, Tensor, float]:
    """(mean square, gradient, worst) of curvature and slope of a face beyond its bounds."""
    square, worst, gradient = 0.0, -MARGIN, torch.zeros_like(net.heights)
    for spans, reached, bound, quantity in _near(net, outline, bounds):
        leaf = spans.heights.detach().requires_grad_()
        relative = torch.where(reached, quantity(replace(spans, heights=leaf).jet(QUARTERS)) / bound - 1, -MARGIN)
        squared = total(torch.relu(relative + MARGIN) ** 2)
        gradient += spans.scattered(*torch.autograd.grad(squared, leaf))
        square, worst = square + float(squared.detach()), max(worst, float(relative.detach().max()))
    count = math.prod(len(QUARTERS) * (points - 2) for points in net.shape)
    return square / count, gradient / count, worst


def _near(
    net: BSplineSurface, outline: Outline, bounds: Bounds
) -> Iterator[tuple[Spans, Tensor, float, Callable[[Jet], Tensor]]]:
    """Spans that may come near a bound, some at a time: which places the outline holds, the bound, its quantity."""
    for bound, most, quantity in (
        (bounds.concave, partial(curvature_bounds, net, 1.0), lambda jet: jet.curvatures[0]),
        (bounds.convex, partial(curvature_bounds, net, -1.0), lambda jet: -jet.curvatures[1]),
        (bounds.slope, partial(slope_bounds, net), lambda jet: jet.slope),
    ):
        if bound is None:
            continue
        near = torch.nonzero(most() > (1 - MARGIN) * bound)
        for i, j in (part.T for part in near.split(SPANS) if len(part)):
            yield Spans.of(net, i, j), reached_by(net, outline, i=i, j=j, s=QUARTERS), bound, quantity


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
    """The lens with its tailored faces bent and its back moved as little as it takes to keep to the bounds everywhere.

    By the penalty alone, in the variables of stage 2; if REPAIR evaluations do not suffice, by faces with less relief.
    Where the front is tailored, the back is moved only if bending both faces does not do: that changes the picture.
    SceneError if even a flat back exceeds a bound.
    """
    for place in (_as_it_is, _placed) if lens.shapes("front") else (_placed,):
        lens = place(lens, bounds)
        if not _exceeds(lens, bounds):
            return lens
        bent = place(_bent(lens, bounds), bounds)
        if not _exceeds(bent, bounds):
            return _nearest(lens, bent, bounds, place)
        lens = bent
    flat = _placed(_flat(lens, bounds), bounds)
    if _exceeds(flat, bounds):
        raise SceneError(
            "lens.max_thickness: with this front not even a flat back keeps to it and to lens.edge_thickness; "
            "allow more, or ask for less at the edge"
        )
    return _nearest(lens, flat, bounds, _placed)


def _nearest(wanted: Lens, known: Lens, bounds: Bounds, place: Callable[[Lens, Bounds], Lens]) -> Lens:
    """The lens nearest to `wanted`, which exceeds the bounds, on the way to `known`, which keeps to them."""
    start = _heights(wanted)
    ways = [there - here for there, here in zip(_heights(known), start, strict=True)]
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        share = (low + high) / 2
        tried = place(wanted.with_heights(h + share * way for h, way in zip(start, ways, strict=True)), bounds)
        if _exceeds(tried, bounds):
            low = share
        else:
            high, known = share, tried
    return known


def _heights(lens: Lens) -> list[Tensor]:
    return [net.heights for net in lens.nets]


def _flat(lens: Lens, bounds: Bounds) -> Lens:
    """The lens with its tailored faces flat."""
    faces, nets = _from_above(lens, bounds), zip(lens.freeform, _heights(lens), strict=True)
    return lens.with_heights(torch.zeros_like(h) if k in faces else h for k, h in nets)


def _as_it_is(lens: Lens, bounds: Bounds) -> Lens:
    return lens


def _placed(lens: Lens, bounds: Bounds) -> Lens:
    return moved_clear(lens, lens.back.z, bounds.thinnest, bounds)


def _exceeds(lens: Lens, bounds: Bounds) -> bool:
    return excess(lens, bounds).worst > -SPARE


def _bent(lens: Lens, bounds: Bounds) -> Lens:
    """The first lens of the penalty's search that exceeds no bound, or else the one that exceeds them least."""
    start = _heights(lens)
    variables = [SobolevVariable.of(net, torch.ones_like(net.heights)) for net in lens.nets]

    def at(c: Sequence[Tensor]) -> Lens:
        return lens.with_heights(h + v.heights(p.detach()) for h, v, p in zip(start, variables, c, strict=True))

    def in_c(parameters: list[Tensor]) -> tuple[float, list[Tensor], float]:
        over = excess(at(parameters), bounds)
        gradients = [v.adjoint(g) for v, g in zip(variables, over.gradients, strict=True)]
        return over.mean_square, gradients, over.worst

    for reached in minimise(in_c, lbfgs([v.zero() for v in variables], REPAIR), REPAIR):
        if reached.best.figure <= -SPARE:
            break
    return at(reached.best.parameters)
