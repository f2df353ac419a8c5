"""Reader of the lens in a STEP file (ISO 10303-21), independent of OCC, for a second check of each written file.

It reads the entities that the checks need: control nets, knots and multiplicities of the freeform faces, the product's
name, the units, the number of solids, the uses of each edge, profile tolerances, and the stated area, volume, centroid
and material, by their names in "Recommended Practices for Geometric and Assembly Validation Properties" of the CAx
Interoperability Forum.  Damage to these entities is refused in one sentence.  OCC, in a second process, reads it all.

Matching takes a time proportional to the length of the text: a repeated group ends at a character that it cannot
contain, and the text is split into statements before they are matched.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bstcad.runs import files
from bstcad.runs.files import one_line
from bstcad.step_text import beginning
from bstcad.step_text.assembly import placement_of, products_of
from bstcad.step_text.entities import ENTITY, REAL, Entities, damaged, read_entities, required
from bstcad.step_text.placement import Placement, identity

MAX_BYTES = 600_000_000  # largest file (bytes): 2049 x 2049 control points of 130 bytes each, with references to them
MAX_DEGREE = 25  # largest degree of a spline, as in OCC
CONIC_NET = 9  # number of control points of a conic or a nearly flat sphere; a freeform face has more

REALS = rf"{REAL}(?:,{REAL})*"
COUNTS = r"\d{1,9}(?:,\d{1,9})*"
FLAG = r"\.([TFU])\."
REFERENCES = re.compile(rf"#{ENTITY}(?:,#{ENTITY})*")
RULED = re.compile(r"\d+,1,")  # pattern of the degrees in u and v of a ruled wall, whose degree in v is 1
SURFACE = re.compile(
    rf"(\d{{1,9}}),(\d{{1,9}}),\(\((.*?)\)\),\.\w+\.,{FLAG},{FLAG},{FLAG},"
    rf"\(({COUNTS})\),\(({COUNTS})\),\(({REALS})\),\(({REALS})\),\.\w+\.\)"
)
KNOT_SPECIFICATION = re.compile(r"\.\w+\.\)")  # last attribute of a B_SPLINE_SURFACE_WITH_KNOTS
VALIDATION, MATERIAL = "geometric validation property", "material property"  # names of two kinds of properties
PREFIXES = {"$": 1.0, ".MICRO.": 1e-6, ".MILLI.": 1e-3, ".CENTI.": 1e-2, ".DECI.": 1e-1, ".KILO.": 1e3}
UNITS = {"METRE": 1e3, "GRAM": 1.0}  # SI units in mm and g
PER_CM3 = 1e3  # factor from g/mm³ to g/cm³
UNKNOWN_VALUE = math.nan  # value of a number that cannot be read or has an unknown unit, so that its check fails
NUMBER = r"[-+]?\d+(?:\.\d*(?:E[-+]?\d+)?)?"  # pattern of a number, with or without a decimal point
UNREADABLE = (LookupError, AttributeError, TypeError, ArithmeticError)  # errors of a missing or malformed entity


@dataclass(frozen=True)
class FreeformSurface:
    """A B_SPLINE_SURFACE_WITH_KNOTS as written, or a rational surface, whose weights are then equal."""

    degrees: tuple[int, int]  # degrees in u and v
    control_points: np.ndarray  # control net, (m, n, 3), mm, in the frame of the file, u along the first axis
    knots: tuple[np.ndarray, np.ndarray]  # distinct knots in u and v
    multiplicities: tuple[np.ndarray, np.ndarray]  # multiplicity of each distinct knot
    closed: tuple[bool, bool]  # True if closed in u, True if closed in v
    self_intersecting: bool | None  # None: not stated
    entity: str  # number of the entity in the file

    @property
    def full_knots(self) -> tuple[np.ndarray, np.ndarray]:
        """Full knot vectors in u and v, each knot repeated by its multiplicity."""
        u, v = (np.repeat(k, c) for k, c in zip(self.knots, self.multiplicities, strict=True))
        return u, v


@dataclass(frozen=True)
class ProfileTolerance:
    """A profile tolerance of a surface."""

    width: float  # width of the tolerance zone (mm)
    surface: str  # entity of the toleranced face's surface; "": the reference to the face has an unknown form
    face: str = ""  # name of the toleranced face


@dataclass(frozen=True)
class ValidationProperties:
    """Properties that the file states for a part; each tuple contains one value per statement."""

    areas: tuple[float, ...] = ()  # area of the whole surface (mm²)
    volumes: tuple[float, ...] = ()  # volume (mm³)
    centroids: tuple[tuple[float, float, float], ...] = ()  # centroid (mm), in the frame in which the part is defined
    materials: tuple[str, ...] = ()
    densities: tuple[float, ...] = ()  # density (g/cm³)
    profiles: tuple[ProfileTolerance, ...] = ()

    def moved(self, placement: Placement) -> ValidationProperties:
        """Return the properties of the part after it is moved by a placement."""
        if not placement.moves:
            return self
        moved = (placement(np.array(centroid)).tolist() for centroid in self.centroids)
        return replace(self, centroids=tuple((x, y, z) for x, y, z in moved))

    @property
    def of_shape(self) -> bool:
        """True if the file states area, volume or centroid."""
        return bool(self.areas or self.volumes or self.centroids)


@dataclass(frozen=True)
class StepText:
    """Contents of the STEP file of one lens, all lengths converted to mm."""

    product: str  # name of the product
    unit: str  # unit of length in the file: millimetre, metre, inch …
    angle: str  # unit of angles: radian, degree …
    schema: str  # schema that the header states
    solids: int  # number of MANIFOLD_SOLID_BREP and BREP_WITH_VOIDS
    faces: int  # number of faces
    surface: FreeformSurface  # freeform back; of two nets, the net whose normal u x v points away from the other net
    front: FreeformSurface | None  # freeform front; None: the front is not a net
    edge_uses: dict[int, tuple[int, int]]  # edge -> number of uses (forward, reversed)
    properties: ValidationProperties
    placement: Placement = field(default_factory=identity)  # placement of the solid, as the file states it

    @property
    def closed(self) -> bool:
        """True if every edge is used exactly twice, once in each direction."""
        return bool(self.edge_uses) and all(uses == (1, 1) for uses in self.edge_uses.values())


def read(path: str | Path) -> StepText:
    """Read the STEP file at `path`; ValueError if it is missing, damaged, or has no freeform face or more than two."""
    path = Path(path)
    try:
        data = files.contents(path, MAX_BYTES)
    except ValueError as error:
        raise ValueError(f"{path.name}: cannot be read ({error}); give the path of a STEP file") from error
    try:
        return parse(data)
    except ValueError as error:
        raise ValueError(one_line(f"{path.name}: read as text: {error}")) from error


def read_lens(path: str | Path, any_unit: bool = False) -> StepText:
    """Read a lens of one solid in mm (any_unit: in any unit of length) and radians; ValueError for any other file."""
    text, name = read(path), f"{Path(path).name}: read as text"
    if not any_unit and text.unit != "millimetre":
        raise ValueError(f"{name}: its lengths are in {text.unit}; export it in millimetres")
    if text.angle != "radian":
        raise ValueError(f"{name}: its angles are in {text.angle}; export it in radians")
    if text.solids != 1:
        raise ValueError(f"{name}: it has {text.solids} solids, but a lens is one solid; export the lens alone")
    return text


def parse(text: bytes | str) -> StepText:
    """Parse the text of a STEP file of a lens; ValueError in one sentence if it is not such a file."""
    try:
        return _parse(text.encode("latin-1", "replace") if isinstance(text, str) else text)
    except ValueError as error:
        raise ValueError(one_line(error)) from error
    except UNREADABLE as error:
        fault = f"{error.args[0]} is missing or of another kind" if isinstance(error, KeyError) else "text is malformed"
        raise ValueError(one_line(damaged(f"entity {fault}"))) from error


def _parse(text: bytes) -> StepText:
    if (fault := beginning.fault(text)) is not None:
        raise ValueError(fault)
    if b"END-ISO-10303-21;" not in text[-200:]:
        raise ValueError("the file is truncated (no END-ISO-10303-21 at its end); export or copy it again")
    header, entities = read_entities(text)
    lengths, angles = (_units(kind, entities) for kind in ("LENGTH", "PLANE_ANGLE"))
    if len(lengths) != 1:
        raise ValueError(f"its units of length are {' and '.join(lengths) or 'not stated'}; export it in millimetres")
    ((unit, number),) = lengths.items()
    size = _unit_size(entities, number)  # mm
    if size is None or not 0 < size < math.inf:
        raise ValueError(f"it has lengths in {unit} but does not state the size of this unit; export it in millimetres")
    solids = [*entities.of("MANIFOLD_SOLID_BREP"), *entities.of("BREP_WITH_VOIDS")]
    placement = placement_of(solids[0], entities) if len(solids) == 1 else identity()
    placement = replace(placement, shift=size * placement.shift)
    surface, *fronts = (_in_millimetres(each, placement, size) for each in _freeform_surfaces(entities))
    return StepText(
        product=_product(entities),
        unit=unit,
        angle=", ".join(angles) or "radian",
        schema=_schema(header, entities.strings),
        solids=len(solids),
        faces=len(_shell_faces(entities)),
        surface=surface,
        front=fronts[0] if fronts else None,
        edge_uses=_edge_uses(entities),
        properties=_properties(entities, products_of(solids[0], entities) if placement.moves else set(), size),
        placement=placement,
    )


def _schema(header: str, strings: Sequence[str]) -> str:
    schema = re.search(r"FILE_SCHEMA\(\('(\d*)'", header)
    if schema is None:
        raise ValueError("the header has no FILE_SCHEMA; export the file again")
    return one_line(strings[int(schema[1])])


def _product(entities: Entities) -> str:
    """Return the name of the first PRODUCT, or its part number (id) if it has no name."""
    for number in entities.of("PRODUCT"):
        return entities.string(number, 1) or entities.string(number, 0)
    raise ValueError("the file has no PRODUCT; export it with a product name")


def _units(quantity: str, entities: Entities) -> dict[str, str]:
    """Return the entity numbers, by name, of the units of a quantity, such as LENGTH, that the shapes' contexts use."""
    used = set()
    for body in entities.of("COMPLEX").values():
        for context in re.findall(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\(\(([#\d,]*)\)\)", body):
            used.update(re.findall(r"\d+", context))
    bodies = {number: entities.bodies[number][1] for number in used}
    named = {_unit_name(body, entities): each for each, body in bodies.items() if f"{quantity}_UNIT()" in body}
    return dict(sorted(named.items()))


def _unit_name(body: str, entities: Entities) -> str:
    if "CONVERSION_BASED_UNIT" in body:  # such as an inch
        index = required(re.search(r"CONVERSION_BASED_UNIT\('(\d+)'", body))[1]
        name = one_line(entities.strings[int(index)].lower()[:40])
        return f"{name} with a conversion factor" if "metre" in name or "radian" in name else name
    if body.count("SI_UNIT(") != 1:
        raise damaged("a unit is not based on one SI_UNIT")
    prefix, unit = required(re.search(r"SI_UNIT\((\.\w+\.|\$),\.(\w+)\.\)", body)).groups()
    return (prefix.strip(".$") + unit).lower()[:40]


# ---- topology ------------------------------------------------------------------------------------------------------


def _edge_uses(entities: Entities) -> dict[int, tuple[int, int]]:
    """Return how often (forwards, backwards) the loops of the faces use each EDGE_CURVE, by its number."""
    edges = {name: [0, 0] for name in entities.of("EDGE_CURVE")}
    oriented = _flagged_references("ORIENTED_EDGE", r"\('\d*',\*,\*,", entities)
    loops = _reference_lists("EDGE_LOOP", entities)
    bounds, outer = (_flagged_references(kind, r"\('\d*',", entities) for kind in ("FACE_BOUND", "FACE_OUTER_BOUND"))
    bounds |= outer
    for face in _shell_faces(entities):
        for bound in face:
            loop, flag = bounds[bound]
            for name in loops[loop]:
                edge, forward = oriented[name]
                edges[edge][forward != flag] += 1  # a reversed bound walks its loop backwards
    return {int(edge): (uses[0], uses[1]) for edge, uses in edges.items()}


def _shell_faces(entities: Entities) -> list[list[str]]:
    """Return the bounds of each face of the closed shells; a face that the shells list twice counts twice."""
    faces = _reference_lists("ADVANCED_FACE", entities)
    return [faces[name] for shell in _reference_lists("CLOSED_SHELL", entities).values() for name in shell]


def _reference_lists(kind: str, entities: Entities) -> dict[str, list[str]]:
    """Return the list of references that follows the name of each entity of a kind, by its number."""
    lists = {name: required(re.match(r"\('\d*',\(([#\d,]*)\)", body)) for name, body in entities.of(kind).items()}
    return {name: re.findall(r"\d+", hit[1]) for name, hit in lists.items()}


def _flagged_references(kind: str, before: str, entities: Entities) -> dict[str, tuple[str, str]]:
    """Return (reference, flag T or F) at the end of each entity of a kind, by number; before: pattern before them."""
    pattern = re.compile(before + r"#(\d+),\.([TF])\.\)")
    flagged = {name: required(pattern.fullmatch(body)) for name, body in entities.of(kind).items()}
    return {name: (hit[1], hit[2]) for name, hit in flagged.items()}


# ---- freeform surfaces ---------------------------------------------------------------------------------------------


def _freeform_surfaces(entities: Entities) -> list[FreeformSurface]:
    """Return the back, then the front if it is a net, in the file's unit, without the placement of the solid."""
    attributes = {n: body.partition("',")[2] for n, body in entities.of("B_SPLINE_SURFACE_WITH_KNOTS").items()}
    bodies = [(number, body) for number, body in attributes.items() if not RULED.match(body)]
    bodies += _rational_surfaces(entities)
    bodies.sort(key=lambda each: each[1].count("#"), reverse=True)
    if not bodies:
        raise ValueError("the file has no B_SPLINE_SURFACE_WITH_KNOTS; give a file written by bstcad")
    large = [each for each in bodies if each[1].count("#") > CONIC_NET]
    if len(large) > 2:
        raise ValueError(f"the file has {len(large)} freeform surfaces, not one or two; export the lens alone")
    surfaces = [_surface(*each, entities) for each in large or bodies[:1]]
    if len(surfaces) > 1:
        (middle, normal), (other, its_normal) = map(_middle_and_normal, surfaces)
        if (normal + its_normal) @ (middle - other) < 0:
            surfaces.reverse()
    return surfaces


def _rational_surfaces(entities: Entities) -> Iterator[tuple[str, str]]:
    """Yield (number, attributes as of a B_SPLINE_SURFACE_WITH_KNOTS) of rational freeform surfaces with equal weights.

    Such a surface is an entity of several kinds, in the order of their names.  Equal weights cancel out; ValueError for
    others.
    """
    for number, body in entities.of("COMPLEX").items():
        net, _, rest = body.partition("B_SPLINE_SURFACE(")[2].partition(")B_SPLINE_SURFACE_WITH_KNOTS(")
        if not rest or RULED.match(net) or net.count("#") <= CONIC_NET:
            continue
        end = required(KNOT_SPECIFICATION.search(rest)).end()
        if "RATIONAL_B_SPLINE_SURFACE(" in rest[end:]:
            text = rest[end:].partition("RATIONAL_B_SPLINE_SURFACE(((")[2].partition("))")[0].replace("),(", ",")
            if not re.fullmatch(REALS, text) or text.count(",") != net.count("#") - 1:
                raise damaged(f"the weights of the surface #{number} are malformed, or not one per control point")
            weights = np.fromstring(text, dtype=np.float64, sep=",")
            low, high = weights.min(), weights.max()
            if not 0 < low == high:
                raise ValueError(
                    f"the freeform surface #{number} is rational with weights from {low:.6g} to {high:.6g}, and a face "
                    "by bstcad has none; give a file written by bstcad"
                )
        yield number, f"{net},{rest[:end]}"


def _middle_and_normal(surface: FreeformSurface) -> tuple[np.ndarray, np.ndarray]:
    """Return the control point (3,) at the centre of a net, and the unit normal (3,) along u x v of its sides."""
    net = surface.control_points
    m, n, _ = net.shape
    normal = np.cross(net[-1, 0] - net[0, 0], net[0, -1] - net[0, 0])
    return net[m // 2, n // 2], normal / max(math.sqrt(normal @ normal), 1e-300)


def _in_millimetres(surface: FreeformSurface, placement: Placement, unit: float) -> FreeformSurface:
    """Return a surface of the file in mm, moved by a placement; unit: the file's unit of length in mm."""
    net = surface.control_points if unit == 1 else unit * surface.control_points
    return replace(surface, control_points=placement(net) if placement.moves else net)


def _surface(entity: str, body: str, entities: Entities) -> FreeformSurface:
    degree_u, degree_v, net, *flags, count_u, count_v, knots_u, knots_v = required(SURFACE.fullmatch(body)).groups()
    numbers, degrees = _net(net), (int(degree_u), int(degree_v))
    counts = [np.array(each.split(","), dtype=np.int64) for each in (count_u, count_v)]
    values = [np.array(each.split(","), dtype=np.float64) for each in (knots_u, knots_v)]
    for count, value, degree, size in zip(counts, values, degrees, numbers.shape, strict=True):
        _check_knots(count, value, size, degree)
    return FreeformSurface(
        degrees=degrees,
        control_points=entities.points(numbers),
        knots=(values[0], values[1]),
        multiplicities=(counts[0], counts[1]),
        closed=(flags[0] == "T", flags[1] == "T"),
        self_intersecting={"T": True, "F": False}.get(flags[2]),
        entity=entity,
    )


def _net(text: str) -> np.ndarray:
    """Return the entity numbers (m, n) of the points of a control net; text: the rows of references to them."""
    lines = text.split("),(")
    if not all(REFERENCES.fullmatch(line) for line in lines):
        raise ValueError("the control net is damaged; export the file again")
    rows = [np.fromstring(line.replace("#", ""), dtype=np.int64, sep=",") for line in lines]
    if len({len(row) for row in rows}) != 1:
        raise ValueError("the control net is not rectangular; export the file again")
    return np.stack(rows)


def _check_knots(counts: np.ndarray, knots: np.ndarray, points: int, degree: int) -> None:
    """Raise ValueError unless knots with multiplicities `counts` define a spline of `points` control points."""
    if not 1 <= degree <= MAX_DEGREE:
        raise damaged(f"a spline has degree {degree}, but 1 to {MAX_DEGREE} are possible")
    rising = np.isfinite(knots).all() and (np.diff(knots) > 0).all()
    if not rising or len(counts) != len(knots) or counts.min() < 1 or counts.sum() != points + degree + 1:
        raise damaged(f"{counts.sum()} knots do not increase, or do not fit {points} control points of degree {degree}")


# ---- stated properties of the part ---------------------------------------------------------------------------------


def _properties(entities: Entities, products: set[str], unit: float) -> ValidationProperties:
    """Return the properties that a file states; a number that cannot be read is UNKNOWN_VALUE.

    unit: the file's unit of length in mm, in which centroids are stated; other measures state their unit.
    products: product definitions of the lens; if empty, properties of all products are read.  Other products, such
    as an assembly, have centroids in frames of their own.
    """
    items: dict[tuple[str, str], list[str]] = {}  # (kind of property, its name) -> first items of its representations
    for body in entities.of("PROPERTY_DEFINITION_REPRESENTATION").values():
        definition, representation = required(re.fullmatch(r"\(#(\d+),#(\d+)\)", body)).groups()
        kind, name = (entities.string(each, 0) for each in (definition, representation))
        if kind == VALIDATION:  # only of the whole part, not of a face or an instance in an assembly
            target = entities.references(definition)[-1]
            of_part = entities.bodies.get(target, ("",))[0] == "PRODUCT_DEFINITION_SHAPE"
            kind = kind if of_part and not (products and products.isdisjoint(entities.references(target))) else ""
        if kind in (VALIDATION, MATERIAL):
            items.setdefault((kind, name), []).extend(entities.references(representation)[:1])

    def measures(kind: str, name: str, measure: str) -> tuple[float, ...]:
        return tuple(_measure(entities, item, measure) for item in items.get((kind, name), []))

    return ValidationProperties(
        areas=measures(VALIDATION, "surface area", "AREA_MEASURE"),
        volumes=measures(VALIDATION, "volume", "VOLUME_MEASURE"),
        centroids=tuple(_centroid(item, entities, unit) for item in items.get((VALIDATION, "centroid"), [])),
        materials=tuple(entities.string(item, 1) for item in items.get((MATERIAL, "material name"), [])),
        densities=tuple(PER_CM3 * value for value in measures(MATERIAL, "density", r"\w+_MEASURE")),
        profiles=tuple(_profiles(entities)),
    )


def _measure(entities: Entities, item: str, kind: str) -> float:
    """Return the value of the measure in entity `item`, in powers of mm and g; kind: pattern of the type of measure."""
    value = re.search(rf"{kind}\(({NUMBER})\),#(\d+)", entities.bodies.get(item, ("", ""))[1])
    return float(value[1]) * _unit_scale(entities, value[2]) if value else UNKNOWN_VALUE


def _centroid(item: str, entities: Entities, unit: float) -> tuple[float, float, float]:
    try:
        x, y, z = (unit * entities.points(np.array([item], dtype=np.int64))[0]).tolist()
    except KeyError:
        return UNKNOWN_VALUE, UNKNOWN_VALUE, UNKNOWN_VALUE
    return x, y, z


def _unit_scale(entities: Entities, unit: str) -> float:
    """Return the size of a unit (its number) in powers of mm and g; UNKNOWN_VALUE if it cannot be read."""
    if (size := _unit_size(entities, unit)) is not None:
        return size
    scale = 1.0
    for element in entities.references(unit):
        kind, body = entities.bodies[element]
        factor = re.fullmatch(rf"\(#(\d+),({NUMBER})\)", body)
        if factor is None or kind != "DERIVED_UNIT_ELEMENT" or (size := _unit_size(entities, factor[1])) is None:
            return UNKNOWN_VALUE
        scale *= size ** float(factor[2])
    return scale


def _unit_size(entities: Entities, unit: str) -> float | None:
    """Return the size of a unit of length (in mm) or mass (in g); None if it is not derived from an SI_UNIT."""
    body, factor = entities.bodies[unit][1], 1.0
    if converted := re.search(r"CONVERSION_BASED_UNIT\('\d+',#(\d+)\)", body):  # such as an inch, defined in mm
        measure = re.search(rf"\(({NUMBER})\)?,#(\d+)\)", entities.bodies[converted[1]][1])
        if measure is None:
            return None
        factor, body = float(measure[1]), entities.bodies[measure[2]][1]
    named = re.search(r"SI_UNIT\((\.\w+\.|\$),\.(\w+)\.\)", body)
    return factor * PREFIXES.get(named[1], UNKNOWN_VALUE) * UNITS.get(named[2], UNKNOWN_VALUE) if named else None


def _profiles(entities: Entities) -> Iterator[ProfileTolerance]:
    kind = "SURFACE_PROFILE_TOLERANCE"
    compound = (body for body in entities.of("COMPLEX").values() if f"{kind}(" in body)
    for body in (*entities.of(kind).values(), *compound):
        tolerance = re.search(r"\('\d*',(?:'\d*'|\$),#(\d+),#(\d+)", body)
        if tolerance is None:
            yield ProfileTolerance(UNKNOWN_VALUE, "")
        else:
            width = _measure(entities, tolerance[1], "LENGTH_MEASURE")
            yield ProfileTolerance(width, *_toleranced_face(entities, tolerance[2]))


def _toleranced_face(entities: Entities, aspect: str) -> tuple[str, str]:
    """Return (number of the surface, name) of the face that a SHAPE_ASPECT denotes; ("", "") unless it is one face."""
    usages = map(entities.references, entities.of("GEOMETRIC_ITEM_SPECIFIC_USAGE"))
    faces = {names[-1] for names in usages if names[0] == aspect}
    if len(faces) != 1 or entities.bodies.get(face := faces.pop(), ("",))[0] != "ADVANCED_FACE":
        return "", ""
    return entities.references(face)[-1], entities.string(face, 0)
