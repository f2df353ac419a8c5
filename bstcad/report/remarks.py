"""Remarks: a sentence with its figure for each wish of the scene that a design does not fulfil, checked or not.

A lens may be right to the last nanometre and still lose light, or be thicker than drawn, because the scene left no
other way; who reads only "passed" or "failed" should not have to search the tables for that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import scipy.ndimage

from bstcad.report.prescription import MOVED
from bstcad.report.record import Contents
from bstcad.report.units import duration, number, percent, quantity, two_digits
from bstcad.report.vocabulary import LEFT_OUT
from bstcad.scene.scene import Scene
from bstcad.verify.checks import CUT, DEFAULT_RRMSD_LIMIT

LITTLE = 1e-3  # of the light: less is not worth a sentence
MUCH = 0.25  # of the source's light: so much may miss the lens without a sentence
DARK = 0.01  # of the picture's mean: darker is dark
UNLIT = 0.1  # of what was asked: what gets less was left dark
PATCH = 5e-3  # of the lit area: less of it left dark is not worth a sentence
CHANGED = 0.01  # of the thickness that was drawn; by less the vertex moves in stage 2 anyhow
NEAR = 0.1  # of the relief: what is left over the least thickness where the back had to move
MISSED = 1.01  # times the accuracy that was asked: two measurements of one lens differ by less
DEAR = 0.8  # of the RRMSD: bounds on the back without which it would be less than that are a compromise
LATE = 1.01  # times the time that was asked: the report itself takes about so long to write
STEEP = 70.0  # degrees
OUTLIERS = 0.01  # of the points of a made part: more outliers are worth a sentence
CLOSE = 5.0  # degrees to total internal reflection; some 98 % of the deflection that the glass allows


def sentences(report: Contents, scene: Scene, target: np.ndarray, irradiance: np.ndarray) -> list[str]:
    """Remarks on a report, by its target and irradiance (rows, columns), both of one sum; the most important first.

    What the scene itself asks for and does not get comes before what nobody spoke of.
    """
    return [
        *_thickness(report.shape, scene),
        *_accuracy(report, scene),
        *_too_large(report),
        *_bounds(report),
        *_time(report, scene),
        *_unlit(target, irradiance, scene),
        *_mount(report, scene.optic),
        *_light(report.flux, report.efficiency, scene.optic),
        *_left_out(report),
        *_margin(report.stability["tir_margin_deg"]),
        *_darkness(target, irradiance),
        *_steepness(report.shape),
        *_mesh(report, scene),
        *_tailoring(report),
    ]


def _thickness(shape, scene):
    lens, least = scene.lens, scene.lens.min_thickness
    drawn, found = lens.back.z - lens.front.z, shape["centre_thickness"]
    moved, thinnest = found - drawn, shape["thickness_min"]
    instead = f"The {scene.optic} is {quantity(found, 'mm')} thick on the axis instead of {quantity(drawn, 'mm')}"
    if moved > MOVED * drawn and thinnest < least + NEAR * shape["sag_pv"]:
        yield (
            f"{instead}: the back was moved by {quantity(moved, 'mm')} along +z, so that the thinnest place keeps "
            f"{quantity(thinnest, 'mm')}."
        )
    elif abs(moved) > CHANGED * drawn:
        yield f"{instead}: tailoring moved the vertex of the back by {quantity(moved, 'mm')} along z."
    if thinnest < least:
        yield f"The {scene.optic} is {quantity(thinnest, 'mm')} thin where {quantity(least, 'mm')} was asked."


def _accuracy(report, scene):
    asked, wanted, found = scene.tailoring.accuracy, scene.accept.rrmsd, report.rrmsd
    if asked is not None and found > MISSED * asked:
        yield f"The accuracy of {number(asked)} that was asked is not reached: the RRMSD is {number(found)}."
    if wanted is not None and found > wanted:
        yield f"The RRMSD is {number(found)} where {number(wanted)} was asked."


def _bounds(report):
    """Bounds on the back that cost much, or that the back does not keep to."""
    if report.bounds and (report.bounds["rrmsd_freed"] or math.inf) < DEAR * report.rrmsd:
        yield bounds(report.bounds)


def _time(report, scene):
    asked, took = scene.tailoring.max_time, report.seconds_total
    if asked is not None and took > LATE * asked:
        yield (
            f"The time limit of {duration(asked)} was missed by {duration(took - asked)}: loading, stage 1 and "
            "writing run whole, and this machine took that long for them."
        )


def _unlit(target, irradiance, scene):
    """Where light was asked and hardly any came; the largest patch says where to look."""
    lit = target > DARK * target.mean()
    unlit = lit & (irradiance < UNLIT * target)
    share = unlit.sum() / lit.sum()
    if share < PATCH or target[unlit].sum() < PATCH * target.sum():  # which a rim of pixels that are lit in part is not
        return
    patches, count = scipy.ndimage.label(unlit, np.ones((3, 3)))
    largest = patches == 1 + np.argmax(scipy.ndimage.sum_labels(unlit, patches, range(1, count + 1)))
    rows, columns = (np.flatnonzero(largest.any(axis)) for axis in (1, 0))
    x, y = _between(scene.target.x, columns, target.shape[1]), _between(scene.target.y[::-1], rows, target.shape[0])
    yield (
        f"{percent(float(share))} of the lit part of the target is left dark, with less than {100 * UNLIT:g} % of what "
        f"was asked there; the largest patch lies at x = {x[0]:.4g} to {x[1]:.4g} mm, y = {y[1]:.4g} to {y[0]:.4g} mm."
    )


def _between(ends, indices, count):
    """The coordinates (mm) between which these pixels lie, of `count` from the first end to the second."""
    return tuple(ends[0] + (ends[1] - ends[0]) * i / count for i in (int(indices[0]), int(indices[-1]) + 1))


def _mount(report, optic):
    """The light that the part's rim, draft and bevel cut away, as a part of the light through the uncut lens."""
    for check in report.checks:
        if check.name == CUT and check.value > MUCH:
            sends = "reflect" if optic == "mirror" else "let through"
            yield f"The mount cuts away {percent(check.value)} of the light that the uncut {optic} would {sends}."


def _light(flux, efficiency, optic):
    """Light that misses the lens, as a part of all; other losses as parts of the light that meets the front face."""
    enters = 1 - flux["missed the lens"]
    if 1 - enters > MUCH:
        yield f"{percent(1 - enters)} of the light that the source sends out misses the {optic}."
    for line, what in (
        ("total internal reflection", "is lost to total internal reflection"),
        ("lost through the sides", "leaves through the sides, before it meets the back"),
    ):
        if flux[line] > LITTLE * enters > 0:
            yield f"{percent(flux[line] / enters)} of the light that enters the lens {what}."
    if efficiency < 1 - LITTLE:
        yield f"{percent(1 - efficiency)} of the light that leaves the {optic} falls outside the target."


def _too_large(report):
    """A source whose image blurs the picture by more than is allowed, of a design that deviates by more, too."""
    allowed = _allowed(report)
    blur, finest = report.blur, report.finest_detail
    if blur and finest and min(report.rrmsd, blur.rrmsd) > allowed:
        nearer = ""
        if finest.nearer_distance:
            near, far = length(finest.nearer_distance), length(finest.distance)
            nearer = f"; at {near} instead of {far} it is {length(finest.nearer_width)}"
        yield (
            f"The source is too large for the picture: the finest detail on the target is {length(finest.width)} wide "
            f"({finest.of}), and the picture with no finer detail has an RRMSD of {number(blur.rrmsd)} where "
            f"{number(allowed)} is allowed{nearer}."
        )


def _left_out(report):
    """Effects that are not simulated and would change the picture by more than the stated or the allowed RRMSD.

    By the RRMSD that the effect alone gives a perfect lens (analysis.neglected_effects); a real one's is about
    √(stated² + change²).  A size of the source which the scene does not state is assumed, and said to be.
    """
    stated, allowed = report.rrmsd, _allowed(report)
    limit = min(stated, allowed)
    of = f"stated {number(stated)}" if limit == stated else f"{number(allowed)} that is allowed"
    for entry in report.estimates:
        if (entry.rrmsd_change or 0.0) > limit:
            detail = entry.detail + (", which the scene does not state" if entry.assumed else "")
            by = f", {detail}," if detail else ""
            how = f"; {entry.simulate_by} in the scene simulates it" if entry.simulate_by else ""
            if how and entry.assumed and entry.kind == "source size":
                how += f", {entry.simulate_by.replace('source.', 'source.real_')} states another size"
            yield (
                f"Left out: {LEFT_OUT[entry.kind]}{by} would change the picture by an RRMSD of "
                f"{number(entry.rrmsd_change)}, more than the {of}{how}."
            )


def _allowed(report):
    """The RRMSD that passes."""
    return DEFAULT_RRMSD_LIMIT if report.rrmsd_asked is None else report.rrmsd_asked


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


def _steepness(shape):
    if shape["slope_max_deg"] > STEEP:
        yield f"The back is as steep as {quantity(shape['slope_max_deg'], 'deg')}: hardly a tool reaches that."


def _mesh(report, scene):
    """Where nobody asked how fine it is to be; where somebody did, it is a check."""
    [error] = [check.value for check in report.checks if check.name == "STL: chordal error"] or [None]
    if error is not None and error > scene.mesh_tolerance and scene.output.mesh_tolerance is None:
        yield (
            f"The facets of lens.stl and lens.3mf lie within {quantity(error, 'mm')} of the lens, not within "
            f"{quantity(scene.mesh_tolerance, 'mm')}: that would take more triangles than a file should have; "
            "lens.step is exact."
        )


def _tailoring(report):
    if report.stopped == "time":
        yield "Tailoring ended when its time was up, before it had gained all it could."
    if report.stopped == "interrupt":
        yield "Tailoring was stopped by hand, before it had gained all it could; --resume goes on with it."
    if report.skipped_steps:
        yield f"{number(report.skipped_steps)} steps were left out because their gradient was not finite."


def length(value: float) -> str:
    """An estimate of a length (mm), to two digits."""
    return quantity(two_digits(value), "mm")


def bounds(found: Mapping[str, Any] | None) -> str:
    """The bounds on the back ([lens] tool_radius, max_slope, thicknesses) and their price; nothing if none is asked."""
    if not found:
        return ""
    units = {"max_slope": "degrees"}
    asked = ", ".join(f"lens.{key} = {value:g} {units.get(key, 'mm')}" for key, value in found["asked"].items())
    at = " and ".join(f"{percent(share)} of it is within 3 % of lens.{key}" for key, share in found["at"].items())
    within = f"The back was tailored within bounds ({asked})" + (f"; {at}." if at else ".")
    if found["rrmsd"] is None or found["rrmsd_freed"] is None:
        return f"{within} What they cost was not measured in this run."
    return (
        f"{within} With them the design comes to an RRMSD of {number(found['rrmsd'])}; freed of them, it comes to "
        f"{number(found['rrmsd_freed'])} in an eighth of its evaluations more. So much of their cost one run can "
        "measure; a design without them tells all."
    )


def outliers(measured: Mapping[str, Any]) -> Iterator[str]:
    """Many outliers among the points of a made part, which may pass all the same; measured: as report.json has it."""
    share = measured["outliers"]["share"]
    if share > OUTLIERS:
        yield (
            f"{percent(share)} of the measured points are outliers and were left out: dust, glints or "
            "slips of the instrument. Clean the part and measure it again to be sure."
        )
