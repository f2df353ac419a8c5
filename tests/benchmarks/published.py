"""Published results beside bstcad's on the same scenes: docs/published.json, docs/published.md and its pictures.

make published                                        records all scenes anew, a quarter of an hour, and writes the page
make published ONLY="L1-letters thu"                  records these; with ONLY= writes the page alone
make published SUN_PICTURE=img1.jpg                   with diffinytrace's examples/img1.jpg: its scene, too

Each scene is a cold `bstcad generate` of quality standard.  The judge of all is tests/benchmarks/independent.py, which
shares no code with bstcad and reads the faces from lens.step.  The text of the page, with the peers' figures, is
published.md.j2.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from skimage.metrics import structural_similarity

from bstcad.designs.folder import read_nominal
from bstcad.figures.light_figures import View
from bstcad.runs import files
from tests import markdown
from tests.benchmarks import accuracy
from tests.benchmarks.cold import ROOT, TEMPLATES, generate
from tests.benchmarks.independent import judge
from tests.benchmarks.judged_cells import HALF, finer_targets, stated_by_cell

RECORDED, PAGE, PICTURES = (ROOT / "docs" / name for name in ("published.json", "published.md", "published"))
TEXT, SCENES = Path(__file__).with_name("published.md.j2"), Path(__file__).with_name("published_scenes")
SUN = "sun-picture"  # name of the scene whose picture is not in the repository
SUN_SIDE, SUN_INSIDE = 256, 212  # pixels; the picture in its black border
SIDE, COLOURS = 256, 64  # pixels a side of each of the two pictures of a scene; grey levels
GAP = 4  # pixels between them
BRIGHT = 99.5  # percentile of the target that is shown white
CASES = {  # name: (title, scene)
    "thu": ("letters, collimated, off axis", TEMPLATES / "thu.toml"),
    "portrait": ("portrait, point source", TEMPLATES / "portrait.toml"),
    "caustic_portrait": ("portrait, collimated, on axis", TEMPLATES / "caustic_portrait.toml"),
    "caustic_letters": ("letters, collimated, on axis", TEMPLATES / "caustic_letters.toml"),
    "L1-letters": ("L1: letters, 90 degrees wide", SCENES / "L1_letters.toml"),
    "L1-portrait": ("L1: portrait, 90 degrees wide", SCENES / "L1_portrait.toml"),
    "L2-letters": ("L2: letters, 6 mm behind the lens", SCENES / "L2_letters.toml"),
    "L2-portrait": ("L2: portrait, 6 mm behind the lens", SCENES / "L2_portrait.toml"),
    "L3-letters": ("L3: letters from a half space", SCENES / "L3_letters.toml"),
    "L3-portrait": ("L3: portrait from a half space", SCENES / "L3_portrait.toml"),
    "L4-letters": ("L4: letters, 4 mm behind a lamp of 60 degrees", SCENES / "L4_letters.toml"),
    "L4-portrait": ("L4: portrait, 4 mm behind a lamp of 60 degrees", SCENES / "L4_portrait.toml"),
    SUN: ("a picture by sunlight (20 mrad)", SCENES / "sun_picture.toml"),
}


def bordered(picture: Path) -> Image.Image:
    """diffinytrace's img1.jpg as it shows it: the middle square in grey, in a black border."""
    grey = Image.open(picture).convert("L")
    inside = ImageOps.fit(grey, (min(grey.size),) * 2).resize((SUN_INSIDE,) * 2, Image.Resampling.LANCZOS)
    return ImageOps.expand(inside, (SUN_SIDE - SUN_INSIDE) // 2, 0)


def designed(name: str, sun: Path | None) -> dict[str, Any]:
    """The record of a scene: a cold design, and the independent judge of its folder; its picture is put in PICTURES."""
    _, scene = CASES[name]
    accuracy.warm_up("thu", "draft")
    with tempfile.TemporaryDirectory() as place:
        if name == SUN:
            scene = Path(shutil.copy(scene, place))
            bordered(sun).save(scene.with_suffix(".png"))
        run = generate(scene, Path(place) / "design")
        report, judged = run.report(), judge(run.folder, finer_targets=finer_targets(run.folder)[0])
        with np.load(run.folder / "design.npz") as kept:
            target = kept["target"].astype(float)
        seen = View.of(read_nominal(run.folder).scene)
    files.put(PICTURES / f"{name}.png", side_by_side(seen.picture(target), seen.picture(judged.picture)))
    half, half_error = judged.by_cell[HALF]
    return {
        "rrmsd": judged.rrmsd, "error": judged.error, "stated": report["rrmsd"], "on_target": judged.flux["on target"],
        "rrmsd_half": half, "error_half": half_error, "stated_half": stated_by_cell(report).get(HALF, (None,))[0],
        "ssim": structural_similarity(target, judged.picture, data_range=float(target.max())),
        "whole": report.get("rrmsd_whole"),
        "failed": [check["name"] for check in report["checks"] if not check["passed"]],
        "rays": judged.rays, "seconds": run.seconds, "cpu_seconds": run.cpu_seconds,
        "recorded": accuracy.circumstances(),
    }  # fmt: skip


def side_by_side(target: np.ndarray, irradiance: np.ndarray) -> bytes:
    """PNG of the target and the irradiance on one scale of grey."""
    white = np.percentile(target[target > 0], BRIGHT)
    shown = [
        Image.fromarray(np.uint8(255 * np.clip(p / white, 0, 1) ** (1 / 2.2))).resize((SIDE,) * 2, Image.Resampling.BOX)
        for p in (target, irradiance)
    ]
    both = Image.new("L", (2 * SIDE + GAP, SIDE), 255)
    for k, picture in enumerate(shown):
        both.paste(picture, (k * (SIDE + GAP), 0))
    stream = io.BytesIO()
    both.quantize(COLOURS).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def page(recorded: Mapping[str, Any], others: Mapping[str, Any]) -> str:
    """Return the page from the records, and from accuracy.json Mitsuba's run and the paper's procedure."""
    when = {json.dumps(found["recorded"]): found["recorded"] for found in recorded.values()}
    return markdown.page(
        TEXT, {}, found=recorded, rays=max(found["rays"] for found in recorded.values()),
        mitsuba=others["mitsuba"]["points"][-1], paper=others["designs"]["thu"]["paper"],
        titles={name: title for name, (title, _) in CASES.items()},
        records=sorted(when.values(), key=lambda each: each["date"]),
    )  # fmt: skip


def main() -> None:
    """Record after each scene, so that nothing is lost on the way, and write the page at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=CASES, help="names of scenes; without a name: write alone")
    parser.add_argument("--sun-picture", type=Path, help="diffinytrace's examples/img1.jpg; without it its scene stays")
    asked = parser.parse_args()
    PICTURES.mkdir(exist_ok=True)
    for name in CASES if asked.only is None else asked.only:
        if name == SUN and asked.sun_picture is None:
            print(f"{SUN} is left as it is: make published SUN_PICTURE=…/img1.jpg records it", flush=True)
            continue
        print(f"recording {name}", flush=True)
        recorded = accuracy.known(RECORDED) | {name: designed(name, asked.sun_picture)}
        accuracy.put(RECORDED, {key: recorded[key] for key in CASES if key in recorded})
    if recorded := accuracy.known(RECORDED):
        files.put(PAGE, page(recorded, accuracy.known(accuracy.RECORDED)).encode())


if __name__ == "__main__":
    main()
