"""Wang et al. 2023's transport map: from the front's vertex plane to the target, and with it the aim of each ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.planes import TargetPlane, TiltedPlane
from bstcad.optics.simulation import arrive_at_back, clear_window
from bstcad.optics.sources import Source
from bstcad.tailoring import slope_map
from bstcad.tailoring.slope_map import pixel_corners, spread_density
from bstcad.transport.bfm import Step
from bstcad.transport.density import Density
from bstcad.transport.mapping import Frame, Mapping, TransportMap, solve

Progress = Callable[[Step], None]

SUBCELLS = 2  # each way; rays that decide how much of a cell's light gets through the lens
TARGET_FLOOR = 1e-3  # of the mean: flux that the map may spend on black parts


@torch.no_grad()
def source_density(source: Source, lens: Lens, n: int) -> tuple[Density, Frame]:
    """The flux that gets through both faces, on n x n cells of a square in the plane of the front's vertex."""
    area = clear_window(source, lens)
    side = max(area.width, area.height)
    x, y = (t.to(lens.like.device) for t in sampling.grid(Rectangle(side, side), n * SUBCELLS))
    flux = source.irradiance(x, y, lens.entrance.z)
    flux = flux * arrive_at_back(source.rays(x, y, lens.entrance.z, 1.0), lens)
    flux = flux.cpu().numpy().reshape(n, SUBCELLS, n, SUBCELLS).mean((1, 3))
    return Density.from_values(flux), Frame((0.0, 0.0), side)


def square_frame(screen: Screen) -> Frame:
    """The square of the screen's longer side, centred on it: where `Density.from_picture` puts a picture."""
    side = max(screen.x[1] - screen.x[0], screen.y[1] - screen.y[0])
    return Frame(((screen.x[0] + screen.x[1]) / 2, (screen.y[0] + screen.y[1]) / 2), side)


def picture_density(picture: np.ndarray, screen: Screen, n: int, floor: float) -> Density:
    """A picture (rows, columns) that fills the screen, on n x n cells of its square; lifted to `floor` of its mean."""
    width, height = screen.x[1] - screen.x[0], screen.y[1] - screen.y[0]
    return Density.from_picture(picture, n, width=width, height=height, floor=floor)


def map_to_target(
    source: Source, lens: Lens, picture: np.ndarray, screen: Screen, n: int, iterations: int, progress: Progress
) -> Mapping:
    """The transport map from the plane of the front's vertex (mm) to the target (mm), on n x n cells.

    To a tilted target the map leads in the coordinates of the level plane through its middle, on which each place is
    where the front's vertex sees it: in those of the plane itself the map would be nowhere near a gradient of heights.
    """
    density, source_frame = source_density(source, lens, n)
    if isinstance(plane := screen.plane, TiltedPlane):
        wanted, frame = spread_density(picture, plane.seen(*pixel_corners(screen), lens.front.z), n)
    else:
        wanted, frame = picture_density(picture, screen, n, TARGET_FLOOR), square_frame(screen)
    return solve(density, wanted, source_frame, frame, iterations=iterations, progress=progress)


def sent_from(mapping: Mapping, lens: Lens, screen: Screen) -> TransportMap:
    """The inverse of such a map at corners of the target's pixels."""
    corners = pixel_corners(screen)
    if isinstance(plane := screen.plane, TiltedPlane):
        corners = plane.seen(*corners, lens.front.z)
    return replace(slope_map.sent_from(mapping.inverse(*corners), screen), plane="entrance")


def aim_points(mapping: Mapping, lens: Lens, plane: TargetPlane, x: Tensor, y: Tensor) -> Tensor:
    """Where on the plane the map sends the points (x, y) (mm): (2, …) mm, like x."""
    sent = mapping(x.detach().cpu().double().numpy(), y.detach().cpu().double().numpy())
    if isinstance(plane, TiltedPlane):
        sent = plane.found(*sent, lens.front.z)
    return torch.stack([torch.from_numpy(np.ascontiguousarray(s)) for s in sent]).to(x)
