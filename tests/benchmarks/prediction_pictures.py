"""Pictures of the scenes in prediction_scenes.py: linear irradiance, row 0 the top.

Patterns are drawn on the square from -1 to 1 along x (to the right) and y (up); r is the distance from its middle.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

SIDE = 512  # pixels of a pattern
DIM = 0.08  # of the lit parts: the ground of drawings


def drawn(name: str) -> np.ndarray:
    """(rows, columns) irradiance of a pattern, or of a picture that scikit-image or Matplotlib brings along."""
    if name in PATTERNS:
        y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
        return PATTERNS[name](x, y, np.hypot(x, y))
    if name in SAMPLES:
        return SAMPLES[name]()
    from skimage import data

    picture = np.asarray(getattr(data, name)(), dtype=float)
    return picture.mean(2) if picture.ndim == 3 else picture


def _noise(side: int, power: float, seed: int = 7) -> np.ndarray:
    """Noise of mean 0 and variance 1, the amplitude of whose waves falls with a power of their number."""
    waves = np.fft.fft2(np.random.default_rng(seed).standard_normal((side, side)))
    number = np.hypot(*np.meshgrid(*[np.fft.fftfreq(side, 1 / side)] * 2))
    waves[number > 0] *= number[number > 0] ** power
    waves[0, 0] = 0
    noise = np.fft.ifft2(waves).real
    return noise / noise.std()


def _cells(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sixty cells, each the places nearest to a point, in even tints."""
    draw = np.random.default_rng(21)
    _, nearest = cKDTree(draw.uniform(-1, 1, (60, 2))).query(np.stack((x, y), -1))
    return draw.uniform(0.1, 1, 60)[nearest]


def _cog(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A cog wheel of fourteen teeth with six round holes and a hub."""
    angle = np.arctan2(y, x)
    wheel = r < np.where(np.cos(14 * angle) > 0, 0.86, 0.72)
    hole_angle = np.mod(angle, np.pi / 3) - np.pi / 6
    holes = np.hypot(r * np.cos(hole_angle) - 0.45, r * np.sin(hole_angle)) < 0.14
    return np.where(wheel & ~holes & (r > 0.12), 1.0, 0.12)


def _maze() -> np.ndarray:
    """Lit ways between dark walls, found by going on at random from where one can."""
    draw, side = np.random.default_rng(22), 12
    ways, stack = np.zeros((2 * side + 1, 2 * side + 1)), [(0, 0)]
    ways[1, 1] = 1
    while stack:
        row, column = stack[-1]
        near = [(row + down, column + right) for down, right in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        new = [(r, c) for r, c in near if 0 <= r < side and 0 <= c < side and not ways[2 * r + 1, 2 * c + 1]]
        if not new:
            stack.pop()
            continue
        to = new[draw.integers(len(new))]
        ways[2 * to[0] + 1, 2 * to[1] + 1] = ways[row + to[0] + 1, column + to[1] + 1] = 1
        stack.append(to)
    return np.kron(np.where(ways > 0, 1.0, DIM), np.ones((20, 20)))


def _sunset(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A sun low over the sea: a sky that darkens upwards, the disc, and its glitter on the waves."""
    sky = 0.25 + 0.5 * np.exp(-1.5 * (y + 0.2).clip(0)) + 0.9 * (np.hypot(x, y - 0.15) < 0.22)
    glitter = np.exp(-((x / (0.15 + 0.35 * (-0.2 - y).clip(0))) ** 2)) * (1 + np.sin(60 / (y - 0.1) + 9 * x))
    return np.where(y > -0.2, sky, 0.2 + 0.35 * glitter)


def _julia(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How far z² + c goes in a few dozen steps, c = -0.7 + 0.27 i: bright where it stays."""
    z, stayed = 1.5 * (x + 1j * y), np.zeros(x.shape)
    for _ in range(40):
        z = np.where(np.abs(z) < 4, z**2 - 0.7 + 0.27015j, z)
        stayed += np.exp(-np.abs(z))
    return 0.1 + stayed / stayed.max()


def _hearts(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Nine hearts in rows, bright in their middles."""
    across, up = np.mod(3 * (x + 1) / 2, 1) * 2.6 - 1.3, np.mod(3 * (y + 1) / 2, 1) * 2.6 - 1.2
    inside = 1 - across**2 - (up - 0.8 * np.sqrt(np.abs(across))) ** 2
    return 0.15 + 0.8 / (1 + np.exp(-8 * inside))


def _hopper() -> np.ndarray:
    """A photograph of Grace Hopper in uniform."""
    from matplotlib.cbook import get_sample_data
    from PIL import Image

    with get_sample_data("grace_hopper.jpg") as file:
        return np.asarray(Image.open(file).convert("L"), dtype=float)


def _head() -> np.ndarray:
    """A slice through a head, as a magnetic resonance scanner sees it, on a faint ground."""
    from matplotlib.cbook import get_sample_data

    with get_sample_data("s1045.ima.gz") as file:
        scan = np.frombuffer(file.read(), np.uint16).reshape(256, 256).astype(float)
    return scan + 0.05 * scan.max()


def _terrain() -> np.ndarray:
    """The height of hills and valleys at a fault."""
    from matplotlib.cbook import get_sample_data

    with get_sample_data("jacksboro_fault_dem.npz") as arrays:
        height = arrays["elevation"].astype(float)
    return height - height.min() + 0.2 * np.ptp(height)


def _coast() -> np.ndarray:
    """The height of land and sea floor: steps at coasts."""
    from matplotlib.cbook import get_sample_data

    with get_sample_data("topobathy.npz") as arrays:
        height = arrays["topo"][::-1].astype(float)
    return 0.15 + np.where(height > 0, 0.6, 0.0) + 0.4 * (height - height.min()) / np.ptp(height)


SAMPLES = {"hopper": _hopper, "head": _head, "terrain": _terrain, "coast": _coast}  # that Matplotlib brings along

PATTERNS = {
    "rings": lambda x, y, r: 1 + 0.6 * np.cos(14 * r),
    "checks": lambda x, y, r: np.where((np.floor(4 * x) + np.floor(4 * y)) % 2, 1.0, 0.15),
    "spots": lambda x, y, r: 0.05 + np.exp(4 * (np.cos(9 * x) * np.cos(9 * y) - 1)),
    "slope": lambda x, y, r: 0.1 + 0.9 * (x + 1) / 2,
    "ramp": lambda x, y, r: 0.2 + 0.8 * (y + 0.5 * x + 1.5) / 3,
    "glow": lambda x, y, r: 0.1 + np.exp(-3 * r**2),
    "wedge": lambda x, y, r: 0.15 + (np.arctan2(y, x) + np.pi) / (2 * np.pi) * np.clip(4 * r, 0, 1),
    "vignette": lambda x, y, r: 1 - 0.4 * r**2,
    "spiral": lambda x, y, r: 1 + 0.7 * np.cos(16 * r + 3 * np.arctan2(y, x)),
    "zone plate": lambda x, y, r: 0.1 + (np.cos(40 * r**2) > 0),
    "star": lambda x, y, r: np.where(r < 0.55 + 0.35 * np.cos(5 * np.arctan2(x, y)), 1.0, 0.05),
    "clouds": lambda x, y, r: np.exp(0.6 * _noise(len(x), -1.5)),
    "islands": lambda x, y, r: np.where(_noise(len(x), -2.0) > 0, 1.0, 0.1),
    "dusk": lambda x, y, r: np.exp(-1.5 * (y + 0.3 * x)),
    "sheen": lambda x, y, r: 0.15 + np.exp(-(((x - y - 0.3) / 0.7) ** 2)),
    "petals": lambda x, y, r: 1 + 0.8 * np.cos(7 * np.arctan2(y, x)) * np.exp(-3 * (r - 0.5) ** 2),
    "stripes": lambda x, y, r: np.where(np.sin(14 * (x + 0.4 * y)) > 0, 1.2, 0.2),
    "corner": lambda x, y, r: 0.1 + (x + 1) * (y + 1.2),
    "swirl": lambda x, y, r: 1 + 0.7 * np.sin(12 * r + 3 * np.arctan2(y, x)),
    "marble": lambda x, y, r: np.exp(0.5 * _noise(len(x), -1.2, 1)),
    "hills": lambda x, y, r: np.exp(_noise(len(x), -2.0, 2)),
    "felt": lambda x, y, r: np.exp(0.3 * _noise(len(x), -0.8, 3)),
    "fine dots": lambda x, y, r: np.where(np.cos(30 * x) * np.cos(30 * y) > 0.45 * (x + y), 1.0, DIM),
    "dots": lambda x, y, r: np.where(np.cos(16 * x) * np.cos(16 * y) > 0.45 * (x + y), 1.0, DIM),
    "cross": lambda x, y, r: np.where((np.abs(x) < 0.15) | (np.abs(y) < 0.15), 1.1, 0.1),
    "bullseye": lambda x, y, r: np.where(np.cos(25 * r) > 0, 1.1, 0.1),
    "fringes": lambda x, y, r: 1 + 0.9 * np.cos(20 * x),
    "folds": lambda x, y, r: 0.2 + 0.8 * np.abs(np.mod(5 * x + 3 * y, 2) - 1),
    "steps": lambda x, y, r: 0.1 + np.floor(4 * (x + 1)) / 8,
    "window": lambda x, y, r: 0.04 + np.exp(-(((x / 0.3) ** 2 + (y / 0.5) ** 2) ** 2)),
    # of the kept-out scenes
    "cells": lambda x, y, r: _cells(x, y),
    "cog": _cog,
    "maze": lambda x, y, r: _maze(),
    "sunset": _sunset,
    "julia": lambda x, y, r: _julia(x, y),
    "hearts": lambda x, y, r: _hearts(x, y),
}
