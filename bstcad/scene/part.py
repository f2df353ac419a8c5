"""What drawings and STEP files say of a part besides its shape: the [part] table, each key of which is optional."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Literal

from bstcad.optics.key import Key
from bstcad.optics.outlines import STRICT

if TYPE_CHECKING:  # the second process, which is handed this record, need not load the reader of scenes
    from bstcad.scene.blank import LensBlank

GLASS, METAL = "#9ed3f580", "#c8ccd0"  # colours of a lens and of a mirror
LONGEST = 200  # characters of a text
DATE = re.compile(r"\d{4}-\d{2}-\d{2}")
COLOUR = re.compile(r"#(?:[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")


@dataclass(frozen=True)
class Part:
    """A part as a drawing's title block tells it; None: the file does not say."""

    number: Annotated[str | None, Key("Number of the part; the scene's name if absent.")] = None
    author: Annotated[str | None, Key("Author of the file.")] = None
    organisation: Annotated[str | None, Key("Organisation of the author.")] = None
    material: Annotated[str | None, Key("Material in words; lens.material if absent.")] = None
    density: Annotated[float | None, Key("Density; that of lens.material if absent.", "g/cm³", 1e-3, 30.0)] = None
    colour: Annotated[str | None, Key('"#rrggbb", or "#rrggbbaa" with the opacity; pale blue or grey if absent.')] = (
        None
    )
    surface_profile: Annotated[float | None, Key("Full tolerance zone of the back's profile.", "mm", 1e-6, 10.0)] = None
    front_profile: Annotated[float | None, Key("Full tolerance zone of the front's profile.", "mm", 1e-6, 10.0)] = None
    roughness: Annotated[float | None, Key("Greatest Ra of the optical faces.", "nm", 0.01, 1e5)] = None
    coating: Annotated[str | None, Key("Coating of the optical faces in words.")] = None
    thickness_tolerance: Annotated[float | None, Key("Tolerance (+-) of the centre thickness.", "mm", 1e-6, 10.0)] = (
        None
    )
    date: Annotated[str | None, Key("Date of the drawing, ISO 8601.")] = None
    schema: Annotated[Literal["AP242", "AP214"], Key("Schema of lens.step; AP214 for older programs.")] = "AP242"

    __pydantic_config__ = STRICT

    def of(self, lens: LensBlank) -> Part:
        """The same with what the lens itself says: its material, that one's density, a colour."""
        known: dict[str, str | float | None] = {"colour": METAL if lens.back.reflect else GLASS}
        if lens.material is not None and self.material is None:
            from bstcad.optics.media import medium

            its = medium(lens.material)
            known |= {"material": its.name, "density": its.density}
        return replace(self, **{name: value for name, value in known.items() if getattr(self, name) is None})

    def complaints(self, lens: LensBlank) -> Iterator[str]:
        """Complaints about the table and about the lens that it is of."""
        for field in fields(self):
            text = getattr(self, field.name)
            if isinstance(text, str) and not (text.strip() and text.isprintable() and len(text) <= LONGEST):
                yield f"part.{field.name}: must be one line of 1 to {LONGEST} characters that can be printed; change it"
        if self.colour is not None and not COLOUR.fullmatch(self.colour):
            yield f'part.colour: {self.colour!r} is no colour; write it as "#9ed3f5", or "#9ed3f580" to see through'
        if self.density is not None and self.material is None and lens.material is None:
            yield "part.density: is of no material; add part.material, in words"
        for key in ("surface_profile", "front_profile"):
            if getattr(self, key) is not None and self.schema == "AP214":
                yield f'part.{key}: is not written in AP214; remove it, or the line schema = "AP214"'
        thickness = lens.back.z - lens.front.z
        if self.thickness_tolerance is not None and not self.thickness_tolerance < thickness:
            yield (
                f"part.thickness_tolerance: {self.thickness_tolerance:g} mm, and the lens is {thickness:g} mm thick "
                "before it is tailored; give less"
            )
        if self.date is not None and not _is_date(self.date):
            yield f'part.date: {self.date!r} is no date of ISO 8601; write it as "2031-05-06"'


def _is_date(text: str) -> bool:
    try:
        return bool(DATE.fullmatch(text) and datetime.date.fromisoformat(text))
    except ValueError:
        return False
