"""The report of a design: report.json for machines, report.html for people, a few lines for the terminal.

All three show the same record (record.Contents); none of them measures anything.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bstcad import files
from bstcad.report import bound_words, cost_words, judge_figures, order, part_words
from bstcad.report.record import BY_HAND, Contents, Examined, read
from bstcad.report.templates import house
from bstcad.report.tolerances import BEGIN, END
from bstcad.report.units import DIGITS, about, bound, duration, number, percent, quantity, two_digits
from bstcad.report.vocabulary import LEFT_OUT, WAYS, ledger
from bstcad.verify.verdict import Check

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

Sections = Sequence[tuple[str, Sequence[tuple[str, str]]]]  # heading, rows of name and value
RESOLVED = 5.0  # an RRMSD below this many standard errors is not resolved

VIEWER = Path(__file__).with_name("solid_view.js")
LITTLE = 1e-3  # of the source's light: a smaller loss is not named beside the figure
BADGES = {  # report["verdict"]: (sign, style of the page, of the terminal)
    "passed": ("✓", "pass", "bold green"),
    "passed with remarks": ("✓", "remarks", "bold yellow"),
    "failed": ("✗", "fail", "bold red"),
}
LOSSES = {  # line of the ledger: in a remark
    "missed the lens": "missed the {optic}",
    "lost through the sides": "sides",
    "total internal reflection": "total internal reflection",
    "off target": "beside the target",
    "ghost on target": "ghost on the target",
    "ghost off target": "ghost beside it",
}
STOPPED = {  # report["stopped"]: in words
    "evaluations": "all evaluations spent",
    "plateau": "no more gain",
    "accuracy": "the accuracy asked for was reached",
    "time": "the time given was up",
    "interrupt": "stopped by hand; --resume goes on",
}
STABILITY = {  # key of report["stability"]: (what it is, unit)
    "tir_margin_deg": ("Smallest margin to total internal reflection", "deg"),
    "newton_slope_min": ("Smallest slope of Newton's method (1 head on, 0 grazing)", ""),
    "curvature_max": ("Largest principal curvature of the back face", "1/mm"),
    "non_finite": ("Values that are not finite", ""),
}
SHAPE = {  # key of report["shape"]: (what it is, unit)
    "centre_thickness": ("Centre thickness", "mm"),
    "edge_thickness_min": ("Thinnest edge", "mm"),
    "thickness_min": ("Thinnest place", "mm"),
    "sag_pv": ("Sag of the back surface, PV", "mm"),
    "slope_max_deg": ("Steepest slope", "deg"),
    "radius_min_concave": ("Smallest concave radius", "mm"),
    "radius_min_convex": ("Smallest convex radius", "mm"),
    "departure_best_sphere": ("Departure from the best sphere, PV", "mm"),
    "volume": ("Volume", "mm³"),
    "slope_energy_top_octave": ("Slope energy in the net's highest octave, as a part of all", ""),
}
FIGURES = {  # key of a picture: what it shows, for those who cannot see it
    "irradiance": "Target, simulated irradiance and their signed difference, side by side.",
    "cross_section": "Target and simulated irradiance on cuts through the centre and through the brightest place.",
    "ghost": "The irradiance by light that is reflected twice inside the lens.",
    "lines": "The picture in colour, and in grey the one that each line of the spectrum makes by itself.",
    "lens": "The lens in three dimensions, seen from the side of its back surface.",
    "side_view": "Section of the lens with a fan of rays: close up, and from the source to the target.",
    "surface": "Maps of the back surface: height with contour lines, slope, mean curvature.",
    "transport": "A regular grid on the source and the image of its lines on the target.",
    "convergence": "RRMSD against seconds with the ends of the stages and its standard error.",
}


# --- report.json ------------------------------------------------------------------------------------------------------


def write_json(report: Contents, path: str | Path) -> None:
    """Write report.json: one record a line, numbers to 12 digits; ValueError names a number that is not finite."""
    lines = ",\n".join(f"  {_line(key)}: {_block(value)}" for key, value in _plain(report.facts(), "").items())
    files.put(Path(path), f"{{\n{lines}\n}}\n".encode())


def _plain(value: Any, where: str) -> Any:
    """`value` of dicts, lists, text, bools, ints and finite floats only; `where` is its place in the report.

    Numbers are rounded to DIGITS, but for those of the prescription, which is what was designed.
    """
    if isinstance(value, Mapping):
        return {str(key): _plain(part, f"{where}.{key}" if where else str(key)) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(part, f"{where}[{i}]") for i, part in enumerate(value)]
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, np.bool_ | np.integer | int):
        return value.item() if isinstance(value, np.generic) else value
    number = float(value)
    if not math.isfinite(number):
        remedy = "a report holds finite numbers, and null for what was not measured"
        raise ValueError(f"report: {where!r} is {number}; {remedy}")
    return number if where.startswith("prescription.") else float(f"{number:.{DIGITS}g}")


def _line(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _block(value: Any) -> str:
    """JSON of a top-level value: a line for each entry of a dict and for each record of a list."""
    if isinstance(value, dict) and value:
        return "{\n" + ",\n".join(f"    {_line(key)}: {_line(part)}" for key, part in value.items()) + "\n  }"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(f"    {_line(part)}" for part in value) + "\n  ]"
    return _line(value)


# --- what is said -----------------------------------------------------------------------------------------------------


def resolved(report: Contents) -> bool:
    """Is the RRMSD at least five times its standard error?"""
    return report.rrmsd >= RESOLVED * report.rrmsd_noise


def unresolved(report: Contents) -> str:
    """What an RRMSD means that is not resolved, in a sentence; none for one that is."""
    if resolved(report):
        return ""
    value, noise = report.rrmsd, report.rrmsd_noise
    return (
        f"The RRMSD is not resolved: {number(value)} is less than five times its standard error, "
        f"{number(noise)}. The {report.optic} may be better than that figure, or worse, up to {number(value + noise)} "
        "or so; fewer target.pixels are resolved more easily."
    )


def explanation(report: Contents | Examined) -> str:
    """The verdict in sentences: how many checks passed or failed, and what is in doubt."""
    checks = report.checks
    if failed := sum(not check.passed for check in checks):
        said = f"{failed} of {len(checks)} checks failed."
    else:
        said = f"All {len(checks)} checks passed." if report.passed else "The design did not pass."
    return " ".join((said, *doubts(report)))


def doubts(report: Contents | Examined) -> list[str]:
    """Sentences on the RRMSD: that none was asked, that it is not resolved."""
    return [] if isinstance(report, Examined) else [*filter(None, (_unasked(report), unresolved(report)))]


def _unasked(report: Contents) -> str:
    """That the scene asks for no RRMSD, and by what it was judged instead."""
    if report.rrmsd_asked is not None:
        return ""
    limits = (check.limit for check in report.checks if check.name.startswith("RRMSD"))
    return f"No RRMSD was asked (accept.rrmsd); any up to {number(next(limits, None))} passes."


def place(check: Check) -> str:
    """Where a failed check fails, in brackets; nothing if it does not say."""
    return f" ({check.where})" if check.where else ""


def check_line(check: Check) -> str:
    """A check with its place, value and limit, in one line: "thinnest place (at (1, 2) mm): 0.7 mm, limit ≥ 1 mm"."""
    limit = f", limit {bound(check)}" if check.limit is not None else ""
    return f"{check.name}{place(check)}: {quantity(check.value, check.unit)}{limit}"


def first_figures(report: Contents | Examined) -> list[tuple[str, str, str]]:
    """The figures that a reader looks for first, (name, value, remark), as the terminal and report.html show them.

    A STEP file by itself has those of the part alone.
    """
    if isinstance(report, Examined):
        return [(name, value, "") for name, value in report.part.items()]
    floor = f"standard error {number(report.rrmsd_noise)}"
    ended = STOPPED.get(report.stopped or "", "")
    changed = f"of the proof alone: the {report.optic} was changed by hand" if report.stopped == BY_HAND else ""
    remark = floor if resolved(report) else f"not resolved: {floor} is more than a fifth of it"
    found = [
        ("RRMSD, re-read STEP", number(report.rrmsd), remark),
        *_dark(report),
        ("Light on the target", percent(report.light_on_target), _where_it_went(report.flux, report.optic)),
        *_finest_detail(report.finest_detail),
    ]
    if report.order:
        part = "part" if report.order["file"] == order.PART else report.optic
        size = order.size_words(order.Order.of_facts(report.order))
        found.append((f"Size of the {part}", size, _thickness(report.shape or {})))
    elif outline := report.prescription.get("outline"):
        found.append((f"Size of the {report.optic}", _across(outline), _thickness(report.shape or {})))
    if shape := report.shape:
        concave, convex = (quantity(shape.get(f"radius_min_{kind}"), "mm") for kind in ("concave", "convex"))
        found.append(("Smallest concave radius", concave, f"smallest convex radius {convex}"))
    by = f"tailoring ended: {ended}" if ended else changed or f"to the verified {report.optic}"
    found.append(("Time", duration(report.seconds_total), by))
    return found


def _across(outline: Mapping[str, Any]) -> str:
    """Width and height, or the diameter, of the prescription's outline."""
    if outline["shape"] == "circle":
        return f"Ø {quantity(2 * outline['radius'], 'mm')}"
    return f"{number(outline['width'])} × {quantity(outline['height'], 'mm')}"


def _thickness(shape: Mapping[str, float | None]) -> str:
    """At the centre and where it is thinnest."""
    said = (("centre_thickness", "{} thick at the centre"), ("thickness_min", "thinnest place {}"))
    return ", ".join(text.format(quantity(shape[key], "mm")) for key, text in said if key in shape)


def _dark(report: Contents) -> Iterator[tuple[str, str, str]]:
    """The light where the target wants none, if there is such a place."""
    if report.leak is not None:
        lit = "none" if report.contrast is None else f"lit pixels are {about(report.contrast)} times as bright"
        yield "Light in the dark", percent(report.leak), f"of the light on the target, where it wants none; {lit}"


def blur(report: Contents) -> str:
    """How far the source's size blurs every picture, in sentences; none of a source that is a point."""
    if not report.blur:
        return ""
    width, pixels = quantity(report.blur["width"], "mm"), number(report.blur["pixels"])
    return (
        f"The source has some size.  Through each place of the {report.optic} it throws an image of itself, "
        f"{width} or {pixels} pixels wide in the mean, and detail finer than that does not come back.  The target "
        f"itself, blurred by the mean image, has an RRMSD of {number(report.blur['rrmsd'])} against the sharp "
        "one; a lens comes below that as far as it sharpens coarser detail beforehand."
    )


def _finest_detail(found: Mapping[str, Any] | None) -> Iterator[tuple[str, str, str]]:
    """The tile of analysis.blur.FinestDetail."""
    if found is None:
        return
    sizes = {key: quantity(two_digits(value), "mm") for key, value in found.items() if isinstance(value, float)}
    of = found["of"] + (", which the scene does not state" if found["assumed"] else "")
    remark = f"by {of}"
    if found["source_image"] < found["pixel"]:
        remark = f"by the pixels; the source's image is {sizes['source_image']} wide ({of})"
    if found["nearer_distance"]:
        remark += f"; with the target at {sizes['nearer_distance']} instead of {sizes['distance']}: "
        remark += sizes["nearer_width"]
    yield "Finest detail on the target", sizes["width"], remark


def _where_it_went(flux: Mapping[str, float], of: str) -> str:
    """What the light on the target is a part of, and the larger losses."""
    lost = [
        f"{words.format(optic=of)} {percent(flux[line])}"
        for line, words in LOSSES.items()
        if flux.get(line, 0.0) > LITTLE
    ]
    return "; ".join(["of what the source sends out", ", ".join(lost)] if lost else ["of what the source sends out"])


def stability(report: Contents) -> list[tuple[str, str]]:
    """How far the design is from where numbers go wrong: (what, figure)."""
    found, twins = report.stability or {}, report.twins
    rows = [
        (name, quantity(found[key], unit))
        for key, (name, unit) in STABILITY.items()
        if key in found and not (key == "tir_margin_deg" and report.optic == "mirror")
    ]
    if report.skipped_steps is not None:
        rows.append(("Steps left out, their gradient not finite", number(report.skipped_steps)))
    if twins:
        m, steps = twins.control_points, twins.evaluations
        rows += [
            (f"float32 beside float64, {m} × {m} control points: gradient", number(twins.gradient)),
            (
                f"… RRMSD after {steps} evaluations",
                f"{number(twins.rrmsd_float32)} beside {number(twins.rrmsd_float64)}",
            ),
            (f"… control points after {steps} evaluations", quantity(twins.heights, "mm")),
        ]
    return rows


def machine(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The machine's facts in words, those that are known; of a design on a GPU, that it cannot be had again exactly."""
    rows = [
        (key.removesuffix("_gb").replace("_", " "), f"{value:.3g} GB" if key.endswith("_gb") else str(value))
        for key, value in facts.items()
        if value is not None
    ]
    on_cpu = facts.get("device", "cpu") == "cpu"
    return rows if on_cpu else [*rows, ("once more", "another lens of the same merit: a GPU adds up in no fixed order")]


# --- report.html ------------------------------------------------------------------------------------------------------


def write_html(
    report: Contents,
    figures: Mapping[str, bytes | None],
    path: str | Path,
    scene: str = "",
    prescription: Sections = (),
    solid: str = "",
    tolerances: str = "",
) -> None:
    """Write report.html, one file: pictures (PNG bytes by the keys of FIGURES) and styles inside, nothing fetched.

    A picture that is None or absent is left out; for the lens a sentence says so.  scene: the resolved TOML text.
    prescription: as bstcad.report.prescription puts it in words.  solid: as bstcad.report.solid_view tells the lens,
    for a reader to turn it; none: a page without any script.  tolerances: as bstcad.report.tolerances has them.
    """
    from markupsafe import Markup

    templates = house()
    templates.filters["place"] = place
    shape = report.shape or {}
    viewer = VIEWER.read_text(encoding="utf-8") if solid else ""
    page = templates.get_template("report.html.j2").render(
        report=report,
        pictures={key: base64.b64encode(picture).decode() for key, picture in figures.items() if picture},
        alt=FIGURES,
        explanation=explanation(report),
        badge=BADGES[report.verdict],
        first_figures=first_figures(report),
        resolved=resolved(report),
        shape=[(name, quantity(shape[key], unit)) for key, (name, unit) in SHAPE.items() if key in shape],
        stability=stability(report),
        blur=blur(report),
        bounds=bound_words.sentence(report),
        optic=report.optic,
        way=WAYS[report.optic],
        ledger=ledger(report.flux, report.optic),
        order=order.rows(report.order),
        price=cost_words,
        part=part_words,
        names=LEFT_OUT,
        judge_words={judge.name: judge_figures.words(judge) for judge in report.judges if not judge.declined},
        judge_key=judge_figures.key,
        machine=machine(report.machine),
        prescription=prescription,
        scene=scene,
        tolerances=Markup(f"{BEGIN}\n{tolerances}{END}\n"),  # a page of this program
        solid=Markup(solid),  # numbers and names of ours
        viewer=Markup(viewer),
        policy=_policy(viewer),
    )
    files.put(Path(path), page.encode())


def _policy(script: str) -> str:
    """What a browser may do for the page: run this script alone, and fetch nothing."""
    run = f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" if script else "'none'"
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {run}; base-uri 'none'"


# --- terminal ---------------------------------------------------------------------------------------------------------


def summary(facts: Mapping[str, Any], verbose: bool = False) -> Group:
    """Verdict, remarks, first figures, failed checks and the number of passed ones; verbose: every check.

    facts: the entries of report.json.  For `rich.print`, a paragraph a line.
    """
    from rich.console import Group
    from rich.text import Text

    report = read(facts)
    lines = [Text.assemble((report.verdict.upper(), BADGES[report.verdict][2]), f": {report.title or report.name}")]
    given_up = () if isinstance(report, Examined) else report.given_up
    lines += [Text(f"Remark: {sentence}") for sentence in (*given_up, *doubts(report))]
    figures = first_figures(report)
    wide = max((len(name) for name, _, _ in figures), default=0)
    lines += [Text(f"{name:{wide}}  {value}{remark and f' ({remark})'}") for name, value, remark in figures]
    if not isinstance(report, Examined):
        limit = cost_words.limit(report.limits) if report.limits else ""
        lines += map(Text, filter(None, (limit, bound_words.sentence(report))))
    passed = sum(check.passed for check in report.checks)
    lines += check_lines(report.checks, verbose)
    lines.append(Text(f"{passed} checks passed{'' if verbose else '; --verbose lists them'}."))
    return Group(*lines)


def check_lines(checks: Sequence[Check], verbose: bool, of: str = "") -> Iterator[Text]:
    """A line for each failed check, verbose: then for each passed one; of: the design's name before the check's."""
    from rich.text import Text

    for check in checks:
        if not check.passed:
            yield Text.assemble(("FAIL", "bold red"), f" {of}{check_line(check)}")
    for check in checks if verbose else ():
        if check.passed:
            yield Text(f"{'stated' if check.limit is None else 'pass'} {of}{check_line(check)}")
