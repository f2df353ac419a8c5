"""The effects that a scene names: [[effects]] tables, none by default; each costs nothing where it is absent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, PrivateAttr

from bstcad.optics import media
from bstcad.optics.key import Key
from bstcad.scene.blank import INDICES, LensBlank
from bstcad.scene.schema import Record

if TYPE_CHECKING:
    from bstcad.optics.losses import Losses
    from bstcad.optics.measure import GhostTracer

METAL = "Al"  # of a mirror, unless a scene names another
PACKAGES = "bstcad.effects"  # group of entry points by which an installed package brings effects along
Makes = Callable[[float], Any]  # the loss (optics.interfaces.Loss) of light of a wavelength (nm)
_KNOWN: dict[str, Makes] = {}  # by the names that `effect` was given


class Coating(Record):
    """A single layer on both faces of the lens."""

    index: Annotated[float, Key("Refractive index of the layer.", "", *INDICES, example=1.38)]
    thickness: Annotated[float, Key("Thickness of the layer.", "nm", 0.0, 1e5, example=100.0)]


class Fresnel(Record):
    """Reflection at the faces of a lens, or the reflectance of a mirror's metal; in tailoring and in verification."""

    kind: Annotated[Literal["fresnel"], Key("Reflection at the faces.")]
    polarisation: Annotated[Literal["none", "s", "p"], Key("Polarisation against the plane of incidence.")] = "none"
    coating: Annotated[
        Coating | None,
        Key("A single layer on both faces of a lens.", example={"index": 1.38, "thickness": 100.0}),
    ] = None
    metal: Annotated[str | None, Key("Metal of a mirror; Al if absent.")] = None


class Absorption(Record):
    """Beer-Lambert absorption along the path in the glass; in tailoring and in verification."""

    kind: Annotated[Literal["absorption"], Key("Absorption along the path in the glass.")]
    coefficient: Annotated[float | None, Key("Absorption coefficient; the material's if absent.", "1/mm", 0.0, 1e3)] = (
        None
    )


class Ghost(Record):
    """Light that is reflected twice inside the lens; in verification.

    Faces that reflect from inside do so from outside too: a scene with a ghost has `fresnel` as well, that of bare
    faces and unpolarised light if no other is named.
    """

    kind: Annotated[Literal["ghost"], Key("Light reflected twice inside the lens, in verification.")]


class Own(Record):
    """A loss of flux by a script or an installed package, in tailoring and in verification; see `effect`."""

    kind: Annotated[Literal["own"], Key("A loss of flux by a script or an installed package.")]
    name: Annotated[str, Key("Name under which the script or the package has it.", example="dust")]
    _makes: Makes | None = PrivateAttr(None)  # travels with the record to other processes

    def model_post_init(self, context: Any) -> None:
        """Look the name up."""
        self._makes = _KNOWN.get(self.name) or _installed(self.name)

    def of(self, wavelength: float) -> Any:
        """The loss of light of a wavelength (nm)."""
        assert self._makes is not None  # else `complaints` refused the scene
        return self._makes(wavelength)


def effect(name: str, makes: Makes) -> Own:
    """An effect of one's own for scene.changed({"effects": [...]}): a loss of flux at faces or in the glass.

    makes(wavelength in nm) gives an object with share(cos_in, cos_out, path): the part of each ray's flux that goes on,
    a tensor like the cosines of incidence and of refraction (or reflection) and the path before the face in mm, and
    differentiable in them.  It acts at each face that light goes through or is reflected by; with the attribute
    in_glass = True on the way through the glass alone.  The ledger counts the rest as "taken by NAME".  The scene file
    holds the name: a script that opens such a design calls `effect` first, and an installed package declares an entry
    point NAME = "module:makes" of the group "bstcad.effects" instead.
    """
    _KNOWN[name] = makes
    return Own(kind="own", name=name)


def _installed(name: str) -> Makes | None:
    """What an installed package has under a name."""
    return next((found.load() for found in entry_points(group=PACKAGES, name=name)), None)


Effect = Annotated[Fresnel | Absorption | Ghost | Own, Field(discriminator="kind")]
Effects = tuple[Effect, ...]


def complaints(effects: Effects, lens: LensBlank) -> Iterator[str]:
    """Effects that are named twice, that the lens or the mirror does not have, or of which no data are known."""
    for k, effect in enumerate(effects):
        key, glass = f"effects[{k}]", lens.passes.enters
        if any(_name(effect) == _name(other) for other in effects[:k]):
            yield f"{key}: {_name(effect)!r} is named twice; remove one of the two tables"
        if isinstance(effect, Own) and effect._makes is None:
            yield (
                f"{key}.name: no effect is called {effect.name!r} here; let the script that has it call "
                f"bstcad.effect({effect.name!r}, …) first, or install its package"
            )
        if {"absorption": not glass, "ghost": lens.passes.reflects}.get(effect.kind):
            by = f"(lens.{lens.passes.mirror}.reflect)"
            bare = f"light does not enter a mirror {by}, so it has no {effect.kind}"
            why = f"ghosts of a mirror behind glass {by} are not simulated" if glass else bare
            yield f"{key}: {why}; remove the table"
        if not glass and getattr(effect, "coating", None) is not None:
            bare = "a mirror's face (lens.back.reflect) is bare metal"
            yield f"{key}.coating: {bare}; remove it, or name the metal by {key}.metal"
        if not lens.passes.reflects and getattr(effect, "metal", None) is not None:
            yield f"{key}.metal: is for a mirror (lens.back.reflect, lens.front.reflect); remove it"
        if effect.kind == "absorption" and effect.coefficient is None and lens.material is None:
            yield f"{key}.coefficient: missing, and lens.index names no material; add it in 1/mm, or give lens.material"


def _name(effect: Effect) -> str:
    return effect.name if isinstance(effect, Own) else effect.kind


def named(effects: Effects, kind: type) -> Record | None:
    """The effect of a kind; None if the scene names none."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def reflection_of(effects: Effects) -> Fresnel | None:
    """The reflection that a scene names, or that of bare faces where it names a ghost alone; None: there is none."""
    bare = Fresnel(kind="fresnel") if named(effects, Ghost) else None
    return named(effects, Fresnel) or bare


def ghost(effects: Effects) -> GhostTracer | None:
    """How light is followed that is reflected twice inside the lens; None: it is left out."""
    if named(effects, Ghost) is None:
        return None
    from bstcad.optics.trace import ghost_light

    return ghost_light


def losses(effects: Effects, lens: LensBlank, wavelength: float) -> Losses | None:
    """The losses of light of a wavelength (nm); None: there are none, and their module is not even loaded.

    Raises ValueError, in one sentence, where the material's data do not say enough.
    """
    fresnel, absorption = reflection_of(effects), named(effects, Absorption)
    others = [effect for effect in effects if isinstance(effect, Own)]
    if fresnel is None and absorption is None and not others:
        return None
    from bstcad.optics import losses as physics

    reflection = absorbed = None
    if fresnel is not None:
        coating = fresnel.coating and physics.Coating(fresnel.coating.index, fresnel.coating.thickness)
        metal = media.complex_index(fresnel.metal or METAL, wavelength) if lens.passes.reflects else None
        reflection = physics.Fresnel(wavelength, fresnel.polarisation, coating, metal)
    if absorption is not None:
        given = absorption.coefficient
        absorbed = physics.Absorption(
            media.absorption_coefficient(lens.material, wavelength) if given is None else given
        )
    own = tuple(physics.Own(other.name, wavelength, other.of(wavelength)) for other in others)
    return physics.Losses(reflection, absorbed, own)
