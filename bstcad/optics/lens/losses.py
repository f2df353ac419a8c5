"""Losses of flux: Fresnel reflection at faces, absorption in glass, absorption by a metal mirror.

`share(cos_in, cos_out, path)` of a loss is the fraction of a ray's flux that remains behind an interface, given the
cosines of the angles of incidence and of refraction or reflection there and the path before it (mm); `line` is the line
of the flux ledger that counts the rest.  `Losses` assigns the losses of one wavelength to the interfaces of a lens.

Born and Wolf, Principles of Optics, 7th ed.: Fresnel's equations, section 1.5.2; single layer, 1.6.4; metals, 14.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Interface, Loss, Reflect
from bstcad.optics.numerics.reductions import elementary

# Lines of the flux ledger.
REFLECTED, ABSORBED, BY_THE_MIRROR = "reflected at the faces", "absorbed in the glass", "absorbed by the mirror"
Polarisation = Literal["none", "s", "p"]


@dataclass(frozen=True)
class CoatingLayer:
    """A single-layer coating of a face."""

    index: float  # refractive index at the wavelength
    thickness: float  # physical thickness, nm


def reflectance(
    n_in: float, n_out: float, cos_in: Tensor, cos_out: Tensor, polarisation: Polarisation = "none"
) -> Tensor:
    """Return the reflectance R of an uncoated face between two media.

    r_s = (n cos θ - n' cos θ') / (n cos θ + n' cos θ'),  r_p = (n' cos θ - n cos θ') / (n' cos θ + n cos θ'),
    R = r² of one polarisation with respect to the plane of incidence, or the mean of s and p.
    """
    r_s, r_p = _amplitudes(n_in, n_out, cos_in, cos_out)
    return _mean(r_s * r_s, r_p * r_p, polarisation)


def coated_reflectance(face: Transmission, coating: CoatingLayer, cos_in: Tensor, cos_out: Tensor) -> Tensor:
    """Return the reflectance R of a face with a single layer between its two media.

    r = (r_1 + r_2 e^{2iβ}) / (1 + r_1 r_2 e^{2iβ}),  β = 2π n_f d cos θ_f / λ,  r_1 and r_2 the amplitudes at the two
    sides of a layer (index n_f, thickness d).  Its angle θ_f is real for transmitted light, since n_f >= 1 >= n sin θ.
    """
    n_f = coating.index
    cos_f = torch.sqrt(1 - (face.n_in / n_f) ** 2 * (1 - cos_in * cos_in))
    phase = 2 * elementary(torch.cos, (4 * math.pi * n_f * coating.thickness / face.wavelength) * cos_f)
    first, second = _amplitudes(face.n_in, n_f, cos_in, cos_f), _amplitudes(n_f, face.n_out, cos_f, cos_out)
    reflectances = []
    for r_1, r_2 in zip(first, second, strict=True):
        product = r_1 * r_2
        reflectances.append((r_1 * r_1 + r_2 * r_2 + product * phase) / (1 + product * product + product * phase))
    return _mean(reflectances[0], reflectances[1], face.polarisation)


def metal_reflectance(index: complex, cos_in: Tensor, polarisation: Polarisation = "none") -> Tensor:
    """Return the reflectance R of a metal; index: its complex index n + ik, divided by that of the medium before it.

    With a + ib = sqrt((n + ik)² - sin² θ):  R_s = ((a - cos θ)² + b²) / ((a + cos θ)² + b²),
    R_p = R_s ((a cos θ - sin² θ)² + b² cos² θ) / ((a cos θ + sin² θ)² + b² cos² θ).
    """
    sin2 = 1 - cos_in * cos_in
    real, imaginary = (index * index).real - sin2, (index * index).imag
    modulus = torch.sqrt(real * real + imaginary * imaginary)
    a, b2 = torch.sqrt((modulus + real) / 2), (modulus - real) / 2
    r_s = ((a - cos_in) ** 2 + b2) / ((a + cos_in) ** 2 + b2)
    b2_cos2 = b2 * cos_in * cos_in
    r_p = r_s * ((a * cos_in - sin2) ** 2 + b2_cos2) / ((a * cos_in + sin2) ** 2 + b2_cos2)
    return _mean(r_s, r_p, polarisation)


@dataclass(frozen=True)
class Transmission:
    """Transmittance T = 1 - R of a face; the rest counts as reflected."""

    n_in: float  # refractive index before the face
    n_out: float  # refractive index behind the face
    wavelength: float  # wavelength in vacuum, nm
    polarisation: Polarisation = "none"
    coating: CoatingLayer | None = None  # single layer on the face; None: uncoated

    line, in_glass, fused = REFLECTED, False, True

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Return T at the angles of incidence and refraction."""
        if self.coating is None:
            return 1 - reflectance(self.n_in, self.n_out, cos_in, cos_out, polarisation=self.polarisation)
        return 1 - coated_reflectance(self, self.coating, cos_in, cos_out)


@dataclass(frozen=True)
class MetalReflection:
    """Reflectance R of a metal mirror; the rest is absorbed by the metal."""

    index: complex  # n + ik of the metal divided by the index of the medium before it
    polarisation: Polarisation = "none"

    line, in_glass, fused = BY_THE_MIRROR, False, True

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Return R at the angle of incidence."""
        return metal_reflectance(self.index, cos_in, self.polarisation)


@dataclass(frozen=True)
class AbsorptionLoss:
    """Absorption by the Beer-Lambert law: the fraction exp(-a s) remains after a path s in the glass."""

    coefficient: float  # absorption coefficient a, 1/mm

    line, in_glass, fused = ABSORBED, True, True

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Return exp(-a s)."""
        return elementary(torch.exp, -self.coefficient * path)


@dataclass(frozen=True)
class CustomLoss:
    """A loss defined by a script or a package (scene.effects.effect), without a kernel."""

    name: str  # name of the effect in the scene
    wavelength: float  # wavelength, nm
    loss: Any = field(compare=False)  # object with share(cos_in, cos_out, path), determined by name and wavelength

    fused = False

    @property
    def line(self) -> str:
        """Line of the flux ledger that counts this loss."""
        return f"taken by {self.name}"

    @property
    def in_glass(self) -> bool:
        """True if the loss acts on the path in the glass, False if at the faces."""
        return bool(getattr(self.loss, "in_glass", False))

    def share(self, cos_in: Tensor, cos_out: Tensor, path: Tensor) -> Tensor:
        """Return the fraction that remains; raise ValueError if it is not a tensor of the cosines' shape."""
        share = self.loss.share(cos_in, cos_out, path)
        if not (isinstance(share, Tensor) and share.shape == cos_in.shape):
            found = f"a tensor of shape {tuple(share.shape)}" if isinstance(share, Tensor) else type(share).__name__
            raise ValueError(f"effect {self.name!r}: share() returned {found}; return a tensor of the shape of cos_in")
        return share


@dataclass(frozen=True)
class FresnelLoss:
    """Fresnel reflection at the faces: polarisation, coating, and the metal of a mirror."""

    wavelength: float  # wavelength, nm
    polarisation: Polarisation = "none"
    coating: CoatingLayer | None = None  # single layer on every refracting face; None: uncoated
    metal: complex | None = None  # n + ik of the mirror's metal; None: no mirror

    def of(self, interface: Interface, index: float = 1.0) -> Loss:
        """Return the loss at an interface; index: refractive index of the medium before it."""
        law = interface.law
        if isinstance(law, Reflect):
            assert self.metal is not None  # FresnelLoss of a mirror states it
            return MetalReflection(self.metal / index, self.polarisation)
        return Transmission(law.n_in, law.n_out, self.wavelength, polarisation=self.polarisation, coating=self.coating)


@dataclass(frozen=True)
class Losses:
    """Losses at the faces and in the glass of a lens, for light of one wavelength."""

    fresnel: FresnelLoss | None = None  # reflection at the faces; None: no such loss
    absorption: AbsorptionLoss | None = None  # absorption in the glass; None: no such loss
    own: tuple[CustomLoss, ...] = ()  # losses defined by scripts or packages

    def on(self, interfaces: Sequence[Interface]) -> tuple[Interface, ...]:
        """Return the interfaces of a lens, each with the losses at the face and in the glass before it."""
        index = getattr(interfaces[0].law, "n_out", 1.0)  # index behind the first interface
        return tuple(replace(each, losses=self._at(k, each, index if k else 1.0)) for k, each in enumerate(interfaces))

    def _at(self, k: int, interface: Interface, index: float) -> tuple[Loss, ...]:
        inside = (self.absorption,) if self.absorption and k > 0 else ()  # glass lies behind the first interface
        own = (loss for loss in self.own if k > 0 or not loss.in_glass)
        return (*inside, *own, *((self.fresnel.of(interface, index),) if self.fresnel else ()))  # last, for trace.ghost


def _amplitudes(n_in: float, n_out: float, cos_in: Tensor, cos_out: Tensor) -> tuple[Tensor, Tensor]:
    """Return the reflected amplitudes (r_s, r_p) at a boundary between two media (see `reflectance`)."""
    a, b, c, d = n_in * cos_in, n_out * cos_out, n_out * cos_in, n_in * cos_out
    return (a - b) / (a + b), (c - d) / (c + d)


def _mean(s: Tensor, p: Tensor, polarisation: Polarisation) -> Tensor:
    return s if polarisation == "s" else p if polarisation == "p" else (s + p) / 2
