"""The pictures of a report, drawn by a second process while this one goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad.analysis.light import bundle, fan, ray_map
from bstcad.analysis.shape import survey
from bstcad.cad import mesh as meshes
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.rays import TiltedPlane
from bstcad.optics.sources import Source
from bstcad.report import data_sheet_page, figures, light_figures, rendering
from bstcad.report.data_sheet import Sheet
from bstcad.report.drawing import png
from bstcad.report.light_figures import View
from bstcad.report.light_path import LightPath
from bstcad.report.record import Contents
from bstcad.report.units import number
from bstcad.report.vocabulary import ledger
from bstcad.scene.picture import to_srgb
from bstcad.scene.scene import Scene
from bstcad.verify.checks import Verification

if TYPE_CHECKING:
    from bstcad.judges.comparison import Compared
    from bstcad.measured.made_part import MadePart

CELLS = 320  # of the mesh in the 3-D picture, each way
SHOWN_CELLS = 200  # of the mesh of a lens at work, each way
RAYS, FEW = 28, 12  # each way, over the light that gets through the lens; and from near by
MILLIONTHS = 1e6

Submit = Callable[..., Future]  # submit(function, *arguments): has it called by the second process


class Pictures:
    """Figures and data sheet of a scene's design, begun one by one and waited for together."""

    def __init__(self, scene: Scene, submit: Submit) -> None:
        self._scene, self._submit = scene, submit
        self._vtk = ThreadPoolExecutor(1)  # waits for VTK, which draws in a process of its own
        self._solid: Future | None = None
        self._others: list[Future] = []
        self._sheet: Future | None = None

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *error: object) -> None:
        self._vtk.shutdown()

    def solid(self, lens: Lens) -> None:
        """Begin the 3-D picture."""
        self._solid = self._vtk.submit(rendering.lens_picture, meshes.lens_mesh(lens, CELLS))

    def lens(self, lens: Lens) -> None:
        """Begin the maps of the lens and its rays."""
        rays = self._scene.source.central, lens, self._scene.target.screen
        self._begin(draw_lens, *rays, self._view)

    def light(self, target: np.ndarray, proof: Verification) -> None:
        """Begin the pictures of the irradiance, of the ghost in it and of its lines."""
        self._begin(draw_light, target, proof, self._view)

    def numbers(self, report: Contents) -> None:
        """Begin the pictures of the flux and of the convergence."""
        self._begin(draw_numbers, report)

    def sheet(self, sheet: Sheet) -> None:
        """Begin the data sheet of a part."""
        self._sheet = self._submit(data_sheet_page.draw, sheet)

    def judges(self, judged: Sequence[Compared]) -> None:
        """Begin the pictures by other programs."""
        if drawn := [judge for judge in judged if not judge.declined]:
            self._begin(light_figures.draw_judges, drawn, self._view)

    def part(self, made: MadePart, proof: Verification) -> None:
        """Begin the pictures of a made part."""
        self._begin(light_figures.draw_part, made, proof.irradiance, self._view)

    def result(self) -> dict[str, bytes | None]:
        """PNG bytes by name; None for the 3-D picture on a machine that cannot draw it.

        A second process that died takes its pictures along: a proven lens is worth more.
        """
        pictures: dict[str, bytes | None] = {"lens": None if self._solid is None else self._solid.result()}
        for other in self._others:
            try:
                pictures |= other.result()
            except BrokenExecutor:
                continue
        return pictures

    def data_sheet(self) -> bytes | None:
        """PDF; None if there is none, or the process that drew it died."""
        try:
            return None if self._sheet is None else self._sheet.result()
        except BrokenExecutor:
            return None

    @property
    def _view(self) -> View:
        return View.of(self._scene)

    def _begin(self, draw: Callable[..., dict[str, bytes]], *given: Any) -> None:
        self._others.append(self._submit(draw, *given))


class NoPictures(Pictures):
    """The pictures of a design that nobody looks at: none."""

    def solid(self, lens: Lens) -> None:
        """Draw nothing."""

    def sheet(self, sheet: Sheet) -> None:
        """Draw nothing."""

    def _begin(self, draw: Callable[..., dict[str, bytes]], *given: Any) -> None:
        """Draw nothing."""


def draw_lens(source: Source, lens: Lens, screen: Screen, view: View) -> dict[str, bytes]:
    """The pictures of the lens but the 3-D one, with its rays to the screen, as PNG bytes by name."""
    return {
        "surface": png(figures.surface_maps(lens, survey(lens).slope.largest)),
        "side_view": png(figures.side_view(lens, fan(source, lens, screen.plane), screen)),
        "transport": png(figures.transport_map(*ray_map(source, lens, screen.plane), view)),
    }


def draw_light(target: np.ndarray, proof: Verification, view: View) -> dict[str, bytes]:
    """The pictures of the light as PNG bytes by name; one of the ghost and of lines if the proof has any."""
    found = proof.irradiance
    pictures = {
        "irradiance": light_figures.irradiance_triptych(target, found, view),
        "cross_section": light_figures.cross_section(target, found, view),
    }
    if proof.ghost is not None:
        pictures["ghost"] = light_figures.ghost_picture(target, proof.ghost, view)
    if proof.lines:
        pictures["lines"] = light_figures.lines_apart(target, found, proof.lines, view)
    return {name: png(picture) for name, picture in pictures.items()}


def draw_numbers(report: Contents) -> dict[str, bytes]:
    """The pictures of the flux, and of the convergence of a design with a history, as PNG bytes by name."""
    pictures = {"flux": figures.flux_ledger(ledger(report.flux, report.optic))}
    if report.history:
        pictures["convergence"] = figures.convergence(report.history, report.stages, report.rrmsd_noise)
    return {name: png(picture) for name, picture in pictures.items()}


# --- a lens at work ---------------------------------------------------------------------------------------------------


def light_path_of(scene: Scene, lens: Lens, target: np.ndarray, irradiance: np.ndarray) -> LightPath | None:
    """The lens, rays through it and their picture for `bstcad show`; None if no light arrives at the target."""
    source, screen = scene.source.central, scene.target.screen
    rays, flux = bundle(source, lens, screen.plane, RAYS)
    few, few_flux = bundle(source, lens, screen.plane, FEW)
    if not len(few):
        return None
    mesh = meshes.lens_mesh(lens, SHOWN_CELLS)
    top = light_figures.brightest(target, irradiance)
    tones = np.clip(to_srgb(np.clip(irradiance / top, 0.0, 1.0)), 0.0, 1.0)
    return LightPath(
        vertices=mesh.vertices,
        faces=mesh.faces,
        rays=rays,
        flux=MILLIONTHS * flux,
        few=few,
        few_flux=MILLIONTHS * few_flux,
        screen=corners(screen),
        picture=np.rint(255 * tones).astype(np.uint8),
        lamp=rays[:1, 0] if np.ptp(rays[:, 0], axis=0).max() < 1e-6 else np.empty((0, 3)),
        seen_along=1 if scene.target.seen_from == "lens" else -1,
        mirror=lens.reflects,
        title=scene.title or scene.name,
        words=_words(screen, len(rays), scene.source.extent is not None),
    )


def corners(screen: Screen) -> np.ndarray:
    """The corners of a screen in space (4, 3), mm: once around from x min, y min."""
    around = [(x, y) for y, x in product(screen.y, screen.x)]
    plane = screen.plane
    if isinstance(plane, TiltedPlane):
        return np.array([plane.point(*around[k]) for k in (0, 1, 3, 2)])
    return np.array([(*around[k], plane) for k in (0, 1, 3, 2)])


def _words(screen: Screen, rays: int, extended: bool) -> str:
    width, height = (number(high - low) for low, high in (screen.x, screen.y))
    of = "of the middle of the source" if extended else "of the source"
    return f"Target {width} × {height} mm at z = {number(screen.z)} mm\n{rays} rays {of}, true to scale"
