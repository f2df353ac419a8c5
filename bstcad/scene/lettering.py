"""Lettering: a text as light, white bold letters on black."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bstcad.scene.errors import SceneError
from bstcad.scene.framing import Frame, Window, average


def letters(text: str, frame: Frame) -> np.ndarray:
    """(rows, columns) share of ink, centred, 84 % of the frame's width or 80 % of its height."""
    frame, turn = frame.lying() if frame.turn.lays_down else frame, frame.turn
    aspect = frame.width / frame.height
    side = min(4 * max(frame.columns, frame.rows), 4096)  # drawn finer, then averaged: smooth rims
    width = max(round(side * min(aspect, 1.0)), 16)
    height = max(round(side * min(1 / aspect, 1.0)), 16)
    at_100 = _ink(text, 100.0)
    scale = min(0.84 * width / at_100.width, 0.80 * height / at_100.height)
    ink = _ink(text, max(100.0 * scale, 1.0))
    image = Image.new("L", (width, height))
    image.paste(ink, ((width - ink.width) // 2, (height - ink.height) // 2))
    whole = Window(0.0, 0.0, width, height)
    return turn.of(average(lambda box: np.asarray(image.crop(box)) / 255.0, image.size, whole, frame))


def _ink(text: str, size: float) -> Image.Image:
    """The letters alone, cut where their ink ends (a font's own box has empty margins)."""
    font = _font(size, text)
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), text, font=font, align="center")
    image = Image.new("L", (int(right - left) + 8, int(bottom - top) + 8))
    ImageDraw.Draw(image).text((4 - left, 4 - top), text, fill=255, font=font, align="center")
    if image.getbbox() is None:
        raise SceneError("target.text: its letters leave no ink; give others")
    return image.crop(image.getbbox())


def _font(size: float, text: str) -> ImageFont.FreeTypeFont:
    """DejaVu Sans Bold, found among matplotlib's files without importing matplotlib."""
    [package] = importlib.util.find_spec("matplotlib").submodule_search_locations
    font = ImageFont.truetype(str(Path(package, "mpl-data", "fonts", "ttf", "DejaVuSans-Bold.ttf")), size)
    absent = bytes(font.getmask("\uffff"))  # the box that stands for letters a font does not have
    for letter in sorted(set(text) - {"\n"}):
        if not letter.splitlines()[0] or bytes(font.getmask(letter)) == absent:  # a break of lines, other than ours
            raise SceneError(f"target.text: the font has no letter {letter!r}; give the text as an image instead")
    return font
