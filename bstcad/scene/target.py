"""The target: the picture wanted, where it lies, and how it is seen."""

from __future__ import annotations

import functools
import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    Discriminator,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from bstcad.optics.irradiance import Screen
from bstcad.optics.key import Key
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.scene import framing, picture
from bstcad.scene.errors import SceneError
from bstcad.scene.fields import COORDINATES, Outlined, Record, from_file
from bstcad.scene.framing import Frame, Turn
from bstcad.scene.picture import Drawing, letters
from bstcad.scene.tones import Tones

FEWEST = 8  # pixels along a side, unless asked for fewer (which the range of `pixels` refuses)
NARROWEST = 1e-3  # mm; a target's side, as an outline's
PICTURES = ("text", "image", "sample", "uniform")  # a target has exactly one


# Told apart by what is written, so that a sentence speaks of the one that was meant.
Pixels = Annotated[
    Annotated[int, Tag("number")] | Annotated[tuple[int, int], Tag("pair")],
    Discriminator(lambda given: "pair" if isinstance(given, list | tuple) else "number"),
]
PictureFile = Annotated[
    from_file(picture.Picture, picture.read_picture, lambda found: found.name, "image = 'photo.png'"),
    BeforeValidator(lambda given: picture.from_array(given) if isinstance(given, np.ndarray) else given),
]


class Target(Record):
    """The picture wanted on the plane z, or on one that is turned about its middle, over the rectangle x by y."""

    z: Annotated[float, Key("Plane of the target, or its middle if tilted.", "mm", *COORDINATES, example=1000.0)]
    x: Annotated[tuple[float, float], Key("Ends of the target along x.", "mm", *COORDINATES, example=[-200.0, 200.0])]
    y: Annotated[tuple[float, float], Key("Ends of the target along y.", "mm", *COORDINATES, example=[-200.0, 200.0])]
    tilt: Annotated[
        tuple[float, float] | None,
        Key("Tilt about x, then about y.", "degrees", -89.0, 89.0),
    ] = None
    pixels: Annotated[Pixels, Key("Pixels along the longer side, or [columns, rows].", "", FEWEST, 4096, example=512)]
    text: Annotated[str | None, Key("The picture as letters.")] = None
    image: Annotated[PictureFile | None, Key("The picture as a file, relative to the scene file.")] = None
    sample: Annotated[Literal[picture.SAMPLES] | None, Key("The picture as one of scikit-image's.")] = None
    uniform: Annotated[Literal[True] | None, Key("No picture: the same irradiance everywhere.")] = None
    gamma: Annotated[float | None, Key("Irradiance = number ^ gamma; the file's own if absent.", "", 0.1, 10.0)] = None
    invert: Annotated[bool, Key("Dark for light.")] = False
    seen_from: Annotated[Literal["lens", "behind"], Key("Side from which the picture is unmirrored.")] = "lens"
    rotate: Annotated[Literal[0, 90, 180, 270], Key("Turn counterclockwise.", "degrees")] = 0
    mirror: Annotated[bool, Key("Left for right, after the turn.")] = False
    fit: Annotated[Literal["crop", "pad", "stretch"], Key("Fit of a picture of other proportions.")] = "crop"
    outline: Annotated[Outlined | None, Key("Light falls only inside this outline, which is centred.")] = None

    @model_validator(mode="after")
    def _one_picture(self) -> Self:
        given = [name for name in PICTURES if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"needs exactly one of {', '.join(PICTURES)}, but has {found}; keep or add one")
        return self

    @field_validator("x", "y")
    @classmethod
    def _interval(cls, ends: tuple[float, float]) -> tuple[float, float]:
        if not ends[0] < ends[1]:
            raise ValueError(f"[{ends[0]:g}, {ends[1]:g}] is no interval; write the smaller end first")
        if ends[1] - ends[0] < NARROWEST:
            raise ValueError(f"is narrower than {NARROWEST:g} mm; move its ends apart")
        return ends

    @field_validator("tilt")
    @classmethod
    def _level(cls, tilt: tuple[float, float] | None) -> tuple[float, float] | None:
        return tilt if tilt and any(tilt) else None

    @field_validator("text")
    @classmethod
    def _some_letters(cls, text: str | None) -> str | None:
        if text is not None and not (text.strip() and len(text) <= 100):
            raise ValueError('must have 1 to 100 letters; give for example text = "THU"')
        return text

    @field_validator("gamma")
    @classmethod
    def _gamma_of_a_picture(cls, gamma: float | None, info: ValidationInfo) -> float | None:
        if gamma is not None and (info.data.get("text") is not None or info.data.get("uniform") is not None):
            raise ValueError("only an image or a sample has a gamma; remove it")
        return gamma

    @field_validator("invert")
    @classmethod
    def _inverts_a_picture(cls, invert: bool, info: ValidationInfo) -> bool:
        if invert and info.data.get("uniform") is not None:
            raise ValueError("a uniform target inverted is dark; remove one of the two")
        return invert

    @field_validator("outline")
    @classmethod
    def _fits(cls, outline: Rectangle | Circle | None, info: ValidationInfo) -> Rectangle | Circle | None:
        for axis, half in zip("xy", outline.half_extent if outline else (), strict=False):
            low, high = info.data.get(axis, (-math.inf, math.inf))
            if 2 * half > high - low:
                raise ValueError(f"is larger than the target along {axis}; make it smaller or widen {axis}")
        return outline

    @property
    def size(self) -> tuple[float, float]:
        """Width and height (mm)."""
        return self.x[1] - self.x[0], self.y[1] - self.y[0]

    @property
    def columns_rows(self) -> tuple[int, int]:
        """Pixels along x and along y; FEWEST at least, however narrow the target."""
        if not isinstance(self.pixels, int):
            return self.pixels
        longer = max(self.size)
        return tuple(max(round(self.pixels * side / longer), min(self.pixels, FEWEST)) for side in self.size)

    @property
    def screen(self) -> Screen:
        """The pixels that light falls into."""
        return Screen(self.z, self.x, self.y, self.columns_rows, tilt=self.tilt)

    def irradiance(self) -> np.ndarray:
        """Flux wanted in each pixel, (rows, columns) float64 of sum 1; row 0 = y max, column 0 = x min.

        From the lens, along +z with y up, x grows to the left: there the picture's left column is that of x max.
        """
        seen = _drawn(self).light
        flux = seen[:, ::-1] if self.seen_from == "lens" else seen
        if self.outline is not None:
            flux = flux * framing.inside(self.outline, *self.columns_rows, *self.size)
        total = flux.sum()
        if not total > 0:
            [kind] = (name for name in PICTURES if getattr(self, name) is not None)
            raise SceneError(f"target.{kind}: the picture is all black; give one with some light in it")
        return flux / total

    def remarks(self) -> tuple[str, ...]:
        """What happens to the picture that was perhaps not meant, a sentence each."""
        return _drawn(self).remarks


@functools.lru_cache(maxsize=1)  # a photograph takes seconds, and is asked for when it is read and when it is used
def _drawn(target: Target) -> Drawing:
    """The target's picture as a person sees it who stands where target.seen_from says."""
    turn = Turn(target.mirror, (-target.rotate if target.mirror else target.rotate) // 90 % 4)
    frame = Frame(*target.columns_rows, *target.size, target.fit, turn)
    if target.text is not None:
        ink = letters(target.text, frame)
        return Drawing(1.0 - ink if target.invert else ink)
    tones = Tones(target.gamma, target.invert)
    if target.image is not None:
        return picture.photograph(target.image, frame, tones)
    if target.sample is not None:
        return picture.sample(target.sample, frame, tones)
    return Drawing(np.ones((frame.rows, frame.columns)))
