"""The lens that a reader of report.html can turn: its faces and its wall in a few hundred kilobytes of text.

solid_view.js draws them in plain WebGL, which every browser has: a solid of one material needs a shader of twenty
lines, and not the 0.6 to 1 MB of a library, of whose lamps the relief of a lens would have to be seen by.  The slopes
are the surface's own, not those of the triangles, so that the shading is as fine as the lens at any distance.
"""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np

from bstcad.cad.mesh import nodes, rim, sampled
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface
from bstcad.report import rendering

FINE, COARSE = 256, 64  # cells each way of a net, and of a surface that is one smooth piece
STEPS = 65535  # of a number, over its range
LEAST = 1e-9  # range, mm or a slope, of what is all the same


def solid(lens: Lens) -> str:
    """The JSON that solid_view.js reads: lengths in mm, and the lamps of the 3-D picture (rendering.py).

    "" of faces that are not finite everywhere, as a damaged file may have them.

    values: base64 of 16-bit numbers, low byte first, each a part of its range.  For each face the places x, y, z of
    (cells + 1)² nodes and their slopes along x and y; then x, y, z of the front and z of the back around the rim.
    """
    lens = lens.plain()
    faces = [(_face(lens, surface), up) for surface, up in ((lens.back, 1), (lens.front, -1))]
    around = _around(lens)
    places = np.concatenate([*(face[:3].reshape(3, -1) for face, _ in faces), around[:3], around[[0, 1, 3]]], axis=1)
    if not np.isfinite(places).all():
        return ""
    low, size = places.min(axis=1), np.maximum(np.ptp(places, axis=1), LEAST)
    told, values = [], []
    for face, up in faces:
        steepest = max(float(np.abs(face[3:]).max()), LEAST)
        told.append({"cells": face.shape[1] - 1, "up": up, "steepest": steepest})
        values += [_steps(face[k], low[k], size[k]) for k in range(3)]
        values += [_steps(face[k], -steepest, 2 * steepest) for k in (3, 4)]
    values += [_steps(around[k], low[min(k, 2)], size[min(k, 2)]) for k in range(4)]
    lit: dict[str, Any] = {
        "eye": rendering.EYE,
        "angle": rendering.VIEW_ANGLE,
        "clay": [int(rendering.CLAY[k : k + 2], 16) / 255 for k in (1, 3, 5)],
        "lamps": [direction for direction, _ in rendering.LIGHTS],
        "bright": [intensity for _, intensity in rendering.LIGHTS],
        **rendering.FINISH,
    }
    numbers = base64.b64encode(np.concatenate(values).tobytes()).decode()
    shape = {"low": low.tolist(), "size": size.tolist(), "faces": told, "rim": around.shape[1]}
    return json.dumps(shape | lit | {"values": numbers})


def _face(lens: Lens, surface: Surface) -> np.ndarray:
    """x, y, z (mm), ∂z/∂x and ∂z/∂y of a face at its nodes: (5, cells + 1, cells + 1)."""
    x, y = nodes(lens.outline, COARSE if math.isinf(surface.detail) else FINE)
    return np.stack([x, y, *sampled(surface, x, y)])


def _around(lens: Lens) -> np.ndarray:
    """x, y, z of the front and z of the back once around the rim: (4, 4 FINE), mm."""
    x, y = nodes(lens.outline, FINE)
    at = rim(np.arange(x.size).reshape(x.shape))
    x, y = x.ravel()[at], y.ravel()[at]
    return np.stack([x, y, sampled(lens.front, x, y)[0], sampled(lens.back, x, y)[0]])


def _steps(values: np.ndarray, low: float, size: float) -> np.ndarray:
    """16-bit numbers: which part of the range from `low` on each value is at."""
    return np.rint((values.ravel() - low) * (STEPS / size)).astype("<u2")
