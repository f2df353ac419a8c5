"""What predictions were fitted on, and which scenes lie outside of it."""

from __future__ import annotations

from collections.abc import Iterator

from bstcad.scene.quality import Tailoring
from bstcad.scene.scene import Scene

CONTROL_POINTS, PIXELS = (65, 1025), (128, 512)  # a side; pixels: of the longer one
ASPECT = 2.0  # of the target, or its inverse
ENDS = {"quality", "seed", "accuracy", "max_time", "source_points"}  # what may be set in tailoring: no amount of work


def complaint(scene: Scene) -> str:
    """Why no figures are predicted for a scene, in a sentence; "" if they are."""
    return next(_complaints(scene), "")


def _complaints(scene: Scene) -> Iterator[str]:
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    if scene.tailoring.method == "integration":
        yield 'predictions were fitted on tailored lenses, and tailoring.method = "integration" tailors none'
    if scene.lens.back.reflect:
        yield "predictions were fitted on lenses, and lens.back.reflect = true makes a mirror"
    if scene.source.extent is not None:
        yield "predictions were fitted on points and parallel light, and the source has a size"
    if len(scene.source.lines) > 1:
        yield "predictions were fitted on one wavelength, and source.wavelength has several"
    if scene.source.tilt or scene.target.tilt:
        yield "predictions were fitted on sources and targets that look along the axis, and here one is tilted"
    if scene.lens.front.kind not in ("plane", "sphere"):
        yield f'predictions were fitted on plane and spherical fronts, and lens.front.kind = "{scene.lens.front.kind}"'
    if scene.bounds is not None:
        keys = " and ".join(f"lens.{key}" for key in scene.lens.bounded_by)
        yield f"predictions were fitted on backs of any shape, and the scene bounds it by {keys}"
    if scene.effects:
        kinds = " and ".join(effect.kind for effect in scene.effects)
        yield f"predictions were fitted without effects, and the scene asks for {kinds}"
    for key, value, (fewest, most) in (
        ("lens.back.control_points", m, CONTROL_POINTS),
        ("target.pixels", max(columns, rows), PIXELS),
    ):
        if not fewest <= value <= most:
            yield f"predictions were fitted on {key} from {fewest} to {most}, and here there are {value}"
    if not 1 / ASPECT <= columns / rows <= ASPECT:
        yield f"predictions were fitted on targets of nearly equal sides, and this one has {columns} x {rows} pixels"
    for key in sorted(_knobs_set(scene)):
        yield f"predictions were fitted on the qualities as they are, and tailoring.{key} is set"


def _knobs_set(scene: Scene) -> set[str]:
    """The knobs that the scene sets to something else than its quality does."""
    m, given = scene.lens.back.control_points, scene.tailoring
    preset = Tailoring(quality=given.quality).resolved(m)
    return {
        key
        for key, value in given.model_dump(exclude=ENDS, exclude_none=True).items()
        if value != getattr(preset, key)
    }  # fmt: skip
