"""The record of report.json put together from a design, its proof, its diagnosis and the remarks on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from bstcad.analysis.light import FinestDetail, finest_detail
from bstcad.measured.form_error import MAP
from bstcad.measured.made_part import MadePart
from bstcad.optics.lens import Lens
from bstcad.report import remarks
from bstcad.report.light_figures import rrmsd
from bstcad.report.prescription import prescription
from bstcad.report.record import Contents, LeftOut, Line, Making
from bstcad.report.vocabulary import LEFT_OUT, extent, simulated
from bstcad.scene.scene import Scene
from bstcad.verify.checks import Verification
from bstcad.verify.verdict import verdict


def contents_of(
    scene: Scene, lens: Lens, target: np.ndarray, proof: Verification, *, making: Making,
    circumstances: Mapping[str, Any], estimates: tuple[LeftOut, ...], diagnosis: Mapping[str, Any],
) -> Contents:  # fmt: skip
    """The contents of report.json.

    lens: as designed.  circumstances: version, machine and versions of libraries now, which those of its making
    precede.  estimates: of the effects that are left out.  diagnosis: convergence, remaining_error, limits and bounds.
    """
    known = {key: value for key, value in vars(making).items() if value is not None}
    dark = proof.leak
    contents = Contents(
        **{**circumstances, **known},
        **diagnosis,
        name=scene.name,
        title=scene.title,
        verdict=verdict(proof.passed, ()),
        passed=proof.passed,
        rrmsd=proof.rrmsd,
        rrmsd_tent=proof.rrmsd_tent,
        rrmsd_noise=proof.rrmsd_noise,
        light_on_target=proof.flux["on target"],
        efficiency=proof.efficiency,
        flux=proof.flux,
        prescription=asdict(prescription(scene, lens, proof.shape)),
        checks=proof.checks,
        effects={
            "simulated": tuple(item.what for item in simulated(scene)),
            "left_out": tuple(LEFT_OUT[entry.kind] for entry in estimates),
        },
        seed=scene.tailoring.seed,
        leak=dark and dark.share,
        contrast=dark and dark.contrast,
        optic=scene.optic,
        quality=scene.tailoring.quality,
        rrmsd_asked=proof.rrmsd_asked,
        rays_traced=proof.rays,
        shape=proof.shape,
        stability=proof.stability,
        blur=proof.blur,
        finest_detail=_finest_detail(scene, proof, estimates),
        lines=tuple(Line(line.wavelength, line.share, rrmsd(target, line.picture)) for line in proof.lines),
        estimates=estimates,
    )
    return _remarked(contents, tuple(remarks.sentences(contents, scene, target, proof.irradiance)))


def with_part(contents: Contents, part: MadePart, place: str = "") -> Contents:
    """The same with a made part, whose checks are of the verdict too; place: of its own folder, from the report's."""
    measured = part.facts | {"deviation_map": [f"{place}{name}" for name in MAP]}
    passed, checks = contents.passed and part.facts["passed"], (*contents.checks, *part.checks)
    contents = replace(contents, checks=checks, passed=passed, measured=measured)
    return _remarked(contents, tuple(remarks.outliers(part.facts)))


def _remarked(contents: Contents, more: tuple[str, ...]) -> Contents:
    """The same with more remarks, and the verdict that follows."""
    given_up = (*contents.given_up, *more)
    return replace(contents, given_up=given_up, verdict=verdict(contents.passed, given_up))


def _finest_detail(scene: Scene, proof: Verification, estimates: tuple[LeftOut, ...]) -> FinestDetail | None:
    """Of the source as the scene has it, or, of a point and of parallel light, as large as the estimates take it."""
    screen = scene.target.screen
    if proof.blur:
        of = ", ".join(f"source.{key} = {size}" for key, size in extent(scene.source))
        return finest_detail(proof.blur.pixels, proof.lens, screen, of)
    for entry in estimates:
        if entry.kind == "source size" and entry.blur_pixels is not None:
            return finest_detail(entry.blur_pixels, proof.lens, screen, of=entry.detail, assumed=entry.assumed)
    return None
