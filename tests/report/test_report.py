"""The report says what the record says, fails where a check fails, and is one file that fetches nothing.

report.junit.xml says the same in the form that build servers read.
"""

import base64
import copy
import hashlib
import html
import io
import json
import re
from dataclasses import replace

import pytest
from lxml import etree
from rich.console import Console

from bstcad.report import report as reports
from bstcad.report import units
from bstcad.report.record import WORST_GOAL_KEYS, of_json
from bstcad.verify.verdict import Check

PICTURES = (
    "irradiance", "cross_section", "ghost", "lines", "lens", "side_view", "surface", "transport", "convergence",
    "isolux", "polar", "isocandela", "cone",
)  # fmt: skip
PNG = b"\x89PNG not a real picture"
REPORT = {
    "name": "thu", "title": "Letters", "verdict": "passed", "passed": True, "rrmsd": 0.0283712, "rrmsd_tent": 0.0241,
    "rrmsd_noise": 0.002, "light_on_target": 0.97, "efficiency": 0.99931,
    "goals": [{
        "key": "target", "where": "z = 500 mm", "weight": 1.0, "rrmsd": 0.0283712, "rrmsd_standard_error": 0.002,
        "rrmsd_tent": 0.0241, "light_on_target": 0.97, "efficiency": 0.99931, "leak": None, "contrast": None,
        "unit": "mm",
    }],
    "flux": {"on target": 0.97, "off target": 0.01, "missed the lens": 0.02},
    "prescription": {"index": 1.49},
    "seconds_total": 71.4,
    "stages": [
        {"name": "transport", "seconds": 1.5, "rrmsd": None, "cpu_seconds": None},
        {"name": "stage 2", "seconds": 69.9, "rrmsd": 0.03, "cpu_seconds": 120.5},
    ],
    "history": [{"seconds": 5.0, "rrmsd": 0.5}, {"seconds": 60.0, "rrmsd": 0.03}],
    "checks": [
        {"name": "RRMSD", "value": 0.0283712, "limit": 0.05, "unit": "", "passed": True, "where": "",
         "id": "rrmsd"},
        {"name": "form of the STEP", "value": 3e-7, "limit": 1e-6, "unit": "mm", "passed": True, "where": "",
         "id": "form"},
        {"name": "thinnest place", "value": 5.8123, "limit": 1.0, "unit": "mm", "passed": True, "where": "",
         "id": ""},
    ],
    "effects": {"simulated": [], "left_out": ["absorption"]},
    "machine": {"system": "Linux", "cores": 2, "memory_gb": 7.76},
    "versions": {"python": "3.11.9"},
    "seed": 0, "rrmsd_asked": 0.05,
}  # fmt: skip
CONTENTS = of_json(json.dumps(REPORT))
DETAIL = {
    "width": 5.57, "source_image": 5.55, "pixel": 0.39, "distance": 600.0, "nearer_distance": 250.0,
    "nearer_width": 2.356, "of": "source.divergence = 0.53 degrees", "assumed": False,
}  # fmt: skip
SHARP = {
    "throw": 812.0, "distance": 600.0, "cell": 0.39, "spot": 0.288, "spots": {"form": 0.27, "source": 0.1},
    "grade": "milled-polished", "words": "milled by a router", "assumed": False,
}  # fmt: skip
ALONE = {"nearer_distance": None, "nearer_width": None}
SHAPE = {"centre_thickness": 12.0, "thickness_min": 5.8, "radius_min_concave": 8.9, "radius_min_convex": None}


def contents(report):
    """Return the record of a report; the figures of its one goal are those of the whole."""
    figures = {name: report[key] for key, name in WORST_GOAL_KEYS.items() if key in report}
    return of_json(json.dumps(report | {"goals": [goal | figures for goal in report["goals"]]}))


def page_of(report, figures=None, scene=""):
    """The text of report.html."""
    return reports.html(contents(report), figures or {}, scene=scene).decode()


def failing():
    """REPORT with the thickness check failed."""
    report = copy.deepcopy(REPORT)
    report |= {"passed": False, "verdict": "failed"}
    report["checks"][2] |= {"value": 0.7, "passed": False}
    return report


def printed(report, verbose=False):
    """Return the text on the terminal, 240 columns wide."""
    console = Console(file=io.StringIO(), width=240)
    console.print(reports.summary(contents(report), verbose))
    return console.file.getvalue()


CURVE = {"last_tenth_seconds": 4.0, "last_tenth": 0.4, "halving": None, "power": 0.01, "last_gain": 0.0123}
GONE = {"on target": 0.338, "off target": 0.008, "missed the lens": 0.469, "lost through the sides": 0.185}
SAID = [  # changes of REPORT: words of the page; do they stand on the terminal, too?
    ({"rrmsd_asked": None}, "(accept.rrmsd), so the verdict does not judge it.", True),
    ({"rrmsd": 0.0099}, "; not resolved: the standard error 0.002", True),  # less than five standard errors
    ({"flux": GONE}, "missed the lens 46.9 %, lost through the sides 18.5 %, beside the target 0.80 %", True),
    ({"leak": 0.012, "contrast": 85.0}, "lit pixels are 85 times as bright", True),
    ({"finest_detail": DETAIL}, "degrees); it would be 2.4 mm with the target 250 mm instead of 600 mm from", True),
    ({"finest_detail": DETAIL | ALONE | {"assumed": True}}, "0.53 degrees, assumed, since the scene", True),
    ({"finest_detail": DETAIL | {"source_image": 0.1}}, "pixels; the image of the source is 0.1 mm wide (so", True),
    ({"sharp_throw": SHARP}, "Sharp up to a throw of", True),
    (
        {"sharp_throw": SHARP},
        "is 0.29 mm wide: 0.27 mm by the form, 0.1 mm by the source (part: milled by",
        True,
    ),
    ({"sharp_throw": SHARP | {"assumed": True}}, "by a router; assumed, since the scene states no grade)", True),
    ({"shape": SHAPE}, "smallest convex radius none", True),
    ({"prescription": {"outline": {"radius": 7.5, "shape": "circle"}}}, "Ø 15 mm", True),
    ({"title": "[red]Letters[/red]"}, "[red]Letters[/red]", True),
    ({"blur": {"width": 50.2, "pixels": 6.03, "rrmsd": 0.114}}, "50.2 mm (6.03 pixels) wide", False),
    ({"machine": {"device": "NVIDIA X"}}, "a GPU sums in no fixed order", False),
    ({"convergence": CURVE | {"halving": 5.66}}, "about 5.7 times the time of the evaluations", False),
    ({"stopped": "evaluations", "convergence": CURVE}, "; the last 5 lowered the RRMSD by 1.2 %", True),
    ({"picture": ["target.image: the first", "target.fit: cropped"]}, "image: the first; target.fit: cropped.", False),
]


@pytest.mark.parametrize(("changes", "words", "on_terminal"), SAID)
def test_each_fact_has_its_words_on_the_page_and_first_figures_on_the_terminal(changes, words, on_terminal):
    told, bare = (
        [" ".join(html.unescape(text).split()) for text in (page_of(report), printed(report))]
        for report in (REPORT | changes, REPORT)
    )
    assert [words in text for text in told] == [True, on_terminal]
    assert not any(words in text for text in bare)


CELLS = [
    {"cell": 0.8 * k, "unit": "mm", "pixels": k, "rrmsd": rrmsd, "standard_error": 1e-4, "blurred": blurred}
    for k, rrmsd, blurred in ((2.0, 0.02, None), (1.0, 0.0284, None), (0.5, 0.232, None), (0.25, 0.34, 0.0821))
]


def with_cells(right_down_to):
    report = copy.deepcopy(REPORT)
    report["goals"][0] |= {"rrmsd_by_cell": CELLS, "right_down_to": right_down_to}
    return report | {"rrmsd_by_cell": CELLS, "right_down_to": right_down_to}


@pytest.mark.parametrize(("smallest", "words"), [(0.8, "0.8 mm"), (None, "no measured size")])
def test_terminal_and_page_say_down_to_which_cell_the_light_is_right(smallest, words):
    figures = "RRMSD 0.0284 on pixels, 0.232 on half pixels; 0.0821 on quarter pixels with the size of the real source"
    report = with_cells(smallest)
    [line] = [line for line in printed(report).splitlines() if line.startswith("Light right down to")]
    assert words in line and figures in line
    page = " ".join(html.unescape(page_of(report, {"cell_error": PNG})).split())
    assert figures in page and words.split()[0] in page and "RRMSD against the size of the cells" in page
    bare = page_of(REPORT, {"cell_error": PNG})
    assert "Error against size" not in bare and "right down to" not in printed(REPORT)


def test_the_finest_detail_names_the_light_if_this_limits_it():
    report = with_cells(8.0) | {"finest_detail": DETAIL | ALONE | {"width": 8.0}}
    assert "limited by the light, which is right down to cells of this size" in printed(report)
    assert "limited by the image" in printed(with_cells(0.8) | {"finest_detail": DETAIL})


class TestHtml:
    def test_a_page_runs_one_script_of_ours_or_none(self):
        """The browser's own rule tells scripts apart by their hashes."""
        page = reports.html(CONTENTS, {"lens": PNG}, solid='{"values": ""}').decode()
        data, script = re.findall(r"<script(.*?)>(.*?)</script>", page, re.S)
        digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
        assert data[0] == ' type="application/json" id="solid"'
        assert f"script-src 'sha256-{digest}'" in html.unescape(page)
        bare = html.unescape(page_of(REPORT))
        assert "script-src 'none'" in bare and "No 3-D picture" in bare

    def test_text_of_the_user_is_escaped(self):
        evil = [f"<script>alert('&{k}')</script>" for k in range(8)]
        report = failing() | {"title": evil[0], "name": evil[1], "flux": {evil[2]: 1.0}, "machine": {"cores": evil[3]}}
        report["effects"]["left_out"], report["stages"][0]["name"] = [evil[4]], evil[5]
        report["checks"][2]["name"] = evil[6]  # named in the header too
        page = page_of(report, scene=evil[7])
        assert "<script" not in page and all(text in html.unescape(page) for text in evil)

    def test_remarks_have_a_colour_of_their_own(self):
        remarked = REPORT | {"verdict": "passed with remarks", "given_up": ["The lens is thick."]}
        for verdict, report in (("pass", REPORT), ("remarks", remarked), ("fail", failing())):
            assert f'<div class="verdict {verdict}">' in page_of(report)
        page = page_of(remarked)
        assert "✓ PASSED WITH REMARKS" in page and page.index("The lens is thick.") < page.index("<h2>Light on")
        assert printed(remarked).startswith("PASSED WITH REMARKS: Letters\nRemark: The lens is thick.\n")

    def test_where_no_limit_was_asked_neither_a_pass_nor_a_fail_is_said(self):
        checks = [REPORT["checks"][0] | {"limit": None}, *REPORT["checks"][1:]]
        report = REPORT | {"verdict": "no limit was asked", "rrmsd_asked": None, "checks": checks}
        first, second, *_ = printed(report).splitlines()
        assert first == "NO LIMIT WAS ASKED: Letters" and second.startswith("Remark: The scene sets no limit")
        page = page_of(report)
        assert '<div class="verdict plain"><strong>? NO LIMIT WAS ASKED' in page and "PASSED" not in page
        suite = etree.fromstring(reports.junit(contents(report)))[0]
        [skipped] = (case.get("name") for case in suite.iter("testcase") if case.find("skipped") is not None)
        assert (suite.get("failures"), suite.get("skipped"), skipped) == ("0", "1", "RRMSD")

    def test_a_failing_check_fails_and_is_named(self):
        page = page_of(failing())
        header = page[page.index("<header>") : page.index("</header>")]
        assert "FAILED" in header
        assert "thinnest place" in header and "0.7 mm" in header and "≥ 1 mm" in header
        assert "form of the STEP" not in header
        assert "PASSED" not in page and "FAIL" not in page_of(REPORT)


WORDS = [  # names of units beside a number
    (units.quantity, (3.2e-7, "mm"), "0.32 nm"), (units.quantity, (1e-14, "mm"), "< 0.001 pm"),
    (units.quantity, (0.00173, "mm"), "1.73 µm"), (units.quantity, (-12.345, "mm"), "−12.3 mm"),
    (units.quantity, (0.0, "mm"), "0 mm"), (units.quantity, (17.2238, "deg"), "17.2°"),
    (units.quantity, (1e-4, "deg"), "0.36″"), (units.quantity, (6512.33, "mm³"), "6512 mm³"),
    (units.quantity, (3.2e-7, ""), "3.2 × 10⁻⁷"), (units.quantity, (1e-6, ""), "10⁻⁶"),
    (units.quantity, (263169, "points"), "263\u202f169 points"), (units.quantity, (None, "mm"), "none"),
    (units.percent, (0.9712,), "97.1 %"), (units.percent, (0.99996,), "99.996 %"), (units.percent, (1.0,), "100 %"),
    (units.percent, (1e-9,), "< 0.001 %"), (units.percent, (1 - 1e-9,), "> 99.999 %"),
    (units.duration, (59.97,), "1 min 0 s"), (units.duration, (3720,), "1 h 2 min"),
    (units.mm, (4.3791,), "4.379"), (units.mm, (6.0402,), "6.040"), (units.mm, (-1e-9,), "0"),
    (units.interval, ((-12.0, 12.0),), "±12"), (units.interval, ((15.0, 20.5),), "15 to 20.5"),
]  # fmt: skip


@pytest.mark.parametrize(("say", "given", "text"), WORDS)
def test_numbers_in_words(say, given, text):
    assert say(*given) == text


@pytest.mark.parametrize(
    ("value", "limit", "passed", "sense"),
    [(1, 2, True, "≤"), (3, 2, False, "≤"), (3, 2, True, "≥"), (1, 2, False, "≥")],
)
def test_sense_of_a_limit_follows_from_the_outcome(value, limit, passed, sense):
    check = Check("", value, limit, "", passed)
    assert units.bound(check) == f"{sense} {limit}".strip()


class TestSummary:
    def test_what_passed_is_counted_and_listed_when_asked(self):
        short, long = printed(REPORT), printed(REPORT, verbose=True)
        assert short.startswith("PASSED: Letters\n") and short.endswith("\n3 checks passed; --verbose lists them.\n")
        assert not any(check["name"] + ":" in short for check in REPORT["checks"])
        assert "\npass form of the STEP: 0.3 nm, limit ≤ 1 nm [check-form]\n" in long and "FAIL" not in long
        assert long.count("\npass ") == 3 and "\n3 checks passed.\n" in long and "bstcad docs NAME" in long

    def test_a_failed_check_is_shown_once_with_value_limit_and_place_after_the_first_figures(self):
        report = failing() | {"given_up": ["The lens is thick."], "remarks": ["vertex-moved"]}
        report["checks"][2] |= {"where": "at [red](1, 2) mm", "name": "[/] thinnest place"}
        lines = printed(report).splitlines()
        verdict, remark, *figures, failed, passed, explained = lines
        assert (verdict, remark) == ("FAILED: Letters", "Remark: The lens is thick. [remark-vertex-moved]")
        assert failed == "FAIL [/] thinnest place (at [red](1, 2) mm): 0.7 mm, limit ≥ 1 mm"
        assert "bstcad docs NAME" in explained and passed.startswith("2 checks passed")
        assert any(line.startswith("RRMSD against the target") for line in figures)

    def test_terminal_and_page_show_the_same_first_figures(self):
        outline = {"width": 16.0, "height": 12.5, "shape": "rectangle"}
        report = REPORT | {"shape": SHAPE, "prescription": {"outline": outline}}
        rows = reports.first_figures(contents(report))
        assert ("Size of the lens", "16 × 12.5 mm", "thickness 12 mm at the centre, smallest thickness 5.8 mm") in rows
        text, page = printed(report), page_of(report)
        assert len(rows) == 5 and len(text.splitlines()) == 7  # the verdict before them, the number of checks after
        for name, value, remark in rows:
            assert re.search(rf"^{re.escape(name)} +{re.escape(value)} \({re.escape(remark)}\)$", text, re.M)
            assert f'<dt>{name}</dt><dd class="value">{value}</dd><dd class="remark">{remark}</dd>' in page


# --- report.junit.xml ------------------------------------------------------------------------------------------------

# What Jenkins and GitLab read: the elements that each may hold, and the attributes that each must have.
HOLDS = {
    "testsuites": {"testsuite"}, "testsuite": {"properties", "testcase", "system-out"}, "properties": {"property"},
    "testcase": {"properties", "failure", "system-out"},
}  # fmt: skip
HAS = {
    "testsuite": {"name", "tests", "failures", "errors", "skipped"}, "testcase": {"classname", "name"},
    "failure": {"message", "type"}, "property": {"name", "value"},
}  # fmt: skip


def read(data):
    """The suite, its form looked at and its counts counted."""
    root = etree.fromstring(data)
    assert root.tag == "testsuites"
    for element in root.iter():
        assert {child.tag for child in element} <= HOLDS.get(element.tag, set())
        assert HAS.get(element.tag, set()) <= set(element.attrib)
    (suite,) = root
    for which in (root, suite):
        assert int(which.get("tests")) == len(suite.findall("testcase"))
        assert int(which.get("failures")) == len(suite.findall("testcase/failure"))
    return suite


def test_each_check_of_a_written_design_is_a_case(small_design):
    suite = read((small_design.folder / "report.junit.xml").read_bytes())
    told = json.loads((small_design.folder / "report.json").read_text(encoding="utf-8"))
    cases = [
        (case.get("name"), case.find("properties/property[@name='id']").get("value"), case.find("failure") is None)
        for case in suite.findall("testcase")
    ]
    assert cases == [(check["name"], check["id"], check["passed"]) for check in told["checks"]]
    seconds = next(stage["seconds"] for stage in told["stages"] if stage["name"] == "verify")
    assert float(suite.get("time")) == pytest.approx(seconds, abs=1e-3)
    assert suite.find("properties/property[@name='verdict']").get("value") == told["verdict"]


@pytest.mark.parametrize(("value", "words"), [
    (0.7, "0.7 mm, limit ≥ 1 mm"), (None, "could not be measured, limit 1 mm"),
])  # fmt: skip
def test_a_failure_says_what_was_found_and_what_was_asked(value, words):
    report = failing()
    report["checks"][0] |= {"limit": None}
    report["checks"][2] |= {"value": value, "where": "at (1, 2) mm"}
    suite = read(reports.junit(contents(report)))
    (found,) = suite.iterfind("testcase/failure")
    assert found.get("message") == found.text == f"thinnest place: {words}, at (1, 2) mm."
    assert suite.find("testcase/system-out").text == "0.0284, limit none"


def test_any_name_is_well_formed():
    report = replace(CONTENTS, name="a\x00b<&\"'\ud800", given_up=("\x1b[31mred",))
    suite = read(reports.junit(report))
    assert suite.get("name") == "a�b<&\"'�" and suite.find("system-out").text == "�[31mred"
