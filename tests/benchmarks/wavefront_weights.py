"""A picture and parallel light behind it, by the weight of the wavefront: both errors, with one free face and with two.

make tradeoff     designs a portrait of 128 pixels, 100 mm behind a lens, eight times, and draws
                  docs/wavefront-weights.png: a minute and a half on two cores
"""

from __future__ import annotations

from matplotlib.figure import Figure

import bstcad
from bstcad.runs import processes
from bstcad.scene.scene import load
from tests.benchmarks.cold import ROOT, TEMPLATES

WEIGHTS = (1e-4, 1e-2, 1.0, 100.0)  # weights of (RMS / λ)²; the weight of RRMSD² is 1
FACES = {"front and back": {}, "back": {"lens.front": {"kind": "plane", "z": 0.0}}}  # changes of the template
SMALL = {"lens.back.control_points": 129, "target.pixels": 128, "tailoring.rays": 512}


def main() -> None:
    """Draw both errors of every design, a curve for each choice of faces."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for (name, front), line in zip(FACES.items(), ("o-", "s--"), strict=True):
        errors = []
        for weight in WEIGHTS:
            scene = load(TEMPLATES / "collimated_portrait.toml").changed(front | SMALL | {"wavefront.weight": weight})
            report = bstcad.design(scene, progress=False).verify(progress=False)
            errors.append((report.wavefront.rms, report.rrmsd))
            print(name, weight, errors[-1], flush=True)
            axes.annotate(f"{weight:g}", errors[-1], xytext=(5, 4), textcoords="offset points", fontsize=8)
        axes.loglog(*zip(*errors, strict=True), line, label=f"free: {name}")
    axes.set(xlabel="Wavefront error, RMS (waves of 633 nm)", ylabel="RRMSD of the portrait")
    axes.set_title("A portrait and parallel light: numbers are wavefront.weight", fontsize=10)
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(ROOT / "docs" / "wavefront-weights.png", dpi=110)


if __name__ == "__main__":
    processes.keep_freed()
    main()
