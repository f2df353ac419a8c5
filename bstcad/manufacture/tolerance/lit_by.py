"""The picture of a lens in another light than that for which it was designed: a plate for the sun under a lamp, say.

The other light replaces the source of the scene, at its main wavelength; lens and targets stay.  Its picture is that of
flux tubes of its centre, blurred by its image (tailoring/source_image.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bstcad.manufacture.tolerance.as_made import SceneLight, scaled
from bstcad.optics.receivers.irradiance import rrmsd_of_pictures
from bstcad.optics.trace.finish import Finish
from bstcad.scene.errors import SceneError, nearest
from bstcad.scene.scene import Scene
from bstcad.verify.nominal import Nominal


class Lamp(NamedTuple):
    """A light in which a lens may be seen."""

    words: str
    size: dict[str, float]  # keys of [source] that state its size
    ahead: float = 0.0  # default distance from the lens, in widths of the lens; 0: see `distance`
    distance: float = 0.0  # default distance from the lens (mm); 0: the sun, infinitely far away


LIGHTS = {
    "sun": Lamp("the sun, straight in front of it", {"divergence": 0.53}),
    "lamp": Lamp("a lamp of 2 mm", {"diameter": 2.0}, ahead=5.0),
    "led": Lamp("an LED of 1 mm", {"width": 1.0, "height": 1.0}, ahead=1.0),
    "phone": Lamp("the flashlight of a phone, 2 mm wide", {"diameter": 2.0}, distance=500.0),
}


@dataclass(frozen=True, eq=False)
class GoalLit:
    """Light on one target in the light of the design and in another; pictures (rows, columns), sum of the target."""

    key: str  # key of the target
    target: np.ndarray
    designed: np.ndarray  # picture in the light of the design
    lit: np.ndarray  # picture in the other light; zero if none reaches the target

    @property
    def rrmsds(self) -> tuple[float, float]:
        """RRMSD in the light of the design and in the other light."""
        return rrmsd_of_pictures(self.target, self.designed), rrmsd_of_pictures(
            self.target, self.lit
        ) if self.lit.any() else 1.0


@dataclass(frozen=True, eq=False)
class LitBy:
    """Pictures of a lens in another light."""

    name: str  # name of the light, a key of LIGHTS
    words: str  # the light and its distance, in words
    distance: float | None  # distance from the light to the lens (mm); None: infinite
    goals: tuple[GoalLit, ...]

    def facts(self) -> dict[str, Any]:
        """Return the entry `lit` of `plan --json`."""
        goals = [{"key": g.key, "rrmsd_designed": g.rrmsds[0], "rrmsd": g.rrmsds[1]} for g in self.goals]
        return {"light": self.name, "words": self.words, "distance": self.distance, "goals": goals}


def lit_by(design: Nominal, name: str, distance: float | None = None) -> LitBy:
    """Return the pictures of a design in the light of this name (LIGHTS).

    distance: from the light to the lens (mm); None: that of the light.  SceneError for an unknown light, or one that
    does not go with the scene.
    """
    scene, distance = scene_lit_by(design.scene, name, distance)
    lights = (SceneLight.of(each) for each in (design, replace(design, scene=scene)))
    before, after = (light.pictures(design.lens, Finish()) for light in lights)
    found = tuple(
        GoalLit(goal.key, goal.picture, scaled(one, goal.picture.sum()), scaled(two, goal.picture.sum()))
        for goal, one, two in zip(design.goals, before, after, strict=True)
    )
    where = "" if distance is None else f", {distance:.4g} mm away"
    return LitBy(name, LIGHTS[name].words + where, distance, found)


def scene_lit_by(scene: Scene, name: str, distance: float | None = None) -> tuple[Scene, float | None]:
    """Return the scene with the light of this name, and its distance (mm) from the lens; None: infinite."""
    if name not in LIGHTS:
        raise SceneError(f"--lit-by {name}: no such light; {nearest(name, list(LIGHTS), 'give one of')}")
    lamp, (half_x, half_y) = LIGHTS[name], scene.lens.outline.half_extent
    line = {"wavelength": scene.source.main_wavelength}
    if not lamp.ahead and not lamp.distance:
        if distance is not None:
            raise SceneError("--lit-at: the sun has no distance; remove it, or choose another light")
        sides = {"shape": "rectangle", "width": 2 * half_x, "height": 2 * half_y}
        beam = {"kind": "collimated", "profile": "uniform", "aperture": sides, **line, **lamp.size}
        if not scene.lens.passes.enters or scene.lens.passes.reflects:
            beam["z"] = scene.lens.back.z + 2 * max(half_x, half_y)
        return scene.changed({"source": beam}), None
    away = distance or lamp.distance or lamp.ahead * 2 * max(half_x, half_y)
    above = scene.lens.passes.sense < 0
    z = scene.lens.back.z + away if above else scene.lens.front.z - away
    point = {"kind": "point", "position": [0.0, 0.0, z], "profile": "lambertian", **line, **lamp.size}
    return scene.changed({"source": point}), away
