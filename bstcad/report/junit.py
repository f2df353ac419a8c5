"""report.junit.xml: the checks in the form in which build servers read tests, one test case a check."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from bstcad.report.record import Contents
from bstcad.report.units import bound, quantity
from bstcad.verify.verdict import Check

NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0 has no such characters


def junit(report: Contents) -> bytes:
    """The checks of a design as a suite; its time is that of the verification, which no check has a part of its own in.

    A check that is stated, not judged, is a case that passes; what was given up stands in the suite's output.
    """
    checks = report.checks
    counts = {"tests": len(checks), "failures": sum(not check.passed for check in checks), "errors": 0, "skipped": 0}
    numbers = {key: str(value) for key, value in counts.items()}
    took = [stage.seconds for stage in report.stages if stage.name == "verify"]
    numbers |= {"time": f"{took[-1]:.3f}"} if took else {}
    top = ElementTree.Element("testsuites", numbers)
    suite = ElementTree.SubElement(top, "testsuite", {"name": _text(report.name)} | numbers)
    properties = ElementTree.SubElement(suite, "properties")
    for key in ("verdict", "rrmsd", "rrmsd_noise", "leak", "light_on_target", "efficiency", "quality"):
        if (value := getattr(report, key)) is not None:
            told = value if isinstance(value, str) else f"{value:.12g}"
            ElementTree.SubElement(properties, "property", {"name": key, "value": _text(told)})
    for check in checks:
        _case(suite, check, f"bstcad.{report.optic}.{report.name}")
    if report.given_up:
        ElementTree.SubElement(suite, "system-out").text = _text("\n".join(report.given_up))
    ElementTree.indent(top)
    return ElementTree.tostring(top, encoding="utf-8", xml_declaration=True) + b"\n"


def _case(suite: ElementTree.Element, check: Check, group: str) -> None:
    """One check as a test case, with its value; one that failed with a sentence."""
    case = ElementTree.SubElement(suite, "testcase", {"classname": _text(group), "name": _text(check.name)})
    if not check.passed:
        said = _text(failure(check))
        ElementTree.SubElement(case, "failure", {"message": said, "type": "check"}).text = said
    ElementTree.SubElement(case, "system-out").text = _text(f"{_found(check)}, limit {bound(check) or 'none'}")


def failure(check: Check) -> str:
    """Why a check fails, in a sentence."""
    asked = f" where {bound(check)} was asked" if check.limit is not None else ""
    return f"{check.name}: {_found(check)}{asked}{f', {check.where}' if check.where else ''}."


def _found(check: Check) -> str:
    return "could not be measured" if check.value is None else quantity(check.value, check.unit)


def _text(said: str) -> str:
    return NO_XML.sub("�", said)
