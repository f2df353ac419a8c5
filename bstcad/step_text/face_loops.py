"""In which sense do the loops of a face in a STEP file run about the surface's own normal?

Edges are followed as polygons: a spline by its control points, an arc by chords.  That is near enough for a sense.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from bstcad.step_text.entities import Entities

CHORDS = 32  # of a whole turn
HALF = 1e-6  # rad; nearer to a half turn there is no short way
UPRIGHT = 1e-6  # an edge of a wall that goes across by less than this part of what it rises is one of its sides
APART = 1e-6  # of an edge's size; a curve whose ends lie further from its vertices is longer than the edge

Normal = Callable[[np.ndarray], np.ndarray]  # of a surface, at a place on it (3,), of any length


def counterclockwise(entities: Entities, bounds: list[str], surface: str) -> bool | None:
    """Does the outer loop run so about the normal of the surface?  None: no lens has such a surface, or such loops."""
    loops = [_edges(entities, bound) for bound in bounds]
    kind = entities.kind(surface)
    if kind == "PLANE":
        _, normal = entities.placement(entities.names(surface)[0])
        return _positive(_area(loops, normal))
    if kind == "CYLINDRICAL_SURFACE":
        centre, axis = entities.placement(entities.names(surface)[0])
        axis = _unit(axis)
        return _along_the_foot(loops, axis, lambda place: place - centre)
    if kind == "CONICAL_SURFACE":
        centre, axis = entities.placement(entities.names(surface)[0])
        return _unrolled(loops, centre, _unit(axis))
    if kind == "SURFACE_OF_LINEAR_EXTRUSION":
        curve, vector = entities.names(surface)
        axis = _unit(entities.numbers(entities.names(vector)[0]))
        path = _across(_curve(entities, curve), axis)
        return _along_the_foot(loops, axis, lambda place: np.cross(_nearest_leg(path, _across(place, axis)), axis))
    return None


def about_a_ruled_wall(entities: Entities, bounds: list[str], poles: np.ndarray) -> bool | None:
    """The same of a ruled surface of these poles (n, 2, 3), which turns by less than a whole turn.

    ∫ n dA of a surface is half of ∮ x × dx around it; so the loops' is the surface's own, or turned.
    """
    along, across = poles[1:].sum(axis=1) - poles[:-1].sum(axis=1), poles[:, 1] - poles[:, 0]
    own = np.cross(along, across[:-1] + across[1:]).sum(axis=0)
    return _positive(_area([_edges(entities, bound) for bound in bounds], own))


def seen_from_above(entities: Entities, bounds: list[str]) -> bool | None:
    """Does the outer loop of a face that is a height over (x, y) run counterclockwise, seen against z?"""
    return _positive(_area([_edges(entities, bound) for bound in bounds], np.array([0.0, 0.0, 1.0])))


def _positive(value: float) -> bool | None:
    return bool(value > 0) if value and math.isfinite(value) else None


def _edges(entities: Entities, bound: str) -> list[np.ndarray]:
    """The edges of a loop in its order, each as a polygon (n, 3) in the direction in which it is walked."""
    loop = entities.names(bound)[0]
    walked = []
    for oriented in entities.names(loop):
        polygon = _edge(entities, entities.names(oriented)[0])
        walked.append(polygon if entities.forward(oriented) else polygon[::-1])
    return walked if entities.forward(bound) else [polygon[::-1] for polygon in reversed(walked)]


def _edge(entities: Entities, edge: str) -> np.ndarray:
    """(n, 3) from its first vertex to its second."""
    ends, curve = entities.ends(edge), entities.curve(edge)
    forward = entities.forward(edge)
    if entities.kind(curve) == "CIRCLE":
        centre, axis = entities.placement(entities.names(curve)[0])
        return _arc(ends, centre, axis if forward else -axis)
    if entities.kind(curve) in ("B_SPLINE_CURVE_WITH_KNOTS", "COMPLEX"):
        poles = _curve(entities, curve)
        poles = poles if forward else poles[::-1]
        if np.abs(poles[[0, -1]] - ends).max() <= APART * np.ptp(poles, axis=0).max():
            return poles
    return ends


def _curve(entities: Entities, curve: str) -> np.ndarray:
    """(n, 3) along the whole of a curve, in its own direction."""
    kind = entities.kind(curve)
    if kind == "LINE":
        place, vector = entities.names(curve)
        start = entities.points([place])[0]
        return np.stack([start, start + entities.numbers(entities.names(vector)[0])])
    if kind in ("CIRCLE", "ELLIPSE"):
        [frame], radii = entities.names(curve), entities.numbers(curve)
        centre, axis = entities.placement(frame)
        first = entities.numbers(entities.names(frame)[2])
        turn = np.linspace(0, 2 * np.pi, CHORDS + 1)[:, None]
        return centre + radii[0] * np.cos(turn) * first + radii[-1] * np.sin(turn) * np.cross(axis, first)
    return entities.points(entities.names(curve))


def _arc(ends: np.ndarray, centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The short way from one place of a circle to another; if none is short, or both are one, round the axis."""
    first, second = ends - centre
    side = np.cross(axis, first)
    turn = math.atan2(second @ side, second @ first)
    if np.array_equal(*ends):
        turn = 2 * math.pi
    elif math.pi - abs(turn) < HALF:
        turn = abs(turn)
    angle = np.linspace(0, turn, math.ceil(CHORDS * abs(turn) / (2 * math.pi)) + 1)[:, None]
    along = first @ axis * axis  # none, of a circle about its own centre
    return centre + along + (first - along) * np.cos(angle) + side * np.sin(angle)


def _area(loops: list[list[np.ndarray]], normal: np.ndarray) -> float:
    """Of the largest loop, seen against a normal; positive if it runs counterclockwise."""
    found = []
    for loop in loops:
        corners = np.concatenate(loop)
        corners = corners - corners[0]
        found.append(float(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0) @ normal) / 2)
    return max(found, key=abs)


def _unrolled(loops: list[list[np.ndarray]], centre: np.ndarray, axis: np.ndarray) -> bool | None:
    """The sense on a cone, whose normal looks away from its axis: of the largest loop, by angle and height."""
    found = []
    for loop in loops:
        places = np.concatenate(loop) - centre
        first, height = _unit(_across(places[0], axis)), places @ axis
        turn = np.unwrap(np.arctan2(places @ np.cross(axis, first), places @ first))
        if abs(turn[-1] - turn[0]) < math.pi:  # else it runs once around the axis, and bounds nothing alone
            found.append(float((turn * np.roll(height, -1) - np.roll(turn, -1) * height).sum()) / 2)
    return _positive(max(found, key=abs, default=0.0))


def _unit(axis: np.ndarray) -> np.ndarray:
    return axis / max(float(np.linalg.norm(axis)), 1e-300)


def _across(places: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Places without what of them lies along an axis."""
    return places - (places @ axis)[..., None] * axis


def _along_the_foot(loops: list[list[np.ndarray]], axis: np.ndarray, normal: Normal) -> bool | None:
    """The sense on a wall along an axis: at its lowest edge, walked along d, the normal of the loop is d x axis.

    normal: the surface's own at a place.
    """
    feet = [edge for loop in loops for edge in loop if _goes_across(edge, axis)]
    if not feet:
        return None
    foot = min(feet, key=lambda edge: float((edge @ axis).mean()))
    places, legs = (foot[:-1] + foot[1:]) / 2, np.diff(foot, axis=0)
    some = np.unique(np.linspace(0, len(legs) - 1, CHORDS).round().astype(int))
    return _positive(sum(float(np.cross(legs[k], axis) @ normal(places[k])) for k in some))


def _goes_across(edge: np.ndarray, axis: np.ndarray) -> bool:
    flat = _across(edge, axis)
    return bool(np.linalg.norm(flat - flat[0], axis=1).max() > UPRIGHT * np.ptp(edge @ axis))


def _nearest_leg(path: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The part of a polygon (n, 3) that lies nearest to a place, as a vector."""
    legs = np.diff(path, axis=0)
    share = ((place - path[:-1]) * legs).sum(axis=1) / np.maximum((legs * legs).sum(axis=1), 1e-300)
    nearest = path[:-1] + np.clip(share, 0, 1)[:, None] * legs
    return legs[int(((nearest - place) ** 2).sum(axis=1).argmin())]
