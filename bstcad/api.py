"""Designs for scripts and notebooks: made from a scene or opened from a folder, then written and verified.

design = bstcad.design("templates/thu.toml")
report = design.write("outputs/thu")
design = bstcad.open("outputs/thu")
"""

from __future__ import annotations

import base64
import html
import math
import os
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from PIL import Image

from bstcad import commands
from bstcad.commands import OwnCheck, OwnSection, ProofOptions
from bstcad.designs import folder as folders
from bstcad.designs import pipeline
from bstcad.designs.course import BY_HAND, DesignCourse
from bstcad.designs.designed_lens import DesignedLens, same_front
from bstcad.figures.drawing import png
from bstcad.figures.light_figures import View, irradiance_triptych
from bstcad.manufacture.measured.compensation import CompensationSettings as CompensationSettings
from bstcad.manufacture.shop.as_built import AsBuilt
from bstcad.manufacture.shop.rounds import Compensated
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.sides import as_pair, simplified, size_text
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.optics.trace.measure import Effort, tubes_picture
from bstcad.planning.net_choice import with_net
from bstcad.report import record
from bstcad.report.record import Report, rrmsds
from bstcad.report.units import number, quantity
from bstcad.runs import files, processes
from bstcad.runs import progress as progresses
from bstcad.scene.errors import SceneError
from bstcad.scene.fronts import MIN_ROUND_POINTS
from bstcad.scene.scene import Scene, load
from bstcad.tailoring.driver import Hooks
from bstcad.tailoring.merit import PictureError
from bstcad.transport.mapping import TransportMap

if TYPE_CHECKING:
    from bstcad.manufacture.tolerance.as_made import AsMade
    from bstcad.manufacture.tolerance.lit_by import LitBy

RELATIVE_TOLERANCE = 1e-9  # largest ignored difference of indices (relative) and of the ends of nets (in net widths)
PREVIEW_TUBES = 521  # flux tubes per side of the light, for the picture of a design that is not verified yet
AnyPath = str | os.PathLike[str]  # path of a file or of a folder


def design(
    scene: Scene | AnyPath, *, progress: bool = True, device: str = "auto", merit: PictureError | None = None
) -> Design:
    """Design the lens for a scene or a scene file.  SceneError states the fault of an invalid scene.

    progress: show a progress bar in a terminal or notebook.  device: "auto", "cpu" or "cuda" (pipeline.device_for).
    merit: function of (picture, target), tensors (rows, columns) of flux, that stages 2 and 3 minimise instead of
    RRMSD².  It must be differentiable and of the magnitude of RRMSD².  The verification still reports the RRMSD.

    On Linux the process keeps up to 2 GB of freed memory for its next design (bstcad.runs.processes.keep_freed).
    """
    began = time.perf_counter()
    scene = scene.changed({}) if isinstance(scene, Scene) else load(os.fspath(scene))
    for warning in scene.warnings():
        warnings.warn(warning, stacklevel=2)
    processes.keep_freed()
    with progresses.for_script(progress) as shown:
        scene, _ = with_net(scene, lambda line: shown("control points", 1, 1, line))
        hooks, options = Hooks(progress=shown), pipeline.DesignOptions(merit, compare_later=True)
        return Design(pipeline.design(scene, device=device, hooks=hooks, options=options, began=began))


def open(folder: AnyPath) -> Design:
    """Read the exact design from a folder of `Design.write` or `bstcad generate`.  SceneError if it cannot be read."""
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder; give a design's folder, such as outputs/thu")
    made = commands.read(folder)
    try:
        contents = record.read(folder / "report.json")
    except ValueError:  # report.json is missing or damaged; verify writes it again
        return Design(made, None, folder)
    return Design(made, Report(contents, folders.read_irradiances(folder, made.scene)), folder)


class Design:
    """A lens, its scene, and the report of its verification.

    `verify` reads the files of the folder to which the design was last written, or from which it was opened.
    """

    def __init__(self, made: DesignedLens, report: Report | None = None, folder: Path | None = None) -> None:
        self._made = made
        self.report = report  # report of the last verification; None: not verified yet
        self.folder = folder  # folder of the design's files; None: not written yet

    @property
    def scene(self) -> Scene:
        """Scene of the design."""
        return self._made.scene

    @property
    def lens(self) -> Lens:
        """Lens with front, back, outline and index; lens.back.control_points() is (m, n, 3) in mm."""
        return self._made.lens

    @property
    def target(self) -> np.ndarray:
        """Flux per pixel required on the first target, (rows, columns), sum 1; row 0 is y max, column 0 is x min."""
        return self._made.goals[0].picture

    @property
    def transport(self) -> TransportMap | None:
        """Transport map of stage 1: points of the target, and where their light passes the lens (mm), see TransportMap.

        None for your own lens (with_lens, with_heights) and for a folder that an earlier version wrote.  With several
        spectral lines, the map of the line with most light; for an extended source, the map for its centre.
        """
        return self._made.transport

    def with_lens(self, lens: Lens) -> Design:
        """Return a design with another lens for the same source and target, to verify and to write.

        lens: must have the outline and the index (at the main wavelength) of the scene, be a mirror if the scene has a
        mirror, and have a net as wide as the net of the scene; it is converted to float64 on the CPU.  A different
        front or number of control points is stored in the new design's scene, whose [[effects]] determine the losses.
        The new design has no stages, history or transport map, and its report states "changed by hand".  SceneError
        names the property of a lens that does not fit.
        """
        self.scene.lens.require_heights("with_lens")
        scene, lens = _adapted(lens, self._made.scene, self.lens.front)
        made = replace(self._made, scene=scene, lens=scene.as_mounted(lens), course=DesignCourse(stopped=BY_HAND))
        return Design(replace(made, transport=None, precision_comparison=None))

    def with_heights(self, heights: Any) -> Design:
        """Return a design with other control heights of the back.

        heights: (m, n) in mm, a numpy array or a tensor, with x along the first axis and y along the second; relative
        to z = lens.back.z, as lens.back.heights.
        """
        try:
            found = np.asarray(heights.detach().cpu() if isinstance(heights, torch.Tensor) else heights)
            if found.dtype.kind not in "fiu" or found.ndim != 2:
                raise ValueError
        except (TypeError, ValueError):  # numpy raises ValueError for rows of unequal length
            given = getattr(heights, "shape", type(heights).__name__)
            given = f"numbers of shape {tuple(given)}" if isinstance(given, tuple) else given
            raise SceneError(
                f"with_heights: {given} cannot be the heights; give (m, n) numbers in mm, such as lens.back.heights"
            ) from None
        m, n = (max(count, MIN_ROUND_POINTS) for count in found.shape)
        net = self.scene.flat_lens((m, n)).back_net
        back = replace(net, z=self.lens.back.z, heights=torch.from_numpy(found.astype(np.float64)))
        return self.with_lens(self.lens.with_back(back))

    def solid(
        self, trim: Any = None, holes: Sequence[Any] = (), body: Any = None, *, draft: float = 0.0, bevel: float = 0.0
    ) -> Any:
        """Return the exact solid, a cadquery.Solid for Workplane chains and assemblies.

        trim: closed plane cadquery.Wire inside the lens, to which the lens is cut; the z of the wire is ignored.
        holes: such wires, or (x, y, diameter) in mm.  Trim and holes only change the boundaries of the designed faces,
        which takes a second; a boolean operation on a large net would take half a minute.  body: cadquery solid,
        such as a flange, that is joined to the lens, see bstcad.mounted.  draft: angle (degrees) by which the outer
        walls lean inwards to the front, from the body or from at most 0.1 mm below the back's rim; holes stay along z.
        bevel: height along z (mm) of a bevel at 45 degrees on the edge between walls and front.  SceneError if a wire
        is open, crosses itself or another wire, or leaves the lens, if the body does not fit, or if walls would meet.
        """
        return self._named_solid(trim, holes, body, (draft, bevel)).solid

    @property
    def wall(self) -> tuple[float, float]:
        """Lower and upper z (mm) of the wall of the lens, between the rims of front and back; a flange has to meet it.

        SceneError if the faces cross.
        """
        from bstcad.cad import solid

        with commands.scene_errors():
            lens = solid.prepared(self.lens)
            back, front = solid.rim_heights(lens, solid.rim_loop(lens))
        return float(front.max()), float(back.min())

    def write_part(
        self, path: AnyPath, trim: Any = None, holes: Sequence[Any] = (), body: Any = None, *,
        draft: float = 0.0, bevel: float = 0.0,
    ) -> Path:  # fmt: skip
        """Write what `solid` returns for these arguments as STEP, with face names and the scene's [part].

        The control points have all digits; cadquery's own export would round them.  The file states area, volume and
        centroid, unless the body has a face that bstcad cannot integrate, such as a freeform face of another program.
        """
        from bstcad.cad import solid_properties, step_writing

        path, made = Path(path).expanduser(), self._named_solid(trim, holes, body, (draft, bevel))
        part, properties = self.scene.part.of(self.scene.lens), solid_properties.of_solid(made.solid)
        step_writing.write(made.solid, path, path.stem, part=part, faces=made.faces, properties=properties)
        return path

    def _named_solid(self, trim: Any, holes: Sequence[Any], body: Any, walls: tuple[float, float]) -> Any:
        """Return the result of `solid` with the names of its faces; walls: (draft, bevel)."""
        from bstcad.cad import mounting
        from bstcad.cad.solid import named_solid
        from bstcad.cad.walls import Draft

        with commands.scene_errors():
            if body is None:
                return named_solid(self.lens, trim, holes, Draft(*walls))
            return mounting.mounted(body, [mounting.PlacedLens(self.lens, trim, holes, draft=Draft(*walls))])

    def preview(self, control_points: int = 33) -> Any:
        """Return a coarse copy of the solid for viewers, such as show_object of CQ-editor or a notebook's cell.

        control_points: number of control points along the longer side of the copy's back.  The copy is a cadquery.Solid
        for display only, not for manufacture.
        """
        from bstcad.cad.solid import coarse_copy, lens_solid

        if control_points < 17:
            raise SceneError(f"control_points: {control_points} is too small for a preview; give 17 or more")
        return lens_solid(coarse_copy(self.lens, control_points))

    def part(self) -> Any:
        """Return the lens with the scene's [mount], in the frame of its datum, as in part.step.

        Returns a cadquery.Solid.  SceneError if the scene has no mount, or flange and lens do not fit.
        """
        from bstcad.cad import mounting

        if self.scene.mount is None:
            raise SceneError(f"{self.scene.name}: the scene has no [mount]; add it, or call solid() with a body")
        with commands.scene_errors():
            return mounting.part_of(self.lens, self.scene.mount).solid

    def export(
        self, *kinds: str, points: int | None = None, tiles: str | tuple[int, int] | None = None,
        folder: AnyPath | None = None, **cutting: float | str,
    ) -> list[Path]:  # fmt: skip
        """Write additional files, by names such as "zemax", into the folder of the design; return their paths.

        points: number of grid points along the wider side (default: number of control points; for "zemax", a grid
        through the knots).  tiles: numbers of tiles along x and along y, such as "2x3" or (2, 3); None: 2x2.
        folder: another folder for the files.  cutting: settings of "spiral" and "raster": tool_radius, cusp, pitch,
        tolerance, stock and depth in mm, feed in mm/min, along ("x" or "y"), zero ("top" or "bottom" of the blank),
        units ("mm" or "inch") and rapid ("G0" or "G1") of the G-code.  SceneError if a name is unknown or a value
        impossible, or if the design has not been written.
        """
        place = None if folder is None else Path(folder).expanduser()
        return commands.export(self._own_folder(), kinds, points, cutting, tiles=tiles, place=place).paths

    def write(
        self, folder: AnyPath, *, progress: bool = True, effort: Effort | None = None,
        checks: Sequence[OwnCheck] = (), sections: Sequence[OwnSection] = (),
    ) -> Report:  # fmt: skip
        """Write the files as `bstcad generate` does, in place of an earlier design, verify them, and return the report.

        effort: limits of the verification; None: bstcad.Effort().  checks: functions of (proof, folder) that return
        bstcad.Check records for the verdict; proof: verify.checks.Proof (lens, light, shape …).  sections: functions of
        report.record.Contents that return (heading, HTML) for report.html.  SceneError if `folder` has other files.
        """
        folder = Path(folder).expanduser()
        files.check_free(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with files.exclusive(folder), progresses.for_script(progress) as shown:
            limit = self.scene.tailoring.max_time if self.report is None else None  # only for a new design
            self._made = self._made.with_report_data()
            options = ProofOptions(effort, checks=checks, sections=sections, limit=limit)
            self.report = commands.write(self._made, folder, options, shown)
        self.folder = folder.resolve()
        return self.report

    def verify(
        self, *, measured: AnyPath | None = None, folder: AnyPath | None = None,
        against: Sequence[Any] = (), progress: bool = True, effort: Effort | None = None,
        checks: Sequence[OwnCheck] = (), sections: Sequence[OwnSection] = (),
    ) -> Report:  # fmt: skip
        """Verify the design from its files and write its report again; without files, temporary files are used.

        measured: file of points of a made part (CSV, PLY or STL; mm), which is also verified, see Report.measured.
        folder: folder for report, figures and deviation map of the made part; the design's folder is not changed.
        against: independent programs that also trace the design, "batoid" and "mitsuba", or your own judge
        (bstcad.verify.judges.comparison.OwnJudge).  measured, folder and against need a written design.  Others: see
        `write`.
        """
        options = ProofOptions(effort, checks=checks, sections=sections)
        cloud, place = (Path(path).expanduser() if path else None for path in (measured, folder))
        given: dict[str, Any] = {"measured": cloud, "place": place}
        judges = [against] if isinstance(against, str) else against
        with progresses.for_script(progress) as shown:
            if self._has_files() or measured or folder or against:
                report = commands.verify(self._own_folder(), options, against=judges, progress=shown, **given)
                assert isinstance(report, Report), "the files are those of a design"
            else:
                self._made = self._made.with_report_data()
                report = commands.prove(self._made, options, shown)
        self.report = report
        return report

    def tolerance(
        self, *, grade: str | None = None, wanted: float | None = None, seed: int = 0, workers: int | None = None,
        scheduler: str | None = None, progress: bool = True,
    ) -> dict[str, Any]:  # fmt: skip
        """Study the tolerances of manufacture, mounting and source; write tolerance.json and return its entries.

        grade: "moulded", "diamond-turned", "precise", "milled-polished", "milled-sanded", "resin-printed" or
        "resin-printed-coated", for errors that no [[tolerance]] names; None: as in the scene.
        wanted: yield (0 to 1) for which the loosest tolerances are computed.  seed: seed of the random trials.
        workers: number of processes for the traces (a script then needs `if __name__ == "__main__":`); scheduler:
        address of a dask scheduler instead.
        """
        from bstcad.manufacture.tolerance.study import StudySettings  # loaded late, as in commands.tolerance

        folder = self._own_folder()
        with progresses.for_script(progress) as shown:
            settings = StudySettings(grade, wanted, seed, progress=shown)
            return commands.tolerance(folder, settings, workers, scheduler).facts()

    def compensate(
        self, *measured: AnyPath, gain: float | None = None, cutoff: float | None = None,
        by: Literal["form", "light"] = "form", progress: bool = True,
    ) -> Compensated:  # fmt: skip
        """Write what to cut next to the design's folder, from measured points of the parts that were cut last.

        measured: files of points of the back, one per part.  gain: part of the deviation that is corrected; None: 1/n
        in round n.  cutoff: cutoff (mm) of the low pass; None: the light chooses.  by: correct the whole deviation
        ("form"), or only what changes the picture ("light").  The result has `folder` and `figures`.
        """
        clouds, settings = [Path(path).expanduser() for path in measured], CompensationSettings(gain, cutoff, by)
        with progresses.for_script(progress) as shown:
            return commands.compensate(self._own_folder(), clouds, settings, progress=shown)

    def retailor(
        self, *, thickness: float | None = None, index: float | None = None, front: float | AnyPath | None = None,
        folder: AnyPath | None = None, progress: bool = True,
    ) -> Design:  # fmt: skip
        """Tailor the back anew to the blank as it was built; write and verify the new design, and return it.

        thickness: distance of the vertices (mm).  index: refractive index at the main wavelength.  front: curvature
        (1/mm), or file of measured points of the front.  None: as designed.  folder: of the new design; None: the
        design's folder with "-as-built" behind its name.
        """
        measured = Path(front).expanduser() if isinstance(front, str | os.PathLike) else front
        place = None if folder is None else Path(folder).expanduser()
        with progresses.for_script(progress) as shown:
            written, report, found = commands.retailor(
                self._own_folder(), AsBuilt(thickness, index, measured), place, hooks=Hooks(shown)
            )
        return Design(found.made, report, written)

    def as_made(self, grade: str | None = None, *, layer_height: float | None = None) -> AsMade:
        """Predict the pictures of the lens as made: with layers or tool marks, roughness and form error of a grade.

        grade: grade as in `tolerance`; None: as in the scene.  layer_height: height of the layers of a print (mm);
        None: that of the grade.  The result has `goals` with the pictures `designed` and `made`, their `rrmsds` and
        `contrasts`, and the `changes` by each effect; `facts()` returns its figures as a dictionary.
        """
        from bstcad.manufacture.tolerance.as_made import as_made  # loaded late, as in commands.tolerance

        return as_made(self._made, grade, layer_height)

    def lit_by(self, light: str, *, distance: float | None = None) -> LitBy:
        """Predict the pictures of the lens in another light: "sun", "lamp", "led" or "phone" (the flashlight of one).

        distance: from the light to the lens (mm); None: five widths of the lens for a lamp, one for an LED, 500 mm for
        a phone.  The result has `goals` with the pictures `designed` and `lit`, and their `rrmsds`.
        """
        from bstcad.manufacture.tolerance.lit_by import lit_by  # loaded late, as in commands.tolerance

        return lit_by(self._made, light, distance)

    def show(self, png: AnyPath | None = None) -> None:
        """Draw the lens with rays and screen in the file `png` or, if None, in a window; return once it is closed."""
        commands.show(self._own_folder(), None if png is None else Path(png).expanduser())

    def picture(self, png: AnyPath | None = None, *, target: int = 0) -> np.ndarray:
        """Return the light on a target as a viewer at target.seen_from sees it: sRGB grey (rows, columns), uint8.

        Each pixel of the target is a pixel of the picture; white is the upper end of the report's scale.  The light is
        from the verification, or else from a trace of few flux tubes.  png: file to write.  target: index, from 0.
        """
        wanted = self._made.goals
        if not 0 <= target < len(wanted):
            possible = "0" if len(wanted) == 1 else f"a number from 0 to {len(wanted) - 1}"
            raise SceneError(f"target: there is no target[{target}]; give {possible}")
        view = View.of(self.scene, target)
        seen = view.picture(view.tones(self._irradiance(target), wanted[target].picture))
        grey = np.ascontiguousarray(seen)
        if png is not None:
            Image.fromarray(grey).save(Path(png).expanduser(), format="png")
        return grey

    def _has_files(self) -> bool:
        return self.folder is not None and (self.folder / "lens.step").exists()  # absent if writing failed

    def _own_folder(self) -> Path:
        """Return the folder with the files of this design; SceneError if there is none."""
        if self.folder is None or not self._has_files():
            raise SceneError(f"{self.scene.name}: this design has no files yet; write it to a folder first")
        if not self._made.is_lens_of(folders.read_nominal(self.folder)):
            raise SceneError(f"{self.folder}: the folder now contains another design; write this one elsewhere")
        return self.folder

    def __repr__(self) -> str:
        title = f": {self.scene.title}" if self.scene.title else ""
        return f"Design {self.scene.name!r}{title}\n  {self._dimensions()}\n  {self._quality()}"

    def _repr_html_(self) -> str:
        """Return HTML for a notebook: the text of `repr`, each target, and the irradiance on it."""
        lines = "<br>".join(html.escape(line.strip()) for line in repr(self).splitlines())
        shown = ""
        for k, goal in enumerate(self._made.goals):
            picture = irradiance_triptych(goal.picture, self._irradiance(k), View.of(self.scene, k))
            data = base64.b64encode(png(picture)).decode()
            shown += f'<img alt="Target, irradiance, their difference" width="100%" src="data:image/png;base64,{data}">'
        return f"<div>{lines}<br>{shown}</div>"

    def _dimensions(self) -> str:
        lens, (x, y) = self.lens, (2 * half for half in self.lens.plan.half_extent)
        across = f"{x:.6g} mm across" if self.scene.lens.outline.is_round else f"{x:g} x {y:g} mm"
        axis = torch.zeros(1, dtype=torch.float64)
        thick = float(lens.back.sag_and_slope(axis, axis)[0] - lens.front.sag_and_slope(axis, axis)[0])
        glass = self.scene.lens.material or "glass"
        return (
            f"{across} of {glass} (index {lens.index:.5g}), {quantity(thick, 'mm')} thick on the axis, "
            f"{size_text(lens.back_net.shape)} control points"
        )

    def _quality(self) -> str:
        if self.report is not None:
            where = f", in {self.folder}" if self.folder else ""
            return f"RRMSD {rrmsds(self.report.contents)}, {self.report.verdict}{where}"
        if self._made.course.stopped == BY_HAND:
            return "changed by hand; not verified yet"
        values = [stage.rrmsd for stage in self._made.course.stages if stage.rrmsd is not None]
        return f"RRMSD {number(values[-1])} as tailored; not verified yet" if values else "not verified yet"

    def _irradiance(self, number: int = 0) -> np.ndarray:
        """Return the flux per pixel (rows, columns; sum 1) on target[number], verified or else by PREVIEW_TUBES."""
        if self.report is not None:
            return self.report.irradiances[number]
        goal = self._made.goals[number]
        found = tubes_picture(self.lens, self.scene.channels(), goal.screen, PREVIEW_TUBES).numpy()
        return found * (goal.picture.sum() / found.sum())


def _adapted(lens: Lens, scene: Scene, front: Surface) -> tuple[Scene, Lens]:
    """Return (scene, lens): the scene with the front and the net of a user's lens, and the lens in float64 on the CPU.

    front: current front, which the scene keeps if the new front is equal.  SceneError if the lens does not fit.
    """
    if not (isinstance(lens, Lens) and isinstance(getattr(lens.back, "heights", None), torch.Tensor)):
        given = type(lens.back if isinstance(lens, Lens) else lens).__name__
        raise SceneError(f"with_lens: {given} is not possible; give a bstcad.Lens with a bstcad.BSplineSurface as back")
    lens, shape = replace(lens.plain(), losses=None).with_clear(None), tuple(lens.back_net.heights.shape)
    if len(shape) != 2:
        raise SceneError(f"with_lens: heights of shape {shape} are not possible; give (m, n), m along x and n along y")
    _check_same("outline", lens.outline, scene.lens.outline)
    _check_same("path of light", lens.passes.words, scene.lens.passes.words)
    if lens.passes.enters and not math.isclose(lens.index, scene.index, rel_tol=RELATIVE_TOLERANCE):
        _check_same("index", lens.index, scene.index)
    net = lens.back_net
    if net.shape != as_pair(scene.lens.back.net):
        scene = scene.changed({"lens.back.control_points": simplified(net.shape), "tailoring.levels": None})
    shapes_front = scene.lens.front.is_tailored and lens.front.is_net
    if shapes_front and lens.front_net.shape != as_pair(scene.lens.nets()[1]):
        scene = scene.changed({"lens.front.control_points": simplified(lens.front_net.shape), "lens.front.file": None})
    flat = scene.flat_lens(net.shape)
    back = _on_net(net, flat.back_net, BACK)
    if shapes_front:
        lens = lens.with_front(_on_net(lens.front_net, flat.front_net, FRONT))
    elif not same_front(lens.front, front):
        scene = scene.changed({"lens.front": lens.front})
        lens = lens.with_front(scene.lens.front_surface)  # a net, if the front is of a user's class
    return scene, scene.assembled(replace(lens, index=scene.index).with_back(back))


def _on_net(face: BSplineSurface, net: BSplineSurface, name: str) -> BSplineSurface:
    """Return a face with the ranges x, y of `net`, equal but for rounding; SceneError if not, or if not finite."""
    if not bool(torch.isfinite(face.heights).all()) or not math.isfinite(face.z):
        raise SceneError(f"with_lens: the {name} has heights that are not finite; give finite numbers in mm")
    for axis, own, theirs in (("x", face.x, net.x), ("y", face.y, net.y)):
        if not np.allclose(own, theirs, rtol=0, atol=RELATIVE_TOLERANCE * (theirs[1] - theirs[0])):
            _check_same(f"extent of the {name}'s net along {axis} (mm)", own, theirs)
    return replace(face, x=net.x, y=net.y)


def _check_same(name: str, own: Any, theirs: Any) -> None:
    if own != theirs:
        raise SceneError(f"with_lens: the {name} is {own}, and in the scene it is {theirs}; give the scene's value")


def mounted(
    body: Any, placed: Sequence[tuple[Design | Lens, Sequence[float]]], *, trim: Any = None, holes: Sequence[Any] = (),
    draft: float = 0.0, bevel: float = 0.0,
) -> Any:  # fmt: skip
    """Return one cadquery.Solid of a body with lenses: an array on a plate, or a lens with its flange.

    body: cadquery solid, or a Workplane with one solid, from which the shape of each lens is cut.  Around each lens it
    must be a plate between two planes z = const.  placed: pairs of a design (or bstcad.Lens) and the position of the
    origin of its scene in the body, (x, y) or (x, y, z) in mm.  trim, holes, draft, bevel: for each lens, as in
    Design.solid.  SceneError if the body does not surround a lens, or its planes cut the rim of an optical face.
    """
    from bstcad.cad import mounting
    from bstcad.cad.walls import Draft

    with commands.scene_errors():
        walls = Draft(draft, bevel)
        lenses = [
            mounting.PlacedLens(one if isinstance(one, Lens) else one.lens, trim, holes, at=_point(at), draft=walls)
            for one, at in placed
        ]
        return mounting.mounted(body, lenses).solid


def _point(at: Sequence[float]) -> tuple[float, float, float]:
    if len(at) not in (2, 3):
        raise ValueError(f"placed: {tuple(at)} is not a position; give (x, y) or (x, y, z) in mm")
    x, y, z = (*map(float, at), 0.0)[:3]
    return x, y, z
