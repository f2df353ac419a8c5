"""Scenes at the rim of what is possible: hard pictures, geometries, glasses, sizes.

Each is a template with a few lines changed, at a modest size; the pictures are drawn here and written as 16-bit PNG,
since eight bits hold no contrast of 1 : 1000.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
SIDE = 64  # pixels of a picture
WHITE = 65_000


@dataclass(frozen=True)
class Hard:
    """One design."""

    template: str  # in templates/, without ".toml"
    changes: Mapping[str, Any]  # dotted keys, as --set
    picture: Callable[[], np.ndarray] | None = None  # (SIDE, SIDE) from 0 to 1
    sizes: Mapping[str, Any] = field(default_factory=dict)  # what it is about, and so is not made smaller


def one_pixel() -> np.ndarray:
    """One bright pixel on black, off the middle."""
    picture = np.zeros((SIDE, SIDE))
    picture[20, 41] = 1.0
    return picture


def checkerboard() -> np.ndarray:
    """8 x 8 fields of 1 : 1000."""
    row, column = np.indices((SIDE, SIDE)) * 8 // SIDE
    return np.where((row + column) % 2, 1.0, 1e-3)


def ring() -> np.ndarray:
    """A circle of two pixels' width."""
    row, column = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    return (np.abs(np.hypot(row, column) - 0.36 * SIDE) <= 1.0).astype(float)


def islands() -> np.ndarray:
    """Two squares in opposite corners."""
    picture = np.zeros((SIDE, SIDE))
    picture[4:14, 4:14] = picture[-14:-4, -14:-4] = 1.0
    return picture


def _size(half: float, **more: Any) -> dict[str, Any]:
    """A target from -half to half each way (mm), filled evenly to nine tenths."""
    ends = [-half, half]
    return {"target.x": ends, "target.y": ends, "target.outline": {"shape": "circle", "radius": 0.9 * half}, **more}


def _square(side: float) -> dict[str, Any]:
    return {"shape": "rectangle", "width": side, "height": side}


_PICTURE = {"target.outline": {"shape": "rectangle", "width": 400.0, "height": 400.0}}

DESIGNS: dict[str, Hard] = {
    "one bright pixel": Hard("disk", _PICTURE, one_pixel),
    "checkerboard 1 : 1000": Hard("disk", _PICTURE, checkerboard),
    "thin ring": Hard("disk", _PICTURE, ring),
    "two islands": Hard("disk", _PICTURE, islands),
    "target 40 mm behind": Hard("disk", _size(20.0, **{"target.z": 60.0})),
    "target 50 m behind": Hard("disk", _size(20_000.0, **{"target.z": 50_020.0})),
    "deflection of 33 to 38 degrees": Hard(
        "thu", {"lens.front.z": 4.0, "target.x": [600.0, 750.0], "target.y": [-75.0, 75.0]}
    ),
    "deflection no face can make": Hard(
        "thu", {"lens.front.z": 4.0, "target.x": [1500.0, 1650.0], "target.y": [-75.0, 75.0]}
    ),
    "source 5 mm before": Hard("disk", {"source.position": [0.0, 0.0, 10.0]}),
    "source 500 mm before": Hard("disk", {"source.position": [0.0, 0.0, -485.0]}),
    "index 1.05": Hard("disk", {**_PICTURE, "lens.index": 1.05}),
    "index 1.05, a target it cannot reach": Hard("disk", {"lens.index": 1.05}),
    "index 2.4": Hard("disk", {"lens.index": 2.4}),
    "lens of 2 mm": Hard(
        "disk",
        _size(
            25.0,
            **{"lens.outline": _square(2.0), "lens.front.z": 1.9, "lens.back.z": 2.6, "target.z": 62.5},
        ),
    ),
    "lens of 300 mm": Hard(
        "disk",
        _size(
            3750.0,
            **{"lens.outline": _square(300.0), "lens.front.z": 280.0, "lens.back.z": 375.0, "target.z": 9375.0},
        ),
    ),
    "33 control points": Hard("disk", {}, sizes={"lens.back.control_points": 33}),
    "1025 control points": Hard("disk", {}, sizes={"lens.back.control_points": 1025}),
    "16 pixels": Hard("disk", {}, sizes={"target.pixels": 16}),
    "2048 pixels": Hard("disk", {}, sizes={"target.pixels": 2048}),
    "back through the front": Hard("thu", {"lens.front.z": 16.0}),
}


def overrides(name: str, folder: Path, more: Mapping[str, Any]) -> tuple[Path, dict[str, Any]]:
    """(template, changes) of one design, its picture written to `folder`; `more` goes before, but for its sizes."""
    design = DESIGNS[name]
    changes = {"name": name.replace(" ", "-"), **design.changes, **more, **design.sizes}
    if design.picture is not None:
        path = folder / f"{len(list(folder.iterdir()))}.png"
        Image.fromarray(np.round(design.picture() * WHITE).astype(np.uint16)).save(path)
        changes["target.image"] = str(path)
    return TEMPLATES / f"{design.template}.toml", changes
