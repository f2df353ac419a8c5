"""What `bstcad show` draws of a design: its lens, rays through it, and the picture that they make."""

from __future__ import annotations

import os
import sys
import tempfile
from itertools import product
from pathlib import Path

import numpy as np

from bstcad import files
from bstcad.analysis.ray_fan import bundle
from bstcad.cad.mesh import lens_mesh
from bstcad.optics.irradiance import Screen
from bstcad.optics.planes import TiltedPlane
from bstcad.report import light_path
from bstcad.report.light_figures import brightest
from bstcad.report.light_path import LightPath
from bstcad.report.units import number
from bstcad.runs import folder as folders
from bstcad.scene.errors import MachineError, SceneError
from bstcad.scene.tones import to_srgb

CELLS = 200  # of the mesh, each way
RAYS, FEW = 28, 12  # each way, over the light that gets through the lens; and from near by
MILLIONTHS = 1e6


def show(folder: Path, png: Path | None) -> None:
    """Write the picture of a design at work to `png`, or open a window with it and wait until it is closed."""
    if png is None and not _has_display():
        raise MachineError("this machine has no display to open a window on; give --png FILE for a picture")
    path = light_path_of(folder)
    if png is None:
        if not light_path.draw(path, None):
            raise MachineError("no window could be opened here; give --png FILE for a picture")
        return
    with tempfile.TemporaryDirectory(prefix="bstcad-") as place:
        drawn = Path(place, "light.png")
        if not light_path.draw(path, drawn):
            raise MachineError("this machine cannot draw in three dimensions: it has no display, EGL or OSMesa")
        files.put(png, drawn.read_bytes())


def light_path_of(folder: Path) -> LightPath:
    """What there is to see of the design in a folder."""
    scene, nominal = folders.read_nominal(folder)
    irradiance = folders.read_irradiance(folder, scene)
    source, lens, screen = scene.source.central, nominal.lens, nominal.screen
    rays, flux = bundle(source, lens, screen.plane, RAYS)
    few, few_flux = bundle(source, lens, screen.plane, FEW)
    if not len(few):
        raise SceneError(f"{folder}: no light of this design arrives at the target; there is nothing to show")
    mesh = lens_mesh(lens, CELLS)
    top = brightest(nominal.target, irradiance)
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


def _has_display() -> bool:
    """Linux says by its environment whether there is one; elsewhere there is."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
