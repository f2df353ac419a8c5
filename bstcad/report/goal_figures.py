"""The figures of each goal in report.json: the light on each target, flat tops, and the wavefront."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from bstcad.analysis.top_hat import FLAT, FlatTop
from bstcad.optics.goal import Goal, suffix_of, words_of
from bstcad.optics.measure import RESOLVED, Light
from bstcad.optics.wavefront_error import WavefrontError
from bstcad.scene.scene import Scene
from bstcad.scene.target import drawing
from bstcad.verify.checks import Proof

Share = Annotated[float, Field(ge=-1e-6, le=1 + 1e-6)]  # part of 1, but for the rounding of a sum
Size = Annotated[float, Field(ge=0, le=1e12)]
Rrmsd = Annotated[float, Field(gt=0, le=1e3)]


@dataclass(frozen=True)
class GoalFigures:
    """The light on a target."""

    key: str  # target, or target[0], target[1], … of several
    where: str  # place of its receiver, in words
    weight: Size  # weight of its squared error among all goals
    rrmsd: Rrmsd  # RRMSD by the flux into each pixel
    rrmsd_standard_error: Annotated[float, Field(ge=0, le=1e3)]  # standard error of rrmsd, by independent sets of rays
    rrmsd_tent: Rrmsd | None  # RRMSD by linear binning
    light_on_target: Share  # part of the source's flux
    efficiency: Share  # flux on the target over flux that leaves the back face
    leak: Share | None  # part of the light on the target that is on its dark pixels; None: it has none
    contrast: Size | None  # mean irradiance of the lit pixels over that of the dark ones; None: or without leak
    unit: str = "mm"  # unit of x and y on its receiver

    @property
    def resolved(self) -> bool:
        """Is the RRMSD at least five times its standard error?"""
        return self.rrmsd >= RESOLVED * self.rrmsd_standard_error

    @property
    def suffix(self) -> str:
        """Behind a name: which of several targets it is."""
        return suffix_of(self.key)

    @property
    def words(self) -> str:
        """The target in a sentence."""
        return words_of(self.key)


@dataclass(frozen=True)
class WavefrontFigures:
    """The wavefront behind the lens against the one asked for; waves are those of `wavelength` in air."""

    z: float  # mm, the plane on which both are compared
    wavelength: Size  # nm
    rms: Size  # waves, each ray by its flux
    pv: Size  # waves, greatest less least of all rays
    rms_with_tilt: Size  # waves, piston alone removed
    tilt_urad: tuple[float, float]  # tilt removed: light that leans towards +x and towards +y of the wanted light
    angle_rms_urad: Size  # RMS angle between rays and wanted rays, each ray by its flux; tilt included
    angle_max_urad: Size  # largest angle between rays and wanted rays
    floor: Size  # waves that rounding may add to the RMS
    flux: Share  # part of the source's flux that is measured
    removed: Literal["piston and tilt"] = "piston and tilt"  # terms that are removed before rms and pv

    @classmethod
    def of(cls, error: WavefrontError) -> WavefrontFigures:
        """The figures of a measurement, whose flux is a sum over a grid: at the edge of a beam it may go beyond 1."""
        return cls(
            error.z, error.wavelength, error.without_tilt.rms, error.without_tilt.pv,
            rms_with_tilt=error.without_piston.rms, tilt_urad=error.tilt, angle_rms_urad=error.angle_rms,
            angle_max_urad=error.angle_max, floor=error.floor, flux=min(error.flux, 1.0),
        )  # fmt: skip


def figures_of(goals: Sequence[Goal], lights: Sequence[Light]) -> tuple[GoalFigures, ...]:
    """The light on each target."""
    return tuple(
        GoalFigures(
            goal.key,
            goal.receiver.plane.where(),
            goal.weight,
            light.rrmsd,
            rrmsd_standard_error=light.standard_error,
            rrmsd_tent=light.tent,
            light_on_target=light.flux["on target"],
            efficiency=light.efficiency,
            leak=light.leak and light.leak.share,
            contrast=light.leak and light.leak.contrast,
            unit=goal.receiver.plane.unit,
        )
        for goal, light in zip(goals, lights, strict=True)
    )


def flat_tops(scene: Scene, proof: Proof) -> Iterator[FlatTop]:
    """The figures of each target with a profile that is flat, if light falls on it."""
    for key, target, light in zip(scene.target_keys, scene.targets, proof.lights, strict=True):
        if target.profile is not None and target.profile.shape != "gaussian" and light.picture.any():
            pixel = tuple(side / n for side, n in zip(target.size, target.columns_rows, strict=True))
            inside = drawing(target).light  # the share of each pixel, of shapes with an edge
            if target.profile.shape == "super_gaussian":
                inside = (inside >= FLAT * inside.max()).astype(float)
            areas = 1.0 if target.screen.areas is None else target.screen.areas
            yield FlatTop.of(key, light.picture / areas, pixel, inside, on_picture=light.flux["on target"])
