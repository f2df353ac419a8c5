"""A reader for STEP files (ISO 10303-21) that shares no line with OCC: a second opinion on what was written.

It reads what the checks need and no more: the control net, knots and multiplicities of the one freeform surface, the
product's name, the unit of length, the number of solids, how often each edge is used, which senses are turned, and what
the file states of its part (stated.py).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bstcad import files
from bstcad.files import one_line
from bstcad.step_text import orientation, stated, strings, syntax
from bstcad.step_text.stated import Stated

LARGEST_FILE = 600_000_000  # bytes: 2049 x 2049 control points, 130 each with what refers to them
QUOTE = "'"
RULED = re.compile(r"\d+,1,")  # walls: of degree 1 the other way
NAMES = re.compile(rf"#{syntax.NAME}(?:,#{syntax.NAME})*")
BLANKS = bytes(code for code in range(256) if chr(code).isspace())


@dataclass(frozen=True)
class FreeformSurface:
    """A B_SPLINE_SURFACE_WITH_KNOTS as the file states it."""

    degrees: tuple[int, int]  # u, v
    control_points: np.ndarray  # (m, n, 3), the file's unit of length, u along the first axis
    knots: tuple[np.ndarray, np.ndarray]  # distinct values
    multiplicities: tuple[np.ndarray, np.ndarray]
    form: str  # surface_form, such as UNSPECIFIED
    closed: tuple[bool, bool]
    self_intersecting: bool | None  # None: the file does not know
    knot_form: str  # knot_spec, such as UNSPECIFIED
    rational: bool  # weights that differ
    entity: str  # its number in the file

    @property
    def full_knots(self) -> tuple[np.ndarray, np.ndarray]:
        """Each knot repeated as often as it counts, in u and in v."""
        u, v = (np.repeat(k, c) for k, c in zip(self.knots, self.multiplicities, strict=True))
        return u, v


@dataclass(frozen=True)
class StepText:
    """What one STEP file says about one lens."""

    product: str
    unit: str  # of length: millimetre, metre, inch …
    angle: str  # unit of angles: radian, degree …
    schema: str
    solids: int  # MANIFOLD_SOLID_BREP and BREP_WITH_VOIDS
    faces: int
    surface: FreeformSurface  # the freeform back: of two large nets that with the higher middle
    front: FreeformSurface | None  # the other one
    edge_uses: dict[int, tuple[int, int]]  # edge -> uses (forward, reversed)
    turned: tuple[str, ...]  # faces that look inwards; edges and loops that do not run as they say
    stated: Stated  # of area, volume, centroid, material, density and tolerances

    @property
    def closed(self) -> bool:
        """Is every edge used exactly twice, once in each direction?"""
        return bool(self.edge_uses) and all(uses == (1, 1) for uses in self.edge_uses.values())


def read(path: str | Path) -> StepText:
    """The STEP file at `path`; ValueError if it is missing, truncated or not one lens."""
    path = Path(path)
    try:
        text = files.contents(path, LARGEST_FILE).decode("latin-1")  # Part 21 is ASCII; latin-1 never fails
    except ValueError as error:
        raise ValueError(f"{path.name}: cannot be read ({error}); give the path of a STEP file") from error
    try:
        return parse(text)
    except ValueError as error:
        raise ValueError(one_line(f"{path.name}: {error}")) from error


def read_lens(path: str | Path) -> StepText:
    """The same of a lens in millimetres and radians; ValueError if it is anything else."""
    text, name = read(path), Path(path).name
    if text.unit != "millimetre":
        raise ValueError(f"{name}: lengths in {text.unit}; export it in millimetres")
    if text.angle != "radian":
        raise ValueError(f"{name}: angles in {text.angle}; export it in radians")
    if text.solids != 1:
        raise ValueError(f"{name}: {text.solids} solids; a lens is one: export it alone")
    return text


def parse(text: str) -> StepText:
    """What the text of a STEP file says about one lens; ValueError in one sentence if it does not."""
    try:
        return _parse(text)
    except ValueError as error:
        raise ValueError(one_line(error)) from error
    except (IndexError, KeyError, AttributeError) as error:
        fault = f"the file is damaged (an entity is missing or malformed: {error}); write it again"
        raise ValueError(one_line(fault)) from error


def _parse(text: str) -> StepText:
    if not text.lstrip().startswith("ISO-10303-21;"):
        raise ValueError("not a STEP file (it does not begin with ISO-10303-21); export the lens as STEP")
    if "END-ISO-10303-21;" not in text[-200:]:
        raise ValueError("the file is truncated (no END-ISO-10303-21 at its end); write or copy it again")
    points, statements = syntax.read(_bare(text))
    lengths, angles = (_units(kind, statements, text) for kind in ("LENGTH", "PLANE_ANGLE"))
    if len(lengths) != 1:
        raise ValueError(f"{len(lengths)} units of length ({', '.join(lengths)}); export it in millimetres only")
    surface, front = _freeform_surfaces(statements, points)
    return StepText(
        product=_product(text),
        unit=lengths[0],
        angle=", ".join(angles) or "radian",
        schema=_schema(text),
        solids=sum(kind in ("MANIFOLD_SOLID_BREP", "BREP_WITH_VOIDS") for kind, _ in statements.values()),
        faces=len(_shell_faces(statements)),
        surface=surface,
        front=front,
        edge_uses=_edge_uses(statements),
        turned=orientation.turned(statements, points, *(face.control_points for face in (surface, front) if face)),
        stated=stated.read(text, statements, points),
    )


def _bare(text: str) -> str:
    """The text without blanks, since writers wrap lines anywhere; two quotes for each string, which may hold anything.

    A doubled quote inside a string makes two of it, and those one again.
    """
    data = (2 * QUOTE).join(text.split(QUOTE)[::2])
    if 4 * QUOTE in data:
        data = re.sub(f"(?:{2 * QUOTE})+", 2 * QUOTE, data)
    return data.encode("latin-1", "replace").translate(None, BLANKS).decode("latin-1")


def _schema(text: str) -> str:
    found = re.search(r"FILE_SCHEMA\s*\(\s*\(\s*'([^']*)'", text)
    if found is None:
        raise ValueError("no FILE_SCHEMA in its header; write it again")
    return one_line(found.group(1))


def _product(text: str) -> str:
    """The first PRODUCT's name, or its number if it has none, its Part-21 escapes resolved."""
    string = r"'([^']*(?:''[^']*)*)'"
    found = re.search(rf"=\s*PRODUCT\s*\(\s*{string}\s*,\s*{string}", text)
    if found is None:
        raise ValueError("no PRODUCT in the file; export it with a product name")
    return strings.decoded(found.group(2) or found.group(1))


def _units(quantity: str, statements: syntax.Statements, text: str) -> list[str]:
    """The units of a quantity that the shapes' contexts name, each once."""
    used = set()
    for _, body in statements.values():
        for context in re.findall(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\(\(([#\d,]*)\)\)", body):
            used.update(re.findall(r"\d+", context))
    bodies = (statements[number][1] for number in used if number in statements)
    return sorted({_unit_name(body, text) for body in bodies if f"{quantity}_UNIT()" in body})


def _unit_name(body: str, text: str) -> str:
    if "CONVERSION_BASED_UNIT" in body:  # an inch: its name is a string, which `body` no longer has
        name = re.search(r"CONVERSION_BASED_UNIT\s*\(\s*'([^']*)'", text).group(1).lower()[:40]
        name = one_line(name)
        return f"{name} by a factor of its own" if "metre" in name or "radian" in name else name
    if body.count("SI_UNIT(") != 1:
        raise ValueError("the file is damaged (a unit is of no kind or of two); write it again")
    prefix, unit = re.search(r"SI_UNIT\((\.\w+\.|\$),\.(\w+)\.\)", body).groups()
    return (prefix.strip(".$") + unit).lower()[:40]


def _edge_uses(statements: syntax.Statements) -> dict[int, tuple[int, int]]:
    """How often the loops of the faces walk each EDGE_CURVE forwards and backwards."""
    edges = {int(name): [0, 0] for name in _of("EDGE_CURVE", statements)}
    oriented = _flagged("ORIENTED_EDGE", r"\('',\*,\*,", statements)
    loops = _lists("EDGE_LOOP", statements)
    bounds = _flagged("FACE_BOUND", r"\('',", statements) | _flagged("FACE_OUTER_BOUND", r"\('',", statements)
    for face in _shell_faces(statements):
        for bound in face:
            loop, flag = bounds[bound]
            for name in loops[loop]:
                edge, forward = oriented[name]
                edges[int(edge)][forward != flag] += 1  # a reversed bound walks its loop backwards
    return {edge: (uses[0], uses[1]) for edge, uses in edges.items()}


def _shell_faces(statements: syntax.Statements) -> list[list[str]]:
    """The bounds of each face of the closed shells; a face listed twice counts twice."""
    faces = _lists("ADVANCED_FACE", statements)
    return [faces[name] for shell in _lists("CLOSED_SHELL", statements).values() for name in shell]


def _of(kind: str, statements: syntax.Statements) -> dict[str, str]:
    """The attributes of the entities of one kind."""
    return {name: body for name, (its, body) in statements.items() if its == kind}


def _lists(kind: str, statements: syntax.Statements) -> dict[str, list[str]]:
    """The list of references that each entity of a kind begins with."""
    found = {name: re.match(r"\('',\(([#\d,]*)\)", body) for name, body in _of(kind, statements).items()}
    return {name: re.findall(r"\d+", hit.group(1)) for name, hit in found.items()}


def _flagged(kind: str, before: str, statements: syntax.Statements) -> dict[str, tuple[str, str]]:
    """The reference and the flag, T or F, that each entity of a kind ends with."""
    found = {n: re.fullmatch(before + r"#(\d+),\.([TF])\.\)", body) for n, body in _of(kind, statements).items()}
    return {name: (hit.group(1), hit.group(2)) for name, hit in found.items()}


def _freeform_surfaces(
    statements: syntax.Statements, points: syntax.Points
) -> tuple[FreeformSurface, FreeformSurface | None]:
    """The back, and the front if its net is larger than the 3 x 3 of a conic or a nearly flat sphere."""
    bodies = [each for each in _surface_bodies(statements) if not RULED.match(each[1])]
    bodies.sort(key=lambda each: each[1].count("#"), reverse=True)
    if not bodies:
        raise ValueError("no B_SPLINE_SURFACE_WITH_KNOTS in the file; give one written by bstcad")
    large = [each for each in bodies if each[1].count("#") > 9]
    if len(large) > 2:
        raise ValueError(f"{len(bodies)} freeform surfaces in the file; a lens has one or two: export it alone")
    found = [_surface(*each, points) for each in large or bodies[:1]]
    found.sort(key=lambda surface: _middle(surface.control_points), reverse=True)
    return found[0], found[1] if len(found) > 1 else None


def _middle(net: np.ndarray) -> float:
    """z of the control point in the middle of a net."""
    return float(net[net.shape[0] // 2, net.shape[1] // 2, 2])


def _surface_bodies(statements: syntax.Statements) -> list[tuple[str, str]]:
    """(number, attributes) of each surface in the order of the simple entity, weights behind, simple or complex."""
    kind = "B_SPLINE_SURFACE_WITH_KNOTS"
    simple = [(name, body.removeprefix("('',")[:-1]) for name, body in _of(kind, statements).items()]
    compound = [(name, body) for name, body in _of("COMPLEX", statements).items() if f"{kind}(" in body]
    return simple + [(name, _as_simple(body)) for name, body in compound]


def _as_simple(body: str) -> str:
    net, _, rest = body.partition("B_SPLINE_SURFACE(")[2].partition(")B_SPLINE_SURFACE_WITH_KNOTS(")
    end = re.search(r"\.[A-Z_]+\.\)", rest).end()
    weights = rest[end:].partition("RATIONAL_B_SPLINE_SURFACE((")[2].partition("))")[0]
    return f"{net},{rest[: end - 1]}" + (f",{weights}" if weights else "")


def _surface(entity: str, body: str, points: syntax.Points) -> FreeformSurface:
    degree_u, degree_v, net, rest = re.match(r"(\d{1,9}),(\d{1,9}),\(\((.*?)\)\),(.*)", body).groups()
    flags = re.match(r"\.(\w+)\.,\.([TFU])\.,\.([TFU])\.,\.([TFU])\.,(.*)", rest)
    counted, valued = rf"\(({syntax.COUNTS})\),", rf"\(({syntax.NUMBERS})\),"
    lists = re.match(counted * 2 + valued * 2 + r"\.(\w+)\.(.*)", flags.group(5))
    numbers = _net(net)
    counts = [np.array(lists.group(i).split(","), dtype=np.int64) for i in (1, 2)]
    values = [np.array(lists.group(i).split(","), dtype=np.float64) for i in (3, 4)]
    degrees = int(degree_u), int(degree_v)
    for count, value, degree, size in zip(counts, values, degrees, numbers.shape, strict=True):
        syntax.check_knots(count, value, size, degree)
    weights = re.findall(syntax.REAL, lists.group(6))
    if len(weights) not in (0, numbers.size) or (lists.group(6) and not weights):
        raise ValueError(f"{len(weights)} weights for {numbers.size} control points; write the file again")
    return FreeformSurface(
        degrees=degrees,
        control_points=points.at(numbers),
        knots=(values[0], values[1]),
        multiplicities=(counts[0], counts[1]),
        form=flags.group(1)[:40],
        closed=(flags.group(2) == "T", flags.group(3) == "T"),
        self_intersecting={"T": True, "F": False}.get(flags.group(4)),
        knot_form=lists.group(5)[:40],
        rational=len(set(weights)) > 1,
        entity=entity,
    )


def _net(text: str) -> np.ndarray:
    """The entity numbers of a control net, one row a line."""
    lines = text.split("),(")
    if not all(NAMES.fullmatch(line) for line in lines):
        raise ValueError("the control net is damaged; write the file again")
    rows = [np.fromstring(line.replace("#", ""), dtype=np.int64, sep=",") for line in lines]
    if len({len(row) for row in rows}) != 1:
        raise ValueError("the control net is not rectangular; write the file again")
    return np.stack(rows)
