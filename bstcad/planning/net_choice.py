"""Choose the number of control points of the back if the scene states none.

If the light of k cells of the net falls on a pixel, the lens has k degrees of freedom for that pixel.  The flux that a
pixel needs, divided by the flux density of the source's light at the back, is the area of the back that lights the
pixel.  Dark pixels are lit by few cells.  The RRMSD of a net follows from the detail of the picture that is finer than
its cells, and finer than cells twice as wide.  The size of the net determines time and memory (prediction.py).

Among the nets that memory, tailoring.max_time and the tool radius allow, the smallest net is chosen for which each
larger net would reduce the RRMSD by at most a fifth, or by at most half in three or more times the time.
tests/benchmarks/test_net_choice.py compares the choice with designs of every net.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import psutil
import torch
from scipy.ndimage import gaussian_filter

from bstcad.analysis.cost import TILE_PIXELS, ControlCells
from bstcad.optics.lens.interfaces import cross
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.sides import Sides, as_pair, coarser, size_text, spread
from bstcad.optics.trace.tubes import area_of, collect, launch_tubes
from bstcad.planning.effect_estimates import coarse_lens
from bstcad.planning.prediction import REMAINING_BLUR, blur_rrmsd, memory_gb, typical_seconds
from bstcad.report.units import about, two_digits
from bstcad.scene.scene import Scene
from bstcad.scene.schema import MAX_CONTROL_POINTS

NET_KEY = "lens.back.control_points"  # key of the scene that states the net
SQUARE_NETS = (65, 129, 257, 513, 1025)  # control points per side; an oblong net has about as many in total
MAX_SQUARE_ASPECT = 1.25  # largest aspect ratio of an outline with a square net
# Factors (reduction of the RRMSD, increase of the time): a larger net that reduces less and takes longer is rejected.
MIN_GAINS = ((1.25, 1.0), (2.0, 3.0))
MEMORY_FRACTION = 0.8  # fraction of the machine's memory that a design may use
DENSITY_TUBES = 256  # flux tubes per side for the flux density at the back
# Coefficients of the error bound (ControlCells.floor) of the net, and of a net with half as many cells per side.
FLOOR_FACTOR, HALVED_FACTOR = 0.68, 0.43
# (factor, offset) by quality: RRMSD due to the net = factor · (both error bounds combined) + offset.
QUALITY_TERMS = {"draft": (1.5, 0.012), "standard": (1.0, 0.002), "fine": (0.7, 0.004)}
MIN_SEAM_SHIFT = 7.0  # seam shift (pixels) below which cells are too fine for the tool
# Cells per pixel above which finer nets reduce the RRMSD further by at most a factor, and this factor.
SUFFICIENT_CELLS, MAX_FURTHER_GAIN = 5.0, 1.4
MIN_RRMSD_RATIO = 0.43  # smallest observed RRMSD with a finer net / with a coarser net (portrait.toml, 1025 and 513)
MIN_RELATIVE_FLUX = 1e-3  # flux of a tile / mean flux below which the mean area per flux is used


@dataclass(frozen=True)
class Candidate:
    """Net with its estimated RRMSD, time and memory."""

    net: Sides  # control points per side, or along x and along y
    rrmsd: float  # estimated RRMSD
    seconds: float  # time (s) on two cores of pace 1 (prediction.pace)
    memory_gb: float  # peak memory of the two processes (GB)
    seam_shift: float = math.inf  # result of the function `seam_shift` (pixels)

    def relative_to(self, other: Candidate) -> tuple[float, float]:
        """Return (RRMSD, time) divided by those of another candidate; the ratios are more accurate than the values."""
        return self.rrmsd / other.rrmsd, self.seconds / other.seconds


@dataclass(frozen=True)
class Choice:
    """Chosen net among all possible nets."""

    possible: tuple[Candidate, ...]  # possible nets, from coarse to fine
    index: int  # index of the chosen net
    limit: str = ""  # limit that excludes larger nets, in words; "": none

    @property
    def net(self) -> Sides:
        """Control points per side, or along x and along y."""
        return self.possible[self.index].net

    @property
    def line(self) -> str:
        """Line that states the chosen net, and RRMSD and time with more or fewer control points."""
        chosen, around = self.possible[self.index], []
        for step, word in ((1, "more"), (-1, "fewer")):
            if 0 <= self.index + step < len(self.possible):
                other = self.possible[self.index + step]
                less, longer = map(about, other.relative_to(chosen))
                factors = f"about {less} times the RRMSD in {longer} times the time"
                around.append(f"{word}, {size_text(other.net)}, would give {factors}")
        return "; ".join(filter(None, (f"{size_text(chosen.net)} control points are chosen", *around, self.limit)))

    def facts(self) -> dict[str, Any]:
        """Return the choice for JSON, each net with RRMSD and time relative to the chosen one."""
        chosen = self.possible[self.index]
        factors = [(each.net, *map(two_digits, each.relative_to(chosen))) for each in self.possible]
        return {
            "possible": [dict(zip(("net", "times_rrmsd", "times_seconds"), each, strict=True)) for each in factors],
            "number": self.index,
            "limit": self.limit,
        }


def with_net(scene: Scene, say: Callable[[str], None] = lambda line: None) -> tuple[Scene, Choice | None]:
    """Return the scene with a net, and its Choice (None: the scene states it); raise SceneError for an unlit back.

    All commands that take a scene without a net choose it here.  say: receives the line on a choice.
    """
    if scene.lens.back.control_points is not None:
        return scene, None
    levels = scene.tailoring.levels
    if levels is not None:  # the last level states the net
        return scene.changed({NET_KEY: levels[-1]}), None
    choice = choose_net(scene)
    say(choice.line)
    return scene.changed({NET_KEY: choice.net}), choice


def choose_net(scene: Scene) -> Choice:
    """Choose a net for a scene that states none; with several targets, the target that needs the finest net decides."""
    choices = map(_choose_for_target, scene.single_target_scenes())
    return max(choices, key=lambda choice: math.prod(as_pair(choice.net)))


def _choose_for_target(scene: Scene) -> Choice:
    scenes = [scene.changed({NET_KEY: net}) for net in candidate_nets(scene.lens.outline)]
    lens = coarse_lens(scenes[0])
    light, image = area_cells(scenes[0], lens), blur_rrmsd(scenes[0], lens)
    pixels = light.target.size
    mean_cells = [light.cells_per_pixel.sum() / math.prod(each.lens.cells) / pixels for each in scenes]  # per pixel
    candidates: list[Candidate] = []
    for each, cells, coarser_cells in zip(scenes, mean_cells, [0.0, *mean_cells], strict=False):
        if coarser_cells > SUFFICIENT_CELLS:
            break
        likely = net_rrmsd(light, each, image)
        if candidates and cells > SUFFICIENT_CELLS:
            likely = max(likely, candidates[-1].rrmsd / MAX_FURTHER_GAIN)
        seconds = typical_seconds(each).total
        candidates.append(Candidate(each.lens.back.net, likely, seconds, memory_gb(each), seam_shift=seam_shift(each)))
    possible, limit = _affordable(candidates, scene.tailoring.max_time, scene.lens.tool_radius)
    first = 0
    while any(_is_worthwhile(possible[first], other) for other in possible[first + 1 :]):
        first += 1
    return Choice(possible, first, limit if first == len(possible) - 1 else "")


def rrmsd_ratio(scene: Scene, finer: Scene, lenses: Sequence[Lens]) -> float:
    """Return the RRMSD of the scene with a finer net (`finer`) / RRMSD of `scene`, for the target that improves least.

    It is at least MIN_RRMSD_RATIO and at most 1.  lenses: a coarse lens for each target.
    """
    ratios = []
    for one, other, lens in zip(scene.single_target_scenes(), finer.single_target_scenes(), lenses, strict=True):
        light, image = area_cells(one, lens), blur_rrmsd(one, lens)
        coarse_error, fine_error = (net_rrmsd(light, each, image) for each in (one, other))
        ratios.append(fine_error / coarse_error)
    return min(max(*ratios, MIN_RRMSD_RATIO), 1.0)


def _is_worthwhile(coarse: Candidate, fine: Candidate) -> bool:
    less, longer = coarse.rrmsd / fine.rrmsd, fine.seconds / coarse.seconds
    return not any(less <= gain and longer >= time for gain, time in MIN_GAINS)


def _affordable(
    candidates: list[Candidate], max_time: float | None, radius: float | None
) -> tuple[tuple[Candidate, ...], str]:
    """Return the candidates that tool, time and memory allow (or the coarsest), and, in words, what excludes others."""
    available = MEMORY_FRACTION * psutil.virtual_memory().total / 1e9
    bounds = (
        (f"more have no effect with lens.tool_radius = {radius}", lambda each: each.seam_shift >= MIN_SEAM_SHIFT),
        (f"more take longer than tailoring.max_time = {max_time}", lambda each: each.seconds <= (max_time or math.inf)),
        ("more need more memory than this machine has", lambda each: each.memory_gb <= available),
    )
    limit = ""
    for reason, fits in bounds:
        fewer = [each for each in candidates if fits(each)] or candidates[:1]
        candidates, limit = fewer, reason if len(fewer) < len(candidates) else limit
    return tuple(candidates), limit


def seam_shift(scene: Scene) -> float:
    """Return the distance (pixels) on the target between light from both ends of a cell in the tool's narrowest valley.

    It is p L D / R, with the width p of a cell, the throw L, the tool radius R, and the ratio D of deflection to slope
    (Passes.deflection); infinite without R.  At a seam, where light separates, the back has such a valley.
    """
    radius, target = scene.lens.tool_radius, scene.target
    if radius is None:
        return math.inf
    deflection = max(scene.lens.passes.deflection(face, scene.index) for face in scene.lens.tailored_faces)
    throw = abs(target.screen.receiver.per_radian(scene.lens.back.z)) * deflection / radius
    return throw * math.sqrt(math.prod(scene.lens.cells)) * math.sqrt(math.prod(target.screen.per_unit))


def candidate_nets(outline: Outline) -> list[Sides]:
    """Return the candidate nets from coarse to fine; for an oblong lens they have square cells."""
    half_x, half_y = outline.half_extent
    if max(half_x, half_y) <= MAX_SQUARE_ASPECT * min(half_x, half_y):
        return list(SQUARE_NETS)
    return [coarser(spread(points, half_x, half_y), MAX_CONTROL_POINTS) for points in SQUARE_NETS]


@torch.no_grad()
def area_cells(scene: Scene, lens: Lens) -> ControlCells:
    """Return the area (mm²) of the back that lights each pixel, as ControlCells of 1 mm².

    lens: coarse lens for the scene, whose light gives the flux density at the back for each part of the target.
    """
    light = max(scene.with_source_scaled(0.0).channels(), key=lambda channel: channel.weight)
    lens, screen, target = light.through(lens), scene.target.screen, scene.target.irradiance()
    columns, rows = as_pair(screen.pixels)
    tiles = replace(screen, pixels=(-(-columns // TILE_PIXELS), -(-rows // TILE_PIXELS)))
    tubes = launch_tubes(light.source, lens, DENSITY_TUBES)
    x, y = cross(tubes.rays, lens.interfaces[lens.tailored_numbers[0]]).rays.position[:2]
    landed = tubes.landing(lens, screen.receiver)
    flux, corners = tubes.arriving_flux(landed), landed.position.double()
    area = torch.where(flux > 0, area_of(x, y).double(), torch.zeros_like(flux))
    area, flux = (
        gaussian_filter(
            collect(corners, carried, tiles.shape, tiles.scale)[0].cpu().numpy().clip(0), 1.0, mode="nearest"
        )
        for carried in (area, flux)
    )
    mean = area.sum() / flux.sum() if flux.sum() > 0 else 0.0
    bright = flux > MIN_RELATIVE_FLUX * flux.mean()
    per_flux = np.where(bright, area / np.maximum(flux, 1e-300), mean)  # mm² per unit of flux
    whole = float(flux.sum())
    rows, columns = target.shape
    over_pixels = np.kron(per_flux, np.ones((TILE_PIXELS, TILE_PIXELS)))[:rows, :columns]
    return ControlCells(whole * target * over_pixels, target)


def net_rrmsd(light: ControlCells, scene: Scene, image: float = 0.0) -> float:
    """Estimate the RRMSD of a scene: detail finer than its net's cells, finer than cells twice as wide, and an offset.

    light: see `area_cells`.  image: RRMSD of the target blurred by the image of the source.  The estimate is fitted to
    designs in standard quality: half are within a factor 1.3, nine of ten within 2.  Other qualities: less accurate.
    """
    factor, rest = QUALITY_TERMS.get(scene.tailoring.quality, QUALITY_TERMS["standard"])
    width, height = scene.lens.cells
    finer = 1 / math.sqrt(width * height)
    other_tiles = tuple(slice(TILE_PIXELS // 2 if side > TILE_PIXELS // 2 else 0, None) for side in light.target.shape)
    between = replace(light, cells_per_pixel=light.cells_per_pixel[other_tiles], target=light.target[other_tiles])
    floors = (FLOOR_FACTOR * light.floor(finer), FLOOR_FACTOR * between.floor(finer))
    halved = (HALVED_FACTOR * light.floor(finer / 2), HALVED_FACTOR * between.floor(finer / 2))
    by_net = factor * math.hypot(*floors, *halved) / math.sqrt(2) + rest
    return math.hypot(by_net, REMAINING_BLUR * image)
