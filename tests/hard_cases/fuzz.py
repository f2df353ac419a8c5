"""Wrong scenes by the hundred thousand, each made anew from its number, by which a fault is found again.

`g` is the random.Random of one input; most inputs are one to three changes away from a good one, so that they are
refused deep inside, or not at all.  Not by hypothesis: a process of its own feeds thousands a second and is watched
for memory and files (readers.py), where an example of hypothesis costs a millisecond and shrinking hides the number.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Sequence
from typing import Any

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
)
ODD = (  # behind "="
    "0", "-1", "-0.0", "1e-320", "1e9", "1e308", "1e999", "nan", "-inf", "1_0", "0x7f", "9" * 30, "9" * 5000, "1.",
    "0x" + "f" * 5000, "2.0000001", "1979-05-27", "07:32:00", "true", "[]", "{}", "[[1.0]]", "{ a = 1 }",
    *("[" * depth + "1" + "]" * depth for depth in (3, 200, 3000)), "{ a = " * 400 + "1" + " }" * 400,
    *(f'"{text}"' for text in (
        "../../x", "/etc/passwd", "/proc/self/mem", "/dev/zero", "C:\\\\x", "NUL", "a\\u0000b", "a\\u001b[31mb",
        "a\\nb", "x" * 5000, "\\U0001F600", "\\u202e", "\\ud800", "~/x", "{0}", "point", "circle", "PMMA", "a.png", "",
        " ", "\\", "林", "\u2028x", "A\\rB", "\u202eabc\u05d0", "/" + "a/" * 2100, "file:///etc/passwd",
    )),
)  # fmt: skip
KEYS = (
    "name", "title", "kind", "z", "x", "pixels", "text", "uniform", "image", "effects", "outline", "levels", "a.b.c",
    '"a\\nb"', '"a\\u001b[1mb"', '""', "diameter", "curvature", "index", "seed", "half_angle", "a." * 1500 + "a",
)  # fmt: skip
LINES = ("[a]", "[[effects]]", "[lens.back]", "[source.x.y]", "[" + "a." * 99 + "b]")
VALUE = re.compile(r'(?<== )(?:"[^"\n]*"|\[[^\]\n]*\]|\{[^}\n]*\}|[-+\w.]+)|(?<=[\[ ])-?\d+(?:\.\d+)?')
NUMBER = re.compile(r"(?<=[ \[])-?\d+(?:\.\d+)?(?=[ \],\n])")
KEY = re.compile(r"[a-z_0-9]+(?= = )|(?<=\[)[a-z]+(?=\])")


def generator(reader: str, seed: int, number: int) -> random.Random:
    """The one source of chance of one input."""
    return random.Random(f"{reader} {seed} {number}")


def damaged(g: random.Random, data: bytes) -> bytes:
    """Bytes flipped, cut, put in, doubled, moved, or the end lost."""
    a = g.randrange(len(data) + 1)
    b = min(len(data), a + g.choice((1, 2, 8, 100)))
    c = g.randrange(len(data) + 1)
    flipped = bytes([data[a] ^ g.randrange(1, 256)]) if a < len(data) else b""
    return g.choice((
        data[:a] + flipped + data[a + 1 :], data[:a] + data[b:], data[:a] + g.randbytes(g.choice((1, 8))) + data[a:],
        data[:b] + data[a:], data[:c] + data[a:b] + data[c:], data[:a],
    ))  # fmt: skip


def several(g: random.Random, thing: Any, changes: Sequence[Callable]) -> Any:
    """One to three changes, one after the other."""
    for _ in range(g.choice([1, 1, 1, 2, 3])):
        thing = g.choice(changes)(g, thing)
    return thing


def scene(g: random.Random) -> tuple[bytes, dict[str, Any]]:
    """A scene file, and overrides for it."""
    changes = (_number, _number, _number, _value, _swapped, _line, _key)
    changed = several(g, g.choice(SCENES), changes).encode("utf-8", "surrogatepass")
    return damaged(g, changed) if g.random() < 0.1 else changed, _overrides(g) if g.random() < 0.2 else {}


def _replaced(g: random.Random, text: str, pattern: re.Pattern, new: Callable[[str], str]) -> str:
    """The text with one of the pattern's hits made new."""
    hits = list(pattern.finditer(text))
    if not hits:
        return text
    hit = g.choice(hits)
    return text[: hit.start()] + new(hit.group()) + text[hit.end() :]


def _number(g: random.Random, text: str) -> str:
    """Another number, that may well be right."""

    def new(old: str) -> str:
        number = float(old) * g.choice((-1, 0, 0.01, 0.5, 0.9, 1.1, 2, 100)) + g.choice((-1, 0, 0, 1))
        return f"{number:.0f}" if "." not in old else repr(number)

    return _replaced(g, text, NUMBER, new)


def _value(g: random.Random, text: str) -> str:
    return _replaced(g, text, VALUE, lambda old: g.choice(ODD))


def _swapped(g: random.Random, text: str) -> str:
    """A value where another one stood."""
    other = g.choice(VALUE.findall(text) or ["1"])
    return _replaced(g, text, VALUE, lambda old: other)


def _line(g: random.Random, text: str) -> str:
    """A line lost, doubled, moved, or a strange one put in."""
    lines = text.split("\n")
    i, new = g.randrange(len(lines)), f"{g.choice(KEYS)} = {g.choice(ODD)}"
    lines[i : i + g.randrange(2)] = g.choice(([], [g.choice(lines)], [new], [new], [g.choice(LINES)]))
    return "\n".join(lines)


def _key(g: random.Random, text: str) -> str:
    return _replaced(g, text, KEY, lambda old: g.choice((*KEYS, old[:-1], old.upper(), f"{old}.{old}")))


def _overrides(g: random.Random) -> dict[str, Any]:
    keys = ("name", "target.pixels", "target.x", "lens.back.z", "source", "lens.outline", "effects", "tailoring.seed")
    odd = ("", ".", "a..b", "target.x.y", "a\nb", "\x1b[1m", "a." * 1200 + "a", "\udcff", "target." + "x" * 3000)
    values = (None, True, 3, 2.5, 1e400, 10**400, [], {}, [[[]]], {"a": {"b": 1}}, {1: 2}, b"x", (1, 2), "\udcff",
              "3\na = 1")  # fmt: skip
    key = g.choice(keys if g.random() < 0.7 else odd)
    return {key: g.choice(values) if g.random() < 0.5 else g.choice(ODD)}
