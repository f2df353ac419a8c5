"""Pictures for lenses that throw two: the words of a published case, two photographs, and the published error.

T1 of Sun, Deng and Zhang 2026 (Optics Express; arXiv 2604.00831): a square lens of 100 mm, 20 mm thick, relative index
1.49, in parallel even light; "OPTICS EXPRESS" 20 mm behind its exit face and "LIGHT CONTROL" 100 mm behind it, letters
of pixel value 0.75 on 0.50 by 256 x 256 pixels as wide as the lens.  Their pictures are not published: these are the
same words in bstcad's own letters, with rims smooth in pixel values.  What their pixel values mean in light is not
said in what was read, so that there are two readings: number ** 2.2, and sRGB (IEC 61966-2-1).

Their error is the mean of |pixel value shown - pixel value wanted| over all pixels: 0.0063 and 0.0062 by their own
model, 0.0093 and 0.0098 by LuxCore.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from bstcad.cad import step_reading
from bstcad.optics.measure import tubes_picture
from bstcad.scene.picture import SAMPLES, from_srgb, to_srgb
from bstcad.scene.scene import Scene
from bstcad.scene.target import Target, drawing

SIDE, THICKNESS, INDEX = 100.0, 20.0, 1.49  # mm, mm, relative to air: of T1's lens
PLANES = (20.0, 100.0)  # mm behind its exit face
WORDS = ("OPTICS\nEXPRESS", "LIGHT\nCONTROL")  # on these planes
LETTERS, GROUND = 0.75, 0.50  # pixel values
PIXELS = 256
PUBLISHED = {"own model": (0.0063, 0.0062), "LuxCore": (0.0093, 0.0098)}  # their encoded errors on these planes

PHOTOGRAPHS = SAMPLES  # of the second case, on these planes, as wide as the lens
PHOTOGRAPH_PLANES = (100.0, 240.0)  # mm behind the exit face
PHOTOGRAPH_PIXELS = 512
TUBES = 3001  # a side, for the light of a written lens

SRGB = "srgb"
Decoding = float | str  # an exponent, or SRGB


@dataclass(frozen=True)
class Words:
    """A picture as it is encoded, and as light."""

    encoded: np.ndarray  # (256, 256) pixel values from 0 to 1, row 0 at the top
    linear: np.ndarray  # the same in irradiance, white 1


def decoded(values: np.ndarray, decoding: Decoding) -> np.ndarray:
    """Irradiance of pixel values: value ** exponent, or as sRGB has it; white is 1."""
    return from_srgb(values) if decoding == SRGB else np.asarray(values, dtype=float) ** decoding


def encoded(light: np.ndarray, decoding: Decoding) -> np.ndarray:
    """The inverse of `decoded`; it goes on above white, and what is less than black is black."""
    light = np.maximum(light, 0.0)
    return to_srgb(light) if decoding == SRGB else light ** (1 / decoding)


def pictures(gamma: Decoding) -> tuple[Words, Words]:
    """The words of T1 on its two planes; the share c of ink in a pixel has the value GROUND + c (LETTERS - GROUND)."""
    both = []
    for text in WORDS:
        ink = drawing(_target(0.0, PIXELS, text=text)).light
        values = GROUND + (LETTERS - GROUND) * ink
        both.append(Words(values, decoded(values, gamma)))
    return both[0], both[1]


def portraits(pixels: int = PHOTOGRAPH_PIXELS) -> tuple[np.ndarray, np.ndarray]:
    """The irradiance (pixels, pixels), of sum 1, of PHOTOGRAPHS on squares as wide as the lens.

    As in all scenes, a sample's numbers are irradiance.
    """
    first, second = (_target(z, pixels, sample=s) for z, s in zip(PHOTOGRAPH_PLANES, PHOTOGRAPHS, strict=True))
    return first.irradiance(), second.irradiance()


def _target(behind: float, pixels: int, **picture: str) -> Target:
    half = SIDE / 2
    return Target(z=THICKNESS + behind, x=(-half, half), y=(-half, half), pixels=pixels, **picture)


def encoded_error(irradiance: np.ndarray, wanted: np.ndarray, decoding: Decoding) -> float:
    """Mean of |encoded(s E) - wanted| over all pixels, s so that s E has the sum of decoded(wanted).

    irradiance E: (rows, columns), linear, on any scale.  wanted: pixel values (`Words.encoded`).
    """
    scale = decoded(wanted, decoding).sum() / irradiance.sum()
    return float(np.abs(encoded(scale * irradiance, decoding) - wanted).mean())


T1 = """\
name = "t1"
title = "The words of Sun, Deng and Zhang 2026 on two planes"

[source]
kind = "collimated"
wavelength = 633.0
aperture = {{ shape = "rectangle", width = {side}, height = {side} }}

[lens]
index = {index}
outline = {{ shape = "rectangle", width = {blank}, height = {blank} }}
front = {{ kind = "bspline", z = 0.0, optimise = true }}
back = {{ kind = "bspline", z = {thickness}, control_points = 513 }}

[accept]
rrmsd = 0.04
"""
PLANE = """
[[target]]
z = {z}
x = [{low}, {high}]
y = [{low}, {high}]
pixels = 256
image = "{image}"
gamma = 1.0
"""
MARGIN = 1.0  # mm on each side, of the blank around the light


def write_t1(folder: Path, decoding: Decoding) -> Path:
    """The scene file of T1 and its two pictures, as 16-bit numbers in proportion to irradiance, in a folder."""
    text = T1.format(side=SIDE, blank=SIDE + 2 * MARGIN, thickness=THICKNESS, index=INDEX)
    for number, (words, behind) in enumerate(zip(pictures(decoding), PLANES, strict=True)):
        image = f"words_{number}.png"
        Image.fromarray(np.round(65535 * words.linear / words.linear.max()).astype(np.uint16)).save(folder / image)
        text += PLANE.format(z=THICKNESS + behind, low=-SIDE / 2, high=SIDE / 2, image=image)
    path = folder / "t1.toml"
    path.write_text(text)
    return path


def errors_of_step(step: Path, scene: Scene, decoding: Decoding) -> list[float]:
    """The encoded error on each plane, of the light through the lens of a STEP file, by exact tubes."""
    lens = step_reading.lens(step_reading.read(step), scene.index)
    errors = []
    for target, words in zip(scene.targets, pictures(decoding), strict=True):
        light = np.asarray(tubes_picture(lens, scene.channels(), target.screen, TUBES))
        irradiance = target.irradiance()  # as the light has it, which is not as the picture is read
        wanted = encoded(irradiance / irradiance.max() * words.linear.max(), decoding)
        errors.append(encoded_error(light, wanted, decoding))
    return errors
