"""Scenes at the rim of what is possible: hard pictures, geometries, glasses, sizes.

python -m tests.hard_cases.designs PAGE     designs them from the command line, and writes their table on a page

Each is a template with a few lines changed, at a modest size; the pictures are drawn here and written as 16-bit PNG,
since eight bits hold no contrast of 1 : 1000.  From the command line each has a process of its own, as a user runs it;
seconds are indications.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests import markdown
from tests.benchmarks.cold import TEMPLATES, generate

SIDE = 64  # pixels of a picture
WHITE = 65_000


# What a report may say was given up, by words of its sentence.
MISSES, SIDES, OUTSIDE = "misses the lens", "is lost through the sides", "the source emits falls beside"
LIFTED, DARK = "are too bright: ", "is left dark"
MOVED, CHANGED = "The back was moved by", "Tailoring moved the vertex of the back"
MISSED, STEEP = "The RRMSD", "has slopes up to"
CLOSE = "Some light meets the back"  # beginning of the remark on light next to total internal reflection, or past it
# What two faces cannot do, as it is said before stage 2.
CROSSED, IN_GLASS = (
    "would have to cross between the lens and the nearest target",
    "the front would have to deflect light by",
)


@dataclass(frozen=True)
class Hard:
    """One design, and what became of it once in a rough draft, with room: another order of a sum is another RRMSD."""

    template: str  # name of the template, without ".toml"
    changes: Mapping[str, Any]  # dotted keys, as --set
    picture: Callable[[], np.ndarray] | None = None  # (SIDE, SIDE) from 0 to 1
    # Changes of the scene that make the case, which stay at full size.
    sizes: Mapping[str, Any] = field(default_factory=dict)
    refused: str = ""  # the sentence, of a design that cannot be
    rrmsd: float = 0.01  # largest RRMSD
    efficiency: float = 0.99  # smallest efficiency
    says: tuple[str, ...] = (MISSES, SIDES)  # beginnings of the remarks in report["given_up"], and of no others
    told: tuple[str, ...] = ()  # before stage 2
    perhaps: tuple[str, ...] = ()  # may be said beside them: so near the limit that another machine says it
    bench: bool = False  # run by `make bench` alone: half a minute, as easy as others, or one of tailoring's own tests
    rough: Mapping[str, Any] = field(default_factory=dict)  # changes of the scene that save time in a rough draft


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
_SMALL = {"lens.outline": _square(2.0), "lens.front.z": 1.9, "lens.back.z": 2.6, "target.z": 62.5}
_LARGE = {"lens.outline": _square(300.0), "lens.front.z": 280.0, "lens.back.z": 375.0, "target.z": 9375.0}


def _aside(near: float) -> dict[str, Any]:
    """Letters 150 mm wide beside the axis, before which the lens is 4 mm thicker."""
    return {"lens.front.z": 4.0, "target.x": [near, near + 150.0], "target.y": [-75.0, 75.0]}


def _two_faces(gap: float, *targets: dict[str, Any], width: float = 10.0, **more: Any) -> dict[str, Any]:
    """A square beam of 7 mm on two freeform faces so far apart (mm)."""
    front = {"kind": "bspline", "z": 8.0, "optimise": True, "control_points": 33}
    source = {"kind": "collimated", "aperture": _square(7.0), "wavelength": 587.6}
    return {"source": source, "lens.outline": _square(width), "lens.front": front, "lens.back.z": 8.0 + gap,
            "target": list(targets), **more}  # fmt: skip


def _even(z: float, half: float, **more: Any) -> dict[str, Any]:
    """A target of `_two_faces`: an even square from -half to half (mm), or something else in it."""
    return {"z": z, "x": [-half, half], "y": [-half, half], "pixels": 48, **(more or {"uniform": True})}


DESIGNS: dict[str, Hard] = {
    "one bright pixel": Hard("disk", _PICTURE, one_pixel, rrmsd=0.13, says=(MOVED, MISSES, SIDES, CLOSE, LIFTED)),
    "checkerboard 1 : 1000": Hard("disk", _PICTURE, checkerboard, rrmsd=0.2, says=(MISSED, MISSES, SIDES, LIFTED),
                                  bench=True),
    "thin ring": Hard("disk", _PICTURE, ring, rrmsd=0.06, says=(MISSES, SIDES, LIFTED), bench=True),
    "two islands": Hard("disk", _PICTURE, islands, rrmsd=0.15, efficiency=0.98,
                        says=(MOVED, MISSED, MISSES, SIDES, OUTSIDE, CLOSE, LIFTED), bench=True),
    "target 40 mm behind the lens": Hard(
        "disk", _size(20.0, **{"target.z": 60.0}), rrmsd=0.03, says=(MOVED, MISSES, SIDES), bench=True),
    "target 50 m behind the lens": Hard("disk", _size(20_000.0, **{"target.z": 50_020.0}), bench=True),
    "deflection of 33 to 38 degrees": Hard("thu", _aside(600.0), rrmsd=0.2, says=(MISSED, CLOSE, LIFTED)),
    "deflection that no face can make": Hard(
        "thu", _aside(1500.0),
        refused="target: no light reaches the target, as a face of index 1.488 deflects light by at most 47.8",
    ),
    "source 5 mm before the lens": Hard(
        "disk", {"source.position": [0.0, 0.0, 10.0]}, rrmsd=0.12, says=(MOVED, SIDES, LIFTED), bench=True),
    "source 500 mm before the lens": Hard("disk", {"source.position": [0.0, 0.0, -485.0]}, rrmsd=0.02, bench=True),
    "index 1.05": Hard(  # more rounds come nearer to the picture, with less of the light
        "disk", {**_PICTURE, "lens.index": 1.05}, rrmsd=0.19, efficiency=0.95, rough={"tailoring.rounds": 3},
        says=(CHANGED, MISSED, MISSES, SIDES), perhaps=(OUTSIDE, "would need a face steeper"),
    ),
    "index 1.05, a target that light cannot reach": Hard(  # without a surface for it each round ends elsewhere
        "disk", {"lens.index": 1.05}, rrmsd=0.6, efficiency=0.9, rough={"tailoring.rounds": 3},
        says=(MOVED, MISSED, MISSES, SIDES, OUTSIDE, LIFTED), perhaps=(CLOSE, STEEP, DARK), bench=True,
    ),
    "index 2.4": Hard("disk", {"lens.index": 2.4}, bench=True),
    "lens of 2 mm": Hard("disk", _size(25.0, **_SMALL), says=(MOVED, MISSES, SIDES), bench=True),
    "lens of 300 mm": Hard("disk", _size(3750.0, **_LARGE), bench=True),
    "33 control points": Hard("disk", {}, sizes={"lens.back.control_points": 33}, bench=True),
    "1025 control points": Hard(
        "disk", {}, sizes={"lens.back.control_points": 1025}, rrmsd=0.08, says=(MISSES, SIDES, LIFTED), bench=True,
        rough={"tailoring.rays": 640, "tailoring.stage2_iterations": 3},
    ),
    "16 pixels": Hard("disk", {}, sizes={"target.pixels": 16}, bench=True),
    "2048 pixels": Hard("disk", {}, sizes={"target.pixels": 2048}, rrmsd=0.06, bench=True),
    "two faces 0.6 mm apart": Hard(
        "disk", _two_faces(0.6, _even(40.0, 3.2), _even(80.0, 3.7)), rrmsd=0.1, efficiency=0.96, told=(IN_GLASS,),
        says=(MOVED, OUTSIDE, OUTSIDE), perhaps=(STEEP,), bench=True,
    ),
    "two faces, rays that cross": Hard(
        "disk", _two_faces(6.0, _even(100.0, 3.2), _even(150.0, 3.2, text="AB"), width=14.0), rrmsd=0.65,
        efficiency=0.8, told=(CROSSED,), says=(MISSED, MISSED, "face steeper than", OUTSIDE, OUTSIDE),
        perhaps=(CLOSE, LIFTED, STEEP, DARK), bench=True,
    ),
    "two faces, rays that all cross": Hard(
        "disk", _two_faces(6.0, _even(100.0, 3.2, text="O"), _even(130.0, 3.2, text="X"),
                           **{"tailoring.solution": "convex"}),
        refused="of the light would have to cross between the lens and the nearest target",
    ),
    "two faces, a deflection that no front can make": Hard(
        "disk", _two_faces(6.0, _even(150.0, 9.0), width=24.0, wavefront={"kind": "plane", "z": 150.0}), rrmsd=2.0,
        efficiency=0.95, told=(IN_GLASS,), says=(MISSED, DARK, "face steeper than"),
        perhaps=(CHANGED, OUTSIDE, CLOSE, LIFTED, STEEP, "The facets of"), bench=True,
    ),
    "back through the front": Hard("thu", {"lens.front.z": 16.0}, rrmsd=0.2, says=(MOVED, MISSED, LIFTED)),
}  # fmt: skip


def overrides(name: str, folder: Path, more: Mapping[str, Any]) -> tuple[Path, dict[str, Any]]:
    """(template, changes) of one design, its picture written to `folder`; `more` goes before, but for its sizes."""
    design = DESIGNS[name]
    if "target" in design.changes:  # a list of them, with pixels of their own
        more = {key: value for key, value in more.items() if key != "target.pixels"}
    changes = {"name": name.replace(" ", "-"), **design.changes, **more, **design.sizes}
    if design.picture is not None:
        path = folder / f"{len(list(folder.iterdir()))}.png"
        Image.fromarray(np.round(design.picture() * WHITE).astype(np.uint16)).save(path)
        changes["target.image"] = str(path)
    return TEMPLATES / f"{design.template}.toml", changes


HEAD = (
    "design", "exit code", "RRMSD", "standard error", "efficiency", "margin to total reflection", "smallest thickness",
    "steepest slope", "time",
)  # fmt: skip


def designed(name: str, folder: Path, quality: str) -> tuple[list[str], str]:
    """Return a row of the table, and the remarks of the report, as links, or the message of a refusal."""
    pictures, design = folder / "pictures", DESIGNS[name]
    pictures.mkdir(exist_ok=True)
    pixels = SIDE if design.picture else 128
    sizes = {"lens.back.control_points": 65, "target.pixels": pixels, "tailoring.quality": quality}
    changes = overrides(name, pictures, sizes)[1]
    run = generate(design.template, folder / changes["name"], *(f"{k}={as_toml(v)}" for k, v in changes.items()))
    time = f"{run.seconds:.0f} s"
    if run.code == 2:
        return [name, "2", *[""] * 6, time], run.said.splitlines()[-1].removeprefix("bstcad: ")
    report = run.report()
    rrmsd = report["rrmsd"]
    shape, margin = report["shape"], report.get("stability", {}).get("tir_margin_deg")
    failed = [c["name"] for c in report["checks"] if not c["passed"] and not c["name"].startswith("RRMSD")]
    remarks = [f"[{id}](reference/remarks.md#remark-{id})" for id in dict.fromkeys(report["remarks"])]
    said = ", ".join([*remarks, *(f"failed: {name}" for name in failed)]) or "none"
    return [
        name, str(run.code), f"{rrmsd:.4f}", f"{report['rrmsd_noise']:.1e}", f"{report['efficiency']:.4f}",
        "" if margin is None else f"{margin:.2f}°", f"{shape['thickness_min']:.2f} mm",
        f"{shape['slope_max_deg']:.1f}°", time,
    ], said  # fmt: skip


def as_toml(value: Any) -> str:
    """A value as --set reads it."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {as_toml(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return json.dumps(value)


def main() -> None:
    """Run them and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--quality", default="draft")
    wanted = parser.parse_args()
    rows, words = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name in DESIGNS:
            cells, said = designed(name, Path(folder), wanted.quality)
            rows.append(cells)
            words.append(f"- {name}: {said}")
            print(markdown.row(cells), flush=True)
    below = "Remarks in the report of each design, or the message with which it was refused:"
    content = [markdown.table(HEAD, rows), "", below, "", *words]
    markdown.write(wanted.page, "<!-- figures: designs -->", "\n".join(content))


if __name__ == "__main__":
    main()
