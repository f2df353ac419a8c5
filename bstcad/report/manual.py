"""Documentation as Markdown for a terminal, for an installation without built pages.

The name of a page is its path without ".md", such as "tutorials/first-lens".  Directives of Sphinx are removed.

checks.md and remarks.md beside this file have a section for each check and remark: a label "(check-rrmsd)=" with the
id, a heading "###", a paragraph with the id and the texts in a report ("…" stands for any text), and explanations.
"""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path
from posixpath import dirname, join, normpath

PLACES = (Path(__file__).parents[1] / "manual", Path(__file__).parents[2] / "docs")  # pages in a wheel, in the sources
SITES = (Path(__file__).parents[1] / "site", Path(__file__).parents[2] / "docs/_build/html")  # built pages, likewise
FIRST = "index"  # name of the first page
PAGES = ("checks", "remarks")  # pages beside this file, without ".md", whose sections `bstcad docs` also shows singly
SECTION = re.compile(r"^\(([\w-]+)\)=\n+(### .+?)(?=\n+^(?:\([\w-]+\)=$|#{1,2} )|\s*\Z)", re.M | re.S)
TO_A_SECTION = re.compile(r"\[([^]]+)\]\((?:\w+\.md)?#([\w-]+)\)")
INCLUDED = re.compile(r"^```\{include\} (\S+)$.*?^```$\n?", re.M | re.S)
NOT_MADE = "(`make docs` writes the table that belongs here.)\n"
DIRECTIVE = re.compile(r"^```\{.*?^```$\n?", re.M | re.S)
CARD = re.compile(r"^:::\{grid-item-card\} ([^\n]+)\n:link: (\S+)\n:link-type: doc\n(.*?)^:::$\n?", re.M | re.S)
NOT_SHOWN = re.compile(r"^(?::{3,}.*|:[\w-]+: .*|\([\w-]+\)=)\n", re.M)
LINK = re.compile(r"(?<!!)\[([^]]+)\]\((?!https?:)([^)#\s]*?)(?:\.md)?(?:#[\w-]+)?\)")


def site() -> Path | None:
    """Return the folder of the built pages; None: they are not built."""
    return next((place for place in SITES if (place / f"{FIRST}.html").is_file()), None)


@cache
def pages() -> dict[str, Path]:
    """Return the files of all pages by their names; the pages of checks and remarks always exist."""
    place = next((place for place in PLACES if (place / f"{FIRST}.md").is_file()), PLACES[-1])
    paths = [path for path in sorted(place.rglob("*.md")) if "_build" not in path.parts]
    found = {path.relative_to(place).with_suffix("").as_posix(): path for path in paths if _title(path)}
    return found | {f"reference/{page}": Path(__file__).with_name(f"{page}.md") for page in PAGES}


def names() -> frozenset[str]:
    """Return the names of all pages: an installed wheel has the built pages alone."""
    built = site()
    files = [] if built is None else [path.relative_to(built) for path in built.rglob("*.html")]
    return frozenset(pages()) | {path.with_suffix("").as_posix() for path in files if path.as_posix()[0] != "_"}


def name_of(topic: str) -> str | None:
    """Return the full name of the page whose name is `topic` or ends in /`topic`; None: no such page, or several."""
    name, known = topic.removesuffix(".md"), names()
    ending = [each for each in known if each.endswith(f"/{name}")]
    return name if name in known else ending[0] if len(ending) == 1 else None


def page(name: str) -> str:
    """Return the Markdown of a page, in which links to other pages are names for `bstcad docs`."""

    def linked(found: re.Match[str]) -> str:
        other = normpath(join(dirname(name), found[2])) if found[2] else ""
        return f"{found[1]} (`bstcad docs {other}`)" if other in pages() else found[1]

    def included(found: re.Match[str]) -> str:
        path = pages()[name].parent / found[1]
        return path.read_text(encoding="utf-8") if path.is_file() else NOT_MADE

    text = INCLUDED.sub(included, pages()[name].read_text(encoding="utf-8"))
    text = NOT_SHOWN.sub("", CARD.sub(_card, DIRECTIVE.sub("", text)))
    return re.sub(r"\n{3,}", "\n\n", LINK.sub(linked, text)).strip() + "\n"


def first() -> str:
    """Return the first page, and a list of all others."""
    others = "\n".join(f"- `bstcad docs {name}`: {_title(path)}" for name, path in pages().items() if name != FIRST)
    return "\n".join(([page(FIRST)] if FIRST in pages() else ["# bstcad\n"]) + ["## All pages\n", others, ""])


@cache
def sections() -> dict[str, str]:
    """Return all sections (Markdown from the heading on) by page and label, such as "checks#check-rrmsd", in order."""
    texts = {page: pages()[f"reference/{page}"].read_text(encoding="utf-8") for page in PAGES}
    return {f"{page}#{label}": text for page, whole in texts.items() for label, text in SECTION.findall(whole)}


def section(name: str) -> str:
    """Return a section, in which links such as "[check](checks.md#check-rrmsd)" are names for `bstcad docs`."""
    return TO_A_SECTION.sub(r"\1 (bstcad docs \2)", sections()[name])


def show(text: str) -> None:
    """Show Markdown: rendered in a pager on a terminal, otherwise as plain text."""
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    if not console.is_terminal:
        print(text, end="")
        return
    os.environ.setdefault("LESS", "-R")  # with this option `less` shows bold and colour
    with console.pager(styles=True):
        console.print(Markdown(text))


def _card(found: re.Match[str]) -> str:
    return f"- **{found[1]}** (`bstcad docs {found[2]}`): {found[3]}"


def _title(path: Path) -> str:
    return next((line[2:] for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ")), "")
