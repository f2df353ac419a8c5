"""The section of report.html on tolerances, where `bstcad tolerance` was run: written with the page, or put into it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bstcad import files
from bstcad.report import previous_report, tolerance_words
from bstcad.report.templates import house
from bstcad.report.tolerance_figures import FIGURES

BEGIN, END = "<!-- tolerances -->", "<!-- end of tolerances -->"  # in report.html, about the section
LARGEST = 30_000_000  # bytes of a page
LARGEST_PICTURE = 1_000_000  # bytes
PNG = b"\x89PNG\r\n\x1a\n"


def section(facts: Mapping[str, Any], pictures: Mapping[str, bytes], optic: str) -> str:
    """HTML of what tolerance.json says; pictures: PNG bytes by the keys of FIGURES."""
    encoded = {key: base64.b64encode(picture).decode() for key, picture in pictures.items() if key in FIGURES}
    template = house().get_template("tolerances.html.j2")
    return template.render(facts=facts, words=tolerance_words, pictures=encoded, alt=FIGURES, optic=optic)


def of_folder(folder: Path, optic: str) -> str:
    """The same of a design's folder; nothing where there is no tolerance.json, or none of ours."""
    facts = previous_report.tolerances(folder / "tolerance.json")
    if facts is None:
        return ""
    pictures = {}
    for key in FIGURES:
        try:
            picture = files.contents(folder / "figures" / f"{key}.png", LARGEST_PICTURE)
        except (OSError, ValueError):
            continue
        if picture.startswith(PNG):
            pictures[key] = picture
    return section(facts, pictures, optic)


def put_into(page: Path, section: str) -> bytes | None:
    """The page with this section instead of an earlier one; None for a page that has no place for it."""
    try:
        text = files.contents(page, LARGEST).decode("utf-8")
    except (OSError, ValueError):
        return None
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{section}{end}{after}".encode() if begin and end else None
