"""Each check that bstcad can make and each remark that it can write has a section that explains it."""

import ast
import functools
import re
from collections import defaultdict
from itertools import product
from pathlib import Path

import pytest
from jinja2 import nodes

from bstcad.report import explained
from bstcad.report.explained import PAGES, page_of, parsed, section, sections, topic
from bstcad.report.units import environment
from bstcad.scene.scene import load
from bstcad.scene.schema import rows
from tests.conftest import DISK
from tests.report.test_remarks import SENTENCES, said

PACKAGE = Path(explained.__file__).parents[1]
ROOMS = ("verify", "judges", "measured")
FILES = [path for room in ROOMS for path in sorted((PACKAGE / room).glob("*.py")) if path.name != "verdict.py"]
PARAGRAPHS = {
    "checks": ("**Measures**", "**Limit**", "**Why**", "**When it fails**"),
    "remarks": ("**Means**", "**Why**", "**What to do**"),
}

# ---- the names of checks, by the source ------------------------------------------------------------------------------

# Calls whose first argument is the name of a check; `judge` is one of the first two, from a table.
MAKERS = ("Check", "Check.at_most", "Check.at_least", "Check.true", "judge", "net_check", "_edges_moved")
STEP = ("STEP text", "part.step")
WORDS = {  # in a function, what a variable part of a name may stand for
    ("structure", "name"): STEP,
    ("measures", "name"): STEP,
    ("of_part", "name"): STEP,
    ("of_part", "quantity"): ("density", "profile tolerance", "profile tolerance of the front"),
    ("_absent", "name"): STEP,
    ("_absent", "', '.join(missing)"): ("centroid", "area, volume"),
    ("_aperture", "name"): ("front", "back"),
    ("_of_light", "meets"): ("enters the lens", "meets the mirror"),
    ("_of_light", "of"): ("", ", target[1]"),
    ("_of_ripple", "of"): ("", " of the front"),
    ("_picture", "goal.suffix"): ("", ", target[1]"),
    ("verify", "of"): ("", ", target[1]"),
    ("of_bounds", "of"): ("", " of the front"),
    ("compare", "name"): ("batoid", "mitsuba"),
    ("compare", "key"): ("target[1]",),
    ("judge", "goal.suffix"): ("", ", target[1]"),
}


@functools.cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def constants(path):
    """The values of a file's names, those that it imports from the package too."""
    found = dict(assigned(node for node in tree(path).body if isinstance(node, ast.Assign)))
    for node in tree(path).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bstcad."):
            other = PACKAGE.parent / f"{node.module.replace('.', '/')}.py"
            names = {alias.name for alias in node.names}
            if other.exists() and other.parent.name in ROOMS:
                found |= {name: value for name, value in constants(other).items() if name in names}
    return found


def assigned(body):
    """(name, values) by all statements of a body, and in them."""
    found = defaultdict(list)
    for node in (inner for statement in body for inner in ast.walk(statement)):
        if isinstance(node, ast.Assign):
            pair(node.targets[0], node.value, found)
        elif isinstance(node, ast.For) and isinstance(node.iter, ast.Tuple):
            for element in node.iter.elts:
                pair(node.target, element, found)
    return found.items()


def pair(target, value, found):
    if isinstance(target, ast.Name):
        found[target.id].append(value)
    elif isinstance(value, ast.IfExp):
        pair(target, value.body, found)
        pair(target, value.orelse, found)
    elif isinstance(value, ast.Tuple):
        for one, its in zip(target.elts, value.elts, strict=True):
            pair(one, its, found)


def texts(node, where, local, outer):
    """All texts that an expression in function `where` may be; a part that is not known is a KeyError."""
    if isinstance(node, ast.Constant):
        return [node.value]
    if isinstance(node, ast.IfExp):
        return texts(node.body, where, local, outer) + texts(node.orelse, where, local, outer)
    if isinstance(node, ast.JoinedStr):
        parts = [texts(getattr(part, "value", part), where, local, outer) if isinstance(part, ast.FormattedValue)
                 else [part.value] for part in node.values]  # fmt: skip
        return ["".join(chosen) for chosen in product(*parts)]
    name = ast.unparse(node)
    values = local.get(name) or outer.get(name)
    if not values:
        return list(WORDS[where, name])
    rest = {key: value for key, value in local.items() if key != name}  # `name = f"…{name}"` means the argument
    return [text for value in values for text in texts(value, where, rest, outer)]


def names(path):
    """The names of all checks that a file can make."""
    outer = constants(path)
    for function in tree(path).body:
        if not isinstance(function, ast.FunctionDef) or function.name == "_edges_moved":
            continue
        local = dict(assigned(function.body))
        for call in (node for node in ast.walk(function) if isinstance(node, ast.Call) and node.args):
            maker, first = ast.unparse(call.func), call.args[0]
            if maker not in MAKERS or isinstance(first, ast.Starred) or function.name == "net_check":
                continue
            yield from texts(first, function.name, local, outer)


@functools.cache
def all_names():
    return {name for path in FILES for name in names(path)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_each_check_of_the_source_has_a_section(path):
    assert [name for name in names(path) if not (page_of(name) or "").startswith("checks#")] == []


def test_each_section_is_of_a_check_that_there_is():
    assert len(all_names()) > 80
    pages = {page for page in sections() if page.startswith("checks#")}
    assert pages - {page_of(name) for name in all_names()} == set()
    exact = {name for page in pages for name in sections()[page].patterns if "…" not in name}
    assert exact - all_names() == set()


def test_a_check_without_a_section_has_none():
    assert page_of("colour of the lens") is None and page_of("") is None
    with pytest.raises(KeyError):
        texts(ast.parse("f'{colour} of the lens'", mode="eval").body, "of_part", {}, {})


def test_each_check_of_a_report_has_a_section(small_design):
    found = [check["name"] for check in small_design.report["checks"]]
    assert len(found) > 20
    assert [name for name in found if not (page_of(name) or "").startswith("checks#")] == []
    assert all((page_of(each) or "").startswith("remarks#") for each in small_design.report["given_up"])


# ---- the sentences of remarks ----------------------------------------------------------------------------------------

REMARKS = [
    ("The lens is 6.25 mm thick on the axis instead of 5 mm: the back was moved by 1.25 mm along +z, so that the "
     "thinnest place keeps 0.6 mm.", "back-moved"),
    ("The lens is 4.8 mm thick on the axis instead of 5 mm: tailoring moved the vertex of the back by −0.2 mm along z.",
     "vertex-moved"),
    ("The lens is 4.8 mm thick on the axis instead of 5 mm: tailoring moved the vertices of its faces by −0.2 mm along "
     "z.", "vertex-moved"),
    ("The mirror is 0.25 mm thin where 0.5 mm was asked.", "too-thin"),
    ("The accuracy of 0.02 that was asked is not reached: the RRMSD is 0.03.", "accuracy"),
    ("The RRMSD is 0.234 where 0.1 was asked.", "rrmsd"),
    ("The RRMSD of target[1] is 0.234 where 0.1 was asked.", "rrmsd"),
    ("The source is too large for the picture: the finest detail on the target is 46 mm wide (source.divergence = 0.53 "
     "degrees), and the picture with no finer detail has an RRMSD of 0.54 where 0.1 is allowed; with the target "
     "250 mm instead of 5\u202f000 mm from the lens it is 2.4 mm.", "source-too-large"),
    ("The time limit of 20.0 s was missed by 6.8 s: loading, stage 1 and writing run whole, and this machine took that "
     "long for them.", "time-limit"),
    ("32.1 % of the target, with 30.6 % of its light, cannot be lit: a face of index 1.494 turns light by less than 48 "
     "degrees, or reflects it. The lens is for the rest; against the whole picture its RRMSD is 0.682.", "unreachable"),
    ("2.0 % of the target, with 1.0 % of its light, cannot be lit: no slope up to 70 degrees sends light there. The "
     "mirror is for the rest; against the whole picture its RRMSD is 0.1.", "unreachable"),
    ("0.80 % of the lit part of the target is left dark, with less than 10 % of what was asked there; the largest "
     "patch lies at x = -152 to -144 mm, y = -40 to 120 mm.", "dark"),
    ("0.80 % of the lit part of target[1] is left dark, with less than 10 % of what was asked there; the largest "
     "patch lies at x = -152 to -144 mm, y = -40 to 120 mm.", "dark"),
    ("The mount cuts away 30.0 % of the light that the uncut lens would let through.", "mount-cut"),
    ("The mount cuts away 30.0 % of the light that the uncut mirror would reflect.", "mount-cut"),
    ("47.0 % of the light that the source sends out misses the lens.", "misses"),
    ("47.0 % of the light that the source sends out misses the mirror.", "misses"),
    ("4.0 % of the light that enters the lens is lost to total internal reflection.", "total-reflection"),
    ("20.0 % of the light that enters the lens leaves through the sides, before it meets the back.", "sides"),
    ("3.0 % of the light that leaves the lens falls outside the target.", "outside"),
    ("3.0 % of the light that leaves the lens falls outside target[1].", "outside"),
    ('Left out: Fresnel reflection would change the picture by an RRMSD of 0.031, more than the stated 0.03; '
     '[[effects]] kind = "fresnel" in the scene simulates it.', "left-out"),
    ("Left out: ghosts, light reflected twice inside the lens, roughly, since it may gather to a spot, would change "
     "the picture by an RRMSD of 0.11, more than the 0.1 that is allowed.", "left-out"),
    ("Left out: size of the source, a cone of 0.1 degrees, which the scene does not state, would change the picture by "
     "an RRMSD of 0.06, more than the stated 0.03; source.divergence in the scene simulates it, source.real_divergence "
     "states another size.", "source-size"),
    ("Some light meets the back 0.5° beyond the critical angle, and is reflected.", "beyond-critical-angle"),
    ("Some light meets the back only 1.25° short of total internal reflection: where the face is made steeper by as "
     "much, that light is lost.", "near-total-reflection"),
    ("The darkest parts are lifted: pixels that ask for less than 1 % of the mean irradiance get 20.0 % of it, and in "
     "all 10.0 % of the light on the target more than they ask for.", "lifted"),
    ("The darkest parts of target[1] are lifted: pixels that ask for less than 1 % of the mean irradiance get 20.0 % "
     "of it, and in all 10.0 % of the light on target[1] more than they ask for.", "lifted"),
    ("12.5 % of the light of the target would need a back steeper than 70°, up to 97°, which overhangs: a height over "
     "a plane carries no more, and that light is sent elsewhere.", "too-steep"),
    ("5.0 % of the light that the source sends out meets the underside beside the front.", "underside"),
    ("The back is as steep as 75°: hardly a tool reaches that.", "steep"),
    ("The front is as steep as 75°: hardly a tool reaches that.", "steep"),
    ("The facets of lens.stl and lens.3mf lie within 1.75 µm of the lens, not within 1 µm: that would take more "
     "triangles than a file should have; lens.step is exact.", "facets"),
    ("Tailoring ended when its time was up, before it had gained all it could.", "time-up"),
    ("Tailoring was stopped by hand, before it had gained all it could; --resume goes on with it.", "interrupted"),
    ("Steps left out because their gradient was not finite: 3.", "skipped-steps"),
    ("3.0 % of the measured points are outliers and were left out: dust, glints or slips of the instrument. Clean the "
     "part and measure it again to be sure.", "outliers"),
    ("No limit on the light was asked: the RRMSD is 0.25, with 51.0 % of the source's light on the target. Whether "
     "that is enough, the scene does not say: write limits into its table [accept], such as rrmsd = 0.1 and "
     "light_on_target = 0.8.", "no-limit"),
    ("No RRMSD was asked (accept.rrmsd): the verdict does not judge it.", "no-rrmsd-asked"),
    ("The RRMSD is not resolved: 0.0284 is less than five times its standard error, 0.02. The lens may be better than "
     "that figure, or worse, up to 0.0484 or so; fewer target.pixels are resolved more easily.", "not-resolved"),
]  # fmt: skip


@pytest.mark.parametrize(("sentence", "label"), REMARKS, ids=[label for _, label in REMARKS])
def test_each_remark_has_its_section(sentence, label):
    assert page_of(sentence) == f"remarks#remark-{label}"


def test_each_section_is_of_a_remark():
    pages = {page for page in sections() if page.startswith("remarks#")}
    assert pages == {f"remarks#remark-{label}" for _, label in REMARKS}


def test_the_remarks_of_a_report_have_sections():
    scene = load(DISK)
    found = [sentence for changes, asked, _ in SENTENCES for sentence in said(scene.changed(asked), changes)]
    assert len(found) > 20
    assert [sentence for sentence in found if not (page_of(sentence) or "").startswith("remarks#")] == []


@pytest.mark.parametrize(
    ("template", "macros"), [("remarks.txt.j2", ["remarks", "steep"]), ("verdict.txt.j2", ["doubts"])]
)
def test_no_words_of_the_templates_are_in_no_example(template, macros):
    """So a new remark needs an example above, and with it a section."""
    source, _, _ = environment().loader.get_source(environment(), template)
    every = " ".join(sentence for sentence, _ in REMARKS)
    written = [macro for macro in environment().parse(source).find_all(nodes.Macro) if macro.name in macros]
    parts = [" ".join(data.data.split()) for macro in written for data in macro.find_all(nodes.TemplateData)]
    assert len(written) == len(macros) and len(parts) > 5
    assert [part for part in parts if part not in every] == []


# ---- the pages -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
class TestPages:
    def test_labels_are_short_and_of_one_section_each(self, page):
        labels = [label for label, _ in parsed(explained._page(page))]
        assert len(labels) == len(set(labels)) > 20
        assert labels == re.findall(r"^\((.+)\)=$", explained._page(page), re.M)  # none is overlooked
        kind = page.removesuffix("s")
        assert [label for label in labels if not re.fullmatch(rf"{kind}(-[a-z]+){{1,4}}", label)] == []

    def test_each_pattern_leads_to_its_own_section(self, page):
        for label, found in parsed(explained._page(page)):
            assert found.patterns
            for pattern in found.patterns:
                assert page_of(pattern) == f"{page}#{label}", pattern
                assert page_of(pattern.replace("…", "12 mm")) == f"{page}#{label}", pattern

    def test_each_section_has_its_paragraphs(self, page):
        for label, found in parsed(explained._page(page)):
            heading, named, *paragraphs = found.text.split("\n\n")
            assert heading.startswith("### ") and "\n" not in heading.strip().partition("\n")[0], label
            assert named.startswith("Names: " if page == "checks" else "Sentences: "), label
            assert tuple(p.partition(":")[0] for p in paragraphs) == PARAGRAPHS[page], label
            assert all(paragraph.endswith(".") for paragraph in paragraphs), label

    def test_links_lead_to_sections(self, page):
        links = re.findall(r"\]\((\w+)\.md#([\w-]+)\)", explained._page(page))
        assert links and [link for link in links if "#".join(link) not in sections()] == []

    def test_lines_are_short(self, page):
        assert [line for line in explained._page(page).splitlines() if len(line) > 120] == []


def test_keys_of_the_scene_are_known():
    known = {row.key.replace("[]", "") for row in rows()} | {"mount.flange", "lens.front", "lens.outline"}
    tables = {key.partition(".")[0] for key in known}
    quoted = re.findall(r"`(\w+(?:\.\w+)+)(?: = [^`]*)?`", "".join(map(explained._page, PAGES)))
    files = ("step", "npz", "toml", "json", "html", "txt", "pdf", "csv", "stl")
    keys = [key for key in quoted if key.partition(".")[0] in tables and not key.endswith(files)]
    assert len(keys) > 50 and [key for key in keys if key not in known] == []


def test_a_topic_is_a_label():
    assert topic("smallest thickness") == "check-thickness" and topic("colour of the lens") == ""


def test_a_section_is_markdown_without_its_label():
    text = section("checks#check-rrmsd")
    assert text.startswith("### RRMSD\n\nNames: `RRMSD, box pixels") and "(check-" not in text and "\n## " not in text
    assert section("remarks#remark-skipped-steps").endswith(".")
    with pytest.raises(KeyError):
        section("checks#check-colour")
