"""`bstcad tolerance`: study a design in its folder, write tolerance.json and the section of report.html on it."""

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
from bstcad.report.light_figures import SHOWN, View, histogram, worst_trials
from bstcad.report.tolerances import Grade, Inverse, TargetStudy, Tolerances, Trial, WavefrontStudy
from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.scene.target import Target
from bstcad.tolerance import study as studies
from bstcad.tolerance.grades import GRADES, perturbations, start_of, whole_table
from bstcad.tolerance.perturbations import Kind, Setup, perturbed, trials
from bstcad.tolerance.study import Pictures, Progress, Spread, Study, Wavefronts, Yield, here, share_of
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
        if scene.ghost is not None:
            raise SceneError("[[effects]] ghost: tolerances do not follow stray light yet; remove it from scene.toml")
        pictures, limit = _pictures(scene, nominal, grade, tubes), scene.accept.rrmsd or DEFAULT_RRMSD_LIMIT
        goals = [("accept.rrmsd", each, limit, _rrmsd(nominal, each)) for each in pictures]
        if scene.wavefront is not None:
            setup, errors = pictures[0].setup, pictures[0].perturbations
            waves = Wavefronts(setup, errors, scene.wavefront, scene.source.main_wavelength)
            goals.append(("accept.wavefront", waves, scene.accept.wavefront or math.inf, waves.designed))
        for key, _, most, designed in goals if wanted is not None else ():
            if not designed < most:
                raise SceneError(
                    f"{key}: the design itself is at {designed:.4f}, not below {most:g}, and no tolerances "
                    "keep a yield; design it better, or allow more in scene.toml"
                )
        of = partial(studies.study, linear=trials, full=full, progress=progress, spread=spread or here)
        found = [of(goal, most, seed, designed) for _, goal, most, designed in goals]
        study = studies.worst_of(found[: len(pictures)])
        record = _record(study, found, wanted, scene=scene, grade=_grade(scene, grade), tubes=tubes)
        progress("report", 0, 1, "")
        tolerances.write(record, amended / "tolerance.json")
        drawn = _drawn(scene, pictures[0], study, own=found[0])
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
    pictures = _pictures(scene, nominal, grade, TUBES)[0]
    [amounts] = trials(pictures.perturbations, seed, [number])
    lens = perturbed(pictures.setup, pictures.perturbations, amounts).lens
    step_writing.write_lens(lens, path, f"{scene.name}, trial {number}")
    return tuple((p.kind, float(a)) for p, a in zip(pictures.perturbations, amounts, strict=True))


def _pictures(scene: Scene, nominal: Nominal, grade: str | None, tubes: int) -> tuple[Pictures, ...]:
    """Of each target; the errors are the same for all, and screens move alike."""
    channels = scene.channels(POINTS) if scene.source.extent else scene.channels()
    setup = Setup(nominal.lens, channels, scene.target.screen)
    errors = perturbations(setup, whole_table(scene.tolerance, grade), scene.lens.material)
    return tuple(Pictures(replace(setup, screen=goal.receiver), errors, goal.picture, tubes) for goal in nominal.goals)


def _rrmsd(nominal: Nominal, pictures: Pictures) -> float:
    """Of the design on the screen of these pictures, by rays."""
    return measure(
        nominal.lens, nominal.channels, pictures.setup.screen, pictures.target,
        effort=nominal.effort(Effort(witness=False)), draw=nominal.scene.draw,
    ).rrmsd  # fmt: skip


def _grade(scene: Scene, grade: str | None) -> Grade:
    """The grade from which the errors start, in words, and whether the scene says otherwise of some errors."""
    name = start_of(whole_table(scene.tolerance, grade))
    words = GRADES[name].words if name in GRADES else "nothing"
    if any(entry.name for entry in scene.tolerance):
        words = f"{words} but for what the scene says" if name in GRADES else "as the scene says"
    return Grade(name, words)


def _record(
    study: Study, goals: Sequence[Study], wanted: float | None, *, scene: Scene, grade: Grade, tubes: int
) -> Tolerances:  # fmt: skip
    """study: of the worst target; goals: of each target, and of the wavefront if one is wanted."""
    count = len(scene.targets)
    each, wave = goals[:count], goals[count] if len(goals) > count else None
    names = [error.kind.name for error in study.perturbations]
    worst = zip(study.worst, trials(study.perturbations, study.seed, study.worst).tolist(), strict=True)
    inverse = None
    if wanted is not None:
        loose, kept = studies.loosest(goals[0], wanted, goals[1:])
        inverse = Inverse(wanted, kept, {error.kind.name: error.limit for error in loose})
    return Tolerances(
        name=scene.name, version=bstcad.__version__, grade=grade, seed=study.seed, tubes=tubes, limit=study.limit,
        rrmsd=study.rrmsd, trials=len(study.linear), full_trials=len(study.full),
        passed=_together(goals, "linear"), passed_full=_together(goals, "full"),
        passed_adjusted=_together(goals, "adjusted"),
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
        key=key, where=target.screen.plane.where(), rrmsd=study.rrmsd, passed=study.share(study.linear),
        passed_full=study.share(study.full), passed_adjusted=study.share(study.adjusted),
        rrmsd_trials=_percentiles(study.linear), rrmsd_full=_percentiles(study.full),
        rrmsd_adjusted=_percentiles(study.adjusted), model_off=_disagreement(study), sensitivities=study.sensitivities,
    )  # fmt: skip


def _of_wavefront(study: Study) -> WavefrontStudy:
    asked = math.isfinite(study.limit)
    return WavefrontStudy(
        limit=study.limit if asked else None, rms=study.rrmsd, passed=study.share(study.linear) if asked else None,
        passed_full=study.share(study.full) if asked else None, rms_trials=_percentiles(study.linear),
        rms_full=_percentiles(study.full), model_off=_disagreement(study),
    )  # fmt: skip


def _together(goals: Sequence[Study], trials: str) -> Yield:
    """Share of these trials ("linear", "full" or "adjusted") that keep to the limits of all goals."""
    return share_of(np.logical_and.reduce([getattr(goal, trials) <= goal.limit for goal in goals]))


def _percentiles(figures: np.ndarray) -> dict[str, float]:
    return {f"{p} %": float(np.percentile(figures, p)) for p in (5, 50, 95)}


def _disagreement(study: Study) -> dict[str, float]:
    off = study.disagreement
    return {"median": float(np.median(off)), "95 %": float(np.percentile(off, 95))}


def _drawn(scene: Scene, pictures: Pictures, study: Study, own: Study) -> dict[str, bytes]:
    """The pictures of the report's section, on the first target; own: its study, that of the worst target `study`."""
    shown = study.worst[:SHOWN]
    amounts = trials(study.perturbations, study.seed, shown)
    worst = [(k, float(own.full[k]), pictures.light(z)) for k, z in zip(shown, amounts, strict=True)]
    nominal = pictures.light(np.zeros(len(study.perturbations)))
    rrmsds = histogram(study.rrmsd, study.limit, linear=study.linear, full=study.full, adjusted=study.adjusted)
    of = f", {scene.target_keys[0]}" if len(scene.targets) > 1 else ""
    drawn = rrmsds, worst_trials(own.rrmsd, nominal, worst, View.of(scene), of=of)
    return dict(zip(tolerances.FIGURES, map(png, drawn), strict=True))
