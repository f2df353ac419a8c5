"""Lenses as their STEP files hold them, for programs not written here to judge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import NdBSpline

from bstcad.cad import step_reading, step_writing
from bstcad.cad.solid import lens_solid
from bstcad.cad.step_reading import StepLens
from bstcad.optics.lens import Lens
from bstcad.pipeline import design
from bstcad.scene.scene import Scene, load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
SMALL = {  # a metre's throw
    "lens.back.control_points": 65,
    "target.z": 1000.0,
    "target.pixels": 64,
    "tailoring.quality": "draft",
}
SCENES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "a beam, off axis": ("thu", {"source.aperture": {"shape": "circle", "radius": 11.0}}),
    "a point, through a sphere": (
        "disk",
        {
            # off the axis in x and in y: no mirror image of itself
            "source": {
                "kind": "point", "position": [0.4, -0.3, 0.0], "wavelength": 587.6,
                "profile": "uniform", "half_angle": 22.0,
            },
            "lens.outline": {"shape": "circle", "diameter": 18.0},
            "lens.front": {"kind": "sphere", "z": 15.0, "curvature": -0.015},
            "lens.back.z": 21.0,
            "target.x": [-350.0, 450.0],
            "target.y": [-400.0, 400.0],
            "target.outline": {"shape": "circle", "radius": 360.0},
        },
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Written:
    """A design and its lens as the written file holds it."""

    scene: Scene
    step: StepLens
    lens: Lens


def written(name: str, folder: Path) -> Written:
    """Design a scene of SCENES, write its lens to `folder` as STEP, and read that back."""
    template, changes = SCENES[name]
    scene = load(TEMPLATES / f"{template}.toml", {**SMALL, **changes})
    path = folder / "lens.step"
    step_writing.write(lens_solid(design(scene, device="cpu").lens), path, scene.name)
    step = step_reading.read(path)
    return Written(scene, step, step_reading.lens(step, scene.index))


@dataclass(frozen=True)
class Grid:
    """The back face where x and y are uniform in its parameters: between the second knot and the last but one.

    There a quadratic spline is a quadratic polynomial of x and y from knot to knot.
    """

    x: np.ndarray  # (n,) mm
    y: np.ndarray  # (n,) mm
    z: np.ndarray  # (n, n) mm, y along the first axis
    z_x: np.ndarray  # ∂z/∂x
    z_y: np.ndarray  # ∂z/∂y
    z_xy: np.ndarray  # ∂²z/∂x∂y (1/mm)


def back_grid(step: StepLens, parts: int = 1) -> Grid:
    """The back face on its knot lines, each span in `parts`, by scipy's spline on the net and knots of the file."""
    net = step.control_points
    m = len(net)
    t = np.linspace(1.0, m - 3.0, parts * (m - 4) + 1)
    spline = NdBSpline((step.knots_x, step.knots_y), net, (2, 2))
    at = np.stack(np.meshgrid(t, t, indexing="xy"), axis=-1)  # y along the first axis
    place, along_x, along_y, mixed = (spline(at, nu=nu) for nu in ((0, 0), (1, 0), (0, 1), (1, 1)))
    per_x, per_y = 1 / along_x[0, 0, 0], 1 / along_y[0, 0, 1]  # spans a mm
    return Grid(
        place[0, :, 0], place[:, 0, 1], place[..., 2],
        along_x[..., 2] * per_x, along_y[..., 2] * per_y, mixed[..., 2] * per_x * per_y,
    )  # fmt: skip
