"""The 3-D picture of a lens, drawn in a process of its own.

VTK ends the whole process (segmentation fault, not an exception) where it finds neither a display nor EGL nor
OSMesa, and writes its complaints straight to the terminal.  A design that took minutes must not die of its picture,
so `lens_picture` runs this file as a script and reads the PNG back.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from bstcad.cad.mesh import Mesh

SIZE = (1120, 800)  # pixels
CLAY = "#d3d9e0"
LIGHTS = (((-1.0, 0.5, 0.7), 0.8), ((0.5, -1.0, 0.35), 0.5), ((0.1, -0.2, 1.0), 0.25))  # (towards the light, intensity)
FINISH = {"ambient": 0.12, "diffuse": 0.9, "specular": 0.2, "specular_power": 30.0}  # of the clay
EYE = (0.75, -1.5, 1.7)  # where it is seen from, off its centre in diagonals of its bounding box
VIEW_ANGLE = 26.0  # degrees, from the lower to the upper edge
FEATURE_ANGLE = 35.0  # degrees; an edge sharper than this is drawn sharp
PATIENCE = 120.0  # seconds a picture may take


def lens_picture(mesh: Mesh) -> bytes | None:
    """PNG of the solid in matt clay, seen from the back surface's side, on a transparent background.

    None where this machine cannot draw in 3-D (no display, no EGL, no OSMesa): the report then says so.
    """
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder, "lens.png")
        done = run_in_subprocess(__file__, {"vertices": mesh.vertices, "faces": mesh.faces}, str(picture), PATIENCE)
        return picture.read_bytes() if done and picture.exists() else None


def run_in_subprocess(script: str, arrays: Mapping[str, np.ndarray], picture: str, patience: float | None) -> bool:
    """Run a file that draws `arrays` as a script; did it end well, within `patience` seconds?"""
    with tempfile.TemporaryDirectory() as folder:
        given = Path(folder, "arrays.npz")
        np.savez(given, **arrays)
        # -P keeps this folder, with its report.py and checks.py, off the import path.
        command = [sys.executable, "-P", script, str(given), picture]
        # pyvista need not open a window first to see whether it can: if it cannot, that process ends.
        env = os.environ | {"ALLOW_PLOTTING": "true"}
        try:
            return subprocess.run(command, capture_output=True, timeout=patience, check=False, env=env).returncode == 0
        except (OSError, subprocess.TimeoutExpired):
            return False


def render(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """RGBA image (rows, columns, 4) of the triangles `faces` (n, 3) on `vertices` (k, 3) in mm, back surface up."""
    import pyvista

    solid = pyvista.PolyData.from_regular_faces(vertices.astype(np.float32), faces)
    solid = solid.compute_normals(split_vertices=True, feature_angle=FEATURE_ANGLE, consistent_normals=False)
    centre = (vertices.min(0) + vertices.max(0)) / 2
    reach = float(np.linalg.norm(np.ptp(vertices, axis=0)))

    plotter = pyvista.Plotter(off_screen=True, window_size=list(SIZE), lighting="none")
    plotter.add_mesh(solid, color=CLAY, **FINISH)
    # The relief is shallow: the key light grazes the back surface; the fill keeps the sides readable.
    for direction, intensity in LIGHTS:
        light = pyvista.Light(position=centre + 10 * reach * np.array(direction), focal_point=centre, color="white")
        light.intensity = intensity
        plotter.add_light(light)
    plotter.camera.focal_point = centre
    plotter.camera.position = centre + reach * np.array(EYE)
    plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.camera.view_angle = VIEW_ANGLE
    plotter.enable_anti_aliasing("ssaa")
    return plotter.screenshot(None, return_img=True, transparent_background=True)


def main(solid: str, picture: str) -> None:
    """Read the triangles of `solid` (npz: vertices, faces) and write `picture` (PNG)."""
    from PIL import Image

    with np.load(solid, allow_pickle=False) as mesh:
        image = Image.fromarray(render(mesh["vertices"], mesh["faces"]))
    image.crop(image.getchannel("A").getbbox()).save(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
