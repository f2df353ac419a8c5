"""The proof: the written files, measured against the design.

Nothing here knows how the lens was found.  The net and knots are read by a parser that is not OCC, the surface is
sampled through OCC, the mesh is read back from the STL, and the irradiance is traced through the geometry of the STEP
file, by rays that tailoring never saw, and by ray tubes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.light import Blur, blur, margins, mount_losses, rrmsd_of_ripple
from bstcad.analysis.shape import AT_BOUND, describe, survey, survey_front
from bstcad.cad import mesh as meshes
from bstcad.optics import quadrature
from bstcad.optics.channels import Channel
from bstcad.optics.goal import Goal, worst
from bstcad.optics.lens import Lens
from bstcad.optics.measure import FULL, RESOLVED, Effort, Light, SpectralLine, measure, spectral_lines, tubes_of
from bstcad.optics.outlines import Outline
from bstcad.optics.wavefront_error import WavefrontError, wavefront_error
from bstcad.runs.processes import Overdue, Submit, end, result, return_freed, run_here
from bstcad.scene.blank import LensBlank
from bstcad.scene.mount import as_cut
from bstcad.scene.scene import Accept, Scene
from bstcad.step_text import part21
from bstcad.verify import text_checks
from bstcad.verify.verdict import Check

if TYPE_CHECKING:
    from bstcad.verify.step_checks import ExaminedFile  # which loads OCC

VERTEX_ROUNDING = 2e-7  # of the largest coordinate: a vertex in float32 on a slope, off its face
VERIFY_SEED = 1_000_003  # added to the seed: rays that tailoring never saw
TARGET_DIFFERENCE = 1e-3  # of the brightest pixel: versions of the libraries that read pictures and draw letters differ
DEFAULT_RRMSD_LIMIT = 0.25  # RRMSD that remarks, plans and tolerance studies take where accept.rrmsd asks for none
LINE_TUBES = 1031  # tubes a side at least for the picture of each line of a spectrum by itself
APERTURE_DIFFERENCE = 1e-3  # mm; of a front whose edge is not level the scene knows its largest inset along the rim
CUT_EXCUSE = 1e-3  # of the light: a mount that cuts away less is no reason for a picture that fails
MAX_ON_FLANGE = 1e-3  # of the light that gets through the lens; no wall of a flange is to stand in the way of more
WAVEFRONT = "wavefront error, RMS in waves, piston and tilt removed"
ROUGH = 0.01  # standard error of a draft's RRMSD, relative to it, at which the proof ends
FLOOR = 0.1  # of the wavefront error that is allowed: rounding that adds more leaves the verdict open
LIMIT, LIMIT_PER_MB = 120.0, 3.0  # s that OCC may take over a file, and more for each MB; it needs a hundredth of them
GRID = ", on a grid four times finer than the net"


@dataclass(frozen=True)
class Nominal:
    """The design that the files are held to."""

    scene: Scene
    lens: Lens  # float64
    goals: tuple[Goal, ...]  # with the scene's own pictures
    # pictures of the goals as design.npz has them; None: those of `goals`
    stored: tuple[np.ndarray, ...] | None = field(default=None, kw_only=True)

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """The light of the scene, of an extended source by other points than tailoring knows."""
        return self.scene.judging_channels()

    @property
    def heaviest(self) -> Channel:
        """The channel with the most light: that of the main line, by which waves are counted."""
        return max(self.channels, key=lambda channel: channel.weight)

    def effort(self, given: Effort | None = None) -> Effort:
        """The rays and tubes of a measurement of this design, a draft's with fewer; given: a limit, None: no limit."""
        given, tailoring = given or FULL, self.scene.tailoring
        accuracy = ROUGH if tailoring.quality == "draft" else FULL.accuracy
        return replace(given, seed=tailoring.seed, accuracy=max(given.accuracy, accuracy))


@dataclass(frozen=True)
class AtBound:
    """How near the tailored faces come to a bound of the scene."""

    share: float | None  # part of their area within 3 % of the bound; None: a thickness is there
    tightest: str  # place nearest to the bound, "at (1, 2) mm"; of a thickness none


@dataclass(frozen=True)
class Proof:
    """The outcome of the proof of a design's files."""

    checks: tuple[Check, ...]
    lens: Lens  # as re-read from lens.step; with a mount that of part.step, with its clear apertures
    lights: tuple[Light, ...]  # that it throws on each target
    shape: dict[str, float | None]  # of the lens within the mount's rim; volume: of lens.step
    stability: dict[str, float | int | None]
    # blur by the source's size, None: it has none, and lines of a spectrum: on the target with the largest RRMSD
    blur: Blur | None = None
    lines: tuple[SpectralLine, ...] = ()
    at_bounds: dict[str, AtBound] | None = None  # the bounds met, by key; None: no bounds
    # of the light, against the one asked for; None: none was, or no light comes to where it is stated
    wavefront: WavefrontError | None = None

    @property
    def worst(self) -> int:
        """The number of the target with the largest RRMSD, whose figures stand for the design's."""
        return worst(light.rrmsd for light in self.lights)

    @property
    def light(self) -> Light:
        """That on the target with the largest RRMSD."""
        return self.lights[self.worst]

    @property
    def passed(self) -> bool:
        """Every check?"""
        return all(check.passed for check in self.checks)


def verify(
    folder: Path,
    nominal: Nominal,
    submit: Submit = run_here,
    known: Callable[[Lens], None] = lambda lens: None,
    lit: Callable[[Light, tuple[SpectralLine, ...], int], None] = lambda light, lines, number: None,
    effort: Effort | None = None,
) -> Proof:
    """Check lens.step and lens.stl in `folder` against the design; ValueError if one of them cannot be read at all.

    With bstcad.runs.processes.submit OCC reads the STEP file in its own process, while this one reads its text and the
    mesh.  `known` is called with the lens of the STEP file as soon as that is known, and `lit` with its light on each
    target, the lines of a spectrum there, and the number of the target.
    """
    effort = nominal.effort(effort)
    effort = replace(effort, seed=effort.seed + VERIFY_SEED, seconds=effort.seconds / len(nominal.goals))
    path = (folder / "lens.step").absolute()
    lens = submit("bstcad.verify.step_checks.lens", path, nominal.lens.index, nominal.lens.passes)
    mount, part = nominal.scene.mount, nominal.scene.part.of(nominal.scene.lens)
    seen = mount and submit("bstcad.verify.step_checks.lens_of_part", folder.absolute(), nominal.lens, mount)
    step_job = "bstcad.verify.step_checks.check", path, nominal.lens, nominal.scene.accept.form, effort.points
    of_step = submit(*step_job)
    part_job = "bstcad.verify.step_checks.check_part", folder.absolute(), nominal.lens, mount, part
    of_part = mount and submit(*part_job)
    try:
        text = part21.read_lens(path)  # its sentences say more than OCC's
    except ValueError:
        if not lens.done():  # OCC may never end over a file that is damaged
            end()
        raise
    mesh = meshes.read_stl(folder / "lens.stl")
    sealed = Check.true("STL watertight, winding consistent", meshes.is_closed(mesh), id="mesh-closed")
    return_freed()  # the texts: OCC holds more of it still
    lens = _as_shaped(_result(lens, path), nominal.lens)
    whole = quadrature.of_lens(lens)  # not as it was stated
    as_made, of_aperture, why = (lens, (), "") if mount is None else _as_made(seen, lens, nominal, folder)
    known(as_made)
    found = []
    for number, goal in enumerate(nominal.goals):
        found.append(_lit(as_made, nominal, goal, effort=effort))
        lit(*found[-1], number)
    lights, lines = zip(*found, strict=True)
    number = worst(light.rrmsd for light in lights)
    wavefront, of_wavefront = _of_wavefront(as_made, nominal)
    cut = as_cut(lens, mount)
    shape = describe(cut, effort.places) | {"volume": whole.volume} | _ripples_in_light(as_made, nominal)
    stability = _stability(as_made, nominal, lights, shape)
    machined, at_bounds = of_bounds(cut, nominal.scene.lens, shape)
    meets = f"{'enters' if lens.passes.enters else 'meets'} the {lens.passes.optic}"
    goals = [(goal, each, goal.suffix) for goal, each in zip(nominal.goals, lights, strict=True)]
    degrees = math.nan if stability["tir_margin_deg"] is None else stability["tir_margin_deg"]
    margin = Check.at_least("smallest margin to total internal reflection", degrees, None, "deg", id="tir-margin")
    checks = (
        *text_checks.of_lens(text, nominal.lens),
        *text_checks.measures(text.properties, whole, lens.outline),
        *text_checks.of_part(text, part),
        *_result(of_step, path, lambda: submit(*step_job)),
        *(_result(of_part, folder / "part.step", lambda: submit(*part_job)) if of_part else ()),
        *of_aperture,
        *machined,
        *_of_ripple(shape),
        sealed,
        *_facets(mesh, lens, shape["volume"], nominal),
        *map(_picture, nominal.goals, nominal.stored or [goal.picture for goal in nominal.goals]),
        *(c for _, each, of in goals for c in _of_light(each, nominal.scene.accept, meets, of=of, why=why)),
        *of_wavefront,
        *([margin] if lens.passes.enters else []),
        Check.at_most("values that are not finite", stability["non_finite"], 0, id="finite"),
    )
    return Proof(
        checks, as_made, lights, shape, stability=stability,
        blur=blur(nominal.channels, as_made, nominal.goals[number].receiver, nominal.goals[number].picture),
        lines=lines[number], at_bounds=at_bounds or None, wavefront=wavefront,
    )  # fmt: skip


def _lit(lens: Lens, nominal: Nominal, goal: Goal, effort: Effort) -> tuple[Light, tuple[SpectralLine, ...]]:
    """The light that the lens throws on a target, and that of each line of a spectrum; ValueError if there is none."""
    how = {"effort": effort, "ghost": nominal.scene.ghost, "draw": nominal.scene.draw, "whole": goal.whole}
    light = measure(lens, nominal.channels, goal.receiver, goal.picture, **how)
    if not light.rrmsd >= 0:
        name = "lens.step" if nominal.scene.mount is None else "part.step"
        raise ValueError(f"{name}: none of its light falls on {goal.words}; write it again, or check scene.toml")
    n = max(LINE_TUBES, tubes_of(lens))
    return light, spectral_lines(lens, nominal.channels, goal.receiver, target=goal.picture, n=n)


def _as_shaped(lens: Lens, designed: Lens) -> Lens:
    """The re-read lens with what no file says: the elements around it, and which faces tailoring shaped.

    The latter if its front is a net as well.
    """
    shaped = designed.shaped if lens.front.is_net else None
    return replace(lens, before=designed.before, behind=designed.behind, shaped=shaped)


def _as_made(read: Future, bare: Lens, nominal: Nominal, folder: Path) -> tuple[Lens, Sequence[Check], str]:
    """The lens whose light is judged, that of part.step; checks of its clear apertures; and the loss by them in words.

    Where there is no such part, which other checks say, it is lens.step's with the apertures that the part was to have.
    """
    designed, flange = nominal.lens, nominal.scene.mount.flange
    try:
        lens = replace(_as_shaped(_result(read, folder / "part.step"), designed), outline=bare.outline)
        checks = [_aperture(*each) for each in zip(("front", "back"), lens.apertures, designed.apertures, strict=True)]
    except ValueError as error:
        lens = replace(bare, clear=designed.clear)
        name = "part.step: clear apertures can be measured"
        checks = [Check.true(name, False, str(error), id="clear-aperture-measured")]
    losses = mount_losses(lens, nominal.channels, None if flange is None else (flange.z, flange.z + flange.thickness))
    name = "part.step: light that the mount cuts away, of what gets through the uncut lens"
    checks.append(Check.at_most(name, losses.cut, None, id="mount-cut"))
    if flange is not None:
        where = "a wall of its opening stands in the way; make the flange thinner, or put it where it meets the lens"
        name = "part.step: light that meets the flange"
        checks.append(Check.at_most(name, losses.on_flange, MAX_ON_FLANGE, where=where, id="flange-light"))
    why = f"the mount leaves {lens.apertures[1].words} of the back and cuts away {100 * losses.cut:.3g} % of the light"
    return lens, checks, why if losses.cut > CUT_EXCUSE else ""


def _aperture(name: str, measured: Outline, designed: Outline) -> Check:
    """The largest distance between the rim of a face's clear aperture and that of the designed one."""
    off = max(float(np.abs(a.depth(*b.rim_points())).max()) for a, b in ((measured, designed), (designed, measured)))
    where = f"the part has {measured.words}, the lens was tailored for {designed.words}; generate the design again"
    name = f"part.step: clear aperture of the {name}, from the mount's"
    return Check.at_most(name, off, APERTURE_DIFFERENCE, unit="mm", where=where, id="clear-aperture")


def _stability(
    lens: Lens, nominal: Nominal, lights: Sequence[Light], shape: dict
) -> dict[str, float | int | None]:  # fmt: skip
    """How far the lens is from where its numbers would go wrong; angles in degrees, curvature in 1/mm."""
    least = margins(nominal.channels, lens, nominal.goals[0].receiver, nominal.scene.tailoring.seed + VERIFY_SEED)
    keys = (f"{face}radius_min_{kind}" for face in ("", "front_") for kind in ("concave", "convex"))
    radii = [shape[key] for key in keys if shape.get(key)]
    return {
        "tir_margin_deg": least.tir_margin_deg,
        "newton_slope_min": least.newton_slope_min,
        "curvature_max": 1 / min(radii) if radii else 0.0,
        "non_finite": least.non_finite + sum(int((~np.isfinite(light.picture)).sum()) for light in lights),
    }


def examine(path: Path, submit: Submit = run_here) -> ExaminedFile:
    """Check a STEP file by itself; ValueError if it holds no lens."""
    return _result(submit("bstcad.verify.step_checks.examine", path.absolute()), path)


def _result(read: Future, path: Path, again: Callable[[], Future] | None = None) -> Any:
    """The answer of OCC's process; `again` asks it anew, where it may have ended over another file before."""
    limit = time_limit(path)
    try:
        return result(read, limit)
    except Overdue as error:
        took = f"OCC had not ended after {limit:.0f} s and was stopped"
        raise ValueError(f"{path.name}: {took}; export the lens again, alone, or by another program") from error
    except BrokenExecutor as error:
        if again is not None:
            return _result(again(), path)
        raise ValueError(f"{path.name}: OCC broke down over it, the file is damaged; write it again") from error


def time_limit(path: Path) -> float:
    """Seconds that OCC may take over a STEP file."""
    return LIMIT + (LIMIT_PER_MB * path.stat().st_size / 1e6 if path.is_file() else 0.0)


def _of_ripple(shape: Mapping[str, float | None]) -> list[Check]:
    """State how steep the control points of each tailored face go up and down in turn.

    No limit: the RRMSD judges what the light feels of it, and the bounds of the scene what a tool feels.
    """
    measured = "RMS slope of control points that go up and down in turn"
    faces = {"": shape["ripple_slope"], " of the front": shape.get("front_ripple_slope")}
    return [
        Check.at_most(f"ripple{of}: {measured}", slope, None, "rad", id="ripple")
        for of, slope in faces.items()
        if slope is not None
    ]


def _ripples_in_light(lens: Lens, nominal: Nominal) -> dict[str, float]:
    """RRMSD that the ripple of each tailored face makes by itself, by keys of Proof.shape."""
    light = nominal.heaviest
    channel = replace(light, source=light.source.central, weight=1.0)
    faces, screen = {"": "back"} | ({"front_": "front"} if lens.shapes("front") else {}), nominal.goals[0].receiver
    return {f"{key}ripple_rrmsd": rrmsd_of_ripple(channel, lens, screen, face) for key, face in faces.items()}


def of_bounds(
    lens: Lens, asked: LensBlank, shape: Mapping[str, float | None]
) -> tuple[list[Check], dict[str, AtBound]]:
    """Checks of the bounds that a scene puts on its tailored faces, and which of the bounds these meet, by key.

    The bounds are tool_radius, max_slope and the thicknesses of [lens]; shape: of the re-read lens.  A front that is
    tailored is held to them as the back is, seen from outside: a tool has to fit into its valleys.
    """
    checks, found = [], {}
    radius, degrees, kind = asked.tool_radius, asked.max_slope, "convex" if asked.mould else "concave"
    if radius is not None or degrees is not None:
        surveys = [(survey, "")] * lens.shapes("back") + [(survey_front, " of the front")] * lens.shapes("front")
        for surveyed, of in surveys:
            bending = surveyed(lens, **{kind: radius}, slope=degrees)
            if radius is not None:
                met = getattr(bending, kind)
                name = f"smallest {kind} radius{of}{GRID}"
                checks.append(Check.at_least(name, met.largest, radius, "mm", where=met.where, id="tool-radius"))
                found.setdefault("tool_radius", []).append((met.largest, met, of))
            if degrees is not None:
                met = bending.slope
                name = f"steepest slope{of}{GRID}"
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
            checks.append(judge(name, shape[figure], limit, "mm", id=id))
            if min(shape[figure], limit) >= AT_BOUND * max(shape[figure], limit):
                at_bounds[key] = AtBound(None, "")
    return checks, at_bounds


def _picture(goal: Goal, stored: np.ndarray) -> Check:
    """The target that travels with a design against the picture of its scene."""
    off = np.abs(stored - goal.picture)
    row, column = np.unravel_index(np.argmax(off), off.shape)
    name = f"target in design.npz against the scene's, of its brightest pixel{goal.suffix}"
    where = f"pixel ({column}, {row}), counted from the upper left"
    return Check.at_most(name, float(off.max() / goal.picture.max()), TARGET_DIFFERENCE, where=where, id="target")


def _facets(mesh: meshes.Mesh, lens: Lens, volume: float, nominal: Nominal) -> list[Check]:
    """The facets of the STL file against the faces of the re-read solid, whose volume is in mm³.

    Facets of the area A (mm²) within the tolerance (mm) enclose a volume that is off by no more than A times it.
    """
    size = float(np.abs(mesh.vertices).max(initial=0.0))
    tolerance, finest = nominal.scene.mesh_tolerance, len(mesh.faces) >= 0.9 * meshes.MOST
    limit = None if finest and nominal.scene.output.mesh_tolerance is None else tolerance
    enclosed, area = meshes.volume_and_area(mesh)
    off, error = abs(enclosed / volume - 1), meshes.chordal_error(mesh, lens)
    off_faces, rounding = meshes.vertex_error(mesh, lens), VERTEX_ROUNDING * size
    least = error * len(mesh.faces) / meshes.ASKED  # it falls as their number grows
    most = (
        f"no mesh has over {meshes.ASKED} triangles, which come within some {least:.1g} mm; allow more than that by "
        "output.mesh_tolerance" if finest and error > tolerance else ""
    )  # fmt: skip
    return [
        Check.at_most("STL: volume against the solid's, relative", off, area * tolerance / volume, id="mesh-volume"),
        Check.at_most("STL: vertices off the solid's faces", off_faces, rounding, "mm", id="mesh-vertices"),
        Check.at_most("STL: chordal error", error, limit, unit="mm", where=most, id="mesh-chord"),
    ]


def _of_light(
    light: Light, accept: Accept, meets: str = "enters the lens", of: str = "", why: str = ""
) -> list[Check]:  # fmt: skip
    """The irradiance through the re-read geometry, by rays, and by ray tubes that share only the trace with them.

    of: which of several targets it falls on, as Goal.suffix has it; why: reason for a limit of accept that is not met.
    """
    closure, tubes = abs(sum(light.flux.values()) - 1), light.witness
    off, error = RESOLVED * light.standard_error, f"standard error of that RRMSD, times five{of}"
    on_target, least = f"light on the target, of what {meets}{of}", accept.light_on_target
    rrmsd = f"RRMSD, box pixels, through the re-read STEP{of}"
    # noise below the RRMSD leaves its figure resolved; noise below its distance from the limit leaves its verdict sure
    noise = None if accept.rrmsd is None else max(light.rrmsd, accept.rrmsd - light.rrmsd)
    checks = [
        Check.at_most(rrmsd, light.rrmsd, accept.rrmsd, where=why, id="rrmsd"),
        Check.at_most(error, off, noise, id="noise"),
        Check.at_least(on_target, light.used, least, where=why, id="light-on-target"),
        Check.at_least(f"efficiency{of}", light.efficiency, accept.efficiency, where=why, id="efficiency"),
        Check.at_most(f"flux ledger: distance of its sum from 1{of}", closure, 1e-12, id="ledger"),
    ]
    if tubes is not None:
        name = f"picture by ray tubes, off the one by rays{of}"
        checks.insert(2, Check.at_most(name, tubes.difference, tubes.limit, id="tubes"))
    if light.leak:
        name = f"light where the target is dark, of all on the target{of}"
        checks.append(Check.at_most(name, light.leak.share, accept.leak, id="leak"))
    return checks


def _of_wavefront(lens: Lens, nominal: Nominal) -> tuple[WavefrontError | None, list[Check]]:
    """The wavefront through the re-read lens against the wave asked for, and its checks; nothing if none is."""
    wave, asked = nominal.scene.wavefront, nominal.scene.accept.wavefront
    if wave is None:
        return None, []
    light = nominal.heaviest
    try:
        error = wavefront_error(light.source.central, light.through(lens), wave)
    except ValueError as none:  # a lens that misses the wave is written all the same, and fails
        return None, [Check.at_most(WAVEFRONT, math.nan, asked, "waves", where=str(none), id="wavefront")]
    most = None if asked is None else FLOOR * asked
    return error, [
        Check.at_most(WAVEFRONT, error.without_tilt.rms, asked, "waves", id="wavefront"),
        Check.at_most("wavefront error floor", error.floor, most, "waves", id="wavefront-floor"),
    ]
