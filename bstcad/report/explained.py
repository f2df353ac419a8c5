"""The sections of checks.md and remarks.md, by the ids of checks and remarks.

A section of these pages is a label "(check-rrmsd)=" of the id, a heading "###", a line of the sentences as they stand
in a report, in which "…" stands for any text, and paragraphs.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

PAGES = ("checks", "remarks")  # files beside this one, without ".md"
SECTION = re.compile(r"^\(([\w-]+)\)=\n+(### .+?)(?=\n+^(?:\([\w-]+\)=$|#{1,2} )|\s*\Z)", re.M | re.S)
LINK = re.compile(r"\[([^]]+)\]\((?:\w+\.md)?#([\w-]+)\)")


@cache
def sections() -> dict[str, str]:
    """All sections, markdown from the heading on, by page and label: "checks#check-rrmsd"; in the pages' order."""
    return {f"{page}#{label}": text for page in PAGES for label, text in SECTION.findall(_page(page))}


def read_in_a_terminal(page: str) -> str:
    """A section whose links to other sections are names for `bstcad docs`: "[check](checks.md#check-rrmsd)"."""
    return LINK.sub(r"\1 (bstcad docs \2)", sections()[page])


def _page(name: str) -> str:
    return Path(__file__).with_name(f"{name}.md").read_text(encoding="utf-8")
