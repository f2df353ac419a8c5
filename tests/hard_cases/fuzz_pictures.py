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
LOSSY = base64.b85decode(  # WebP, 8 x 8, of colour
    "Qb|TeH~;_uS4BclR!}$~EC2uiumJ#_0V)Up2ml8_mL;eHbO7>yW1s;2i1G^cSm69R;2UEDui7Qq;P&7E"
)
LOSSLESS = base64.b85decode(  # the same with opacity
    "Qb|TeLI3~&S4BclR!}%hHUIzsF9*N@5Y3e#qW`gri2eu20!)SwV*XbUyCM(^CPT^p3Q-`Cggo*n0)Z5^%M$<r?;Z1H;6D"
)
MOVING = base64.b85decode(  # two frames, with opacity
    "Qb|Te9svLVS4BclR!}%t3IG5A5&!@I2LJ#E002QwNlgX-0000000000K~7CZdH?_b00000000L700#g71poj7K}=9cBLDyZ0Y5M#5fT0%2!Kpmuw"
    "cQ01q&8L^gjTABqhnVlca68?f(G)R!}$~HUIzsPyqm)0V)Up2ml8_mL;$N1atrZ{)6}m%je}^?I>2}_Ahov+H9dZwbRMSHOvm7Tm!o%Kmb8bO-67"
    "400000000002LJ#E000F500KcwP)Hd70003$FeDKX{vgaYQW(ovj%EJeGl=Ma;JN|;R!}$~HUIzsPyqm)0V)Up2ml8_mL;$N1atrZ{^Vv`qHJh>e"
    "zX2>d)X({K)Hs$sD{msSH|q!_}mmA000"
)
HEIC = base64.b85decode(  # 16 x 16, of colour
    "0000SW^{RQXk}?*00000ZE0pPXk}?*ZE0a<0004eZDn*}000000000XXk=`10000000000aA{+700000000000000000000B57=IV*mgE07O6l0R"
    "RC200001pa1~?00000001`t001LtX>Mi!000000RR916=`l}WdZ;I000310BCk&F#rGn01j|zbZr0t000010002|X>f9I0002oX>en20001WXm(>"
    "m0RwOV0058x000009`FGC{rLC*01pFT0096PKmiN^|NjGU00093kN^M!000939=ZZRVE_RDDMA4O18@KU0|1Z!00RI30{|YNAb|yz>aLpR;31&Ef"
    "B*mtfB*mk0EA)y0RRR>0l{;@i2wiq6Ju{|a&BX6cmM$a4FCp!0000KX>)L8000000000$0000$0000eV{Bn?0000G000010000G00001|NsBc000"
    "02|NsBc000020000GaA|mH000000|*ER0000OX>e^}0000000001009Mo0s{qv0000#ZDe6|0000pC;_ho5*AJ*`00p_`3hcicxFqfO!(n4V%c%Y"
    "=hSL=9Zeuet*9nf{h+-u0vjN>7s@{"
)
HEIC_OPACITY = base64.b85decode(  # the same with opacity
    "0000SW^{RQXk}?*00000ZE0pPXk}?*ZE0a<0007OZDn*}000000000XXk=`10000000000aA{+700000000000000000000G-+&aV*mgE07O6l0s"
    "sL300002j{pGx00000001`t0ssI200PDU0RR9100000Bme*aIB98aW&i*H00062000$fZf0cy000000RRAKc4ILB0000LX>Mj^0ssI200IC2Xm(>"
    "U000004sdC7Z2$lO0003100F9LaB^?}00Dw&aAR)(004Dpc4I>U18@KU0FVFx0000U@BsY%`1k+-4+CHT0RR|40Sp2E{{wIU00RJ!0009300RIXx"
    "&lC90096gLID8-Z~y=U0FVFx0{{R603M(qfd!W8uA1iHA)vs3000bt00093gkk^z00u+>!E?ch0000JV{dG7ZewhC0096E00w{n000zeb8uw<000"
    "00002M$002M$001asY+-N!000mG00031000mG00061|Nqbc00092|Nqbc00062000nhX?SS>000032nYxO0041lc4I>U1PA~C0H62(0000U@BsY$"
    "`1k+-4+CHT0RR_30Sp2E{{#pC00RJ@_y7O{0017k0zhE^0RSdK0RaRE00093pZEX(0{{RXz=8x8TdKNin*sm;0{}7r00RI55MlrU00u+>!E?ch00"
    "00EaA|mH000000SEv904HH}ctZdH004DzZaQsnWoJ5QWp-maGB7bUI$?EqX=FMv00000AZc)IVE_OC000000ssL8fdT^sga85sh64wPga7~l8fkK"
    "6W&i*H000004q<h8YybiP0RRC2003icWMOmw001*60j~rS7EUDi>4=W`3SM-0W=p9|_~9~Q*>TC|)M|JgO(00Es3uqapuI5y8z8tB%0B=A03av<t"
    "_UO}xxm{U2zb9`QfQ++zqrFgzpA8$!Z4MSEPw"
)


def picture(g: random.Random) -> bytes:
    """A picture file, most of them with something wrong."""
    data = g.choice((png, png, png, tiff, tiff, tiff, jpeg, jpeg, webp, bmp, heic))(g)
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
        (b"gAMA", struct.pack(">I", g.choice((*SIZES, 45_455, 100_000)))), (b"sRGB", g.randbytes(g.choice((0, 1, 2)))),
        (b"cICP", bytes((g.choice((1, 9, g.randrange(256))), g.choice((1, 8, 13, 16, g.randrange(256))), 0, 1))),
        (b"iCCP", b"key\0\0" + zlib.compress(_profile(g))),
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


# ---- WebP, BMP, HEIC -------------------------------------------------------------------------------------------------


def webp(g: random.Random) -> bytes:
    """Chunks lost, doubled, of other lengths; another size in the header; a colour profile put in."""
    data = g.choice((LOSSY, LOSSLESS, MOVING))
    match g.randrange(5):
        case 0:
            place = g.choice([i for i in range(12, len(data) - 8) if data[i : i + 4].strip().isalnum()])
            return data[: place + 4] + struct.pack("<I", g.choice(SIZES)) + data[place + 8 :]
        case 1:
            return data[:4] + struct.pack("<I", g.choice(SIZES)) + data[8:]
        case 2:
            head = b"VP8X" + struct.pack("<IB3x", 10, g.randrange(64)) + g.randbytes(6)
            profile = _profile(g)
            body = head + b"ICCP" + struct.pack("<I", len(profile)) + profile + bytes(len(profile) % 2) + data[12:]
            return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body
        case 3:
            place = g.randrange(20, 34)
            return data[:place] + g.randbytes(3) + data[place + 3 :]
    return data


def bmp(g: random.Random) -> bytes:
    """Any header, depth and compression, palettes too short or too long, pixels that begin anywhere."""
    width, height, depth = g.randint(1, 16), g.choice((1, -1)) * g.randint(1, 16), g.choice((1, 4, 8, 16, 24, 32))
    compression, header = g.choice((0, 0, 0, 1, 2, 3, 4, 5)), g.choice((40, 40, 40, 12, 64, 108, 124))
    colours = g.choice((0, 2, 16, 256)) if depth <= 8 else 0
    body = g.randbytes(abs(height) * ((width * depth + 31) // 32 * 4))
    if g.random() < 0.2:
        width, depth = g.choice((width, *SIZES)) % 2**31, g.choice((depth, g.randrange(64)))
        height, colours = g.choice((height, *SIZES)) % 2**31, g.choice((colours, 2**31))
    palette = g.randbytes(4 * min(colours or (2**depth if depth <= 8 else 0), 256))
    if header == 12:
        info = struct.pack("<IHHHH", 12, width % 65_536, abs(height) % 65_536, 1, depth)
    else:
        info = struct.pack("<IiiHHIIiiII", header, width, height, 1, depth, compression, 0, 0, 0, colours, 0)
        info += g.randbytes(header - 40)
    start = g.choice((14 + len(info) + len(palette), 14 + len(info) + len(palette), g.choice(SIZES)))
    return b"BM" + struct.pack("<IHHI", 14 + len(info) + len(palette) + len(body), 0, 0, start) + info + palette + body


def heic(g: random.Random) -> bytes:
    """Boxes of other lengths and names, another size, another brand."""
    data = g.choice((HEIC, HEIC_OPACITY))
    names = [i for i in range(4, len(data) - 4) if data[i : i + 4].isalpha() and data[i : i + 4].islower()]
    place = g.choice(names)
    match g.randrange(6):
        case 0:
            return data[: place - 4] + struct.pack(">I", g.choice((*SIZES, g.randrange(200)))) + data[place:]
        case 1:
            return data[:place] + data[(other := g.choice(names)) : other + 4] + data[place + 4 :]
        case 2:
            size = data.index(b"ispe") + 8
            return data[:size] + struct.pack(">II", *(g.choice(SIZES) for _ in range(2))) + data[size + 8 :]
        case 3:
            return data[:8] + g.choice((b"avif", b"mif1", b"heix", b"qt  ", g.randbytes(4))) + data[12:]
        case 4:
            return damaged(g, data[-100:]).join((data[:-100], b""))
    return data


def _profile(g: random.Random) -> bytes:
    """An ICC profile, or what looks like one: a header of any colours, and a table of tags that may point anywhere."""
    name = g.choice((b"wtpt", b"kTRC", b"rTRC", b"rXYZ", b"A2B0", b"desc"))
    body = struct.pack(">I4sII", g.choice((1, *SIZES)), name, g.choice((144, *SIZES)), g.choice((40, *SIZES)))
    body += g.randbytes(40)
    colours = g.choice((b"RGB ", b"GRAY", b"CMYK", b"Lab ", g.randbytes(4)))
    head = struct.pack(">I4xI4s4s4s12x4s", 128 + len(body), 0x02400000, b"mntr", colours, b"XYZ ", b"acsp")
    return head + bytes(128 - len(head)) + body
