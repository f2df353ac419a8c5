"""Where a place over the x-y plane lies in the plane of a face's own parameters, (u, v)."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface, parameter
from bstcad.optics.outlines import Circle, Outline
from bstcad.optics.surfaces import Conic, Plane, Sphere, Surface

PARABOLA = 1e-10  # mm; a sphere that departs from its parabola by less is written as one

Image = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (x, y) in mm -> (…, 2) in the plane of a patch


@functools.singledispatch
def of_face(face: Surface, outline: Outline) -> Image | None:
    """The image of a face of a lens with this outline on the patch that `faces` makes of it; None: that is a plane."""
    raise TypeError(f"no OCC surface is exactly a {type(face).__name__}")


@of_face.register
def _(face: Plane, outline: Outline) -> None:
    return None


@of_face.register
def _(face: Sphere, outline: Outline) -> Image | None:
    if face.curvature == 0:
        return None
    if nearly_flat(face.curvature, outline):
        return lambda x, y: np.stack([x, y], axis=-1)
    return of_sphere(face.curvature)


@of_face.register
def _(face: Conic, outline: Outline) -> Image | None:
    return of_conic(face) if face.curvature else None


@of_face.register
def _(face: BSplineSurface, outline: Outline) -> Image:
    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ends = zip((x, y), (face.x, face.y), face.pitch, strict=True)
        across = (np.clip((p - low) / pitch, 0.0, face.m - 1.0) for p, (low, _), pitch in ends)
        return np.stack([parameter(torch.from_numpy(p), face.m).numpy() for p in across], axis=-1)

    return uv


def nearly_flat(c: float, outline: Outline) -> bool:
    """Is a sphere of this curvature (1/mm) written as its parabola?"""
    return abs(c) ** 3 * reach2(outline) ** 2 / 8 < PARABOLA


def of_sphere(c: float) -> Image:
    """(x, y) in mm to (u, v) of a sphere of curvature c (1/mm), its poles along ±x."""
    s, R = np.sign(c), 1 / abs(c)

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        v = np.arcsin(s * x / R)
        return np.stack([np.pi + np.arcsin(y / (R * np.cos(v))), v], axis=-1)

    return uv


def of_conic(front: Conic) -> Image:
    """(x, y) in mm to (u, v) of a conic as a rational patch (faces.conic_net)."""
    bend = (1 + front.conic_constant) * front.curvature**2

    def uv(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        scale = 2 / (1 + np.sqrt(1 - bend * (x * x + y * y)))
        return np.stack([x * scale, y * scale], axis=-1)

    return uv


def reach2(outline: Outline) -> float:
    """The largest r² of the outline (mm²)."""
    a, b = outline.half_extent
    return a * a if isinstance(outline, Circle) else a * a + b * b
