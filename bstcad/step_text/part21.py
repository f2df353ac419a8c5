"""A reader for STEP files (ISO 10303-21) that shares no line with OCC: a second opinion on what was written.

It reads what the checks need: control nets, knots and multiplicities of the freeform faces, the product's name, the
units, the number of solids, how often each edge is used, and the validation properties.  A damaged file is refused in
one sentence as far as that needs; OCC, which reads all of a file, does so in a process of its own.

Every pattern takes a time in proportion to the text: a repeated part ends at a character that it cannot hold, and
statements are cut apart before they are matched.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bstcad.runs import files
from bstcad.runs.files import one_line
from bstcad.step_text import validation_properties
from bstcad.step_text.validation_properties import Statements

MAX_BYTES = 600_000_000  # of a file: 2049 x 2049 control points, 130 bytes each with what refers to them
MAX_COORDINATE = 1e12  # of a point; a target may be 1e8 mm away
MAX_DEGREE = 25  # of a spline; OCC goes no further
CONIC_NET = 9  # control points of a conic or a nearly flat sphere; the net of a freeform face is larger

NAME = r"[1-9]\d{0,17}"  # an entity's number: one of 64 bits
REAL = r"[-+]?\d+\.\d*(?:E[-+]?\d+)?"
REALS = rf"{REAL}(?:,{REAL})*"
COUNTS = r"\d{1,9}(?:,\d{1,9})*"
FLAG = r"\.([TFU])\."
BLANKS = bytes(code for code in range(256) if chr(code).isspace())
STRING = re.compile(r"'[^']*(?:''[^']*)*'")
POINT = re.compile(rf"(?<=;)#({NAME})=CARTESIAN_POINT\('\d*',\(({REAL},{REAL},{REAL})\)\);")
STATEMENT = re.compile(rf"#({NAME})=([A-Z][A-Z_0-9]*)?(\(.*\))", re.DOTALL)
REFERENCES = re.compile(rf"#{NAME}(?:,#{NAME})*")
RULED = re.compile(r"\d+,1,")  # a wall: of degree 1 in v
SURFACE = re.compile(
    rf"(\d{{1,9}}),(\d{{1,9}}),\(\((.*?)\)\),\.\w+\.,{FLAG},{FLAG},{FLAG},"
    rf"\(({COUNTS})\),\(({COUNTS})\),\(({REALS})\),\(({REALS})\),\.\w+\.(.*)"
)
UNREADABLE = (LookupError, AttributeError, TypeError, ArithmeticError)  # an entity is missing, or of another form


@dataclass(frozen=True)
class FreeformSurface:
    """A B_SPLINE_SURFACE_WITH_KNOTS as the file states it."""

    degrees: tuple[int, int]  # u, v
    control_points: np.ndarray  # (m, n, 3), the file's unit of length, u along the first axis
    knots: tuple[np.ndarray, np.ndarray]  # distinct values
    multiplicities: tuple[np.ndarray, np.ndarray]
    closed: tuple[bool, bool]
    self_intersecting: bool | None  # None: the file does not know
    rational: bool  # weights that differ
    entity: str  # its number in the file

    @property
    def full_knots(self) -> tuple[np.ndarray, np.ndarray]:
        """Each knot repeated as often as it counts, in u and in v."""
        u, v = (np.repeat(k, c) for k, c in zip(self.knots, self.multiplicities, strict=True))
        return u, v


@dataclass(frozen=True)
class StepText:
    """The text of one STEP file of one lens."""

    product: str
    unit: str  # of length: millimetre, metre, inch …
    angle: str  # unit of angles: radian, degree …
    schema: str
    solids: int  # MANIFOLD_SOLID_BREP and BREP_WITH_VOIDS
    faces: int
    surface: FreeformSurface  # the freeform back: of two large nets that with the higher middle
    front: FreeformSurface | None  # the other one
    edge_uses: dict[int, tuple[int, int]]  # edge -> uses (forward, reversed)
    properties: validation_properties.ValidationProperties

    @property
    def closed(self) -> bool:
        """Is every edge used exactly twice, once in each direction?"""
        return bool(self.edge_uses) and all(uses == (1, 1) for uses in self.edge_uses.values())


@dataclass(frozen=True)
class Points:
    """The points in space of a file, nearly all of its entities."""

    numbers: np.ndarray  # of the entities, ascending
    xyz: np.ndarray  # (n, 3), in that order, the file's unit of length

    def at(self, numbers: np.ndarray) -> np.ndarray:
        """The points of these entities; KeyError names an entity that is no point."""
        rows = np.searchsorted(self.numbers, numbers).clip(max=len(self.numbers) - 1)
        wrong = numbers[self.numbers[rows] != numbers] if len(self.numbers) else numbers.ravel()
        if len(wrong):
            raise KeyError(f"#{wrong[0]}")
        return self.xyz[rows]


def read(path: str | Path) -> StepText:
    """The STEP file at `path`; ValueError if it is missing, truncated or not one lens."""
    path = Path(path)
    try:
        text = files.contents(path, MAX_BYTES).decode("latin-1")  # Part 21 is ASCII; latin-1 never fails
    except ValueError as error:
        raise ValueError(f"{path.name}: cannot be read ({error}); give the path of a STEP file") from error
    try:
        return parse(text)
    except ValueError as error:
        raise ValueError(one_line(f"{path.name}: read as text: {error}")) from error


def read_lens(path: str | Path) -> StepText:
    """A lens in millimetres and radians; ValueError if the file holds anything else."""
    text, name = read(path), f"{Path(path).name}: read as text"
    if text.unit != "millimetre":
        raise ValueError(f"{name}: lengths in {text.unit}; export it in millimetres")
    if text.angle != "radian":
        raise ValueError(f"{name}: angles in {text.angle}; export it in radians")
    if text.solids != 1:
        raise ValueError(f"{name}: {text.solids} solids; a lens is one: export it alone")
    return text


def parse(text: str) -> StepText:
    """The text of a STEP file of a lens; ValueError in one sentence if it is none."""
    try:
        return _parse(text)
    except ValueError as error:
        raise ValueError(one_line(error)) from error
    except UNREADABLE as error:
        fault = f"{error.args[0]} is missing, or of another kind" if isinstance(error, KeyError) else "one is malformed"
        raise ValueError(one_line(f"the file is damaged (of its entities {fault}); write it again")) from error


def _parse(text: str) -> StepText:
    if not text.lstrip().startswith("ISO-10303-21;"):
        raise ValueError("not a STEP file (it does not begin with ISO-10303-21); export the lens as STEP")
    if "END-ISO-10303-21;" not in text[-200:]:
        raise ValueError("the file is truncated (no END-ISO-10303-21 at its end); write or copy it again")
    data, strings = _bare(text)
    points, statements = _entities(data, strings)
    lengths, angles = (_units(kind, statements) for kind in ("LENGTH", "PLANE_ANGLE"))
    if len(lengths) != 1:
        raise ValueError(f"{len(lengths)} units of length ({', '.join(lengths)}); export it in millimetres only")
    surface, front = _freeform_surfaces(statements, points)
    return StepText(
        product=_product(statements),
        unit=lengths[0],
        angle=", ".join(angles) or "radian",
        schema=_schema(data, strings),
        solids=len(statements.of("MANIFOLD_SOLID_BREP")) + len(statements.of("BREP_WITH_VOIDS")),
        faces=len(_shell_faces(statements)),
        surface=surface,
        front=front,
        edge_uses=_edge_uses(statements),
        properties=validation_properties.read(statements, points.at),
    )


# ---- statements ----------------------------------------------------------------------------------------------------


def _bare(text: str) -> tuple[str, list[str]]:
    """(the text without blanks, the strings): each string in it gives way to its place in the list, '' stays."""
    strings: list[str] = []

    def numbered(hit: re.Match[str]) -> str:
        if len(hit[0]) == 2:
            return "''"
        strings.append(hit[0][1:-1])
        return f"'{len(strings) - 1}'"

    data = STRING.sub(numbered, text)
    return data.encode("latin-1", "replace").translate(None, BLANKS).decode("latin-1"), strings


def _entities(data: str, strings: Sequence[str]) -> tuple[Points, Statements]:
    """(the points in space, all other entities) of a file."""
    start, end = data.find("DATA;"), data.rfind("ENDSEC;")
    if not 0 <= start < end:
        raise ValueError("the file is damaged (it has no DATA section); write it again")
    parts = POINT.split(data[start + len("DATA") : end])  # from its semicolon on
    rest, names = "".join(parts[::3]), parts[1::3]
    known = set(names)
    statements = _statements(rest[1:], strings)
    if len(known) != len(names) or not known.isdisjoint(statements.bodies):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    missing = set(re.findall(r"#(\d+)", rest)) - known - statements.bodies.keys()
    if missing:
        raise ValueError(f"the file is damaged (entity #{min(missing)} is missing); write it again")
    return _points(names, parts[2::3]), statements


def _points(names: Sequence[str], values: Sequence[str]) -> Points:
    numbers = np.fromstring(",".join(names), dtype=np.int64, sep=",")
    xyz = np.fromstring(",".join(values), dtype=np.float64, sep=",").reshape(-1, 3)
    if not np.isfinite(xyz).all():
        raise ValueError("a CARTESIAN_POINT is not finite; write the file again")
    if np.abs(xyz).max(initial=0.0) > MAX_COORDINATE:
        raise ValueError(f"a CARTESIAN_POINT is over {MAX_COORDINATE:g} away; write the file again")
    order = np.argsort(numbers)
    return Points(numbers[order], xyz[order])


def _statements(section: str, strings: Sequence[str]) -> Statements:
    *texts, rest = section.split(";")
    found = [STATEMENT.fullmatch(each) for each in texts]
    if rest or not found or None in found:
        raise ValueError("the file is damaged (a statement is no entity); write it again")
    bodies = {hit[1]: (hit[2] or "COMPLEX", hit[3]) for hit in found}
    if len(bodies) != len(found):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    return Statements(bodies, strings)


def _schema(data: str, strings: Sequence[str]) -> str:
    schema = re.search(r"FILE_SCHEMA\(\('(\d*)'", data)
    if schema is None:
        raise ValueError("no FILE_SCHEMA in its header; write it again")
    return one_line(strings[int(schema[1])])


def _product(statements: Statements) -> str:
    """The first PRODUCT's name, or its number if it has none."""
    for number in statements.of("PRODUCT"):
        return statements.string(number, 1) or statements.string(number, 0)
    raise ValueError("no PRODUCT in the file; export it with a product name")


def _units(quantity: str, statements: Statements) -> list[str]:
    """The units of a quantity that the shapes' contexts name, each once."""
    used = set()
    for body in statements.of("COMPLEX").values():
        for context in re.findall(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\(\(([#\d,]*)\)\)", body):
            used.update(re.findall(r"\d+", context))
    bodies = (statements.bodies[number][1] for number in used)
    return sorted({_unit_name(body, statements) for body in bodies if f"{quantity}_UNIT()" in body})


def _unit_name(body: str, statements: Statements) -> str:
    if "CONVERSION_BASED_UNIT" in body:  # an inch
        place = re.search(r"CONVERSION_BASED_UNIT\('(\d+)'", body)[1]
        name = one_line(statements.strings[int(place)].lower()[:40])
        return f"{name} by a factor of its own" if "metre" in name or "radian" in name else name
    if body.count("SI_UNIT(") != 1:
        raise ValueError("the file is damaged (a unit is of no kind or of two); write it again")
    prefix, unit = re.search(r"SI_UNIT\((\.\w+\.|\$),\.(\w+)\.\)", body).groups()
    return (prefix.strip(".$") + unit).lower()[:40]


# ---- topology ------------------------------------------------------------------------------------------------------


def _edge_uses(statements: Statements) -> dict[int, tuple[int, int]]:
    """How often the loops of the faces walk each EDGE_CURVE forwards and backwards."""
    edges = {name: [0, 0] for name in statements.of("EDGE_CURVE")}
    oriented = _flagged("ORIENTED_EDGE", r"\('\d*',\*,\*,", statements)
    loops = _lists("EDGE_LOOP", statements)
    bounds = _flagged("FACE_BOUND", r"\('\d*',", statements) | _flagged("FACE_OUTER_BOUND", r"\('\d*',", statements)
    for face in _shell_faces(statements):
        for bound in face:
            loop, flag = bounds[bound]
            for name in loops[loop]:
                edge, forward = oriented[name]
                edges[edge][forward != flag] += 1  # a reversed bound walks its loop backwards
    return {int(edge): (uses[0], uses[1]) for edge, uses in edges.items()}


def _shell_faces(statements: Statements) -> list[list[str]]:
    """The bounds of each face of the closed shells; a face listed twice counts twice."""
    faces = _lists("ADVANCED_FACE", statements)
    return [faces[name] for shell in _lists("CLOSED_SHELL", statements).values() for name in shell]


def _lists(kind: str, statements: Statements) -> dict[str, list[str]]:
    """The list of references that each entity of a kind begins with."""
    lists = {name: re.match(r"\('\d*',\(([#\d,]*)\)", body) for name, body in statements.of(kind).items()}
    return {name: re.findall(r"\d+", hit[1]) for name, hit in lists.items()}


def _flagged(kind: str, before: str, statements: Statements) -> dict[str, tuple[str, str]]:
    """The reference and the flag, T or F, that each entity of a kind ends with."""
    pattern = re.compile(before + r"#(\d+),\.([TF])\.\)")
    flagged = {name: pattern.fullmatch(body) for name, body in statements.of(kind).items()}
    return {name: (hit[1], hit[2]) for name, hit in flagged.items()}


# ---- freeform surfaces ---------------------------------------------------------------------------------------------


def _freeform_surfaces(statements: Statements, points: Points) -> tuple[FreeformSurface, FreeformSurface | None]:
    """The back, and the front if it has a freeform net."""
    bodies = [each for each in _surface_bodies(statements) if not RULED.match(each[1])]
    bodies.sort(key=lambda each: each[1].count("#"), reverse=True)
    if not bodies:
        raise ValueError("no B_SPLINE_SURFACE_WITH_KNOTS in the file; give one written by bstcad")
    large = [each for each in bodies if each[1].count("#") > CONIC_NET]
    if len(large) > 2:
        raise ValueError(f"{len(bodies)} freeform surfaces in the file; a lens has one or two: export it alone")
    surfaces = [_surface(*each, points) for each in large or bodies[:1]]
    surfaces.sort(key=lambda surface: _middle(surface.control_points), reverse=True)
    return surfaces[0], surfaces[1] if len(surfaces) > 1 else None


def _middle(net: np.ndarray) -> float:
    """z of the control point in the middle of a net."""
    return float(net[net.shape[0] // 2, net.shape[1] // 2, 2])


def _surface_bodies(statements: Statements) -> list[tuple[str, str]]:
    """(number, attributes) of each surface in the order of the simple entity, weights behind, simple or complex."""
    kind = "B_SPLINE_SURFACE_WITH_KNOTS"
    simple = [(name, body.partition("',")[2][:-1]) for name, body in statements.of(kind).items()]
    compound = [(name, body) for name, body in statements.of("COMPLEX").items() if f"{kind}(" in body]
    return simple + [(name, _as_simple(body)) for name, body in compound]


def _as_simple(body: str) -> str:
    net, _, rest = body.partition("B_SPLINE_SURFACE(")[2].partition(")B_SPLINE_SURFACE_WITH_KNOTS(")
    end = re.search(r"\.[A-Z_]+\.\)", rest).end()
    weights = rest[end:].partition("RATIONAL_B_SPLINE_SURFACE((")[2].partition("))")[0]
    return f"{net},{rest[: end - 1]}" + (f",{weights}" if weights else "")


def _surface(entity: str, body: str, points: Points) -> FreeformSurface:
    degree_u, degree_v, net, *rest = SURFACE.match(body).groups()
    *flags, count_u, count_v, knots_u, knots_v, behind = rest
    numbers, degrees = _net(net), (int(degree_u), int(degree_v))
    counts = [np.array(each.split(","), dtype=np.int64) for each in (count_u, count_v)]
    values = [np.array(each.split(","), dtype=np.float64) for each in (knots_u, knots_v)]
    for count, value, degree, size in zip(counts, values, degrees, numbers.shape, strict=True):
        _check_knots(count, value, size, degree)
    weights = re.findall(REAL, behind)
    if len(weights) not in (0, numbers.size) or (behind and not weights):
        raise ValueError(f"{len(weights)} weights for {numbers.size} control points; write the file again")
    return FreeformSurface(
        degrees=degrees,
        control_points=points.at(numbers),
        knots=(values[0], values[1]),
        multiplicities=(counts[0], counts[1]),
        closed=(flags[0] == "T", flags[1] == "T"),
        self_intersecting={"T": True, "F": False}.get(flags[2]),
        rational=len(set(weights)) > 1,
        entity=entity,
    )


def _net(text: str) -> np.ndarray:
    """The entity numbers of a control net, one row a line."""
    lines = text.split("),(")
    if not all(REFERENCES.fullmatch(line) for line in lines):
        raise ValueError("the control net is damaged; write the file again")
    rows = [np.fromstring(line.replace("#", ""), dtype=np.int64, sep=",") for line in lines]
    if len({len(row) for row in rows}) != 1:
        raise ValueError("the control net is not rectangular; write the file again")
    return np.stack(rows)


def _check_knots(counts: np.ndarray, knots: np.ndarray, points: int, degree: int) -> None:
    """ValueError unless so many control points have a spline of this degree on these knots, each so often."""
    if not 1 <= degree <= MAX_DEGREE:
        raise ValueError(f"the file is damaged (a spline of degree {degree}); write it again")
    rising = np.isfinite(knots).all() and (np.diff(knots) > 0).all()
    if not rising or len(counts) != len(knots) or counts.min() < 1 or counts.sum() != points + degree + 1:
        raise ValueError(
            f"the file is damaged ({counts.sum()} knots for {points} control points of degree {degree}); write it again"
        )
