"""A lens at work in space: the solid, rays coloured by their flux, and the screen with its picture.

Drawn in a process of its own, as in rendering.py: `draw` runs this file as a script, which opens a window or writes a
PNG.  At the left the lens from near by; at the right all of the way, true to scale.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SIZE = (1920, 1080)  # pixels
SHARES = (5, 9)  # of the width: the lens from near by, all of the way
GROUND, INK, SOFT = "#0e1116", "#e6eaee", "#8b96a1"
GLASS, METAL, LAMP = "#b9d4ea", "#9aa3ad", "#fff3c4"
FLUX = "inferno"  # from little to much
DARKEST = 0.35  # of the colours of flux: the least of it is still seen on the dark ground
ASIDE = (0.95, 0.42, 0.62)  # towards the eye: sideways, up, and along the axis to the picture's side
NEAR = (0.9, 0.5, 0.75)  # the same of the lens from near by, whose back faces the eye
TITLE = 46  # letters of a line of it
VIEW_ANGLE = 24.0  # degrees, from the lower to the upper edge
FILLED, ROOM = 0.88, 0.6  # of a view: what is looked at, and a lens with room for its rays
AHEAD = 2.0  # diagonals of the lens that the rays are drawn for from near by


@dataclass(frozen=True, eq=False)
class LightPath:
    """The geometry of the picture, mm."""

    vertices: np.ndarray  # (n, 3), of the lens
    faces: np.ndarray  # (k, 3), vertices of its triangles
    rays: np.ndarray  # (rays, stops, 3), from the source over the faces to the screen
    flux: np.ndarray  # (rays,) that each arrives with, in millionths of the source's light
    few: np.ndarray  # (fewer rays, stops, 3), to be seen from near by
    few_flux: np.ndarray  # (fewer rays,) in the same unit
    screen: np.ndarray  # (4, 3), its corners: (x min, y min), (x max, y min), (x max, y max), (x min, y max)
    picture: np.ndarray  # (rows, columns) uint8, the tones of its irradiance; row 0 at y max
    lamp: np.ndarray  # (0 or 1, 3), a point source
    seen_along: int  # +1: the picture is seen from where the light comes from, along +z; -1: from behind the screen
    mirror: bool
    title: str
    words: str  # a caption of a line or two


def draw(path: LightPath, picture: Path | None) -> bool:
    """Write `picture` (PNG), or open a window until it is closed; False where this machine cannot."""
    from bstcad.report import rendering

    arrays = {name: np.asarray(value) for name, value in vars(path).items()}
    if picture is None:
        return rendering.run_in_subprocess(__file__, arrays, "", None)
    return rendering.run_in_subprocess(__file__, arrays, str(picture), rendering.PATIENCE)


def plotter_of(path: LightPath, off_screen: bool) -> Any:
    """A pyvista plotter of both views."""
    import pyvista

    plotter = pyvista.Plotter(
        shape=(1, 2), col_weights=list(SHARES), off_screen=off_screen, window_size=list(SIZE), border=False,
        lighting="none", title=f"bstcad: {path.title}",
    )  # fmt: skip
    plotter.set_background(GROUND)
    solid = pyvista.PolyData.from_regular_faces(path.vertices.astype(np.float32), path.faces)
    solid = solid.compute_normals(split_vertices=True, feature_angle=35.0, consistent_normals=False)
    plotter.subplot(0, 1)
    _lens(plotter, solid, path.mirror)
    drawn = _rays(plotter, path.rays, path.flux, min(0.35, 100 / len(path.rays)))
    if np.ptp(path.flux) > 1e-3 * path.flux.max():
        _scale(plotter, drawn)
    _lamp(plotter, path)
    _screen(plotter, path)
    _say(plotter, path.words, (0.02, 0.03), size=10, colour=SOFT)
    everything = np.concatenate([path.vertices, path.rays.reshape(-1, 3), path.screen])
    _frame(plotter, everything, path, np.multiply(ASIDE, [1, 1, -path.seen_along]), filled=FILLED)
    plotter.subplot(0, 0)
    _lens(plotter, solid, path.mirror)
    _rays(plotter, _near(path), path.few_flux, 0.8)
    _lamp(plotter, path)
    title = textwrap.wrap(path.title, TITLE, max_lines=2, placeholder=" …")
    _say(plotter, "\n".join(title), (0.03, 0.97 - 0.03 * len(title)), size=13, colour=INK)
    _frame(plotter, path.vertices, path, np.array(NEAR), filled=ROOM)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def _say(plotter: Any, words: str, place: tuple[float, float], size: int, colour: str) -> None:
    import matplotlib

    font = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")  # has more letters than VTK's own
    plotter.add_text(words, position=place, viewport=True, font_size=size, color=colour, font_file=str(font))


def _near(path: LightPath) -> np.ndarray:
    """The few rays as far as they are seen from near by the lens."""
    reach = AHEAD * np.linalg.norm(np.ptp(path.vertices, axis=0))
    rays = path.few.copy()
    for end, before in ((0, 1), (-1, -2)):
        way = rays[:, end] - rays[:, before]
        long = np.linalg.norm(way, axis=1, keepdims=True)
        rays[:, end] = rays[:, before] + way * np.minimum(1.0, reach / np.maximum(long, 1e-12))
    return rays


def _lens(plotter: Any, solid: Any, mirror: bool) -> None:
    """The solid under two lamps; of glass, through which the rays are seen, or of metal."""
    import pyvista

    look = {"color": METAL, "specular": 0.4} if mirror else {"color": GLASS, "specular": 0.9, "opacity": 0.42}
    plotter.add_mesh(solid, ambient=0.15, diffuse=0.75, specular_power=40, **look)
    edges = solid.extract_feature_edges(35.0, boundary_edges=False, non_manifold_edges=False, manifold_edges=False)
    if edges.n_cells:
        plotter.add_mesh(edges, color=INK, line_width=1.2, opacity=0.7, lighting=False)
    for direction, intensity in (((-1.0, 1.0, 0.7), 0.9), ((0.8, 0.3, -1.0), 0.5)):
        light = pyvista.Light(position=direction, focal_point=(0, 0, 0), color="white", light_type="scene light")
        light.intensity = intensity
        plotter.add_light(light)


def _rays(plotter: Any, rays: np.ndarray, flux: np.ndarray, opacity: float) -> Any:
    """Lines in the colours of their flux; the mapper of the colours."""
    import pyvista
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    count, stops, _ = rays.shape
    lines = np.column_stack([np.full(count, stops), np.arange(count * stops).reshape(count, stops)])
    bundle = pyvista.PolyData(rays.reshape(-1, 3).astype(np.float32), lines=lines.ravel())
    bundle.cell_data["flux"] = flux
    colours = ListedColormap(colormaps[FLUX](np.linspace(DARKEST, 0.95, 128)))
    drawn = plotter.add_mesh(
        bundle, scalars="flux", cmap=colours, clim=(0.0, float(flux.max())), lighting=False, line_width=1.5,
        opacity=opacity, show_scalar_bar=False,
    )  # fmt: skip
    return drawn.mapper


def _scale(plotter: Any, mapper: Any) -> None:
    """The scale of the rays' colours."""
    plotter.add_scalar_bar(
        "flux of a ray, in millionths of the source's light\n", mapper=mapper, color=SOFT, title_font_size=16,
        label_font_size=15, n_labels=3, fmt="%.4g", width=0.4, height=0.08, position_x=0.57, position_y=0.02,
    )  # fmt: skip


def _lamp(plotter: Any, path: LightPath) -> None:
    import pyvista

    size = 0.02 * np.linalg.norm(np.ptp(path.vertices, axis=0))
    for place in path.lamp:
        plotter.add_mesh(pyvista.Sphere(size, center=place), color=LAMP, lighting=False)


def _screen(plotter: Any, path: LightPath) -> None:
    """The picture at its place, and its frame."""
    import pyvista

    quad = pyvista.PolyData(path.screen.astype(np.float32), faces=[4, 0, 1, 2, 3])
    quad.active_texture_coordinates = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    picture = pyvista.Texture(np.repeat(path.picture[..., None], 3, axis=2))
    picture.interpolate = True
    plotter.add_mesh(quad, texture=picture, lighting=False)
    border = pyvista.lines_from_points(path.screen[[0, 1, 2, 3, 0]].astype(np.float32))
    plotter.add_mesh(border, color=SOFT, line_width=1.5, lighting=False)


def _frame(plotter: Any, points: np.ndarray, path: LightPath, towards: np.ndarray, filled: float) -> None:
    """Have all of the points in the view, y up, from the side that the screen is not off to."""
    off = path.screen[:, 0].mean() - path.vertices[:, 0].mean()
    towards = towards * [-1 if off > 0 else 1, 1, 1] / np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(towards, right), towards])
    left, low, wide, high = plotter.renderer.GetViewport()
    half = np.tan(np.radians(VIEW_ANGLE / 2)) * filled
    half = np.array([half * SIZE[0] * (wide - left) / (SIZE[1] * (high - low)), half])
    seen = points @ axes.T
    middle, far = (seen.min(axis=0) + seen.max(axis=0)) / 2, 0.0
    for _ in range(20):  # what is near looks larger, so that the middle of what is seen shifts as the eye draws near
        across, ahead = seen[:, :2] - middle[:2], seen[:, 2:]
        far = float((ahead + np.abs(across) / half).max())
        spread = across / (far - ahead)
        middle[:2] += (spread.min(axis=0) + spread.max(axis=0)) / 2 * (far - middle[2])
    camera = plotter.camera
    camera.view_angle = VIEW_ANGLE
    camera.focal_point = middle @ axes
    camera.position = np.array([*middle[:2], far]) @ axes
    camera.up = (0.0, 1.0, 0.0)
    plotter.reset_camera_clipping_range()


def main(arrays: str, picture: str) -> None:
    """Draw what `arrays` (npz) holds: into `picture` (PNG), or in a window if that is empty."""
    with np.load(arrays, allow_pickle=False) as found:
        told: Mapping[str, Any] = {name: value if value.ndim else value.item() for name, value in found.items()}
    plotter = plotter_of(LightPath(**told), off_screen=bool(picture))
    if picture:
        plotter.screenshot(picture)
    else:
        plotter.show()


if __name__ == "__main__":
    main(*sys.argv[1:])
