"""Figures of each goal in report.json: the light on each target, absolute too, flat tops, and the wavefront."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field

from bstcad.analysis.cell_errors import is_right, right_down_to
from bstcad.analysis.etendue import Silhouette
from bstcad.analysis.top_hat import FLAT_LEVEL, FlatTop
from bstcad.designs.course import Fraction, Rrmsd, Size
from bstcad.optics.receivers.goal import Goal, suffix_of, words_of
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.trace.measure import RESOLVED, CellError, Light
from bstcad.optics.trace.wavefront_error import WavefrontError
from bstcad.scene.target import Target, drawing
from bstcad.verify.checks import Proof
from bstcad.verify.light_limits import PER_LX

CELL_WORDS = {1.0: "pixels", 0.5: "half pixels", 0.25: "quarter pixels"}  # side of a cell (pixels): name of the cells


@dataclass(frozen=True)
class CellFigures:
    """RRMSD of the light on cells of one size, by which each pixel is divided, or pixels are joined."""

    cell: Size  # side of a cell, the geometric mean of width and height, in `unit`
    unit: str  # unit of the receiver: mm, or degrees for a target over directions
    pixels: Size  # side of a cell in pixels of the target: 4, 2, 1, 0.5 or 0.25
    rrmsd: Rrmsd  # RRMSD from the target as it is meant on these cells, without bias by noise
    standard_error: Annotated[float, Field(ge=0, le=1e3)]  # standard error of rrmsd
    # RRMSD of the light blurred by the image of the real source, which counts on these cells; None: the size of the
    # source is simulated, or its image is narrower than a cell
    blurred: Rrmsd | None = None

    @property
    def counted(self) -> float:
        """RRMSD that counts on these cells: `blurred` if it is known."""
        return self.rrmsd if self.blurred is None else self.blurred

    @property
    def words(self) -> str:
        """Name of the cells in a sentence."""
        return CELL_WORDS.get(self.pixels, f"cells of {self.pixels:g} pixels")


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
    rrmsd_by_cell: Annotated[tuple[CellFigures, ...], Field(max_length=20)] = ()  # RRMSDs by size of the cells
    # side of the smallest cell, in `unit`, such that on it and on all larger cells the RRMSD is at most 1.5 times that
    # on pixels, or at most 0.03; None: not measured, or no cell is as good
    right_down_to: Size | None = None

    def on_cells(self, pixels: float) -> CellFigures | None:
        """Return the figures on cells of a side in pixels; None: not measured."""
        return next((each for each in self.rrmsd_by_cell if each.pixels == pixels), None)

    @property
    def uneven_in_pixels(self) -> bool:
        """True if the RRMSD on half pixels is too large for that on pixels, both with the real source if known."""
        pixel, half = self.on_cells(1.0), self.on_cells(0.5)
        return pixel is not None and half is not None and not is_right(half.counted, pixel.counted)

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
    finest = [right_down_to(light.by_cell) for light in lights]
    return tuple(
        GoalFigures(
            goal.key,
            goal.screen.receiver.position_text(),
            goal.weight,
            light.rrmsd,
            rrmsd_standard_error=light.standard_error,
            rrmsd_tent=light.tent,
            light_on_target=light.flux["on target"],
            efficiency=light.efficiency,
            leak=light.leak and light.leak.share,
            contrast=light.leak and light.leak.contrast,
            unit=goal.screen.receiver.unit,
            rrmsd_by_cell=tuple(_cell_figures(light.by_cell, goal.screen)),
            right_down_to=None if smallest is None else smallest * goal.screen.pixel_side,
        )
        for goal, light, smallest in zip(goals, lights, finest, strict=True)
    )


def _cell_figures(errors: Sequence[CellError], screen: Screen) -> Iterator[CellFigures]:
    """Yield the figures of cells of each size on a screen."""
    for each in errors:
        yield CellFigures(
            each.cell * screen.pixel_side, screen.receiver.unit, each.cell,
            rrmsd=each.rrmsd, standard_error=each.standard_error, blurred=each.blurred,
        )  # fmt: skip


@dataclass(frozen=True)
class Photometry:
    """Absolute figures of the light on a target, if the luminous flux of the source is known."""

    key: str  # key of the target: target, target[0], …
    source_lumens: Size  # luminous flux of the source (lm)
    lumens: Size  # luminous flux on the target (lm)
    unit: str | None  # unit of mean and peak: lx on planes, cd over directions; None: a receiver of a script
    mean: Size | None  # mean illuminance or intensity over the whole target
    peak: Size | None  # illuminance or intensity of the brightest cell
    output_ratio: Fraction  # light output ratio: flux that leaves the last surface / flux of the source
    reflection: bool  # True if losses by reflection at the faces are simulated
    # mean luminance of the back (cd/m²), its outline projected, in the direction of the peak; None: not a target over
    # directions
    luminance: Size | None = None
    peak_error: Size | None = None  # standard error of peak; None: unknown
    peak_cell: Size = 1.0  # side (pixels) of the cells of which peak is the brightest

    @property
    def peak_words(self) -> str:
        """Name of the cell of the peak in a sentence."""
        return "pixel" if self.peak_cell == 1 else f"cell of {self.peak_cell:g} pixels"


def photometry(goals: Sequence[Goal], proof: Proof, lumens: float | None, *, reflection: bool) -> Iterator[Photometry]:
    """Yield the absolute figures of the light on each goal; none if the flux of the source is not known.

    lumens: luminous flux of the source.  reflection: True if the light lost by reflection is simulated.
    """
    for goal, light in zip(goals, proof.lights, strict=True) if lumens else ():
        screen, on_target = goal.screen, lumens * light.on_screen
        unit = screen.receiver.photometric_unit
        mean = peak = error = luminance = None
        if unit is not None and light.picture.any():
            sizes = screen.cell_sizes
            scale = on_target / light.picture.sum() * (PER_LX if unit == "lx" else 1.0)
            values = scale * light.picture / sizes
            row, column = (int(each) for each in np.unravel_index(values.argmax(), values.shape))
            mean = float(scale * light.picture.sum() / sizes.sum())
            whole = on_target * (PER_LX if unit == "lx" else 1.0)
            peak, error = whole * light.peak, whole * light.peak_error
            luminance = _luminance(proof, screen, peak, at=(row, column)) if unit == "cd" else None
        yield Photometry(
            goal.key, lumens, on_target, unit, mean=mean, peak=peak, output_ratio=light.leaving, luminance=luminance,
            reflection=reflection, peak_error=error, peak_cell=light.peak_cell,
        )  # fmt: skip


def _luminance(proof: Proof, screen: Screen, peak: float, at: tuple[int, int]) -> float | None:
    """Return I / A (cd/m²): I = peak (cd) in the direction of the pixel `at`, from which the back has the area A."""
    (row, column), (per_x, per_y) = at, screen.per_unit
    x, y = screen.x[0] + (column + 0.5) / per_x, screen.y[1] - (row + 0.5) / per_y
    cosine = float(screen.receiver.normal(torch.tensor([x, y], dtype=torch.float64))[2])
    area = float(Silhouette.of(proof.lens).area(np.array([abs(cosine)]))[0])
    return peak / area * PER_LX if area > 0 else None


def flat_tops(targets: Mapping[str, Target], lights: Sequence[Light]) -> Iterator[FlatTop]:
    """Yield the figures of each target with a flat profile, if light falls on it; targets: by key."""
    for (key, target), light in zip(targets.items(), lights, strict=True):
        if target.profile is not None and target.profile.shape != "gaussian" and light.picture.any():
            pixel = tuple(side / n for side, n in zip(target.size, target.columns_rows, strict=True))
            inside = drawing(target).light  # covered fraction of each pixel, for a shape with an edge
            if target.profile.shape == "super_gaussian":
                inside = (inside >= FLAT_LEVEL * inside.max()).astype(float)
            areas = 1.0 if target.screen.areas is None else target.screen.areas
            yield FlatTop.of(key, light.picture / areas, pixel, inside, on_picture=light.flux["on target"])
