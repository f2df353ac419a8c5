"""Thirty-two scenes, four pictures in each of eight geometries that no template has, and their designs measured.

    python -m tests.benchmarks.geometry_scenes [NAME ...]

designs the scenes and adds to geometry_scenes.json the RRMSD by rays that tailoring never saw, the remarks of the
command, and where in the picture the squared error sits.  test_geometries.py holds the figures to bounds.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from bstcad.optics.measure import Effort, measure
from bstcad.pipeline import design
from bstcad.scene.scene import Scene
from tests.benchmarks.pictures import drawn

FIGURES = Path(__file__).with_name("geometry_scenes.json")
RIM = 16  # of 256 pixels: the outermost ones, whose share of the squared error is kept
JUDGED = Effort(accuracy=0.01, witness=False)
NET, PIXELS = 257, 256


def _lens(z: float, outline: dict[str, Any], front: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    back = {"kind": "bspline", "z": z, "control_points": NET}
    return {"outline": outline, "front": {"kind": "plane", "z": 0.0} | (front or {}), "back": back} | more


def _target(z: float, x: tuple[float, float], y: tuple[float, float], **more: Any) -> dict[str, Any]:
    return {"z": z, "x": x, "y": y, "pixels": PIXELS} | more


def _rectangle(width: float, height: float) -> dict[str, Any]:
    return {"shape": "rectangle", "width": width, "height": height}


def _disc(diameter: float) -> dict[str, Any]:
    return {"shape": "circle", "radius": diameter / 2}


PMMA, GLASS = {"material": "PMMA"}, {"material": "N-BK7"}
BEAM = {"kind": "collimated", "wavelength": 587.6, "profile": "uniform"}
LAMP = {"kind": "point", "wavelength": 587.6, "position": (0.0, 0.0, 0.0), "profile": "lambertian"}
GEOMETRIES: dict[str, dict[str, Any]] = {
    "laser": {  # a Gaussian beam through a round lens, the wall aside
        "source": {"kind": "collimated", "wavelength": 632.8, "profile": "gaussian", "radius_1e2": 12.0,
                   "aperture": _disc(28.0)},
        "lens": _lens(8.0, _disc(30.0), **PMMA),
        "target": _target(900.0, (100.0, 400.0), (-150.0, 150.0)),
    },
    "near": {  # a wall nearer than the plate is wide
        "source": BEAM | {"aperture": _rectangle(60.0, 60.0)},
        "lens": _lens(12.0, _rectangle(60.0, 60.0), **PMMA),
        "target": _target(62.0, (-30.0, 30.0), (-30.0, 30.0)),
    },
    "tilted": {  # a wall that stands askew
        "source": BEAM | {"aperture": _rectangle(40.0, 40.0)},
        "lens": _lens(9.0, _rectangle(40.0, 40.0), **GLASS),
        "target": _target(700.0, (-120.0, 120.0), (-120.0, 120.0), tilt=(30.0, -20.0)),
    },
    "oblong": {  # a plate of two to one, a picture of one to one beside the axis
        "source": BEAM | {"aperture": _rectangle(60.0, 30.0)},
        "lens": _lens(10.0, _rectangle(60.0, 30.0), **PMMA),
        "target": _target(500.0, (20.0, 180.0), (-80.0, 80.0)),
    },
    "wide lamp": {  # Lambertian light within 50 degrees of the axis and more, gathered by a front that is searched for
        "source": LAMP,
        "lens": _lens(26.0, _disc(36.0), {"kind": "sphere", "z": 12.0, "curvature": 0.0, "optimise": True}, **PMMA),
        "target": _target(800.0, (-300.0, 300.0), (-300.0, 300.0)),
    },
    "lamp aside": {  # a lamp before a square lens, the picture to one side and below
        "source": LAMP,
        "lens": _lens(34.0, _rectangle(44.0, 44.0), {"z": 22.0}, **GLASS),
        "target": _target(1200.0, (100.0, 600.0), (-500.0, 0.0)),
    },
    "diverging": {  # a lamp far before a lens with a conic front, a small picture
        "source": LAMP | {"profile": "uniform", "position": (0.0, 0.0, -150.0), "half_angle": 9.0},
        "lens": _lens(
            12.0, _disc(44.0), {"kind": "conic", "z": 0.0, "curvature": 0.004, "conic_constant": -0.8}, **PMMA
        ),
        "target": _target(400.0, (-40.0, 40.0), (-40.0, 40.0)),
    },
    "mirror": {  # a lamp before a square mirror, the wall beside it
        "source": LAMP | {"profile": "uniform", "position": (0.0, 0.0, 150.0), "half_angle": 15.0},
        "lens": {"outline": _rectangle(64.0, 64.0), "front": {"kind": "plane", "z": 0.0},
                 "back": {"kind": "bspline", "z": 15.0, "control_points": NET, "reflect": True}},
        "target": _target(700.0, (120.0, 420.0), (-100.0, 200.0)),
    },
}  # fmt: skip
SMOOTH = ("glow", "dusk", "sheen", "slope", "vignette", "corner", "hills")
PICTURES = {
    "laser": ("glow", "stripes", "hopper", "discs"),
    "near": ("dusk", "strokes", "terrain", "cross"),
    "tilted": ("slope", "keys", "coast", "contours"),
    "oblong": ("sheen", "many polygons", "frame", "maze"),
    "wide lamp": ("vignette", "checkerboard", "cog", "rocket"),
    "lamp aside": ("corner", "dots", "emblem", "coffee"),
    "diverging": ("hills", "bar code", "star", "hearts"),
    "mirror": ("slope", "islands", "head", "bullseye"),
}
SCENES = {f"{name}, {picture}": (name, picture) for name in GEOMETRIES for picture in PICTURES[name]}


def scene_of(name: str) -> Scene:
    """The scene of a name of SCENES."""
    geometry, picture = SCENES[name]
    described = GEOMETRIES[geometry] | {"name": name.replace(",", "").replace(" ", "-")}
    target = described["target"] | {"uniform": True}  # until its picture is there
    return Scene.model_validate(described | {"target": target}).changed(
        {"target.uniform": None, "target.image": drawn(picture)}
    )


def measured(scene: Scene) -> dict[str, Any]:
    """RRMSD, its share in the outermost pixels, the light on the target, and seconds."""
    began, cpu = time.perf_counter(), time.process_time()
    made = design(scene, device="cpu", later=True)
    spent = time.perf_counter() - began, time.process_time() - cpu
    target = made.goals[0].picture
    judged = measure(made.lens, scene.judging_channels(), scene.target.screen, target=target, effort=JUDGED)
    image = judged.picture / judged.picture.sum()
    error = (image - target / target.sum()) ** 2
    inside = error[RIM:-RIM, RIM:-RIM]
    stages = {stage.name: round(stage.rrmsd, 4) for stage in made.making.stages if stage.rrmsd is not None}
    return {
        "rrmsd": round(judged.rrmsd, 5), "rim": round(float(1 - inside.sum() / error.sum()), 3),
        "on_target": round(judged.flux["on target"], 4), "stages": stages,
        "seconds": round(spent[0], 1), "cpu_seconds": round(spent[1], 1),
    }  # fmt: skip


def main() -> None:
    """Measure the scenes that are asked for."""
    for name in sys.argv[1:] or SCENES:
        found = measured(scene_of(name))
        known = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
        FIGURES.write_text(json.dumps(known | {name: found}, indent=1, sort_keys=True) + "\n")
        print(f"{name:28}", found, flush=True)


if __name__ == "__main__":
    main()
