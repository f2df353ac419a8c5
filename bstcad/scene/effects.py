"""Effects of a scene: [[effects]] tables; an absent effect costs no time.

None is simulated by default, but with the luminous flux of the source known, the reflection at the faces of a lens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import Field, PrivateAttr

from bstcad.optics.lens import media
from bstcad.optics.surfaces.key import Key
from bstcad.scene.blank import INDICES, LensBlank
from bstcad.scene.schema import Record

if TYPE_CHECKING:
    from bstcad.optics.lens.losses import Losses
    from bstcad.optics.light.emitters import Emitter
    from bstcad.optics.trace.measure import GhostTracer

METAL = "Al"  # default metal of a mirror
PACKAGES = "bstcad.effects"  # group of entry points with which an installed package adds effects
LossFactory = Callable[[float], Any]  # function of a wavelength (nm) that returns a loss (optics.lens.interfaces.Loss)
_REGISTERED: dict[str, LossFactory] = {}  # functions registered by `effect`, by name


class Coating(Record):
    """A single layer on both faces of the lens."""

    index: Annotated[float, Key("Refractive index of the layer.", "", *INDICES, example=1.38)]
    thickness: Annotated[float, Key("Thickness of the layer.", "nm", 0.0, 1e5, example=100.0)]


class Fresnel(Record):
    """Reflection at the faces of a lens, or reflectance of a mirror's metal, in tailoring and verification."""

    kind: Annotated[Literal["fresnel"], Key("Reflection at the faces.")]
    polarisation: Annotated[Literal["none", "s", "p"], Key("Polarisation relative to the plane of incidence.")] = "none"
    coating: Annotated[
        Coating | None, Key("A single layer on both faces of a lens.", example={"index": 1.38, "thickness": 100.0})
    ] = None
    metal: Annotated[str | None, Key("Metal of a mirror; Al if absent.")] = None


class Absorption(Record):
    """Beer-Lambert absorption along the path in the glass, in tailoring and verification."""

    kind: Annotated[Literal["absorption"], Key("Absorption along the path in the glass.")]
    coefficient: Annotated[float | None, Key("Absorption coefficient (default: material's).", "1/mm", 0.0, 1e3)] = None


class Ghost(Record):
    """Light reflected twice inside the lens, in verification.

    The faces then reflect light as the effect `fresnel` states, or without it as bare faces reflect unpolarised light.
    """

    kind: Annotated[Literal["ghost"], Key("Light reflected twice inside the lens, in verification.")]


class Own(Record):
    """A loss of flux defined by a script or an installed package, in tailoring and verification; see `effect`."""

    kind: Annotated[Literal["own"], Key("A loss of flux defined by a script or an installed package.")]
    name: Annotated[str, Key("Name that the script or the package gave the effect.", example="dust")]
    _makes: LossFactory | None = PrivateAttr(None)  # pickled with the record for other processes

    def model_post_init(self, context: Any) -> None:
        """Find the function that a script or an installed package registered under the effect's name."""
        self._makes = _REGISTERED.get(self.name) or _installed(self.name)

    def of(self, wavelength: float) -> Any:
        """Return the loss at a wavelength (nm)."""
        assert self._makes is not None  # otherwise `complaints` has refused the scene
        return self._makes(wavelength)


def effect(name: str, makes: LossFactory) -> Own:
    """Return an effect of your own for scene.changed({"effects": [...]}): a loss of flux at faces or in the glass.

    makes(wavelength in nm) returns an object with a method share(cos_in, cos_out, path), which returns the fraction of
    each ray's flux that continues: a tensor of the shape of the arguments, differentiable in them.  cos_in and cos_out
    are the cosines of the angles of incidence and of refraction (or reflection); path is the length (mm) of the ray
    before the face.  The loss acts at each face of the lens that light meets, not at other elements; if the object has
    the attribute in_glass = True, it acts only along paths in the glass.  The ledger counts it as "taken by NAME".  The
    scene file contains only NAME, so a script calls `effect` before it opens such a design; an installed package
    declares an entry point NAME = "module:makes" of the group "bstcad.effects" instead.
    """
    _REGISTERED[name] = makes
    return Own(kind="own", name=name)


def _installed(name: str) -> LossFactory | None:
    """Return the function that an installed package declares under a name as an entry point; None if there is none."""
    return next((found.load() for found in entry_points(group=PACKAGES, name=name)), None)


Effect: TypeAlias = Annotated[Fresnel | Absorption | Ghost | Own, Field(discriminator="kind")]
Effects: TypeAlias = tuple[Effect, ...]
OneEffect = TypeVar("OneEffect", bound=Record)


def complaints(effects: Effects, lens: LensBlank) -> Iterator[str]:
    """Yield complaints about effects that are stated twice, impossible for this lens or mirror, or without data."""
    for k, effect in enumerate(effects):
        key, glass = f"effects[{k}]", lens.passes.enters
        if any(_name(effect) == _name(other) for other in effects[:k]):
            yield f"{key}: {_name(effect)!r} is named twice; remove one of the two tables"
        if isinstance(effect, Own) and effect._makes is None:
            yield (
                f"{key}.name: the effect {effect.name!r} is not known; call bstcad.effect({effect.name!r}, …) before "
                "the scene is read, or install the package that defines it"
            )
        if {"absorption": not glass, "ghost": lens.passes.reflects}.get(effect.kind):
            key_of_mirror = f"(lens.{lens.passes.mirror}.reflect)"
            bare = f"a mirror {key_of_mirror} has no {effect.kind}, as light does not enter it"
            why = f"ghosts of a mirror behind glass {key_of_mirror} are not simulated" if glass else bare
            yield f"{key}: {why}; remove the table"
        if not glass and getattr(effect, "coating", None) is not None:
            bare = "the face of a mirror (lens.back.reflect) is bare metal"
            yield f"{key}.coating: {bare}; remove this key, or set {key}.metal"
        if not lens.passes.reflects and getattr(effect, "metal", None) is not None:
            yield f"{key}.metal: only a mirror (lens.back.reflect, lens.front.reflect) has a metal; remove this key"
        if effect.kind == "absorption" and effect.coefficient is None and lens.material is None:
            yield f"{key}.coefficient: missing, and so is lens.material; add it in 1/mm, or set lens.material"


def default(source: Emitter, lens: LensBlank) -> Effects:
    """Return the effects of a scene that states none: `fresnel` for a lens if the flux of the source is known.

    Absolute photometry needs the losses at the faces.  The reflectance of a mirror depends on its metal, which only the
    scene can state.
    """
    known = source.luminous_flux is not None and not lens.passes.reflects
    return (Fresnel(kind="fresnel"),) if known else ()


def _name(effect: Effect) -> str:
    return effect.name if isinstance(effect, Own) else effect.kind


def find_effect(effects: Effects, kind: type[OneEffect]) -> OneEffect | None:
    """Return the scene's effect of the class `kind`; None if the scene does not have it."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def reflection_of(effects: Effects) -> Fresnel | None:
    """Return the scene's effect `fresnel`; if it has only `ghost`, that of bare faces; None if it has neither."""
    bare = Fresnel(kind="fresnel") if find_effect(effects, Ghost) else None
    return find_effect(effects, Fresnel) or bare


def ghost(effects: Effects) -> GhostTracer | None:
    """Return the function that traces light reflected twice inside the lens; None if the scene has no ghost."""
    if find_effect(effects, Ghost) is None:
        return None
    from bstcad.optics.trace.trace import ghost_light

    return ghost_light


def losses(effects: Effects, lens: LensBlank, wavelength: float) -> Losses | None:
    """Return the losses at a wavelength (nm), or None (without loading optics.lens.losses) if the scene has no losses.

    Raises ValueError, in one sentence, if the data of the material do not suffice.
    """
    fresnel, absorption = reflection_of(effects), find_effect(effects, Absorption)
    others = [effect for effect in effects if isinstance(effect, Own)]
    if fresnel is None and absorption is None and not others:
        return None
    from bstcad.optics.lens import losses as physics

    reflection = absorbed = coating = None
    if fresnel is not None:
        if (layer := fresnel.coating) is not None:
            coating = physics.CoatingLayer(layer.index, layer.thickness)
        metal = media.complex_index(fresnel.metal or METAL, wavelength) if lens.passes.reflects else None
        reflection = physics.FresnelLoss(wavelength, fresnel.polarisation, coating, metal)
    if absorption is not None:
        coefficient = absorption.coefficient
        if coefficient is None:
            assert lens.material is not None  # otherwise `complaints` has refused the scene
            coefficient = media.absorption_coefficient(lens.material, wavelength)
        absorbed = physics.AbsorptionLoss(coefficient)
    own = tuple(physics.CustomLoss(other.name, wavelength, other.of(wavelength)) for other in others)
    return physics.Losses(reflection, absorbed, own)
