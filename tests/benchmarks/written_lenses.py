"""Lenses as their STEP files hold them, for programs not written here to judge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
    return of_template(template, {**SMALL, **changes}, folder)


def of_template(template: str, changes: Mapping[str, Any], folder: Path) -> Written:
    """The same of a template with some of its keys changed."""
    scene = load(TEMPLATES / f"{template}.toml", changes)
    path = folder / "lens.step"
    step_writing.write(lens_solid(design(scene, device="cpu").lens), path, scene.name)
    step = step_reading.read(path)
    lens = step_reading.lens(step, scene.index)
    return Written(scene, step, replace(lens, reflects=scene.lens.back.reflect))
