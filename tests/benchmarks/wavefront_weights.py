"""A picture and parallel light behind it, by the weight of the wavefront: both errors, with one free face and with two.

make tradeoff     designs a portrait of 128 pixels, 100 mm behind a lens, eight times, and draws
                  docs/wavefront-weights.png: a minute and a half on two cores
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

import bstcad
from bstcad.runs import processes
from bstcad.scene.scene import Scene, load

ROOT = Path(__file__).parents[2]
WEIGHTS = (1e-4, 1e-2, 1.0, 100.0)  # of (RMS / λ)²; that of RRMSD² is 1
FACES = {"front and back": True, "back": False}  # is the front tailored too?
POINTS, PIXELS, RAYS = 129, 128, 512


def scene(tailored: bool, weight: float) -> Scene:
    """templates/collimated_portrait.toml with a quarter of the control points and pixels."""
    front = {} if tailored else {"lens.front": {"kind": "plane", "z": 0.0}}
    return load(ROOT / "templates" / "collimated_portrait.toml").changed(
        front
        | {
            "lens.back.control_points": POINTS,
            "target.pixels": PIXELS,
            "wavefront.weight": weight,
            "tailoring.rays": RAYS,
        }
    )


def errors(tailored: bool) -> Iterator[tuple[float, float, float]]:
    """(weight, RMS in waves without tilt, RRMSD) of each design."""
    for weight in WEIGHTS:
        report = bstcad.design(scene(tailored, weight), progress=False).verify(progress=False)
        found = weight, report.wavefront.rms, report.rrmsd
        print(tailored, found, flush=True)
        yield found


def draw(path: Path) -> None:
    """Both errors of every design, a curve for each choice of faces."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, tailored in FACES.items():
        weights, waves, rrmsd = zip(*errors(tailored), strict=True)
        axes.loglog(waves, rrmsd, "o-" if tailored else "s--", label=f"free: {name}")
        for weight, *at in zip(weights, waves, rrmsd, strict=True):
            axes.annotate(f"{weight:g}", at, xytext=(5, 4), textcoords="offset points", fontsize=8)
    axes.set(xlabel="Wavefront error, RMS (waves of 633 nm)", ylabel="RRMSD of the portrait")
    axes.set_title("A portrait and parallel light: numbers are wavefront.weight", fontsize=10)
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    processes.keep_freed()
    draw(ROOT / "docs" / "wavefront-weights.png")
