"""Twelve scenes for the choice of a net: pictures of several kinds in several geometries; and their designs measured.

    python -m tests.benchmarks.net_scenes [--half] [--case NAME ...] [--net N ...]

designs each scene with each net and adds to net_choice.json its RRMSD and CPU seconds; --half: with half of the pixels
a side.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from skimage import data

from bstcad.designs.pipeline import design
from bstcad.optics.surfaces.sides import as_pair, coarser, spread
from bstcad.optics.trace.measure import Effort, rrmsds_by_rays
from bstcad.scene.scene import Scene, load
from tests.benchmarks.cold import TEMPLATES

FIGURES = Path(__file__).with_name("net_choice.json")
NETS = (129, 257, 513, 1025)
JUDGED = Effort(accuracy=0.02, witness=False)
NET, PIXELS, OUTLINE = "lens.back.control_points", "target.pixels", "target.outline"
X, Y, Z = "target.x", "target.y", "target.z"
CAUSTIC, THU, POINT, OFF, LAMP = "caustic_portrait", "thu", "portrait", "off_axis", "disk"
EVEN = {OUTLINE: None, "target.uniform": None, PIXELS: 512}
WIDE = {
    "source.aperture": {"shape": "rectangle", "width": 200.0, "height": 50.0},
    "lens.outline": {"shape": "rectangle", "width": 200.0, "height": 50.0}, "lens.back.z": 25.0,
    X: (-120.0, 120.0), Y: (-30.0, 30.0), Z: 600.0, PIXELS: (512, 128), "target.fit": "crop",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A template with another picture (`drawn`) and other values."""

    name: str
    template: str
    picture: str = ""  # "": that of the template
    changes: Mapping[str, Any] = field(default_factory=dict)


CASES = (
    Case("strokes", CAUSTIC, "many strokes", {Z: 500.0, X: (-60.0, 60.0), Y: (-60.0, 60.0)}),
    Case("letters", THU),
    Case("portrait", POINT),
    Case("checks", THU, "checks"),
    Case("slope", CAUSTIC, "slope"),
    Case("page", CAUSTIC, "page", {"target.fit": "crop"}),
    Case("frame", POINT, "frame"),
    Case("star", OFF, "star"),
    Case("spots", LAMP, "spots", EVEN),
    Case("cameraman", CAUSTIC, "camera", {Z: 260.0}),
    Case("coffee", LAMP, "coffee", EVEN),
    Case("wide-portrait", CAUSTIC, "", WIDE),
)


def strokes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fourteen lit strokes on a dim ground, each a parabola through three places."""
    draw, away, along = np.random.default_rng(2), np.full(x.shape, np.inf), np.linspace(0, 1, 400)[:, None]
    for _ in range(14):
        first, last, middle = draw.uniform(-0.9, 0.9, (3, 2))
        stroke = (1 - along) ** 2 * first + 2 * along * (1 - along) * middle + along**2 * last
        away = np.minimum(away, cKDTree(stroke).query(np.stack((x, y), -1))[0])
    return 0.08 + np.exp(-((away / 0.015) ** 4))


def frame(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A lit square frame on a dark ground."""
    out = np.maximum(np.abs(x), np.abs(y))
    return np.where((out > 0.6) & (out < 0.85), 1.05, 0.05)


PATTERNS = {  # patterns on the square from -1 to 1 along x (to the right) and y (up)
    "many strokes": strokes,
    "frame": frame,
    "checks": lambda x, y: np.where((np.floor(4 * x) + np.floor(4 * y)) % 2, 1.0, 0.15),
    "slope": lambda x, y: 0.1 + 0.9 * (x + 1) / 2,
    "star": lambda x, y: np.where(np.hypot(x, y) < 0.55 + 0.35 * np.cos(5 * np.arctan2(x, y)), 1.0, 0.05),
    "spots": lambda x, y: 0.05 + np.exp(4 * (np.cos(9 * x) * np.cos(9 * y) - 1)),
}


def drawn(name: str) -> np.ndarray:
    """Irradiance of a pattern, or of a picture that scikit-image brings along; row 0 is the top."""
    if name in PATTERNS:
        y, x = np.mgrid[1:-1:512j, -1:1:512j]
        return PATTERNS[name](x, y)
    picture = np.asarray(getattr(data, name)(), dtype=float)
    return picture.mean(2) if picture.ndim == 3 else picture


def scene_of(case: Case, half: bool) -> Scene:
    """The scene of a case, its net left to be chosen or set; half: with half of its pixels a side."""
    changes = {"name": case.name, "tailoring.quality": "standard"} | dict(case.changes)
    picture = {"target.image": drawn(case.picture)} if case.picture else {}
    scene = load(TEMPLATES / f"{case.template}.toml").changed(changes | picture)
    pixels = scene.target.pixels
    less = pixels // 2 if isinstance(pixels, int) else [n // 2 for n in pixels]
    return scene.changed({PIXELS: less}) if half else scene


def with_net(scene: Scene, side: int) -> Scene:
    """The scene with as many control points as a square net of this side, in square cells."""
    net = coarser(spread(side, *scene.lens.outline.half_extent), 2049)
    return scene.changed({NET: list(net) if isinstance(net, tuple) else net, "tailoring.levels": None})


def measure(scene: Scene) -> dict[str, float]:
    """RRMSD by rays that tailoring never saw, and CPU seconds of tailoring."""
    began = time.process_time()
    made = design(scene, device="cpu")
    spent = time.process_time() - began
    [rrmsd] = rrmsds_by_rays(made.lens, scene.verification_channels(), scene.goals, JUDGED)
    return {"rrmsd": round(rrmsd, 5), "cpu_seconds": round(spent, 2)}


def main() -> None:
    """Measure the cases that are asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--half", action="store_true")
    parser.add_argument("--case", nargs="*", default=[case.name for case in CASES])
    parser.add_argument("--net", nargs="*", type=int, default=NETS)
    asked = parser.parse_args()
    size = "half" if asked.half else "whole"
    for case in (case for case in CASES if case.name in asked.case):
        for side in asked.net:
            found = measure(scene := with_net(scene_of(case, asked.half), side))
            known = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
            known.setdefault(size, {}).setdefault(case.name, {})[str(side)] = found
            FIGURES.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
            print(size, case.name, as_pair(scene.lens.back.net), found, flush=True)


if __name__ == "__main__":
    main()
