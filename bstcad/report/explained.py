"""Which section of checks.md or remarks.md explains a check by its name, or a remark by its sentence.

A section of these pages is a label "(check-rrmsd)=", a heading "###", a line "Names:" or "Sentences:" of patterns in
backticks, in which "…" stands for any text, and paragraphs.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

PAGES = ("checks", "remarks")  # files beside this one, without ".md"
ANY = "…"
SECTION = re.compile(r"^\(([\w-]+)\)=\n+(### .+?)(?=\n+^(?:\([\w-]+\)=$|#{1,2} )|\s*\Z)", re.M | re.S)
LINK = re.compile(r"\[([^]]+)\]\((?:\w+\.md)?#([\w-]+)\)")
PATTERNS = re.compile(r"^(?:Names|Sentences): (.+?)(?:\n\n|\Z)", re.M | re.S)


class Section(NamedTuple):
    """The explanation of a check or a remark, or of several that differ by a name only."""

    text: str  # markdown, from its heading on
    patterns: tuple[str, ...]


@cache
def sections() -> dict[str, Section]:
    """All sections by page and label, such as "checks#check-rrmsd", in the order of the pages."""
    return {f"{page}#{label}": found for page in PAGES for label, found in parsed(_page(page))}


def parsed(page: str) -> list[tuple[str, Section]]:
    """(label, section) of each section of a page."""
    return [(label, Section(text, _patterns(text))) for label, text in SECTION.findall(page)]


def page_of(text: str) -> str | None:
    """The section for the name of a check or the sentence of a remark, such as "checks#check-rrmsd"; None: none.

    Of several patterns that fit the one with the longest literal text counts.
    """
    fitting = ((weight, page) for pattern, weight, page in _compiled() if pattern.fullmatch(text))
    return max(fitting, default=(0, None), key=lambda found: found[0])[1]


def topic(text: str) -> str:
    """The name by which `bstcad docs` explains a check or a remark, such as "check-rrmsd"; "": there is none."""
    return (page_of(text) or "").partition("#")[2]


def section(page: str) -> str:
    """The markdown of a section by its page and label, from its heading on; KeyError if there is none."""
    return sections()[page].text


def read_in_a_terminal(page: str) -> str:
    """A section whose links to other sections are names for `bstcad docs`: "[check](checks.md#check-rrmsd)"."""
    return LINK.sub(r"\1 (bstcad docs \2)", section(page))


def _page(name: str) -> str:
    return Path(__file__).with_name(f"{name}.md").read_text(encoding="utf-8")


def _patterns(text: str) -> tuple[str, ...]:
    found = PATTERNS.search(text)
    return tuple(re.findall("`([^`]+)`", " ".join(found[1].split()))) if found else ()


@cache
def _compiled() -> tuple[tuple[re.Pattern[str], int, str], ...]:
    """(pattern, length of its literal text, page and label) of all sections."""
    return tuple(
        (re.compile(".*".join(map(re.escape, pattern.split(ANY))), re.S), len(pattern.replace(ANY, "")), page)
        for page, found in sections().items()
        for pattern in found.patterns
    )
