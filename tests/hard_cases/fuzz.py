"""Wrong input for the readers: good texts and pictures with one to three changes, mostly deep, drawn by a seed."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import struct
import zlib
from collections import defaultdict
from random import Random
from typing import Any

import numpy as np
from PIL import Image

from tests.benchmarks.cold import TEMPLATES

# ---- texts: tokens and statements of a good one exchanged, lost, doubled, or odd -------------------------------------

TOKEN = re.compile(
    r"(?P<string>'(?:[^']|'')*'|\"[^\"\n]*\")|(?P<reference>#\d+)|(?P<number>-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
    r"|(?P<flag>\.\w+\.)|(?P<word>\w+)|(?P<mark>[^\s\w])|(?P<blank>\s+)"
)
WORDS = (
    "../../x", "/proc/self/mem", "/dev/zero", "C:\\\\x", "NUL", "a\\u0000b", "a\\u001b[31mb", "a\\nb", "x" * 5000,
    "\\ud800", "~/x", "point", "", "\\", "林", "\u2028x", "/" + "a/" * 2100, "\\X2\\D800", "\\X\\ZZ", "\\X2\\" * 999,
)  # fmt: skip
ODD = (  # texts that take the place of any token
    "0", "-1", "1.E-999", "1.E999", "-inf", "nan", "0x7f", "²", "", *("9" * digits for digits in (19, 40, 5000)),
    "0x" + "f" * 5000, "#1", "#0", "#" + "9" * 40, "$", "*", "=", ";", "1979-05-27", "true", ".T.", ".U.", "[]", "{}",
    "{ a = 1 }", "(", "))))", *("[" * n + "1" + "]" * n for n in (3, 200, 3000)), "{ a = " * 400 + "1" + " }" * 400,
    "(" * 2000 + "1" + ")" * 2000, "/* x */", "'", '"', "\0", "\x1b[1m", "\n", "ENDSEC;", "DATA;", "#1=(#2)",
    "a." * 1500 + "a", *(f"{quote}{word}{quote}" for quote in "\"'" for word in WORDS), "kind", "image", "[[effects]]",
)  # fmt: skip
FACTORS = (-1.0, 0.0, 0.01, 0.999999, 1.000001, 1.1, 100.0, 1e9, 1e300)
CHANGES = ("exchange", "exchange", "number", "digit", "statement", "odd", "odd", "cut")


class Good:
    """A good text in tokens; `groups`: places of the tokens of one class in statements of one kind."""

    def __init__(self, text: str, end: str):
        self.tokens: list[str] = []
        self.starts = [0]  # of its statements
        groups, word = defaultdict(list), ""
        for hit in TOKEN.finditer(text):
            word = word or (hit.group() if hit.lastgroup == "word" else "")
            groups[word, hit.lastgroup].append(len(self.tokens))
            self.tokens.append(hit.group())
            if end in hit.group():
                self.starts.append(len(self.tokens))
                word = ""
        self.groups = [places for (_, kind), places in groups.items() if kind not in ("blank", "mark")]
        self.numbers = [places for (_, kind), places in groups.items() if kind == "number"]
        self.starts.append(len(self.tokens))


def changed(random: Random, good: Good, changes: tuple[str, ...] = CHANGES, most: int = 3) -> str:
    """A good text with some changes; most numbers of a STEP file belong to control points, so a digit is theirs."""
    tokens = list(good.tokens)
    for _ in range(random.randint(1, most)):
        change = random.choice(changes)
        groups = (good.numbers if change in ("number", "digit") else ()) or good.groups
        group = random.choices(groups, [len(g) for g in groups])[0] if change == "digit" else random.choice(groups)
        place = random.choice(group)
        if change == "exchange":  # a flag is turned, a reference leads elsewhere
            tokens[place] = tokens[random.choice(group)]
        elif change == "odd":
            tokens[place] = random.choice(ODD)
        elif change == "digit":
            if digits := [k for k, letter in enumerate(tokens[place]) if letter.isdigit()]:
                at = random.choice(digits)
                tokens[place] = tokens[place][:at] + random.choice("0123456789") + tokens[place][at + 1 :]
        elif change == "number":
            with contextlib.suppress(ValueError):
                near = float(tokens[place]) * random.choice(FACTORS) + random.choice((0.0, 1e-6, 1.0))
                tokens[place] = f"{near:.14f}" if "." in tokens[place] else f"{near:.0f}"
        elif change == "statement":  # lost, doubled, or in place of another
            a, c = (random.randrange(len(good.starts) - 1) for _ in range(2))
            (a, b), (c, d) = good.starts[a : a + 2], good.starts[c : c + 2]
            new = random.choice(([], 2 * tokens[a:b], tokens[c:d]))
            tokens[a:b] = ["".join(new), *[""] * (b - a - 1)] if a < b else []
        else:  # the end or a part lost; some are closed again as a STEP file is
            low, high = sorted(random.choices(range(len(tokens)), k=2))
            high = random.choice((high, len(tokens)))
            tokens[low:high] = [random.choice(("", ";\nENDSEC;\nEND-ISO-10303-21;\n")), *[""] * (high - low - 1)]
    return "".join(tokens)


def damaged(random: Random, data: bytes) -> bytes:
    """Bytes flipped, cut, doubled, moved, or the end lost."""
    a, c = (random.randint(0, len(data)) for _ in range(2))
    b, new = a + random.choice((1, 8, 100)), random.randbytes(random.randint(1, 8))
    return random.choice((
        data[:a] + new + data[a + len(new) :], data[:a] + data[b:], data[:b] + data[a:],
        data[:c] + data[a:b] + data[c:], data[:a],
    ))  # fmt: skip


def file_of(random: Random, good: Good, encoding: str = "utf-8") -> bytes:
    """A changed text as a file, one of ten with damaged bytes."""
    data = changed(random, good).encode(encoding, "surrogatepass" if encoding == "utf-8" else "replace")
    return damaged(random, data) if random.random() < 0.1 else data


@functools.cache
def scenes() -> tuple[Good, ...]:
    """Templates without comments, at eight pixels."""
    names = ("disk", "led", "machinable_letters", "mirror", "off_axis", "sun_caustic", "white_logo")
    bare = (re.sub(r"(?m)\s*#.*$", "", (TEMPLATES / f"{name}.toml").read_text(encoding="utf-8")) for name in names)
    return tuple(Good(re.sub(r"pixels = .*", "pixels = 8", text), "\n") for text in bare)


KEYS = (
    "name", "target.pixels", "target.x", "lens.back.z", "source", "effects", "", ".", "a..b", "target.x.y", "a\nb",
    "\x1b[1m", "a." * 1200 + "a", "\udcff", "target." + "x" * 3000,
)  # fmt: skip
VALUES = (None, 2.5, 1e400, 10**400, [[[]]], {"a": {"b": 1}}, {1: 2}, b"x", (1, 2), "\udcff", "3\na = 1", *ODD)

# ---- pictures: files of every format that Pillow writes, with numbers that lie ---------------------------------------

SIZES = (0, 1, 2, 7, 255, 2000, 65_535, 65_536, 64_000_000, 2**31 - 1, 2**31, 2**32 - 1)
FORMS = (
    *(("PNG", mode, {}) for mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16")),
    *(("TIFF", mode, {}) for mode in ("1", "L", "P", "RGB", "RGBA", "CMYK", "F", "I;16")),
    *(("TIFF", "RGB", {"compression": name}) for name in ("tiff_adobe_deflate", "tiff_lzw", "packbits")),
    *(("JPEG", mode, {}) for mode in ("L", "RGB", "CMYK")), ("WEBP", "RGB", {}), ("WEBP", "RGBA", {"lossless": True}),
    ("WEBP", "RGBA", {"save_all": True}), ("BMP", "1", {}), ("BMP", "P", {}), ("BMP", "RGB", {}), ("HEIF", "RGBA", {}),
    ("GIF", "P", {}), ("GIF", "P", {"save_all": True}), ("AVIF", "RGB", {}), ("AVIF", "RGBA", {}),
)  # fmt: skip


def good_picture(form: str, mode: str, options: dict[str, Any], side: int = 8) -> bytes:
    """A small picture as Pillow writes it; one that is saved with all of its frames has two."""
    if form == "HEIF":
        import pillow_heif

        pillow_heif.register_heif_opener()
    noise = np.random.default_rng(0).integers(0, 256, (side, side, 3), dtype=np.uint8)
    image = Image.fromarray(noise).convert("L" if mode == "I;16" else mode).convert(mode)
    out, exif = io.BytesIO(), Image.Exif()
    exif[274] = 6  # turned
    frames = {"append_images": [image.rotate(90)]} if "save_all" in options else {}
    image.save(out, form, **options, **frames, **({"exif": exif} if form in ("PNG", "JPEG", "WEBP") else {}))
    return out.getvalue()


def lying(random: Random, data: bytes) -> bytes:
    """Two or four bytes, mostly in the header, replaced by a number that means something, in either order of bytes."""
    form = random.choice("<>") + random.choice("HI")
    new = struct.pack(form, random.choice((*SIZES, random.randint(0, 300))) % 256 ** struct.calcsize(form))
    place = random.randint(0, max(0, random.choice((64, len(data))) - len(new)))
    return data[:place] + new + data[place + len(new) :]


def chunk(random: Random) -> bytes:
    """A chunk that may stand in a PNG beside the picture's own, its contents right or not, without its checksum."""
    profile = struct.pack(">I4xI4s4s4s12x4s", 184, 0x02400000, b"mntr", b"GRAY", b"XYZ ", b"acsp").ljust(184, b"\0")
    packed = zlib.compress(random.choice((lying(random, profile), bytes(100), bytes(5_000_000))))
    junk, numbers = random.randbytes(random.randint(0, 40)), struct.pack(">7I", *random.choices(SIZES, k=7))
    name, content = random.choice((
        *((name, junk) for name in (b"tRNS", b"sRGB", b"cICP", b"PLTE", b"cHRM")), (b"gAMA", numbers[:4]),
        (b"iCCP", b"key\0\0" + packed), (b"zTXt", b"key\0\0" + packed), (b"iTXt", b"key\0\1\0\0\0" + packed),
        (b"acTL", numbers[:8]), (b"fcTL", numbers[:26]), (b"fdAT", numbers[:4] + junk),
    ))  # fmt: skip
    return struct.pack(">I", len(content)) + name + content + bytes(4)


def picture(random: Random) -> bytes:
    """A picture file, mostly with something wrong; a PNG's checksums are right, so that the wrong part is read."""
    form, mode, options = random.choice(FORMS)
    data = good_picture(form, mode, options)
    if form == "PNG" and random.random() < 0.5:
        data = data[:33] + chunk(random) + data[33:]
    for _ in range(random.randint(0, 2)):
        data = lying(random, data) if random.random() < 0.7 else damaged(random, data)
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
