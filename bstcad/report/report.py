"""The report of a design for people: report.html, a few lines for the terminal, and report.junit.xml for build servers.

All of them show the record of report.json (record.Contents); none of them measures anything.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bstcad.analysis.light import FinestDetail
from bstcad.report import cost_words, order, remarks
from bstcad.report.record import BY_HAND, Contents, Examined, changes
from bstcad.report.units import about, bound, duration, number, percent, quantity, rounded_up
from bstcad.report.vocabulary import LEFT_OUT, WAYS, ledger
from bstcad.runs import files
from bstcad.verify.verdict import Check

if TYPE_CHECKING:
    from jinja2 import Environment
    from rich.console import Group
    from rich.text import Text

Sections = Sequence[tuple[str, Sequence[tuple[str, str]]]]  # heading, rows of name and value
BEGIN, END = "<!-- tolerances -->", "<!-- end of tolerances -->"  # about the section on tolerances
NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0 has no such characters
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
STABILITY = {  # key of report["stability"]: (name, unit)
    "tir_margin_deg": ("Smallest margin to total internal reflection", "deg"),
    "newton_slope_min": ("Smallest slope of Newton's method (1 head on, 0 grazing)", ""),
    "curvature_max": ("Largest principal curvature of the back face", "1/mm"),
    "non_finite": ("Values that are not finite", ""),
}
SHAPE = {  # key of report["shape"]: (name, unit)
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
FIGURES = {  # key of a picture: its text for readers who cannot see it
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


# --- words ------------------------------------------------------------------------------------------------------------


def resolved(report: Contents) -> bool:
    """Is the RRMSD at least five times its standard error?"""
    return report.rrmsd >= RESOLVED * report.rrmsd_noise


def explanation(report: Contents | Examined) -> str:
    """The verdict in sentences: how many checks passed or failed, and doubts on the RRMSD."""
    checks = report.checks
    text = f"All {len(checks)} checks passed." if report.passed else "The design did not pass."
    if failed := sum(not check.passed for check in checks):
        text = f"{failed} of {len(checks)} checks failed."
    return " ".join((text, *doubts(report)))


def doubts(report: Contents | Examined) -> Iterator[str]:
    """Sentences on the RRMSD: that the scene asks for none, that it is not resolved."""
    if isinstance(report, Examined):
        return
    if report.rrmsd_asked is None:
        limits = (check.limit for check in report.checks if check.name.startswith("RRMSD"))
        yield f"No RRMSD was asked (accept.rrmsd); any up to {number(next(limits, None))} passes."
    if not resolved(report):
        value, noise = report.rrmsd, report.rrmsd_noise
        yield (
            f"The RRMSD is not resolved: {number(value)} is less than five times its standard error, "
            f"{number(noise)}. The {report.optic} may be better than that figure, or worse, up to "
            f"{number(value + noise)} or so; fewer target.pixels are resolved more easily."
        )


def check_line(check: Check) -> str:
    """A check with its location, value and limit, in a line: "thinnest place (at (1, 2) mm): 0.7 mm, limit ≥ 1 mm"."""
    limit = f", limit {bound(check)}" if check.limit is not None else ""
    where = f" ({check.where})" if check.where else ""
    return f"{check.name}{where}: {quantity(check.value, check.unit)}{limit}"


def first_figures(report: Contents | Examined) -> list[tuple[str, str, str]]:
    """The figures that a reader looks for first, (name, value, remark), as the terminal and report.html show them.

    A STEP file by itself has those of the part alone.
    """
    if isinstance(report, Examined):
        return [(name, value, "") for name, value in report.part.items()]
    return list(_figures(report))


def _figures(report: Contents) -> Iterator[tuple[str, str, str]]:
    noise, shape = f"standard error {number(report.rrmsd_noise)}", report.shape or {}
    remark = noise if resolved(report) else f"not resolved: {noise} is more than a fifth of it"
    yield "RRMSD, re-read STEP", number(report.rrmsd), remark
    if report.leak is not None:
        lit = "none" if report.contrast is None else f"lit pixels are {about(report.contrast)} times as bright"
        yield "Light in the dark", percent(report.leak), f"of the light on the target, where it wants none; {lit}"
    yield "Light on the target", percent(report.light_on_target), _where_it_went(report.flux, report.optic)
    yield from _finest_detail(report.finest_detail)
    if report.order:
        part = "part" if report.order.file == order.PART else report.optic
        yield f"Size of the {part}", order.size_words(report.order), _thickness(shape)
    elif outline := report.prescription.get("outline"):
        yield f"Size of the {report.optic}", _across(outline), _thickness(shape)
    if shape:
        concave, convex = (quantity(shape.get(f"radius_min_{kind}"), "mm") for kind in ("concave", "convex"))
        yield "Smallest concave radius", concave, f"smallest convex radius {convex}"
    by = f"to the verified {report.optic}"
    if report.stopped == BY_HAND:
        by = f"of the proof alone: the {report.optic} was changed by hand"
    elif report.stopped in STOPPED:
        by = f"tailoring ended: {STOPPED[report.stopped]}"
    yield "Time", duration(report.seconds_total), by


def _across(outline: Mapping[str, Any]) -> str:
    """Width and height, or the diameter, of the prescription's outline."""
    if outline["shape"] == "circle":
        return f"Ø {quantity(2 * outline['radius'], 'mm')}"
    return f"{number(outline['width'])} × {quantity(outline['height'], 'mm')}"


def _thickness(shape: Mapping[str, float | None]) -> str:
    """At the centre and where it is thinnest."""
    known = (("centre_thickness", "{} thick at the centre"), ("thickness_min", "thinnest place {}"))
    return ", ".join(text.format(quantity(shape[key], "mm")) for key, text in known if key in shape)


def _finest_detail(found: FinestDetail | None) -> Iterator[tuple[str, str, str]]:
    if found is None:
        return
    of = found.of + (", which the scene does not state" if found.assumed else "")
    remark = f"by {of}"
    if found.source_image < found.pixel:
        remark = f"by the pixels; the source's image is {remarks.length(found.source_image)} wide ({of})"
    if found.nearer_distance:
        nearer, far = remarks.length(found.nearer_distance), remarks.length(found.distance)
        remark += f"; with the target at {nearer} instead of {far}: {remarks.length(found.nearer_width)}"
    yield "Finest detail on the target", remarks.length(found.width), remark


def _where_it_went(flux: Mapping[str, float], of: str) -> str:
    """The larger losses of the source's light."""
    large = {line: words for line, words in LOSSES.items() if flux.get(line, 0.0) > LITTLE}
    lost = ", ".join(f"{words.format(optic=of)} {percent(flux[line])}" for line, words in large.items())
    return "of what the source sends out" + (f"; {lost}" if lost else "")


def stability(report: Contents) -> list[tuple[str, str]]:
    """Margins to numerical trouble: (name, figure)."""
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
        both = f"{number(twins.rrmsd_float32)} beside {number(twins.rrmsd_float64)}"
        rows += [
            (f"float32 beside float64, {m} × {m} control points: gradient", number(twins.gradient)),
            (f"… RRMSD after {steps} evaluations", both),
            (f"… control points after {steps} evaluations", quantity(twins.heights, "mm")),
        ]
    return rows


def machine(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The machine's facts in words, those that are known; of a design on a GPU, that it cannot be had again exactly."""
    rows = [
        (key.removesuffix("_gb").replace("_", " "), _fact(key, value))
        for key, value in facts.items()
        if value is not None
    ]
    on_cpu = facts.get("device", "cpu") == "cpu"
    return rows if on_cpu else [*rows, ("once more", "another lens of the same merit: a GPU adds up in no fixed order")]


def _fact(key: str, value: Any) -> str:
    return f"{value:.3g} GB" if key.endswith("_gb") and isinstance(value, int | float) else str(value)


# --- report.html ------------------------------------------------------------------------------------------------------


@cache  # a process compiles each template once: 0.6 CPU seconds
def environment() -> Environment:
    """The templates of report.html; all text is escaped, since titles, names and scenes are a user's."""
    import jinja2

    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    found.filters |= {f.__name__: f for f in (number, quantity, percent, duration, bound, about, rounded_up, changes)}
    found.globals |= {f.__name__: f for f in (explanation, first_figures, resolved, stability, machine, ledger)}
    return found


def write_html(
    report: Contents, figures: Mapping[str, bytes | None], path: str | Path, *, scene: str = "",
    prescription: Sections = (), solid: str = "", tolerances: str = "",
) -> None:  # fmt: skip
    """Write report.html, one file: pictures (PNG bytes by the keys of FIGURES) and styles inside, nothing fetched.

    A picture that is None or absent is left out; for the lens a sentence says so.  scene: the resolved TOML text.
    prescription: as bstcad.report.prescription puts it in words.  solid: as bstcad.report.solid_view tells the lens,
    for a reader to turn it; none: a page without any script.  tolerances: as bstcad.report.tolerances has them.
    """
    from markupsafe import Markup

    shape = report.shape or {}
    viewer = VIEWER.read_text(encoding="utf-8") if solid else ""
    page = (
        environment()
        .get_template("report.html.j2")
        .render(
            report=report,
            pictures=encoded(figures),
            alt=FIGURES,
            badge=BADGES[report.verdict],
            shape=[(name, quantity(shape[key], unit)) for key, (name, unit) in SHAPE.items() if key in shape],
            bounds=remarks.bounds(report.bounds),
            optic=report.optic,
            way=WAYS[report.optic],
            order_rows=order.rows,
            price=cost_words,
            names=LEFT_OUT,
            prescription=prescription,
            scene=scene,
            tolerances=Markup(f"{BEGIN}\n{tolerances}{END}\n"),  # a page of this program
            solid=Markup(solid),  # numbers and names of ours
            viewer=Markup(viewer),
            policy=_policy(viewer),
        )
    )
    files.put(Path(path), page.encode())


def encoded(pictures: Mapping[str, bytes | None]) -> dict[str, str]:
    """PNG bytes by name as a page holds them: in base64."""
    return {key: base64.b64encode(picture).decode() for key, picture in pictures.items() if picture}


def _policy(script: str) -> str:
    """The content security policy of the page: a browser runs this script alone, and fetches nothing."""
    run = f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" if script else "'none'"
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {run}; base-uri 'none'"


# --- terminal ---------------------------------------------------------------------------------------------------------


def summary(report: Contents | Examined, verbose: bool = False) -> Group:
    """Verdict, remarks, first figures, failed checks and the number of passed ones; verbose: every check.

    For `rich.print`, a paragraph a line.
    """
    from rich.console import Group
    from rich.text import Text

    lines = [Text.assemble((report.verdict.upper(), BADGES[report.verdict][2]), f": {report.title or report.name}")]
    given_up = () if isinstance(report, Examined) else report.given_up
    lines += [Text(f"Remark: {sentence}") for sentence in (*given_up, *doubts(report))]
    figures = first_figures(report)
    wide = max((len(name) for name, _, _ in figures), default=0)
    lines += [Text(f"{name:{wide}}  {value}{remark and f' ({remark})'}") for name, value, remark in figures]
    if not isinstance(report, Examined):
        limit = cost_words.limit(report.limits) if report.limits else ""
        lines += map(Text, filter(None, (limit, remarks.bounds(report.bounds))))
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


# --- report.junit.xml -------------------------------------------------------------------------------------------------


def junit(report: Contents) -> bytes:
    """The checks of a design as a suite, each a test case; a check that is stated, not judged, passes.

    The time of the suite is that of the verification; remarks stand in its output.
    """
    took = [stage.seconds for stage in report.stages if stage.name == "verify"]
    keys = ("verdict", "rrmsd", "rrmsd_noise", "leak", "light_on_target", "efficiency", "quality")
    values = {key: value for key in keys if (value := getattr(report, key)) is not None}
    page = environment().get_template("junit.xml.j2").render(
        report=report, failed=sum(not check.passed for check in report.checks), failure=failure, seconds=took[-1:],
        properties={key: value if isinstance(value, str) else f"{value:.12g}" for key, value in values.items()},
    )  # fmt: skip
    return NO_XML.sub("�", page).encode()


def failure(check: Check) -> str:
    """The reason of a failed check, in a sentence."""
    found = "could not be measured" if check.value is None else quantity(check.value, check.unit)
    asked = f" where {bound(check)} was asked" if check.limit is not None else ""
    return f"{check.name}: {found}{asked}{f', {check.where}' if check.where else ''}."
