"""Each check that bstcad can make and each remark that it can write has a section that explains it."""

import re
from itertools import accumulate
from pathlib import Path

import pytest

from bstcad.report import manual
from bstcad.report.manual import PAGES, sections
from bstcad.scene.schema import rows

PACKAGE = Path(manual.__file__).parents[1]
PARAGRAPHS = {
    "checks": ("**Measures**", "**Limit**", "**Why**", "**When it fails**"),
    "remarks": ("**Means**", "**Why**", "**What to do**"),
}


def _page(name):
    return manual.pages()[f"reference/{name}"].read_text(encoding="utf-8")


def ids(page):
    return {label.removeprefix(f"{page}#{page[:-1]}-") for label in sections() if label.startswith(f"{page}#")}


def text_of(*patterns):
    return "\n".join(path.read_text(encoding="utf-8") for each in patterns for path in PACKAGE.glob(each))


def calls(source):
    """The arguments of each call that makes a check."""
    for call in re.finditer(r"(?<!def )\b(?:Check(?:\.\w+)?|net_check)\(", source):
        depth = accumulate({"(": 1, ")": -1}.get(letter, 0) for letter in source[call.end() - 1 :])
        yield source[call.start() : call.end() + next(k for k, deep in enumerate(depth) if deep == 0)]


def test_each_check_has_an_id_and_each_id_a_section():
    source = text_of("verify/*.py", "verify/judges/*.py", "manufacture/measured/*.py")
    made = list(calls(source))
    assert len(made) > 60 and [call for call in made if "id=" not in call] == []
    assert set(re.findall(r"\bid=\"([a-z-]+)\"", source)) <= ids("checks")
    assert {id for id in ids("checks") if f'"{id}"' not in source} == set()


def test_each_remark_has_a_section():
    written = text_of("report/remarks.txt.j2", "report/verdict.txt.j2")
    begun = set(re.findall(r"^\(([a-z-]+)\) ", written, re.M))
    assert begun <= ids("remarks") and {id for id in ids("remarks") - begun if f'"{id}"' not in written} == set()


def test_each_line_of_a_report_is_explained(small_design):
    checks, report = small_design.report["checks"], small_design.report
    assert len(checks) > 20 and {check["id"] for check in checks} <= ids("checks")
    assert report["remarks"] and set(report["remarks"]) <= ids("remarks")
    assert len(report["remarks"]) == len(report["given_up"])


# ---- the pages -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
class TestPages:
    def test_labels_are_short_and_of_one_section_each(self, page):
        labels = re.findall(r"^\((.+)\)=$", _page(page), re.M)
        assert len(labels) == len(set(labels)) > 20
        assert {f"{page}#{label}" for label in labels} <= sections().keys()  # none is overlooked
        kind = page.removesuffix("s")
        assert [label for label in labels if not re.fullmatch(rf"{kind}(-[a-z]+){{1,4}}", label)] == []

    def test_each_section_has_its_paragraphs(self, page):
        for id in ids(page):
            heading, named, *paragraphs = sections()[f"{page}#{page[:-1]}-{id}"].split("\n\n")
            assert heading.startswith("### ") and "\n" not in heading.strip().partition("\n")[0], id
            assert named.startswith(f"Id: `{id}`. {'Names' if page == 'checks' else 'Sentences'}:"), id
            assert tuple(p.partition(":")[0] for p in paragraphs) == PARAGRAPHS[page], id
            assert all(paragraph.endswith(".") for paragraph in paragraphs), id

    def test_links_lead_to_sections(self, page):
        links = re.findall(r"\]\((\w+)\.md#([\w-]+)\)", _page(page))
        assert links and [link for link in links if "#".join(link) not in sections()] == []


def test_keys_of_the_scene_are_known():
    known = {row.key.replace("[]", "") for row in rows()} | {"mount.flange", "lens.front", "lens.outline"}
    tables = {key.partition(".")[0] for key in known}
    quoted = re.findall(r"`(\w+(?:\.\w+)+)(?: = [^`]*)?`", "".join(map(_page, PAGES)))
    files = ("step", "npz", "toml", "json", "html", "txt", "pdf", "csv", "stl", "xml", "3mf")
    keys = [key for key in quoted if key.partition(".")[0] in tables and not key.endswith(files)]
    assert len(keys) > 50 and [key for key in keys if key not in known] == []
