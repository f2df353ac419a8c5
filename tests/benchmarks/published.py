"""Published results beside bstcad's on the same scenes: docs/published.json, docs/published.md and its pictures.

make published                                        records all scenes anew, a quarter of an hour, and writes the page
make published ONLY="L1-letters thu"                  records these; with ONLY= writes the page alone
make published SUN_PICTURE=img1.jpg                   with diffinytrace's examples/img1.jpg: its scene, too

Each scene is a cold `bstcad generate` of quality standard.  The judge of all is tests/benchmarks/independent.py, which
shares no code with bstcad and reads the faces from lens.step.  The peers' figures are those that they state, unless the
page says that their program was run.
"""

from __future__ import annotations

import argparse
import io
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from skimage.metrics import structural_similarity

from bstcad.folder import read_nominal
from bstcad.report.light_figures import View
from bstcad.runs import files
from bstcad.sweep.cold_run import rounded
from tests import markdown
from tests.benchmarks import accuracy
from tests.benchmarks.cold import ROOT, TEMPLATES, generate
from tests.benchmarks.independent import judge

RECORDED, PAGE, PICTURES = (ROOT / "docs" / name for name in ("published.json", "published.md", "published"))
SCENES = Path(__file__).parent / "published_scenes"
SUN = "sun-picture"  # its picture is not in the repository
SUN_SIDE, SUN_INSIDE = 256, 212  # pixels; the picture in its black border
SIDE, COLOURS = 256, 64  # pixels a side of each of the two pictures of a scene; grey levels
GAP = 4  # pixels between them
BRIGHT = 99.5  # percentile of the target that is shown white
DIGITS = 5
UNKNOWN = "not recorded"


@dataclass(frozen=True)
class Peer:
    """A published result."""

    who: str
    rrmsd: float
    took: str  # time and machine, as stated; empty where it is not


LI = "Li, Tang, Feng 2025"
I9 = "Intel i9-12900K"
PAPER = "Wang et al. 2023"
FAST, HERE = "fast_caustic_design", "two CPU cores"


@dataclass(frozen=True)
class Case:
    """A scene, who published what of it, and what is not alike."""

    title: str
    scene: Path
    peers: tuple[Peer, ...]
    unlike: str


def _own(geometry: str) -> str:
    return (
        f"Geometry {geometry}, index and pixels are theirs. **Their pictures are not published**: letters and portrait "
        "are our own, and a picture of other contrast has another RRMSD. They judge by Mitsuba 3, whose noise is part "
        "of it; their figures are read from notes of the paper, not from the paper itself."
    )


BEYOND = (
    "One refraction at 1.4936 turns a parallel ray by less than 48.0 degrees; the corners of the target stand at 54.7 "
    "degrees, where no light can come to, by either program. bstcad designs for the part within reach, and its RRMSD "
    "is that of this part; of the whole target, dark corners and all, it is {whole}."
)
CASES = {
    "thu": Case(
        "letters, collimated, off axis", TEMPLATES / "thu.toml", (Peer(PAPER, 0.1254, "RTX A4000"),),
        "Source, blank, target plane and letters are those of example 2. Their net has 257 x 257 points, ours 513 x "
        "513; with 257 the paper's procedure as bstcad has it (`quality = \"paper\"`) comes to 0.118 here.",
    ),
    "portrait": Case(
        "portrait, point source", TEMPLATES / "portrait.toml", (Peer(PAPER, 0.1217, "RTX A4000"),),
        "Source, blank and target plane are those of example 1. **The portrait is another one**, scikit-image's "
        "astronaut. Their figure is stated after stage 1.",
    ),
    "caustic_portrait": Case(
        "portrait, collimated, on axis", TEMPLATES / "caustic_portrait.toml",
        (Peer(FAST, 0.101, f"330-450 s, {HERE}"), Peer("Mitsuba 3, caustics tutorial", 0.427, f"331 s, {HERE}")),
        "Same plate, same picture, same pixels; both programs were run here, at their own settings. {mitsuba} "
        "fast_caustic_design was judged with a tent as wide as a pixel, whose own floor is 0.024; it writes a mesh, "
        "Mitsuba a height map, neither a solid.",
    ),
    "caustic_letters": Case(
        "letters, collimated, on axis", TEMPLATES / "caustic_letters.toml", (Peer(FAST, 0.195, f"330-450 s, {HERE}"),),
        "As above; the tent's floor is 0.037 on letters.",
    ),
    "L1-letters": Case(
        "L1: letters, 90 degrees wide", SCENES / "L1_letters.toml", (Peer(LI, 0.2463, f"2507 s, {I9}"),),
        f"{_own('L1')} {BEYOND}",
    ),
    "L1-portrait": Case(
        "L1: portrait, 90 degrees wide", SCENES / "L1_portrait.toml", (Peer(LI, 0.1342, f"1937 s, {I9}"),),
        f"As L1's letters. {BEYOND} This portrait is bright there; theirs is not known.",
    ),
    "L2-letters": Case(
        "L2: letters, 6 mm behind the lens", SCENES / "L2_letters.toml", (Peer(LI, 0.2389, ""),), _own("L2")
    ),
    "L2-portrait": Case(
        "L2: portrait, 6 mm behind the lens", SCENES / "L2_portrait.toml", (Peer(LI, 0.1265, ""),), "As L2's letters."
    ),
    SUN: Case(
        "a picture by sunlight (20 mrad)", SCENES / "sun_picture.toml",
        (Peer("diffinytrace", 0.147, "GPU, time not stated"),),
        "Their picture (`examples/img1.jpg`, MIT licence, Martin Pflaum), cropped and bordered as theirs. Their "
        "figure follows from their stated rmse of 8.00e-5 /mm² and the target's rms of 5.44e-4 /mm². **The suns "
        "differ**: theirs draws the polar angle evenly and so is brightest in its middle, ours is even in its cone and "
        "blurs more. Their SSIM is 0.883, ours {ssim} (scikit-image, window of 7 pixels, range of the target): the "
        "target itself, blurred to an RRMSD of 0.133, has 0.767 by that formula, so that theirs must be scaled in "
        "another way, of which nothing is stated. They state 10^8 random rays as judge.",
    ),
}  # fmt: skip
ABSENT = """\
- **L3 and L4 of Li, Tang, Feng 2025** (a point source that shines into a half space): bstcad's faces are heights over a
  plane, and its maps are in slopes; both end below 90 degrees. There is no figure of ours.
- **Ansys Speos, LightTools**: commercial, and no figure of a picture's RRMSD is published.
- **causticsEngineering and poisson_caustic_design**: Poisson's equation instead of transport; the second has 0.167 on
  the portrait on axis at 128 x 128 and 85 to 112 s, by the judge with the tent.
- **Hacking et al. 2026** (mirrors, 2 to 8 s on an RTX 4090) and **Sun, Deng, Zhang 2026** (two faces): other systems
  than a freeform face before a plane; bstcad has no scene for them yet.
"""
HEAD = """# Published results, side by side

Made by `make published` from [published.json](published.json) and [accuracy.json](accuracy.json); nothing here is
written by hand. RRMSD is the relative RMS deviation of the irradiance from the target over all pixels of the target
(512 x 512; of the sunlight picture 256 x 256). bstcad's figures are of quality `standard`, a cold process on two CPU
cores from the command to its end, and **each is judged by the same independent Monte Carlo**
(`tests/benchmarks/independent.py`: {rays} million rays, no code in common with bstcad) through the faces of the written
`lens.step`. The peers' figures are as they state them;
[how far each comparison is like for like](#how-far-each-comparison-is-like-for-like) stands below the table.
"""


def bordered(picture: Path) -> Image.Image:
    """diffinytrace's img1.jpg as it shows it: the middle square in grey, in a black border."""
    grey = Image.open(picture).convert("L")
    inside = ImageOps.fit(grey, (min(grey.size),) * 2).resize((SUN_INSIDE,) * 2, Image.Resampling.LANCZOS)
    return ImageOps.expand(inside, (SUN_SIDE - SUN_INSIDE) // 2, 0)


def designed(name: str, sun: Path | None) -> dict[str, Any]:
    """The record of a scene: a cold design, and the independent judge of its folder; its picture is put in PICTURES."""
    case = CASES[name]
    accuracy.warm_up("thu", "draft")
    with tempfile.TemporaryDirectory() as place:
        scene = case.scene
        if name == SUN:
            scene = Path(place) / scene.name
            scene.write_text(case.scene.read_text(encoding="utf-8"), encoding="utf-8")
            bordered(sun).save(scene.with_suffix(".png"))
        run = generate(scene, Path(place) / "design")
        report, judged = run.report(), judge(run.folder)
        with np.load(run.folder / "design.npz") as kept:
            target = kept["target"].astype(float)
        seen = View.of(read_nominal(run.folder)[0])
    files.put(PICTURES / f"{name}.png", side_by_side(seen.picture(target), seen.picture(judged.picture)))
    return {
        "rrmsd": judged.rrmsd, "error": judged.error, "stated": report["rrmsd"], "on_target": judged.flux["on target"],
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


def known() -> dict[str, Any]:
    """The records."""
    return json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.exists() else {}


def page(recorded: Mapping[str, Any], others: Mapping[str, Any]) -> str:
    """The page from the records, and from accuracy.json Mitsuba's run."""
    rays = max(found["rays"] for found in recorded.values()) / 1e6
    parts = [HEAD.format(rays=f"{rays:.0f}"), _table(recorded), "## How far each comparison is like for like\n"]
    last = others["mitsuba"]["points"][-1]
    told = {
        "mitsuba": f"Mitsuba's tutorial sees 128 x 128 pixels; on these it has {last['rrmsd_coarse']:.3f}.",
        "ssim": f"{recorded[SUN]['ssim']:.3f}" if SUN in recorded else UNKNOWN,
    }
    for name, found in recorded.items():
        case, whole = CASES[name], found.get("whole")
        text = case.unlike.format(**told, whole=UNKNOWN if whole is None else f"{whole:.3f}")
        failed = f" Of bstcad's own checks failed: {'; '.join(found['failed'])}." if found["failed"] else ""
        parts.append(f"- **{case.title}**: {text}{failed}")
    parts += ["\n## Without a figure of ours, and why\n", ABSENT, "## Target and irradiance\n"]
    parts.append("Left the target, right the irradiance as the independent judge traces it, on one scale.\n")
    parts += [f"![{CASES[name].title}: target and irradiance](published/{name}.png)\n\n*{CASES[name].title}*\n"
              for name in recorded]  # fmt: skip
    when = sorted({f"{r['date']}: bstcad {r['version']}; {r['machine']}; {r['versions']}"
                   for r in (found["recorded"] for found in recorded.values())})  # fmt: skip
    return "\n".join([*parts, "## Recorded\n", *(f"- {line}" for line in when), ""])


def _table(recorded: Mapping[str, Any]) -> str:
    head = ("scene", "published by", "their RRMSD", "time, machine", "bstcad's RRMSD", "seconds", "light on the target")
    return markdown.table(head, _rows(recorded), words=("published by", "time, machine")) + "\n"


def _rows(recorded: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, found in recorded.items():
        for k, peer in enumerate(CASES[name].peers):
            ours = (f"**{found['rrmsd']:.4f}** ± {found['error']:.1g}", f"{found['seconds']:.0f}",
                    f"{found['on_target']:.3f}")  # fmt: skip
            yield (CASES[name].title if k == 0 else "", peer.who, f"{peer.rrmsd:.3f}", peer.took or "not stated",
                   *(ours if k == 0 else ("", "", "")))  # fmt: skip


def write() -> None:
    """The page from what is recorded."""
    files.put(PAGE, page(known(), accuracy.known()).encode())


def main() -> None:
    """Record, and write after each scene, so that nothing is lost on the way."""
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
        recorded = known() | {name: designed(name, asked.sun_picture)}
        recorded = {key: recorded[key] for key in CASES if key in recorded}
        files.put(RECORDED, (json.dumps(rounded(recorded, DIGITS), ensure_ascii=False, indent=1) + "\n").encode())
        write()
    if known():
        write()


if __name__ == "__main__":
    main()
