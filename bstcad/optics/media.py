"""Media: the refractive index of what lenses are made of, n(wavelength).

n² - 1 = Σ_k B_k λ² / (λ² - C_k), λ in µm (Sellmeier), relative to air, at room temperature.
Each medium says where its coefficients were published and over which wavelengths they hold.  Densities are the makers'
nominal ones near 20 °C (ISO 1183 for the polymers, data sheets for the glasses); grades of one polymer differ by 1 %.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Medium:
    """A dispersion formula, valid from `shortest` to `longest`."""

    name: str
    strengths: tuple[float, ...]  # B_k
    resonances: tuple[float, ...]  # C_k (µm²)
    shortest: float  # nm
    longest: float  # nm
    source: str
    density: float  # g/cm³, nominal

    def index(self, wavelength: float) -> float:
        """n at a wavelength in nm; the caller keeps to the range."""
        square = (wavelength / 1000.0) ** 2
        terms = (b * square / (square - c) for b, c in zip(self.strengths, self.resonances, strict=True))
        return math.sqrt(1.0 + sum(terms))


_POLYMERS = "Sultanova, Kasarova and Nikolov, Acta Phys. Pol. A 116, 585 (2009), 20 °C; Sellmeier fit of the data"

MEDIA = (
    Medium(
        "PMMA",
        (0.99654, 0.18964, 0.00411),
        (0.00787, 0.02191, 3.85727),
        404.7,
        1083.0,
        "Szczurowski (2013), refractiveindex.info, 23 °C",
        1.19,
    ),
    Medium("polycarbonate", (1.4182,), (0.021304,), 436.8, 1052.0, _POLYMERS, 1.20),
    Medium("polystyrene", (1.4435,), (0.020216,), 436.8, 1052.0, _POLYMERS, 1.05),
    Medium("Zeonex E48R", (1.2969,), (0.011721,), 436.8, 1052.0, _POLYMERS, 1.01),
    Medium(
        "N-BK7",
        (1.03961212, 0.231792344, 1.01046945),
        (0.00600069867, 0.0200179144, 103.560653),
        300.0,
        2500.0,
        "SCHOTT data sheet (2017)",
        2.51,
    ),
    Medium(
        "N-SF11",
        (1.73759695, 0.313747346, 1.89878101),
        (0.013188707, 0.0623068142, 155.23629),
        370.0,
        2500.0,
        "SCHOTT data sheet (2017)",
        3.22,
    ),
    Medium(
        "fused silica",
        (0.6961663, 0.4079426, 0.8974794),
        (0.0684043**2, 0.1162414**2, 9.896161**2),
        210.0,
        3710.0,
        "Malitson, J. Opt. Soc. Am. 55, 1205 (1965), 20 °C",
        2.20,
    ),
    Medium(
        "water",
        (5.684027565e-1, 1.726177391e-1, 2.086189578e-2, 1.130748688e-1),
        (5.101829712e-3, 1.821153936e-2, 2.620722293e-2, 1.069792721e1),
        182.0,
        1129.0,
        "Daimon and Masumura, Appl. Opt. 46, 3811 (2007), 20 °C",
        0.998,
    ),
)
ALIASES = {"acrylic": "PMMA", "pc": "polycarbonate", "ps": "polystyrene", "silica": "fused silica"}


def _plain(name: str) -> str:
    """A name as people vary it: 'n-bk7', 'NBK7' and 'N-BK7' are one."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


_BY_NAME = {_plain(medium.name): medium for medium in MEDIA}
_BY_NAME |= {alias: _BY_NAME[_plain(name)] for alias, name in ALIASES.items()}


def medium(material: str) -> Medium:
    """The medium of that name; ValueError names the nearest one."""
    found = _BY_NAME.get(_plain(material))
    if found is None:
        near = difflib.get_close_matches(_plain(material), _BY_NAME, n=1)
        known = ", ".join(m.name for m in MEDIA)
        hint = f"did you mean {_BY_NAME[near[0]].name!r}?" if near else f"known are {known}; or give the index itself"
        raise ValueError(f"{material!r} is not a known material; {hint}")
    return found


def density(material: str) -> float:
    """Nominal density (g/cm³) of a named material; ValueError names the nearest one."""
    return medium(material).density


def refractive_index(material: str, wavelength: float) -> float:
    """Refractive index relative to air of a named material at a wavelength in nm.

    Raises ValueError, in one sentence, for an unknown material or a wavelength its formula does not cover.
    """
    found = medium(material)
    if not found.shortest <= wavelength <= found.longest:
        raise ValueError(
            f"the index of {found.name} is known from {found.shortest:g} to {found.longest:g} nm, not at "
            f"{wavelength:g} nm; give the index itself"
        )
    return found.index(wavelength)
