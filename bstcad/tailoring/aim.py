"""Where each ray should go: from source, lens and picture to a transport problem, and from its map to aim points."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bstcad.optics import sampling
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.rays import Rays
from bstcad.optics.simulation import arrive_at_back, clear_window, simulate
from bstcad.optics.sources import Source
from bstcad.optics.trace import trace
from bstcad.transport.density import Density
from bstcad.transport.mapping import Frame, Mapping, Progress, solve

SUBCELLS = 2  # each way; rays that decide how much of a cell's light gets through the lens
MARGIN = 0.08  # of the target's side: light that lands no further outside is brought back by the feedback
FLOOR = 1e-3  # of the mean; keeps the feedback's densities positive
FEEDBACK_ITERATIONS = 15


@torch.no_grad()
def source_density(source: Source, lens: Lens, n: int) -> tuple[Density, Frame]:
    """The flux that gets through both faces, on n x n cells of a square in the plane of the front's vertex."""
    area = clear_window(source, lens)
    side = max(area.width, area.height)
    x, y = sampling.grid(Rectangle(side, side), n * SUBCELLS)
    flux = source.irradiance(x, y, lens.front.z)
    flux = flux * arrive_at_back(source.rays(x, y, lens.front.z, 1.0), lens)
    flux = flux.view(n, SUBCELLS, n, SUBCELLS).mean((1, 3))
    return Density.of(flux.cpu().numpy()), Frame((0.0, 0.0), side)


def around(screen: Screen, margin: float, pixels: int) -> Screen:
    """A square screen with the target in its middle, wider than the target's longer side by `margin` of it each way."""
    centre = [(low + high) / 2 for low, high in (screen.x, screen.y)]
    half = max(high - low for low, high in (screen.x, screen.y)) * (0.5 + margin)
    (x0, x1), (y0, y1) = ((c - half, c + half) for c in centre)
    return Screen(screen.z, (x0, x1), (y0, y1), pixels)


def frame(square: Screen) -> Frame:
    """The square screen as the unit square of a transport problem."""
    return Frame(((square.x[0] + square.x[1]) / 2, (square.y[0] + square.y[1]) / 2), square.x[1] - square.x[0])


def target_density(picture: np.ndarray, screen: Screen, square: Screen, floor: float) -> Density:
    """The picture (pixels, pixels), row 0 = y max, on the cells of `square`; at least `floor` of its mean inside it."""
    side = square.x[1] - square.x[0]
    width, height = ((high - low) / side for low, high in (screen.x, screen.y))
    return Density.of_picture(picture, width, height, square.pixels, floor)


def map_to_target(
    source: Source, lens: Lens, picture: np.ndarray, screen: Screen, n: int, iterations: int, progress: Progress
) -> Mapping:
    """The transport map from the plane of the front's vertex (mm) to the target (mm)."""
    density, source_frame = source_density(source, lens, n)
    square = around(screen, 0.0, n)
    wanted = target_density(picture, screen, square, TARGET_FLOOR)
    return solve(density, wanted, source_frame, frame(square), iterations=iterations, progress=progress)


def aim_points(mapping: Mapping, x: Tensor, y: Tensor) -> Tensor:
    """Where the map sends the points (x, y) (mm): (2, …) mm, like x."""
    sent = mapping(x.detach().cpu().double().numpy(), y.detach().cpu().double().numpy())
    return torch.stack([torch.from_numpy(np.ascontiguousarray(s)) for s in sent]).to(x)


def correct(
    source: Source, lens: Lens, rays: Rays, picture: np.ndarray, screen: Screen, n: int, seed: int, progress: Progress
) -> Tensor:
    """Transport feedback: aim points (2, …) that undo what the lens does wrong.

    The map from the simulated irradiance to the wanted one is small; applied to where the rays land now, it asks for a
    change that an integrable surface can follow better than the first map, of which only the gradient part survived.
    """
    square = around(screen, MARGIN, n)
    found = simulate(source, lens, square, 4 * n, seed).tent.cpu().numpy()
    here = Density.of_picture(found, 1.0, 1.0, n, FLOOR)
    wanted = target_density(picture, screen, square, FLOOR)
    mapping = solve(here, wanted, frame(square), frame(square), iterations=FEEDBACK_ITERATIONS, progress=progress)
    landed = trace(rays, lens, screen.z)
    return aim_points(mapping, *landed.position)
