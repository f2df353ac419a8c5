"""Command `bstcad tolerance`: study a design in its folder, write tolerance.json and the section of report.html."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import bstcad
from bstcad import folder as folders
from bstcad.cad import step_writing
from bstcad.folder import read_nominal
from bstcad.optics.measure import Effort, measure
from bstcad.report import tolerances
from bstcad.report.drawing import png
from bstcad.report.light_figures import MAX_WORST_TRIALS, View, histogram, worst_trials
from bstcad.report.tolerances import Grade, Inverse, TargetStudy, Tolerances, Trial, WavefrontStudy
from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.scene.target import Target
from bstcad.tolerance import study as studies
from bstcad.tolerance.grades import GRADES, base_grade, graded_table, perturbations
from bstcad.tolerance.perturbations import Kind, Setup, perturb, trials
from bstcad.tolerance.study import (
    Progress,
    Spread,
    Study,
    TargetPictures,
    Wavefronts,
    Yield,
    estimate_yield,
    run_locally,
)
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT, Nominal

DEFAULT_TUBES = 1031  # flux tubes per side and channel; their numerical error is the same in every trial
SOURCE_POINTS = 64  # number of points by which an extended source is sampled


def tolerance(
    folder: Path, *, grade: str | None = None, seed: int = 0, trials: int = studies.MODEL_TRIALS,
    full: int = studies.FULL_TRIALS, wanted: float | None = None, tubes: int = DEFAULT_TUBES,
    progress: Progress = lambda *event: None, spread: Spread | None = None,
) -> Tolerances:  # fmt: skip
    """Study the design in a folder by the [[tolerance]] tables of its scene; return the record of tolerance.json.

    grade: grade that overrides the one in the scene.
    wanted: yield (0 … 1) for which the loosest tolerances are sought; None: they are not sought.
    spread: executor of the traces, None: this process; results are equal to the last bit.
    """
    with folders.amending(folder) as amended:
        scene, nominal = read_nominal(folder)
        if scene.ghost is not None:
            raise SceneError(
                "[[effects]] ghost: tolerances do not include stray light yet; remove that table from scene.toml"
            )
        pictures, limit = _pictures(scene, nominal, grade, tubes), scene.accept.rrmsd or DEFAULT_RRMSD_LIMIT
        goals = [("accept.rrmsd", each, limit, _rrmsd(nominal, each)) for each in pictures]
        if scene.wavefront is not None:
            setup, errors = pictures[0].setup, pictures[0].perturbations
            waves = Wavefronts(setup, errors, scene.wavefront, scene.source.main_wavelength)
            goals.append(("accept.wavefront", waves, scene.accept.wavefront or math.inf, waves.design_rms))
        for key, _, allowed, designed in goals if wanted is not None else ():
            if not designed < allowed:
                raise SceneError(
                    f"{key}: the design itself has {designed:.4f}, which is not below {allowed:g}, so no tolerances "
                    "give that yield; improve the design, or raise the limit in scene.toml"
                )
        run = partial(studies.study, linear=trials, full=full, progress=progress, spread=spread or run_locally)
        results = [run(goal, allowed, seed, designed) for _, goal, allowed, designed in goals]
        study = studies.worst_of(results[: len(pictures)])
        record = _record(study, results, wanted, scene=scene, grade=_grade(scene, grade), tubes=tubes)
        progress("report", 0, 1, "")
        tolerances.write(record, amended / "tolerance.json")
        images = _figures(scene, pictures[0], study, own=results[0])
        figures = files.folder_in_place(amended / "figures")
        for name, picture in images.items():
            files.put(figures / f"{name}.png", picture)
        page = tolerances.put_into(folder / "report.html", tolerances.section(record, images, scene.optic))
        if page is not None:
            files.put(amended / "report.html", page)
        missing = "report.html has no section for tolerances; bstcad verify writes a report that has one"
        progress("report", 1, 1, missing if page is None else "")
    return record


def write_trial(
    folder: Path, number: int, path: Path, *, grade: str | None = None, seed: int = 0
) -> tuple[tuple[Kind, float], ...]:  # fmt: skip
    """Write the lens of one trial as a STEP file, in its own frame; return all amounts of the trial by kind."""
    scene, nominal = read_nominal(folder)
    pictures = _pictures(scene, nominal, grade, DEFAULT_TUBES)[0]
    [amounts] = trials(pictures.perturbations, seed, [number])
    lens = perturb(pictures.setup, pictures.perturbations, amounts).lens
    step_writing.write_lens(lens, path, f"{scene.name}, trial {number}")
    return tuple((p.kind, float(a)) for p, a in zip(pictures.perturbations, amounts, strict=True))


def _pictures(scene: Scene, nominal: Nominal, grade: str | None, tubes: int) -> tuple[TargetPictures, ...]:
    """Return the pictures of each target; all have the same errors, and their screens move together."""
    channels = scene.channels(SOURCE_POINTS) if scene.source.extent else scene.channels()
    setup = Setup(nominal.lens, channels, scene.target.screen)
    errors = perturbations(setup, graded_table(scene.tolerance, grade), scene.lens.material)
    setups = [(replace(setup, screen=goal.receiver), goal.picture) for goal in nominal.goals]
    return tuple(TargetPictures(each, errors, picture, tubes) for each, picture in setups)


def _rrmsd(nominal: Nominal, pictures: TargetPictures) -> float:
    return measure(
        nominal.lens, nominal.channels, pictures.setup.screen, pictures.target,
        effort=nominal.effort(Effort(witness=False)), draw=nominal.scene.draw,
    ).rrmsd  # fmt: skip


def _grade(scene: Scene, grade: str | None) -> Grade:
    """Return the grade of the errors, in words that state whether the scene overrides some of them."""
    name = base_grade(graded_table(scene.tolerance, grade))
    words = GRADES[name].words if name in GRADES else "nothing"
    if any(entry.name for entry in scene.tolerance):
        words = f"{words}, except for the tolerances in the scene" if name in GRADES else "as stated in the scene"
    return Grade(name, words)


def _record(
    study: Study, goals: Sequence[Study], wanted: float | None, *, scene: Scene, grade: Grade, tubes: int
) -> Tolerances:  # fmt: skip
    """Return the record; study: worst target; goals: studies of each target and, if one is stated, the wavefront."""
    count = len(scene.targets)
    each, wave = goals[:count], goals[count] if len(goals) > count else None
    names = [error.kind.name for error in study.perturbations]
    worst = zip(study.worst, trials(study.perturbations, study.seed, study.worst).tolist(), strict=True)
    inverse = None
    if wanted is not None:
        loosened, achieved = studies.loosest_limits(goals[0], wanted, goals[1:])
        inverse = Inverse(wanted, achieved, {error.kind.name: error.limit for error in loosened})
    return Tolerances(
        name=scene.name, version=bstcad.__version__, grade=grade, seed=study.seed, tubes=tubes, limit=study.limit,
        rrmsd=study.rrmsd, trials=len(study.linear), full_trials=len(study.full),
        passed=_joint_yield(goals, "linear"), passed_full=_joint_yield(goals, "full"),
        passed_adjusted=_joint_yield(goals, "adjusted"),
        rrmsd_trials=_percentiles(study.linear), rrmsd_full=_percentiles(study.full),
        rrmsd_adjusted=_percentiles(study.adjusted), model_off=_disagreement(study),
        sensitivities=tuple(
            replace(s, wavefront_change=wave and wave.change_of(s.name)) for s in study.sensitivities
        ),
        worst=tuple(Trial(k, float(study.full[k]), dict(zip(names, amounts, strict=True))) for k, amounts in worst),
        inverse=inverse,
        targets=tuple(map(_of_target, scene.target_keys, scene.targets, each)) if count > 1 else None,
        wavefront=wave and _of_wavefront(wave),
    )  # fmt: skip


def _of_target(key: str, target: Target, study: Study) -> TargetStudy:
    return TargetStudy(
        key=key, where=target.screen.plane.position_text(),
        rrmsd=study.rrmsd, passed=study.fraction_within(study.linear),
        passed_full=study.fraction_within(study.full), passed_adjusted=study.fraction_within(study.adjusted),
        rrmsd_trials=_percentiles(study.linear), rrmsd_full=_percentiles(study.full),
        rrmsd_adjusted=_percentiles(study.adjusted), model_off=_disagreement(study), sensitivities=study.sensitivities,
    )  # fmt: skip


def _of_wavefront(study: Study) -> WavefrontStudy:
    has_limit = math.isfinite(study.limit)
    return WavefrontStudy(
        limit=study.limit if has_limit else None,
        rms=study.rrmsd,
        passed=study.fraction_within(study.linear) if has_limit else None,
        passed_full=study.fraction_within(study.full) if has_limit else None,
        rms_trials=_percentiles(study.linear),
        rms_full=_percentiles(study.full),
        model_off=_disagreement(study),
    )


def _joint_yield(goals: Sequence[Study], trials: str) -> Yield:
    """Return the fraction of the trials ("linear", "full" or "adjusted") that are within the limits of all goals."""
    return estimate_yield(np.logical_and.reduce([getattr(goal, trials) <= goal.limit for goal in goals]))


def _percentiles(figures: np.ndarray) -> dict[str, float]:
    return {f"{p} %": float(np.percentile(figures, p)) for p in (5, 50, 95)}


def _disagreement(study: Study) -> dict[str, float]:
    difference = study.disagreement
    return {"median": float(np.median(difference)), "95 %": float(np.percentile(difference, 95))}


def _figures(scene: Scene, pictures: TargetPictures, study: Study, own: Study) -> dict[str, bytes]:
    """Draw the figures of the report's section for the first target, whose study is `own`; study: the worst target."""
    numbers = study.worst[:MAX_WORST_TRIALS]
    amounts = trials(study.perturbations, study.seed, numbers)
    worst = [(k, float(own.full[k]), pictures.light(z)) for k, z in zip(numbers, amounts, strict=True)]
    nominal = pictures.light(np.zeros(len(study.perturbations)))
    rrmsds = histogram(study.rrmsd, study.limit, linear=study.linear, full=study.full, adjusted=study.adjusted)
    suffix = f", {scene.target_keys[0]}" if len(scene.targets) > 1 else ""
    images = rrmsds, worst_trials(own.rrmsd, nominal, worst, View.of(scene), of=suffix)
    return dict(zip(tolerances.FIGURES, map(png, images), strict=True))
