"""Wrong pictures, each made anew from its number: files of every format that Pillow writes, with numbers that lie.

A number anywhere in the file becomes another one: a width, a count, a length, an offset, in either order of bytes.
The checksums of PNG are made right again, so that the lie is read.
"""

from __future__ import annotations

import functools
import io
import random
import re
import struct
import zlib
from collections.abc import Sequence

import numpy as np
from PIL import Image

from tests.hard_cases.fuzz import damaged

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
def good(form: str, mode: str, number: int = 0, side: int = 8) -> bytes:
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


def picture(g: random.Random) -> bytes:
    """A picture file, most of them with something wrong."""
    form = g.choice(("PNG", "PNG", "TIFF", "TIFF", "JPEG", "WEBP", "BMP", "HEIF"))
    data = good(form, g.choice(MODES[form]), g.randrange(len(OPTIONS.get(form, ({},)))))
    if form == "PNG" and g.random() < 0.5:
        data = data[:33] + b"".join(_chunk(*_extra(g)) for _ in range(g.choice((1, 1, 3)))) + data[33:]
    for _ in range(g.choice((0, 1, 1, 2))):
        data = (lying if g.random() < 0.7 else damaged)(g, data)
    return _checked(data) if form == "PNG" else data


def lying(g: random.Random, data: bytes) -> bytes:
    """Two or four bytes, mostly in the header, replaced by a number that means something."""
    order, size, number = g.choice("<>"), g.choice("HI"), g.choice((*SIZES, g.randrange(300)))
    new = struct.pack(order + size, number % 256 ** struct.calcsize(size))
    place = g.randrange(max(1, g.choice((64, len(data))) - len(new)))
    return data[:place] + new + data[place + len(new) :]


def tiff_of(entries: Sequence[tuple[int, int, list[int]]], body: bytes) -> bytes:
    """A little-endian TIFF of one directory behind its data; entries: (tag, 4, [value])."""
    table = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, (value,) in entries)
    return b"II*\0" + struct.pack("<I", 8 + len(body)) + body + struct.pack("<H", len(entries)) + table + bytes(4)


def _chunk(name: bytes, content: bytes) -> bytes:
    """A chunk of a PNG; its checksum is made later."""
    return struct.pack(">I", len(content)) + name + content + bytes(4)


def _extra(g: random.Random) -> tuple[bytes, bytes]:
    """A chunk that may stand beside the picture's own, its contents right or not."""
    profile = struct.pack(">I4xI4s4s4s12x4s", 184, 0x02400000, b"mntr", b"GRAY", b"XYZ ", b"acsp").ljust(128, b"\0")
    bomb = g.choice(BOMBS)
    return g.choice((
        (b"tRNS", g.randbytes(g.choice((0, 1, 2, 6, 256)))), (b"gAMA", struct.pack(">I", g.choice((*SIZES, 45_455)))),
        (b"sRGB", g.randbytes(g.choice((0, 1, 2)))), (b"cICP", g.randbytes(4)), (b"PLTE", g.randbytes(7)),
        (b"iCCP", b"key\0\0" + zlib.compress(lying(g, profile + g.randbytes(56)))), (b"iCCP", b"key\0\0" + bomb),
        (b"zTXt", b"key\0\0" + bomb), (b"iTXt", b"key\0\1\0\0\0" + bomb), (b"cHRM", g.randbytes(g.choice((32, 5)))),
        (b"acTL", struct.pack(">II", g.choice(SIZES), 0)), (b"fdAT", struct.pack(">I", 1) + g.randbytes(9)),
        (b"fcTL", struct.pack(">IIIIIHHBB", 0, *(g.choice(SIZES) for _ in range(4)), 1, 1, 0, 0)),
        (g.randbytes(4), g.randbytes(4)),
    ))  # fmt: skip


def _checked(data: bytes) -> bytes:
    """A PNG whose chunks have the right checksums, as far as their lengths lead."""
    out, place = [data[:8]], 8
    while place + 12 <= len(data):
        end = place + 8 + min(int.from_bytes(data[place : place + 4], "big"), len(data))
        body = data[place + 4 : end]
        out.append(data[place : place + 4] + body + struct.pack(">I", zlib.crc32(body)))
        place = end + 4
    return b"".join((*out, data[place:]))


def claiming(form: str, side: int) -> bytes:
    """A small picture whose header says that it has side x side pixels."""
    if form == "BMP":
        return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, side, side, 1, 8, *[0] * 6)
    if form == "WEBP":
        moving = good("WEBP", "RGBA", 2)
        return moving[:24] + 2 * (side - 1).to_bytes(3, "little") + moving[30:]
    sizes = struct.pack(">II", side, side)
    return re.sub(rb"(ispe....)........", lambda hit: hit[1] + sizes, good("HEIF", "RGB", side=16), flags=re.DOTALL)
