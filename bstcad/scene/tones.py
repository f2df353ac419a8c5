"""Tones: what the numbers in a picture file mean in light.

A photograph's are sRGB (IEC 61966-2-1): E = c / 12.92 up to c = 0.04045 and ((c + 0.055) / 1.055)^2.4 above it, for a
channel c and the irradiance E, both from 0 to 1.  Numbers of 16 bits and more are irradiance itself.  Before either
goes what the file says: cICP, an ICC profile, sRGB or gAMA, in this order, as PNG has it.  Grey is the mean of the
channels' light.
"""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image, ImageCms

from bstcad.scene.errors import SceneError

Curve = Callable[[np.ndarray], np.ndarray]  # from numbers to irradiance, both from 0 to 1

LARGEST_PROFILE = 10_000_000  # bytes; printers' profiles have a few millions
STEEPEST = 10.0  # an exponent beyond it, or below its inverse, is a mistake in the file
LINEAR, PQ, HLG = 8, 16, 18  # transfer characteristics of a cICP chunk (ITU-T H.273)


@dataclass(frozen=True)
class Tones:
    """How a scene wants the numbers of a picture to be read."""

    gamma: float | None = None  # irradiance = number ** gamma; None: as the file says
    invert: bool = False  # dark for light, as a person sees them


@dataclass(frozen=True)
class Meaning:
    """How the numbers of one picture become light."""

    curve: Curve
    colours: Callable[[Image.Image], Image.Image] | None = None  # by the picture's ICC profile, to sRGB
    white: float = 1.0  # of numbers that have neither 8 nor 16 bits


def from_srgb(value: np.ndarray) -> np.ndarray:
    """Irradiance of sRGB numbers from 0 to 1."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4)


def to_srgb(light: np.ndarray) -> np.ndarray:
    """sRGB numbers of irradiance from 0 to 1: what a screen is sent to show so much light."""
    light = np.asarray(light, dtype=np.float64)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055)


def meaning_of(image: Image.Image, data: bytes, deep: bool, tones: Tones) -> Meaning:
    """What the picture's numbers mean; deep: they have 16 bits or more.  `data`: its file."""
    found = Meaning(power(tones.gamma)) if tones.gamma is not None else _by_file(image, data, deep)
    if tones.invert:
        found = replace(found, curve=_inverted(found.curve))
    return replace(found, white=_white(image)) if image.mode in ("I", "F") else found


def power(gamma: float) -> Curve:
    """number ** gamma."""
    return linear if gamma == 1 else lambda number: number**gamma


def linear(number: np.ndarray) -> np.ndarray:
    """The number itself is the irradiance."""
    return number


def light(numbers: np.ndarray, alpha: np.ndarray | None, curve: Curve) -> np.ndarray:
    """Grey irradiance (h, w) of numbers (h, w, channels): integers of their type's range, or floats from 0 to 1.

    alpha (h, w) from 0 to 1: the picture stands before black.
    """
    if numbers.dtype == np.float64:
        return curve(numbers if alpha is None else numbers * alpha[..., None]).mean(-1)
    most = np.iinfo(numbers.dtype).max
    if alpha is None:
        return curve(np.arange(most + 1.0) / most)[numbers].mean(-1)
    return light(numbers / most, alpha, curve)


def numbers(image: Image.Image, low: Image.Image | None, meaning: Meaning) -> tuple[np.ndarray, np.ndarray | None]:
    """(h, w, channels) numbers as `light` takes them, and (h, w) opacity from 0 to 1 where there is one.

    low: the second bytes of colours of 16 bits, of which Pillow keeps the first.
    """
    if image.mode.startswith(("I", "F")):
        return _one_channel(image, meaning.white)
    alpha = None
    if image.has_transparency_data:
        rgba = image.convert("RGBA")
        image, alpha = rgba.convert("RGB"), np.asarray(rgba.getchannel("A")) / 255.0
    if meaning.colours is not None:
        return np.asarray(meaning.colours(image)), alpha
    if low is not None:
        first, second = (np.asarray(part.convert("RGB")).astype(np.uint16) for part in (image, low))
        return first * np.uint16(256) + second, alpha
    if image.mode in ("1", "L"):
        return np.asarray(image.convert("L"))[..., None], alpha
    return np.asarray(image.convert("RGB")), alpha


def _one_channel(image: Image.Image, white: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Of 16 or 32 bits, or floats; a PNG may name one number that is transparent."""
    values, clear = np.asarray(image), image.info.get("transparency")
    alpha = (values != clear).astype(np.float64) if isinstance(clear, int) else None
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:
        return values.astype(np.uint16)[..., None], alpha
    return values.astype(np.float64)[..., None] / white, alpha


def _white(image: Image.Image) -> float:
    """Of a picture of floats 1, of one of 32 bits 65535, or its largest number where that is more."""
    usual, most = 65535.0 if image.mode == "I" else 1.0, float(image.getextrema()[1])
    return max(usual, most) if math.isfinite(most) else usual


def _inverted(curve: Curve) -> Curve:
    """The light of the negative: what is seen as the tone t becomes 1 - t, and tones are sRGB whatever the file has."""
    return lambda number: from_srgb(np.round(1.0 - to_srgb(np.clip(curve(number), 0.0, 1.0)), 12))  # 1 ends at 0


def _by_file(image: Image.Image, data: bytes, deep: bool) -> Meaning:
    """What the file itself says, and by its depth where it says nothing."""
    transfer = _transfer(data) if image.format == "PNG" else None
    if transfer in (PQ, HLG):
        raise SceneError("target.image: it is an HDR picture (PQ or HLG); save it in sRGB, or give target.gamma")
    if transfer is not None:
        return Meaning(linear if transfer == LINEAR else from_srgb)
    profile = _profile(image)
    if profile is not None and image.mode.startswith(("I", "F")):
        return Meaning(_curve(profile))
    if profile is not None:
        return Meaning(from_srgb, profile)
    if "srgb" in image.info:
        return Meaning(from_srgb)
    encoded = image.info.get("gamma")
    if isinstance(encoded, float) and 1 / STEEPEST <= encoded <= STEEPEST:
        return Meaning(power(1 / encoded))
    return Meaning(linear if deep else from_srgb)


def _transfer(data: bytes) -> int | None:
    """The transfer characteristics that a PNG's cICP chunk names."""
    place = 8
    while place + 12 <= len(data):
        size, name = int.from_bytes(data[place : place + 4], "big"), data[place + 4 : place + 8]
        if name == b"IDAT":
            return None
        if name == b"cICP" and size == 4:
            return data[place + 9]
        place += 12 + size
    return None


def _profile(image: Image.Image) -> Callable[[Image.Image], Image.Image] | None:
    """From the picture's colours to sRGB by its ICC profile; None without one, or with one that cannot be used."""
    data = image.info.get("icc_profile")
    if not isinstance(data, bytes) or not 0 < len(data) <= LARGEST_PROFILE:
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[profile.profile.xcolor_space.strip()]
        transform = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, OSError, KeyError, ValueError, TypeError):
        return None
    if (mode == "CMYK") != (image.mode == "CMYK") or (mode == "L" and image.mode not in ("1", "L", "LA", "I;16", "F")):
        return None
    return functools.partial(_transformed, transform=transform, mode=mode)


def _transformed(image: Image.Image, transform: ImageCms.ImageCmsTransform, mode: str) -> Image.Image:
    return ImageCms.applyTransform(image if image.mode == mode else image.convert(mode), transform)


def _curve(profile: Callable[[Image.Image], Image.Image]) -> Curve:
    """What a profile makes of grey, for numbers finer than its own 8 bits."""
    ramp = Image.fromarray(np.arange(256, dtype=np.uint8)[None])
    seen = from_srgb(np.asarray(profile(ramp)) / 255.0).mean(-1)[0]
    return lambda number: np.interp(number, np.arange(256) / 255.0, seen)
