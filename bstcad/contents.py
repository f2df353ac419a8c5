"""What report.json holds of a design that was proved: the record of its figures, its price and what was given up."""

from __future__ import annotations

from dataclasses import asdict, replace

from bstcad.measured.made_part import MadePart
from bstcad.price import of_bounds, price
from bstcad.report import prescription, shortfalls
from bstcad.report.light_figures import rrmsd as rrmsd_of
from bstcad.report.record import Contents, LeftOut, Line
from bstcad.report.vocabulary import LEFT_OUT, simulated
from bstcad.runs.environment import circumstances
from bstcad.runs.folder import Made
from bstcad.verify.checks import Verification
from bstcad.verify.verdict import verdict


def contents_of(made: Made, proof: Verification, estimates: tuple[LeftOut, ...]) -> Contents:
    """The contents of report.json; estimates: what is left out, and what it would change."""
    scene = made.scene
    told = {key: value for key, value in vars(made.making).items() if value is not None}  # of an earlier run, say
    paid = price(scene, made.making, proof.lens, proof.irradiance, made.target, proof.rrmsd, proof.efficiency)
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
        optic=made.optic,
        quality=scene.tailoring.quality,
        rrmsd_asked=proof.rrmsd_asked,
        rays_traced=proof.rays,
        tubes_traced=proof.tubes,
        shape=proof.shape,
        stability=proof.stability,
        blur=proof.blur and asdict(proof.blur),
        lines=tuple(Line(line.wavelength, line.share, rrmsd_of(made.target, line.picture)) for line in proof.lines)
        or None,
        estimates=estimates,
        convergence=paid.convergence,
        remaining_error=paid.remaining_error,
        limits=paid.limits,
        bounds=of_bounds(scene, made.making, proof.at_bounds),
    )
    said = tuple(shortfalls.sentences(contents, scene, made.target, proof.irradiance))
    return replace(contents, verdict=verdict(proof.passed, said), given_up=said)


def with_part(contents: Contents, part: MadePart) -> Contents:
    """The same with a made part, whose checks are of the verdict too."""
    passed = contents.passed and part.facts["passed"]
    return replace(
        contents, checks=(*contents.checks, *part.checks), passed=passed, verdict=verdict(passed, contents.given_up),
        measured=part.facts,
    )  # fmt: skip
