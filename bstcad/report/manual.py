"""The documentation as Markdown for a terminal, where bstcad came without built pages.

A page is called by its path without ".md", such as "tutorials/first-lens"; what Sphinx alone understands is left out.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from posixpath import dirname, join, normpath

from bstcad.report import explained

PLACES = (Path(__file__).parents[1] / "manual", Path(__file__).parents[2] / "docs")  # in a wheel, in sources
FIRST = "index"  # name of the first page
DIRECTIVE = re.compile(r"^```\{.*?^```$\n?", re.M | re.S)
CARD = re.compile(r"^:::\{grid-item-card\} ([^\n]+)\n:link: (\S+)\n:link-type: doc\n(.*?)^:::$\n?", re.M | re.S)
LEFT_OUT = re.compile(r"^(?::{3,}.*|:[\w-]+: .*|\([\w-]+\)=)\n", re.M)
LINK = re.compile(r"(?<!!)\[([^]]+)\]\((?!https?:)([^)#\s]*?)(?:\.md)?(?:#[\w-]+)?\)")


@cache
def pages() -> dict[str, Path]:
    """The files of all pages by their names; the pages of checks and remarks are always there."""
    place = next((place for place in PLACES if (place / f"{FIRST}.md").is_file()), None)
    paths = [] if place is None else [path for path in sorted(place.rglob("*.md")) if "_build" not in path.parts]
    found = {path.relative_to(place).with_suffix("").as_posix(): path for path in paths if _title(path)}
    return found | {f"reference/{page}": Path(explained.__file__).with_name(f"{page}.md") for page in explained.PAGES}


def name_of(topic: str) -> str | None:
    """The name of a page by its name or by the last part of it; None if there is none, or several."""
    name = topic.removesuffix(".md")
    ending = [each for each in pages() if each.endswith(f"/{name}")]
    return name if name in pages() else ending[0] if len(ending) == 1 else None


def page(name: str) -> str:
    """The Markdown of a page; links to other pages are names for `bstcad docs`."""

    def linked(found: re.Match[str]) -> str:
        other = normpath(join(dirname(name), found[2])) if found[2] else ""
        return f"{found[1]} (`bstcad docs {other}`)" if other in pages() else found[1]

    text = pages()[name].read_text(encoding="utf-8")
    text = LEFT_OUT.sub("", CARD.sub(_card, DIRECTIVE.sub("", text)))
    return re.sub(r"\n{3,}", "\n\n", LINK.sub(linked, text)).strip() + "\n"


def first() -> str:
    """The first page, and a list of all others."""
    others = "\n".join(f"- `bstcad docs {name}`: {_title(path)}" for name, path in pages().items() if name != FIRST)
    return "\n".join(([page(FIRST)] if FIRST in pages() else ["# bstcad\n"]) + ["## All pages\n", others, ""])


def _card(found: re.Match[str]) -> str:
    return f"- **{found[1]}** (`bstcad docs {found[2]}`): {found[3]}"


def _title(path: Path) -> str:
    return next((line[2:] for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ")), "")
