"""Estimates around a design: changes by the effects that are left out, and the diagnosis of a finished design.

Before a design the effects are estimated (analysis.neglected_effects) on a coarse lens of two transport maps and fits
of slopes, in a second or two; most are good to a factor of two.  Reports have them of the finished lens.  The diagnosis
of a finished design takes the pictures and the history of the run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from bstcad.analysis.cost import ending, remaining
from bstcad.analysis.neglected_effects import Change, Reference
from bstcad.optics import media
from bstcad.optics.channels import Channel
from bstcad.optics.lens import Lens
from bstcad.optics.sides import as_pair
from bstcad.report.record import DesignCourse, LeftOut
from bstcad.scene.effects import Absorption, Effect, Fresnel, Ghost, losses, named, reflection_of
from bstcad.scene.scene import Scene
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.slope_map import face_grid, fit_to_map, lit_window, slope_map
from bstcad.verify.checks import AtBound

# --- a coarse lens ----------------------------------------------------------------------------------------------------

NET, CELLS, PIXELS = 33, 32, 64  # a side of the coarse lens: control points, cells of its transport, pixels it aims at
FRONT_NET = 17  # control points a side of the lenses among which a front is sought of which something is free
ROUNDS, STEPS = 2, 40  # of transport and slope fit, the second from the sag of the first; of each transport


@torch.no_grad()
def coarse_lens(scene: Scene) -> Lens:
    """A lens for the scene whose angles and paths are near those of the finished lens; its picture is coarse."""
    channel = _central(scene)
    lens = channel.through(scene.flat_lens(NET))
    picture = _coarse(scene.target.irradiance(), PIXELS)
    screen = replace(scene.target.screen, pixels=picture.shape[::-1])
    if scene.lens.front.free:
        from bstcad.tailoring.stage1 import shaped_front  # with scipy.optimize, a tenth of a second to load

        tried = replace(lens, back=scene.flat_lens(FRONT_NET).back)
        found = shaped_front(
            channel.source, tried, picture, screen, free=scene.lens.front.free, rim_sags=scene.rim_sags, n=CELLS,
            iterations=STEPS, repeats=1,
        )  # fmt: skip
        lens = replace(lens, front=found.front)
    wanted, z = None, lens.back.z
    for _ in range(ROUNDS):
        window = lit_window(channel.source, lens)
        wanted = slope_map(
            channel.source, lens, window, picture, screen=screen, n=CELLS, previous=wanted, iterations=STEPS
        )
        grid = face_grid(channel.source, lens, window, 2 * NET)
        lens = fit_to_map(lens, wanted, grid, Fit(bending=1e-2, steps=20, degree=3), unlit=0.0)
        lens = place_back(lens, z, scene.lens.min_thickness)
    return lens


def _coarse(picture: np.ndarray, most: int) -> np.ndarray:
    """The picture on at most `most` x `most` pixels, each the sum of whole ones."""
    for axis in (0, 1):
        few = min(most, picture.shape[axis])
        starts = (np.arange(few) * picture.shape[axis]) // few
        picture = np.add.reduceat(picture, starts, axis)
    return picture


def _central(scene: Scene, *more: Effect) -> Channel:
    """The light of the middle of the source at its main wavelength, with more effects than the scene names."""
    source = scene.source.central
    lost = losses((*scene.effects, *more), scene.lens, source.wavelength)
    return Channel(source, scene.index, losses=lost, around=scene.around(source.wavelength))


# --- effects that are left out ----------------------------------------------------------------------------------------

VISIBLE = (400.0, 700.0)  # nm; of white light
SUN = (0.5, 0.56)  # degrees; divergence of sunlight, 0.53 in the mean
LINE = 10.0  # nm; width of a line of which the scene says nothing: an LED's is 20 to 40, a laser's below 1
DIAMETER = 0.1  # mm; of a point source
DIVERGENCE = 0.1  # degrees; of parallel light
USUAL = {"diameter": (DIAMETER, "disc", "mm"), "divergence": (DIVERGENCE, "cone", "degrees")}  # by Emitter.size_key
THREE = ((-(0.6**0.5), 5 / 18), (0.0, 8 / 18), (0.6**0.5, 5 / 18))  # Gauss points of an even line, in half widths
DISC = tuple((x, y, 1 / 4) for x in (-0.5, 0.5) for y in (-0.5, 0.5))  # points of an even disc, in radii; degree 3
BY_FRESNEL, BY_LINES = '[[effects]] kind = "fresnel"', "source.wavelength = [[nm, weight], …]"


def left_out(scene: Scene, lens: Lens, picture: np.ndarray) -> tuple[LeftOut, ...]:
    """The effects that the scene leaves out, and their change of the picture of this lens; the largest change first.

    picture: (rows, columns) flux in each pixel, of the target or as the lens throws it.
    """
    screen, points = scene.target.screen, math.prod(as_pair(scene.lens.back.net))
    reference = Reference.of(lens, _central(scene), screen, picture=picture, control_points=points)
    found = [*_of_glass(scene, reference), *_of_mirror(scene, reference)]
    found += _size(scene, reference)
    found.append(_entry("diffraction", reference.diffraction(), "of the whole aperture"))
    found.append(_entry("stray light", None, "it depends on the finish of the faces"))
    return tuple(sorted(found, key=lambda entry: -(entry.rrmsd_change or 0.0)))


def _of_glass(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if not scene.lens.passes.enters:
        return
    bare = Fresnel(kind="fresnel")
    if reflection_of(scene.effects) is None:
        yield _entry("fresnel", reference.change([_central(scene, bare)]), simulate_by=BY_FRESNEL)
    if named(scene.effects, Absorption) is None:
        yield _absorption(scene, reference)
    if len(scene.source.lines) == 1:
        yield _dispersion(scene, reference)
    if scene.lens.passes.reflects:
        yield _entry("ghost", None, "ghosts of a mirror behind glass are not simulated")
    elif named(scene.effects, Ghost) is None:
        reflecting = _central(scene, *(() if named(scene.effects, Fresnel) else (bare,)))
        yield _entry(
            "ghost", reference.ghost(reflecting), "roughly, since it may gather to a spot", '[[effects]] kind = "ghost"'
        )


def _of_mirror(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if not scene.lens.passes.reflects:
        return
    if not scene.lens.passes.enters and named(scene.effects, Fresnel) is None:
        aluminium = _central(scene, Fresnel(kind="fresnel"))
        yield _entry("reflectance", reference.change([aluminium]), "of aluminium", BY_FRESNEL)
    yield _entry("shadows", None, "they depend on the lamp's housing")


def _absorption(scene: Scene, reference: Reference) -> LeftOut:
    by, material = '[[effects]] kind = "absorption"', scene.lens.material
    try:
        absorbing = _central(scene, Absorption(kind="absorption")) if material else None
    except ValueError:
        absorbing = None
    if absorbing is None:
        reason = f"there are no data of {material}" if material else "lens.index names no material"
        return _entry("absorption", None, reason, f"{by}, coefficient = … (1/mm)")
    return _entry("absorption", reference.change([absorbing]), simulate_by=by)


def _dispersion(scene: Scene, reference: Reference) -> LeftOut:
    channel, material = reference.channel, scene.lens.material
    if material is None:
        return _entry("dispersion", None, "lens.index names no material", f"lens.material, and {BY_LINES}")
    low, high = band(scene)
    around = [((low + high) / 2 + (high - low) / 2 * place, weight) for place, weight in THREE]
    try:
        channels = [replace(channel, index=media.refractive_index(material, nm), weight=w) for nm, w in around]
    except ValueError:
        between = f"from {low:g} to {high:g} nm"
        return _entry("dispersion", None, f"there are no data of {material} {between}", BY_LINES)
    sun = (low, high) == VISIBLE
    words = f"of sunlight, even from {low:g} to {high:g} nm" if sun else f"of a line {LINE:g} nm wide"
    return _entry("dispersion", reference.change(channels), words, BY_LINES, assumed=not sun)


def band(scene: Scene) -> tuple[float, float]:
    """Return the band (nm) that light of one wavelength stands for: of the sun's divergence VISIBLE, else LINE wide."""
    source = scene.source
    if source.size_key == "divergence" and SUN[0] <= (source.divergence or source.real_divergence or 0.0) <= SUN[1]:
        return VISIBLE
    return source.main_wavelength - LINE / 2, source.main_wavelength + LINE / 2


def _size(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if scene.source.extent is not None or (key := scene.source.size_key) is None:
        return
    stated, (usual, shape, unit) = getattr(scene.source, f"real_{key}"), USUAL[key]
    wide = replace(reference.channel.source, **{key: stated or usual})
    radius = wide.extent.radius
    channels = [replace(reference.channel, source=wide.element(radius * u, radius * v), weight=w) for u, v, w in DISC]
    words = f"source.real_{key} = {stated:g} {unit}" if stated else f"a {shape} of {usual:g} {unit}"
    yield _entry("source size", reference.change(channels), words, f"source.{key}", assumed=not stated)


def _entry(kind: str, change: Change | None, detail: str = "", simulate_by: str = "", assumed: bool = False) -> LeftOut:
    if change is None:
        reason = detail or "no light reaches the target"
        return LeftOut(kind, None, None, None, detail=reason, simulate_by=simulate_by)
    numbers = (float(f"{value:.3g}") for value in (change.flux, change.rrmsd, change.blur))
    return LeftOut(kind, *numbers, detail=detail, simulate_by=simulate_by, assumed=assumed)


# --- the diagnosis of a finished design -------------------------------------------------------------------------------

SIZES = "stage 3, "  # how the stages of a design begin that are for one size of the source each


def diagnosis(
    scene: Scene, making: DesignCourse, lens: Lens, *, picture: np.ndarray, target: np.ndarray, efficiency: float,
    at_bounds: Mapping[str, AtBound] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return of a design the entries convergence, remaining_error and bounds of report.json (record.Contents).

    lens: as re-read, which throws this picture (rows, columns), of the target's sum.
    at_bounds: where the tailored faces are at a bound, by key.
    """
    sizes = [k for k, stage in enumerate(making.stages) if stage.name.startswith(SIZES)]
    curve = ending(
        [(point.seconds, point.rrmsd) for point in making.history],
        [(stage.seconds, stage.rrmsd) for stage in making.stages],
        since=math.fsum(stage.seconds for stage in making.stages[: max(sizes[2:], default=0)]),  # of the whole source
    )
    met = {key: at for key, at in (at_bounds or {}).items() if key in scene.lens.bounded_by}
    bounds = {
        "asked": {key: getattr(scene.lens, key) for key in scene.lens.bounded_by},
        "at": {key: at.share for key, at in met.items()}, "tightest": {key: at.tightest for key, at in met.items()},
        **({"both" if lens.shapes("back") else "front": True} if lens.shapes("front") else {}),  # that they are on
    }  # fmt: skip
    return {
        "convergence": None if curve is None else asdict(curve),
        "remaining_error": remaining(picture, target, scene.target.screen.per_unit) | {"outside": 1 - efficiency},
        "bounds": bounds if bounds["asked"] else None,
    }
