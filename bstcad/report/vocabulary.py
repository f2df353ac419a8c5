"""The words for effects, simulated or neglected, and for the lines of the flux ledger of a lens or a mirror."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bstcad.report.units import turned

if TYPE_CHECKING:
    from bstcad.optics.sources import Collimated, Point
    from bstcad.scene.scene import Scene

LEFT_OUT = {  # LeftOut.kind: in words
    "fresnel": "Fresnel reflection",
    "reflectance": "reflectance below 1",
    "absorption": "absorption in the glass",
    "dispersion": "dispersion",
    "source size": "size of the source",
    "ghost": "ghosts, light reflected twice inside the lens",
    "shadows": "shadows of the source and of the mirror on itself",
    "stray light": "stray light",
    "diffraction": "diffraction",
}
WAYS = {  # of the light
    "lens": "Light travels along +z",
    "mirror": "Light comes down to the mirror along -z and leaves it along +z",
}
OF_GLASS = ("lost through the sides", "total internal reflection")  # lines of the ledger that a mirror cannot have


@dataclass(frozen=True)
class Simulated:
    """A part of the physics that is simulated."""

    what: str  # in words
    key: str  # of the scene, which asks for it


def simulated(scene: Scene) -> tuple[Simulated, ...]:
    """The physics that is simulated for a scene, in the order in which light meets it."""
    return tuple(Simulated(*item) for part in (_source, _faces, _effects, _target) for item in part(scene))


def _source(scene: Scene) -> Iterator[tuple[str, str]]:
    source = scene.source
    if len(source.lines) > 1:
        yield f"a spectrum of {len(source.lines)} lines", "source.wavelength"
    for key, size in extent(source):
        yield f"an extended source: its {key} of {size}", f"source.{key}"
    if source.tilted:
        yield f"a source tilted by {turned(source.tilt, '{:g}'.format)}", "source.tilt"


def extent(source: Collimated | Point) -> Iterator[tuple[str, str]]:
    """The keys of a source that give it a size, and that with its unit."""
    for key in ("diameter", "width", "height", "divergence"):
        if value := getattr(source, key, None):
            yield key, f"{value:g} {'degrees' if key == 'divergence' else 'mm'}"


def _faces(scene: Scene) -> Iterator[tuple[str, str]]:
    if scene.lens.back.reflect:
        lossless = not any(effect.kind == "fresnel" for effect in scene.effects)
        yield "reflection at the face" + (", without loss" if lossless else ""), "lens.back.reflect"
    else:
        medium = "lens.material" if scene.lens.index is None else "lens.index"
        yield "refraction at both faces (vector Snell)", medium
        if len(scene.source.lines) > 1:
            yield "dispersion of the material", medium
        yield "total internal reflection", medium
    if scene.mount and (scene.mount.rim or scene.mount.draft or scene.mount.bevel):
        yield "vignetting by the mount's rim, draft and bevel", "mount"
    else:
        yield "vignetting by the outline", "lens.outline"


def _effects(scene: Scene) -> Iterator[tuple[str, str]]:
    for k, effect in enumerate(scene.effects):
        key = f"effects[{k}].kind"
        if effect.kind == "fresnel":
            polarised = "" if effect.polarisation == "none" else f", {effect.polarisation}-polarised light"
            if scene.lens.back.reflect:
                yield f"reflectance of the metal{polarised}", key
            else:
                coated = f", faces coated ({effect.coating.thickness:g} nm)" if effect.coating else ""
                yield f"Fresnel reflection at both faces{polarised}{coated}", key
        elif effect.kind == "absorption":
            yield "absorption in the glass (Beer-Lambert)", key
        else:
            if not any(other.kind == "fresnel" for other in scene.effects):  # which a ghost brings with it
                yield "Fresnel reflection at both faces", key
            yield LEFT_OUT[effect.kind], key


def _target(scene: Scene) -> Iterator[tuple[str, str]]:
    if (tilt := scene.target.tilt) and any(tilt):
        yield f"a target tilted by {turned(tilt, '{:g}'.format)}", "target.tilt"


def ledger(flux: Mapping[str, float], of: str) -> dict[str, float]:
    """The lines of a ledger as people read them."""
    lines = {line: part for line, part in flux.items() if of == "lens" or line not in OF_GLASS}
    return {line.replace("the lens", f"the {of}"): part for line, part in lines.items()}
