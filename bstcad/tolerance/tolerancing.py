"""`bstcad tolerance`: study a design in its folder, write tolerance.json and the section of report.html on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import bstcad
from bstcad import folder as folders
from bstcad.cad import step_writing
from bstcad.folder import read_nominal
from bstcad.optics.measure import Effort, measure
from bstcad.report import tolerances
from bstcad.report.drawing import png
from bstcad.report.light_figures import SHOWN, View, histogram, worst_trials
from bstcad.report.tolerances import Grade, Inverse, Tolerances, Trial
from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tolerance import study as studies
from bstcad.tolerance.grades import GRADES, perturbations, start_of, whole_table
from bstcad.tolerance.perturbations import Kind, Setup, perturbed, trials
from bstcad.tolerance.study import Pictures, Progress, Spread, Study, here
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT, Nominal

TUBES = 1031  # a side, a channel: their error is the same in every trial
POINTS = 64  # of an extended source


def tolerance(
    folder: Path, *, grade: str | None = None, seed: int = 0, trials: int = studies.LINEAR, full: int = studies.FULL,
    wanted: float | None = None, tubes: int = TUBES, progress: Progress = lambda *told: None,
    spread: Spread | None = None,
) -> Tolerances:  # fmt: skip
    """Study the design in a folder, by the [[tolerance]] tables of its scene; the record of tolerance.json.

    grade: from which they start, whatever grade they name.
    wanted: the yield (0 … 1) that the loosest tolerances are to keep; None: they are not asked for.
    spread: where pictures are traced, None: in this process; no bit of the study depends on it.
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
        study = studies.study(
            pictures, limit, seed, light.rrmsd, linear=trials, full=full, progress=progress, spread=spread or here
        )
        record = _record(study, wanted, name=scene.name, grade=_grade(scene, grade), tubes=tubes)
        if len(scene.targets) > 1:
            record = replace(record, target=scene.target_keys[0])
        progress("report", 0, 1, "")
        tolerances.write(record, amended / "tolerance.json")
        drawn = _drawn(scene, pictures, study)
        figures = files.folder_in_place(amended / "figures")
        for name, picture in drawn.items():
            files.put(figures / f"{name}.png", picture)
        page = tolerances.put_into(folder / "report.html", tolerances.section(record, drawn, scene.optic))
        if page is not None:
            files.put(amended / "report.html", page)
        missing = "report.html has no place for it; bstcad verify writes one that has"
        progress("report", 1, 1, missing if page is None else "")
    return record


def write_trial(
    folder: Path, number: int, path: Path, *, grade: str | None = None, seed: int = 0
) -> tuple[tuple[Kind, float], ...]:  # fmt: skip
    """The lens of one trial as a STEP file, in its own frame; its amounts by kind, decentres and tilts among them."""
    scene, nominal = read_nominal(folder)
    pictures = _pictures(scene, nominal, grade, TUBES)
    [amounts] = trials(pictures.perturbations, seed, [number])
    lens = perturbed(pictures.setup, pictures.perturbations, amounts).lens
    step_writing.write_lens(lens, path, f"{scene.name}, trial {number}")
    return tuple((p.kind, float(a)) for p, a in zip(pictures.perturbations, amounts, strict=True))


def _pictures(scene: Scene, nominal: Nominal, grade: str | None, tubes: int) -> Pictures:
    channels = scene.channels(POINTS) if scene.source.extent else scene.channels()
    setup = Setup(nominal.lens, channels, scene.target.screen)
    errors = perturbations(setup, whole_table(scene.tolerance, grade), scene.lens.material)
    return Pictures(setup, errors, nominal.target, tubes)


def _grade(scene: Scene, grade: str | None) -> Grade:
    """The grade from which the errors start, in words, and whether the scene says otherwise of some errors."""
    name = start_of(whole_table(scene.tolerance, grade))
    words = GRADES[name].words if name in GRADES else "nothing"
    if any(entry.name for entry in scene.tolerance):
        words = f"{words} but for what the scene says" if name in GRADES else "as the scene says"
    return Grade(name, words)


def _record(study: Study, wanted: float | None, *, name: str, grade: Grade, tubes: int) -> Tolerances:
    def percentiles(rrmsds: np.ndarray) -> dict[str, float]:
        return {f"{p} %": float(np.percentile(rrmsds, p)) for p in (5, 50, 95)}

    off, names = study.disagreement, [error.kind.name for error in study.perturbations]
    worst = zip(study.worst, trials(study.perturbations, study.seed, study.worst).tolist(), strict=True)
    inverse = None
    if wanted is not None:
        loose, kept = studies.loosest(study, wanted)
        inverse = Inverse(wanted, kept, {error.kind.name: error.limit for error in loose})
    return Tolerances(
        name=name, version=bstcad.__version__, grade=grade, seed=study.seed, tubes=tubes, limit=study.limit,
        rrmsd=study.rrmsd, trials=len(study.linear), full_trials=len(study.full),
        passed=study.share(study.linear), passed_full=study.share(study.full),
        passed_adjusted=study.share(study.adjusted),
        rrmsd_trials=percentiles(study.linear), rrmsd_full=percentiles(study.full),
        rrmsd_adjusted=percentiles(study.adjusted),
        model_off={"median": float(np.median(off)), "95 %": float(np.percentile(off, 95))},
        sensitivities=study.sensitivities,
        worst=tuple(Trial(k, float(study.full[k]), dict(zip(names, amounts, strict=True))) for k, amounts in worst),
        inverse=inverse,
    )  # fmt: skip


def _drawn(scene: Scene, pictures: Pictures, study: Study) -> dict[str, bytes]:
    """The pictures of the report's section."""
    shown = study.worst[:SHOWN]
    amounts = trials(study.perturbations, study.seed, shown)
    worst = [(k, float(study.full[k]), pictures.light(z)) for k, z in zip(shown, amounts, strict=True)]
    nominal = pictures.light(np.zeros(len(study.perturbations)))
    rrmsds = histogram(study.rrmsd, study.limit, linear=study.linear, full=study.full, adjusted=study.adjusted)
    drawn = rrmsds, worst_trials(study.rrmsd, nominal, worst, View.of(scene))
    return dict(zip(tolerances.FIGURES, map(png, drawn), strict=True))
