"""Wrong input by the hundred thousand, each made anew from its number, by which a fault is found again; here scenes.

Standard library only.  `g` is the random.Random of one input; most inputs are one to three changes away from a good
one, so that they are refused deep inside, or not at all.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Sequence
from typing import Any

# ---- bytes ---------------------------------------------------------------------------------------------------------


def generator(reader: str, seed: int, number: int) -> random.Random:
    """The one source of chance of one input."""
    return random.Random(f"{reader} {seed} {number}")


def damaged(g: random.Random, data: bytes) -> bytes:
    """Bytes flipped, cut, put in, doubled, moved, or the end lost."""
    a, b = sorted((g.randrange(len(data) + 1), g.randrange(len(data) + 1)))
    b = min(b, a + g.choice([1, 2, 8, 100]))
    match g.randrange(6):
        case 0 if data:
            a = min(a, len(data) - 1)
            return data[:a] + bytes([data[a] ^ g.randrange(1, 256)]) + data[a + 1 :]
        case 1:
            return data[:a] + data[b:]
        case 2:
            return data[:a] + g.randbytes(g.choice([1, 2, 8])) + data[a:]
        case 3:
            return data[:b] + data[a:]
        case 4:
            c = g.randrange(len(data) + 1)
            return data[:c] + data[a:b] + data[c:]
    return data[:a]


def several(g: random.Random, thing: Any, changes: Sequence[Callable]) -> Any:
    """One to three changes, one after the other."""
    for _ in range(g.choice([1, 1, 1, 2, 3])):
        thing = g.choice(changes)(g, thing)
    return thing


# ---- scenes --------------------------------------------------------------------------------------------------------

SCENES = (
    """name = "a"
title = "A disc"
[source]
kind = "point"
position = [0.5, 0.0, -60.0]
wavelength = 650.0
profile = "lambertian"
[lens]
material = "PMMA"
outline = { shape = "rectangle", width = 8.0, height = 6.0 }
front = { kind = "sphere", z = 15.0, curvature = 0.002, optimise = true }
back = { kind = "bspline", z = 25.0, control_points = 9 }
[target]
z = 1000.0
x = [-30.0, 30.0]
y = [-25.0, 25.0]
pixels = 8
uniform = true
outline = { shape = "circle", radius = 20.0 }
[tailoring]
quality = "draft"
seed = 0
levels = [5, 9]
[accept]
rrmsd = 0.1
""",
    """name = "b"
[source]
kind = "collimated"
aperture = { shape = "circle", diameter = 20 }
profile = "gaussian"
radius_1e2 = 8.0
[lens]
index = 1.5
outline = { shape = "circle", radius = 12 }
front = { kind = "plane", z = 8.0 }
back = { kind = "bspline", z = 20.0, control_points = 17 }
[target]
z = 1e3
x = [0, 400.0]
y = [0, 400.0]
pixels = 12
image = "a.png"
gamma = 2.2
[tailoring]
accuracy = 0.05
max_time = 60
""",
    """name = "c"
source = { kind = "point", profile = "uniform", half_angle = 30.0 }
accept = { form = 1e-6, efficiency = 0.9 }
[lens]
material = "N-BK7"
outline = { shape = "rectangle", width = 24.0, height = 24.0 }
front = { kind = "plane", z = 8.0 }
back = { kind = "bspline", z = 20.0, control_points = 33 }
[target]
z = 300.0
x = [-40.0, 40.0]
y = [-40.0, 40.0]
pixels = 8
text = "A b"
""",
)
NUMBERS = (
    "0", "-1", "-0.0", "1e-320", "1e-9", "1e9", "1e300", "1e308", "1e999", "-1e999", "nan", "-inf", "1_0", "0x7f",
    "0b1", "9" * 30, "9" * 5000, "0x" + "f" * 5000, "0x" + "f" * 5000 + "p", "1.", ".5", "1e", "300", "4097",
    "2.0000001",     "1979-05-27", "07:32:00", "true", "false", "''", "[]", "{}", "[[]]", "[[1.0]]", "{ a = 1 }",
)  # fmt: skip
TEXTS = (
    "../../x", "/etc/passwd", "/etc/shadow", "/proc/self/mem", "/proc/kmsg", "/dev/zero", "/dev/stdin", "C:\\\\x", ".",
    "..", "NUL", "a\\u0000b", "a\\u001b[31mb", "a\\nb", "x" * 5000, "\\U0001F600", "ⅳ", "\\u202e", "\\ud800", "ß" * 300,
    "~/x", "%s%n", "{0}", "$(x)", "point", "circle", "PMMA", "astronaut", "a.png", "", " ", "/", "//a/b", "fine", "\\",
    "a.b.c", "林", "\u200b", "\u2028x", "A\\rB", "\u0301", "\u202eabc\u05d0", "A\\n\\nB", "\\uFFFF", "/" + "a/" * 2100, "file:///etc/passwd",
)  # fmt: skip
KEYS = (
    "name", "title", "kind", "z", "x", "pixels", "text", "uniform", "sample", "image", "effects", "outline", "levels",
    "a.b.c", '"a\\nb"', '"a\\u001b[1mb"', '""', "'.'", "diameter", "curvature", "index", "seed", "half_angle",
)  # fmt: skip
VALUE = re.compile(r'(?<== )(?:"[^"\n]*"|\[[^\]\n]*\]|\{[^}\n]*\}|[-+\w.]+)|(?<=[\[ ])-?\d+(?:\.\d+)?')


def scene(g: random.Random) -> tuple[bytes, dict[str, Any]]:
    """A scene file, and what is to go before it."""
    changed = several(g, g.choice(SCENES), SCENE_CHANGES).encode("utf-8", "surrogatepass")
    if g.random() < 0.1:
        changed = damaged(g, changed)
    return changed, _overrides(g) if g.random() < 0.2 else {}


def _value(g: random.Random) -> str:
    """Something that could stand behind '='."""
    kind = g.randrange(10)
    if kind < 5:
        return g.choice(NUMBERS)
    if kind < 9:
        return f'"{g.choice(TEXTS)}"'
    depth = g.choice([3, 50, 200, 400, 3000])
    left, right = g.choice([("[", "]"), ("{ a = ", " }")])
    return left * depth + "1" + right * depth


def _other_number(g: random.Random, text: str) -> str:
    """One that may well be right."""
    found = list(re.finditer(r"(?<=[ \[])-?\d+(?:\.\d+)?(?=[ \],\n])", text))
    if not found:
        return text
    hit = g.choice(found)
    number = float(hit.group()) * g.choice((-1, 0, 0.01, 0.5, 0.9, 1.1, 2, 100)) + g.choice((-1, 0, 0, 1))
    new = f"{number:.0f}" if "." not in hit.group() else repr(number)
    return text[: hit.start()] + new + text[hit.end() :]


def _other_value(g: random.Random, text: str) -> str:
    found = list(VALUE.finditer(text))
    if not found:
        return text
    hit = g.choice(found)
    return text[: hit.start()] + _value(g) + text[hit.end() :]


def _swapped_values(g: random.Random, text: str) -> str:
    found = list(VALUE.finditer(text))
    if len(found) < 2:
        return text
    a, b = sorted(g.sample(found, 2), key=lambda hit: hit.start())
    if a.end() > b.start():
        return text
    return text[: a.start()] + b.group() + text[a.end() : b.start()] + a.group() + text[b.end() :]


def _changed_lines(g: random.Random, text: str) -> str:
    lines = text.split("\n")
    i, j = g.randrange(len(lines)), g.randrange(len(lines))
    match g.randrange(5):
        case 0:
            del lines[i]
        case 1:
            lines.insert(i, lines[j])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case 3:
            lines.insert(i, f"{g.choice(KEYS)} = {_value(g)}")
        case 4:
            lines.insert(
                i,
                g.choice(["[a]", "[[effects]]", "[lens.back]", "[source.x.y]", "[" + "a." * g.choice([9, 99]) + "b]"]),
            )
    return "\n".join(lines)


def _other_key(g: random.Random, text: str) -> str:
    found = list(re.finditer(r"[a-z_0-9]+(?= = )|(?<=\[)[a-z]+(?=\])", text))
    if not found:
        return text
    hit = g.choice(found)
    new = g.choice(
        [
            *KEYS,
            hit.group()[:-1],
            hit.group().upper(),
            hit.group() + "." + hit.group(),
            "a." * g.choice([30, 1500]) + "a",
        ]
    )
    return text[: hit.start()] + new + text[hit.end() :]


SCENE_CHANGES = (_other_number, _other_number, _other_number, _other_value, _swapped_values, _changed_lines, _other_key)


def _overrides(g: random.Random) -> dict[str, Any]:
    keys = ("name", "target.pixels", "target.x", "lens.back.z", "source", "lens.outline", "effects", "tailoring.seed")
    odd = ("", ".", "a..b", "target.x.y", "a\nb", "\x1b[1m", "a." * 1200 + "a", "\udcff", "target." + "x" * 3000)
    values = (
        None,
        True,
        3,
        2.5,
        1e400,
        10**400,
        [],
        {},
        [[[]]],
        {"a": {"b": 1}},
        {1: 2},
        b"x",
        (1, 2),
        "\udcff",
        "3\na = 1",
    )
    return {
        g.choice(keys if g.random() < 0.7 else odd): g.choice(values) if g.random() < 0.5 else _value(g)
        for _ in range(g.choice([1, 1, 2]))
    }
