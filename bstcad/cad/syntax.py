"""Is the text of a STEP file whole?  Asked before OCC reads it: some files that are not whole end the process there.

Part 21 in four questions: is each statement an entity, is each attribute a token of the language, does each reference
lead to an entity of the kind that geometry and topology need there, and does each spline have the knots it asks for?
`data` is a file without strings ('' in their place) and without blanks.
"""

from __future__ import annotations

import re

import numpy as np

REAL = r"[-+]?\d+\.\d*(?:E[-+]?\d+)?"
NUMBER = rf"(?:{REAL}|[-+]?\d+)"
NUMBERS = rf"{NUMBER}(?:,{NUMBER})*"
NO_TOKEN = re.compile(rf"[(,](?!(?:#\d+|{NUMBER}|\.\w+\.|[*$]|''|)[,)]|\(|[A-Z][A-Z_0-9]*\()[^,)]*")
POINTS = re.compile(rf"(?:CARTESIAN_POINT|DIRECTION)\('',\({REAL}(?:,{REAL}){{1,2}}\)\);")

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


def check(data: str) -> None:
    """ValueError in one sentence unless the data section of the file is whole."""
    section = data[data.find("DATA;") + 5 : data.rfind("ENDSEC;")]
    statements = _statements(section)
    stray = NO_TOKEN.search(section)
    if stray:
        raise ValueError(f"the file is damaged ('{stray.group()[1:30]}' is no value); write it again")
    if len(POINTS.findall(section)) != section.count("=CARTESIAN_POINT(") + section.count("=DIRECTION("):
        raise ValueError("the file is damaged (a CARTESIAN_POINT or DIRECTION holds no numbers); write it again")
    _check_references(statements)
    _check_curves(section)


def _statements(section: str) -> dict[str, tuple[str, str]]:
    """Entity number -> (kind, attributes); a complex entity's kind is COMPLEX."""
    characters = np.frombuffer(section.encode("latin-1", "replace"), dtype=np.uint8)
    turns = (characters == ord("(")).astype(np.int8) - (characters == ord(")"))
    depth = np.cumsum(turns, dtype=np.int32)
    ends = np.flatnonzero(characters == ord(";"))
    found = re.findall(r"#(\d+)=([A-Z][A-Z_0-9]*)?(\([^;]*\));", section)
    if len(found) != len(ends) or not len(ends) or ends[-1] != len(section) - 1 or depth[ends].any() or depth.min() < 0:
        raise ValueError("the file is damaged (a statement is no entity); write it again")
    statements = {number: (kind or "COMPLEX", body) for number, kind, body in found}
    if len(statements) != len(found):
        raise ValueError("the file is damaged (two entities share a number); write it again")
    return statements


def _kind(name: str, statements: dict[str, tuple[str, str]]) -> str:
    """The kind of an entity, with 2 or 3 behind it where it lies in the plane of a face or in space."""
    kind, body = statements[name]
    if kind in ("CARTESIAN_POINT", "DIRECTION"):
        return f"{kind}{body.count(',')}"  # after the name
    if kind in AS_THEIR_POINTS or (kind == "COMPLEX" and "B_SPLINE_" in body):
        first = re.search(r"#(\d+)", body)
        return kind + _kind(first.group(1), statements).rstrip("D")[-1] if first else kind
    return kind


def _check_references(statements: dict[str, tuple[str, str]]) -> None:
    for number, (kind, body) in statements.items():
        if kind in ("CARTESIAN_POINT", "DIRECTION"):  # nearly all of a file, and they refer to nothing
            continue
        try:
            kinds = " ".join([_kind(name, statements) for name in re.findall(r"#(\d+)", body)])
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
