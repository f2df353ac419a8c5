"""Pages of docs/*.md from their templates, tables, and the places on a page where a program writes them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

END = "<!-- end -->"


def row(cells: Iterable[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def table(head: Sequence[str], rows: Iterable[Iterable[object]], words: Collection[str] = ()) -> str:
    """A table of numbers: the first column and those of `words` are aligned to the left."""
    rule = ["---" if name in words or not k else "--:" for k, name in enumerate(head)]
    return "\n".join(map(row, [head, rule, *rows]))


def write(page: Path, begin: str, content: str) -> None:
    """Replace all between a marker of the page and the next END; ValueError if there is no such place."""
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, ended, after = rest.partition(END)
    if not (found and ended):
        raise ValueError(f"{page} has no '{begin}' … '{END}'")
    page.write_text(f"{before}{found}\n\n{content}\n\n{END}{after}", encoding="utf-8")


def page(template: Path, recorded: Mapping[str, Any], **more: Any) -> str:
    """Fill a template with records.  Callables of `more` are filters, too; `number` formats what is known, else –."""
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    environment.filters["number"] = lambda value, form: format(value, form) if isinstance(value, int | float) else "–"
    environment.filters.update({name: value for name, value in more.items() if callable(value)})
    return environment.from_string(template.read_text(encoding="utf-8")).render(**recorded, **more)
