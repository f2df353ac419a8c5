"""Where the light misses its target: lit parts of a picture that stay dark, and dark parts that are lit.

Both are of a target and of an irradiance of one sum, (rows, columns) with row 0 at y max.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.ndimage

from bstcad.optics.irradiance import Screen

DARK = 0.01  # of the picture's mean: darker is dark
UNLIT = 0.1  # of the target's irradiance: a pixel with less of it was left dark
PATCH = 5e-3  # of the lit area: less of it left dark is not worth a sentence


def unlit(target: np.ndarray, irradiance: np.ndarray, screen: Screen) -> dict[str, Any]:
    """The share of the lit part that gets hardly any light, and the place of its largest patch; {} for next to none.

    place: least and largest x, least and largest y, in words.
    """
    lit = target > DARK * target.mean()
    dark = lit & (irradiance < UNLIT * target)
    share = float(dark.sum() / lit.sum())
    if share < PATCH or target[dark].sum() < PATCH * target.sum():  # which a rim of pixels that are lit in part is not
        return {}
    patches, count = scipy.ndimage.label(dark, np.ones((3, 3)))
    largest = 1 + np.argmax(scipy.ndimage.sum_labels(dark, patches, range(1, count + 1)))
    rows, columns = scipy.ndimage.find_objects(patches)[largest - 1]
    x, y = (np.linspace(*ends, n + 1) for ends, n in zip((screen.x, screen.y), target.shape[::-1], strict=True))
    sides = (x[columns.start], x[columns.stop]), (y[-1 - rows.stop], y[-1 - rows.start])
    named = zip(screen.plane.names, sides, strict=True)
    place = (f"{name} = {low:.4g} to {high:.4g} {screen.plane.unit}" for name, (low, high) in named)
    return {"share": share, "place": ", ".join(place)}


def lifted(target: np.ndarray, irradiance: np.ndarray) -> dict[str, float]:
    """The light on the dark parts of the target, of all light, and its level, of the mean irradiance.

    A smooth face cannot part its light without a seam.
    """
    dark = target < DARK * target.mean()
    light = float((irradiance - target)[dark].sum() / target.sum())
    return {"light": light, "level": float(irradiance[dark].mean() / target.mean()) if dark.any() else 0.0}
