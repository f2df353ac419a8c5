"""A reader for STEP files (ISO 10303-21) that shares no line with OCC: a second opinion on what was written.

It reads what the checks need and no more: the control net, knots and multiplicities of the one freeform surface, the
product's name, the unit of length, the number of solids, and how often each edge is used.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bstcad.cad import syntax

QUOTE = "'"


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
    schema: str
    solids: int  # MANIFOLD_SOLID_BREP and BREP_WITH_VOIDS
    faces: int
    surface: FreeformSurface  # the freeform face: the largest control net of the file
    edge_uses: dict[int, tuple[int, int]]  # edge -> uses (forward, reversed)

    @property
    def closed(self) -> bool:
        """Is every edge used exactly twice, once in each direction?"""
        return bool(self.edge_uses) and all(uses == (1, 1) for uses in self.edge_uses.values())


def read(path: str | Path) -> StepText:
    """The STEP file at `path`; ValueError if it is missing, truncated or not one lens."""
    path = Path(path)
    try:
        text = path.read_bytes().decode("latin-1")  # Part 21 is ASCII; latin-1 never fails
    except OSError as error:
        raise ValueError(f"{path.name}: cannot be read ({error.strerror}); give the path of a STEP file") from error
    try:
        return parse(text)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def parse(text: str) -> StepText:
    """What the text of a STEP file says about one lens; ValueError in one sentence if it does not."""
    if not text.lstrip().startswith("ISO-10303-21;"):
        raise ValueError("not a STEP file (it does not begin with ISO-10303-21); export the lens as STEP")
    if "END-ISO-10303-21;" not in text[-200:]:
        raise ValueError("the file is truncated (no END-ISO-10303-21 at its end); write or copy it again")
    points, data = syntax.take_points(_bare(text))
    syntax.check(data, points.names)
    try:
        return StepText(
            product=_product(text),
            unit=_unit(data, text),
            schema=_schema(text),
            solids=len(re.findall(r"=(?:MANIFOLD_SOLID_BREP|BREP_WITH_VOIDS)\(", data)),
            faces=len(_shell_faces(data)),
            surface=_largest_surface(data, points),
            edge_uses=_edge_uses(data),
        )
    except (IndexError, KeyError, AttributeError) as error:
        raise ValueError(f"the file is damaged (an entity is missing or malformed: {error}); write it again") from error


def _bare(text: str) -> str:
    """The text without blanks, since writers wrap lines anywhere; two quotes for each string, which may hold anything.

    A doubled quote inside a string makes two of it, and those one again.
    """
    data = (2 * QUOTE).join(text.split(QUOTE)[::2])
    if 4 * QUOTE in data:
        data = re.sub(f"(?:{2 * QUOTE})+", 2 * QUOTE, data)
    return "".join(data.split())


def _schema(text: str) -> str:
    found = re.search(r"FILE_SCHEMA\s*\(\s*\(\s*'([^']*)'", text)
    if found is None:
        raise ValueError("no FILE_SCHEMA in its header; write it again")
    return found.group(1)


def _product(text: str) -> str:
    """The first PRODUCT's name, its Part-21 escapes resolved."""
    found = re.search(r"=\s*PRODUCT\s*\(\s*'((?:[^']|'')*)'", text)
    if found is None:
        raise ValueError("no PRODUCT in the file; export it with a product name")
    name = re.sub(r"[\r\n]", "", found.group(1)).replace("''", "'")
    name = re.sub(r"\\X2\\([0-9A-F]*)\\X0\\", lambda hit: bytes.fromhex(hit.group(1)).decode("utf-16-be"), name)
    return re.sub(r"\\X\\([0-9A-F]{2})", lambda hit: chr(int(hit.group(1), 16)), name)


def _unit(data: str, text: str) -> str:
    """The one unit of length that the shapes' contexts name."""
    contexts = re.findall(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\(\(([#\d,]*)\)\)", data)
    used = {number for context in contexts for number in re.findall(r"\d+", context)}
    units = set()
    for number, body in re.findall(r"#(\d+)=(\([^;]*LENGTH_UNIT\(\)[^;]*\));", data):
        if number in used:
            units.add(_unit_name(body, text))
    if len(units) != 1:
        raise ValueError(f"{len(units)} units of length ({', '.join(sorted(units))}); export it in millimetres only")
    return units.pop()


def _unit_name(body: str, text: str) -> str:
    if "CONVERSION_BASED_UNIT" in body:  # an inch: its name is a string, which `data` no longer has
        return re.search(r"CONVERSION_BASED_UNIT\s*\(\s*'([^']*)'", text).group(1).lower()
    prefix = re.search(r"SI_UNIT\(([^,]*),\.METRE\.\)", body).group(1)
    return prefix.strip(".$").lower() + "metre"


def _edge_uses(data: str) -> dict[int, tuple[int, int]]:
    """How often the loops of the faces walk each EDGE_CURVE forwards and backwards."""
    edges = {int(n): [0, 0] for n in re.findall(r"#(\d+)=EDGE_CURVE\(", data)}
    walks = re.findall(r"#(\d+)=ORIENTED_EDGE\('',\*,\*,#(\d+),\.([TF])\.\)", data)
    oriented = {name: (int(edge), flag) for name, edge, flag in walks}
    loops = _lists("EDGE_LOOP", data)
    named = re.findall(r"#(\d+)=FACE(?:_OUTER)?_BOUND\('',#(\d+),\.([TF])\.\)", data)
    bounds = {name: (loop, flag) for name, loop, flag in named}
    for face in _shell_faces(data):
        for bound in face:
            loop, flag = bounds[bound]
            for name in loops[loop]:
                edge, forward = oriented[name]
                edges[edge][forward != flag] += 1  # a reversed bound walks its loop backwards
    return {edge: (uses[0], uses[1]) for edge, uses in edges.items()}


def _shell_faces(data: str) -> list[list[str]]:
    """The bounds of each face of the closed shells; a face listed twice counts twice."""
    faces = _lists("ADVANCED_FACE", data)
    return [faces[name] for shell in _lists("CLOSED_SHELL", data).values() for name in shell]


def _lists(kind: str, data: str) -> dict[str, list[str]]:
    """The list of references that each entity of a kind begins with."""
    found = re.findall(rf"#(\d+)={kind}\('',\(([#\d,]*)\)", data)
    return {number: re.findall(r"\d+", references) for number, references in found}


def _largest_surface(data: str, points: syntax.Points) -> FreeformSurface:
    """The surface with the largest net: a nearly flat spherical front is a small patch beside it."""
    bodies = _surface_bodies(data)
    if not bodies:
        raise ValueError("no B_SPLINE_SURFACE_WITH_KNOTS in the file; give one written by bstcad")
    sizes = sorted((body.count("#") for body in bodies), reverse=True)
    if len(sizes) > 1 and sizes[1] > 9:
        raise ValueError(f"{len(bodies)} freeform surfaces in the file; a lens has one: export it alone")
    return _surface(max(bodies, key=lambda body: body.count("#")), points)


def _surface_bodies(data: str) -> list[str]:
    """The attributes of each surface in the order of the simple entity, weights behind, whether simple or complex."""
    simple = re.findall(r"=B_SPLINE_SURFACE_WITH_KNOTS\('',([^;]*)\);", data)
    parts = re.findall(r"B_SPLINE_SURFACE\((\d[^;]*?\.)\)B_SPLINE_SURFACE_WITH_KNOTS\(([^;]*?\.\w+\.)\)([^;]*);", data)
    weights = [re.search(r"RATIONAL_B_SPLINE_SURFACE\(\((.*?)\)\)", rest) for _, _, rest in parts]
    return simple + [
        f"{net},{knots}" + (f",{found.group(1)}" if found else "")
        for (net, knots, _), found in zip(parts, weights, strict=True)
    ]


def _surface(body: str, points: syntax.Points) -> FreeformSurface:
    degree_u, degree_v, net, rest = re.match(r"(\d+),(\d+),\(\((.*?)\)\),(.*)", body).groups()
    flags = re.match(r"\.(\w+)\.,\.([TFU])\.,\.([TFU])\.,\.([TFU])\.,(.*)", rest)
    one_list = rf"\(({syntax.NUMBERS})\),"
    lists = re.match(one_list * 4 + r"\.(\w+)\.(.*)", flags.group(5))
    rows = [np.array(line.replace("#", "").split(","), dtype=np.int64) for line in net.split("),(")]
    if len({len(line) for line in rows}) != 1:
        raise ValueError("the control net is not rectangular; write the file again")
    numbers = np.stack(rows)
    at = points.row[numbers]
    if (at < 0).any():
        raise ValueError("a control point is missing from the file; write it again")
    counts = [np.array(lists.group(i).split(","), dtype=np.int64) for i in (1, 2)]
    values = [np.array(lists.group(i).split(","), dtype=np.float64) for i in (3, 4)]
    degrees = int(degree_u), int(degree_v)
    for count, value, degree, size in zip(counts, values, degrees, numbers.shape, strict=True):
        if len(count) != len(value) or count.sum() != size + degree + 1 or (np.diff(value) <= 0).any():
            raise ValueError(f"{count.sum()} knots for {size} control points of degree {degree}; write the file again")
    weights = re.findall(syntax.REAL, lists.group(6))
    return FreeformSurface(
        degrees=degrees,
        control_points=points.xyz[at],
        knots=(values[0], values[1]),
        multiplicities=(counts[0], counts[1]),
        form=flags.group(1),
        closed=(flags.group(2) == "T", flags.group(3) == "T"),
        self_intersecting={"T": True, "F": False}.get(flags.group(4)),
        knot_form=lists.group(5),
        rational=len(set(weights)) > 1,
    )
