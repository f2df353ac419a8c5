"""The photo of a target on the page: a small copy on which a crop is drawn, and its proportions."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from bstcad.app.kinds import extent, table_at
from bstcad.scene import picture
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.scene.target import Target, shown_size

MAX_SIDE = 480  # largest length of the longer side of the photo on the page (pixels)


def target_of(scene: Scene, key: str) -> Target:
    """Return the target at a key such as target or target[1].  SceneError if it does not exist or has no photo."""
    found = dict(zip(scene.target_keys, scene.targets, strict=True)).get(key)
    if found is None or (found.image is None and found.sample is None):
        raise SceneError(f"{key[:40]}: no such target, or it has no photo; choose a target with an image or a sample")
    return found


def small_photo(target: Target) -> bytes:
    """Return the whole photo of a target, upright, as a PNG of at most MAX_SIDE pixels per side."""
    given = target.sample if target.image is None else target.image
    with picture.decoding(getattr(given, "name", given)):
        image = picture.photo(given).image
        if image.mode.startswith(("I", "F")):  # more than 8 bits: scale by the brightest pixel
            image = image.point(lambda value: value * (255 / max(image.getextrema()[1], 1e-300))).convert("L")
        image = image.convert("RGB")
        image.thumbnail((MAX_SIDE, MAX_SIDE))
    written = io.BytesIO()
    image.save(written, "png")
    return written.getvalue()


def in_proportions(data: Mapping[str, Any], key: str, target: Target) -> dict[str, Any]:
    """Return the changes, by key, that give the lens and the picture the proportions of a target's photo.

    data: tables of the scene.  key: key of the target.  The longer sides keep their lengths.  A round lens, and a lens
    for several targets, keeps its outline.  A source's aperture that equals the outline of the lens changes with it.
    """
    shown = shown_size(target)
    sides = [each / max(shown) for each in shown]
    changes: dict[str, Any] = {}
    longer = max(target.size)
    for axis, (low, high), side in zip("xy", (target.x, target.y), sides, strict=True):
        half, middle = side * longer / 2, (low + high) / 2
        changes[f"{key}.{axis}"] = [float(f"{middle - half:.7g}"), float(f"{middle + half:.7g}")]
    outline = table_at("lens.outline", dict(data))
    if key == "target" and outline.get("shape") == "rectangle" and (sizes := extent(outline)) is not None:
        tables = ["lens.outline", *(["source.aperture"] if table_at("source.aperture", dict(data)) == outline else [])]
        for table in tables:
            for name, side in zip(("width", "height"), sides, strict=True):
                changes[f"{table}.{name}"] = float(f"{side * max(sizes):.4g}")
    return changes
