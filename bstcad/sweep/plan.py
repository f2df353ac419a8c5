"""A plan of a scene before its design: the effects that are simulated and left out, and the predictions.

The changes by effects that are left out are estimated (analysis.neglected_effects) on a coarse lens of two transport
maps and fits of slopes, in a second or two; most are good to a factor of two.  Reports have them of the finished lens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bstcad.analysis.neglected_effects import Change, Reference
from bstcad.optics import media
from bstcad.optics.channels import Channel
from bstcad.optics.lens import Lens
from bstcad.report.assemble import simulated
from bstcad.report.record import LeftOut
from bstcad.scene.check import rim_sags
from bstcad.scene.effects import Absorption, Effect, Fresnel, losses, named, reflection_of
from bstcad.scene.errors import line_of, toml_positions
from bstcad.scene.scene import Scene
from bstcad.tailoring.clearance import moved_clear
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.slope_map import back_grid, follow, lit_window, slope_map

if TYPE_CHECKING:
    from bstcad.sweep.work import Units

LINE = 10.0  # nm; width of a line of which the scene says nothing: an LED's is 20 to 40, a laser's below 1
DIAMETER = 0.1  # mm; of a point source
DIVERGENCE = 0.1  # degrees; of parallel light
THREE = ((-(0.6**0.5), 5 / 18), (0.0, 8 / 18), (0.6**0.5, 5 / 18))  # Gauss points of an even line, in half widths
DISC = tuple((x, y, 1 / 4) for x in (-0.5, 0.5) for y in (-0.5, 0.5))  # points of an even disc, in radii; degree 3
NET, CELLS, PIXELS = 33, 32, 64  # a side of the coarse lens: control points, cells of its transport, pixels it aims at
FRONT_NET = 17  # control points a side of the lenses among which a front is sought of which something is free
ROUNDS, STEPS = 2, 40  # of transport and slope fit, the second from the sag of the first; of each transport


def plan(
    scene: Scene,
    text: str = "",
    settings: Sequence[str] = (),
    units: Callable[[], Units] | None = None,
    first: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """The entries of `plan --json`: predicted, simulated and left_out, the latter ranked by its change of the RRMSD.

    text: of the scene file, whose lines are named.  settings: the keys that the command line gives instead.  units:
    measures the units of this machine (work.units).  first: is called with simulated and left_out as soon as they are
    known, seconds before the predictions.
    """
    at, lens = toml_positions(text), coarse_lens(scene)
    asked = [{"what": what, "key": key, **_asked(key, at, settings)} for what, key in simulated(scene)]
    estimates = left_out(scene, lens, scene.target.irradiance())
    effects = {"simulated": asked, "left_out": [asdict(estimate) for estimate in estimates]}
    if first:
        first(effects)
    from bstcad.sweep import forecast, work  # a fifth of a second to load, after `first`

    return forecast.outlook(scene, lens, units or work.units).facts() | effects


def _asked(key: str, at: Mapping[str, int], settings: Sequence[str]) -> dict[str, Any]:
    """The line of the file that asks for an effect, None if the command line does, or nobody; and that in words."""
    for other in settings:
        if other == key or key.startswith(f"{other}.") or other.startswith(f"{key}."):
            return {"line": None, "asked_by": f"--set {other}"}
    line = line_of(key, at)
    return {"line": line, "asked_by": key if line is None else f"{key}, line {line}"}


@torch.no_grad()
def coarse_lens(scene: Scene) -> Lens:
    """A lens for the scene whose angles and paths are near those of the finished lens; its picture is coarse."""
    target, lens = scene.target, scene.flat_lens(NET)
    channel = _central(scene)
    lens = channel.through(lens)
    picture = _coarse(target.irradiance(), PIXELS)
    screen = replace(target.screen, pixels=picture.shape[::-1])
    if scene.lens.front.free:
        from bstcad.tailoring.stage1 import shaped_front  # with scipy.optimize, a tenth of a second to load

        tried = replace(lens, back=scene.flat_lens(FRONT_NET).back)
        found = shaped_front(
            channel.source, tried, picture, screen, free=scene.lens.front.free, rim_sags=rim_sags(scene), n=CELLS,
            iterations=STEPS, repeats=1,
        )  # fmt: skip
        lens = replace(lens, front=found.front)
    wanted, z = None, lens.back.z
    for _ in range(ROUNDS):
        window = lit_window(channel.source, lens)
        wanted = slope_map(
            channel.source, lens, window, picture, screen=screen, n=CELLS, previous=wanted, iterations=STEPS
        )
        grid = back_grid(channel.source, lens, window, 2 * NET)
        lens = follow(lens, wanted, grid, Fit(bending=1e-2, steps=20, degree=3), unlit=0.0)
        lens = moved_clear(lens, z, scene.lens.min_thickness)
    return lens


def _coarse(picture: np.ndarray, most: int) -> np.ndarray:
    """The picture on at most `most` x `most` pixels, each the sum of whole ones."""
    for axis in (0, 1):
        few = min(most, picture.shape[axis])
        starts = (np.arange(few) * picture.shape[axis]) // few
        picture = np.add.reduceat(picture, starts, axis)
    return picture


def left_out(scene: Scene, lens: Lens, picture: np.ndarray) -> tuple[LeftOut, ...]:
    """The effects that the scene leaves out, and their change of the picture of this lens; the largest change first.

    picture: (rows, columns) flux in each pixel, of the target or as the lens throws it.
    """
    reference = Reference.of(lens, _central(scene), scene.target.screen, picture, scene.lens.back.control_points)
    found = list(_mirror(scene, reference) if lens.reflects else _lens(scene, reference))
    found += _size(scene, reference)
    found.append(_entry("diffraction", reference.diffraction(), "of the whole aperture"))
    found.append(_entry("stray light", None, "it depends on the finish of the faces"))
    return tuple(sorted(found, key=lambda entry: -(entry.rrmsd_change or 0.0)))


def _lens(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if reflection_of(scene.effects) is None:
        yield _entry("fresnel", reference.change([_central(scene, Fresnel(kind="fresnel"))]),
                     simulate_by='[[effects]] kind = "fresnel"')  # fmt: skip
    if named(scene.effects, Absorption) is None:
        yield _absorption(scene, reference)
    if len(scene.source.lines) == 1:
        yield _dispersion(scene, reference)
    if not any(effect.kind == "ghost" for effect in scene.effects):
        yield _entry("ghost", reference.ghost(_reflecting(scene)), "roughly, since it may gather to a spot",
                     '[[effects]] kind = "ghost"')  # fmt: skip


def _mirror(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if named(scene.effects, Fresnel) is None:
        yield _entry("reflectance", reference.change([_central(scene, Fresnel(kind="fresnel"))]), "of aluminium",
                     '[[effects]] kind = "fresnel"')  # fmt: skip
    yield _entry("shadows", None, "they depend on the lamp's housing")


def _central(scene: Scene, *more: Effect) -> Channel:
    """The light of the middle of the source at its main wavelength, with more effects than the scene names."""
    source = scene.source.central
    return Channel(source, scene.index, losses=losses((*scene.effects, *more), scene.lens, source.wavelength))


def _reflecting(scene: Scene) -> Channel:
    """The same with faces that reflect, as the scene has it or bare."""
    return _central(scene, *(() if named(scene.effects, Fresnel) else (Fresnel(kind="fresnel"),)))


def _absorption(scene: Scene, reference: Reference) -> LeftOut:
    by = '[[effects]] kind = "absorption", coefficient = … (1/mm)'
    if scene.lens.material is None:
        return _entry("absorption", None, "lens.index names no material", by)
    try:
        absorbing = _central(scene, Absorption(kind="absorption"))
    except ValueError:
        return _entry("absorption", None, f"there are no data of {scene.lens.material}", by)
    return _entry("absorption", reference.change([absorbing]), simulate_by='[[effects]] kind = "absorption"')


def _dispersion(scene: Scene, reference: Reference) -> LeftOut:
    by, channel, material = "source.wavelength = [[nm, weight], …]", reference.channel, scene.lens.material
    if material is None:
        return _entry("dispersion", None, "lens.index names no material", f"lens.material, and {by}")
    middle = channel.source.wavelength
    around = [(middle + LINE / 2 * place, weight) for place, weight in THREE]
    try:
        channels = [replace(channel, index=media.refractive_index(material, nm), weight=w) for nm, w in around]
    except ValueError:
        return _entry("dispersion", None, f"there are no data of {material} around {middle:g} nm", by)
    return _entry("dispersion", reference.change(channels), f"of a line {LINE:g} nm wide", by, assumed=True)


def _size(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if scene.source.extent is not None:
        return
    if scene.source.kind == "point":
        key, real, least, unit = "diameter", scene.source.real_diameter, DIAMETER, "mm"
    else:
        key, real, least, unit = "divergence", scene.source.real_divergence, DIVERGENCE, "degrees"
    wide = replace(reference.channel.source, **{key: real or least})
    radius = wide.extent.radius
    channels = [replace(reference.channel, source=wide.element(radius * u, radius * v), weight=w) for u, v, w in DISC]
    if real:
        said, assumed = f"source.real_{key} = {real:g} {unit}", False
    else:
        said, assumed = f"a {'disc' if unit == 'mm' else 'cone'} of {least:g} {unit}", True
    yield _entry("source size", reference.change(channels), said, f"source.{key}", assumed=assumed)


def _entry(kind: str, change: Change | None, detail: str = "", simulate_by: str = "", assumed: bool = False) -> LeftOut:
    if change is None:
        reason = detail or "no light reaches the target"
        return LeftOut(kind, None, None, None, detail=reason, simulate_by=simulate_by)
    numbers = (float(f"{value:.3g}") for value in (change.flux, change.rrmsd, change.blur))
    return LeftOut(kind, *numbers, detail=detail, simulate_by=simulate_by, assumed=assumed)
