"""What there is to say of a made part, from the entry `measured` of report.json: rows of name and value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bstcad.report.units import about, number, percent, quantity

PICTURE = "Form error of the made part, the light that it will throw, and what the form error changes of it."
REMARKED = 0.01  # of the points: more outliers than that are remarked upon
FIGURES = {  # key of measured: what it is
    "pv": "PV of the points, least squares",
    "pvr": "PVr of the points (36 Zernike terms, and three times the RMS of the rest)",
    "rms": "RMS of the points",
    "form_pv": "PV of the fitted form error",
    "form_rms": "RMS of the fitted form error",
    "noise": "Noise of the measurement, RMS",
}


def figures(part: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The deviation in figures."""
    zone = part["minimum_zone"]["width"]
    rows = [(words, quantity(part[key], "mm")) for key, words in FIGURES.items()]
    rows.insert(1, ("Surface profile, minimum zone (twice the largest distance, at its least)", quantity(zone, "mm")))
    rows.append(("Slope error of the fitted form, RMS", quantity(part["slope_rms"], "rad")))
    x, y = part["worst_at"]
    return [*rows, ("Furthest off", f"at x = {number(x)} mm, y = {number(y)} mm")]


def drawing(part: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """The tightest form tolerances that the part meets, as a drawing would ask for them: (symbol, value, meaning).

    ISO 1101 (profile of any surface, no datum): a zone about the design, its width once the part is laid best in it.
    ISO 10110-5 (code number 3, total deviation by its RMS, in nm): what least squares leave. Both rounded up.
    """
    zone, rms = part["minimum_zone"]["width"], 1e6 * part["rms"]
    return [
        ("profile", f"{_up(zone)}", "ISO 1101, profile of any surface, no datum: width of the zone, mm"),
        ("", f"3/—RMSt < {_up(rms)}", "ISO 10110-5, surface form: total deviation, RMS, nm"),
    ]


def _up(value: float, digits: int = 3) -> str:
    """Rounded up to so many digits, never in powers of ten."""
    if not value > 0:
        return "0"
    last = math.floor(math.log10(value)) - digits + 1
    units = math.ceil(value / 10**last * (1 - 1e-12))
    return f"{units * 10**last:.{max(0, -last)}f}"


def removed(part: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What the alignments took away: (what, by least squares, by minimum zone)."""
    names = {
        "dx": ("Shift in x", "mm"), "dy": ("Shift in y", "mm"), "dz": ("Shift in z", "mm"),
        "rotation_x": ("Rotation about x", "deg"), "rotation_y": ("Rotation about y", "deg"),
        "rotation_z": ("Rotation about z", "deg"),
    }  # fmt: skip
    both = part["alignment"], part["minimum_zone"]
    return [(words, *(quantity(found[key], unit) for found in both)) for key, (words, unit) in names.items()]


def counted(part: Mapping[str, Any]) -> str:
    """How many points, and which were left out, in a sentence or two."""
    out = [f"{number(count)} {where}" for where, count in part["left_out"].items() if count]
    outside = f"; left out: {', '.join(out)}" if out else ""
    said = f"{number(part['points'])} points of the back face, of {part['cloud']}{outside}.{_alone(part['outliers'])}"
    free = part["alignment"]["undetermined"]
    return f"{said} The face does not determine, and the alignment left alone: {'; '.join(free)}." if free else said


def _alone(found: Mapping[str, Any]) -> str:
    """The outliers that were left out, in a sentence; none without any."""
    if not found["points"]:
        return ""
    many, above = found["points"] > 1, found["above"]
    return (
        f" {number(found['points'])} outlier{'s' * many} ({percent(found['share'])} of the points near the face) "
        f"{'stand' if many else 'stands'} alone among {'their' if many else 'its'} neighbours, up to "
        f"{quantity(found['farthest'], 'mm')} off; {number(above)} out of the glass, {number(found['points'] - above)} "
        f"into it. {'They are' if many else 'It is'} left out of every figure here."
    )


def remarks(part: Mapping[str, Any]) -> tuple[str, ...]:
    """What of the measurement, though the part may pass, a reader has to know; in a sentence each."""
    if part["outliers"]["share"] <= REMARKED:
        return ()
    return (
        f"{percent(part['outliers']['share'])} of the measured points are outliers and were left out: dust, glints or "
        "slips of the instrument. Clean the part and measure it again to be sure.",
    )


def light(part: Mapping[str, Any]) -> str:
    """What the part will do, in a sentence or two."""
    found, high = part["rrmsd_predicted"], part["rrmsd_high"]
    if found is None or high is None:
        return "None of its light falls on the target."
    said = f"With the fitted form error the lens has an RRMSD of {number(found)}."
    if high > 1.1 * found:
        said += (
            f" The points leave open how its finest waves run: were they all against it, {number(high)}."
            " More points, or quieter ones, would tell."
        )
    return said


def bands(part: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """The form error by its periods: (period, RMS, share of its mean square, slope RMS)."""
    total = sum(band["rms"] ** 2 for band in part["bands"]) or 1.0
    return [
        (
            _period(band["period"]),
            quantity(band["rms"], "mm"),
            percent(band["rms"] ** 2 / total),
            quantity(band["slope_rms"], "rad"),
        )
        for band in part["bands"]
    ]


def _period(ends: tuple[float, float] | None) -> str:
    """From the shortest to the longest, in words."""
    if ends is None:
        return "smooth: power and astigmatism"
    longest, shortest = ends
    return f"{about(shortest)} to {about(longest)} mm"
