"""A scene's [mount] in words, as a drawing has them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from bstcad.report.part_views import length
from bstcad.scene.mount import Box, Mount, Round

DATUMS = {"source": "as on this sheet", "front": "the front's vertex", "flange": "the flange's lower face"}


def rows(mount: Mount | None) -> Iterator[tuple[str, str]]:
    """What part.step adds to the lens, (name, value); nothing without a mount."""
    if mount is None:
        return
    yield "Its z = 0", DATUMS[mount.datum]
    if mount.rim is not None:
        yield "Rim cut to", f"{_across(mount.rim)} mm"
    if walls := _walls(mount.draft, mount.bevel):
        yield "Lens's walls", walls
    flange = mount.flange
    if flange is None:
        return
    yield "Flange", f"{_across(flange.outline)} mm"
    yield "", f"z = {length(flange.z)} to {length(flange.z + flange.thickness)} mm here"
    if walls := _walls(flange.draft, flange.bevel):
        yield "Its walls", walls
    if flange.screws is not None:
        screws = flange.screws
        on = f"on \u00d8{length(screws.circle)} mm, from {screws.first:g}\u00b0"
        yield "Screw holes", f"{screws.count} \u00d7 \u00d8{length(screws.diameter)} {on}"
    for diameter, count in Counter(diameter for _, _, diameter in flange.holes).items():
        yield "Holes", f"{count} \u00d7 \u00d8{length(diameter)} mm, see part.step"


def _walls(draft: float, bevel: float) -> str:
    """Of both what there is."""
    found = (f"draft {draft:g}\u00b0" * bool(draft), f"bevel {bevel:g} mm" * bool(bevel))
    return ", ".join(filter(None, found))


def _across(outline: Round | Box) -> str:
    if outline.shape == "circle":
        return f"\u00d8{length(outline.diameter)}"
    corner = f", R{length(outline.corner_radius)}" if outline.corner_radius else ""
    return f"{length(outline.width)} \u00d7 {length(outline.height)}{corner}"
