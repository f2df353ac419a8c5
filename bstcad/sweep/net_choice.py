"""How many control points the net of a back gets where the scene states none.

Where the light of k cells of the net falls on a pixel, the lens has k numbers to shape it with.  A pixel asks for a
flux, and the source's flux density where its light crosses the back tells the area of the back that sends it: scarce
light, which many such cells would have to carry, has few.  What of a picture is finer than its cells can make, and than
half as many each way can, gives the RRMSD of a net; its size gives its seconds and memory (prediction.py).

Of those that memory, tailoring.max_time and the tool's radius allow, the smallest net is chosen whose RRMSD each larger
one would lower by less than a fifth, or by less than half in three times the time.
tests/benchmarks/test_net_choice.py holds it to designs with every net.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import psutil
import torch
from scipy.ndimage import gaussian_filter

from bstcad.analysis.cost import TILE_PIXELS, ControlCells
from bstcad.optics.interfaces import cross
from bstcad.optics.lens import Lens
from bstcad.optics.sides import Sides, as_pair, coarser, size_text, spread
from bstcad.optics.tubes import area_of, collect, launch_tubes
from bstcad.report.units import about, two_digits
from bstcad.scene.blank import MAX_CONTROL_POINTS
from bstcad.scene.scene import Scene
from bstcad.sweep.estimates import coarse_lens
from bstcad.sweep.prediction import UNDONE, blurred, memory_gb, usual

KEY = "lens.back.control_points"
SQUARE = (65, 129, 257, 513, 1025)  # control points a side of the nets that are tried, or as many in square cells
NEARLY = 1.25  # as wide as high: a plate no more oblong than that gets a square net
WORTH = ((1.25, 1.0), (2.0, 3.0))  # (times less RRMSD, times the time): a larger net that gives no more is not worth it
ROOM = 0.8  # of the machine's memory, that a design may take
TUBES = 256  # a side, by which the light is followed
FLOOR, HALVED = 0.68, 0.43  # of the least error by the cells (ControlCells.floor), and by half as many each way
BY_QUALITY = {"draft": (1.5, 0.012), "standard": (1.0, 0.002), "fine": (0.7, 0.004)}  # times that, and what is left
SEAM = 7.0  # pixels; a valley of the tool's radius that moves light by less within a cell is narrower than it need be
ENOUGH, BEYOND = 5.0, 1.4  # cells a pixel; more of them lower the RRMSD by that factor at most, and that once
MOST_GAINED = 0.43  # times the RRMSD of the portrait with 1025 control points instead of 513, the largest gain known
DIM = 1e-3  # of the mean flux; tiles of less are taken for the mean


@dataclass(frozen=True)
class Candidate:
    """What a net would come to."""

    net: Sides
    rrmsd: float
    seconds: float  # on two cores of pace 1
    memory_gb: float
    moved: float = math.inf  # pixels, see `moved`

    def over(self, other: Candidate) -> tuple[float, float]:
        """Return its RRMSD and its time over those of another: `plan` predicts both better than they are known here."""
        return self.rrmsd / other.rrmsd, self.seconds / other.seconds


@dataclass(frozen=True)
class Choice:
    """The net that is chosen, among all that are possible from coarse to fine."""

    possible: tuple[Candidate, ...]
    number: int  # of the chosen one
    limit: str = ""  # what keeps it from being larger, beside its worth; "": nothing

    @property
    def net(self) -> Sides:
        """Control points a side, or along x and along y."""
        return self.possible[self.number].net

    @property
    def line(self) -> str:
        """What is chosen, and what more and fewer would give; one line."""
        chosen, around = self.possible[self.number], []
        for step, word in ((1, "more"), (-1, "fewer")):
            if 0 <= self.number + step < len(self.possible):
                other = self.possible[self.number + step]
                less, longer = map(about, other.over(chosen))
                factors = f"about {less} times the RRMSD in {longer} times the time"
                around.append(f"{word}, {size_text(other.net)}, would come to {factors}")
        return "; ".join(filter(None, (f"{size_text(chosen.net)} control points are chosen", *around, self.limit)))

    def facts(self) -> dict[str, Any]:
        """The choice for JSON, each net by its RRMSD and time over those of the chosen one."""
        chosen = self.possible[self.number]
        factors = [(each.net, *map(two_digits, each.over(chosen))) for each in self.possible]
        return {
            "possible": [dict(zip(("net", "times_rrmsd", "times_seconds"), each, strict=True)) for each in factors],
            "number": self.number,
            "limit": self.limit,
        }


def with_net(scene: Scene) -> tuple[Scene, Choice | None]:
    """The scene with the net that is chosen for it; a scene that states one as it is, and None.

    SceneError if no light reaches the back.
    """
    if scene.lens.back.control_points is not None:
        return scene, None
    levels = scene.tailoring.levels
    if levels is not None:  # they say it
        return scene.changed({KEY: levels[-1]}), None
    choice = chosen(scene)
    return scene.changed({KEY: choice.net}), choice


def chosen(scene: Scene) -> Choice:
    """The choice for a scene without a net; of several targets that which asks for the finest one."""
    choices = (_chosen(each) for each in scene.single_target_scenes())
    return max(choices, key=lambda choice: math.prod(as_pair(choice.net)))


def _chosen(scene: Scene) -> Choice:
    """The choice for a scene of one target."""
    tried = [scene.changed({KEY: net}) for net in nets(scene)]
    lens = coarse_lens(tried[0])
    light, image = cells_of_a_mm2(tried[0], lens), blurred(tried[0], lens)
    a_pixel = [light.a_pixel.sum() / math.prod(each.lens.cells) / light.target.size for each in tried]  # on average
    candidates: list[Candidate] = []
    for each, cells, coarser_cells in zip(tried, a_pixel, [0.0, *a_pixel], strict=False):
        if coarser_cells > ENOUGH:
            break
        likely = rrmsd(light, each, image)
        if candidates and cells > ENOUGH:
            likely = max(likely, candidates[-1].rrmsd / BEYOND)
        candidates.append(Candidate(each.lens.back.net, likely, usual(each).total, memory_gb(each), moved=moved(each)))
    possible, limit = _possible(scene, candidates)
    first = next(k for k, each in enumerate(possible) if not any(_worth(each, other) for other in possible[k + 1 :]))
    return Choice(possible, first, limit if first == len(possible) - 1 else "")


def gain(scene: Scene, finer: Scene, lenses: Sequence[Lens]) -> float:
    """Times the RRMSD of a scene that it has with a finer net, for the target that gains least.

    lenses: a coarse one for each target.
    """
    found = []
    for one, other, lens in zip(scene.single_target_scenes(), finer.single_target_scenes(), lenses, strict=True):
        light, image = cells_of_a_mm2(one, lens), blurred(one, lens)
        few, many = (rrmsd(light, each, image) for each in (one, other))
        found.append(many / few)
    return min(max(*found, MOST_GAINED), 1.0)


def _worth(coarse: Candidate, fine: Candidate) -> bool:
    """Is a finer net worth its time beside a coarser one?"""
    less, longer = coarse.rrmsd / fine.rrmsd, fine.seconds / coarse.seconds
    return not any(less <= gain and longer >= time for gain, time in WORTH)


def _possible(scene: Scene, candidates: list[Candidate]) -> tuple[tuple[Candidate, ...], str]:
    """Those that tool, time and memory allow, the coarsest in any case; and which of them leaves larger ones out."""
    most, room, radius = scene.tailoring.max_time, ROOM * psutil.virtual_memory().total / 1e9, scene.lens.tool_radius
    bounds = (
        (f"lens.tool_radius = {radius} has no use for more", lambda each: each.moved >= SEAM),
        (f"tailoring.max_time = {most} leaves no time for more", lambda each: most is None or each.seconds <= most),
        ("the memory of this machine is too little for more", lambda each: each.memory_gb <= room),
    )
    limit = ""
    for reason, fits in bounds:
        fewer = [each for each in candidates if fits(each)] or candidates[:1]
        candidates, limit = fewer, reason if len(fewer) < len(candidates) else limit
    return tuple(candidates), limit


def moved(scene: Scene) -> float:
    """Pixels by which the tightest valley that the tool makes moves light on the target within a cell; inf: any.

    p L (n - 1) / R of a cell of pitch p behind a throw L; a mirror turns light by twice its slope.  Where light
    has to part, a seam is as wide as the tool makes it, and much finer cells do not narrow it.
    """
    radius, target = scene.lens.tool_radius, scene.target
    if radius is None:
        return math.inf
    turn = max(scene.lens.passes.deflection(face, scene.index) for face in scene.lens.tailored_faces)
    throw = abs(target.screen.plane.per_radian(scene.lens.back.z)) * turn / radius
    return throw * math.sqrt(math.prod(scene.lens.cells)) * math.sqrt(math.prod(target.screen.per_unit))


def nets(scene: Scene) -> list[Sides]:
    """The nets that are tried, from coarse to fine: of an oblong lens with square cells."""
    half_x, half_y = scene.lens.outline.half_extent
    if max(half_x, half_y) <= NEARLY * min(half_x, half_y):
        return list(SQUARE)
    return [coarser(spread(points, half_x, half_y), MAX_CONTROL_POINTS) for points in SQUARE]


@torch.no_grad()
def cells_of_a_mm2(scene: Scene, lens: Lens) -> ControlCells:
    """The area (mm²) of the back that lights each pixel, by the flux that the target wants there: cells of 1 mm².

    lens: a coarse one for the scene, whose light tells what flux density the light for each part of the target has as
    it crosses the back.
    """
    light = max(scene.with_source_scaled(0.0).channels(), key=lambda channel: channel.weight)
    lens, screen, target = light.through(lens), scene.target.screen, scene.target.irradiance()
    tiles = replace(screen, pixels=tuple(-(-n // TILE_PIXELS) for n in screen.pixels))
    tubes = launch_tubes(light.source, lens, TUBES)
    x, y = cross(tubes.rays, lens.interfaces[lens.freeform[0]]).rays.position[:2]
    landed = tubes.landing(lens, screen.plane)
    flux, corners = tubes.arriving_flux(landed), tiles.pixels_of(landed.position.double())
    area = torch.where(flux > 0, area_of(x, y).double(), torch.zeros_like(flux))
    area, flux = (
        gaussian_filter(collect(corners, carried, tiles.shape)[0].cpu().numpy().clip(0), 1.0, mode="nearest")
        for carried in (area, flux)
    )
    mean = area.sum() / flux.sum() if flux.sum() > 0 else 0.0
    per_flux = np.where(flux > DIM * flux.mean(), area / np.maximum(flux, 1e-300), mean)  # mm² of a unit of flux
    whole = float(flux.sum())
    rows, columns = target.shape
    over_pixels = np.kron(per_flux, np.ones((TILE_PIXELS, TILE_PIXELS)))[:rows, :columns]
    return ControlCells(whole * target * over_pixels, target)


def rrmsd(light: ControlCells, scene: Scene, image: float = 0.0) -> float:
    """RRMSD of a scene with its net, roughly: detail that its cells cannot make, or make badly, and the rest.

    image: RRMSD of the target blurred by the source's size.  Fitted to designs in standard quality, of which half
    keep to 1.3 times this, and nine of ten to 2 times; drafts and fine designs are a little further off.
    """
    factor, rest = BY_QUALITY.get(scene.tailoring.quality, BY_QUALITY["standard"])
    width, height = scene.lens.cells
    finer = 1 / math.sqrt(width * height)
    other_tiles = tuple(slice(TILE_PIXELS // 2 if side > TILE_PIXELS // 2 else 0, None) for side in light.target.shape)
    between = replace(light, a_pixel=light.a_pixel[other_tiles], target=light.target[other_tiles])
    floors = (FLOOR * light.floor(finer), FLOOR * between.floor(finer))
    halved = (HALVED * light.floor(finer / 2), HALVED * between.floor(finer / 2))
    by_net = factor * math.hypot(*floors, *halved) / math.sqrt(2) + rest
    return math.hypot(by_net, UNDONE * image)
