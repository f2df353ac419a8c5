"""Proof of a design: the written files are measured and compared with the design.

The proof is independent of the optimisation.  Net and knots are read by a parser that is not OCC, the surface is
sampled with OCC, the mesh is read back from the STL, and the irradiance is traced through the geometry of the STEP
file, with rays that tailoring has not used, and with flux tubes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch

from bstcad.analysis.light import Blur, blur, margins, mount_losses, rrmsd_of_ripple
from bstcad.analysis.shape import AT_BOUND, Extreme, describe, survey
from bstcad.cad import mesh as meshes
from bstcad.optics.lens import face_integrals
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import Goal, worst
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.trace.measure import (
    RESOLVED,
    Effort,
    Light,
    SpectralLine,
    spectral_lines,
    squared_distance,
    tubes_of,
)
from bstcad.optics.trace.wavefront_error import WavefrontError, wavefront_error
from bstcad.runs.processes import Overdue, Submit, end, result, return_freed, run_here
from bstcad.scene.accept import Accept
from bstcad.scene.blank import LensBlank
from bstcad.scene.errors import SceneError
from bstcad.scene.mount import Part, as_cut
from bstcad.step_text import part21
from bstcad.step_text.part21 import StepText
from bstcad.verify import jobs, text_checks
from bstcad.verify.light_limits import LightValue, light_values
from bstcad.verify.nominal import Nominal
from bstcad.verify.verdict import Check

if TYPE_CHECKING:
    from bstcad.verify.step_checks import ExaminedFile  # this import loads OCC

VERTEX_ROUNDING = 2e-7  # largest distance of a float32 vertex from a sloped face, relative to the largest coordinate
VERIFY_SEED = 1_000_003  # offset of the seed, for rays that tailoring has not used
# Tolerance of the irradiance in design.npz, of which smoothing hides noise: a multiple of its estimated error, and an
# RMS difference relative to its RMS, for the rounding of another processor.
STORED_NOISE, STORED_TOLERANCE = 3.0, 2e-3
TARGET_TOLERANCE = 1e-3  # largest change of the target since design.npz / brightest pixel: picture libraries change
LINE_TUBES = 1031  # smallest number of tubes per side for the picture of one line of a spectrum
CLEAR_APERTURE_TOLERANCE = 1e-3  # largest distance (mm) between the rims of measured and designed apertures
MIN_MOUNT_LOSS = 1e-3  # smallest fraction of light cut away by a mount that a failed check states as its reason
MAX_FLANGE_LIGHT = 1e-3  # largest fraction of the light through the clear apertures that may meet the flange
WAVEFRONT = "wavefront error, RMS in waves, piston and tilt removed"
MAX_FLOOR = 0.1  # largest rounding error of the wavefront error / accept.wavefront that leaves the verdict certain
TIME_LIMIT, TIME_LIMIT_PER_MB = 120.0, 3.0  # timeout of OCC (s) and its increase per MB, 100 times the usual time

R = TypeVar("R")
Lines = tuple[SpectralLine, ...]  # pictures of the lines of a spectrum on one target
OnLight = Callable[[Light, Lines, int], None]  # function of the light on a target, its Lines, and its index
FINE_GRID = ", on a grid four times finer than the net"  # suffix of the names of checks on such a grid


@dataclass(frozen=True)
class AtBound:
    """A bound of the scene that limits the tailored faces."""

    share: float | None  # fraction of the faces' area within 3 % of the bound; None for a bound of the thickness
    tightest: str  # position where a face is nearest to the bound, "at (1, 2) mm"; "" for a thickness


@dataclass(frozen=True)
class Proof:
    """Result of the proof of a design's files."""

    checks: tuple[Check, ...]
    lens: Lens  # lens re-read from lens.step or, with a mount, from part.step, including clear apertures
    lights: tuple[Light, ...]  # light of the lens on each target
    shape: dict[str, float | None]  # figures by key: lens within the mount's rim, volume of lens.step (mm³), ripple
    stability: dict[str, float | int | None]  # figures of stability by key (record.Contents)
    blur: Blur | None = None  # blur due to the source's size on the worst target; None: the source has no size
    lines: Lines = ()  # pictures of the lines of a spectrum on the worst target
    at_bounds: dict[str, AtBound] | None = None  # bounds that the lens reaches, by key; None: no bound is reached
    wavefront: WavefrontError | None = None  # error of the wavefront; None: not requested, or no light reaches it
    values: tuple[LightValue, ...] = ()  # values of the light that the scene limits, such as test points

    @property
    def worst(self) -> int:
        """Index of the worst target, with the largest RRMSD, whose figures represent the design."""
        return worst(light.rrmsd for light in self.lights)

    @property
    def light(self) -> Light:
        """Light on the target with the largest RRMSD."""
        return self.lights[self.worst]

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return all(check.passed for check in self.checks)


def verify(
    folder: Path,
    nominal: Nominal,
    submit: Submit = run_here,
    on_lens: Callable[[Lens], None] = lambda lens: None,
    on_light: OnLight = lambda light, lines, number: None,
    effort: Effort | None = None,
) -> Proof:
    """Check lens.step, lens.stl and, if the scene has a mount, part.step in `folder` against the design.

    Raises ValueError if lens.step or lens.stl cannot be read or a target receives no light.  submit: with
    bstcad.runs.processes.submit, OCC reads the STEP file in a second process, while this one reads text and mesh.
    on_lens: called with the re-read lens.  on_light: called for each target (OnLight).  effort: see `Nominal.effort`.
    """
    effort = nominal.effort(effort)
    effort = replace(effort, seed=effort.seed + VERIFY_SEED, seconds=effort.seconds / len(nominal.goals))
    path, mount, part = folder.absolute() / "lens.step", nominal.scene.mount, nominal.scene.part.of(nominal.scene.lens)
    read = submit(jobs.read_lens, path, nominal.lens.index, nominal.lens.passes)
    read_part = None if mount is None else submit(jobs.read_lens_of_part, path.parent, nominal.lens, mount)
    solid_checks = _check_solids(path, nominal, part, effort.points, submit=submit)
    text = _read_text(path, read)
    text_checks.check_size(text, nominal.lens, path.name)
    mesh = meshes.read_stl(folder / "lens.stl")
    closed = Check.true("STL: watertight, winding consistent", meshes.is_closed(mesh), id="mesh-closed")
    return_freed()  # memory of the texts
    lens = _with_design_facts(_result(read, path), nominal.lens)
    whole = face_integrals.of_lens(lens)  # computed, not as stated in the file
    made_lens, of_aperture, why = (lens, [], "") if read_part is None else _mounted_lens(read_part, lens, nominal, path)
    on_lens(made_lens)
    lights, lines = zip(*_measure_targets(made_lens, nominal, effort, on_light), strict=True)
    values = light_values(nominal.scene.accept, nominal.goals, lights, lens=made_lens, far=nominal.far_field)
    stored: Sequence[tuple[np.ndarray | None, float]] = nominal.lit or [(None, math.nan)] * len(lights)
    of_stored = [
        _stored_light_check(goal, light, *of) for goal, light, of in zip(nominal.goals, lights, stored, strict=True)
    ]
    lights = tuple(replace(light, sets=()) for light in lights)  # frees their memory
    wavefront, of_wavefront = _wavefront_checks(made_lens, nominal)
    cut = as_cut(lens, mount)
    shape = describe(cut, effort.places) | {"volume": whole.volume} | _ripple_rrmsd(made_lens, nominal)
    stability, of_stability = _stability(made_lens, nominal, lights, shape, rays=effort.places // 2)
    of_shape, at_bounds = bound_checks(cut, nominal.scene.lens, shape)
    optic, accept = lens.passes.optic, nominal.scene.accept
    lit_goals = list(zip(nominal.goals, lights, strict=True))
    checks = (
        *text_checks.lens_checks(text, nominal.lens),
        *text_checks.measure_checks(text.properties, whole, lens.plan),
        *text_checks.part_checks(text, part),
        *solid_checks(),
        *of_aperture,
        *of_shape,
        *_ripple_checks(cut, shape),
        closed,
        *_mesh_checks(mesh, lens, whole.volume, nominal),
        *map(_target_check, nominal.goals, nominal.stored or [goal.picture for goal in nominal.goals]),
        *of_stored,
        *(c for goal, light in lit_goals for c in _light_checks(light, accept, optic, of=goal.suffix, why=why)),
        *(check for value in values for check in value.checks()),
        *of_wavefront,
        *of_stability,
    )
    proof = Proof(checks, made_lens, lights, shape, stability=stability, wavefront=wavefront, values=values)
    goal = nominal.goals[proof.worst]
    blurred = blur(nominal.channels, made_lens, goal.screen, goal.picture)
    return replace(proof, blur=blurred, lines=lines[proof.worst], at_bounds=at_bounds or None)


def _check_solids(path: Path, nominal: Nominal, part: Part, points: int, submit: Submit) -> Callable[[], list[Check]]:
    """Submit the checks of the solids of lens.step and part.step; return a function that waits for them."""
    lens, mount, form = nominal.lens, nominal.scene.mount, nominal.scene.accept.form
    starts: dict[Path, Callable[[], Future[tuple[Check, ...]]]] = {
        path: lambda: submit(jobs.check_lens, path, lens, form=form, points=points)
    }
    if mount is not None:
        starts[path.with_name("part.step")] = lambda: submit(jobs.check_part, path.parent, lens, mount=mount, part=part)
    started = [(start(), file, start) for file, start in starts.items()]
    return lambda: [check for job in started for check in _result(*job)]


def _read_text(path: Path, read: Future[Lens]) -> StepText:
    """Read the text of lens.step, with more precise errors than OCC's; after an error, stop OCC's job `read`."""
    try:
        return part21.read_lens(path)
    except ValueError:
        if not read.done():  # a damaged file may hang OCC
            end()
        raise


def _measure_targets(lens: Lens, nominal: Nominal, effort: Effort, on_light: OnLight) -> list[tuple[Light, Lines]]:
    """Measure the light on each target, and the lines of a spectrum there; ValueError if a target gets no light."""
    found = []
    lights = nominal.lights(lens, nominal.goals, effort)
    for number, (goal, light) in enumerate(zip(nominal.goals, lights, strict=True)):
        if not light.rrmsd >= 0:
            if nominal.scene.sampler is not None and nominal.scene.sampler.largest_side is not None:
                few = f"so few of the rays fall on {goal.words} that an eighth of them may give no picture"
                raise SceneError(f"source.rays: {few}; give a file with more rays, or widen lens or target")
            name = "lens.step" if nominal.scene.mount is None else "part.step"
            raise ValueError(f"{name}: none of its light falls on {goal.words}; write it again, or check scene.toml")
        found.append((light, spectral_lines(lens, nominal.channels, goal, n=max(LINE_TUBES, tubes_of(lens)))))
        light, lines = found[-1]
        on_light(replace(light, sets=()), lines, number)  # pictures are drawn in another process
    return found


def _with_design_facts(lens: Lens, designed: Lens) -> Lens:
    """Return the re-read lens with data that no file states: elements around it, and which of two nets are tailored."""
    shaped = designed.tailored if lens.front.is_net else None
    return replace(lens, before=designed.before, behind=designed.behind, tailored=shaped)


def _mounted_lens(read: Future[Lens], bare: Lens, nominal: Nominal, path: Path) -> tuple[Lens, list[Check], str]:
    """Return the lens of part.step, checks of its clear apertures and lost light, and the loss in words, "" if small.

    bare: lens of lens.step, returned with the designed apertures if the part cannot be read, which a check reports.
    """
    designed, mount = nominal.lens, nominal.scene.mount
    flange = None if mount is None else mount.flange
    try:
        made = _result(read, path.with_name("part.step"))
        outline = bare.back.chart.outline_in(designed.back.chart, bare.outline)
        lens = replace(_with_design_facts(made, designed), outline=outline)
        names = (face.name for face in lens.faces)
        checks = [_aperture_check(*each) for each in zip(names, lens.apertures, designed.apertures, strict=True)]
    except ValueError as error:
        lens = bare.with_clear(designed.clear)
        name = "part.step: clear apertures can be measured"
        checks = [Check.true(name, False, str(error), id="clear-aperture-measured")]
    losses = mount_losses(lens, nominal.channels, None if flange is None else (flange.z, flange.z + flange.thickness))
    name = "part.step: light that the mount cuts away, as a fraction of the light through the uncut lens"
    checks.append(Check.at_most(name, losses.cut, None, id="mount-cut"))
    if flange is not None:
        where = "a wall of its opening stands in the way; make the flange thinner, or put it where it meets the lens"
        name = "part.step: light that meets the flange, as a fraction of the light through the clear apertures"
        checks.append(Check.at_most(name, losses.on_flange, MAX_FLANGE_LIGHT, where=where, id="flange-light"))
    why = f"the mount leaves {lens.apertures[1].words} of the back and cuts away {100 * losses.cut:.3g} % of the light"
    return lens, checks, why if losses.cut > MIN_MOUNT_LOSS else ""


def _aperture_check(name: str, measured: Outline, designed: Outline) -> Check:
    """Check the largest distance (mm) between the rims of a face's clear aperture and of the designed aperture."""
    off = max(float(np.abs(a.depth(*b.rim_points())).max()) for a, b in ((measured, designed), (designed, measured)))
    where = f"the part has {measured.words}, but the lens was tailored for {designed.words}; generate the design again"
    name = f"part.step: clear aperture of the {name}, deviation from the mount's"
    return Check.at_most(name, off, CLEAR_APERTURE_TOLERANCE, unit="mm", where=where, id="clear-aperture")


def _stability(
    lens: Lens, nominal: Nominal, lights: Sequence[Light], shape: Mapping[str, float | None], rays: int
) -> tuple[dict[str, float | int | None], list[Check]]:
    """Return figures of stability (record.Contents), and checks of total internal reflection and of finite values.

    rays: number of rays per side for the margins.
    """
    seed = nominal.scene.tailoring.seed + VERIFY_SEED
    margin = margins(nominal.channels, lens, nominal.goals[0].screen, seed, n=rays)
    keys = (f"{face.prefix}radius_min_{kind}" for face in lens.faces for kind in ("concave", "convex"))
    radii = [radius for key in keys if (radius := shape.get(key))]
    non_finite = margin.non_finite + sum(int((~np.isfinite(light.picture)).sum()) for light in lights)
    stability = {
        "tir_margin_deg": margin.tir_margin_deg,
        "newton_slope_min": margin.newton_slope_min,
        "curvature_max": 1 / min(radii) if radii else 0.0,
        "non_finite": non_finite,
    }
    name, degrees = "smallest margin to total internal reflection", margin.tir_margin_deg
    value = math.nan if degrees is None else degrees
    reflection = [Check.at_least(name, value, None, "deg", id="tir-margin")] if lens.passes.enters else []
    return stability, [*reflection, Check.at_most("number of values that are not finite", non_finite, 0, id="finite")]


def examine(path: Path, submit: Submit = run_here) -> ExaminedFile:
    """Check a STEP file without a design; ValueError if it has no lens."""
    return _result(submit(jobs.examine, path.absolute()), path)


def _result(read: Future[R], path: Path, again: Callable[[], Future[R]] | None = None) -> R:
    """Return the result of a job of OCC's process; again: restarts the job, if another file may have crashed OCC."""
    limit = time_limit(path)
    try:
        return result(read, limit)
    except Overdue as error:
        took = f"OpenCASCADE did not read this file within {limit:.0f} s and was stopped"
        raise ValueError(f"{path.name}: {took}; export only the lens, or export it from another program") from error
    except BrokenExecutor as error:
        if again is not None:
            return _result(again(), path)
        raise ValueError(
            f"{path.name}: OpenCASCADE crashed while reading this file, which is damaged; write it again"
        ) from error


def time_limit(path: Path) -> float:
    """Return the timeout (s) of OCC for a STEP file."""
    return TIME_LIMIT + (TIME_LIMIT_PER_MB * path.stat().st_size / 1e6 if path.is_file() else 0.0)


def _ripple_checks(lens: Lens, shape: Mapping[str, float | None]) -> list[Check]:
    """State the RMS slope of the ripple of each tailored face: a checkerboard in its net.

    There is no limit: the RRMSD contains the effect on the light, and bounds of the scene limit the effect on a tool.
    """
    measured = "RMS slope of the checkerboard in the net"
    named = {f"ripple{face.of}: {measured}": shape.get(f"{face.prefix}ripple_slope") for face in lens.described_faces}
    return [Check.at_most(name, slope, None, "rad", id="ripple") for name, slope in named.items() if slope is not None]


def _ripple_rrmsd(lens: Lens, nominal: Nominal) -> dict[str, float]:
    """Return the RRMSD due to the ripple of the back alone, and of a tailored front alone, by keys of Proof.shape."""
    light = nominal.heaviest
    channel = replace(light, source=light.source.central, weight=1.0)
    screen, faces = nominal.goals[0].screen, lens.described_faces
    return {f"{face.prefix}ripple_rrmsd": rrmsd_of_ripple(channel, lens, screen, face.name) for face in faces}


def bound_checks(
    lens: Lens, asked: LensBlank, shape: Mapping[str, float | None]
) -> tuple[list[Check], dict[str, AtBound]]:
    """Check the bounds of a scene on its tailored faces, and return the bounds that the lens reaches, by key.

    asked: [lens] of the scene, with tool_radius, max_slope and thicknesses; shape: dimensions of the re-read lens.
    tool_radius and max_slope apply to each tailored face: tool_radius to its valleys, or for a mould to its ridges.
    """
    checks: list[Check] = []
    found: dict[str, list[tuple[float, Extreme, str]]] = {}
    radius, degrees, kind = asked.tool_radius, asked.max_slope, "convex" if asked.mould else "concave"
    if radius is not None or degrees is not None:
        for face in lens.tailored_faces:
            bending, of = survey(lens, face.name, **{kind: radius}, slope=degrees), face.of
            if radius is not None:
                met = getattr(bending, kind)
                name = f"smallest {kind} radius{of}{FINE_GRID}"
                checks.append(Check.at_least(name, met.largest, radius, "mm", where=met.where, id="tool-radius"))
                found.setdefault("tool_radius", []).append((met.largest, met, of))
            if degrees is not None:
                met = bending.slope
                name = f"steepest slope{of}{FINE_GRID}"
                checks.append(Check.at_most(name, met.largest, degrees, "deg", where=met.where, id="slope"))
                found.setdefault("max_slope", []).append((-met.largest, met, of))
    at_bounds = {}
    for key, faces in found.items():
        _, met, of = min(faces, key=lambda face: face[0])
        share = math.fsum(face.at_bound for _, face, _ in faces) / len(faces)
        at_bounds[key] = AtBound(share, f"{met.where}{of}")
    for id, name, judge, figure, key in (
        ("thickness", "smallest thickness", Check.at_least, "thickness_min", "min_thickness"),
        ("largest-thickness", "largest thickness", Check.at_most, "thickness_max", "max_thickness"),
        ("edge-thickness", "smallest thickness of the edge", Check.at_least, "edge_thickness_min", "edge_thickness"),
    ):
        if (limit := getattr(asked, key)) is not None:
            value = shape[figure]
            assert value is not None  # any lens has thicknesses
            checks.append(judge(name, value, limit, "mm", id=id))
            if min(value, limit) >= AT_BOUND * max(value, limit):
                at_bounds[key] = AtBound(None, "")
    return checks, at_bounds


def _target_check(goal: Goal, stored: np.ndarray) -> Check:
    off = np.abs(stored - goal.picture)
    row, column = np.unravel_index(np.argmax(off), off.shape)
    name = f"target in design.npz: deviation from the target of the scene, relative to its brightest pixel{goal.suffix}"
    where = f"pixel ({column}, {row}), counted from the upper left"
    return Check.at_most(name, float(off.max() / goal.picture.max()), TARGET_TOLERANCE, where=where, id="target")


def _stored_light_check(goal: Goal, light: Light, stored: np.ndarray | None, error: float) -> Check:
    """Check the irradiance in design.npz against the rays of this verification, without their noise.

    stored: None if design.npz is not written yet, with the picture of `light`.  error: RRMSD between the stored
    irradiance and the noiseless one; NaN: not stated, by an earlier version; the error with as many rays then counts.
    """
    picture = torch.from_numpy(light.picture if stored is None else stored)
    squared, uncertainty = squared_distance([each.to(picture.dtype) for each in light.sets], picture)
    error = light.picture_error if math.isnan(error) else error
    limit = math.sqrt((STORED_NOISE * error) ** 2 + RESOLVED * uncertainty + STORED_TOLERANCE**2)
    name = f"irradiance in design.npz: RMS difference from the light traced through the STEP file{goal.suffix}"
    where = "the file was changed, or is that of another lens; generate the design again"
    return Check.at_most(name, math.sqrt(max(squared, 0.0)), limit, where=where, id="irradiance")


def _mesh_checks(mesh: meshes.Mesh, lens: Lens, volume: float, nominal: Nominal) -> list[Check]:
    """Check the facets of the STL file against the faces of the re-read solid, whose volume is in mm³.

    The error of the volume inside facets of total area A (mm²) is at most A times the facets' tolerance (mm).
    """
    size = float(np.abs(mesh.vertices).max(initial=0.0))
    tolerance, finest = nominal.scene.mesh_tolerance, len(mesh.faces) >= 0.9 * meshes.DEFAULT_MAX_TRIANGLES
    limit = None if finest and nominal.scene.output.mesh_tolerance is None else tolerance
    enclosed, area = meshes.volume_and_area(mesh)
    off, error = abs(enclosed / volume - 1), meshes.chordal_error(mesh, lens)
    off_faces, rounding = meshes.vertex_error(mesh, lens), VERTEX_ROUNDING * size
    smallest = error * len(mesh.faces) / meshes.MAX_TRIANGLES  # the error is proportional to 1 / triangles
    where = (
        f"a mesh has at most {meshes.MAX_TRIANGLES} triangles, and then an error of about {smallest:.1g} mm; "
        "set output.mesh_tolerance to a larger value"
    )
    where = where if finest and error > tolerance else ""
    volume_error, distance = "STL: relative error of the volume", "STL: distance of vertices from the solid's faces"
    return [
        Check.at_most(volume_error, off, area * tolerance / volume, id="mesh-volume"),
        Check.at_most(distance, off_faces, rounding, "mm", id="mesh-vertices"),
        Check.at_most("STL: distance of the facets from the lens", error, limit, "mm", where=where, id="mesh-chord"),
    ]


def unit_checks(folder: Path) -> list[Check]:
    """Check the unit of lens.3mf, which other programs believe; empty if the file was deleted."""
    if not (path := folder / "lens.3mf").exists():
        return []
    try:
        unit = meshes.unit_of_3mf(path)
        where = f"the file states {unit}; generate the design again"
    except ValueError as error:
        unit, where = "", str(error)
    return [Check.true("3MF: lengths in millimetres", unit == "millimeter", where, id="mesh-unit")]


def _light_checks(light: Light, accept: Accept, optic: str = "lens", of: str = "", why: str = "") -> list[Check]:
    """Check the irradiance of the re-read lens, computed with rays and with flux tubes, which share only the trace.

    of: suffix of the checks' names, for one of several targets (Goal.suffix).  why: reason stated if a limit is missed.
    """
    closure, tubes = abs(sum(light.flux.values()) - 1), light.witness
    off, error = RESOLVED * light.standard_error, f"standard error of the RRMSD, times five{of}"
    on_target = f"light on the target, as a fraction of the light that meets the {optic}{of}"
    aimed = f"efficiency: light on the target, as a fraction of all light behind the last face{of}"
    rrmsd = f"RRMSD of the light, traced through the STEP file{of}"
    # noise up to the RRMSD leaves the RRMSD resolved; noise up to the distance of the RRMSD from its limit leaves the
    # verdict certain
    noise = None if accept.rrmsd is None else max(light.rrmsd, accept.rrmsd - light.rrmsd)
    checks = [
        Check.at_most(rrmsd, light.rrmsd, accept.rrmsd, where=why, id="rrmsd"),
        Check.at_most(error, off, noise, id="noise"),
        Check.at_least(on_target, light.used, accept.light_on_target, where=why, id="light-on-target"),
        Check.at_least(aimed, light.efficiency, accept.efficiency, where=why, id="efficiency"),
        Check.at_most(f"flux ledger: difference of its sum from 1{of}", closure, 1e-12, id="ledger"),
        *_half_cell_checks(light, accept, of=of, why=why),
    ]
    if tubes is not None:
        name = f"picture by flux tubes: difference from the picture by rays{of}"
        checks.insert(2, Check.at_most(name, tubes.difference, tubes.limit, id="tubes"))
    if light.leak:
        name = f"light on dark pixels of the target, as a fraction of the light on the target{of}"
        checks.append(Check.at_most(name, light.leak.share, accept.leak, id="leak"))
    return checks


def _half_cell_checks(light: Light, accept: Accept, of: str, why: str) -> list[Check]:
    """Check the RRMSD on cells of half a pixel; empty if it was neither measured nor limited."""
    if light.half is None and accept.rrmsd_half is None:
        return []
    if light.half is None:
        why = "cells smaller than the pixels were not measured; set fewer target.pixels, or remove accept.rrmsd_half"
    value = math.nan if light.half is None else light.half.rrmsd
    name = f"RRMSD of the light on cells of half a pixel{of}"
    return [Check.at_most(name, value, accept.rrmsd_half, where=why, id="rrmsd-half")]


def _wavefront_checks(lens: Lens, nominal: Nominal) -> tuple[WavefrontError | None, list[Check]]:
    """Return the wavefront error of the re-read lens, and its checks; None: not requested, or no light reaches it."""
    wave, accepted = nominal.scene.wavefront, nominal.scene.accept.wavefront
    if wave is None:
        return None, []
    light = nominal.heaviest
    try:
        error = wavefront_error(light.source.central, light.through(lens), wave)
    except ValueError as reason:  # a lens that misses the wave is written, and fails
        return None, [Check.at_most(WAVEFRONT, math.nan, accepted, "waves", where=str(reason), id="wavefront")]
    limit = None if accepted is None else MAX_FLOOR * accepted
    return error, [
        Check.at_most(WAVEFRONT, error.without_tilt.rms, accepted, "waves", id="wavefront"),
        Check.at_most("wavefront error floor", error.floor, limit, "waves", id="wavefront-floor"),
    ]
