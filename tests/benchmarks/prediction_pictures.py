"""Pictures of the scenes in prediction_scenes.py: linear irradiance, row 0 the top.

Patterns are drawn on the square from -1 to 1 along x (to the right) and y (up); r is the distance from its middle.
"""

from __future__ import annotations

import numpy as np

SIDE = 512  # pixels of a pattern
DIM = 0.08  # of the lit parts: the ground of drawings


def drawn(name: str) -> np.ndarray:
    """(rows, columns) irradiance of one of the patterns, or of a picture that scikit-image brings along."""
    if name in PATTERNS:
        y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
        return PATTERNS[name](x, y, np.hypot(x, y))
    from skimage import data

    picture = np.asarray(getattr(data, name)(), dtype=float)
    return picture.mean(2) if picture.ndim == 3 else picture


def _noise(side: int, power: float) -> np.ndarray:
    """Noise of mean 0 and variance 1, the amplitude of whose waves falls with a power of their number."""
    waves = np.fft.fft2(np.random.default_rng(7).standard_normal((side, side)))
    number = np.hypot(*np.meshgrid(*[np.fft.fftfreq(side, 1 / side)] * 2))
    waves[number > 0] *= number[number > 0] ** power
    waves[0, 0] = 0
    noise = np.fft.ifft2(waves).real
    return noise / noise.std()


def _faces() -> np.ndarray:
    """Sixteen small photographs of faces side by side."""
    from skimage import data

    faces = data.lfw_subset()
    return np.block([[faces[4 * i + j] for j in range(4)] for i in range(4)])


def _motorcycle() -> np.ndarray:
    """A photograph of a motorcycle in a workshop, three wide to two high; no shadow below a twentieth of the lights."""
    from skimage import data

    photograph = data.stereo_motorcycle()[0].mean(2)
    return photograph.clip(photograph.max() / 20)


def _relief() -> np.ndarray:
    """How near everything is in that photograph: even slopes with steps between them."""
    from scipy.ndimage import distance_transform_edt
    from skimage import data

    disparity = data.stereo_motorcycle()[2].astype(float)
    nearest = distance_transform_edt(~np.isfinite(disparity), return_distances=False, return_indices=True)
    return disparity[tuple(nearest)]  # what the cameras did not see is as its surroundings


def _bar_code(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Dark bars, one to four modules wide, on a lit label."""
    widths = np.random.default_rng(11).integers(1, 5, 41)
    dark = np.pad(np.repeat(np.arange(41) % 2 == 0, widths), 8)
    bars = dark[((x + 1) / 2 * (len(dark) - 1)).round().astype(int)]
    return np.where(bars & (np.abs(y) < 0.75), DIM, 1.0)


def _matrix_code() -> np.ndarray:
    """Dark and lit modules, 29 x 29, with a square eye in three corners and a lit rim."""
    dark = np.random.default_rng(12).random((29, 29)) < 0.5
    rows, columns = np.indices(dark.shape)
    for row, column in ((3, 3), (3, 25), (25, 3)):
        rings = np.maximum(np.abs(rows - row), np.abs(columns - column))
        dark[rings <= 4] = np.isin(rings[rings <= 4], (0, 1, 3))
    return np.kron(np.where(np.pad(dark, 3), DIM, 1.0), np.ones((14, 14)))


def _emblem(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A ring with a triangle in it, cut by two bars, and a disc above."""
    ring = (r > 0.72) & (r < 0.88)
    triangle = (y > -0.45) & (y < 0.35 - 1.6 * np.abs(x))
    bars = (np.abs(y + 0.1) < 0.03) | (np.abs(y + 0.25) < 0.03)
    disc = np.hypot(x, y - 0.5) < 0.11
    return np.where(ring | (triangle & ~bars) | disc, 1.0, DIM)


BOAT = (  # corners of each line of the drawing
    ((-0.9, -0.55), (0.9, -0.55)),
    ((-0.6, -0.3), (0.65, -0.3), (0.4, -0.55), (-0.45, -0.55), (-0.6, -0.3)),
    ((0.0, -0.3), (0.0, 0.75)),
    ((0.08, -0.2), (0.08, 0.65), (0.6, -0.2), (0.08, -0.2)),
    ((-0.08, -0.2), (-0.08, 0.5), (-0.5, -0.2), (-0.08, -0.2)),
    ((-0.85, -0.75), (-0.55, -0.68), (-0.25, -0.75), (0.05, -0.68), (0.35, -0.75), (0.65, -0.68)),
)


def _line_drawing(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A sailing boat and the sun in lit lines."""
    away = np.abs(np.hypot(x + 0.6, y - 0.6) - 0.18)
    for line in BOAT:
        for (x0, y0), (x1, y1) in zip(line, line[1:], strict=False):
            along = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / ((x1 - x0) ** 2 + (y1 - y0) ** 2)
            along = along.clip(0, 1)
            away = np.minimum(away, np.hypot(x - x0 - along * (x1 - x0), y - y0 - along * (y1 - y0)))
    return DIM + np.exp(-((away / 0.02) ** 4))


BUST = (  # x, y, half width, half height, how much brighter (or darker) than what is behind
    (0.0, 0.15, 0.36, 0.5, 0.75),
    (0.0, 0.62, 0.42, 0.22, -0.45),
    (-0.15, 0.22, 0.09, 0.05, -0.4),
    (0.15, 0.22, 0.09, 0.05, -0.4),
    (0.03, 0.03, 0.05, 0.14, 0.2),
    (0.0, -0.14, 0.13, 0.04, -0.3),
    (0.0, -0.85, 0.7, 0.4, 0.55),
    (0.0, -0.45, 0.16, 0.12, 0.2),
)


def _bust(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A head and shoulders of soft blobs before a ground that darkens towards the corners."""
    light = 0.45 - 0.15 * r**2
    for x0, y0, width, height, brighter in BUST:
        light += brighter * np.exp(-(((x - x0) / width) ** 2) - ((y - y0) / height) ** 2)
    return light.clip(DIM)


def _contours(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A map of two hills and a valley: steps of tint, and a dark line at each."""
    height = 0.3 * x + np.exp(-3 * ((x - 0.35) ** 2 + (y - 0.3) ** 2)) + 0.8 * np.exp(-4 * ((x + 0.5) ** 2 + y**2))
    height -= 0.5 * np.exp(-5 * ((x - 0.2) ** 2 + (y + 0.6) ** 2))
    level = 0.05 + 8.9 * (height - height.min()) / np.ptp(height)
    steepness = np.hypot(*np.gradient(level, 2 / (SIDE - 1)))
    line = np.abs(level - level.round()) < 0.008 * steepness
    return np.where(line, 0.12, 0.3 + 0.08 * np.floor(level))


def _keys(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Four rows of round keys, each row moved a little, and a long one below."""
    away = np.hypot((np.abs(x) - 0.45).clip(0), y + 0.7)
    for row in range(4):
        for column in range(8):
            away = np.minimum(away, np.hypot(x + 0.84 - 0.22 * column - 0.04 * row, y - 0.75 + 0.33 * row))
    return DIM + 1 / (1 + np.exp((away - 0.08) / 0.008))


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
    "faces": lambda x, y, r: _faces(),
    # of the kept-out scenes
    "motorcycle": lambda x, y, r: _motorcycle(),
    "relief": lambda x, y, r: _relief(),
    "bar code": lambda x, y, r: _bar_code(x, y),
    "matrix code": lambda x, y, r: _matrix_code(),
    "emblem": _emblem,
    "line drawing": lambda x, y, r: _line_drawing(x, y),
    "bust": _bust,
    "contours": lambda x, y, r: _contours(x, y),
    "keys": lambda x, y, r: _keys(x, y),
    "sheen": lambda x, y, r: 0.15 + np.exp(-(((x - y - 0.3) / 0.7) ** 2)),
}
