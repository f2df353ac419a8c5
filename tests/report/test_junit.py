"""report.junit.xml says what report.json says, in the form that build servers read."""

import json
from dataclasses import replace

import pytest
from lxml import etree

from bstcad.report.report import junit
from tests.report.test_report import CONTENTS, contents, failing

# What Jenkins and GitLab read: the elements that each may hold, and the attributes that each must have.
HOLDS = {
    "testsuites": {"testsuite"},
    "testsuite": {"properties", "testcase", "system-out"},
    "properties": {"property"},
    "testcase": {"failure", "system-out"},
    "property": set(),
    "failure": set(),
    "system-out": set(),
}
HAS = {
    "testsuite": {"name", "tests", "failures", "errors", "skipped"},
    "testcase": {"classname", "name"},
    "failure": {"message", "type"},
    "property": {"name", "value"},
}


def read(data):
    """The suite, its form looked at and its counts counted."""
    root = etree.fromstring(data)
    assert root.tag == "testsuites"
    for element in root.iter():
        assert {child.tag for child in element} <= HOLDS[element.tag]
        assert HAS.get(element.tag, set()) <= set(element.attrib)
    (suite,) = root
    for which in (root, suite):
        assert int(which.get("tests")) == len(suite.findall("testcase"))
        assert int(which.get("failures")) == len(suite.findall("testcase/failure"))
    return suite


def test_each_check_of_a_written_design_is_a_case(small_design):
    suite = read((small_design.folder / "report.junit.xml").read_bytes())
    told = json.loads((small_design.folder / "report.json").read_text(encoding="utf-8"))
    cases = [(case.get("name"), case.find("failure") is None) for case in suite.findall("testcase")]
    assert cases == [(check["name"], check["passed"]) for check in told["checks"]]
    seconds = next(stage["seconds"] for stage in told["stages"] if stage["name"] == "verify")
    assert float(suite.get("time")) == pytest.approx(seconds, abs=1e-3)
    assert suite.find("properties/property[@name='verdict']").get("value") == told["verdict"]


def test_a_failure_says_what_was_found_and_what_was_asked():
    report = failing()
    report["checks"][2]["where"] = "at (1, 2) mm"
    suite = read(junit(contents(report)))
    (found,) = suite.iterfind("testcase/failure")
    assert found.get("message") == "thinnest place: 0.7 mm where ≥ 1 mm was asked, at (1, 2) mm."
    assert found.getparent().get("name") == "thinnest place"


def test_what_was_not_measured_fails_and_what_is_stated_passes():
    report = failing()
    report["checks"][0] |= {"limit": None}
    report["checks"][2] |= {"value": None}
    suite = read(junit(contents(report)))
    (found,) = suite.iterfind("testcase/failure")
    assert found.text == "thinnest place: could not be measured where 1 mm was asked."
    assert suite.find("testcase/system-out").text == "0.0284, limit none"


def test_any_name_is_well_formed():
    report = replace(CONTENTS, name="a\x00b<&\"'\ud800", given_up=("\x1b[31mred",))
    suite = read(junit(report))
    assert suite.get("name") == "a�b<&\"'�" and suite.find("system-out").text == "�[31mred"
