"""Light sources: each says what flux crosses a plane z = const, and in which direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from bstcad.optics.outlines import STRICT, Outline


@dataclass(frozen=True)
class Collimated:
    """Rays along +z through an aperture; E = const, or exp(-2 r² / w²) with w = radius_1e2."""

    aperture: Outline
    wavelength: float = 587.6  # nm
    profile: Literal["uniform", "gaussian"] = "uniform"
    radius_1e2: float | None = None  # 1/e² radius of the Gaussian profile (mm)
    z: float = 0.0  # plane the rays start from (mm)
    kind: Literal["collimated"] = "collimated"

    __pydantic_config__ = STRICT


@dataclass(frozen=True)
class Point:
    """Rays from one point, towards +z.

    gaussian: irradiance on z = const falls as exp(-2 r² / w²), w = distance · tan(half_angle_1e2);
    lambertian: radiant intensity cos(theta); uniform: constant radiant intensity up to half_angle.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # mm
    wavelength: float = 587.6  # nm
    profile: Literal["gaussian", "lambertian", "uniform"] = "lambertian"
    half_angle_1e2: float | None = None  # degrees, gaussian
    half_angle: float | None = None  # degrees, uniform
    diameter: float | None = None  # mm; an extended disc
    kind: Literal["point"] = "point"

    __pydantic_config__ = STRICT


Source = Collimated | Point
