"""Wrong input for the readers, drawn by hypothesis: good texts and pictures with one to three changes, mostly deep."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st
from PIL import Image

from tests.benchmarks.cold import TEMPLATES

# ---- texts: tokens and statements of a good one exchanged, lost, doubled, or odd -------------------------------------

CLASSES = {
    "string": r"'(?:[^']|'')*'|\"[^\"\n]*\"", "reference": r"#\d+", "number": r"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?",
    "flag": r"\.\w+\.", "word": r"\w+", "mark": r"[^\s\w]", "blank": r"\s+",
}  # fmt: skip
TOKEN = re.compile("|".join(f"(?P<{name}>{pattern})" for name, pattern in CLASSES.items()))
NESTED = (*("[" * depth + "1" + "]" * depth for depth in (3, 200, 3000)), "{ a = " * 400 + "1" + " }" * 400)
WORDS = (
    "../../x", "/etc/passwd", "/proc/self/mem", "/dev/zero", "C:\\\\x", "NUL", "a\\u0000b", "a\\u001b[31mb", "a\\nb",
    "x" * 5000, "\\U0001F600", "\\u202e", "\\ud800", "~/x", "{0}", "point", "circle", "", " ", "\\", "林", "\u2028x",
    "A\\rB", "/" + "a/" * 2100, "file:///etc/passwd", "\\X2\\93", "\\X2\\D800", "\\X2\\GG", "\\X\\ZZ", "\\X2\\" * 999,
)  # fmt: skip
ODD = (  # in place of any token
    "0", "-1", "-0.", "1e-320", "1.E-999", "1.E999", "1e999", "-inf", "nan", "1_0", "0x7f", "1.", "1,5", "²", "3", "",
    *("9" * digits for digits in (18, 19, 40, 5000)), "0x" + "f" * 5000, "#1", "#0", "#" + "9" * 40, "$", "*", "!", "=",
    ";", "1979-05-27", "07:32:00", "true", ".T.", ".U.", "[]", "{}", "[[1.0]]", "{ a = 1 }", "(", "))))", "()" * 200,
    *NESTED, "(" * 2000 + "1" + ")" * 2000, "A(", "/* x */", "'", "''" * 999, '"', "\0", "\x1b[1m", "é", "\n",
    "ENDSEC;", "DATA;", "END-ISO-10303-21;", "HEADER;", "#1=(#2)", "LENGTH_UNIT()", "a." * 1500 + "a",
    "[" + "a." * 99 + "b]", *(f"{quote}{word}{quote}" for quote in "\"'" for word in WORDS),
    "name", "kind", "z", "x", "pixels", "image", "effects", "outline", "levels", "a.b.c", "index", "[[effects]]",
)  # fmt: skip
FACTORS = (-1.0, 0.0, 0.01, 0.5, 0.999999, 1.000001, 1.1, 2.0, 100.0, 1e9, 1e300)


class Good:
    """A good text in tokens; `groups` gathers what may change places: tokens of one class in statements of one kind."""

    def __init__(self, text: str, end: str):
        self.text, self.tokens = text, []
        self.groups: dict[tuple[str, str], list[int]] = {}
        self.statements = [0]  # the tokens with which they begin
        word = ""
        for hit in TOKEN.finditer(text):
            here, kind = len(self.tokens), str(hit.lastgroup)
            self.tokens.append(hit.group())
            word = word or (hit.group() if kind == "word" else "")
            if kind != "blank":
                self.groups.setdefault((word, kind), []).append(here)
            if end in hit.group():
                self.statements.append(here + 1)
                word = ""
        self.exchanged = [places for (_, kind), places in self.groups.items() if kind != "mark"]
        self.numbers = [places for (_, kind), places in self.groups.items() if kind == "number"]


def _pick(draw: Callable, among: Sequence) -> Any:
    return among[draw(st.integers(0, len(among) - 1))]


def exchange(draw: Callable, good: Good, tokens: list[str]) -> None:
    """A token of one class and kind of statement takes its place: a flag is turned, a reference leads elsewhere."""
    group = _pick(draw, good.exchanged)
    tokens[_pick(draw, group)] = tokens[_pick(draw, group)]


def digit(draw: Callable, good: Good, tokens: list[str]) -> None:
    """A digit of any number: of a STEP file mostly that of a control point."""
    place = _pick(draw, [place for places in good.numbers for place in places])
    if digits := [k for k, letter in enumerate(tokens[place]) if letter.isdigit()]:
        at = _pick(draw, digits)
        tokens[place] = tokens[place][:at] + _pick(draw, "0123456789") + tokens[place][at + 1 :]


def number(draw: Callable, good: Good, tokens: list[str]) -> None:
    """Another number, that may well be right."""
    place = _pick(draw, _pick(draw, good.numbers))
    with contextlib.suppress(ValueError):
        near = float(tokens[place]) * _pick(draw, FACTORS) + _pick(draw, (0.0, 0.0, 1e-6, 1.0))
        tokens[place] = f"{near:.14f}" if "." in tokens[place] else f"{near:.0f}"


def odd(draw: Callable, good: Good, tokens: list[str]) -> None:
    tokens[_pick(draw, _pick(draw, list(good.groups.values())))] = _pick(draw, ODD)


def statement(draw: Callable, good: Good, tokens: list[str]) -> None:
    """A statement lost, doubled, or in place of another; or a token twice, as in a list."""
    ends = [*good.statements[1:], len(tokens)]
    (a, b), (c, d) = (_pick(draw, list(zip(good.statements, ends, strict=True))) for _ in range(2))
    new = _pick(draw, ([], 2 * tokens[a:b], tokens[c:d], [*tokens[a:b], *tokens[c:d]]))
    if a < b:
        tokens[a:b] = ["".join(new), *[""] * (b - a - 1)]


def cut(draw: Callable, good: Good, tokens: list[str]) -> None:
    """The end lost, or a part; some are closed again as a STEP file is."""
    low, high = sorted(draw(st.integers(0, len(tokens))) for _ in range(2))
    high = draw(st.sampled_from((high, len(tokens))))
    tokens[low:high] = [""] * (high - low)
    if high == len(tokens) > low and draw(st.booleans()):
        tokens[low] = ";\nENDSEC;\nEND-ISO-10303-21;\n"


CHANGES = (exchange, exchange, number, digit, statement, odd, odd, cut)


@st.composite
def texts(draw: Callable, goods: Sequence[Good], changes: Sequence[Callable] = CHANGES, most: int = 3) -> str:
    """One of the good texts with some changes."""
    good = _pick(draw, goods)
    tokens = list(good.tokens)
    for _ in range(draw(st.integers(1, most))):
        _pick(draw, changes)(draw, good, tokens)
    return "".join(tokens)


@st.composite
def damaged(draw: Callable, data: bytes) -> bytes:
    """Bytes flipped, cut, put in, doubled, moved, or the end lost."""
    a, c = (draw(st.integers(0, len(data))) for _ in range(2))
    b = min(len(data), a + draw(st.sampled_from((1, 2, 8, 100))))
    new = draw(st.binary(min_size=1, max_size=8))
    return draw(st.sampled_from((
        data[:a] + new + data[a + len(new) :], data[:a] + data[b:], data[:a] + new + data[a:], data[:b] + data[a:],
        data[:c] + data[a:b] + data[c:], data[:a],
    )))  # fmt: skip


def mostly(strategy: st.SearchStrategy[str], encoding: str = "utf-8") -> st.SearchStrategy[bytes]:
    """The texts as files, one of ten with damaged bytes."""
    data = strategy.map(lambda text: text.encode(encoding, "surrogatepass" if encoding == "utf-8" else "replace"))
    return st.integers(0, 9).flatmap(lambda tenth: data if tenth else data.flatmap(damaged))


@functools.cache
def scenes() -> tuple[Good, ...]:
    """Templates without comments, at eight pixels."""
    names = ("disk", "led", "machinable_letters", "mirror", "off_axis", "sun_caustic", "white_logo")
    bare = (re.sub(r"(?m)\s*#.*$", "", (TEMPLATES / f"{name}.toml").read_text(encoding="utf-8")) for name in names)
    return tuple(Good(re.sub(r"pixels = .*", "pixels = 8", text), "\n") for text in bare)


KEYS = (
    "name", "target.pixels", "target.x", "lens.back.z", "source", "lens.outline", "effects", "tailoring.seed", "", ".",
    "a..b", "target.x.y", "a\nb", "\x1b[1m", "a." * 1200 + "a", "\udcff", "target." + "x" * 3000,
)  # fmt: skip
VALUES = (
    None, True, 3, 2.5, 1e400, 10**400, [], {}, [[[]]], {"a": {"b": 1}}, {1: 2}, b"x", (1, 2), "\udcff", "3\na = 1",
    *ODD,
)  # fmt: skip
OVERRIDES = st.dictionaries(st.sampled_from(KEYS), st.sampled_from(VALUES), max_size=1)

# ---- pictures: files of every format that Pillow writes, with numbers that lie ---------------------------------------

SIZES = (0, 1, 2, 7, 255, 2000, 65_535, 65_536, 64_000_000, 2**31 - 1, 2**31, 2**32 - 1)
BOMBS = tuple(zlib.compress(bytes(size)) for size in (100, 5_000_000))
MODES = {
    "PNG": ("1", "L", "LA", "P", "RGB", "RGBA", "I;16"), "TIFF": ("1", "L", "P", "RGB", "RGBA", "CMYK", "F", "I;16"),
    "JPEG": ("L", "RGB", "CMYK"), "WEBP": ("RGB", "RGBA"), "BMP": ("1", "L", "P", "RGB"), "HEIF": ("RGB", "RGBA"),
}  # fmt: skip
OPTIONS = {
    "TIFF": ({}, {"compression": "tiff_adobe_deflate"}, {"compression": "tiff_lzw"}, {"compression": "packbits"}),
    "WEBP": ({}, {"lossless": True}, {"save_all": True, "append_images": 1}),
}


@functools.cache
def good_picture(form: str, mode: str, number: int = 0, side: int = 8) -> bytes:
    """A small picture as Pillow writes it."""
    if form == "HEIF":
        import pillow_heif

        pillow_heif.register_heif_opener()
    noise = np.random.default_rng(0).integers(0, 256, (side, side, 3), dtype=np.uint8)
    image = Image.fromarray(noise).convert("L" if mode == "I;16" else mode).convert(mode)
    more = dict(OPTIONS.get(form, ({},))[number])
    if "append_images" in more:
        more["append_images"] = [image.rotate(90)]
    out, exif = io.BytesIO(), Image.Exif()
    exif[274] = 6  # turned
    image.save(out, form, **more, **({"exif": exif} if form in ("PNG", "JPEG", "WEBP") else {}))
    return out.getvalue()


@st.composite
def lying(draw: Callable, data: bytes) -> bytes:
    """Two or four bytes, mostly in the header, replaced by a number that means something, in either order of bytes."""
    order, size = draw(st.sampled_from("<>")), draw(st.sampled_from("HI"))
    number = draw(st.one_of(st.sampled_from(SIZES), st.integers(0, 300)))
    new = struct.pack(order + size, number % 256 ** struct.calcsize(size))
    place = draw(st.integers(0, max(0, draw(st.sampled_from((64, len(data)))) - len(new))))
    return data[:place] + new + data[place + len(new) :]


@st.composite
def chunks(draw: Callable) -> bytes:
    """A chunk that may stand in a PNG beside the picture's own, its contents right or not, without its checksum."""
    profile = struct.pack(">I4xI4s4s4s12x4s", 184, 0x02400000, b"mntr", b"GRAY", b"XYZ ", b"acsp").ljust(184, b"\0")
    any_bytes, bomb, size = draw(st.binary(max_size=40)), draw(st.sampled_from(BOMBS)), st.sampled_from(SIZES)
    name, content = draw(st.sampled_from((
        *((name, any_bytes) for name in (b"tRNS", b"sRGB", b"cICP", b"PLTE", b"cHRM", any_bytes[:4].ljust(4))),
        (b"gAMA", struct.pack(">I", draw(size))), (b"iCCP", b"key\0\0" + zlib.compress(draw(lying(profile)))),
        (b"iCCP", b"key\0\0" + bomb), (b"zTXt", b"key\0\0" + bomb), (b"iTXt", b"key\0\1\0\0\0" + bomb),
        (b"acTL", struct.pack(">II", draw(size), 0)), (b"fdAT", struct.pack(">I", 1) + any_bytes),
        (b"fcTL", struct.pack(">IIIIIHHBB", 0, *(draw(size) for _ in range(4)), 1, 1, 0, 0)),
    )))  # fmt: skip
    return struct.pack(">I", len(content)) + name + content + bytes(4)


@st.composite
def pictures(draw: Callable) -> bytes:
    """A picture file, mostly with something wrong; a PNG's checksums are right, so that the wrong part is read."""
    form = draw(st.sampled_from(sorted(MODES)))
    number = draw(st.integers(0, len(OPTIONS.get(form, ({},))) - 1))
    data = good_picture(form, draw(st.sampled_from(MODES[form])), number)
    if form == "PNG" and draw(st.booleans()):
        data = data[:33] + b"".join(draw(st.lists(chunks(), min_size=1, max_size=3))) + data[33:]
    for _ in range(draw(st.integers(0, 2))):
        data = draw(lying(data) if draw(st.integers(0, 9)) < 7 else damaged(data))
    return _checked(data) if form == "PNG" else data


def _checked(data: bytes) -> bytes:
    """A PNG whose chunks have the right checksums, as far as their lengths lead."""
    out, place = [data[:8]], 8
    while place + 12 <= len(data):
        end = place + 8 + min(int.from_bytes(data[place : place + 4], "big"), len(data))
        body = data[place + 4 : end]
        out.append(data[place : place + 4] + body + struct.pack(">I", zlib.crc32(body)))
        place = end + 4
    return b"".join((*out, data[place:]))
