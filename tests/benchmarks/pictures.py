"""Pictures of the scenes in net_scenes.py and geometry_scenes.py: linear irradiance, row 0 the top.

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


def _bar_code(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Dark bars, one to four modules wide, on a lit label."""
    widths = np.random.default_rng(11).integers(1, 5, 41)
    dark = np.pad(np.repeat(np.arange(41) % 2 == 0, widths), 8)
    bars = dark[((x + 1) / 2 * (len(dark) - 1)).round().astype(int)]
    return np.where(bars & (np.abs(y) < 0.75), DIM, 1.0)


def _emblem(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A ring with a triangle in it, cut by two bars, and a disc above."""
    ring = (r > 0.72) & (r < 0.88)
    triangle = (y > -0.45) & (y < 0.35 - 1.6 * np.abs(x))
    bars = (np.abs(y + 0.1) < 0.03) | (np.abs(y + 0.25) < 0.03)
    disc = np.hypot(x, y - 0.5) < 0.11
    return np.where(ring | (triangle & ~bars) | disc, 1.0, DIM)


def _contours(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A map of two hills and a valley: steps of tint, and a dark line at each."""
    height = 0.3 * x + np.exp(-3 * ((x - 0.35) ** 2 + (y - 0.3) ** 2)) + 0.8 * np.exp(-4 * ((x + 0.5) ** 2 + y**2))
    height -= 0.5 * np.exp(-5 * ((x - 0.2) ** 2 + (y + 0.6) ** 2))
    level = 0.05 + 8.9 * (height - height.min()) / np.ptp(height)
    steepness = np.hypot(*np.gradient(level, 2 / (SIDE - 1)))
    line = np.abs(level - level.round()) < 0.008 * steepness
    return np.where(line, 0.12, 0.3 + 0.08 * np.floor(level))


def _keys(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Four rows of round keys, each row moved a little, and a long one below."""
    away = np.hypot((np.abs(x) - 0.45).clip(0), y + 0.7)
    for row in range(4):
        for column in range(8):
            away = np.minimum(away, np.hypot(x + 0.84 - 0.22 * column - 0.04 * row, y - 0.75 + 0.33 * row))
    return DIM + 1 / (1 + np.exp((away - 0.08) / 0.008))


def _polygons(x: np.ndarray, y: np.ndarray, seed: int, number: int) -> np.ndarray:
    """Even polygons of three to six corners, each of one tint, one on the other."""
    draw, picture = np.random.default_rng(seed), np.full(x.shape, 0.1)
    for _ in range(number):
        (x0, y0), radius, corners = draw.uniform(-0.7, 0.7, 2), draw.uniform(0.12, 0.4), draw.integers(3, 7)
        turn, tint = draw.uniform(0, 6), draw.uniform(0.2, 1)
        angle = np.mod(np.arctan2(y - y0, x - x0) - turn, 2 * np.pi / corners) - np.pi / corners
        inside = np.hypot(x - x0, y - y0) * np.cos(angle) < radius * np.cos(np.pi / corners)
        picture = np.where(inside, tint, picture)
    return picture


def _discs(x: np.ndarray, y: np.ndarray, seed: int, number: int, edge: float) -> np.ndarray:
    """Lit discs of many sizes; edge: how soft."""
    draw, picture = np.random.default_rng(seed), np.full(x.shape, 0.05)
    for _ in range(number):
        (x0, y0), radius = draw.uniform(-0.9, 0.9, 2), draw.uniform(0.03, 0.2)
        away = (np.hypot(x - x0, y - y0) - radius) / edge
        picture = np.maximum(picture, draw.uniform(0.4, 1) / (1 + np.exp(away.clip(-50, 50))))
    return picture


def _strokes(x: np.ndarray, y: np.ndarray, seed: int, number: int, width: float) -> np.ndarray:
    """Lit strokes, each a parabola through three places."""
    draw, away, along = np.random.default_rng(seed), np.full(x.shape, np.inf), np.linspace(0, 1, 400)[:, None]
    for _ in range(number):
        first, last, drawn_to = draw.uniform(-0.9, 0.9, (3, 2))
        stroke = (1 - along) ** 2 * first + 2 * along * (1 - along) * drawn_to + along**2 * last
        near, _ = cKDTree(stroke).query(np.stack((x, y), -1))
        away = np.minimum(away, near)
    return DIM + np.exp(-((away / width) ** 4))


def _frame(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """A lit square frame on a dark ground."""
    out = np.maximum(np.abs(x), np.abs(y))
    return np.where((out > 0.6) & (out < 0.85), 1.05, 0.05)


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


def _hearts(x: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
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


SAMPLES = {"hopper": _hopper, "head": _head, "terrain": _terrain, "coast": _coast, "maze": _maze}  # have their own size

PATTERNS = {
    "bar code": _bar_code, "contours": _contours, "keys": _keys, "frame": _frame, "emblem": _emblem, "cog": _cog,
    "hearts": _hearts,
    "checks": lambda x, y, r: np.where((np.floor(4 * x) + np.floor(4 * y)) % 2, 1.0, 0.15),
    "spots": lambda x, y, r: 0.05 + np.exp(4 * (np.cos(9 * x) * np.cos(9 * y) - 1)),
    "slope": lambda x, y, r: 0.1 + 0.9 * (x + 1) / 2,
    "glow": lambda x, y, r: 0.1 + np.exp(-3 * r**2),
    "vignette": lambda x, y, r: 1 - 0.4 * r**2,
    "star": lambda x, y, r: np.where(r < 0.55 + 0.35 * np.cos(5 * np.arctan2(x, y)), 1.0, 0.05),
    "islands": lambda x, y, r: np.where(_noise(len(x), -2.0) > 0, 1.0, 0.1),
    "dusk": lambda x, y, r: np.exp(-1.5 * (y + 0.3 * x)),
    "sheen": lambda x, y, r: 0.15 + np.exp(-(((x - y - 0.3) / 0.7) ** 2)),
    "stripes": lambda x, y, r: np.where(np.sin(14 * (x + 0.4 * y)) > 0, 1.2, 0.2),
    "corner": lambda x, y, r: 0.1 + (x + 1) * (y + 1.2),
    "many polygons": lambda x, y, r: _polygons(x, y, 2, 20),
    "discs": lambda x, y, r: _discs(x, y, 4, 12, 0.01),
    "hills": lambda x, y, r: np.exp(_noise(len(x), -2.0, 2)),
    "strokes": lambda x, y, r: _strokes(x, y, 1, 6, 0.03),
    "many strokes": lambda x, y, r: _strokes(x, y, 2, 14, 0.015),
    "dots": lambda x, y, r: np.where(np.cos(16 * x) * np.cos(16 * y) > 0.45 * (x + y), 1.0, DIM),
    "cross": lambda x, y, r: np.where((np.abs(x) < 0.15) | (np.abs(y) < 0.15), 1.1, 0.1),
    "bullseye": lambda x, y, r: np.where(np.cos(25 * r) > 0, 1.1, 0.1),
}  # fmt: skip
