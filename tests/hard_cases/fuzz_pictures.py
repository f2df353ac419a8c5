"""Wrong pictures, each made anew from its number; PNG and TIFF are put together here, to lie with good checksums.

Standard library only; `g` is the random.Random of one input.
"""

from __future__ import annotations

import base64
import random
import struct
import zlib
from collections.abc import Sequence

from tests.hard_cases.fuzz import damaged

SIZES = (0, 1, 2, 7, 255, 2000, 65_535, 65_536, 64_000_000, 2**31 - 1, 2**31, 2**32 - 1)
BOMBS = tuple(zlib.compress(bytes(size)) for size in (100, 5_000_000))
GREY = base64.b85decode(  # JPEG, 8 x 8, as small as they get
    "|JeWF01!$>Nk#wx0RR9200961|JwjV02>k%7Zed27Zw*D92+1gLMtdGB`8rkJupIGRb^yfRb5+Zc$tA}agcLcU4^xVke;Kft*d8%yve$z$C;?Br2"
    "oJG3kU!R00;pA5di<h02BZL00000000000000000003|HJ?o5C8%L000000000000000000C9Au<2j00;pA002J#DD*Oq|Je"
)
COLOUR = base64.b85decode(  # with EXIF that turns it
    "|JeWF01!$>Nk#wx0RR9200961|KR{4MR;ju002!*04e|g00;m90TKWM0000100sa600000|JwjV04N+DBOVzjBOxO#D=08LWI;SPH#~b-T}fn-fSH"
    "z$fQ*WuwC2O0s@koJjL84X+V1uL|Noo8|NsB`|K|Pw`2X7gLjfx-Ej%?mc0oaQ_@#`c`1ttv`1ttv`1ttv`1ttv`1ttv`1ttv`1ttv`1ttv`1tt"
    "v`1ttv`1ttv`1ttv`1t?801*fP2mlBJ0U`hb5di}c0sq7R6#xMN00000000000000000002|HJ?n5CH)J0RR910000000000000CbG5^E>6afJM0"
    "0000000000000000030!~hf#0RR910000000000000000RP$m3<CiG0ucid06zeUW##}6|Je"
)


def picture(g: random.Random) -> bytes:
    """A picture file, most of them with something wrong."""
    data = g.choice((png, png, tiff, tiff, jpeg))(g)
    for _ in range(g.choice((0, 0, 0, 1, 2))):
        data = damaged(g, data)
    return data


# ---- PNG -----------------------------------------------------------------------------------------------------------


def png(g: random.Random) -> bytes:
    """Any depth and colour, palettes, transparency, animation, text bombs; chunks lost, doubled, in another order."""
    width, height, colour = g.randint(1, 16), g.randint(1, 16), g.choice((0, 0, 2, 3, 4, 6))
    depth = g.choice({0: (1, 2, 4, 8, 16), 3: (1, 2, 4, 8)}.get(colour, (8, 16)))
    if g.random() < 0.1:
        colour, depth = g.choice(((g.randrange(256), depth), (colour, g.randrange(33))))
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 1)
    line = (width * depth * channels + 7) // 8
    body = b"".join(bytes([g.choice((0, 1, 2, 3, 4))]) + g.randbytes(line) for _ in range(height))
    if g.random() < 0.15:
        width, height = g.choice(SIZES), g.choice((height, g.choice(SIZES)))
    packed = zlib.compress(body)
    cut = g.randrange(len(packed))
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, g.choice((0, 0, 0, 1)))
    chunks = [(b"IHDR", head), (b"IDAT", packed[:cut]), (b"IDAT", packed[cut:]), (b"IEND", b"")]
    for _ in range(g.choice((0, 1, 1, 3))):
        chunks.insert(g.choice((1, 1, 1, g.randrange(5))), _extra(g))
    if colour == 3:
        chunks.insert(1, (b"PLTE", g.randbytes(3 * g.choice((1, 16, 256, 257)))))
    if g.random() < 0.1:
        i, j = g.randrange(len(chunks)), g.randrange(len(chunks))
        chunks[i], chunks[j] = g.choice(((chunks[j], chunks[i]), (chunks[i], chunks[i])))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(g, *chunk) for chunk in chunks)


def _extra(g: random.Random) -> tuple[bytes, bytes]:
    """A chunk that may stand beside the picture's own, its contents right or not."""
    bomb = g.choice(BOMBS)
    return g.choice((
        (b"tRNS", g.randbytes(g.choice((0, 1, 2, 6, 256)))),
        (b"gAMA", struct.pack(">I", g.choice(SIZES))),
        (b"eXIf", g.choice((b"", b"MM\0*\0\0\0\x08", _ifd(g, [(274, 3, [g.randrange(12)])], ">")))),
        (b"acTL", struct.pack(">II", g.choice(SIZES), 0)),
        (b"fcTL", struct.pack(">IIIIIHHBB", 0, *(g.choice(SIZES) for _ in range(4)), 1, 1, 0, 0)),
        (b"fdAT", struct.pack(">I", 1) + g.randbytes(9)),
        (b"zTXt", b"key\0\0" + bomb), (b"iTXt", b"key\0\1\0\0\0" + bomb), (b"iCCP", b"key\0\0" + bomb),
        (b"tEXt", g.randbytes(20)), (b"pHYs", g.randbytes(g.choice((9, 3)))), (b"cHRM", g.randbytes(g.choice((32, 5)))),
        (b"PLTE", g.randbytes(7)), (g.randbytes(4), g.randbytes(4)),
    ))  # fmt: skip


def _chunk(g: random.Random, name: bytes, body: bytes) -> bytes:
    length = len(body) if g.random() < 0.99 else g.choice(SIZES)
    checksum = zlib.crc32(name + body) if g.random() < 0.99 else 0
    return struct.pack(">I", length) + name + body + struct.pack(">I", checksum)


# ---- TIFF ----------------------------------------------------------------------------------------------------------

LAYOUTS = (  # bits of each sample, photometric, sample format
    ([8], 1, 1), ([8], 0, 1), ([1], 0, 1), ([4], 1, 1), ([16], 1, 1), ([16], 1, 2), ([32], 1, 1), ([32], 1, 2),
    ([32], 1, 3), ([64], 1, 3), ([8, 8, 8], 2, 1), ([16, 16, 16], 2, 1), ([8, 8, 8, 8], 2, 1), ([8, 8, 8, 8], 5, 1),
    ([8], 3, 1),
    ([8, 8, 8], 6, 1), ([8, 8, 8], 8, 1), ([8, 8], 1, 1), ([12], 1, 1), ([8] * 5, 2, 1), ([8] * 9, 1, 1),
)  # fmt: skip


def tiff(g: random.Random) -> bytes:
    """Any layout and compression, several pictures or a ring of them; entries changed, lost, with counts that lie."""
    order, width, height = g.choice("<>"), g.randint(1, 16), g.randint(1, 16)
    bits, photometric, form = g.choice(LAYOUTS)
    body = g.randbytes(height * ((width * sum(bits) + 7) // 8))
    if form == 3 and g.random() < 0.5:
        body = struct.pack(
            order + "f" * (width * height), *(g.choice((0.5, -1.0, 3e38, 1e-40)) for _ in range(width * height))
        )
    compression = g.choice((1, 1, 1, 8, 32946, 32773, 5, 7, 6, 2, 3, 4, 50000, 34925, 99))
    if compression in (8, 32946):
        body = zlib.compress(body)
    if g.random() < 0.1:
        width, height = g.choice(SIZES), g.choice((height, g.choice(SIZES)))
    entries = [
        (256, 4, [width]), (257, 4, [height]), (258, 3, bits), (259, 3, [compression]), (262, 3, [photometric]),
        (273, 4, [8]), (277, 3, [len(bits)]), (278, 4, [height]), (279, 4, [len(body)]), (339, 3, [form] * len(bits)),
    ]  # fmt: skip
    if photometric == 3:
        entries.append((320, 3, [g.randrange(65536) for _ in range(768)]))
    for _ in range(g.choice((0, 0, 1, 2))):
        entries.append(g.choice((
            (274, 3, [g.randrange(12)]), (317, 3, [g.choice((2, 3, 9))]), (284, 3, [2]), (338, 3, [g.randrange(4)]),
            (322, 4, [g.choice(SIZES)]), (323, 4, [16]), (324, 4, [8]), (325, 4, [len(body)]), (282, 5, [1, 0]),
            (330, 4, [8]), (34675, 7, list(g.randbytes(9))), (700, 1, list(b"<x/>")),
            (34665, 4, [g.choice((8, 2**31))]),
            (g.randrange(65536), g.randrange(14), [g.choice(SIZES)]),
        )))  # fmt: skip
    if g.random() < 0.3:
        i = g.randrange(len(entries))
        tag, kind, _ = entries[i]
        entries[i] = g.choice(
            ((tag, kind, [g.choice(SIZES)]), (tag, g.randrange(14), [1]), (g.randrange(256, 300), kind, [3]))
        )
    if g.random() < 0.1:
        del entries[g.randrange(len(entries))]
    return _ifd(g, sorted(entries, key=lambda e: e[0]), order, body)


def tiff_of(entries: Sequence[tuple[int, int, list[int]]], body: bytes) -> bytes:
    """A TIFF file with these entries and nothing wrong beyond them."""
    return _ifd(_Truthful(0), entries, "<", body)


class _Truthful(random.Random):
    def random(self) -> float:
        return 0.0

    def choice(self, of: Sequence) -> object:
        return of[0]


def _ifd(g: random.Random, entries: Sequence[tuple[int, int, list[int]]], order: str, body: bytes = b"") -> bytes:
    """A TIFF file of one directory behind its data; the next one may be itself, or nowhere."""
    start = 8 + len(body) + len(body) % 2
    table, heap = b"", b""
    room = start + 2 + 12 * len(entries) + 4
    for tag, kind, values in entries:
        code = {1: "B", 3: "H", 6: "b", 7: "B", 8: "h", 9: "i"}.get(kind, "I")
        size = struct.calcsize(code)
        data = b"".join((v % 256**size).to_bytes(size, "little" if order == "<" else "big") for v in values)
        count = (len(values) // 2 if kind == 5 else len(values)) if g.random() < 0.98 else g.choice(SIZES)
        if len(data) > 4:
            where, heap = room + len(heap), heap + data
            data = struct.pack(order + "I", where)
        table += struct.pack(order + "HHI", tag, kind, count) + data.ljust(4, b"\0")
    following = g.choice((0, 0, 0, start, 8, 2**31))
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", start)
    return (
        head
        + body
        + bytes(len(body) % 2)
        + struct.pack(order + "H", len(entries))
        + table
        + struct.pack(order + "I", following)
        + heap
    )


# ---- JPEG ----------------------------------------------------------------------------------------------------------


def jpeg(g: random.Random) -> bytes:
    """Segments lost, doubled, of other lengths; the size in the frame's header another one."""
    data = g.choice((GREY, COLOUR))
    places = [i for i in range(len(data) - 4) if data[i] == 0xFF and data[i + 1] not in (0, 0xFF)]
    place = g.choice(places)
    match g.randrange(5):
        case 0:
            return data[: place + 2] + struct.pack(">H", g.choice((0, 1, 2, 3, 65_535))) + data[place + 4 :]
        case 1:
            end = place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")
            return data[:place] + data[place:end] * g.choice((0, 2, 50)) + data[end:]
        case 2:
            frame = next((i for i in places if data[i + 1] in (0xC0, 0xC2)), place)
            sides = (g.choice(SIZES) % 65_536 for _ in range(2))
            return data[: frame + 5] + struct.pack(">HH", *sides) + data[frame + 9 :]
        case 3:
            return data[: place + 1] + bytes([g.randrange(256)]) + data[place + 2 :]
    return data
