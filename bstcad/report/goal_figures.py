"""Figures of each goal in report.json: the light on each target, flat tops, and the wavefront."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from bstcad.analysis.top_hat import FLAT_LEVEL, FlatTop
from bstcad.optics.goal import Goal, suffix_of, words_of
from bstcad.optics.measure import RESOLVED, Light
from bstcad.optics.wavefront_error import WavefrontError
from bstcad.scene.scene import Scene
from bstcad.scene.target import drawing
from bstcad.verify.checks import Proof

Fraction = Annotated[float, Field(ge=-1e-6, le=1 + 1e-6)]  # number from 0 to 1, with the rounding error of a sum
Size = Annotated[float, Field(ge=0, le=1e12)]  # number from 0 to 1e12
Rrmsd = Annotated[float, Field(gt=0, le=1e3)]


@dataclass(frozen=True)
class GoalFigures:
    """Figures of the light on a target."""

    key: str  # key of the target in the scene: target; if there are several, target[0], target[1] …
    where: str  # position of the receiver, in words
    weight: Size  # weight of the squared error on this target in the merit function
    rrmsd: Rrmsd  # RRMSD computed from the flux in each pixel
    rrmsd_standard_error: Annotated[float, Field(ge=0, le=1e3)]  # standard error, from independent sets of rays
    rrmsd_tent: Rrmsd | None  # RRMSD with each ray divided among four pixels
    light_on_target: Fraction  # fraction of the source's flux on the target
    efficiency: Fraction  # flux on the target, as a fraction of the flux that leaves the last face
    leak: Fraction | None  # fraction of the light on the target that is on its dark pixels; None: no dark pixels
    contrast: Size | None  # mean irradiance of lit divided by dark pixels; None: no dark pixels, or no leak
    unit: str = "mm"  # unit of x and y on the receiver

    @property
    def resolved(self) -> bool:
        """True if the RRMSD is at least five times its standard error."""
        return self.rrmsd >= RESOLVED * self.rrmsd_standard_error

    @property
    def suffix(self) -> str:
        """Suffix that tells apart the names of figures, such as ", target[1]"; empty if there is one target."""
        return suffix_of(self.key)

    @property
    def words(self) -> str:
        """Name of the target in a sentence: "the target" or "target[1]"."""
        return words_of(self.key)


@dataclass(frozen=True)
class WavefrontFigures:
    """Error of the wavefront behind the lens; 1 wave is `wavelength`."""

    z: float  # plane on which the wavefronts are compared (mm)
    wavelength: Size  # vacuum wavelength (nm)
    rms: Size  # RMS error, weighted by flux (waves)
    pv: Size  # peak to valley over all rays (waves)
    rms_with_tilt: Size  # RMS error with only piston removed (waves)
    tilt_urad: tuple[float, float]  # removed tilt towards +x and towards +y, relative to the requested light (µrad)
    angle_rms_urad: Size  # RMS angle between rays and requested rays, weighted by flux, tilt included (µrad)
    angle_max_urad: Size  # largest angle between rays and requested rays (µrad)
    floor: Size  # upper bound of the rounding error of the RMS (waves)
    flux: Fraction  # fraction of the source's flux that is measured
    removed: Literal["piston and tilt"] = "piston and tilt"  # terms that are removed before rms and pv

    @classmethod
    def of(cls, error: WavefrontError) -> WavefrontFigures:
        """Return the figures of a wavefront error; its flux is limited to 1, since a sum over a grid may exceed 1."""
        return cls(
            error.z, error.wavelength, error.without_tilt.rms, error.without_tilt.pv,
            rms_with_tilt=error.without_piston.rms, tilt_urad=error.tilt, angle_rms_urad=error.angle_rms,
            angle_max_urad=error.angle_max, floor=error.floor, flux=min(error.flux, 1.0),
        )  # fmt: skip


def figures_of(goals: Sequence[Goal], lights: Sequence[Light]) -> tuple[GoalFigures, ...]:
    """Return the figures of the light on each target."""
    return tuple(
        GoalFigures(
            goal.key,
            goal.receiver.plane.position_text(),
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
    """Yield the figures of each target with a flat profile, if light falls on it."""
    for key, target, light in zip(scene.target_keys, scene.targets, proof.lights, strict=True):
        if target.profile is not None and target.profile.shape != "gaussian" and light.picture.any():
            pixel = tuple(side / n for side, n in zip(target.size, target.columns_rows, strict=True))
            inside = drawing(target).light  # covered fraction of each pixel, for a shape with an edge
            if target.profile.shape == "super_gaussian":
                inside = (inside >= FLAT_LEVEL * inside.max()).astype(float)
            areas = 1.0 if target.screen.areas is None else target.screen.areas
            yield FlatTop.of(key, light.picture / areas, pixel, inside, on_picture=light.flux["on target"])
