"""Effects that take flux from light on its way: Fresnel reflection at faces, absorption in glass, reflectance of metal.

Each is a loss: `share(cos_in, cos_out, path)` is the part of a ray's flux that goes on behind an interface, given the
cosines of the angles of incidence and of refraction or reflection there and the path before it (mm); `line` is the line
of the flux ledger under which the rest is counted.  `Losses` says which of them act where in a lens, for light of one
wavelength; interfaces.cross applies them.  This module is loaded only where a scene asks for an effect.

Fresnel's equations: Born and Wolf, Principles of Optics, 7th ed., section 1.5.2; a single layer: section 1.6.4; metals:
section 14.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from bstcad.optics.interfaces import Interface, Loss
from bstcad.optics.kernels.reductions import elementary

REFLECTED, ABSORBED, BY_THE_MIRROR = "reflected at the faces", "absorbed in the glass", "absorbed by the mirror"
Polarisation = Literal["none", "s", "p"]


@dataclass(frozen=True)
class Coating:
    """A single layer on a face."""

    index: float
    thickness: float  # nm


def reflectance(
    n_in: float, n_out: float, cos_in: Tensor, cos_out: Tensor, polarisation: Polarisation = "none"
) -> Tensor:
    """R of a bare face between two media.

    r_s = (n cos θ - n' cos θ') / (n cos θ + n' cos θ'),  r_p = (n' cos θ - n cos θ') / (n' cos θ + n cos θ'),
    R = r² of one polarisation, in relation to the plane of incidence, or the mean of both.
    """
    r_s, r_p = _amplitudes(n_in, n_out, cos_in, cos_out)
    return _mean(r_s * r_s, r_p * r_p, polarisation)


def coated_reflectance(
    n_in: float, n_out: float, cos_in: Tensor, cos_out: Tensor, coating: Coating, wavelength: float,
    polarisation: Polarisation = "none",
) -> Tensor:  # fmt: skip
    """R of a face with a single layer between two media (wavelength in nm, in vacuum).

    r = (r_1 + r_2 e^{2iβ}) / (1 + r_1 r_2 e^{2iβ}),  β = 2π n_f d cos θ_f / λ,  r_1 and r_2 the amplitudes of the
    layer's two sides.  Of light that goes through, the angle in the layer is real, since n_f >= 1 >= n sin θ.
    """
    n_f = coating.index
    cos_f = torch.sqrt(1 - (n_in / n_f) ** 2 * (1 - cos_in * cos_in))
    turn = 2 * elementary(torch.cos, (4 * math.pi * n_f * coating.thickness / wavelength) * cos_f)
    first, second = _amplitudes(n_in, n_f, cos_in, cos_f), _amplitudes(n_f, n_out, cos_f, cos_out)
    both = []
    for r_1, r_2 in zip(first, second, strict=True):
        product = r_1 * r_2
        both.append((r_1 * r_1 + r_2 * r_2 + product * turn) / (1 + product * product + product * turn))
    return _mean(*both, polarisation)


def metal_reflectance(index: complex, cos_in: Tensor, polarisation: Polarisation = "none") -> Tensor:
    """R of a metal of the complex index n + ik in air.

    With a + ib = sqrt((n + ik)² - sin² θ):  R_s = ((a - cos θ)² + b²) / ((a + cos θ)² + b²),
    R_p = R_s ((a cos θ - sin² θ)² + b² cos² θ) / ((a cos θ + sin² θ)² + b² cos² θ).
    """
    sin2 = 1 - cos_in * cos_in
    real, imaginary = (index * index).real - sin2, (index * index).imag
    size = torch.sqrt(real * real + imaginary * imaginary)
    a, b2 = torch.sqrt((size + real) / 2), (size - real) / 2
    r_s = ((a - cos_in) ** 2 + b2) / ((a + cos_in) ** 2 + b2)
    far = b2 * cos_in * cos_in
    r_p = r_s * ((a * cos_in - sin2) ** 2 + far) / ((a * cos_in + sin2) ** 2 + far)
    return _mean(r_s, r_p, polarisation)


@dataclass(frozen=True)
class Transmission:
    """T = 1 - R of a face that light goes through; the rest counts as reflected."""

    n_in: float
    n_out: float
    wavelength: float  # nm
    polarisation: Polarisation = "none"
    coating: Coating | None = None

    line, in_glass, fused = REFLECTED, False, True

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """T at the angles of incidence and refraction."""
        at = (self.n_in, self.n_out, cos_in, cos_out)
        if self.coating is None:
            return 1 - reflectance(*at, self.polarisation)
        return 1 - coated_reflectance(*at, self.coating, self.wavelength, self.polarisation)


@dataclass(frozen=True)
class MetalReflection:
    """R of a mirror of metal; the rest is absorbed there."""

    index: complex  # n + ik of the metal, over the index of the medium before it
    polarisation: Polarisation = "none"

    line, in_glass, fused = BY_THE_MIRROR, False, True

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """R at the angle of incidence."""
        return metal_reflectance(self.index, cos_in, self.polarisation)


@dataclass(frozen=True)
class Absorption:
    """Beer-Lambert: exp(-a s) of the flux is left behind a path s in the glass."""

    coefficient: float  # a (1/mm)

    line, in_glass, fused = ABSORBED, True, True

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """exp(-a s)."""
        return elementary(torch.exp, -self.coefficient * path)


@dataclass(frozen=True)
class Own:
    """A loss by a script or a package (scene.effects.effect), which no kernel knows."""

    name: str
    wavelength: float  # nm
    loss: Any = field(compare=False)  # with share(cos_in, cos_out, path); of one name and wavelength there is one

    fused = False

    @property
    def line(self) -> str:
        """Its line of the ledger."""
        return f"taken by {self.name}"

    @property
    def in_glass(self) -> bool:
        """Does it act in the glass alone?"""
        return bool(getattr(self.loss, "in_glass", False))

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Its own share; ValueError, by name, where it is no tensor like the cosines."""
        share = self.loss.share(cos_in, cos_out, path)
        if not (isinstance(share, Tensor) and share.shape == cos_in.shape):
            given = f"a tensor of shape {tuple(share.shape)}" if isinstance(share, Tensor) else type(share).__name__
            raise ValueError(f"effect {self.name!r}: share() gives {given}, not a tensor like cos_in")
        return share


@dataclass(frozen=True)
class Fresnel:
    """Reflection at the faces: the polarisation, the coating, and the metal of a mirror."""

    wavelength: float  # nm
    polarisation: Polarisation = "none"
    coating: Coating | None = None
    metal: complex | None = None  # n + ik

    def of(self, interface: Interface, index: float = 1.0) -> Loss:
        """The loss at an interface; index: of the medium before it."""
        law = interface.law
        if law.reverses:
            return MetalReflection(self.metal / index, self.polarisation)
        return Transmission(law.n_in, law.n_out, self.wavelength, polarisation=self.polarisation, coating=self.coating)


@dataclass(frozen=True)
class Losses:
    """Losses of light of one wavelength at the faces and in the glass of a lens."""

    fresnel: Fresnel | None = None
    absorption: Absorption | None = None
    own: tuple[Own, ...] = ()

    def on(self, interfaces: Sequence[Interface]) -> tuple[Interface, ...]:
        """The interfaces of a lens with the losses at each, and in the glass on the way to it."""
        index = getattr(interfaces[0].law, "n_out", 1.0)  # behind the first interface
        return tuple(replace(each, losses=self._at(k, each, index if k else 1.0)) for k, each in enumerate(interfaces))

    def _at(self, k: int, interface: Interface, index: float) -> tuple[Loss, ...]:
        inside = (self.absorption,) if self.absorption and k > 0 else ()  # behind the first interface is glass
        own = (loss for loss in self.own if k > 0 or not loss.in_glass)
        return (*inside, *own, *((self.fresnel.of(interface, index),) if self.fresnel else ()))  # the last: a ghost's


def _amplitudes(n_in: float, n_out: float, cos_in: Tensor, cos_out: Tensor) -> tuple[Tensor, Tensor]:
    """(r_s, r_p) of a boundary of two media."""
    a, b, c, d = n_in * cos_in, n_out * cos_out, n_out * cos_in, n_in * cos_out
    return (a - b) / (a + b), (c - d) / (c + d)


def _mean(s: Tensor, p: Tensor, polarisation: Polarisation) -> Tensor:
    """The mean over one polarisation, or over both in equal parts."""
    return s if polarisation == "s" else p if polarisation == "p" else (s + p) / 2
