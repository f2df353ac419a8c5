"""Wrong STEP texts, each made anew from its number: tokens, statements and references of a good text changed.

Standard library only; `g` is the random.Random of one input.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Sequence

from tests.hard_cases.fuzz import damaged, several


def lens_text(m: int = 5, rational: bool = False) -> str:
    """A small lens as a STEP file: two of its faces, the rest does not matter to a reader of text."""
    points = [f"#{i + 1} = CARTESIAN_POINT('',({i // m}.,{i % m:.14f},\n  {i / 7:.16E}));" for i in range(m * m)]
    net = ",".join("(" + ",".join(f"#{m * i + j + 1}" for j in range(m)) + ")" for i in range(m))
    counts, values = f"(3,{'1,' * (m - 3)}3)", f"({','.join(f'{i}.' for i in range(m - 1))})"
    knots = f"{counts},{counts},{values},{values},.UNSPECIFIED."
    surface = f"B_SPLINE_SURFACE_WITH_KNOTS('',2,2,({net}),.UNSPECIFIED.,.F.,.F.,.U.,{knots})"
    if rational:
        weights = ",".join("(" + ",".join(["1."] * m) + ")" for _ in range(m))
        surface = (
            f"( BOUNDED_SURFACE() B_SPLINE_SURFACE(2,2,({net}),.UNSPECIFIED.,.F.,.F.,.U.)\n"
            f" B_SPLINE_SURFACE_WITH_KNOTS({knots}) RATIONAL_B_SPLINE_SURFACE(({weights})) SURFACE() )"
        )
    return HEAD + "\n".join(points) + f"\n#500 = {surface};\n" + REST


HEAD = "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('lens'),'2;1');\nFILE_SCHEMA(('AP242'));\nENDSEC;\nDATA;\n"
REST = """#600 = PRODUCT('it''s \\X2\\93E1\\X0\\','','',());
#700 = VERTEX_POINT('',#1); #701 = LINE('',#1,#702); #702 = VECTOR('',#703,1.); #703 = DIRECTION('',(1.,0.,0.));
#710 = SURFACE_CURVE('',#711,(#712),.PCURVE_S1.); #712 = PCURVE('',#500,#713);
#711 = B_SPLINE_CURVE_WITH_KNOTS('',2,(#1,#2,#3),.UNSPECIFIED.,.F.,.F.,(3,3),(0.,1.),.UNSPECIFIED.);
#713 = DEFINITIONAL_REPRESENTATION('',(#714),#719); #714 = LINE('',#715,#716);
#715 = CARTESIAN_POINT('',(0.,1.E-01)); #716 = VECTOR('',#717,1.); #717 = DIRECTION('',(1.,0.));
#719 = ( GEOMETRIC_REPRESENTATION_CONTEXT(2) REPRESENTATION_CONTEXT('2D','') );
#720 = PLANE('',#721); #721 = AXIS2_PLACEMENT_3D('',#1,#703,$);
#800 = EDGE_CURVE('',#700,#700,#701,.T.); #801 = EDGE_CURVE('',#700,#700,#710,.T.);
#802 = ORIENTED_EDGE('',*,*,#800,.T.); #803 = ORIENTED_EDGE('',*,*,#800,.F.);
#804 = ORIENTED_EDGE('',*,*,#801,.T.); #805 = ORIENTED_EDGE('',*,*,#801,.F.);
#810 = EDGE_LOOP('',(#802,#804)); #811 = EDGE_LOOP('',(#803,#805));
#812 = FACE_BOUND('',#810,.T.); #813 = FACE_OUTER_BOUND('',#811,.T.);
#814 = ADVANCED_FACE('',(#812),#500,.T.); #815 = ADVANCED_FACE('',(#813),#720,.F.);
#816 = CLOSED_SHELL('',(#814,#815)); #817 = MANIFOLD_SOLID_BREP('',#816);
#900 = ( GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNIT_ASSIGNED_CONTEXT((#901,#902)) REPRESENTATION_CONTEXT('','') );
#901 = ( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );
#902 = ( NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.) );
ENDSEC;
END-ISO-10303-21;
"""
REALS = ("1.E999", "-1.E999", "1.E-999", "0.", "-0.", "1" * 400 + ".", "." + "1" * 40, "1.E", "nan", "1,5", "1e5", "1")
COUNTS = ("0", "-1", "3", "99999", "9" * 18, "9" * 19, "9" * 40, "9" * 5000, "2.", "1000000000", "²", "")
JUNK = (
    "(", ")", "((((", "))))", ";", ";;", "'", "''", "'''", ",", "$", "*", "#", "=", ".T.", ".U.", "/* x */", "\n", "\0",
    "\x1b[1m", "é", "#1=(#2)", "ENDSEC;", "DATA;", "END-ISO-10303-21;", "HEADER;", "()" * 200, "LENGTH_UNIT()", "!",
    "A(",
)  # fmt: skip
REFERENCE, REAL, WORD = (
    re.compile(r"#\d+"),
    re.compile(r"-?\d+\.\d*(?:E[-+]\d+)?"),
    re.compile(r"[A-Z][A-Z_0-9]{3,}|\.\w+\."),
)
COUNT = re.compile(r"(?<=[(,])\d+(?=[,)])")


def step(g: random.Random, texts: Sequence[str]) -> str:
    """A STEP text with a few things wrong."""
    changed = several(g, g.choice(texts), STEP_CHANGES)
    if g.random() < 0.1:
        changed = damaged(g, changed.encode("latin-1", "replace")).decode("latin-1")
    return changed


def _one(pattern: re.Pattern, replacement: Callable[[random.Random, str, str], str]) -> Callable:
    """A change of one hit of a pattern, looked for from a random place on."""

    def change(g: random.Random, text: str) -> str:
        hit = pattern.search(text, g.randrange(len(text) + 1)) or pattern.search(text)
        return text if hit is None else text[: hit.start()] + replacement(g, hit.group(), text) + text[hit.end() :]

    return change


def _anywhere(pattern: re.Pattern, g: random.Random, text: str) -> str:
    """Another hit of the pattern, from anywhere."""
    hit = pattern.search(text, g.randrange(len(text) + 1)) or pattern.search(text)
    return hit.group() if hit else ""


def _edited(g: random.Random, number: str, text: str) -> str:
    if g.random() < 0.5:
        return g.choice(REALS)
    place = g.randrange(len(number))
    return number[:place] + g.choice("0123456789.-E") + number[place + 1 :]


def _statements(g: random.Random, text: str) -> str:
    parts = text.split(";")
    i, j = g.randrange(len(parts)), g.randrange(len(parts))
    match g.randrange(5):
        case 0:
            del parts[i]
        case 1:
            parts.insert(i, parts[j])
        case 2:
            parts[i], parts[j] = parts[j], parts[i]
        case 3:  # the one's number before the other's attributes
            parts[i] = parts[j].partition("=")[0] + "=" + parts[i].partition("=")[2]
        case 4:  # an entity that refers to itself, or to one that refers to it
            number = parts[i].partition("=")[0].strip() or "#1"
            parts[j] = REFERENCE.sub(number, parts[j])
    return ";".join(parts)


def _claims(g: random.Random, text: str) -> str:
    old, new = g.choice([
        ("HEADER;", "HEADER;\nFILE_SIZE(2147483648);"), ("'AP242'", "'" + "A" * 9999 + "'"),
        ("FILE_SCHEMA", "FILE_SCHEM"), ("DATA;", "DATA;" * 300), ("MILLI", g.choice(["KILO", "", "NANO"])),
        (".MILLI.", "$"),
        ("PRODUCT('", "PRODUCT('" + "''" * 999),
        ("\\X2\\93E1", g.choice(["\\X2\\93", "\\X2\\D800", "\\X2\\GG", "\\X\\ZZ", "\\X2\\" + "93E1" * 9999])),
        ("RADIAN", "DEGREE"), ("GLOBAL_UNIT_ASSIGNED_CONTEXT((", "GLOBAL_UNIT_ASSIGNED_CONTEXT((#900,"),
        ("ISO-10303-21;", ""),
    ])  # fmt: skip
    return text.replace(old, new, g.choice([1, -1]))


STEP_CHANGES = (
    _one(REAL, _edited),
    _one(REFERENCE, lambda g, hit, text: _anywhere(REFERENCE, g, text)),
    _one(REFERENCE, lambda g, hit, text: f"#{g.choice(COUNTS)}"),
    _one(COUNT, lambda g, hit, text: g.choice(COUNTS)),
    _one(WORD, lambda g, hit, text: _anywhere(WORD, g, text)),
    _one(re.compile(r"[(),;=#']"), lambda g, hit, text: g.choice(JUNK)),
    _one(re.compile(r"\(\S*?\)"), lambda g, hit, text: "(" * (n := g.choice([2, 9, 2000])) + hit + ")" * n),
    _statements,
    _statements,
    _claims,
    lambda g, text: text[: g.randrange(len(text) + 1)] + g.choice(["", "\nENDSEC;\nEND-ISO-10303-21;\n"]),
)
