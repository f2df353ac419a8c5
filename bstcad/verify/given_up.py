"""What was given up: in a sentence each, with its figure, what a design does not do that was asked of it.

A lens may be right to the last nanometre and still lose light, or be thicker than drawn, because the scene left no
other way; who reads only "passed" or "failed" should not have to find that in the tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bstcad.scene import Scene
from bstcad.verify.report import number, percent, quantity, resolved

LITTLE = 1e-3  # of the light: less is not worth a sentence
DARK = 0.01  # of the picture's mean: darker is dark
MOVED = 1e-3  # of the blank's thickness: by less the vertex moves in stage 2 anyhow
NEAR = 0.1  # of the relief: what is left over the least thickness where the back had to move
STEEP = 70.0  # degrees
CLOSE = 5.0  # degrees to total internal reflection; some 98 % of the deflection that the glass allows


def sentences(facts: Mapping[str, Any], scene: Scene, target: np.ndarray, irradiance: np.ndarray) -> list[str]:
    """From the contents of report.json and the pictures (rows, columns), both of one sum; most weighty first."""
    return [
        *_accuracy(facts, scene),
        *_light(facts["flux"], facts["efficiency"]),
        *_margin(facts.get("stability", {}).get("tir_margin_deg")),
        *_darkness(target, irradiance),
        *_shape(facts["shape"], scene),
        *_tailoring(facts),
    ]


def _accuracy(facts, scene):
    wanted, found = scene.tolerances.rrmsd, facts["rrmsd"]
    if wanted is not None and found > wanted:
        yield f"The RRMSD is {number(found)} where {number(wanted)} was asked."
    if not resolved(facts):
        yield (
            f"The RRMSD of {number(found)} is not resolved: the noise floor of the tubes that measured it, "
            f"{number(facts['rrmsd_noise'])}, is more than a fifth of it."
        )


def _light(flux, efficiency):
    """Parts of the light that meets the front face: what misses it was not the lens's to use."""
    enters = 1 - flux["missed the lens"]
    for line, what in (
        ("total internal reflection", "is lost to total internal reflection"),
        ("lost through the sides", "leaves through the sides, before it meets the back"),
    ):
        if flux[line] > LITTLE * enters > 0:
            yield f"{percent(flux[line] / enters)} of the light that enters the lens {what}."
    if efficiency < 1 - LITTLE:
        yield f"{percent(1 - efficiency)} of the light that leaves the lens falls outside the target."


def _margin(degrees):
    """Where hardly anything is left, a little form error costs light, and Fresnel reflection (not simulated) grows."""
    if degrees is not None and degrees < 0:
        yield f"Some light meets the back {quantity(-degrees, 'deg')} beyond the critical angle, and is reflected."
    elif degrees is not None and degrees < CLOSE:
        yield (
            f"Some light meets the back only {quantity(degrees, 'deg')} short of total internal reflection: where the "
            "face is made steeper by as much, that light is lost."
        )


def _darkness(target, irradiance):
    """Light where hardly any was wanted: a smooth face cannot part its light without a seam."""
    dark = target < DARK * target.mean()
    lifted = float((irradiance - target)[dark].sum() / target.sum())
    if lifted > LITTLE:
        level = float(irradiance[dark].mean() / target.mean())
        yield (
            f"The darkest parts are lifted: where less than {100 * DARK:g} % of the mean irradiance was asked there is "
            f"{percent(level)} of it, {percent(lifted)} of the light in all."
        )


def _shape(shape, scene):
    lens, least = scene.lens, scene.tolerances.min_thickness
    drawn = lens.back.z - lens.front.z
    moved, thinnest = shape["centre_thickness"] - drawn, shape["thickness_min"]
    if moved > MOVED * drawn and thinnest < least + NEAR * shape["sag_pv"]:
        yield (
            f"The back was moved by {quantity(moved, 'mm')} along +z, so that the thinnest place keeps "
            f"{quantity(thinnest, 'mm')}; on the axis the lens is "
            f"{quantity(shape['centre_thickness'], 'mm')} thick instead of {quantity(drawn, 'mm')}."
        )
    elif thinnest < least:
        yield f"The lens is {quantity(thinnest, 'mm')} thin where {quantity(least, 'mm')} was asked."
    if shape["slope_max_deg"] > STEEP:
        yield f"The back is as steep as {quantity(shape['slope_max_deg'], 'deg')}: hardly a tool reaches that."


def _tailoring(facts):
    if facts.get("stopped") == "time":
        yield "Tailoring ended when its time was up, before it had gained all it could."
    if facts.get("stopped") == "interrupt":
        yield "Tailoring was stopped by hand, before it had gained all it could; --resume goes on with it."
    skipped = facts.get("skipped_steps", 0)
    if isinstance(skipped, int) and skipped > 0:
        yield f"{number(skipped)} steps were left out because their gradient was not finite."
