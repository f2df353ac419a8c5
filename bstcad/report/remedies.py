"""What limits a design, in a sentence with the figures that say so, and what to change in the scene."""

from __future__ import annotations

import math

from bstcad.analysis.bottleneck import Limit
from bstcad.report.units import about, number, two_digits
from bstcad.scene.scene import Scene

RESTS = 0.01  # power of time by which a curve that falls no faster has come to rest
NOTHING = 0.05  # of the RRMSD: these estimates do not tell less from none


def because(limit: Limit, scene: Scene) -> str:
    """Why it limits, and behind the last semicolon what one step of it takes and would leave."""
    sentence = SENTENCES[limit.by](limit, scene)
    if "blurred" not in limit.figures:
        return sentence
    why, _, step = sentence.rpartition("; ")
    return f"{why}; the source's size alone blurs the target to an RRMSD of {number(limit.figures['blurred'])}; {step}"


def _times(limit: Limit) -> str:
    left = two_digits(limit.rrmsd)
    if left < NOTHING:
        return "hardly any of the RRMSD"
    return f"about {number(left)} times the RRMSD" if left < 1 else "the RRMSD as it is"


def _evaluations(limit: Limit, scene: Scene) -> str:
    knobs = scene.tailoring.resolved(scene.lens.back.control_points)
    power = limit.figures["power"]
    falls = f"the curve still falls, as time to the power of {about(-power)}"
    falls = falls if power >= RESTS else "the curve has come to rest"
    return f"{falls}; tailoring.stage2_iterations = {2 * knobs.stage2_iterations} would leave {_times(limit)}"


def _control_points(limit: Limit, scene: Scene) -> str:
    finer, found = 2 * scene.lens.back.control_points - 1, limit.figures
    few, half = (about(found[name]) for name in ("scarce", "median"))
    return (
        f"a tenth of the lit pixels have less than {few} control cells each, half of them less than {half}; what of "
        f"the target is finer than the cells can make is an RRMSD of {number(found['floor'])}, and with twice as many "
        f"a side of {number(found['finer'])}; lens.back.control_points = {finer} would leave {_times(limit)}"
    )


def _tubes(limit: Limit, scene: Scene) -> str:
    knobs, found = scene.tailoring.resolved(scene.lens.back.control_points), limit.figures
    own, rays = number(found["own"]), number(found["finer"])
    seen = f"the tubes that tailored it see an RRMSD of {own}, independent rays {rays}"
    if scene.source.extent is not None:
        seen = f"the tubes and source points that tailored it see an RRMSD of {own}, rays from other points {rays}"
        return f"{seen}; tailoring.source_points = {2 * knobs.source_points} would leave {_times(limit)}"
    return f"{seen}; tailoring.rays = {math.ceil(2**0.5 * knobs.rays)} would leave {_times(limit)}"


def _source_size(limit: Limit, scene: Scene) -> str:
    found = limit.figures
    return (
        f"with a third, two thirds and all of the source's size there was an RRMSD of {number(found['third'])}, "
        f"{number(found['two thirds'])} and {number(found['whole'])}; a source of half the size, or the target "
        f"at half the distance, would leave {_times(limit)}"
    )


def _precision(limit: Limit, scene: Scene) -> str:
    found = limit.figures
    return (
        f"float32 comes to an RRMSD of {number(found['float32'])} where float64 comes to {number(found['float64'])}; "
        f'tailoring.precision = "float64" would leave {_times(limit)}'
    )


SENTENCES = {  # Limit.by: what is to be said of it
    "evaluations": _evaluations,
    "control points": _control_points,
    "tubes": _tubes,
    "source size": _source_size,
    "precision": _precision,
}
