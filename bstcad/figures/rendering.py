"""Three-dimensional pictures: the lens in clay, the lens with its rays, and a model that a reader can rotate.

Without a display, EGL or OSMesa, VTK ends the whole process with a segmentation fault and writes its messages to the
terminal.  To protect the design, this file runs itself as a script in another process.  The script reads arrays from a
file and draws them into a PNG or a window.
"""

from __future__ import annotations

import base64
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from bstcad.cad.mesh import Mesh
    from bstcad.optics.lens.lens import Lens
    from bstcad.optics.surfaces.outlines import Outline
    from bstcad.optics.surfaces.surfaces import Surface

PATIENCE = 120.0  # timeout of a picture (seconds)
FEATURE_ANGLE = 35.0  # angle between facets above which their edge is drawn sharp (degrees)

# The lens in clay.
PICTURE_SIZE = (1120, 800)  # size of the picture (pixels)
CLAY = "#d3d9e0"
# Lights: (direction from the lens to the light, intensity) each.
CLAY_LIGHTS = (((-1.0, 0.5, 0.7), 0.8), ((0.5, -1.0, 0.35), 0.5), ((0.1, -0.2, 1.0), 0.25))
FINISH = {"ambient": 0.12, "diffuse": 0.9, "specular": 0.2, "specular_power": 30.0}  # reflection of light by the clay
EYE = (0.75, -1.5, 1.7)  # position of the eye relative to the centre, in diagonals of the bounding box
VIEW_ANGLE = 26.0  # vertical angle of view of the lens in clay (degrees)

# The lens with its rays, in two views: the lens close up, and the whole path.
WINDOW = (1920, 1080)  # size of the window (pixels)
VIEW_WIDTHS = (5, 9)  # relative widths of the two views
GROUND, INK, SOFT = "#0e1116", "#e6eaee", "#8b96a1"  # colours of the background, of the title, of captions and frames
GLASS_FINISH = {"color": "#b9d4ea", "specular": 0.9, "opacity": 0.42}
METAL_FINISH, LAMP = {"color": "#9aa3ad", "specular": 0.4}, "#fff3c4"
DARKEST = 0.35  # place (0 to 1) of zero flux in the colour map, whose darker colours vanish on the dark background
ASIDE = (0.95, 0.42, 0.62)  # direction (x, y, z) to the eye for the whole path; z is multiplied by -seen_along
NEAR = (0.9, 0.5, 0.75)  # direction (x, y, z) to the eye in the close view, which shows the back
TITLE_WIDTH = 46  # largest number of letters per line of the title
PATH_ANGLE = 24.0  # vertical angle of view in both views (degrees)
PATH_FILL, LENS_FILL = 0.88, 0.6  # fraction of a view filled by the whole path, and by the lens close up
SCREEN_OPACITY = 0.8  # opacity of a screen in front of another one
RAY_REACH, RAY_STEP = 2.0, 5  # close view: rays end at most 2 diagonals of the lens away; every fifth ray is drawn

# The model that a reader can rotate.
FINE, COARSE = 256, 64  # cells per axis of a net, and of a surface without knots
MAX_MODEL_RAYS = 200  # largest number of rays in the model
POSITION_DECIMALS, FLUX_DECIMALS = 4, 3  # decimals of a position (mm), and of a relative flux
STEPS = 65535  # largest 16-bit integer: a range of values has this number of steps
MIN_COSINE = 0.02  # smallest n_z of normals, which are stated as slopes; steeper parts look upright
MIN_RANGE = 1e-9  # lower bound of a range, for values that are all equal (mm, or a slope)


_drawing: list[subprocess.Popen] = []  # processes that are drawing


def lens_picture(mesh: Mesh) -> bytes | None:
    """Return a PNG of the solid in matt clay, seen from the side of the back, on a transparent background.

    None: this machine cannot draw in 3-D (no display, EGL or OSMesa).
    """
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder, "lens.png")
        done = _run({"vertices": mesh.vertices, "faces": mesh.faces}, str(picture), PATIENCE)
        return picture.read_bytes() if done and picture.exists() else None


def draw(path: RayPath, picture: Path | None) -> bool:
    """Draw into the PNG `picture`, or if None in a window until it closes; False: this machine cannot draw in 3-D."""
    given = vars(path).items()
    arrays = {name: np.asarray(value) for name, value in given if not isinstance(value, tuple)}
    arrays |= {f"{name} {k}": each for name, value in given if isinstance(value, tuple) for k, each in enumerate(value)}
    return _run(arrays, "", None) if picture is None else _run(arrays, str(picture), PATIENCE)


def _run(arrays: Mapping[str, np.ndarray], picture: str, patience: float | None) -> bool:
    """Run `main` in another process; return True if it succeeded within `patience` seconds (None: without a limit)."""
    with tempfile.TemporaryDirectory() as folder:
        given = Path(folder, "arrays.npz")
        np.savez(given, **arrays)
        # -P keeps this folder, with its report.py and units.py, off the import path.
        command = [sys.executable, "-P", __file__, str(given), picture]
        # With this variable pyvista omits its test for a display; without a display the process ends.
        env = os.environ | {"ALLOW_PLOTTING": "true"}
        try:
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=env) as drawing:
                _drawing.append(drawing)
                try:
                    return drawing.wait(patience) == 0
                finally:
                    _drawing.remove(drawing)
                    drawing.kill()
        except (OSError, subprocess.TimeoutExpired):
            return False


def stop() -> None:
    """End the processes that are drawing."""
    for drawing in tuple(_drawing):
        drawing.kill()


def main(arrays: str, picture: str) -> None:
    """Draw the mesh or LightPath in `arrays` (npz) into `picture` (PNG), or in a window if `picture` is empty."""
    with np.load(arrays, allow_pickle=False) as found:
        values: dict[str, Any] = {name: value if value.ndim else value.item() for name, value in found.items()}
    if "rays" not in values:
        from PIL import Image

        image = Image.fromarray(draw_clay(values["vertices"], values["faces"]))
        image.crop(image.getchannel("A").getbbox()).save(picture)
        return
    for name in [name for name in values if " " in name]:  # elements of a tuple, in their order
        values[name.split()[0]] = (*values.get(name.split()[0], ()), values.pop(name))
    plotter = plotter_of(RayPath(**values), off_screen=bool(picture))
    if picture:
        plotter.screenshot(picture)
    else:
        plotter.show()


def draw_clay(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return an RGBA image (rows, columns, 4) of triangles `faces` (n, 3) on `vertices` (k, 3; mm), back upwards.

    VTK is called without pyvista, whose import takes longer than the picture.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkRenderingCore import (
        vtkActor,
        vtkLight,
        vtkPolyDataMapper,
        vtkRenderer,
        vtkRenderWindow,
        vtkWindowToImageFilter,
    )
    from vtkmodules.vtkRenderingOpenGL2 import vtkRenderStepsPass, vtkSSAAPass

    points, triangles, solid, mapper = vtkPoints(), vtkCellArray(), vtkPolyData(), vtkPolyDataMapper()
    points.SetData(numpy_to_vtk(vertices.astype(np.float32)))
    triangles.SetData(3, numpy_to_vtkIdTypeArray(faces.astype(np.int64).ravel()))
    solid.SetPoints(points)
    solid.SetPolys(triangles)
    mapper.SetInputData(solid)
    actor, renderer, window = vtkActor(), vtkRenderer(), vtkRenderWindow()
    actor.SetMapper(mapper)
    actor.GetProperty().SetInterpolationToFlat()
    actor.GetProperty().SetColor(_clay())
    for name, value in FINISH.items():
        getattr(actor.GetProperty(), f"Set{name.title().replace('_', '')}")(value)
    renderer.AddActor(actor)
    centre = (vertices.min(0) + vertices.max(0)) / 2
    reach = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    renderer.AutomaticLightCreationOff()
    # The relief is shallow, so the key light grazes the back surface; the fill light keeps the sides visible.
    for towards, bright in CLAY_LIGHTS:
        light = vtkLight()
        light.SetLightTypeToSceneLight()
        light.SetPosition(centre + 10 * reach * np.array(towards))
        light.SetFocalPoint(centre)
        light.SetIntensity(bright)
        renderer.AddLight(light)
    camera = renderer.GetActiveCamera()
    camera.SetPosition(centre + reach * np.array(EYE))
    camera.SetFocalPoint(centre)
    camera.SetViewUp(0.0, 0.0, 1.0)
    camera.SetViewAngle(VIEW_ANGLE)
    renderer.ResetCameraClippingRange()
    finer, steps = vtkSSAAPass(), vtkRenderStepsPass()
    finer.SetDelegatePass(steps)
    renderer.SetPass(finer)
    renderer.SetBackground(1.0, 1.0, 1.0)
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetAlphaBitPlanes(True)
    window.SetSize(PICTURE_SIZE)
    window.AddRenderer(renderer)
    window.Render()
    shot = vtkWindowToImageFilter()
    shot.SetInput(window)
    shot.SetInputBufferTypeToRGBA()
    shot.ReadFrontBufferOff()
    shot.ShouldRerenderOff()
    shot.Update()
    columns, rows, _ = shot.GetOutput().GetDimensions()
    return vtk_to_numpy(shot.GetOutput().GetPointData().GetScalars()).reshape(rows, columns, 4)[::-1].copy()


def _clay() -> list[float]:
    """Return red, green and blue of CLAY, each from 0 to 1."""
    return [int(CLAY[k : k + 2], 16) / 255 for k in (1, 3, 5)]


def _solid(vertices: np.ndarray, faces: np.ndarray) -> Any:
    import pyvista

    solid = pyvista.PolyData.from_regular_faces(vertices.astype(np.float32), faces)
    return solid.compute_normals(split_vertices=True, feature_angle=FEATURE_ANGLE, consistent_normals=False)


def _add_lights(plotter: Any, lights: Iterable[tuple[Any, float]], centre: Any) -> None:
    """Add lights, (position, intensity) each, that shine towards the centre."""
    import pyvista

    for position, intensity in lights:
        light = pyvista.Light(position=position, focal_point=centre, color="white", light_type="scene light")
        light.intensity = intensity
        plotter.add_light(light)


# --- the lens with its rays -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RayPath:
    """Solid, rays coloured by their flux, and screens with their pictures; lengths in mm."""

    vertices: np.ndarray  # vertices of the lens, (n, 3)
    faces: np.ndarray  # vertex indices of its triangles, (k, 3)
    rays: np.ndarray  # points of each ray from the source via the faces to the furthest screen, (rays, points, 3)
    flux: np.ndarray  # flux of each ray at its end, (rays,), in millionths of the source's light
    screens: tuple[np.ndarray, ...]  # corners of each screen, (4, 3), around it from (x min, y min) via (x max, y min)
    pictures: tuple[np.ndarray, ...]  # tones of the irradiance on each screen, (rows, columns) uint8, row 0 at y max
    lamp: np.ndarray  # position of a point source, (1, 3); otherwise (0, 3)
    seen_along: int  # +1: the picture is seen along +z, from the side of the source; -1: from behind the screen
    mirror: bool  # True if no light enters the solid
    title: str
    words: str  # caption of one or two lines


def plotter_of(path: RayPath, off_screen: bool) -> Any:
    """Return a pyvista plotter with two views: the lens close up at the left, the whole path at the right, to scale."""
    import pyvista

    plotter = pyvista.Plotter(
        shape=(1, 2), col_weights=list(VIEW_WIDTHS), off_screen=off_screen, window_size=list(WINDOW), border=False,
        lighting="none", title=f"bstcad: {path.title}",
    )  # fmt: skip
    plotter.set_background(GROUND)
    solid = _solid(path.vertices, path.faces)
    plotter.subplot(0, 1)
    _add_lens(plotter, solid, path)
    drawn = _add_rays(plotter, path.rays, path.flux, min(0.35, 100 / len(path.rays)))
    if np.ptp(path.flux) > 1e-3 * path.flux.max():
        plotter.add_scalar_bar(
            "flux of a ray, in millionths of the source's light\n", mapper=drawn, color=SOFT, title_font_size=16,
            label_font_size=15, n_labels=3, fmt="%.4g", width=0.4, height=0.08, position_x=0.57, position_y=0.02,
        )  # fmt: skip
    *near, last = sorted(zip(path.screens, path.pictures, strict=True), key=lambda pair: pair[0][:, 2].mean())
    for screen, picture in near:
        _add_screen(plotter, screen, picture, SCREEN_OPACITY)
    _add_screen(plotter, *last)
    _add_text(plotter, path.words, (0.02, 0.03), size=10, colour=SOFT)
    everything = np.concatenate([path.vertices, path.rays.reshape(-1, 3), *path.screens])
    _frame(plotter, everything, path, np.multiply(ASIDE, [1, 1, -path.seen_along]), filled=PATH_FILL)
    plotter.subplot(0, 0)
    _add_lens(plotter, solid, path)
    _add_rays(plotter, _close_rays(path), path.flux[::RAY_STEP], 0.8)
    title = textwrap.wrap(path.title, TITLE_WIDTH, max_lines=2, placeholder=" …")
    _add_text(plotter, "\n".join(title), (0.03, 0.97 - 0.03 * len(title)), size=13, colour=INK)
    _frame(plotter, path.vertices, path, np.array(NEAR), filled=LENS_FILL)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def _add_text(plotter: Any, words: str, place: tuple[float, float], size: int, colour: str) -> None:
    import matplotlib

    font = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")  # has more characters than VTK's own font
    plotter.add_text(words, position=place, viewport=True, font_size=size, color=colour, font_file=str(font))


def _close_rays(path: RayPath) -> np.ndarray:
    """Return every RAY_STEP-th ray, cut to RAY_REACH diagonals of the lens before its first and after its last face."""
    reach = RAY_REACH * np.linalg.norm(np.ptp(path.vertices, axis=0))
    rays = path.rays[::RAY_STEP].copy()
    for end, before in ((0, 1), (-1, -2)):
        segment = rays[:, end] - rays[:, before]
        length = np.linalg.norm(segment, axis=1, keepdims=True)
        rays[:, end] = rays[:, before] + segment * np.minimum(1.0, reach / np.maximum(length, 1e-12))
    return rays


def _add_lens(plotter: Any, solid: Any, path: RayPath) -> None:
    """Add the solid of transparent glass or of metal, two lights, and a sphere at a point source."""
    import pyvista

    finish = METAL_FINISH if path.mirror else GLASS_FINISH
    plotter.add_mesh(solid, ambient=0.15, diffuse=0.75, specular_power=40, **finish)
    only = {"boundary_edges": False, "non_manifold_edges": False, "manifold_edges": False}
    edges = solid.extract_feature_edges(FEATURE_ANGLE, **only)
    if edges.n_cells:
        plotter.add_mesh(edges, color=INK, line_width=1.2, opacity=0.7, lighting=False)
    _add_lights(plotter, (((-1.0, 1.0, 0.7), 0.9), ((0.8, 0.3, -1.0), 0.5)), (0, 0, 0))
    size = 0.02 * np.linalg.norm(np.ptp(path.vertices, axis=0))
    for place in path.lamp:
        plotter.add_mesh(pyvista.Sphere(size, center=place), color=LAMP, lighting=False)


def _add_rays(plotter: Any, rays: np.ndarray, flux: np.ndarray, opacity: float) -> Any:
    """Add rays as lines in the colours of their flux; return the mapper of the colours."""
    import pyvista
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    count, stops, _ = rays.shape
    lines = np.column_stack([np.full(count, stops), np.arange(count * stops).reshape(count, stops)])
    bundle = pyvista.PolyData(rays.reshape(-1, 3).astype(np.float32), lines=lines.ravel())
    bundle.cell_data["flux"] = flux
    colours = ListedColormap(colormaps["inferno"](np.linspace(DARKEST, 0.95, 128)))
    drawn = plotter.add_mesh(
        bundle, scalars="flux", cmap=colours, clim=(0.0, float(flux.max())), lighting=False, line_width=1.5,
        opacity=opacity, show_scalar_bar=False,
    )  # fmt: skip
    return drawn.mapper


def _add_screen(plotter: Any, screen: np.ndarray, picture: np.ndarray, opacity: float = 1.0) -> None:
    """Add the picture on a screen, and its frame.  screen, picture: see LightPath."""
    import pyvista

    quad = pyvista.PolyData(screen.astype(np.float32), faces=[4, 0, 1, 2, 3])
    quad.active_texture_coordinates = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    texture = pyvista.Texture(np.repeat(picture[..., None], 3, axis=2))
    texture.interpolate = True
    plotter.add_mesh(quad, texture=texture, lighting=False, opacity=opacity)
    border = pyvista.lines_from_points(screen[[0, 1, 2, 3, 0]].astype(np.float32))
    plotter.add_mesh(border, color=SOFT, line_width=1.5, lighting=False)


def _frame(plotter: Any, points: np.ndarray, path: RayPath, towards: np.ndarray, filled: float) -> None:
    """Look from direction `towards` (`_clear_of_screen`), y up; the points fill the fraction `filled` of the view."""
    towards = _clear_of_screen(path, towards)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(towards, right), towards])
    left, low, wide, high = plotter.renderer.GetViewport()
    half = np.tan(np.radians(PATH_ANGLE / 2)) * filled
    half = np.array([half * WINDOW[0] * (wide - left) / (WINDOW[1] * (high - low)), half])
    seen = points @ axes.T
    middle, far = (seen.min(axis=0) + seen.max(axis=0)) / 2, 0.0
    for _ in range(20):  # near points look larger, so that the centre of the view depends on the distance of the eye
        across, ahead = seen[:, :2] - middle[:2], seen[:, 2:]
        far = float((ahead + np.abs(across) / half).max())
        spread = across / (far - ahead)
        middle[:2] += (spread.min(axis=0) + spread.max(axis=0)) / 2 * (far - middle[2])
    camera = plotter.camera
    camera.view_angle = PATH_ANGLE
    camera.focal_point = middle @ axes
    camera.position = np.array([*middle[:2], far]) @ axes
    camera.up = (0.0, 1.0, 0.0)
    plotter.reset_camera_clipping_range()


def _clear_of_screen(path: RayPath, towards: np.ndarray) -> np.ndarray:
    """Return `towards` as a unit vector; the sign of x is such that the first screen does not cover the lens."""
    offset = path.screens[0][:, 0].mean() - path.vertices[:, 0].mean()
    return towards * [-1 if offset > 0 else 1, 1, 1] / np.linalg.norm(towards)


# --- the model that a reader can rotate -------------------------------------------------------------------------------


def turnable(lens: Lens, path: RayPath | None = None, cells: int = FINE) -> str:
    """Return the JSON for solid_view.js: the faces in mm, the lamps that shade them, and the rays of `path`.

    cells: cells of a net per axis, even; fewer for a preview that is sent often (256: 0.9 MB, 96: 0.2 MB).

    The result is "" if a face is not finite everywhere, as in a damaged file.  solid_view.js draws in plain WebGL,
    since a solid of one material needs a shader of twenty lines, not a library of 0.6 to 1 MB.  The slopes are those of
    the surface, not of the triangles, so that the shading is exact at any distance.

    The key `values` is base64 of 16-bit integers, low byte first, each a fraction of the range of its coordinate.
    For each face these are the positions x, y, z of (cells + 1)² nodes and their slopes along x and y; then x, y, z of
    the front and z of the back around the rim.  A path adds the keys of `_light`.
    """
    from bstcad.cad.grids import nodes, rim
    from bstcad.optics.lens.base import on_base
    from bstcad.optics.surfaces.surfaces import points_and_normals, points_on, sag

    def on_face(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return x, y, z (mm), ∂z/∂x and ∂z/∂y of a face at nodes (x, y) (mm) of its chart, (5, rows, columns)."""
        points, normals = points_and_normals(surface, x, y)
        slopes = -normals[..., :2] / np.maximum(normals[..., 2:], MIN_COSINE)
        return np.moveaxis(np.concatenate([points, slopes], axis=-1), -1, 0)

    def at_nodes(surface: Surface) -> np.ndarray:
        """Return the values of `on_face` at the nodes of a face inside its outline, or inside the rim of the lens."""
        smooth = min(COARSE, cells) if math.isinf(surface.detail) else cells
        if surface.outline is not None:
            return on_face(surface.optical, *nodes(surface.outline, smooth))
        x, y = nodes(lens.outline, smooth)
        if surface.chart != lens.back.chart:  # a plane front, which ends below the rim: rings between axis and rim
            k = np.abs(np.linspace(-1.0, 1.0, smooth + 1))
            ring = np.maximum(k[:, None], k)
            x, y = ring * below_rim(np.stack([x, y]) / np.maximum(ring, 1e-12))
        return on_face(surface, x, y)

    def on_rim(outline: Outline, cells: int) -> np.ndarray:
        """Return x and y (mm) of the nodes once around an outline, (2, 4 cells)."""
        x, y = nodes(outline, cells)
        at = rim(np.arange(x.size).reshape(x.shape))
        return np.stack([x.ravel()[at], y.ravel()[at]])

    def around(plane: Surface, inner: Outline) -> Iterator[np.ndarray]:
        """Yield the quarters of a plane between `inner` and the outline of the lens, in the form of `at_nodes`."""
        begin, end = on_rim(inner, COARSE)[:, None], below_rim(on_rim(lens.outline, COARSE))[:, None]
        places = begin + np.linspace(0, 1, COARSE + 1)[:, None] * (end - begin)
        for k in range(4):
            yield on_face(plane, *places[:, :, np.arange(k * COARSE, (k + 1) * COARSE + 1) % (4 * COARSE)])

    def below_rim(places: np.ndarray) -> np.ndarray:
        """Return x and y (2, …) (mm) in space of places (2, …) (mm) on the rim in the back's chart."""
        return np.moveaxis(points_on(lens.back, *places)[..., :2], -1, 0)

    lens = on_base(lens.plain())
    faces = [at_nodes(lens.back), at_nodes(lens.front)]
    if lens.front.outline is not None:
        faces += around(lens.front.around, lens.front.outline)
    x, y, high = points_on(lens.back, *on_rim(lens.outline, cells)).T
    wall = np.stack([x, y, sag(lens.front, x, y), high])
    places = np.concatenate([*(face[:3].reshape(3, -1) for face in faces), wall[:3], wall[[0, 1, 3]]], axis=1)
    if not np.isfinite(places).all():
        return ""
    low, size = places.min(axis=1), np.maximum(np.ptp(places, axis=1), MIN_RANGE)
    shapes, values = [], []
    for number, face in enumerate(faces):
        steepest = max(float(np.abs(face[3:]).max()), MIN_RANGE)
        shapes.append({"cells": face.shape[1] - 1, "up": -1 if number else 1, "steepest": steepest})
        values += [_steps(face[k], low[k], size[k]) for k in range(3)]
        values += [_steps(face[k], -steepest, 2 * steepest) for k in (3, 4)]
    values += [_steps(wall[k], low[min(k, 2)], size[min(k, 2)]) for k in range(4)]
    numbers = base64.b64encode(np.concatenate(values).tobytes()).decode()
    shape = {"low": low.tolist(), "size": size.tolist(), "faces": shapes, "rim": wall.shape[1]}
    lit = {"eye": EYE, "angle": VIEW_ANGLE, "clay": _clay()}
    lit |= {"lamps": [direction for direction, _ in CLAY_LIGHTS], "bright": [intensity for _, intensity in CLAY_LIGHTS]}
    light = {} if path is None else _light(path)
    return json.dumps(shape | lit | FINISH | {"values": numbers} | light)


def _light(path: RayPath) -> dict[str, Any]:
    """Return a light path as JSON values; positions in mm.

    rays: at most MAX_MODEL_RAYS rays, each with its points from the source to the furthest screen.  flux: flux of each
    ray, 1 for the brightest.  screens: corners as in LightPath, and the picture as a data URL, row 0 at y max.
    lamp, mirror: as in LightPath.  aside: direction to the eye for the whole path, y up.
    """
    every = math.ceil(len(path.rays) / MAX_MODEL_RAYS) | 1  # odd, since an even step would omit whole columns of rays
    rays, flux = path.rays[::every], path.flux[::every] / path.flux.max()
    return {
        "rays": np.round(rays, POSITION_DECIMALS).tolist(),
        "flux": np.round(flux, FLUX_DECIMALS).tolist(),
        "screens": [
            {"corners": np.round(screen, POSITION_DECIMALS).tolist(), "picture": data_url(picture)}
            for screen, picture in zip(path.screens, path.pictures, strict=True)
        ],
        "lamp": np.round(path.lamp, POSITION_DECIMALS).tolist(),
        "mirror": bool(path.mirror),
        "aside": _clear_of_screen(path, np.multiply(ASIDE, [1, 1, -path.seen_along])).tolist(),
    }


def data_url(picture: np.ndarray) -> str:
    """Return tones (rows, columns) uint8 as a PNG in a data URL."""
    from PIL import Image

    png = io.BytesIO()
    Image.fromarray(picture).save(png, "PNG")
    return f"data:image/png;base64,{base64.b64encode(png.getvalue()).decode()}"


def _steps(values: np.ndarray, low: float, size: float) -> np.ndarray:
    """Return values as 16-bit integers: 0 for `low`, STEPS for `low + size`."""
    return np.rint((values.ravel() - low) * (STEPS / size)).astype("<u2")


if __name__ == "__main__":
    main(*sys.argv[1:])
