"""List the effects that a design simulates, estimate those that it neglects, and diagnose a finished design.

Before a design the effects are estimated (analysis.neglected_effects) with a coarse lens, made in a second or two by
two rounds of transport and slope fit; most estimates are accurate within a factor of two.  Reports state estimates for
the finished lens.  The diagnosis of a finished design uses its picture and the history of the run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from bstcad.analysis.cost import ending, remaining
from bstcad.analysis.neglected_effects import Change, Reference, difference
from bstcad.designs.course import DesignCourse
from bstcad.optics.lens import media
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.profiles import pair_of
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.surfaces.sides import as_pair
from bstcad.optics.trace.measure import tubes_picture
from bstcad.report.record import LEFT_OUT, LeftOut, extent
from bstcad.report.units import Rows, tables
from bstcad.scene.effects import Absorption, Effect, Fresnel, Ghost, find_effect, losses
from bstcad.scene.real_source import DEFAULT_DIAMETER as DEFAULT_DIAMETER
from bstcad.scene.real_source import DEFAULT_DIVERGENCE as DEFAULT_DIVERGENCE
from bstcad.scene.real_source import real_size
from bstcad.scene.scene import Scene
from bstcad.tailoring.effort import FrontSearch
from bstcad.tailoring.machinability import place_back
from bstcad.tailoring.slope_fit import Fit
from bstcad.tailoring.slope_map import Solver, face_grid, fit_to_map, lit_window, slope_map, square_grid
from bstcad.verify.checks import Proof

# --- a coarse lens ----------------------------------------------------------------------------------------------------

COARSE_POINTS, COARSE_CELLS, COARSE_PIXELS = 33, 32, 64  # control points, transport cells and target pixels per side
FRONT_NET = 17  # control points per side of the back while a front with free parameters is optimised
TRANSPORT_ROUNDS, COARSE_STEPS = 2, 40  # rounds of transport and slope fit, and iterations of each transport


@torch.no_grad()
def coarse_lens(scene: Scene) -> Lens:
    """Return a lens with nearly the ray angles and path lengths of the finished lens, but with a coarse picture."""
    channel = _central_channel(scene)
    lens = channel.through(scene.flat_lens(COARSE_POINTS))
    picture = _downsample(scene.target.irradiance(), COARSE_PIXELS)
    rows, columns = picture.shape
    goal = Goal("target", replace(scene.target.screen, pixels=(columns, rows)), picture)
    if scene.lens.front.free:
        from bstcad.tailoring import stage1  # with scipy.optimize, a tenth of a second to load

        start = lens.with_back(scene.flat_lens(FRONT_NET).back)
        free, effort = scene.lens.front.free, FrontSearch(COARSE_CELLS, COARSE_STEPS, repeats=1)
        found = stage1.shaped_front(channel.source, start, goal, free, rim_sags=scene.rim_sags, effort=effort)
        lens = lens.with_front(found.front)
    slopes, z = None, lens.back.z
    for _ in range(TRANSPORT_ROUNDS):
        window = lit_window(channel.source, lens)
        grid = square_grid(channel.source, lens, window, COARSE_CELLS)
        slopes = slope_map(lens, grid, goal, slopes, solver=Solver(COARSE_STEPS))
        grid = face_grid(channel.source, lens, window, 2 * COARSE_POINTS)
        lens = fit_to_map(lens, slopes, grid, Fit(bending=1e-2, steps=20, degree=3))
        lens = place_back(lens, z, scene.lens.min_thickness)
    return lens


def _downsample(picture: np.ndarray, limit: int) -> np.ndarray:
    """Return the picture on at most `limit` x `limit` pixels, each the sum of whole pixels."""
    for axis in (0, 1):
        count = min(limit, picture.shape[axis])
        starts = (np.arange(count) * picture.shape[axis]) // count
        picture = np.add.reduceat(picture, starts, axis)
    return picture


def _central_channel(scene: Scene, *more: Effect) -> Channel:
    """Return the central channel of the source at its main wavelength; losses: by the scene's effects and `more`."""
    source = scene.light.central
    loss_factors = losses((*scene.effects, *more), scene.lens, source.main_wavelength)
    return Channel(source, scene.index, losses=loss_factors, around=scene.around(source.main_wavelength))


# --- neglected effects ------------------------------------------------------------------------------------------------

VISIBLE_BAND = (400.0, 700.0)  # band of white light, nm
SUN_ANGLES = (0.5, 0.56)  # range of full divergence angles (degrees) treated as sunlight; the sun's mean is 0.53
LINE_WIDTH = 10.0  # assumed width (nm) of a spectral line; LEDs have 20 to 40, lasers less than 1
LINE_POINTS = ((-(0.6**0.5), 5 / 18), (0.0, 8 / 18), (0.6**0.5, 5 / 18))  # (offset / half width of the band, weight)
BAND_POINTS = ((-0.5, 0.5), (0.5, 0.5))  # (offset, weight) where lines stand for bands
TUBES_PER_PIXEL = 1.0  # flux tubes per pixel, along each side, for the pictures of lines and of a continuous spectrum
FRESNEL_KEYS, LINES_KEYS = '[[effects]] kind = "fresnel"', "source.wavelength = [[nm, weight], …]"  # TOML for scenes


def simulated(scene: Scene) -> Rows:
    """Return the simulated effects: name, and the key of the scene that requests the effect."""
    return tables("simulated.txt.j2", scene=scene, extent=list(extent(scene.source)), names=LEFT_OUT)["simulated"]


def left_out(scene: Scene, lens: Lens, picture: np.ndarray) -> tuple[LeftOut, ...]:
    """Return the neglected effects with the changes that each causes, the largest change of the RRMSD first.

    picture: flux in each pixel (rows, columns), from the target or the traced lens.
    """
    points = math.prod(as_pair(scene.lens.back.net))
    reference = Reference.of(lens, _central_channel(scene), scene.target.screen, picture=picture, control_points=points)
    entries = [*_glass_effects(scene, reference), *_mirror_effects(scene, reference)]
    entries += _source_size(scene.source, reference)
    entries.append(_diffraction(reference))
    entries.append(_entry("stray light", None, "which depends on the finish of the faces"))
    return tuple(sorted(entries, key=lambda entry: -(entry.rrmsd_change or 0.0)))


def _diffraction(reference: Reference) -> LeftOut:
    """Return diffraction at the aperture; over directions with its blur λ / D in degrees."""
    change, screen, words = reference.diffraction(), reference.screen, "at the whole aperture"
    if change is not None and screen.receiver.unit == "degrees":
        blur = change.blur / math.sqrt(math.prod(screen.per_unit))
        words = f"{words}, λ/D = {blur:.2g} degrees"
    return _entry("diffraction", change, words)


def _glass_effects(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if not scene.lens.passes.enters:
        return
    bare = Fresnel(kind="fresnel")
    if not scene.loses_reflections:
        yield _entry("fresnel", reference.change([_central_channel(scene, bare)]), simulate_by=FRESNEL_KEYS)
    if find_effect(scene.effects, Absorption) is None:
        yield _absorption(scene, reference)
    yield _dispersion(scene.source, scene.lens.material, reference)
    if scene.lens.passes.reflects:
        yield _entry("ghost", None, "ghosts of a mirror behind glass are not simulated")
    elif find_effect(scene.effects, Ghost) is None:
        reflecting = _central_channel(scene, *(() if find_effect(scene.effects, Fresnel) else (bare,)))
        change, reason = reference.ghost(reflecting), "a rough estimate, since ghosts may focus to a spot"
        yield _entry("ghost", change, reason, '[[effects]] kind = "ghost"')


def _mirror_effects(scene: Scene, reference: Reference) -> Iterator[LeftOut]:
    if not scene.lens.passes.reflects:
        return
    if not scene.lens.passes.enters and find_effect(scene.effects, Fresnel) is None:
        aluminium = _central_channel(scene, Fresnel(kind="fresnel"))
        yield _entry("reflectance", reference.change([aluminium]), "of aluminium", FRESNEL_KEYS)
    yield _entry("shadows", None, "which depend on the lamp's housing")


def _absorption(scene: Scene, reference: Reference) -> LeftOut:
    keys, material = '[[effects]] kind = "absorption"', scene.lens.material
    try:
        absorbing = _central_channel(scene, Absorption(kind="absorption")) if material else None
    except ValueError:
        absorbing = None
    if absorbing is None:
        reason = f"there are no data of {material}" if material else "lens.index names no material"
        return _entry("absorption", None, reason, f"{keys}, coefficient = … (1/mm)")
    return _entry("absorption", reference.change([absorbing]), simulate_by=keys)


def _dispersion(source: Emitter, material: str | None, reference: Reference) -> LeftOut:
    """Return the change by the width of an only line, or by light between several lines.

    Several lines may stand for a continuous spectrum.  Their pictures then lie between those of other wavelengths, and
    each has structures that only the sum of all lines does not have.
    """
    channel, lines = reference.channel, source.lines
    if material is None:
        return _entry("dispersion", None, "lens.index names no material", f"lens.material, and {LINES_KEYS}")
    bands = [band(source)] if len(lines) == 1 else _bands([nm for nm, _ in lines])
    points = LINE_POINTS if len(lines) == 1 else BAND_POINTS
    finer = [
        ((low + high) / 2 + (high - low) / 2 * place, weight * share)
        for (low, high), (_, weight) in zip(bands, lines, strict=True)
        for place, share in points
    ]
    try:
        channels, own = (
            [replace(channel, index=media.refractive_index(material, nm), weight=weight) for nm, weight in each]
            for each in (finer, lines)
        )
    except ValueError:
        span = f"from {min(nm for nm, _ in finer):.0f} to {max(nm for nm, _ in finer):.0f} nm"
        return _entry("dispersion", None, f"there are no data of {material} {span}", LINES_KEYS)
    change = reference.change(channels)
    if len(lines) > 1:
        words = f"if the light is continuous between the {len(lines)} lines, as for a lamp"
        if change is not None:
            tubes = math.ceil(TUBES_PER_PIXEL * max(reference.screen.shape))
            after, before = (
                tubes_picture(reference.lens, each, reference.screen, tubes).numpy() for each in (channels, own)
            )
            change = replace(change, flux=float(after.sum() / before.sum() - 1), rrmsd=difference(after, before))
        return _entry("dispersion", change, words, f"{LINES_KEYS}, with more lines", assumed=True)
    [(low, high)] = bands
    sun = (low, high) == VISIBLE_BAND
    words = f"of sunlight, uniform from {low:g} to {high:g} nm" if sun else f"for a spectral width of {LINE_WIDTH:g} nm"
    return _entry("dispersion", change, words, LINES_KEYS, assumed=not sun)


def _bands(lines: Sequence[float]) -> list[tuple[float, float]]:
    """Return the band (low, high), nm, of each line: to the middle between neighbours, and as far beyond the last."""
    middle = [(low + high) / 2 for low, high in pairwise(sorted(lines))]
    edges = [2 * min(lines) - middle[0], *middle, 2 * max(lines) - middle[-1]]
    bands = dict(zip(sorted(lines), pairwise(edges), strict=True))
    return [bands[nm] for nm in lines]


def band(source: Emitter) -> tuple[float, float]:
    """Return the band (low, high), nm, assumed for one wavelength: VISIBLE_BAND for sunlight, else LINE_WIDTH wide."""
    if isinstance(source, CollimatedSource):
        divergences = pair_of(source.divergence or source.real_divergence or 0.0)
        if all(SUN_ANGLES[0] <= divergence <= SUN_ANGLES[1] for divergence in divergences):
            return VISIBLE_BAND
    return source.main_wavelength - LINE_WIDTH / 2, source.main_wavelength + LINE_WIDTH / 2


def _source_size(source: Emitter, reference: Reference) -> Iterator[LeftOut]:
    if (size := real_size(source)) is not None:
        change = reference.change(size.channels(reference.channel))
        yield _entry("source size", change, size.words, f"source.{size.key}", assumed=size.assumed)


def _entry(kind: str, change: Change | None, detail: str = "", simulate_by: str = "", assumed: bool = False) -> LeftOut:
    if change is None:
        reason = detail or "no light reaches the target"
        return LeftOut(kind, None, None, None, detail=reason, simulate_by=simulate_by)
    flux, rrmsd, blur = (float(f"{value:.3g}") for value in (change.flux, change.rrmsd, change.blur))
    return LeftOut(kind, flux, rrmsd, blur, detail=detail, simulate_by=simulate_by, assumed=assumed)


# --- the diagnosis of a finished design -------------------------------------------------------------------------------


def diagnosis(scene: Scene, course: DesignCourse, proof: Proof, target: np.ndarray) -> dict[str, Any]:
    """Return the entries convergence, remaining_error and bounds of report.json (record.Contents).

    scene: scene with only the target of the largest RRMSD in the proof.  target: its picture (rows, columns).
    """
    sizes = [k for k, stage in enumerate(course.stages) if stage.is_round and stage.stage == "stage 3"]
    curve = ending(
        [(point.seconds, point.rrmsd) for point in course.history],
        [(stage.seconds, stage.rrmsd) for stage in course.stages],
        since=math.fsum(stage.seconds for stage in course.stages[: max(sizes[2:], default=0)]),  # last round
    )
    reached = {key: at for key, at in (proof.at_bounds or {}).items() if key in scene.lens.bounded_by}
    bounds: dict[str, Any] = {
        "asked": {key: getattr(scene.lens, key) for key in scene.lens.bounded_by},
        "at": {key: at.share for key, at in reached.items()},
        "tightest": {key: at.tightest for key, at in reached.items()},
    }
    if proof.lens.is_tailored(FRONT):
        bounds["both" if proof.lens.is_tailored(BACK) else FRONT] = True  # faces with bounds
    error = remaining(proof.light.picture, target, scene.target.screen.per_unit)
    return {
        "convergence": None if curve is None else asdict(curve),
        "remaining_error": error | {"outside": 1 - proof.light.efficiency},
        "bounds": bounds if bounds["asked"] else None,
    }
