"""What `bstcad tolerance` does: study a design in its folder, and write tolerance.json and report.html's section on it.

tolerance.json:

- name; version: of bstcad; grade: its name and words; seed; tubes: a side, a channel; limit: RRMSD; rrmsd: of the
  design
- trials: by the model; full_trials: of them by full traces
- yield, yield_full, yield_adjusted: [low, likely, high] of the trials, of the full traces, and of these with the screen
  adjusted; low and high are the 95 % interval of Wilson
- rrmsd_trials, rrmsd_full, rrmsd_adjusted: {"5 %", "50 %", "95 %"} of the same; model_off: {"median",
  "95 %"} of the model against the full traces, relative
- sensitivities: the worst first, each with name, words, unit, limit (±), distribution, cost, sigma, rrmsd_change (of
  one sigma) and share (of the mean square that all add to the picture)
- worst: of the fully traced trials, each with number, rrmsd and amounts {name: in the unit of its kind}
- inverse, where asked for: wanted, yield (by trials of its own), limits {name: ±}
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bstcad
from bstcad import files
from bstcad.cad import step_writing
from bstcad.optics.measure import Effort, measure
from bstcad.report import tolerances
from bstcad.report.light_figures import View
from bstcad.report.tolerance_figures import SHOWN, Trials, Worst, draw_tolerances
from bstcad.runs import folder as folders
from bstcad.runs.folder import read_nominal
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tolerance import study as studies
from bstcad.tolerance.grades import GRADES
from bstcad.tolerance.model import Pictures, Spread, here
from bstcad.tolerance.perturbation import Perturbation, perturbed, trial
from bstcad.tolerance.setup import Setup
from bstcad.tolerance.stated import perturbations, start_of, whole_table
from bstcad.tolerance.study import Progress, Study, Yield
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT

TUBES = 1031  # a side, a channel: what these leave out is the same in every trial
POINTS = 64  # of an extended source


def tolerance(
    folder: Path, *, grade: str | None = None, seed: int = 0, trials: int = studies.LINEAR, full: int = studies.FULL,
    wanted: float | None = None, tubes: int = TUBES, progress: Progress = lambda stage, done, of, text: None,
    spread: Spread = here,
) -> dict[str, Any]:  # fmt: skip
    """Study the design in a folder, by the [[tolerance]] tables of its scene; the entries of tolerance.json.

    grade: from which they start, whatever they say of that themselves.
    wanted: the yield (0 … 1) that the loosest tolerances are to keep; None: they are not asked for.
    spread: where pictures are traced; no bit of what is found depends on it.
    """
    with folders.amending(folder) as amended:
        scene, nominal = read_nominal(folder)
        if nominal.ghost is not None:
            raise SceneError("[[effects]] ghost: tolerances do not follow stray light yet; remove it from scene.toml")
        pictures = _pictures(scene, nominal.lens, nominal.target, grade, tubes)
        light = measure(
            nominal.lens, nominal.channels, nominal.screen, nominal.target,
            nominal.effort(Effort(witness=False)), draw=nominal.draw,
        )  # fmt: skip
        limit = scene.accept.rrmsd or DEFAULT_RRMSD_LIMIT
        if wanted is not None and not light.rrmsd < limit:
            raise SceneError(
                f"accept.rrmsd: the design itself is at {light.rrmsd:.4f}, not below {limit:g}, and no tolerances "
                "keep a yield; design it better, or allow more in scene.toml"
            )
        found = studies.study(
            pictures, limit, seed, light.rrmsd, linear=trials, full=full, progress=progress, spread=spread
        )
        facts = _facts(scene.name, _grade(scene, grade), found, tubes)
        if wanted is not None:
            facts["inverse"] = _inverse(found, wanted)
        progress("report", 0, 1, "")
        missing = _write(facts, _drawn(scene, pictures, found), scene.optic, folder / "report.html", amended)
        progress("report", 1, 1, missing)
    return facts


def _write(facts: dict[str, Any], drawn: dict[str, bytes], optic: str, page: Path, folder: Path) -> str:
    """tolerance.json, its figures, and the page with a section on them; what of that could not be, in words."""
    files.put(folder / "tolerance.json", (json.dumps(facts, ensure_ascii=False, indent=1) + "\n").encode())
    place = files.folder_in_place(folder / "figures")
    for name, picture in drawn.items():
        files.put(place / f"{name}.png", picture)
    whole = tolerances.put_into(page, tolerances.section(facts, drawn, optic))
    if whole is None:
        return "report.html has no place for it; bstcad verify writes one that has"
    files.put(folder / "report.html", whole)
    return ""


def _drawn(scene: Scene, pictures: Pictures, found: Study) -> dict[str, bytes]:
    """The pictures of the report's section."""
    wanted = scene.target
    view = View(wanted.x, wanted.y, wanted.seen_from, scene.optic, wanted.tilt)
    worst = [
        Worst(k, float(found.full[k]), pictures.light(trial(found.perturbations, found.seed, k)))
        for k in found.worst[:SHOWN]
    ]
    nominal = pictures.light(np.zeros(len(found.perturbations)))
    spread = Trials(found.rrmsd, found.limit, found.linear, found.full, found.adjusted)
    return draw_tolerances(spread, nominal, worst, view)


def write_trial(folder: Path, number: int, path: Path, *, grade: str | None = None, seed: int = 0) -> dict[str, float]:
    """The lens of one trial as a STEP file, in its own frame; its amounts by name, decentres and tilts among them."""
    scene, nominal = read_nominal(folder)
    pictures = _pictures(scene, nominal.lens, nominal.target, grade, TUBES)
    amounts = trial(pictures.perturbations, seed, number)
    lens = perturbed(pictures.setup, pictures.perturbations, amounts).lens
    step_writing.write_lens(lens, path, f"{scene.name}, trial {number}")
    return _by_name(pictures.perturbations, amounts)


def _pictures(scene: Scene, lens: Any, target: np.ndarray, grade: str | None, tubes: int) -> Pictures:
    channels = scene.channels(POINTS) if scene.source.extent else scene.channels()
    setup = Setup(lens, channels, scene.target.screen)
    return Pictures(
        setup, perturbations(setup, whole_table(scene.tolerance, grade), scene.lens.material), target, tubes
    )


def _grade(scene: Scene, grade: str | None) -> dict[str, str]:
    """From which the errors start, in words, and whether the scene says otherwise of some."""
    name = start_of(whole_table(scene.tolerance, grade))
    words = GRADES[name].words if name in GRADES else "nothing"
    if any(entry.name for entry in scene.tolerance):
        words = f"{words} but for what the scene says" if name in GRADES else "as the scene says"
    return {"name": name, "words": words}


def _by_name(errors: Sequence[Perturbation], amounts: np.ndarray) -> dict[str, float]:
    return {p.kind.name: float(a) for p, a in zip(errors, amounts, strict=True)}


def _facts(name: str, grade: dict[str, str], found: Study, tubes: int) -> dict[str, Any]:
    off = found.disagreement
    return {
        "name": name,
        "version": bstcad.__version__,
        "grade": grade,
        "seed": found.seed,
        "tubes": tubes,
        "limit": found.limit,
        "rrmsd": found.rrmsd,
        "trials": len(found.linear),
        "full_trials": len(found.full),
        "yield": _interval(found.passed),
        "yield_full": _interval(found.passed_full),
        "yield_adjusted": _interval(found.passed_adjusted),
        "rrmsd_trials": _spread(found.linear),
        "rrmsd_full": _spread(found.full),
        "rrmsd_adjusted": _spread(found.adjusted),
        "model_off": {"median": float(np.median(off)), "95 %": float(np.percentile(off, 95))},
        "sensitivities": [
            {
                "name": s.perturbation.kind.name,
                "words": s.perturbation.kind.words,
                "unit": s.perturbation.kind.unit,
                "limit": s.perturbation.limit,
                "distribution": s.perturbation.distribution,
                "cost": s.perturbation.cost,
                "sigma": s.perturbation.sigma,
                "rrmsd_change": s.rrmsd_change,
                "share": s.share,
            }
            for s in found.sensitivities
        ],
        "worst": [
            {
                "number": k,
                "rrmsd": float(found.full[k]),
                "amounts": _by_name(found.perturbations, trial(found.perturbations, found.seed, k)),
            }
            for k in found.worst
        ],
    }


def _spread(rrmsds: np.ndarray) -> dict[str, float]:
    return {f"{p} %": float(np.percentile(rrmsds, p)) for p in (5, 50, 95)}


def _interval(found: Yield) -> list[float]:
    return [found.low, found.likely, found.high]


def _inverse(found: Study, wanted: float) -> dict[str, Any]:
    loose, kept = studies.loosest(found, wanted)
    return {"wanted": wanted, "yield": _interval(kept), "limits": {p.kind.name: p.limit for p in loose}}
