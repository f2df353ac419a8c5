"""What drawings and STEP files say of a part besides its shape: the [part] table, each key of which is optional."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

from bstcad.optics.outlines import STRICT

if TYPE_CHECKING:  # the second process, which is handed this record, need not load the reader of scenes
    from bstcad.scene.wanted import LensBlank

GLASS, METAL = "#9ed3f580", "#c8ccd0"  # colours of a lens and of a mirror
LONGEST = 200  # characters of a text
DATE = re.compile(r"\d{4}-\d{2}-\d{2}")
COLOUR = re.compile(r"#(?:[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")


@dataclass(frozen=True)
class Part:
    """A part as a drawing's title block tells it; None: the file does not say."""

    number: str | None = None  # of the part; None: the scene's name
    author: str | None = None
    organisation: str | None = None
    material: str | None = None  # in words; None: lens.material
    density: float | None = None  # g/cm³; None: as known of lens.material
    colour: str | None = None  # "#rrggbb", or "#rrggbbaa" with how opaque it is; None: pale blue, of a mirror grey
    surface_profile: float | None = None  # tolerance zone of the back's profile, its full width (mm)
    front_profile: float | None = None  # the same of the front
    roughness: float | None = None  # Ra of the optical faces, at most (nm)
    coating: str | None = None  # of the optical faces, in words
    thickness_tolerance: float | None = None  # ± of the centre thickness (mm)
    date: str | None = None  # of the drawing, ISO 8601
    schema: Literal["AP242", "AP214"] = "AP242"  # of the STEP file; AP214 for older programs

    __pydantic_config__ = STRICT

    def of(self, lens: LensBlank) -> Part:
        """The same with what the lens itself says: its material, that one's density, a colour."""
        known: dict[str, str | float | None] = {"colour": METAL if lens.back.reflect else GLASS}
        if lens.material is not None and self.material is None:
            from bstcad.optics.media import medium

            its = medium(lens.material)
            known |= {"material": its.name, "density": its.density}
        return replace(self, **{name: value for name, value in known.items() if getattr(self, name) is None})


def complaints(part: Part, lens: LensBlank) -> Iterator[str]:
    """What is wrong with the table."""
    for field in fields(part):
        text = getattr(part, field.name)
        if isinstance(text, str) and not (text.strip() and text.isprintable() and len(text) <= LONGEST):
            yield f"part.{field.name}: must be one line of 1 to {LONGEST} characters that can be printed; change it"
    if part.colour is not None and not COLOUR.fullmatch(part.colour):
        yield f'part.colour: {part.colour!r} is no colour; write it as "#9ed3f5", or "#9ed3f580" to see through'
    if part.density is not None and part.material is None and lens.material is None:
        yield "part.density: is of no material; add part.material, in words"
    for key in ("surface_profile", "front_profile"):
        if getattr(part, key) is not None and part.schema == "AP214":
            yield f'part.{key}: is not written in AP214; remove it, or the line schema = "AP214"'
    thickness = lens.back.z - lens.front.z
    if part.thickness_tolerance is not None and not part.thickness_tolerance < thickness:
        yield (
            f"part.thickness_tolerance: {part.thickness_tolerance:g} mm, and the lens is {thickness:g} mm thick before "
            "it is tailored; give less"
        )
    if part.date is not None and not _is_date(part.date):
        yield f'part.date: {part.date!r} is no date of ISO 8601; write it as "2031-05-06"'


def _is_date(text: str) -> bool:
    try:
        return bool(DATE.fullmatch(text) and datetime.date.fromisoformat(text))
    except ValueError:
        return False
