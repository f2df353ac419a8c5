"""Damaged STEP files of a whole lens, each made anew from its number: from a lost tail to a turned sense flag.

Standard library only; `g` is the random.Random of one file.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Mapping, Sequence

from tests.hard_cases import fuzz

NUMBER = re.compile(r"-?\d+\.\d+(?:E[-+]\d+)?")
REFERENCE = re.compile(r"(?<=[(,])#\d+")
FLAG = re.compile(r"\.[TF]\.")
END = "ENDSEC;\nEND-ISO-10303-21;\n"
NEAR = {  # kinds of entity whose few numbers, references and flags OCC builds the solid from
    kind: re.compile(rf"#\d+ = {kind}\([^;]*;")
    for kind in (
        "DIRECTION", "AXIS2_PLACEMENT_3D", "VECTOR", "LINE", "CIRCLE", "SPHERICAL_SURFACE", "PCURVE", "EDGE_CURVE",
        "ORIENTED_EDGE", "EDGE_LOOP", "FACE_BOUND", "ADVANCED_FACE", "CLOSED_SHELL", "VERTEX_POINT",
        "B_SPLINE_CURVE_WITH_KNOTS", "B_SPLINE_SURFACE_WITH_KNOTS", "SURFACE_CURVE", "UNCERTAINTY_MEASURE_WITH_UNIT",
    )
}  # fmt: skip
UNITS = (
    (".MILLI.,.METRE.", "$,.METRE."), (".MILLI.,.METRE.", ".MICRO.,.METRE."), (".MILLI.,.METRE.", ".CENTI.,.METRE."),
    (".MILLI.,.METRE.", ".MILLI.,.GRAM."), ("$,.RADIAN.", ".MILLI.,.RADIAN."), ("$,.RADIAN.", "$,.STERADIAN."),
    ("LENGTH_UNIT()", "MASS_UNIT()"), ("PLANE_ANGLE_UNIT()", "LENGTH_UNIT()"),
)  # fmt: skip


def solid(g: random.Random, text: str, others: Mapping[str, bytes]) -> tuple[str, bytes]:
    """(what was done, the file): the text of a lens damaged, or another file altogether."""
    name = g.choice((*DAMAGES, ANOTHER))
    if name == ANOTHER:
        name = g.choice(tuple(others))
        return name, others[name]
    return name, DAMAGES[name](g, text).encode("latin-1", "replace")


def _entity(g: random.Random, text: str) -> re.Match:
    """One entity of a kind chosen first, so that rare kinds have their turn."""
    hits: list[re.Match] = []
    while not hits:
        hits = list(NEAR[g.choice(tuple(NEAR))].finditer(text))
    return g.choice(hits)


def _within(pattern: re.Pattern, new: Callable[[random.Random, str], str]) -> Callable[[random.Random, str], str]:
    """A change of one hit of the pattern within one entity."""

    def change(g: random.Random, text: str) -> str:
        for _ in range(50):
            entity = _entity(g, text)
            hits = list(pattern.finditer(text, entity.start() + len(entity.group().split(" = ")[0]), entity.end()))
            if hits:
                hit = g.choice(hits)
                return text[: hit.start()] + new(g, hit.group()) + text[hit.end() :]
        return text

    return change


def _digit(g: random.Random, number: str) -> str:
    place = g.choice([i for i, c in enumerate(number) if c.isdigit()])
    return number[:place] + g.choice("0123456789") + number[place + 1 :]


def _other_number(g: random.Random, number: str) -> str:
    near = f"{float(number) + g.choice((1e-3, 1e-6, -1.0)):.14f}"
    return g.choice(("0.", "-" + number.lstrip("-"), number.lstrip("-"), "1.E9", "1.E300", "-1.E-9", "3.5", near))


def _any_point(g: random.Random, text: str) -> str:
    """A digit of any number of the file: mostly of a control point."""
    hit = g.choice(list(NUMBER.finditer(text)))
    return text[: hit.start()] + _digit(g, hit.group()) + text[hit.end() :]


def _list_changed(g: random.Random, text: str) -> str:
    """A loop, a shell or a net that names one entity twice, leaves one out, or in another order."""
    kind = g.choice(("EDGE_LOOP", "CLOSED_SHELL", "ADVANCED_FACE", "SURFACE_CURVE", "B_SPLINE_SURFACE_WITH_KNOTS"))
    hit = g.choice(list(NEAR[kind].finditer(text)))
    body, names = hit.group(), REFERENCE.findall(hit.group())
    a, b = g.choice(names), g.choice(names)
    swapped = body.replace(a, "#x", 1).replace(b, a, 1).replace("#x", b, 1)
    changed = (body.replace(a, f"{a},{a}", 1), body.replace(f"{a},", "", 1), swapped, body.replace(a, b, 1))
    return text[: hit.start()] + g.choice(changed) + text[hit.end() :]


def _loop_twice(g: random.Random, text: str) -> str:
    """One face bounded by another's loop."""
    bounds = re.findall(r"FACE_BOUND\('',#\d+,", text)
    one, other = g.choice(bounds), g.choice(bounds)
    return text.replace(one, other, 1)


def _statements(g: random.Random, text: str) -> str:
    """An entity lost, doubled under another number, or two that changed numbers."""
    a, b = _entity(g, text), _entity(g, text)
    number, other = (f"{hit.group().split(' = ')[0]} = " for hit in (a, b))
    swapped = text.replace(number, "#x = ", 1).replace(other, number, 1).replace("#x = ", other, 1)
    doubled = a.group().replace(number, "#99999 = ", 1) + "\n"
    return g.choice((text[: a.start()] + text[a.end() :], text[: a.start()] + doubled + text[a.start() :], swapped))


IMMATERIAL: tuple[Callable[[str], str], ...] = (  # to a reader of shapes
    lambda text: re.sub(r"'\d{4}-\d\d-\d\dT[\d:]+'", "'2001-01-01T00:00:00'", text),
    lambda text: text.replace("PRODUCT('small','small'", "PRODUCT('part 7','rev B'"),
    lambda text: text.replace(",", ",\n  ").replace(" = ", "="),
    lambda text: re.sub(r"#(\d+)", lambda hit: f"#{int(hit.group(1)) + 5000}", text),
    lambda text: NUMBER.sub(lambda hit: f"{float(hit.group()):.17E}", text),
    lambda text: text.replace("DATA;", "DATA;\n#777777 = DIRECTION('stray',(0.,0.,1.));", 1),
)
DAMAGES: Mapping[str, Callable[[random.Random, str], str]] = {
    "cut": lambda g, text: text[: g.randrange(len(text))],
    "cut and closed": lambda g, text: text[: text.rfind(";", 0, g.randrange(2000, len(text))) + 1] + END,
    "bytes": lambda g, text: fuzz.damaged(g, text.encode("latin-1")).decode("latin-1"),
    "a digit anywhere": _any_point,
    "a digit": _within(NUMBER, _digit),
    "a number": _within(NUMBER, _other_number),
    "a reference": lambda g, text: _within(REFERENCE, lambda g, hit: g.choice(REFERENCE.findall(text)))(g, text),
    "a flag": _within(FLAG, lambda g, flag: {".T.": ".F.", ".F.": ".T."}[flag]),
    "a list": _list_changed,
    "a loop twice": _loop_twice,
    "a statement": _statements,
    "a unit": lambda g, text: text.replace(*g.choice(UNITS)),
    "immaterial": lambda g, text: g.choice(IMMATERIAL)(text),
}
ANOTHER = "another file"


def refuse(g: random.Random) -> Sequence[tuple[str, bytes]]:
    """Files that hold nothing of the kind."""
    head = b"ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('2147483648 bytes'),'2;1');\nFILE_SCHEMA(('AP242'));\n"
    head += b"ENDSEC;\nDATA;\n"
    return (
        ("empty", b""), ("a header alone", head + END.encode()), ("rubbish", g.randbytes(50_000)),
        ("zeros", bytes(100_000)), ("UTF-16", "ISO-10303-21;".encode("utf-16")),
        ("a claim of 2 GB", head + b"#2147483647=CARTESIAN_POINT('',(0.,0.,0.));\n" + END.encode()),
        ("brackets", head + b"#1=" + b"(" * 300_000 + END.encode()),
    )  # fmt: skip
