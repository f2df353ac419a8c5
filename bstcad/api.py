"""Designs as a script or a notebook holds them: made from a scene or opened from a folder; to be proved and written.

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
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from bstcad import commands, pipeline
from bstcad import folder as folders
from bstcad.commands import OwnCheck, OwnSection
from bstcad.folder import Made, same_front
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, tubes_picture
from bstcad.optics.sides import as_pair, simplified, size_text
from bstcad.optics.surfaces import Surface
from bstcad.report import record
from bstcad.report.drawing import png
from bstcad.report.light_figures import View, irradiance_triptych
from bstcad.report.record import BY_HAND, DesignCourse, Report, rrmsds
from bstcad.report.units import number, quantity
from bstcad.runs import files, processes
from bstcad.runs import progress as progresses
from bstcad.scene.blank import MIN_ROUND_POINTS
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene, load
from bstcad.transport.mapping import TransportMap

SAME = 1e-9  # of an index, and of the net's width
GLANCE = 521  # ray tubes a side of a picture that is only looked at


def design(
    scene: Scene | str | os.PathLike[str], *, progress: bool = True, device: str = "auto",
    merit: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None = None,
) -> Design:  # fmt: skip
    """The lens for a scene, or for the scene file of that path.  SceneError names the fault of a scene.

    progress: a bar, in a terminal or a notebook; elsewhere there is none.  device: "auto", "cpu" or "cuda" (see
    pipeline.device_for).  merit: a function of the picture and the target, tensors (rows, columns) of the light that
    leaves the lens, whose value stage 2 makes least in place of RRMSD²; it has to be of that size, and differentiable.
    What the proof states stays RRMSD.

    On Linux up to 2 GB of freed memory stay with the process for its next design (bstcad.runs.processes.keep_freed).
    """
    began = time.perf_counter()
    scene = scene.changed({}) if isinstance(scene, Scene) else load(scene)
    for warning in scene.warnings():
        warnings.warn(warning, stacklevel=2)
    processes.keep_freed()
    with progresses.for_script(progress) as shown:
        scene = commands.with_default_net(scene, lambda line: shown("control points", 1, 1, line))
        return Design(pipeline.design(scene, device=device, progress=shown, began=began, merit=merit, later=True))


def open(folder: str | os.PathLike[str]) -> Design:
    """The design in a folder that `Design.write` or `bstcad generate` wrote, exact from its files; SceneError."""
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder; give a design's folder, such as outputs/thu")
    made = commands.read(folder)
    try:
        contents = record.read(folder / "report.json")
    except ValueError:  # it is gone or damaged; verify writes it anew
        return Design(made, None, folder)
    return Design(made, Report(contents, folders.read_irradiances(folder, made.scene)), folder)


class Design:
    """A lens, the scene it was designed for, and, once it is verified, its report.

    It remembers the folder it was last written to, which `verify` then looks at.
    """

    def __init__(self, made: Made, report: Report | None = None, folder: Path | None = None) -> None:
        self._made = made
        self.report = report  # of the last verification; None: there was none yet
        self.folder = folder  # where its files lie; None: nowhere yet

    @property
    def scene(self) -> Scene:
        """The scene of the design."""
        return self._made.scene

    @property
    def lens(self) -> Lens:
        """Both faces, the outline and the index; lens.back.control_points() is (m, n, 3) in mm."""
        return self._made.lens

    @property
    def target(self) -> np.ndarray:
        """Flux wanted in each pixel, (rows, columns) of sum 1; row 0 = y max, column 0 = x min; that of target[0]."""
        return self._made.goals[0].picture

    @property
    def transport(self) -> TransportMap | None:
        """The transport map that stage 1 followed: places of the target, and where the light for them comes from (mm).

        None of a lens of one's own (with_lens, with_heights), and of a folder by an earlier version.  Of several lines
        and of a source of some size it is that of the line with most of the light, and of the source as a point.
        """
        return self._made.transport

    def with_lens(self, lens: Lens) -> Design:
        """The design of another lens for the same source and target, to verify and to write; this one stays as it is.

        lens: of the scene's outline and index (at the main wavelength), a mirror where the scene has a mirror, its net
        as wide as the scene's of as many points; brought to float64 on the CPU.  Another front and another number of
        control points go into the new design's scene; losses stay those of the scene's [[effects]].  Nothing is
        claimed of how the lens was found: there are no stages, no history and no transport map, and the report says
        "changed by hand".
        SceneError names the property of a lens that does not fit.
        """
        scene, lens = _fitting(lens, self._made.scene, self.lens.front)
        made = replace(
            self._made, scene=scene, lens=scene.as_mounted(lens), making=DesignCourse(stopped=BY_HAND), transport=None,
            precision_comparison=None,
        )  # fmt: skip
        return Design(made)

    def with_heights(self, heights: Any) -> Design:
        """The same for a lens that differs in its back alone, by its control heights (mm).

        heights: (m, n), a numpy array or a tensor, x along the first axis, y along the second, in the order of
        lens.back.heights and, as these, relative to z = lens.back.z: of heights in space subtract lens.back.z first.
        """
        try:
            found = np.asarray(heights.detach().cpu() if isinstance(heights, torch.Tensor) else heights)
            if found.dtype.kind not in "fiu" or found.ndim != 2:
                raise ValueError
        except (TypeError, ValueError):  # of lists that are no array, too
            given = getattr(heights, "shape", type(heights).__name__)
            given = f"numbers of shape {tuple(given)}" if isinstance(given, tuple) else given
            raise SceneError(
                f"with_heights: takes (m, n) real numbers in mm, such as lens.back.heights, not {given}"
            ) from None
        m, n = (max(count, MIN_ROUND_POINTS) for count in found.shape)
        net = self.scene.flat_lens((m, n)).back
        back = replace(net, z=self.lens.back.z, heights=torch.from_numpy(found.astype(np.float64)))
        return self.with_lens(replace(self.lens, back=back))

    def solid(
        self, trim: Any = None, holes: Sequence[Any] = (), body: Any = None, *, draft: float = 0.0, bevel: float = 0.0
    ) -> Any:
        """The exact solid, a cadquery.Solid: works in Workplane chains and assemblies.

        trim: a closed plane cadquery.Wire inside the lens to cut it to, used by its x and y.  holes: such wires, or
        (x, y, diameter) in mm.  Walls stand along z.  The faces stay those of the design and are only bounded anew,
        which takes a second where a boolean with a large net takes half a minute.  body: a cadquery solid, such as a
        flange, that becomes one with the lens, see bstcad.mounted.  draft: degrees by which the walls around the lens
        lean inwards, from 0.1 mm below the back's rim, or from the body, to the front.  bevel: mm along z that are
        taken off their edge with the front, at 45 degrees.  SceneError if a wire is open, crosses itself or another,
        or leaves the lens, or the body does not fit, or walls would meet.
        """
        return self._named_solid(trim, holes, body, (draft, bevel)).solid

    def write_part(
        self, path: str | os.PathLike[str], trim: Any = None, holes: Sequence[Any] = (), body: Any = None, *,
        draft: float = 0.0, bevel: float = 0.0,
    ) -> Path:  # fmt: skip
        """Write `solid` of the same arguments as STEP, its faces named, with the facts of the scene's [part]; the path.

        With every digit of the control points, which cadquery's own export rounds.  Area, volume and centroid stand
        there, unless the body has freeform faces of its own, over which OCC would take minutes.
        """
        from bstcad.cad import solid_properties, step_writing

        path, made = Path(path).expanduser(), self._named_solid(trim, holes, body, (draft, bevel))
        part, properties = self.scene.part.of(self.scene.lens), solid_properties.of_solid(made.solid)
        step_writing.write(made.solid, path, path.stem, part=part, faces=made.faces, properties=properties)
        return path

    def _named_solid(self, trim: Any, holes: Sequence[Any], body: Any, walls: tuple[float, float]) -> Any:
        """The solid of these arguments with the names of its faces; walls: draft and bevel."""
        from bstcad.cad import mounting
        from bstcad.cad.solid import named_solid
        from bstcad.cad.walls import Draft

        with commands.scene_errors():
            if body is None:
                return named_solid(self.lens, trim, holes, Draft(*walls))
            return mounting.mounted(body, [mounting.PlacedLens(self.lens, trim, holes, draft=Draft(*walls))])

    def preview(self, control_points: int = 33) -> Any:
        """A coarse copy of the solid that viewers show at once: CQ-editor's show_object, a notebook's cell.

        A cadquery.Solid whose back has so many control points along its longer side: to look at, never to make.
        """
        from bstcad.cad.solid import coarse_copy, lens_solid

        if control_points < 17:
            raise SceneError(f"control_points: {control_points} are too few for a preview; give 17 or more")
        return lens_solid(coarse_copy(self.lens, control_points))

    def part(self) -> Any:
        """The lens as the scene's [mount] asks for it, in the frame of its datum, as in part.step.

        A cadquery.Solid; SceneError if the scene has no mount, or flange and lens do not fit.
        """
        from bstcad.cad import mounting

        if self.scene.mount is None:
            raise SceneError(f"{self.scene.name}: has no [mount]; add one to the scene, or give solid() a body")
        with commands.scene_errors():
            return mounting.part_of(self.lens, self.scene.mount).solid

    def export(self, *kinds: str, points: int | None = None) -> list[Path]:
        """Write files for the shop into the design's folder: by the names of bstcad.report.exports, such as "zemax".

        points: along the wider side of grids (default: as many as control points; for OpticStudio the knots).  Returns
        their paths; SceneError if a kind is none of these or the design was never written.
        """
        return commands.export(self._own_folder(), kinds, points).paths

    def write(
        self, folder: str | os.PathLike[str], *, progress: bool = True, effort: Effort | None = None,
        checks: Sequence[OwnCheck] = (), sections: Sequence[OwnSection] = (),
    ) -> Report:  # fmt: skip
        """Write the whole folder that `bstcad generate` writes, proved from its files, in the place of an earlier one.

        checks: functions of the proof (bstcad.verify.checks.Proof: lens, light, shape …) and of the folder, each giving
        bstcad.Check records that join the verdict.  sections: functions of the report's record, each giving a heading
        and HTML for report.html.  SceneError if the folder holds anything but a design.
        """
        folder = Path(folder).expanduser()
        files.check_free(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with files.exclusive(folder), progresses.for_script(progress) as shown:
            limit = self.scene.tailoring.max_time if self.report is None else None  # else its time was long ago
            self._made = self._made.with_report_data()
            self.report = commands.write(
                self._made, folder, progress=shown, effort=effort, limit=limit, own_checks=checks,
                own_sections=sections,
            )  # fmt: skip
        self.folder = folder.resolve()
        return self.report

    def verify(
        self, *, measured: str | os.PathLike[str] | None = None, folder: str | os.PathLike[str] | None = None,
        against: Sequence[Any] = (), progress: bool = True, effort: Effort | None = None,
        checks: Sequence[OwnCheck] = (), sections: Sequence[OwnSection] = (),
    ) -> Report:  # fmt: skip
        """Prove the design from its files, whose report is written anew; from temporary ones if it has none.

        measured: a file of points of a made part (CSV, PLY or STL; mm), which is judged too, see Report.measured.
        folder: for its report, figures and deviation map alone; the design's own files stay as they are.  against:
        programs not written here that trace it too, "batoid" and "mitsuba", or a judge of one's own
        (bstcad.judges.comparison.OwnJudge).  All want a design that was written.  checks, sections: as in `write`.
        """
        with progresses.for_script(progress) as shown:
            if self._has_files() or measured or folder or against:
                self.report = commands.verify(
                    self._own_folder(), against=[against] if isinstance(against, str) else against,
                    measured=measured and Path(measured).expanduser(), place=folder and Path(folder).expanduser(),
                    progress=shown, effort=effort, own_checks=checks, own_sections=sections,
                )  # fmt: skip
            else:
                self._made = self._made.with_report_data()
                self.report = commands.prove(self._made, progress=shown, effort=effort, own_checks=checks)
        return self.report

    def tolerance(
        self, *, grade: str | None = None, wanted: float | None = None, seed: int = 0, workers: int | None = None,
        scheduler: str | None = None, progress: bool = True,
    ) -> dict[str, Any]:  # fmt: skip
        """How exactly the lens must be made, mounted and lit: the entries of tolerance.json, which is written.

        grade: "moulded", "diamond-turned" or "precise", for all that the scene states no tolerance of.  wanted: the
        yield (0 to 1) that the loosest tolerances are to keep.  workers: processes to spread the traces over, which a
        script may ask for below `if __name__ == "__main__":`; scheduler: of a dask cluster, whose workers do it.
        """
        folder = self._own_folder()
        with progresses.for_script(progress) as shown:
            return commands.tolerance(
                folder, grade=grade, wanted=wanted, seed=seed, workers=workers, scheduler=scheduler, progress=shown
            ).facts()

    def show(self, png: str | os.PathLike[str] | None = None) -> None:
        """Draw the lens at work, rays and screen with it: to a PNG file, or in a window until it is closed."""
        commands.show(self._own_folder(), None if png is None else Path(png).expanduser())

    def picture(self, png: str | os.PathLike[str] | None = None, *, target: int = 0) -> np.ndarray:
        """The light on the target as an eye sees it from the scene's side: grey tones (rows, columns), uint8, sRGB.

        A pixel of the target is a pixel of the picture, white the end of the report's scale.  As verified, or else by a
        glance with few ray tubes.  png: a file to write it to as well.  target: which of several, from 0.
        """
        wanted = self._made.goals
        if not 0 <= target < len(wanted):
            raise SceneError(f"target: there is no target[{target}], the last is target[{len(wanted) - 1}]; give one")
        view = View.of(self.scene, target)
        seen = view.picture(view.tones(self._irradiance(target), wanted[target].picture))
        grey = np.ascontiguousarray(seen)
        if png is not None:
            Image.fromarray(grey).save(Path(png).expanduser(), format="png")
        return grey

    def _has_files(self) -> bool:
        return self.folder is not None and (self.folder / "lens.step").exists()  # else the design alone was kept

    def _own_folder(self) -> Path:
        """The folder with the files of this very design."""
        if not self._has_files():
            raise SceneError(f"{self.scene.name}: has no files yet, which that takes; write the design to a folder")
        if not self._made.is_lens_of(folders.read_nominal(self.folder)[1]):
            raise SceneError(f"{self.folder}: holds another design by now; write this one to a folder of its own")
        return self.folder

    def __repr__(self) -> str:
        title = f": {self.scene.title}" if self.scene.title else ""
        return f"Design {self.scene.name!r}{title}\n  {self._shape()}\n  {self._worth()}"

    def _repr_html_(self) -> str:
        """For a notebook: the same three lines, each target and the irradiance on it."""
        lines = "<br>".join(html.escape(line.strip()) for line in repr(self).splitlines())
        shown = ""
        for k, goal in enumerate(self._made.goals):
            picture = irradiance_triptych(goal.picture, self._irradiance(k), View.of(self.scene, k))
            data = base64.b64encode(png(picture)).decode()
            shown += f'<img alt="Target, irradiance, their difference" width="100%" src="data:image/png;base64,{data}">'
        return f"<div>{lines}<br>{shown}</div>"

    def _shape(self) -> str:
        lens, (x, y) = self.lens, (2 * half for half in self.scene.lens.outline.half_extent)
        across = f"{x:g} mm across" if self.scene.lens.outline.is_round else f"{x:g} x {y:g} mm"
        axis = torch.zeros(1, dtype=torch.float64)
        thick = float(lens.back.sag_and_slope(axis, axis)[0] - lens.front.sag_and_slope(axis, axis)[0])
        glass = self.scene.lens.material or "glass"
        return (
            f"{across} of {glass} (index {lens.index:.5g}), {quantity(thick, 'mm')} thick on the axis, "
            f"{size_text(lens.back.shape)} control points"
        )

    def _worth(self) -> str:
        if self.report is not None:
            where = f", in {self.folder}" if self.folder else ""
            return f"RRMSD {rrmsds(self.report.contents)}, {self.report.verdict}{where}"
        if self._made.making.stopped == BY_HAND:
            return "changed by hand; not verified yet"
        values = [stage.rrmsd for stage in self._made.making.stages if stage.rrmsd is not None]
        return f"RRMSD {number(values[-1])} as tailored; not verified yet" if values else "not verified yet"

    def _irradiance(self, number: int = 0) -> np.ndarray:
        """On a target, as verified, or else by a glance: (rows, columns), with the target's sum."""
        if self.report is not None:
            return self.report.irradiances[number]
        goal = self._made.goals[number]
        found = tubes_picture(self.lens, self.scene.channels(), goal.receiver, GLANCE).numpy()
        return found * (goal.picture.sum() / found.sum())


def _fitting(lens: Lens, scene: Scene, front: Surface) -> tuple[Scene, Lens]:
    """A lens of one's own in float64 on the CPU, without losses, and the scene with its front and its number of points.

    front: which the scene need not be given; SceneError if the lens is not one of the scene.
    """
    if not (isinstance(lens, Lens) and isinstance(getattr(lens.back, "heights", None), torch.Tensor)):
        given = type(lens.back if isinstance(lens, Lens) else lens).__name__
        raise SceneError(f"with_lens: takes a bstcad.Lens whose back is a bstcad.BSplineSurface, not {given}")
    lens, shape = replace(lens.plain(), losses=None, clear=None), tuple(lens.back.heights.shape)
    if len(shape) != 2:
        raise SceneError(f"with_lens: its back has heights of shape {shape}; give m along x and n along y, (m, n)")
    _check_same("outline", lens.outline, scene.lens.outline)
    _check_same("way of light", lens.passes.words, scene.lens.passes.words)
    if lens.passes.enters and not math.isclose(lens.index, scene.index, rel_tol=SAME):
        _check_same("index", lens.index, scene.index)
    if lens.back.shape != as_pair(scene.lens.back.net):
        scene = scene.changed({"lens.back.control_points": simplified(lens.back.shape), "tailoring.levels": None})
    shapes_front = scene.lens.front.shaped and lens.front.is_net
    if shapes_front and lens.front.shape != as_pair(scene.lens.nets()[1]):
        scene = scene.changed({"lens.front.control_points": simplified(lens.front.shape), "lens.front.file": None})
    flat = scene.flat_lens(lens.back.shape)
    back = _on_net(lens.back, flat.back, "back")
    if shapes_front:
        lens = lens.with_front(_on_net(lens.front, flat.front, "front"))
    elif not same_front(lens.front, front):
        scene = scene.changed({"lens.front": lens.front})
        lens = lens.with_front(scene.lens.front_surface)  # a net stands for a surface of one's own
    return scene, scene.assembled(replace(lens, back=back, index=scene.index))


def _on_net(face: BSplineSurface, net: BSplineSurface, name: str) -> BSplineSurface:
    """A face with the ends of the scene's net; SceneError if its heights are not finite, or its net is another."""
    if not bool(torch.isfinite(face.heights).all()) or not math.isfinite(face.z):
        raise SceneError(f"with_lens: heights of its {name} are not finite; give numbers in mm")
    for axis, own, theirs in (("x", face.x, net.x), ("y", face.y, net.y)):
        if not np.allclose(own, theirs, rtol=0, atol=SAME * (theirs[1] - theirs[0])):
            _check_same(f"extent of its {name}'s net along {axis} (mm)", own, theirs)
    return replace(face, x=net.x, y=net.y)


def _check_same(name: str, own: Any, theirs: Any) -> None:
    """SceneError unless a property of a lens is that of the scene."""
    if own != theirs:
        raise SceneError(f"with_lens: {name} is {own}, and the scene's is {theirs}; give that")


def mounted(
    body: Any, placed: Sequence[tuple[Design | Lens, Sequence[float]]], *, trim: Any = None, holes: Sequence[Any] = (),
    draft: float = 0.0, bevel: float = 0.0,
) -> Any:  # fmt: skip
    """One cadquery.Solid of a body and lenses in it: an array on a plate, a lens and its flange.

    body: a cadquery solid (or a Workplane that holds one), whose faces are all its own; the shape of each lens is cut
    out of it.  placed: designs (or bstcad.Lens), and where the origin of each one's scene stands in it, (x, y) or
    (x, y, z) in mm; trim, holes, draft and bevel of each as in Design.solid.  Around a lens the body has to be a plate
    between two planes z = const.
    SceneError, in one sentence, where it does not reach around, or a plane cuts the rim of a face.
    """
    from bstcad.cad import mounting
    from bstcad.cad.walls import Draft

    with commands.scene_errors():
        walls = Draft(draft, bevel)
        lenses = [
            mounting.PlacedLens(getattr(one, "lens", one), trim, holes, at=_place(at), draft=walls)
            for one, at in placed
        ]
        return mounting.mounted(body, lenses).solid


def _place(at: Sequence[float]) -> tuple[float, float, float]:
    if len(at) not in (2, 3):
        raise ValueError(f"placed: {tuple(at)} is no place; give (x, y) or (x, y, z) in mm")
    x, y, z = (*map(float, at), 0.0)[:3]
    return x, y, z
