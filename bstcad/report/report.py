"""Report of a design: report.html and a summary on the terminal for people, report.junit.xml for build servers.

All three show the record of report.json (record.Contents).  The terminal also shows the record of a STEP file without a
design (record.Examined), and a plan, the entries that `bstcad plan --json` prints.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bstcad.optics.receivers.goal import suffix_of
from bstcad.optics.surfaces.sides import size_text
from bstcad.report.goal_figures import GoalFigures
from bstcad.report.prescription import LIGHT_DIRECTIONS, order_rows
from bstcad.report.record import LEFT_OUT, Contents, Examined, LeftOut, bounds, changes
from bstcad.report.units import Remark, Rows, about, bound, environment, paragraphs, quantity, tables
from bstcad.report.units import remarks as written
from bstcad.verify.verdict import NO_LIMIT, Check

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.table import Table
    from rich.text import Text

Figure = tuple[str, str, str]  # number of the report in words: name, value with its unit, remark or ""
BEGIN, END = "<!-- tolerances -->", "<!-- end of tolerances -->"  # comments of report.html around a tolerance study
NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # characters that XML 1.0 forbids
PAGE_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"  # policy of report.html: it loads nothing
VIEWER = Path(__file__).with_name("solid_view.js")
BADGES = {  # verdict of a report: (sign, style on the page, style on the terminal)
    "passed": ("✓", "pass", "bold green"),
    "passed with remarks": ("✓", "remarks", "bold yellow"),
    NO_LIMIT: ("?", "plain", "bold cyan"),
    "failed": ("✗", "fail", "bold red"),
}
# style on the terminal of each kind of a plan's verdict
PLAN_STYLES = {"blurred": "bold red", "beyond": "bold red", "within": "bold green", "no limit": "bold cyan"}
GLASS_LINES = ("lost through the sides", "total internal reflection")  # lines of `ledger`, omitted for a mirror if 0


# --- words ------------------------------------------------------------------------------------------------------------


def counts(checks: Sequence[Check]) -> str:
    """Return a phrase with the numbers of checks that meet a limit, that fail, and that have no limit."""
    failed = sum(not check.passed for check in checks)
    unjudged = sum(check.passed and check.limit is None for check in checks)
    more = ((failed, "failed"), (unjudged, "without a limit (not judged)"))
    passed = f"{len(checks) - failed - unjudged} checks passed"
    return "; ".join([passed, *(f"{count} {words}" for count, words in more if count)])


def explanation(report: Contents) -> str:
    """Return the sentences beside the verdict: numbers of checks, `doubts`, and for a draft how to reduce the RRMSD."""
    draft = 'A draft has few evaluations: the quality "standard" gives a smaller RRMSD.'
    texts = (f"{counts(report.checks)}.", *(doubt.text for doubt in doubts(report)))
    return " ".join((*texts, draft) if report.quality == "draft" else texts)


def doubts(report: Contents | Examined) -> list[Remark]:
    """Return remarks on the verdict: the scene does not limit the light or the RRMSD; the RRMSD is not resolved."""
    if isinstance(report, Examined):
        return []
    return written("verdict.txt.j2", "doubts", report=report)


def cell_sentences(goal: GoalFigures) -> list[str]:
    """Return sentences on the cells down to which the light on a target is right; goal: measured on half pixels."""
    return paragraphs("cells.txt.j2", "sentence", goal=goal)


def check_line(check: Check) -> str:
    """Return a check as a line, such as "smallest thickness (at (1, 2) mm): 0.7 mm, limit ≥ 1 mm"."""
    limit = f", limit {bound(check)}" if check.limit is not None else ""
    where = f" ({check.where})" if check.where else ""
    return f"{check.name}{where}: {quantity(check.value, check.unit)}{limit}"


def machine(facts: Mapping[str, Any]) -> Rows:
    """Return the known facts of report.json's machine as rows; for a GPU also that another run gives another lens."""
    known = {key: value for key, value in facts.items() if value is not None}
    sizes = {
        key: f"{value:.3g} GB" for key, value in known.items() if key.endswith("_gb") and not isinstance(value, str)
    }
    rows = [(key.removesuffix("_gb").replace("_", " "), str(value)) for key, value in (known | sizes).items()]
    if facts.get("device", "cpu") != "cpu":
        rows.append(("same run again", "gives another lens of equal merit, since a GPU sums in no fixed order"))
    return rows


def ledger(flux: Mapping[str, float], of: str) -> dict[str, float]:
    """Return a flux ledger (fraction of the source's flux by where it goes) in a report's words; of: lens or mirror."""
    lines = {line: part for line, part in flux.items() if of == "lens" or part or line not in GLASS_LINES}
    for old, new in (("the lens", f"the {of}"), ("glass", "material"), ("on t", "on the t"), ("off t", "beside the t")):
        lines = {line.replace(old, new): part for line, part in lines.items()}
    return lines


def first_figures(report: Contents | Examined) -> list[Figure]:
    """Return the first numbers of report.html and of the terminal, on a design or on a STEP file without one."""
    if isinstance(report, Examined):
        return [(name, value, "") for name, value in report.part.items()]
    rows = tables("first_figures.txt.j2", report=report)["first"]
    return [(name, *(part.strip() for part in text.partition(" |")[::2])) for name, text in rows]


# --- report.html and report.junit.xml ---------------------------------------------------------------------------------


def html(
    report: Contents,
    figures: Mapping[str, bytes | None],
    *,
    scene: str = "",
    prescription: Mapping[str, Rows] | None = None,
    solid: str = "",
    tolerances: str = "",
    sections: Sequence[tuple[str, str]] = (),
) -> bytes:
    """Return the content of report.html, which contains its pictures and styles and loads nothing.

    figures: PNG bytes by name; None or absent: the picture is omitted (a sentence replaces the 3-D picture).  scene:
    TOML text of the scene with all defaults.  prescription: rows by heading, from bstcad.report.prescription.sections.
    solid: JSON from bstcad.figures.rendering.turnable; "": a page without a script.  tolerances: HTML from
    bstcad.manufacture.tolerance.tolerances.  sections: (heading, HTML) of each section that a script of the user adds.
    """
    from markupsafe import Markup

    viewer = VIEWER.read_text(encoding="utf-8") if solid else ""
    digest = base64.b64encode(hashlib.sha256(viewer.encode()).digest()).decode()
    allowed = f"'sha256-{digest}'" if viewer else "'none'"
    template = environment().get_template("report.html.j2")
    page = template.render(
        report=report,
        pictures=base64_images(figures),
        badge=BADGES[report.verdict],
        explanation=explanation(report),
        counts=counts(report.checks),
        first_figures=first_figures(report),
        facts_of=tables("report_facts.txt.j2", report=report),
        machine=machine(report.machine),
        ledger=ledger(report.flux, report.optic),
        bounds=bounds(report.bounds),
        optic=report.optic,
        direction=LIGHT_DIRECTIONS[report.optic],
        order=report.order and order_rows(report.order),
        changes=changes,
        names=LEFT_OUT,
        prescription=prescription,
        scene=scene,
        tolerances=Markup(f"{BEGIN}\n{tolerances}{END}\n"),  # safe: written by this program
        solid=Markup(solid),  # safe: written by this program
        sections=[(heading, Markup(text)) for heading, text in sections],  # PAGE_POLICY allows no script in it
        viewer=Markup(viewer),
        policy=f"{PAGE_POLICY}; script-src {allowed}; base-uri 'none'",
    )
    return page.encode()


def base64_images(pictures: Mapping[str, bytes | None]) -> dict[str, str]:
    """Return pictures (PNG bytes by name) in base64; a picture that is None is omitted."""
    return {key: base64.b64encode(picture).decode() for key, picture in pictures.items() if picture}


def junit(report: Contents) -> bytes:
    """Return the checks of a design as a JUnit suite, one test case per check.

    A check without a limit counts as passed, or as skipped if the verdict is NO_LIMIT.  The time of the suite
    is that of the verification, and its output contains the remarks.
    """
    unjudged = [check for check in report.checks if report.verdict == NO_LIMIT and check.limit is None]
    text = environment().get_template("junit.xml.j2").render(report=report, unjudged=unjudged)
    return NOT_IN_XML.sub("�", text).encode()


# --- terminal ---------------------------------------------------------------------------------------------------------


def summary(report: Contents | Examined, verbose: bool = False) -> Group:
    """Return verdict, remarks, first figures, failed checks (verbose: all) and numbers of checks, for `rich.print`."""
    from rich.console import Group
    from rich.text import Text

    lines = [Text.assemble((report.verdict.upper(), BADGES[report.verdict][2]), f": {report.title or report.name}")]
    remarks = [*report.all_remarks, *doubts(report)]
    if report.verdict == NO_LIMIT:
        remarks = [*doubts(report), *report.all_remarks]
    lines += [Text.assemble(f"Remark: {remark.text}", topic_tag(remark)) for remark in remarks]
    figures = first_figures(report)
    name_width = max((len(name) for name, _, _ in figures), default=0)
    lines += [Text(f"{name:{name_width}}  {value}{remark and f' ({remark})'}") for name, value, remark in figures]
    lines += map(Text, filter(None, [bounds(report.bounds)]))
    lines += check_lines(report.checks, verbose)
    lines.append(Text(f"{counts(report.checks)}{'' if verbose else '; --verbose lists them'}."))
    if remarks or verbose or not all(check.passed for check in report.checks):
        lines.append(Text("The command `bstcad docs NAME` explains the check or remark that ends in [NAME].", "dim"))
    return Group(*lines)


def check_lines(checks: Sequence[Check], verbose: bool, of: str = "") -> Iterator[Text]:
    """Yield a line per failed check, then with `verbose` one per passed check; of: text before each check's name."""
    from rich.text import Text

    for check in sorted(checks, key=lambda check: check.passed):
        if not check.passed:
            yield Text.assemble(("FAIL", "bold red"), f" {of}{check_line(check)}", topic_tag(check))
        elif verbose:
            outcome = "not judged" if check.limit is None else "pass"
            yield Text.assemble(f"{outcome} {of}{check_line(check)}", topic_tag(check))


def topic_tag(line: Check | Remark) -> tuple[str, str]:
    """Return (" [NAME]", style) if `bstcad docs NAME` explains this check or remark, else ("", style)."""
    return line.topic and f" [{line.topic}]", "dim"


# --- terminal: a plan -------------------------------------------------------------------------------------------------


def plan_effects(plan: Mapping[str, Any], title: str, optic: str) -> Group:
    """Return tables of the effects that are simulated and not simulated; plan: entries of `bstcad plan --json`.

    title: heading.  optic: lens or mirror.  A verdict that already follows from the effects alone comes first.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    simulated, remedies = _table("simulated", "<requested by"), Table.grid(padding=(0, 2))
    for item in plan["simulated"]:
        simulated.add_row(Text(item["what"]), Text(item["asked_by"]))
    for entry in (LeftOut(**entry) for entry in plan["left_out"]):
        if entry.simulate_by:
            remedies.add_row(Text(f"  {LEFT_OUT[entry.kind]}"), Text(entry.simulate_by))
    early = [*_verdict(plan), Text()] if "verdict" in plan else []
    lines = [*early, Text(title, "bold"), simulated]
    for goal in plan["goals"]:
        lines += _of_target(goal, suffix_of(goal["key"]), optic)
    lines.append(Text(" ".join((*paragraphs("plan.txt.j2", "estimated", optic=optic), plan.get("caveat", ""))).strip()))
    if remedies.row_count:
        lines += [Text(), Text("To simulate an effect, write in the scene:"), remedies]
    return Group(*lines)


def _verdict(plan: Mapping[str, Any]) -> Iterator[Text]:
    from rich.text import Text

    kind, sentence = plan["verdict"]["kind"], plan["verdict"]["sentence"]
    yield Text.assemble(("PLAN: ", PLAN_STYLES.get(kind, "bold yellow")), sentence)


def _of_target(plan: Mapping[str, Any], of: str, optic: str) -> Iterator[RenderableType]:
    """Yield effects not simulated and sentences on a target; plan: its entry in `goals`; of: ", target[1]" or ""."""
    from rich.text import Text

    left_out = _table(f"not simulated{of}", "light on target", "RRMSD", "blur")
    for entry in (LeftOut(**entry) for entry in plan["left_out"]):
        detail = (f", {entry.detail}" if entry.detail else "", "dim")
        left_out.add_row(Text.assemble(LEFT_OUT[entry.kind], detail), *changes(entry))
    yield left_out
    for sentence in paragraphs("plan.txt.j2", "light", goal=plan, optic=optic):
        yield Text(sentence)
        yield Text()


def made_sentences(made: Mapping[str, Any], optic: str) -> list[str]:
    """Return sentences on the picture of a part as made; made: entry `made` of `bstcad plan --json`."""
    return paragraphs("plan.txt.j2", "made", made=made, optic=optic)


def lit_sentences(lit: Mapping[str, Any], optic: str) -> list[str]:
    """Return sentences on the picture of a lens in another light; lit: entry `lit` of `bstcad plan --json`."""
    return paragraphs("plan.txt.j2", "lit", lit=lit, optic=optic)


def plan_predictions(plan: Mapping[str, Any]) -> Group:
    """Return predicted seconds, RRMSD and memory by quality, and for a finer net; plan: as for `plan_effects`."""
    from rich.console import Group
    from rich.text import Text

    head = list(_verdict(plan)) if plan["verdict"]["kind"] not in ("blurred", "not predicted") else []
    if plan["predicted"] is None:
        return Group(Text(), Text(f"Seconds, RRMSD and memory are not predicted: {plan['not_predicted']}."))
    rows, finer = dict(plan["predicted"]), plan["finer"]
    if finer is not None:
        rows[f"standard, {size_text(finer['control_points'])} control points"] = finer["predicted"]["standard"]
    headings = "seconds", "RRMSD on pixels", "on half pixels", "memory (GB)"
    table = _table("on this machine", *headings)
    for name, entry in rows.items():
        intervals = (map(about, entry[key]) for key in ("seconds", "rrmsd", "rrmsd_half", "memory_gb"))
        cells = (Text.assemble(likely, (f" ({low} to {high})", "dim")) for low, likely, high in intervals)
        table.add_row(Text(name), *cells)
    return Group(Text(), *head, table, Text(" ".join((*plan["notes"], *paragraphs("plan.txt.j2", "intervals")))))


def _table(first: str, *others: str) -> Table:
    """Return an empty table; its first column, and others whose heading begins with "<", are left-justified."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in (f"<{first}", *others):
        table.add_column(heading.removeprefix("<"), justify="left" if heading.startswith("<") else "right")
    return table
