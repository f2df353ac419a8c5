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

from bstcad.optics.measure import Effort, rrmsd_by_rays
from bstcad.optics.sides import both, coarser, spread
from bstcad.pipeline import design
from bstcad.scene.scene import Scene, load
from tests.benchmarks.cold import TEMPLATES
from tests.benchmarks.pictures import drawn

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
    """A template with another picture (pictures.py) and other values."""

    name: str
    template: str
    picture: str = ""  # "": the template's
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
    spent, screen, target = time.process_time() - began, scene.target.screen, scene.target.irradiance()
    rrmsd = rrmsd_by_rays(made.lens, scene.judging_channels(), screen, target=target, effort=JUDGED)
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
            print(size, case.name, both(scene.lens.back.net), found, flush=True)


if __name__ == "__main__":
    main()
