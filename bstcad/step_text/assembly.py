"""The placements that a STEP file states for its solid, each as defined in ISO 10303-42 and -43.

One of three statements makes a shape representation part of another one: a relationship with a transformation (an
assembly states one for each of its parts); a MAPPED_ITEM; or a plain relationship, which keeps the coordinates.  An
ITEM_DEFINED_TRANSFORMATION maps one AXIS2_PLACEMENT_3D to another.  Nested transformations are composed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bstcad.step_text.entities import REAL, Entities, damaged, required
from bstcad.step_text.placement import Placement, compose

MAX_ASSEMBLY_DEPTH = 100  # largest number of representations, each inside the next, that contain a solid
UNIT_SCALE_TOLERANCE = 1e-12  # largest deviation from 1 of a scale that counts as 1
Z_AXIS, X_AXIS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
NAMES = r"(?:'\d*'|\$),(?:'\d*'|\$)"  # pattern of two attributes of an entity, its name and its description
DIRECTION = re.compile(rf"\('\d*',\(({REAL}),({REAL}),({REAL})\)\)")
AXES = re.compile(r"\('\d*',#(\d+),(?:#(\d+)|\$),(?:#(\d+)|\$)\)")
OPERATOR = re.compile(rf"\((?:'\d*',)?{NAMES},(?:#(\d+)|\$),(?:#(\d+)|\$),#(\d+),({REAL}|\$),(?:#(\d+)|\$)\)")
ITEMS = re.compile(r"(?:^|(?<!\w)REPRESENTATION)\((?:'\d*'|\$),\(([#\d,]*)\),#\d+\)")
RELATED = re.compile(rf"(?:^|(?<!\w)REPRESENTATION_RELATIONSHIP)\({NAMES},#(\d+),#(\d+)\)")
TRANSFORMED = re.compile(r"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION\(#(\d+)\)")


@dataclass(frozen=True)
class Link:
    """The relation of a representation to another one, its parent, which contains it."""

    parent: str  # number of the containing representation
    placement: Placement | None  # placement in the parent; None: the coordinates are those of the parent


def placement_of(solid: str, entities: Entities) -> Placement:
    """Return the placement in the file of a solid (its number); ValueError if the file places it more than once."""
    homes, links = _representations_and_links(solid, entities)
    paths = [path for home in homes[:1] for path in _paths(home, links, frozenset())]
    if len(paths) > 1:
        raise ValueError("the file places its lens more than once; export a single lens")
    return compose(paths[0] if paths else [])


def products_of(solid: str, entities: Entities) -> set[str]:
    """Return the numbers of the product definitions whose own shape is this solid, without assemblies around it."""
    homes, links = _representations_and_links(solid, entities)
    own = {name for home in homes[:1] for name in _equal_representations(home, links)}
    return {product for product, shapes in _shapes(entities).items() if not own.isdisjoint(shapes)}


def _representations_and_links(solid: str, entities: Entities) -> tuple[list[str], dict[str, list[Link]]]:
    """Return the representations that list a solid among their items, and the links of each one to others."""
    items = dict(_items(entities))
    links: dict[str, list[Link]] = {name: [] for name in items}
    for name, link in _links(items, entities):
        links.setdefault(name, []).append(link)
    return [name for name, inside in items.items() if solid in inside], links


def _paths(home: str, links: dict[str, list[Link]], seen: frozenset[str]) -> list[list[Placement]]:
    """Return at most two paths (placements, outermost first) up from `home` to the last parent; seen: those below."""
    same = _equal_representations(home, links)
    if not same.isdisjoint(seen):
        raise damaged(f"representation #{home} is part of itself")
    if len(seen) > MAX_ASSEMBLY_DEPTH:
        raise ValueError(f"its assembly has more than {MAX_ASSEMBLY_DEPTH} levels; export the lens alone")
    around = [link for name in sorted(same) for link in links.get(name, [])]
    up = [(link.parent, link.placement) for link in around if link.placement is not None]
    paths: list[list[Placement]] = [] if up else [[]]
    for parent, placement in up:
        paths += [[*path, placement] for path in _paths(parent, links, seen | same)]
        if len(paths) > 1:
            break
    return paths


def _equal_representations(home: str, links: dict[str, list[Link]]) -> set[str]:
    """Return the representations with the same coordinates as representation `home`, which is included."""
    found, left = {home}, [home]
    while left:
        equal = {link.parent for link in links.get(left.pop(), []) if link.placement is None} - found
        found |= equal
        left += equal
    return found


def _items(entities: Entities) -> Iterator[tuple[str, list[str]]]:
    for name, (kind, body) in entities.bodies.items():
        if kind.endswith("SHAPE_REPRESENTATION") or (kind == "COMPLEX" and "SHAPE_REPRESENTATION(" in body):
            hit = ITEMS.search(body)
            yield name, re.findall(r"\d+", hit[1]) if hit else []


def _links(items: dict[str, list[str]], entities: Entities) -> Iterator[tuple[str, Link]]:
    """Yield (representation, link) for each representation that is part of another one."""
    components = dict(_components(entities))
    for relation, (kind, body) in entities.bodies.items():
        plain = kind == "SHAPE_REPRESENTATION_RELATIONSHIP"
        if not plain and not (kind == "COMPLEX" and "SHAPE_REPRESENTATION_RELATIONSHIP(" in body):
            continue
        first, second = required(RELATED.search(body)).groups()
        transformed = TRANSFORMED.search(body)
        if transformed is None:
            yield first, Link(second, None)
            yield second, Link(first, None)
            continue
        placement = _transformation(transformed[1], items.get(first, []), items.get(second, []), entities)
        component = components.get(relation, set())  # the part, which the relationship may name first or second
        if second in component and first not in component:
            yield second, Link(first, placement.inverse)
        else:
            yield first, Link(second, placement)
    for name, inside in items.items():
        for item in inside:
            if entities.bodies.get(item, ("",))[0] == "MAPPED_ITEM":
                source, target = _pair(item, entities)
                origin, mapped = _pair(source, entities)
                yield mapped, Link(name, _frame(target, entities).after(_frame(origin, entities).inverse))


def _components(entities: Entities) -> Iterator[tuple[str, set[str]]]:
    """Yield (relationship, representations of the part) for each part of an assembly."""
    shapes = _shapes(entities)
    for context in entities.of("CONTEXT_DEPENDENT_SHAPE_REPRESENTATION"):
        relation, shape = _pair(context, entities)
        usage = entities.references(shape)[:1]
        related = entities.references(usage[0])[1:2] if usage else []  # relating, related
        yield relation, shapes.get(related[0], set()) if related else set()


def _shapes(entities: Entities) -> dict[str, set[str]]:
    shapes: dict[str, set[str]] = {}
    for definition in entities.of("SHAPE_DEFINITION_REPRESENTATION"):
        shape, representation = _pair(definition, entities)
        for product in entities.references(shape)[:1]:
            shapes.setdefault(product, set()).add(representation)
    return shapes


def _transformation(name: str, first: list[str], second: list[str], entities: Entities) -> Placement:
    """Return the placement by transformation `name` of a representation with items `first` in one with `second`."""
    if entities.bodies[name][0] != "ITEM_DEFINED_TRANSFORMATION":
        return _frame(name, entities)
    origin, target = _pair(name, entities)
    if not (origin in first and target in second) and target in first and origin in second:
        origin, target = target, origin
    return _frame(target, entities).after(_frame(origin, entities).inverse)


def _frame(name: str, entities: Entities) -> Placement:
    kind, body = entities.bodies[name]
    try:
        if kind == "AXIS2_PLACEMENT_3D":
            location, axis, reference = required(AXES.fullmatch(body)).groups()
            return _axes(location, axis, reference, entities)
        if kind == "CARTESIAN_TRANSFORMATION_OPERATOR_3D":
            first, second, location, scale, third = required(OPERATOR.fullmatch(body)).groups()
            if scale not in (None, "$") and not abs(float(scale) - 1) <= UNIT_SCALE_TOLERANCE:
                raise ValueError(f"it scales the lens by {float(scale):.6g}")
            found = _axes(location, third, first, entities)
            if second and not _direction(second, entities) @ found.rotation[:, 1] > 0:
                raise ValueError("it mirrors the lens")
            return found
    except ValueError as error:
        raise ValueError(f"#{name} = {kind}: {error}; export the lens without this placement") from error
    raise ValueError(f"#{name} = {kind} is a placement of an unknown kind; export the lens without it")


def _axes(location: str, axis: str | None, reference: str | None, entities: Entities) -> Placement:
    """Return the placement at entity `location`, z along `axis`, x along `reference`; None: along the parent's axis.

    A z direction other than +z needs an x direction: ISO 10303-42 projects the x axis, some readers choose another.
    """
    z = Z_AXIS if axis is None else _direction(axis, entities)
    if reference is None and (z[0] or z[1] or not z[2] > 0):
        raise ValueError("it has no reference direction, and STEP readers assume different ones")
    x = X_AXIS if reference is None else _direction(reference, entities)
    return Placement.of_axes(entities.points(np.array([location], dtype=np.int64))[0], z, x)


def _pair(name: str, entities: Entities) -> list[str]:
    """Return the numbers of the two entities to which an entity refers; ValueError if it refers to fewer or more."""
    found = entities.references(name)
    if len(found) != 2:
        raise damaged(f"statement #{name} = {entities.bodies[name][0]} refers to {len(found)} entities, not to two")
    return found


def _direction(name: str, entities: Entities) -> np.ndarray:
    return np.array(required(DIRECTION.fullmatch(entities.bodies[name][1])).groups(), dtype=np.float64)
