"""Is the text of a STEP file whole?  Asked before OCC reads it: some files that are not whole end the process there.

Part 21 in four questions: is each statement an entity, is each attribute a token of the language, does each reference
lead to an entity of the kind that geometry and topology need there, and does each spline have the knots it asks for?
`data` is a file without strings ('' in their place) and without blanks; the points in space, nearly all of a file, are
taken out of it first and asked for by name.
"""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

REAL = r"[-+]?\d+\.\d*(?:E[-+]?\d+)?"
NUMBER = rf"(?:{REAL}|[-+]?\d+)"
NUMBERS = rf"{NUMBER}(?:,{NUMBER})*"
NO_TOKEN = re.compile(rf"[(,](?!(?:#\d+|{NUMBER}|\.\w+\.|[*$]|''|)[,)]|\(|[A-Z][A-Z_0-9]*\()[^,)]*")
POINT = re.compile(rf"(?<=;)#(\d+)=CARTESIAN_POINT\('',\(({REAL},{REAL},{REAL})\)\);")
IN_FEW_NUMBERS = re.compile(rf"(?:CARTESIAN_POINT|DIRECTION)\('',\({REAL}(?:,{REAL}){{1,2}}\)\);")
STATEMENT = re.compile(r"#(\d+)=([A-Z][A-Z_0-9]*)?(\([^;]*\));")

CURVE = r"(?:LINE|CIRCLE|ELLIPSE|B_SPLINE_CURVE_WITH_KNOTS|COMPLEX)"
SURFACE = r"(?:PLANE|\w+_SURFACE|B_SPLINE_SURFACE_WITH_KNOTS|COMPLEX3)"
FRAME = "AXIS2_PLACEMENT_3D"
REFERENCES = {  # the kinds an entity refers to, in order; a 2 or 3 behind a kind is its number of dimensions
    "VECTOR": "DIRECTION[23]",
    "LINE": "CARTESIAN_POINT2 VECTOR2|CARTESIAN_POINT3 VECTOR3",
    "CIRCLE": r"AXIS2_PLACEMENT_[23]D",
    "AXIS2_PLACEMENT_3D": "CARTESIAN_POINT3(?: DIRECTION3){0,2}",
    "AXIS2_PLACEMENT_2D": "CARTESIAN_POINT2(?: DIRECTION2)?",
    "PLANE": FRAME,
    "SPHERICAL_SURFACE": FRAME,
    "CYLINDRICAL_SURFACE": FRAME,
    "B_SPLINE_CURVE_WITH_KNOTS": "CARTESIAN_POINT2(?: CARTESIAN_POINT2)*|CARTESIAN_POINT3(?: CARTESIAN_POINT3)*",
    "B_SPLINE_SURFACE_WITH_KNOTS": "CARTESIAN_POINT3(?: CARTESIAN_POINT3)*",
    "PCURVE": f"{SURFACE} DEFINITIONAL_REPRESENTATION",
    "DEFINITIONAL_REPRESENTATION": f"{CURVE}2 COMPLEX",
    "SURFACE_CURVE": f"{CURVE}3(?: PCURVE)+",
    "SEAM_CURVE": f"{CURVE}3 PCURVE PCURVE",
    "EDGE_CURVE": rf"VERTEX_POINT VERTEX_POINT (?:SURFACE_CURVE|SEAM_CURVE|{CURVE}3)",
    "VERTEX_POINT": "CARTESIAN_POINT3",
    "ORIENTED_EDGE": "EDGE_CURVE",
    "EDGE_LOOP": "ORIENTED_EDGE(?: ORIENTED_EDGE)*",
    "FACE_BOUND": "EDGE_LOOP",
    "FACE_OUTER_BOUND": "EDGE_LOOP",
    "ADVANCED_FACE": rf"FACE_(?:OUTER_)?BOUND(?: FACE_(?:OUTER_)?BOUND)* {SURFACE}",
    "CLOSED_SHELL": "ADVANCED_FACE(?: ADVANCED_FACE)*",
    "MANIFOLD_SOLID_BREP": "CLOSED_SHELL",
}
AS_THEIR_POINTS = {"VECTOR", "LINE", "CIRCLE", "ELLIPSE", "B_SPLINE_CURVE_WITH_KNOTS"}  # in number of dimensions
SPLINE_CURVE = re.compile(
    rf"B_SPLINE_CURVE(?:_WITH_KNOTS\('',|\()(\d+),\(([#\d,]+)\),\.\w+\.,\.[TFU]\.,\.[TFU]\.(?:,|\)B_SPLINE_CURVE_WITH_KNOTS\()"
    rf"\((\d+(?:,\d+)*)\),\(({NUMBERS})\),\.\w+\.\)"
)


@dataclass(frozen=True)
class Points:
    """The well-formed points in space of a file."""

    names: Set[str]  # entity numbers
    row: np.ndarray  # of each entity number, -1 if it is no such point
    xyz: np.ndarray  # (n, 3), the file's unit of length


def take_points(data: str) -> tuple[Points, str]:
    """(the points in space, the file without them); ValueError if two share a number or one is not finite."""
    parts = POINT.split(data)
    names, bodies = parts[1::3], parts[2::3]
    xyz = np.array(",".join(bodies).split(",") if bodies else [], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(xyz).all():
        raise ValueError("a CARTESIAN_POINT is not finite; write the file again")
    numbers = np.array(names, dtype=np.int64)
    known = frozenset(names)
    if len(known) != len(names):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    row = np.full(numbers.max(initial=0) + 1, -1)
    row[numbers] = np.arange(len(numbers))
    return Points(known, row, xyz), "".join(parts[::3])


def check(data: str, points: Set[str]) -> None:
    """ValueError in one sentence unless the data section of the file, without its `points`, is whole."""
    section = data[data.find("DATA;") + 5 : data.rfind("ENDSEC;")]
    statements = _statements(section)
    if not points.isdisjoint(statements):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    stray = NO_TOKEN.search(section)
    if stray:
        raise ValueError(f"the file is damaged ('{stray.group()[1:30]}' is no value); write it again")
    in_numbers = section.count("=CARTESIAN_POINT(") + section.count("=DIRECTION(")
    if len(IN_FEW_NUMBERS.findall(section)) != in_numbers:
        raise ValueError("the file is damaged (a CARTESIAN_POINT or DIRECTION holds no numbers); write it again")
    _check_references(statements, points)
    _check_curves(section)


def _statements(section: str) -> dict[str, tuple[str, str]]:
    """Entity number -> (kind, attributes); a complex entity's kind is COMPLEX."""
    characters = np.frombuffer(section.encode("latin-1", "replace"), dtype=np.uint8)
    turns = (characters == ord("(")).astype(np.int8) - (characters == ord(")"))
    depth = np.cumsum(turns, dtype=np.int32)
    ends = np.flatnonzero(characters == ord(";"))
    found = STATEMENT.findall(section)
    covered = sum(len(number) + len(kind) + len(body) + len("#=;") for number, kind, body in found)
    if not found or covered != len(section) or depth[ends].any() or depth.min() < 0:
        raise ValueError("the file is damaged (a statement is no entity); write it again")
    statements = {number: (kind or "COMPLEX", body) for number, kind, body in found}
    if len(statements) != len(found):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    return statements


def _kind(name: str, statements: dict[str, tuple[str, str]], points: Set[str]) -> str:
    """The kind of an entity, with 2 or 3 behind it where it lies in the plane of a face or in space."""
    if name in points:
        return "CARTESIAN_POINT3"
    kind, body = statements[name]
    if kind in ("CARTESIAN_POINT", "DIRECTION"):
        return f"{kind}{body.count(',')}"  # after the name
    if kind in AS_THEIR_POINTS or (kind == "COMPLEX" and "B_SPLINE_" in body):
        first = re.search(r"#(\d+)", body)
        return kind + _kind(first.group(1), statements, points).rstrip("D")[-1] if first else kind
    return kind


def _check_references(statements: dict[str, tuple[str, str]], points: Set[str]) -> None:
    for number, (kind, body) in statements.items():
        try:
            kinds = " ".join([_kind(name, statements, points) for name in re.findall(r"#(\d+)", body)])
        except KeyError as error:
            raise ValueError(f"the file is damaged (entity #{error.args[0]} is missing); write it again") from error
        except RecursionError as error:
            raise ValueError(f"the file is damaged ({kind} #{number} refers to itself); write it again") from error
        expected = REFERENCES.get(kind)
        if expected is not None and not re.fullmatch(expected, kinds):
            raise ValueError(f"the file is damaged ({kind} #{number} refers to '{kinds[:80]}'); write it again")


def _check_curves(section: str) -> None:
    """Each B-spline curve has as many knots as its control points and degree ask for."""
    curves = SPLINE_CURVE.findall(section)
    if len(curves) != section.count("B_SPLINE_CURVE_WITH_KNOTS("):
        raise ValueError("the file is damaged (a B-spline curve is malformed); write it again")
    for degree, points, counts, values in curves:
        multiplicities = [int(count) for count in counts.split(",")]
        knots = [float(value) for value in values.split(",")]
        fits = sum(multiplicities) == points.count("#") + int(degree) + 1 and len(multiplicities) == len(knots)
        if not fits or sorted(set(knots)) != knots:
            raise ValueError("the file is damaged (a curve's knots do not fit its control points); write it again")
