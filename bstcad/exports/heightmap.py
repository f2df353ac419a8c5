"""Height map of a back: a grey picture whose grey is the height, for the software of routers and printers.

A pixel of the row r and the column c shows the face at the middle of its square, seen from the back:

    x = x_m + (c + 1/2) p - w / 2,   y = y_m + h / 2 - (r + 1/2) p,

p: mm per pixel, w and h: width and height of the picture (mm), x_m and y_m: its middle, the axis except for a tile.

The PNG has 16 bits, z = z_low + g · (z_high - z_low) / 65535 for the grey g.  The TIFF has heights z - z_low in mm as
32-bit floats.  Pixels outside the outline have the grey 0.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from bstcad.cad.tiling import Cell
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.surfaces import Surface, sag

WHITE = 65535  # largest grey of 16 bits
PIXELS_PER_POINT = 4  # pixels per control point along the longer side, by default
MAX_PIXELS = 2048  # largest number of pixels along the longer side, by default
DESCRIPTION, RESOLUTION_X, RESOLUTION_Y, UNIT = 270, 282, 283, 296  # tags of TIFF
CENTIMETRE = 3  # unit of the resolution in a TIFF


@dataclass(frozen=True)
class HeightMap:
    """Heights of a face at the middles of square pixels; the row 0 is that of the largest y."""

    z: np.ndarray  # (rows, columns) mm; NaN outside the outline
    pixel: float  # side of a pixel, mm
    name: str = "heightmap"  # name of the files, without suffix
    centre: tuple[float, float] = (0.0, 0.0)  # x and y of the middle of the picture, mm

    @classmethod
    def of(cls, face: Surface, outline: Outline, pixels: int, cell: Cell | None = None) -> HeightMap:
        """Return the heights inside an outline with `pixels` pixels along its longer side.

        cell: tile to which the picture is limited, with pixels of the same size; None: no limit.
        """
        (half_x, half_y), centre, name = outline.half_extent, (0.0, 0.0), "heightmap"
        p = 2 * max(half_x, half_y) / pixels
        if cell is not None:
            half_x, half_y = ((high - low) / 2 for low, high in cell.extent)
            centre, name = tuple(sum(span) / 2 for span in cell.extent), f"heightmap-{cell.name}"
        columns, rows = (max(round(2 * half / p), 1) for half in (half_x, half_y))
        x = centre[0] + (np.arange(columns) + 0.5 - columns / 2) * p
        y = centre[1] + (rows / 2 - np.arange(rows) - 0.5) * p
        x, y = (at.copy() for at in np.broadcast_arrays(x[None, :], y[:, None]))
        inside = outline.contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
        return cls(np.where(inside, sag(face, x, y), np.nan), p, name, centre)

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest z (mm)."""
        return float(np.nanmin(self.z)), float(np.nanmax(self.z))

    @property
    def per_grey(self) -> float:
        """Height per grey of the PNG, mm."""
        low, high = self.range
        return (high - low) / WHITE

    def png(self) -> bytes:
        """Return a PNG of 16-bit greys; its text states the scale, and pHYs the size of a pixel."""
        grey = np.round((self.z - self.range[0]) / (self.per_grey or 1.0))
        text = PngInfo()
        text.add_text("Description", self.words())
        dots = 25.4 / self.pixel
        picture = Image.fromarray(np.nan_to_num(grey).astype(np.uint16))
        return _saved(picture, "PNG", pnginfo=text, dpi=(dots, dots))

    def tiff(self) -> bytes:
        """Return a TIFF of 32-bit floats: the height (mm) above the lowest point."""
        tags = ImageFileDirectory_v2()
        tags[DESCRIPTION] = self.words()
        tags[RESOLUTION_X] = tags[RESOLUTION_Y] = 10 / self.pixel
        tags[UNIT] = CENTIMETRE
        heights = np.nan_to_num(self.z - self.range[0]).astype(np.float32)
        return _saved(Image.fromarray(heights), "TIFF", tiffinfo=tags, compression="tiff_adobe_deflate")

    def words(self) -> str:
        """Return the scale of the pictures in one sentence each."""
        rows, columns = self.z.shape
        low, high = self.range
        middle = f" Its middle is x = {self.centre[0]:.9g} mm, y = {self.centre[1]:.9g} mm." * any(self.centre)
        return (
            f"{self.name}: {columns} x {rows} pixels of {self.pixel:.9g} mm, {columns * self.pixel:.9g} mm x "
            f"{rows * self.pixel:.9g} mm, seen from the back with x to the right and y up.{middle} "
            f"{self.name}.png: grey 0 is z = {low:.9g} mm, grey {WHITE} is z = {high:.9g} mm, {self.per_grey:.9g} mm "
            f"per grey. {self.name}.tif: height in mm above the lowest point, as 32-bit floats. Both are 0 outside the "
            "outline."
        )


def default_pixels(points: int) -> int:
    """Return the pixels along the longer side for a net with this many control points along it."""
    return min(PIXELS_PER_POINT * points, MAX_PIXELS)


def _saved(picture: Image.Image, kind: str, **options: object) -> bytes:
    data = io.BytesIO()
    picture.save(data, format=kind, **options)
    return data.getvalue()
