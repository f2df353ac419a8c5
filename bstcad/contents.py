"""What report.json holds of a design that was proved: the record of its figures, its diagnosis, its remarks."""

from __future__ import annotations

from dataclasses import asdict, replace

from bstcad.analysis.blur import FinestDetail, finest_detail
from bstcad.measured.deviation import MAP
from bstcad.measured.made_part import MadePart
from bstcad.report import part_words, prescription, shortfalls
from bstcad.report.light_figures import rrmsd as rrmsd_of
from bstcad.report.record import Contents, LeftOut, Line
from bstcad.report.vocabulary import LEFT_OUT, extent, simulated
from bstcad.runs.environment import circumstances
from bstcad.runs.folder import Made
from bstcad.sweep.diagnosis import diagnosis, of_bounds
from bstcad.verify.checks import Verification
from bstcad.verify.verdict import verdict


def contents_of(made: Made, proof: Verification, estimates: tuple[LeftOut, ...]) -> Contents:
    """The contents of report.json; estimates: what is left out, and what it would change."""
    scene = made.scene
    told = {key: value for key, value in vars(made.making).items() if value is not None}  # of an earlier run, say
    dark = proof.leak
    blurred = proof.blur.rrmsd if proof.blur else 0.0
    diagnosed = diagnosis(
        scene, made.making, proof.lens, picture=proof.irradiance, target=made.target, rrmsd=proof.rrmsd,
        efficiency=proof.efficiency, blurred=blurred,
    )  # fmt: skip
    finest = _finest_detail(made, proof, estimates)
    contents = Contents(
        **{**circumstances(made.device), **told},
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
        prescription=asdict(prescription.prescription(scene, made.lens, proof.shape)),
        checks=proof.checks,
        effects={
            "simulated": tuple(item.what for item in simulated(scene)),
            "left_out": tuple(LEFT_OUT[entry.kind] for entry in estimates),
        },
        seed=scene.tailoring.seed,
        leak=dark and dark.share,
        contrast=dark and dark.contrast,
        optic=made.optic,
        quality=scene.tailoring.quality,
        rrmsd_asked=proof.rrmsd_asked,
        rays_traced=proof.rays,
        shape=proof.shape,
        stability=proof.stability,
        blur=proof.blur and asdict(proof.blur),
        finest_detail=finest and asdict(finest),
        lines=tuple(Line(line.wavelength, line.share, rrmsd_of(made.target, line.picture)) for line in proof.lines)
        or None,
        estimates=estimates,
        convergence=diagnosed.convergence,
        remaining_error=diagnosed.remaining_error,
        limits=diagnosed.limits,
        bounds=of_bounds(scene, made.making, proof.at_bounds),
    )
    said = tuple(shortfalls.sentences(contents, scene, made.target, proof.irradiance))
    return replace(contents, verdict=verdict(proof.passed, said), given_up=said)


def _finest_detail(made: Made, proof: Verification, estimates: tuple[LeftOut, ...]) -> FinestDetail | None:
    """Of the source as the scene has it, or, of a point and of parallel light, as large as the estimates take it."""
    screen, source = made.scene.target.screen, made.scene.source
    if proof.blur:
        of = ", ".join(f"source.{key} = {size}" for key, size in extent(source))
        return finest_detail(proof.blur.pixels, proof.lens, screen, of)
    for entry in estimates:
        if entry.kind == "source size" and entry.blur_pixels is not None:
            return finest_detail(entry.blur_pixels, proof.lens, screen, entry.detail, entry.assumed)
    return None


def with_part(contents: Contents, part: MadePart, place: str = "") -> Contents:
    """The same with a made part, whose checks are of the verdict too; place: of its own folder, from the report's."""
    passed, said = contents.passed and part.facts["passed"], (*contents.given_up, *part_words.remarks(part.facts))
    return replace(
        contents, checks=(*contents.checks, *part.checks), passed=passed, verdict=verdict(passed, said), given_up=said,
        measured=part.facts | {"deviation_map": [f"{place}{name}" for name in MAP]},
    )  # fmt: skip
