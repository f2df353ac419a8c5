"""`bstcad tolerance`: study a design in its folder, write tolerance.json and the section of report.html on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

import bstcad
from bstcad import files
from bstcad.cad import step_writing
from bstcad.optics.measure import Effort, measure
from bstcad.report import tolerances
from bstcad.report.drawing import png
from bstcad.report.light_figures import SHOWN, View, histogram, worst_trials
from bstcad.report.tolerances import Grade, Inverse, Sensitivity, Tolerances, Trial
from bstcad.runs import folder as folders
from bstcad.runs.folder import read_nominal
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tolerance import study as studies
from bstcad.tolerance.grades import GRADES, perturbations, start_of, whole_table
from bstcad.tolerance.perturbations import Perturbation, perturbed, trial
from bstcad.tolerance.setup import Setup
from bstcad.tolerance.study import Progress, Study, Yield
from bstcad.tolerance.superposition import Pictures, Spread, here
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT, Nominal

TUBES = 1031  # a side, a channel: their error is the same in every trial
POINTS = 64  # of an extended source


def tolerance(
    folder: Path, *, grade: str | None = None, seed: int = 0, trials: int = studies.LINEAR, full: int = studies.FULL,
    wanted: float | None = None, tubes: int = TUBES, progress: Progress = lambda stage, done, of, text: None,
    spread: Spread = here,
) -> Tolerances:  # fmt: skip
    """Study the design in a folder, by the [[tolerance]] tables of its scene; the record of tolerance.json.

    grade: from which they start, whatever grade they name.
    wanted: the yield (0 … 1) that the loosest tolerances are to keep; None: they are not asked for.
    spread: where pictures are traced; no bit of the study depends on it.
    """
    with folders.amending(folder) as amended:
        scene, nominal = read_nominal(folder)
        if nominal.ghost is not None:
            raise SceneError("[[effects]] ghost: tolerances do not follow stray light yet; remove it from scene.toml")
        pictures = _pictures(scene, nominal, grade, tubes)
        light = measure(
            nominal.lens, nominal.channels, nominal.screen, nominal.target,
            effort=nominal.effort(Effort(witness=False)), draw=nominal.draw,
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
        inverse = None if wanted is None else _inverse(found, wanted)
        record = _record(found, name=scene.name, grade=_grade(scene, grade), tubes=tubes, inverse=inverse)
        progress("report", 0, 1, "")
        drawn = _drawn(scene, pictures, found)
        tolerances.write(record, amended / "tolerance.json")
        progress("report", 1, 1, _put_into_page(record, drawn, folder / "report.html", amended, optic=scene.optic))
    return record


def _put_into_page(record: Tolerances, drawn: dict[str, bytes], page: Path, folder: Path, *, optic: str) -> str:
    """The figures, and the page with a section on the study; a sentence if the page has no place for it."""
    place = files.folder_in_place(folder / "figures")
    for name, picture in drawn.items():
        files.put(place / f"{name}.png", picture)
    whole = tolerances.put_into(page, tolerances.section(record, drawn, optic))
    if whole is None:
        return "report.html has no place for it; bstcad verify writes one that has"
    files.put(folder / "report.html", whole)
    return ""


def _drawn(scene: Scene, pictures: Pictures, found: Study) -> dict[str, bytes]:
    """The pictures of the report's section."""
    worst = [
        (k, float(found.full[k]), pictures.light(trial(found.perturbations, found.seed, k)))
        for k in found.worst[:SHOWN]
    ]
    nominal = pictures.light(np.zeros(len(found.perturbations)))
    trials = histogram(found.rrmsd, found.limit, linear=found.linear, full=found.full, adjusted=found.adjusted)
    shown = worst_trials(found.rrmsd, nominal, worst, View.of(scene))
    return dict(zip(tolerances.FIGURES, map(png, (trials, shown)), strict=True))


def write_trial(folder: Path, number: int, path: Path, *, grade: str | None = None, seed: int = 0) -> dict[str, float]:
    """The lens of one trial as a STEP file, in its own frame; its amounts by name, decentres and tilts among them."""
    scene, nominal = read_nominal(folder)
    pictures = _pictures(scene, nominal, grade, TUBES)
    amounts = trial(pictures.perturbations, seed, number)
    lens = perturbed(pictures.setup, pictures.perturbations, amounts).lens
    step_writing.write_lens(lens, path, f"{scene.name}, trial {number}")
    return _by_name(pictures.perturbations, amounts)


def _pictures(scene: Scene, nominal: Nominal, grade: str | None, tubes: int) -> Pictures:
    channels = scene.channels(POINTS) if scene.source.extent else scene.channels()
    setup = Setup(nominal.lens, channels, scene.target.screen)
    errors = perturbations(setup, whole_table(scene.tolerance, grade), scene.lens.material)
    return Pictures(setup, errors, nominal.target, tubes)


def _grade(scene: Scene, grade: str | None) -> Grade:
    """From which the errors start, in words, and whether the scene says otherwise of some."""
    name = start_of(whole_table(scene.tolerance, grade))
    words = GRADES[name].words if name in GRADES else "nothing"
    if any(entry.name for entry in scene.tolerance):
        words = f"{words} but for what the scene says" if name in GRADES else "as the scene says"
    return Grade(name, words)


def _by_name(errors: Sequence[Perturbation], amounts: np.ndarray) -> dict[str, float]:
    return {p.kind.name: float(a) for p, a in zip(errors, amounts, strict=True)}


def _record(found: Study, *, name: str, grade: Grade, tubes: int, inverse: Inverse | None) -> Tolerances:
    off = found.disagreement
    return Tolerances(
        name=name,
        version=bstcad.__version__,
        grade=grade,
        seed=found.seed,
        tubes=tubes,
        limit=found.limit,
        rrmsd=found.rrmsd,
        trials=len(found.linear),
        full_trials=len(found.full),
        passed=_interval(found.passed),
        passed_full=_interval(found.passed_full),
        passed_adjusted=_interval(found.passed_adjusted),
        rrmsd_trials=_percentiles(found.linear),
        rrmsd_full=_percentiles(found.full),
        rrmsd_adjusted=_percentiles(found.adjusted),
        model_off={"median": float(np.median(off)), "95 %": float(np.percentile(off, 95))},
        sensitivities=tuple(map(_sensitivity, found.sensitivities)),
        worst=tuple(
            Trial(k, float(found.full[k]), _by_name(found.perturbations, trial(found.perturbations, found.seed, k)))
            for k in found.worst
        ),
        inverse=inverse,
    )


def _sensitivity(found: studies.Sensitivity) -> Sensitivity:
    error = found.perturbation
    return Sensitivity(
        name=error.kind.name, words=error.kind.words, unit=error.kind.unit, limit=error.limit,
        distribution=error.distribution, cost=error.cost, sigma=error.sigma, rrmsd_change=found.rrmsd_change,
        share=found.share,
    )  # fmt: skip


def _percentiles(rrmsds: np.ndarray) -> dict[str, float]:
    return {f"{p} %": float(np.percentile(rrmsds, p)) for p in (5, 50, 95)}


def _interval(found: Yield) -> tuple[float, float, float]:
    return found.low, found.likely, found.high


def _inverse(found: Study, wanted: float) -> Inverse:
    loose, kept = studies.loosest(found, wanted)
    return Inverse(wanted, _interval(kept), {p.kind.name: p.limit for p in loose})
