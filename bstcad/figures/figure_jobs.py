"""Jobs that draw the pictures of a report in a second process, and the figures of the lens, its rays and its design.

Each figure has a function that returns it as a matplotlib Figure.  Maps of a face have row 0 at y min and axes in mm.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby, product
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bstcad.analysis.light import bundle, fan, ray_map
from bstcad.analysis.shape import MAX_RADIUS, least_squares, survey
from bstcad.cad import mesh as meshes
from bstcad.designs.course import CurvePoint, StageRecord
from bstcad.figures import light_figures, photometric_figures, rendering
from bstcad.figures.drawing import BLUE, GLASS, GREY, VERMILION, footnote, new_figure, png, round_up, steps, styled
from bstcad.figures.light_figures import View, plain_ticks
from bstcad.figures.rendering import RayPath
from bstcad.figures.wavefront_figure import wavefront_map
from bstcad.optics.lens.base import on_base
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.charts import HEIGHTS, Chart
from bstcad.optics.surfaces.surfaces import sag
from bstcad.optics.trace.measure import Light, SpectralLine
from bstcad.optics.trace.wavefront_error import WavefrontError
from bstcad.report.record import Contents
from bstcad.report.units import number, quantity, tilt_words
from bstcad.runs.processes import Submit
from bstcad.scene.target import numbered
from bstcad.verify.nominal import Nominal

if TYPE_CHECKING:
    from matplotlib.figure import Figure


CELLS, LIGHT_PATH_CELLS = 320, 200  # mesh cells per axis in the 3-D picture, and in the 3-D view with rays
RAYS = 28  # rays per axis in the view with rays
MILLIONTHS = 1e6  # factor from a fraction to millionths
MAP_POINTS = 401  # samples of a surface map along each axis
EDGE_ROUNDING = 1e-9  # relative distance beyond the outline up to which a point of a map counts as inside
ROUNDING = 1e-6  # relative variation below which a map has no contour lines

Pngs = dict[str, bytes]  # pictures by name


class Pictures:
    """Jobs that draw the figures and the data sheet of a design; `result` waits for all of them."""

    def __init__(self, design: Nominal, submit: Submit) -> None:
        self._design, self._submit = design, submit
        self._views = _views_of(design)
        self._vtk = ThreadPoolExecutor(1)  # waits for VTK, which draws in its own process
        self._jobs: list[Future] = []
        self._sheet: Future | None = None

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None:  # Ctrl-C or an error: do not wait seconds for VTK
            rendering.stop()
        self._vtk.shutdown(cancel_futures=kind is not None)

    def begin(self, draw: Callable[..., Pngs], *given: Any, number: int = 0) -> None:
        """Start the job draw(*given, view); number: index of the target that the view shows."""
        self._jobs.append(self._submit(draw, *given, self._views[number]))

    def solid(self, lens: Lens) -> None:
        """Start the job that draws the 3-D picture."""
        mesh = meshes.lens_mesh(lens, CELLS)
        self._jobs.append(self._vtk.submit(lambda: {"lens": rendering.lens_picture(mesh)}))

    def lens(self, lens: Lens) -> None:
        """Start the job `draw_lens`, a job `draw_transport` for each target, and the far field if it has a meaning."""
        source, screens = self._design.emitter.central, [goal.screen for goal in self._design.goals]
        self.begin(draw_lens, source, lens, screens)
        for k, screen in enumerate(screens):
            self.begin(draw_transport, source, lens, screen, number=k)
        if self._design.has_far_field:
            self.begin(photometric_figures.draw_far_field, self._design.far_field, lens)

    def sheet(self, draw: Callable[..., bytes], sheet: Any) -> None:
        """Start the job that draws the data sheet."""
        self._sheet = self._submit(draw, sheet)

    def result(self) -> dict[str, bytes | None]:
        """Return PNG bytes by name; None for the 3-D picture if the machine cannot draw it.

        If the second process died, its pictures are missing without an error: the verified lens is still valid.
        """
        pictures: dict[str, bytes | None] = {"lens": None}
        for job in self._jobs:
            with contextlib.suppress(BrokenExecutor):
                pictures |= job.result()
        return pictures

    def data_sheet(self) -> bytes | None:
        """Return the PDF of the data sheet; None if there is none, or the second process died."""
        with contextlib.suppress(BrokenExecutor):
            return None if self._sheet is None else self._sheet.result()
        return None


class NoPictures(Pictures):
    """Figure jobs that draw nothing, for a design without figures."""

    def begin(self, draw: Callable[..., Pngs], *given: Any, number: int = 0) -> None:
        """Draw nothing."""

    def solid(self, lens: Lens) -> None:
        """Draw nothing."""

    def sheet(self, draw: Callable[..., bytes], sheet: Any) -> None:
        """Draw nothing."""


def draw_lens(source: Emitter, lens: Lens, screens: Sequence[Screen], view: View) -> Pngs:
    """Return maps of the back and of a tailored front, and a side view of the lens; `view` is not used."""
    screens = [drawn(screen, lens) for screen in screens]
    farthest = max(screens, key=lambda screen: screen.receiver.throw(0.0))
    maps = {
        "surface" if face.name == BACK else f"surface_{face.name}": png(surface_maps(lens, face.name))
        for face in lens.described_faces
    }
    return {
        **maps,
        "side_view": png(side_view(lens, fan(source, lens, farthest.receiver), screens)),
    }


def draw_transport(source: Emitter, lens: Lens, screen: Screen, view: View) -> Pngs:
    """Return the picture of the transport map from the lens to a screen."""
    grid, image = ray_map(source, lens, screen.receiver)
    return {numbered("transport", view.number): png(transport_map(grid, image, view, lens.back.chart))}


def draw_light(target: np.ndarray, light: Light, lines: Sequence[SpectralLine], view: View) -> Pngs:
    """Return the figures of the irradiance, of the RRMSD by size of the cells, of the ghost and of spectral lines."""
    found, view = light.picture, view.with_flux(target, light.on_screen)
    pictures = {
        "irradiance": light_figures.irradiance_triptych(target, found, view),
        "cross_section": light_figures.cross_section(target, found, view),
    }
    if light.by_cell:
        pictures["cell_error"] = light_figures.cell_error(light.by_cell, target.shape, view)
    if light.ghost is not None:
        pictures["ghost"] = light_figures.ghost_picture(target, light.ghost, view)
    if lines:
        pictures["lines"] = light_figures.spectral_lines(target, found, lines, view)
    return {numbered(name, view.number): png(picture) for name, picture in pictures.items()}


def draw_wavefront(error: WavefrontError, view: View) -> Pngs:
    """Return the map of a wavefront error; `view` is not used."""
    return {"wavefront": png(wavefront_map(error))}


def draw_convergence(report: Contents, view: View) -> Pngs:
    """Return the convergence curve of a design; empty if the report has no history."""
    if not report.history:
        return {}
    return {"convergence": png(convergence(report.history, report.stages, report.rrmsd_noise))}


# --- the lens ---------------------------------------------------------------------------------------------------------


@styled
def surface_maps(lens: Lens, face: str = BACK) -> Figure:
    """Draw maps of h, slope angle and mean curvature of a freeform face inside the outline, over its chart.

    Extreme values are those of the face's survey, which the samples of the maps may miss.
    The best-fit plane is subtracted from the sag if the PV of the plane exceeds the PV of the residual, else the mean.
    """
    surface, found = lens.face(face).surface.plain(), survey(lens, face)
    chart = surface.chart
    ends = chart.drawn(np.diag(lens.outline.half_extent)).max(axis=0)
    x, y = (np.linspace(-end, end, MAP_POINTS) for end in ends)
    places = np.moveaxis(chart.from_drawn(np.stack(np.meshgrid(x, y), axis=-1)), -1, 0)
    of_x, of_y = (torch.from_numpy(np.ascontiguousarray(p)) for p in places)
    shown = lens.outline.contains(of_x / (1 + EDGE_ROUNDING), of_y / (1 + EDGE_ROUNDING)).numpy()
    patch = surface.at(of_x, of_y)
    height, heading, (scale, unit) = _height_map(chart, np.where(shown, chart.coordinates(patch.position)[2], np.nan))
    normal = patch.normal.numpy()
    normal = normal / np.sqrt((normal * normal).sum(0))
    slope = np.where(shown, np.degrees(np.arctan2(np.hypot(normal[0], normal[1]), normal[2])), np.nan)
    bend = mean_curvature(patch.along_x.numpy(), patch.along_y.numpy(), normal, (of_x.numpy(), of_y.numpy()))
    bend = np.where(shown, bend, np.nan)
    edge = round_up(float(np.nanpercentile(np.abs(bend), 99.0)))

    figure = new_figure(11.0, 3.7, layout="compressed")
    panels = figure.subplots(1, 3, sharey=True)
    place = {"extent": (x[0], x[-1], y[0], y[-1]), "origin": "lower", "interpolation_stage": "data"}
    panels[0].set_ylabel(chart.labels[1])
    maps = (
        (scale * height, unit, heading),
        (slope, "degrees", f"Slope: up to {found.slope.largest:.3g}°"),
        (bend, "1/mm", f"Mean curvature ({'seen from +z: ' if chart.flat else ''}+ hollow, − bulge)"),
    )
    for axes, (values, label, title) in zip(panels, maps, strict=True):
        signed = axes is panels[2]
        shades = {"cmap": steps("PuOr", 82), "vmin": -edge, "vmax": edge} if signed else {"cmap": steps("cividis", 82)}
        map_image = axes.imshow(values, **place, **shades)
        axes.set(xlabel=chart.labels[0], title=title)
        axes.spines[:].set_visible(False)
        extend = "both" if signed else "neither"
        bar = figure.colorbar(map_image, ax=axes, label=label, fraction=0.046, pad=0.03, extend=extend)
        if not signed and np.nanmax(values) - np.nanmin(values) > ROUNDING * (1 + np.nanmax(np.abs(values))):
            bar.add_lines(axes.contour(x, y, values, 10, colors="white", linewidths=0.35))
    if overhangs := found.slope.largest > 90.0:
        panels[1].contour(x, y, slope, [90.0], colors=VERMILION, linewidths=1.2)
    radii = (("concave", found.concave), ("convex", found.convex))
    radii = (f"{n}, {quantity(r.largest, 'mm')} {r.where}" for n, r in radii if r.largest < MAX_RADIUS)
    radii = f"Smallest radii of curvature, seen from outside: {'; '.join(radii) or 'none: the face is flat'}."
    footnote(figure, radii + (" Beyond the red line, at 90°, the face overhangs." if overhangs else ""))
    return figure


def _height_map(chart: Chart, h: np.ndarray) -> tuple[np.ndarray, str, tuple[float, str]]:
    """Return a map (r, c) of h (mm) to draw, its heading, and the scale and name of its unit; h: NaN outside."""
    if not chart.flat:
        return h + chart.offset, f"{chart.distance}: PV {np.nanmax(h) - np.nanmin(h):.3g} mm", (1.0, "mm")
    columns = np.stack([np.ones_like(h), *np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in h.shape[::-1]))], axis=-1)
    known = np.isfinite(h)
    plane = np.where(known, columns @ least_squares(columns[known], h[known]), np.nan)
    tilted = np.nanmax(plane) - np.nanmin(plane) > np.nanmax(h - plane) - np.nanmin(h - plane)
    height = h - plane if tilted else h - np.nanmean(h)
    pv = float(np.nanmax(height) - np.nanmin(height))
    scale, unit = (1.0, "mm") if pv >= 0.5 else (1e3, "µm")
    heading = f"{chart.distance}{', best plane removed' if tilted else ''}: PV {scale * pv:.3g} {unit}"
    return height, heading, (scale, unit)


def mean_curvature(
    along_x: np.ndarray, along_y: np.ndarray, normal: np.ndarray, chart: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return the mean curvature (1/mm), (r, c), from tangents and unit normals (3, r, c) on a grid of a chart.

    H = (l G - 2 m F + k E) / (2 (E G - F²)),  l = -n_x · S_x,  2 m = -n_x · S_y - n_y · S_x,  k = -n_y · S_y, with the
    first fundamental form E, F, G (do Carmo 1976, section 3.3); H > 0 in a hollow, as seen from the side of n.
    chart: x and y (r, c) of the points in the chart (mm).  The derivatives of the normal are central differences along
    the grid, turned into those along x and y.
    """
    (x_v, x_u), (y_v, y_u) = (np.gradient(part) for part in chart)
    det = x_u * y_v - x_v * y_u
    n_v, n_u = (np.stack(part) for part in zip(*(np.gradient(part) for part in normal), strict=True))
    n_x, n_y = (n_u * y_v - n_v * y_u) / det, (n_v * x_u - n_u * x_v) / det
    e, f, g = (along_x**2).sum(0), (along_x * along_y).sum(0), (along_y**2).sum(0)
    l, k = -(n_x * along_x).sum(0), -(n_y * along_y).sum(0)  # noqa: E741 - the names of the second fundamental form
    m = -((n_x * along_y).sum(0) + (n_y * along_x).sum(0)) / 2
    return (l * g - 2 * m * f + k * e) / (2 * (e * g - f * f))


@styled
def side_view(lens: Lens, rays: np.ndarray, screens: Sequence[Screen] = ()) -> Figure:
    """Draw the section of the lens at y = 0 with rays projected on x-z: the lens close up, and the whole path.

    rays: (n_rays, n_points, 3) in mm.  A single screen in a plane z = const is not drawn; all others are.
    """
    figure = new_figure(11.0, 3.4)
    close, whole = figure.subplots(1, 2, width_ratios=(1, 1.9))
    reach = lens.plan.half_extent[0]
    rim_x, rim_z = _section(lens)
    for axes in (close, whole):
        axes.plot(rays[:, :, 2].T, rays[:, :, 0].T, color=VERMILION, linewidth=0.6, alpha=0.8)
        axes.fill(rim_z, rim_x, facecolor=GLASS, edgecolor=BLUE, linewidth=1.0)
        for interface in (*lens.before, *lens.behind):
            half = interface.outline.half_extent[0]
            along = torch.linspace(-half, half, MAP_POINTS, dtype=torch.float64)
            height = interface.surface.sag_and_slope(along, torch.zeros_like(along))[0].expand_as(along)
            axes.plot(height.numpy(), along.numpy(), color=BLUE, linewidth=1.0, gid="element")
        axes.set(xlabel="z (mm)", ylabel="x (mm)")
    low, high = rim_z.min(), rim_z.max()
    close.set(xlim=(low - reach * 0.5, high + reach * 0.5), ylim=(-1.25 * reach, 1.25 * reach))
    close.set(title=f"{lens.passes.optic.capitalize()}, cut along y = 0", aspect="equal")
    whole.set_title("Whole path, source to target (axes at different scales)")
    several = len(screens) > 1
    visible = [screen for screen in screens if several or not screen.receiver.is_level]
    for screen in visible:
        edges = corners(screen)
        whole.fill(edges[:, 2], edges[:, 0], facecolor="none", edgecolor=GREY, linewidth=1.0, gid="screen")
    if visible:
        tilt = visible[0].receiver.tilt
        one = f"Grey: the target, its plane tilted by {tilt_words(tilt)}." if tilt else "Grey: the target."
        footnote(figure, "Grey: the targets." if several else one)
    return figure


def _section(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Return x and z (mm) around the section of a lens at y = 0."""
    lens = on_base(lens.plain())
    along, back = lens.back.section(lens.outline, upright=False, count=MAP_POINTS)
    x = np.linspace(along[0], along[-1], MAP_POINTS)
    return np.concatenate([x, along[::-1]]), np.concatenate([sag(lens.front, x, 0.0 * x), back[::-1]])


@styled
def transport_map(source: np.ndarray, image: np.ndarray, view: View, chart: Chart = HEIGHTS) -> Figure:
    """Draw lines of a grid `source` (k, k, 2) (mm) in a chart, and `image` (k, k, 2) on the target.

    The chart of heights shows the grid on the first vertex's plane.
    """
    figure, where = new_figure(8.2, 3.9, layout="compressed"), "front of the lens" if view.optic == "lens" else "mirror"
    title = f"Grid on the {where}" if chart.flat else "Grid of directions from the centre of the back"
    sides = ((title, chart.drawn(source), chart.labels), ("Its image on the target", image, view.labels))
    for axes, (title, points, (x, y)) in zip(figure.subplots(1, 2), sides, strict=True):
        for lines, colour in ((points, BLUE), (points.swapaxes(0, 1), VERMILION)):
            axes.plot(lines[..., 0].T, lines[..., 1].T, color=colour, linewidth=0.6)
        axes.set(title=title, xlabel=x, ylabel=y, aspect="equal")
        axes.xaxis.set_inverted(view.seen_from == "lens")
    view.note(figure)
    return figure


# --- time -------------------------------------------------------------------------------------------------------------


@styled
def convergence(history: Sequence[CurvePoint], stages: Sequence[StageRecord], noise: float) -> Figure:
    """Draw the RRMSD over time (s): a curve per stage, a ring at the end of each, and the standard error `noise`."""
    seconds, values = np.array([(point.seconds, point.rrmsd) for point in history], dtype=float).T
    ends = np.cumsum([0.0, *(stage.seconds for stage in stages)])
    after = np.isin(values, [stage.rrmsd for stage in stages if stage.rrmsd is not None])
    stage_of = np.where(after, -1, np.searchsorted(ends, seconds))
    figure = new_figure(5.2, 3.5)
    axes = figure.subplots()
    style = {"color": BLUE, "marker": "." if len(values) < 100 else "", "markersize": 4}
    for each in np.unique(stage_of[~after]):
        part = stage_of == each
        axes.plot(seconds[part], values[part], **style, label="" if axes.lines else "within a stage")
    if after.any():
        rings = {"linestyle": "", "marker": "o", "markerfacecolor": "none", "color": VERMILION}
        axes.plot(seconds[after], values[after], **rings, label="after a stage, by new rays")
        figure.legend(loc="outside lower center", ncols=2)
    axes.set(yscale="log", xlabel="time (s)", ylabel="RRMSD on pixels")
    visible = noise > values.min() / 20  # otherwise it is far below the curve
    axes.set_ylim(0.7 * min(values.min(), noise if visible else np.inf), 1.2 * values.max())
    if visible:
        axes.axhline(noise, color=GREY, linestyle="--", linewidth=0.9)
        right_end = axes.get_yaxis_transform()
        axes.text(0.99, noise * 1.05, "standard error", transform=right_end, ha="right", color=GREY, fontsize=8)
    last = 1.02 * max(seconds.max(), ends[-1])
    axes.set_xlim(0.0, last)
    for end in ends[1:]:
        axes.axvline(end, color=GREY, linewidth=0.6, linestyle=":")
    parts = zip((stage.stage for stage in stages), ends, ends[1:], strict=False)
    for name, rounds in groupby(parts, key=itemgetter(0)):
        (_, start, end), *others = rounds
        end = others[-1][2] if others else end
        if end - start > 0.0165 * len(name) * last:  # its name fits above the frame
            above = {"transform": axes.get_xaxis_transform(), "ha": "center", "color": GREY, "fontsize": 8}
            axes.text((start + end) / 2, 1.015, name, **above)
    plain_ticks(axes.yaxis, *axes.get_ylim())
    axes.grid(axis="y", which="both")
    return figure


# --- a lens at work ---------------------------------------------------------------------------------------------------


def light_path_of(design: Nominal, irradiances: Sequence[np.ndarray]) -> RayPath | None:
    """Return lens, rays and pictures for `bstcad show`; None if no light reaches the furthest target.

    irradiances: on each target, (rows, columns).
    """
    lens, emitter, views = design.lens, design.emitter, _views_of(design)
    screens = [drawn(goal.screen, lens) for goal in design.goals]
    receiver = max(screens, key=lambda screen: screen.receiver.throw(0.0)).receiver
    rays, flux = bundle(emitter.central, lens, receiver, RAYS)
    if not len(rays):
        return None
    mesh = meshes.lens_mesh(lens, LIGHT_PATH_CELLS)
    of = "from the centre of the source" if emitter.extent is not None else "from the source"
    lit = zip(views, irradiances, design.goals, strict=True)
    return RayPath(
        vertices=mesh.vertices,
        faces=mesh.faces,
        rays=rays,
        flux=MILLIONTHS * flux,
        screens=tuple(map(corners, screens)),
        pictures=tuple(view.tones(light, goal.picture) for view, light, goal in lit),
        lamp=rays[:1, 0] if np.ptp(rays[:, 0], axis=0).max() < 1e-6 else np.empty((0, 3)),
        seen_along=1 if views[0].seen_from == "lens" else -1,
        mirror=not lens.passes.enters,
        title=design.scene.title or design.scene.name,
        words=f"{_sizes([goal.screen for goal in design.goals])}\n{len(rays)} rays {of}, true to scale",
    )


def _views_of(design: Nominal) -> list[View]:
    """Return the view of each target of a design."""
    return [View.of(design.scene, number) for number in range(len(design.goals))]


def _sizes(screens: Sequence[Screen]) -> str:
    """Return the sizes and positions of the targets in words."""
    sizes = (
        f"{number(x[1] - x[0])} × {number(y[1] - y[0])} {plane.unit} at {plane.position_text()}"
        for plane, x, y in ((screen.receiver, screen.x, screen.y) for screen in screens)
    )
    return f"Target{'s' * (len(screens) > 1)} {', '.join(sizes)}"


def drawn(screen: Screen, lens: Lens) -> Screen:
    """Return the screen as pictures show it: directions at a distance of a few lens widths."""
    place = screen.receiver.drawn(2 * max(lens.plan.half_extent), lens.back.z)
    return screen if place == screen.receiver else replace(screen, surface=place)


def corners(screen: Screen) -> np.ndarray:
    """Return the corners of a screen in space (4, 3), mm, in order around it from x min, y min."""
    around = [screen.receiver.point(x, y) for y, x in product(screen.y, screen.x)]
    return np.array(around)[[0, 1, 3, 2]]
