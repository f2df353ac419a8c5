"""The placements that a STEP file states for its solid, each as ISO 10303-42 and -43 define it.

A shape representation takes part in another one in three ways: by a relationship with an ITEM_DEFINED_TRANSFORMATION,
which an assembly states for each of its parts; by a MAPPED_ITEM; or by a plain relationship, by which both have the
same coordinates.  The transformation takes one AXIS2_PLACEMENT_3D to another.  Nested ones follow each other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bstcad.step_text.entities import REAL, Entities, damaged
from bstcad.step_text.placement import Placement, composed

DEEPEST = 100  # representations on the way from a part to the whole
SAME_SIZE = 1e-12  # largest departure of a scale from 1 that leaves the lens as it is
Z, X = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
NAMES = r"(?:'\d*'|\$),(?:'\d*'|\$)"  # name and description of an entity
DIRECTION = re.compile(rf"\('\d*',\(({REAL}),({REAL}),({REAL})\)\)")
AXES = re.compile(r"\('\d*',#(\d+),(?:#(\d+)|\$),(?:#(\d+)|\$)\)")
OPERATOR = re.compile(rf"\((?:'\d*',)?{NAMES},(?:#(\d+)|\$),(?:#(\d+)|\$),#(\d+),({REAL}|\$),(?:#(\d+)|\$)\)")
ITEMS = re.compile(r"(?:^|(?<!\w)REPRESENTATION)\((?:'\d*'|\$),\(([#\d,]*)\),#\d+\)")
RELATED = re.compile(rf"(?:^|(?<!\w)REPRESENTATION_RELATIONSHIP)\({NAMES},#(\d+),#(\d+)\)")
WITH = re.compile(r"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION\(#(\d+)\)")


@dataclass(frozen=True)
class Step:
    """One representation in another."""

    into: str  # the other one
    placement: Placement | None  # None: both have the same coordinates


def placement_of(solid: str, entities: Entities) -> Placement:
    """The placement of a solid in the file; ValueError if the file places it not exactly once."""
    homes, steps = _home(solid, entities)
    ways = [way for home in homes[:1] for way in _ways(home, steps, frozenset())]
    if len(ways) > 1:
        raise ValueError("the file places its lens more than once; export one alone")
    return composed(ways[0] if ways else [])


def products_of(solid: str, entities: Entities) -> set[str]:
    """The product definitions whose own shape a solid is, not those of assemblies that it is a part of."""
    homes, steps = _home(solid, entities)
    own = {name for home in homes[:1] for name in _same(home, steps)}
    return {product for product, shapes in _shapes(entities).items() if not own.isdisjoint(shapes)}


def _home(solid: str, entities: Entities) -> tuple[list[str], dict[str, list[Step]]]:
    """The representations that hold a solid, and each representation's steps into others."""
    items = dict(_items(entities))
    steps: dict[str, list[Step]] = {name: [] for name in items}
    for name, step in _steps(items, entities):
        steps.setdefault(name, []).append(step)
    return [name for name, inside in items.items() if solid in inside], steps


def _ways(home: str, steps: dict[str, list[Step]], seen: frozenset[str]) -> list[list[Placement]]:
    """The placements on each way from a representation up to one that is in no other, the outermost first.

    Of several ways the first two or three.
    """
    same = _same(home, steps)
    if not same.isdisjoint(seen):
        raise damaged(f"representation #{home} is part of itself")
    if len(seen) > DEEPEST:
        raise ValueError(f"its assembly is nested over {DEEPEST} deep; export the lens alone")
    up = [step for name in sorted(same) for step in steps.get(name, []) if step.placement is not None]
    ways: list[list[Placement]] = [] if up else [[]]
    for step in up:
        ways += [[*way, step.placement] for way in _ways(step.into, steps, seen | same)]
        if len(ways) > 1:
            break
    return ways


def _same(home: str, steps: dict[str, list[Step]]) -> set[str]:
    """The representations that have the coordinates of this one, itself among them."""
    found, left = {home}, [home]
    while left:
        equal = {step.into for step in steps.get(left.pop(), []) if step.placement is None} - found
        found |= equal
        left += equal
    return found


def _items(entities: Entities) -> Iterator[tuple[str, list[str]]]:
    """The items of each shape representation."""
    for name, (kind, body) in entities.bodies.items():
        if kind.endswith("SHAPE_REPRESENTATION") or (kind == "COMPLEX" and "SHAPE_REPRESENTATION(" in body):
            hit = ITEMS.search(body)
            yield name, re.findall(r"\d+", hit[1]) if hit else []


def _steps(items: dict[str, list[str]], entities: Entities) -> Iterator[tuple[str, Step]]:
    """Each representation that takes part in another, and how."""
    components = dict(_components(entities))
    for relation, (kind, body) in entities.bodies.items():
        plain = kind == "SHAPE_REPRESENTATION_RELATIONSHIP"
        if not plain and not (kind == "COMPLEX" and "SHAPE_REPRESENTATION_RELATIONSHIP(" in body):
            continue
        first, second = RELATED.search(body).groups()
        transformed = WITH.search(body)
        if transformed is None:
            yield first, Step(second, None)
            yield second, Step(first, None)
            continue
        placement = _transformation(transformed[1], items.get(first, []), items.get(second, []), entities)
        component = components.get(relation, set())  # the part, which the relationship may name first or second
        if second in component and first not in component:
            yield second, Step(first, placement.inverse)
        else:
            yield first, Step(second, placement)
    for name, inside in items.items():
        for item in inside:
            if entities.bodies.get(item, ("",))[0] == "MAPPED_ITEM":
                source, target = _pair(item, entities)
                origin, mapped = _pair(source, entities)
                yield mapped, Step(name, _frame(target, entities).after(_frame(origin, entities).inverse))


def _components(entities: Entities) -> Iterator[tuple[str, set[str]]]:
    """The relationship of each assembly's part, and the representations of that part."""
    shapes = _shapes(entities)
    for context in entities.of("CONTEXT_DEPENDENT_SHAPE_REPRESENTATION"):
        relation, shape = _pair(context, entities)
        usage = entities.references(shape)[:1]
        related = entities.references(usage[0])[1:2] if usage else []  # relating, related
        yield relation, shapes.get(related[0], set()) if related else set()


def _shapes(entities: Entities) -> dict[str, set[str]]:
    """The shape representations of each product definition."""
    shapes: dict[str, set[str]] = {}
    for definition in entities.of("SHAPE_DEFINITION_REPRESENTATION"):
        shape, representation = _pair(definition, entities)
        for product in entities.references(shape)[:1]:
            shapes.setdefault(product, set()).add(representation)
    return shapes


def _transformation(name: str, first: list[str], second: list[str], entities: Entities) -> Placement:
    """The placement from one representation to another; first, second: the items of the two."""
    if entities.bodies[name][0] != "ITEM_DEFINED_TRANSFORMATION":
        return _frame(name, entities)
    origin, target = _pair(name, entities)
    if not (origin in first and target in second) and target in first and origin in second:
        origin, target = target, origin
    return _frame(target, entities).after(_frame(origin, entities).inverse)


def _frame(name: str, entities: Entities) -> Placement:
    """The frame that an AXIS2_PLACEMENT_3D or a CARTESIAN_TRANSFORMATION_OPERATOR_3D is."""
    kind, body = entities.bodies[name]
    try:
        if kind == "AXIS2_PLACEMENT_3D":
            location, axis, reference = AXES.fullmatch(body).groups()
            return _axes(location, axis, reference, entities)
        if kind == "CARTESIAN_TRANSFORMATION_OPERATOR_3D":
            first, second, location, scale, third = OPERATOR.fullmatch(body).groups()
            if scale not in (None, "$") and not abs(float(scale) - 1) <= SAME_SIZE:
                raise ValueError(f"it scales the lens by {float(scale):.6g}")
            found = _axes(location, third, first, entities)
            if second and not _direction(second, entities) @ found.rotation[:, 1] > 0:
                raise ValueError("it mirrors the lens")
            return found
    except ValueError as error:
        raise ValueError(f"#{name} = {kind}: {error}; export the lens without this placement") from error
    raise ValueError(f"#{name} = {kind} places the lens, and bstcad does not read it; export the lens without it")


def _axes(location: str, axis: str | None, reference: str | None, entities: Entities) -> Placement:
    """A frame by its origin, z and x, either of which may be absent: then they are those of the representation.

    An absent x of a tilted z is refused: ISO 10303-42 projects the x axis, other readers take another one.
    """
    z = Z if axis is None else _direction(axis, entities)
    if reference is None and (z[0] or z[1] or not z[2] > 0):
        raise ValueError("it has no reference direction, and readers of STEP differ in the one that they assume")
    x = X if reference is None else _direction(reference, entities)
    return Placement.of_axes(entities.points(np.array([location], dtype=np.int64))[0], z, x)


def _pair(name: str, entities: Entities) -> list[str]:
    """The two entities that an entity refers to."""
    found = entities.references(name)
    if len(found) != 2:
        raise damaged(f"statement #{name} = {entities.bodies[name][0]} refers to {len(found)} entities, not to two")
    return found


def _direction(name: str, entities: Entities) -> np.ndarray:
    return np.array(DIRECTION.fullmatch(entities.bodies[name][1]).groups(), dtype=np.float64)
