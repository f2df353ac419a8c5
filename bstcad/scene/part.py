"""What lens.step says of the lens besides its shape: the [part] table, optional as a whole and each key of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

from bstcad.optics.outlines import STRICT

if TYPE_CHECKING:  # the second process, which is handed this record, need not load the reader of scenes
    from bstcad.scene.wanted import LensBlank

GLASS, METAL = "#9ed3f580", "#c8ccd0"  # colours of a lens and of a mirror
LONGEST = 200  # characters of a text
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
    if part.surface_profile is not None and part.schema == "AP214":
        yield 'part.surface_profile: is not written in AP214; remove it, or the line schema = "AP214"'
