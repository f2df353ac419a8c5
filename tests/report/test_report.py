"""The report says what the record says, fails where a check fails, and is one file that fetches nothing."""

import base64
import copy
import hashlib
import html
import io
import json
import re
from html.parser import HTMLParser

import pytest
from rich.console import Console

from bstcad.report import report as reports
from bstcad.report import units
from bstcad.report.record import of_json
from bstcad.verify.verdict import Check

PNG = b"\x89PNG not a real picture"
REPORT = {
    "name": "thu",
    "title": "Letters",
    "verdict": "passed",
    "passed": True,
    "rrmsd": 0.0283712,
    "rrmsd_tent": 0.0241,
    "rrmsd_noise": 0.002,
    "light_on_target": 0.97,
    "efficiency": 0.99931,
    "flux": {"on target": 0.97, "off target": 0.01, "missed the lens": 0.02},
    "prescription": {"index": 1.49},
    "seconds_total": 71.4,
    "stages": [
        {"name": "transport", "seconds": 1.5, "rrmsd": None, "cpu_seconds": None},
        {"name": "stage 2", "seconds": 69.9, "rrmsd": 0.03, "cpu_seconds": 120.5},
    ],
    "history": [{"seconds": 5.0, "rrmsd": 0.5}, {"seconds": 60.0, "rrmsd": 0.03}],
    "checks": [
        {"name": "RRMSD", "value": 0.0283712, "limit": 0.05, "unit": "", "passed": True, "where": ""},
        {"name": "form of the STEP", "value": 3e-7, "limit": 1e-6, "unit": "mm", "passed": True, "where": ""},
        {"name": "thinnest place", "value": 5.8123, "limit": 1.0, "unit": "mm", "passed": True, "where": ""},
    ],
    "effects": {"simulated": [], "left_out": ["absorption"]},
    "machine": {"system": "Linux", "cores": 2, "memory_gb": 7.76},
    "versions": {"python": "3.11.9"},
    "seed": 0,
    "rrmsd_asked": 0.05,
}
CONTENTS = of_json(json.dumps(REPORT))
SHAPE = {"centre_thickness": 12.0, "thickness_min": 5.8, "radius_min_concave": 8.9, "radius_min_convex": None}


def contents(report):
    return of_json(json.dumps(report))


def page_of(tmp_path, report, figures=None, scene=""):
    """The text of report.html."""
    path = tmp_path / "report.html"
    reports.write_html(contents(report), figures or {}, path, scene=scene)
    return path.read_text(encoding="utf-8")


def test_the_blur_of_a_source_of_some_size_is_said(tmp_path):
    blurred = " ".join(page_of(tmp_path, REPORT | {"blur": {"width": 50.2, "pixels": 6.03, "rrmsd": 0.114}}).split())
    assert "50.2 mm or 6.03 pixels wide" in blurred and "RRMSD of 0.114" in blurred
    assert "The source has some size" not in page_of(tmp_path, REPORT)


def failing():
    """REPORT with the thickness check failed."""
    report = copy.deepcopy(REPORT)
    report |= {"passed": False, "verdict": "failed"}
    report["checks"][2] |= {"value": 0.7, "passed": False}
    return report


def printed(report, verbose=False):
    """What the terminal shows, 120 columns wide."""
    console = Console(file=io.StringIO(), width=120)
    console.print(reports.summary(contents(report), verbose))
    return console.file.getvalue()


def test_of_a_design_on_a_gpu_it_is_said_that_it_cannot_be_had_again_to_the_bit():
    assert "once more" not in dict(reports.machine({"device": "cpu", "cores": 2}))
    assert "no fixed order" in dict(reports.machine({"device": "NVIDIA X", "cores": 2}))["once more"]


class References(HTMLParser):
    """Collects what a page would fetch or run, and its pictures' alt texts."""

    def __init__(self, page):
        super().__init__()
        self.fetched, self.tags, self.alts = [], set(), []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.fetched += [value for name, value in attributes if name in ("src", "href", "srcset", "data", "poster")]
        self.alts += [value for name, value in attributes if name == "alt"]


class TestHtml:
    def test_one_file_that_fetches_and_runs_nothing(self, tmp_path):
        page = page_of(tmp_path, REPORT, dict.fromkeys(reports.FIGURES, PNG))
        found = References(page)
        assert len(found.fetched) == len(reports.FIGURES)
        assert all(reference.startswith("data:image/png;base64,") for reference in found.fetched)
        assert not found.tags & {"script", "link", "iframe", "object"}
        assert "@import" not in page
        assert "url(" not in page
        assert "http:" not in page and "https:" not in page
        assert sorted(found.alts) == sorted(reports.FIGURES.values())

    def test_a_page_runs_one_script_of_ours_or_none(self, tmp_path):
        """By the browser's own rule, which tells scripts apart by their hashes."""
        path = tmp_path / "report.html"
        reports.write_html(CONTENTS, {"lens": PNG}, path, solid='{"values": ""}')
        page = path.read_text(encoding="utf-8")
        scripts = re.findall(r"<script(.*?)>(.*?)</script>", page, re.S)
        assert [kind for kind, _ in scripts] == [' type="application/json" id="solid"', ""]
        digest = base64.b64encode(hashlib.sha256(scripts[1][1].encode()).digest()).decode()
        assert f"script-src 'sha256-{digest}'" in html.unescape(page)
        assert "script-src 'none'" in html.unescape(page_of(tmp_path, REPORT, {"lens": PNG}))

    @pytest.mark.parametrize("place", ["title", "name", "check", "stage", "effect", "flux", "machine", "scene"])
    def test_text_of_the_user_is_escaped(self, tmp_path, place):
        evil, report = "<script>alert('&')</script>", copy.deepcopy(REPORT)
        match place:
            case "title" | "name":
                report[place] = evil
            case "check":
                report["checks"][0]["name"] = evil
                report["checks"][0]["passed"] = False  # named in the header too
            case "stage":
                report["stages"][0]["name"] = evil
            case "effect":
                report["effects"]["left_out"] = [evil]
            case "flux":
                report["flux"] = {evil: 1.0}
            case "machine":
                report["machine"]["processor"] = evil
        page = page_of(tmp_path, report, scene=evil if place == "scene" else "")
        assert "<script" not in page
        assert evil in html.unescape(page)

    def test_passed(self, tmp_path):
        page = page_of(tmp_path, REPORT)
        assert "PASSED" in page
        assert "All 3 checks passed." in page
        assert "FAIL" not in page

    def test_remarks_have_a_colour_of_their_own(self, tmp_path):
        remarked = REPORT | {"verdict": "passed with remarks", "given_up": ["The lens is thick."]}
        for verdict, report in (("pass", REPORT), ("remarks", remarked), ("fail", failing())):
            assert f'<div class="verdict {verdict}">' in page_of(tmp_path, report)
        page = page_of(tmp_path, remarked)
        assert "✓ PASSED WITH REMARKS" in page and page.index("The lens is thick.") < page.index("<h2>Irradiance")
        assert printed(remarked).startswith("PASSED WITH REMARKS: Letters\nRemark: The lens is thick.\n")

    def test_that_no_rrmsd_was_asked_is_said(self, tmp_path):
        said = "No RRMSD was asked (accept.rrmsd); any up to 0.05 passes."
        for asked, there in ((None, True), (0.05, False)):
            report = REPORT | {"rrmsd_asked": asked}
            assert (said in page_of(tmp_path, report)) is (said in printed(report)) is there

    def test_the_finest_detail_is_said_with_what_makes_it_and_where_it_is_finer(self, tmp_path):
        detail = {
            "width": 5.57, "source_image": 5.55, "pixel": 0.39, "distance": 600.0, "nearer_distance": 250.0,
            "nearer_width": 2.356, "of": "source.divergence = 0.53 degrees", "assumed": False,
        }  # fmt: skip
        for changes, value, said in (
            ({}, "5.6 mm", "by source.divergence = 0.53 degrees; with the target at 250 mm instead of 600 mm: 2.4 mm"),
            (
                {"of": "a disc of 0.1 mm", "assumed": True, "nearer_distance": None, "nearer_width": None},
                "5.6 mm",
                "by a disc of 0.1 mm, which the scene does not state",
            ),
            (
                {"width": 0.46, "source_image": 0.1, "nearer_distance": None, "nearer_width": None},
                "0.46 mm",
                "by the pixels; the source's image is 0.1 mm wide (source.divergence = 0.53 degrees)",
            ),
        ):
            report = REPORT | {"finest_detail": detail | changes}
            assert ("Finest detail on the target", value, said) in reports.first_figures(contents(report))
            page = html.unescape(page_of(tmp_path, report))
            assert said in page and page.index(value) < page.index("<h2>")
            assert f"Finest detail on the target {value} ({said})" in " ".join(printed(report).split())

    def test_the_light_that_arrives_comes_second_with_where_the_rest_went(self, tmp_path):
        flux = {"on target": 0.338, "off target": 0.008, "missed the lens": 0.469, "lost through the sides": 0.185}
        report = REPORT | {"light_on_target": 0.338, "flux": flux | {"total internal reflection": 0.0}}
        first, second, *_ = reports.first_figures(contents(report))
        assert first[0].startswith("RRMSD")
        remark = "of what the source sends out; missed the lens 46.9 %, sides 18.5 %, beside the target 0.80 %"
        assert second == ("Light on the target", "33.8 %", remark)
        text = printed(report)
        assert text.index("RRMSD, re-read") < text.index("Light on the target  33.8 %") < text.index("checks passed")
        assert remark in page_of(tmp_path, report)

    def test_light_in_the_dark_stands_beside_the_rrmsd_where_there_is_dark(self, tmp_path):
        said = "Light in the dark    1.2 % (of the light on the target, where it wants none; lit pixels are 85 times as"
        assert "in the dark" not in printed(REPORT) + page_of(tmp_path, REPORT)
        leaky = REPORT | {"leak": 0.012, "contrast": 85.0}
        text = printed(leaky)
        assert said in text and text.index("RRMSD, re-read") < text.index(said) < text.index("Light on the target")
        assert "85 times as bright" in page_of(tmp_path, leaky)

    def test_a_failing_check_fails_and_is_named(self, tmp_path):
        page = page_of(tmp_path, failing())
        header = page[page.index("<header>") : page.index("</header>")]
        assert "FAILED" in header
        assert "thinnest place" in header and "0.7 mm" in header and "≥ 1 mm" in header
        assert "form of the STEP" not in header
        assert "PASSED" not in page

    def test_where_it_fails_is_said_in_the_header_and_in_the_table(self, tmp_path):
        report = failing()
        report["checks"][2]["where"] = "at <b>(1, 2)</b> mm"
        assert page_of(tmp_path, report).count("thinnest place (at &lt;b&gt;(1, 2)&lt;/b&gt; mm)") == 2

    def test_rrmsd_below_five_noise_floors_is_not_resolved(self, tmp_path):
        assert "not resolved" not in page_of(tmp_path, REPORT | {"rrmsd": 0.0101, "rrmsd_noise": 0.002})
        assert "not resolved" in page_of(tmp_path, REPORT | {"rrmsd": 0.0099, "rrmsd_noise": 0.002})

    def test_no_picture_of_the_lens_is_said_in_one_sentence(self, tmp_path):
        assert "No 3-D picture" in page_of(tmp_path, REPORT, {"lens": None})
        assert "No 3-D picture" not in page_of(tmp_path, REPORT, {"lens": PNG})

    def test_limits_have_a_sense_and_a_human_unit(self, tmp_path):
        page = page_of(tmp_path, REPORT)
        assert "0.3 nm" in page
        assert "≤ 1 nm" in page
        assert "≥ 1 mm" in page

    def test_shape_is_shown_and_an_absent_radius_is_none(self, tmp_path):
        page = page_of(tmp_path, REPORT | {"shape": SHAPE, "quality": "draft"})
        assert "8.9 mm" in page
        assert "smallest convex radius none" in page
        assert "draft" in page


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (3.2e-7, "mm", "0.32 nm"),
        (1e-6, "mm", "1 nm"),
        (1e-9, "mm", "1 pm"),
        (1e-14, "mm", "< 0.001 pm"),
        (0.00173, "mm", "1.73 µm"),
        (-12.345, "mm", "−12.3 mm"),
        (0.0, "mm", "0 mm"),
        (17.2238, "deg", "17.2°"),
        (1e-4, "deg", "0.36″"),
        (6512.33, "mm³", "6512 mm³"),
        (0.02837, "", "0.0284"),
        (3.2e-7, "", "3.2 × 10⁻⁷"),
        (1e-6, "", "10⁻⁶"),
        (1, "", "1"),
        (263169, "points", "263\u202f169 points"),
        (True, "", "yes"),
        (None, "mm", "none"),
    ],
)
def test_quantity(value, unit, text):
    assert units.quantity(value, unit) == text


@pytest.mark.parametrize(
    ("part", "text"),
    [(0.9712, "97.1 %"), (0.99996, "99.996 %"), (1.0, "100 %"), (0.0, "0 %"), (0.00067, "0.067 %"), (1e-9, "< 0.001 %")]
    + [(1 - 1e-9, "> 99.999 %")],
)
def test_percent_never_rounds_to_all_or_nothing(part, text):
    assert units.percent(part) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(8.61, "8.6 s"), (59.97, "1 min 0 s"), (71.4, "1 min 11 s"), (3720, "1 h 2 min")]
)
def test_duration(seconds, text):
    assert units.duration(seconds) == text


@pytest.mark.parametrize(
    ("value", "limit", "passed", "sense"),
    [(1, 2, True, "≤"), (3, 2, False, "≤"), (3, 2, True, "≥"), (1, 2, False, "≥"), (1, 1, True, "")],
)
def test_sense_of_a_limit_follows_from_the_outcome(value, limit, passed, sense):
    check = Check("", value, limit, "", passed)
    assert units.bound(check) == f"{sense} {limit}".strip()


class TestSummary:
    def test_what_passed_is_counted_and_listed_when_asked(self):
        short, long = printed(REPORT), printed(REPORT, verbose=True)
        assert short.startswith("PASSED: Letters\n") and short.endswith("\n3 checks passed; --verbose lists them.\n")
        assert not any(check["name"] + ":" in short for check in REPORT["checks"])
        assert "\npass form of the STEP: 0.3 nm, limit ≤ 1 nm\n" in long and "FAIL" not in long
        assert long.count("\npass ") == 3 and long.endswith("\n3 checks passed.\n")

    def test_a_failed_check_is_shown_once_with_value_limit_and_place_after_the_first_figures(self):
        report = failing() | {"given_up": ["The lens is thick."]}
        report["checks"][2] |= {"where": "at [red](1, 2) mm", "name": "[/] thinnest place"}
        lines = printed(report).splitlines()
        verdict, remark, *figures, failed, passed = lines
        assert (verdict, remark) == ("FAILED: Letters", "Remark: The lens is thick.")
        assert failed == "FAIL [/] thinnest place (at [red](1, 2) mm): 0.7 mm, limit ≥ 1 mm"
        assert passed.startswith("2 checks passed") and any(line.startswith("RRMSD, re-read STEP") for line in figures)

    def test_terminal_and_page_show_the_same_first_figures(self, tmp_path):
        outline = {"width": 16.0, "height": 12.5, "shape": "rectangle"}
        report = REPORT | {"shape": SHAPE, "prescription": {"outline": outline}}
        rows = reports.first_figures(contents(report))
        assert ("Size of the lens", "16 × 12.5 mm", "12 mm thick at the centre, thinnest place 5.8 mm") in rows
        text, page = printed(report), page_of(tmp_path, report)
        assert len(rows) == 5 and len(text.splitlines()) == 7  # the verdict before them, the number of checks after
        for name, value, remark in rows:
            assert re.search(rf"^{re.escape(name)} +{re.escape(value)} \({re.escape(remark)}\)$", text, re.M)
            assert f'<dt>{name}</dt><dd class="value">{value}</dd><dd class="remark">{remark}</dd>' in page

    def test_a_round_lens_has_a_diameter(self):
        report = REPORT | {"prescription": {"outline": {"radius": 7.5, "shape": "circle"}}}
        assert ("Size of the lens", "Ø 15 mm", "") in reports.first_figures(contents(report))

    def test_a_title_is_text_not_markup(self):
        assert "[red]Letters[/red]" in printed(REPORT | {"title": "[red]Letters[/red]"})
