"""Command `bstcad tolerance`: study a design in its folder, write tolerance.json and the section of report.html."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import bstcad
from bstcad.cad import step_writing
from bstcad.designs import folder as folders
from bstcad.designs.folder import read_nominal
from bstcad.figures.drawing import png
from bstcad.figures.light_figures import MAX_WORST_TRIALS, View, histogram, worst_trials
from bstcad.manufacture.tolerance import study as studies
from bstcad.manufacture.tolerance import tolerances
from bstcad.manufacture.tolerance.grades import GRADES, base_grade, graded_table, perturbations
from bstcad.manufacture.tolerance.perturbations import Kind, Setup, perturb, trials
from bstcad.manufacture.tolerance.study import (
    Study,
    StudySettings,
    TargetPictures,
    TracedGoal,
    Wavefronts,
    Yield,
    estimate_yield,
)
from bstcad.manufacture.tolerance.tolerances import Grade, Inverse, TargetStudy, Tolerances, Trial, WavefrontStudy
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.measure import Effort, measure
from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.quality import Tolerance
from bstcad.verify.nominal import DEFAULT_RRMSD_LIMIT, Nominal

TRACED_SOURCE_POINTS = 64  # number of points that sample an extended source


def tolerance(folder: Path, settings: StudySettings) -> Tolerances:
    """Study the design in a folder with the [[tolerance]] tables of its scene; return the record of tolerance.json."""
    with folders.amending(folder) as amended:
        nominal = read_nominal(folder)
        scene = nominal.scene
        if scene.ghost is not None:
            raise SceneError(
                "[[effects]] ghost: tolerances do not include ghosts yet; remove this table from scene.toml"
            )
        pictures, limit = _pictures(nominal, settings), scene.accept.rrmsd or DEFAULT_RRMSD_LIMIT
        goals: list[tuple[str, TracedGoal, float, float]]  # key of the limit, goal, limit, figure of the design
        goals = [("accept.rrmsd", each, limit, _rrmsd(nominal, each)) for each in pictures]
        if scene.wavefront is not None:
            setup, errors = pictures[0].setup, pictures[0].perturbations
            waves = Wavefronts(setup, errors, scene.wavefront, scene.source.main_wavelength)
            goals.append(("accept.wavefront", waves, scene.accept.wavefront or math.inf, waves.design_rms))
        for key, _, allowed, designed in goals if settings.wanted is not None else ():
            if not designed < allowed:
                raise SceneError(
                    f"{key}: the design itself has the value {designed:.4f}, which is not below the limit {allowed:g}, "
                    "so no tolerances give the wanted yield; improve the design, or raise this limit in scene.toml"
                )
        results = [studies.study(goal, allowed, designed, settings) for _, goal, allowed, designed in goals]
        study = studies.worst_of(results[: len(pictures)])
        record = _record(nominal, settings, study, results)
        settings.progress("report", 0, 1, "")
        tolerances.write(record, amended / "tolerance.json")
        images = _draw_figures(View.of(scene), nominal.goals[0].suffix, pictures[0], study, own=results[0])
        figures = files.folder_in_place(amended / "figures")
        for name, picture in images.items():
            files.put(figures / f"{name}.png", picture)
        page = tolerances.put_into(folder / "report.html", tolerances.section(record, images, scene.optic))
        if page is not None:
            files.put(amended / "report.html", page)
        missing = "report.html has no section for tolerances; bstcad verify writes a report that has one"
        settings.progress("report", 1, 1, missing if page is None else "")
    return record


def write_trial(folder: Path, number: int, path: Path, settings: StudySettings) -> tuple[tuple[Kind, float], ...]:
    """Write the lens of one trial as a STEP file, in the frame of the lens; return (kind, amount) of all its errors."""
    nominal = read_nominal(folder)
    pictures = _pictures(nominal, settings)[0]
    [amounts] = trials(pictures.perturbations, settings.seed, [number])
    lens = perturb(pictures.setup, pictures.perturbations, amounts).lens
    step_writing.write_lens(lens, path, f"{nominal.scene.name}, trial {number}")
    return tuple((p.kind, float(a)) for p, a in zip(pictures.perturbations, amounts, strict=True))


def _pictures(nominal: Nominal, settings: StudySettings) -> tuple[TargetPictures, ...]:
    """Return the pictures of each target, all with the same errors; the screens move together."""
    scene = nominal.scene
    channels = scene.channels(TRACED_SOURCE_POINTS) if scene.source.extent else scene.channels()
    setup = Setup(nominal.lens, channels, nominal.goals[0].screen)
    errors = perturbations(setup, graded_table(scene.tolerance, settings.grade), scene.lens.material)
    setups = [(replace(setup, screen=goal.screen), goal.picture) for goal in nominal.goals]
    return tuple(TargetPictures(each, errors, picture, settings.tubes) for each, picture in setups)


def _rrmsd(nominal: Nominal, pictures: TargetPictures) -> float:
    screen, effort = pictures.setup.screen, nominal.effort(Effort(witness=False, cells=1))
    lens, channels, sampler = nominal.lens, nominal.channels, nominal.scene.sampler
    return measure(lens, channels, screen, pictures.target, effort=effort, sampler=sampler).rrmsd


def _grade(stated: Sequence[Tolerance], grade: str | None) -> Grade:
    """Return the grade of the errors; its words state whether the stated tolerances override it for some of them."""
    name = base_grade(graded_table(stated, grade))
    words = GRADES[name].words if name in GRADES else "nothing"
    if any(entry.name for entry in stated):
        words = f"{words}, except for the tolerances in the scene" if name in GRADES else "as stated in the scene"
    return Grade(name, words)


def _record(nominal: Nominal, settings: StudySettings, study: Study, goals: Sequence[Study]) -> Tolerances:
    """Return the record; study: worst target; goals: studies of each target, then of the wavefront if stated."""
    count = len(nominal.goals)
    each, wave = goals[:count], goals[count] if len(goals) > count else None
    change = wave.change_of if wave else lambda error: None
    names = [error.kind.name for error in study.perturbations]
    worst = zip(study.worst, trials(study.perturbations, study.seed, study.worst).tolist(), strict=True)
    inverse = None
    if settings.wanted is not None:
        loosened, achieved = studies.loosest_limits(goals[0], settings.wanted, goals[1:])
        inverse = Inverse(settings.wanted, achieved, {error.kind.name: error.limit for error in loosened})
    return Tolerances(
        name=nominal.scene.name,
        version=bstcad.__version__,
        grade=_grade(nominal.scene.tolerance, settings.grade),
        seed=study.seed,
        tubes=settings.tubes,
        limit=study.limit,
        trials=len(study.linear),
        full_trials=len(study.full),
        **_shared_figures(study, goals),
        sensitivities=tuple(replace(s, wavefront_change=change(s.name)) for s in study.sensitivities),
        worst=tuple(Trial(k, float(study.full[k]), dict(zip(names, amounts, strict=True))) for k, amounts in worst),
        inverse=inverse,
        targets=tuple(map(_of_target, nominal.goals, each)) if count > 1 else None,
        wavefront=_of_wavefront(wave) if wave else None,
    )


def _of_target(goal: Goal, study: Study) -> TargetStudy:
    where, figures = goal.screen.receiver.position_text(), _shared_figures(study, [study])
    return TargetStudy(key=goal.key, where=where, **figures, sensitivities=study.sensitivities)


def _shared_figures(study: Study, goals: Sequence[Study]) -> dict[str, Any]:
    """Return the fields that Tolerances and TargetStudy share; goals: studies whose limits determine the yields."""
    return {
        "rrmsd": study.rrmsd,
        "passed": _joint_yield(goals, "linear"),
        "passed_full": _joint_yield(goals, "full"),
        "passed_adjusted": _joint_yield(goals, "adjusted"),
        "rrmsd_trials": _percentiles(study.linear),
        "rrmsd_full": _percentiles(study.full),
        "rrmsd_adjusted": _percentiles(study.adjusted),
        "model_off": _disagreement(study),
    }


def _of_wavefront(study: Study) -> WavefrontStudy:
    by_model, traced, off = _percentiles(study.linear), _percentiles(study.full), _disagreement(study)
    limit = passed = passed_full = None
    if math.isfinite(study.limit):
        limit, (passed, passed_full) = study.limit, map(study.fraction_within, (study.linear, study.full))
    return WavefrontStudy(study.rrmsd, by_model, traced, off, limit=limit, passed=passed, passed_full=passed_full)


def _joint_yield(goals: Sequence[Study], trials: str) -> Yield:
    """Return (low, estimate, high) of the fraction of trials ("linear", "full" or "adjusted") within all limits."""
    return estimate_yield(np.logical_and.reduce([getattr(goal, trials) <= goal.limit for goal in goals]))


def _percentiles(figures: np.ndarray) -> tolerances.Spread:
    low, median, high = (float(np.percentile(figures, p)) for p in (5, 50, 95))
    return {"5 %": low, "50 %": median, "95 %": high}


def _disagreement(study: Study) -> tolerances.Disagreement:
    difference = study.disagreement
    return {"median": float(np.median(difference)), "95 %": float(np.percentile(difference, 95))}


def _draw_figures(view: View, suffix: str, pictures: TargetPictures, study: Study, *, own: Study) -> dict[str, bytes]:
    """Draw the figures of the report's section for the first target, whose study is `own`; study: the worst target.

    suffix: of the names of the first target's figures.
    """
    numbers = study.worst[:MAX_WORST_TRIALS]
    amounts = trials(study.perturbations, study.seed, numbers)
    worst = [(k, float(own.full[k]), pictures.light(z)) for k, z in zip(numbers, amounts, strict=True)]
    nominal = pictures.light([0.0] * len(study.perturbations))
    rrmsds = histogram(study.rrmsd, study.limit, linear=study.linear, full=study.full, adjusted=study.adjusted)
    images = rrmsds, worst_trials(own.rrmsd, nominal, worst, view, of=suffix)
    return dict(zip(tolerances.FIGURES, map(png, images), strict=True))
