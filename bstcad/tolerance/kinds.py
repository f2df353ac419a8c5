"""What can be off in how a lens is made, mounted and lit: each kind by name, with its unit and what it does to a setup.

Decentres and tilts are those of a part against all that stays; a lens tilts about its middle, a source about itself,
a screen about its own middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bstcad.optics.channels import Channel
from bstcad.optics.lens import Lens
from bstcad.optics.media import refractive_index
from bstcad.optics.motion import Motion, turns_alike
from bstcad.optics.sources import Source
from bstcad.optics.surfaces import Sphere
from bstcad.tolerance import face_errors
from bstcad.tolerance.setup import Setup

AXES = ("x", "y", "z")
Apply = Callable[[Setup, float], Setup]  # (as designed, by how much) -> as it comes out
FRONT = 100  # added to the seeds of its form: other fields than the back has
BAND = 20.0  # nm to either side of each line, over which the material's index is to be known
# (expansion 1/K, dn/dT 1/K) at room temperature.  PMMA: Baeumer, Handbook of Plastic Optics (2nd ed. 2010), table 5.1;
# N-BK7: Schott's data sheet (α from -30 to 70 °C; Δn_rel/ΔT at 546 nm, 20 to 40 °C).
THERMAL = {"PMMA": (6.5e-5, -1.05e-4), "N-BK7": (7.1e-6, 3.0e-6)}


@dataclass(frozen=True)
class Kind:
    """One thing that can be off."""

    name: str  # as in scene files: "lens.decentre_x"
    words: str  # as a report says it
    unit: str  # of its amounts; "" for a ratio
    apply: Apply


def kinds(setup: Setup, material: str | None = None) -> dict[str, Kind]:
    """All that can be off in a setup with one number; what makes no difference there, or is not told, is left out."""
    lens, sources = setup.lens, [channel.source for channel in setup.channels]
    optic = "mirror" if lens.reflects else "lens"
    found = [*_rigid(setup)]
    if not lens.reflects:
        found.append(Kind("lens.thickness", "thickness of the lens", "mm", _thicker))
        found.append(Kind("lens.index", "refractive index", "", lambda s, by: s.with_indices(lambda n: n + by)))
        found.append(Kind("lens.front_power", "sag of the front at its rim", "mm", _front_power))
    found.append(Kind("lens.scale", f"scale of the {optic} (shrinkage)", "", lambda s, by: s.with_lens_scaled(1 + by)))
    if material in THERMAL and not lens.reflects:
        found.append(Kind("temperature", f"temperature of the lens ({material})", "K", partial(_warmer, material)))
    if material is not None and not lens.reflects and _disperses(material, sources):
        found.append(Kind("wavelength", "wavelength of the light", "nm", partial(_redder, material)))
    if any(_angle(source) for source in sources):
        found.append(Kind("source.angle", "width of the source's cone, relative", "", _wider))
    if len({source.place for source in sources}) > 1 and all(source.kind == "point" for source in sources):
        found.append(Kind("source.size", "size of the source, relative", "", _larger))
    return {kind.name: kind for kind in found}


def _rigid(setup: Setup) -> list[Kind]:
    """Shifts along and turns about x, y and z of lens, source and screen."""
    collimated = all(c.source.kind == "collimated" and not c.source.tilted for c in setup.channels)
    round_light = all(turns_alike(channel.source) for channel in setup.channels)
    found = []
    for part in ("lens", "source", "screen"):
        said = "mirror" if part == "lens" and setup.lens.reflects else part
        for k, axis in enumerate(AXES):
            if part == "source" and axis == "z" and collimated:
                continue  # parallel light is the same from further away
            words = f"{said} along the axis" if axis == "z" else f"decentre of the {said} in {axis}"
            name = f"{part}.axial" if axis == "z" else f"{part}.decentre_{axis}"
            found.append(Kind(name, words, "mm", partial(_moved, part, k, False)))
        for k, axis in enumerate(AXES):
            clocking = axis == "z"
            if clocking and (part == "source" or (part == "lens" and not round_light)):
                continue  # light that is round does not show it, and other light cannot be turned so
            words = f"clocking of the {said}" if clocking else f"tilt of the {said} about {axis}"
            name = f"{part}.clocking" if clocking else f"{part}.tilt_{axis}"
            found.append(Kind(name, words, "deg", partial(_moved, part, k, True)))
    return found


def _moved(part: str, axis: int, turns: bool, setup: Setup, by: float) -> Setup:
    amounts = tuple(by if k == axis else 0.0 for k in range(3))
    about = {"lens": setup.middle, "source": setup.foot, "screen": setup.screen.middle}[part]
    motion = Motion.of(turn=amounts, about=about) if turns else Motion.of(shift=amounts)
    return getattr(setup, f"with_{part}_moved")(motion)


def _thicker(setup: Setup, by: float) -> Setup:
    lens = setup.lens
    return replace(setup, lens=replace(lens, back=lens.back.moved(lens.back.z + by)))


def _front_power(setup: Setup, by: float) -> Setup:
    """A front whose rim stands higher by so much (mm): c + 2 by / R², R the farthest from the axis."""
    lens = setup.lens
    front, rim2 = lens.front, sum(p * p for p in lens.outline.farthest)
    if front.curvature is None:
        x, y = (np.linspace(*side, front.m) for side in (front.x, front.y))
        more = by * (x[:, None] ** 2 + y[None, :] ** 2) / rim2
        return replace(
            setup, lens=replace(lens, front=replace(front, heights=front.heights + front.heights.new_tensor(more)))
        )
    curvature = front.curvature + 2 * by / rim2
    bent = front.with_parameters(curvature=curvature) if front.curvature else Sphere(front.z, curvature)
    return replace(setup, lens=replace(lens, front=bent))


def _warmer(material: str, setup: Setup, by: float) -> Setup:
    expansion, of_index = THERMAL[material]
    return setup.with_lens_scaled(1 + expansion * by).with_indices(lambda n: n + of_index * by)


def _disperses(material: str, sources: list[Source]) -> bool:
    """Is the material's index known around each line of the light?"""
    try:
        for nm in {source.wavelength for source in sources}:
            refractive_index(material, nm - BAND), refractive_index(material, nm + BAND)
    except ValueError:
        return False
    return True


def _redder(material: str, setup: Setup, by: float) -> Setup:
    """Every line of the light longer by so much (nm); what faces and glass take is held as it was."""

    def change(channel: Channel) -> Channel:
        nm = channel.source.wavelength
        more = refractive_index(material, nm + by) - refractive_index(material, nm)
        return replace(channel, index=channel.index + more)

    return replace(setup, channels=tuple(change(channel) for channel in setup.channels))


def _angle(source: Source) -> float | None:
    """The half angle (degrees) of a point that shines into a cone."""
    return source.kind == "point" and (source.half_angle_1e2 or source.half_angle)


def _wider(setup: Setup, by: float) -> Setup:
    def change(source: Source) -> Source:
        name = "half_angle_1e2" if source.half_angle_1e2 else "half_angle"
        angle = math.radians(getattr(source, name))
        return replace(source, **{name: math.degrees(math.atan((1 + by) * math.tan(angle)))})

    return setup.with_sources(change)


def _larger(setup: Setup, by: float) -> Setup:
    middle = setup.foot

    def change(source: Source) -> Source:
        return replace(
            source, position=tuple(m + (1 + by) * (p - m) for p, m in zip(source.position, middle, strict=True))
        )

    return setup.with_sources(change)


def form_error(lens: Lens, correlation_length: float, seed: int, face: str = "back") -> Kind:
    """A random field on the back or the front; amounts are its RMS (mm)."""
    front = face == "front"
    net = face_errors.as_net(lens.front, lens.outline) if front else lens.back
    field = face_errors.random_field(net, correlation_length, seed + FRONT * front, face_errors.inside(lens, net))
    return Kind(
        f"{face}.form_{seed}", f"form of the {face}, correlated over {correlation_length:.3g} mm (draw {seed})",
        "mm RMS", partial(_front_raised if front else _raised, field),
    )  # fmt: skip


def ripple(lens: Lens, period: float, pattern: str) -> Kind:
    """What a tool leaves on the back; amounts are its RMS (mm)."""
    field = face_errors.ripple(lens.back, period, pattern, face_errors.inside(lens, lens.back))
    return Kind("back.ripple", f"{pattern} ripple of the back, period {period:g} mm", "mm RMS", partial(_raised, field))


def _front_raised(field: np.ndarray, setup: Setup, by: float) -> Setup:
    lens = setup.lens
    net = face_errors.as_net(lens.front, lens.outline)
    return replace(setup, lens=replace(lens, front=face_errors.higher(net, by * field)))


def _raised(field: np.ndarray, setup: Setup, by: float) -> Setup:
    return replace(setup, lens=face_errors.raised(setup.lens, by * field))
