"""The effects that a scene names: [[effects]] tables, none by default; each costs nothing where it is absent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from bstcad.optics import media
from bstcad.scene.target import Record

if TYPE_CHECKING:
    from bstcad.optics.effects import Losses
    from bstcad.optics.measure import GhostLight
    from bstcad.scene.wanted import LensBlank


class Coating(Record):
    """A single layer on both faces of the lens."""

    index: float
    thickness: float  # nm


class Fresnel(Record):
    """Reflection at the faces of a lens, or the reflectance of a mirror's metal; in tailoring and in verification."""

    kind: Literal["fresnel"]
    polarisation: Literal["none", "s", "p"] = "none"  # in relation to each ray's plane of incidence
    coating: Coating | None = None  # of a lens
    metal: str | None = None  # of a mirror; None: aluminium


class Absorption(Record):
    """Beer-Lambert absorption along the path in the glass; in tailoring and in verification."""

    kind: Literal["absorption"]
    coefficient: float | None = None  # 1/mm; None: the material's


class Ghost(Record):
    """Light that is reflected twice inside the lens; in verification.

    Faces that reflect from inside do so from outside too: whoever names a ghost has `fresnel` as well, that of bare
    faces and unpolarised light if no other is named.
    """

    kind: Literal["ghost"]


Effect = Annotated[Fresnel | Absorption | Ghost, Field(discriminator="kind")]
Effects = tuple[Effect, ...]
METAL = "Al"


def named(effects: Effects, kind: type) -> Record | None:
    """The effect of a kind; None if the scene names none."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def reflection_of(effects: Effects) -> Fresnel | None:
    """What faces reflect: as the scene names it, that of bare faces where it names a ghost alone; None: nothing."""
    bare = Fresnel(kind="fresnel") if named(effects, Ghost) else None
    return named(effects, Fresnel) or bare


def ghost(effects: Effects) -> GhostLight | None:
    """How light is followed that is reflected twice inside the lens; None: it is left out."""
    if named(effects, Ghost) is None:
        return None
    from bstcad.optics.ghosts import ghost_light

    return ghost_light


def losses(effects: Effects, lens: LensBlank, wavelength: float) -> Losses | None:
    """What they take of light of a wavelength (nm); None: nothing, and the module of effects is not even loaded.

    Raises ValueError, in one sentence, where the material's data do not say enough.
    """
    fresnel, absorption = reflection_of(effects), named(effects, Absorption)
    if fresnel is None and absorption is None:
        return None
    from bstcad.optics import effects as physics  # where no effect is asked for nothing of it is there

    reflection = absorbed = None
    if fresnel is not None:
        coating = fresnel.coating and physics.Coating(fresnel.coating.index, fresnel.coating.thickness)
        metal = media.complex_index(fresnel.metal or METAL, wavelength) if lens.back.reflect else None
        reflection = physics.Fresnel(wavelength, fresnel.polarisation, coating, metal)
    if absorption is not None:
        given = absorption.coefficient
        absorbed = physics.Absorption(
            media.absorption_coefficient(lens.material, wavelength) if given is None else given
        )
    return physics.Losses(reflection, absorbed)
