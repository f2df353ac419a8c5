"""Pictures as people have them: each ends on the target, and in its figure, upright, unmirrored, in its own tones.

One drawing, saved in many ways: letters, a circle, and a ramp of greys; what is expected is reckoned from the drawing.
"""

from __future__ import annotations

import numpy as np
import pillow_heif
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, ImageDraw, ImageFont

from bstcad.report.light_figures import HEADROOM, View, irradiance_triptych
from bstcad.scene.scene import load
from bstcad.scene.tones import from_srgb, to_srgb
from tests.scene.test_tones import png

WIDTH, HEIGHT = 300, 400  # of the whole drawing; the square in its middle is what a square target shows
TOP = (HEIGHT - WIDTH) // 2
RAMP = (0, 36, 73, 109, 146, 182, 219, 255)  # sRGB
PLACES = [(20 + 260 * (i + 0.5) / len(RAMP), TOP + 255) for i in range(len(RAMP))]  # of their middles, in the drawing
PIXELS = 128
CAUSTIC = "templates/caustic_letters.toml"  # a square target, seen from the lens


def drawing() -> Image.Image:
    """Grey ground, black strips above and below the middle square, in which are F7, a circle and the ramp."""
    image = Image.new("L", (WIDTH, HEIGHT), 90)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, WIDTH, TOP - 1), fill=0)
    draw.rectangle((0, HEIGHT - TOP, WIDTH, HEIGHT), fill=30)
    draw.text((25, TOP + 10), "F7", fill=255, font=ImageFont.load_default(150))
    draw.ellipse((215, TOP + 50, 275, TOP + 110), fill=190)
    for grey, (x, y) in zip(RAMP, PLACES, strict=True):
        draw.rectangle((x - 15, y - 25, x + 15, y + 25), fill=grey)
    return image


def middle() -> np.ndarray:
    """The numbers of its middle square."""
    return np.asarray(drawing())[TOP : TOP + WIDTH]


def camera(path):
    """Held upright: the camera stores it lying, and how it was held."""
    exif = Image.Exif()
    exif[0x0112] = 6  # the right-hand side was up: turn it clockwise
    drawing().rotate(90, expand=True).convert("RGB").save(path, "JPEG", quality=97, subsampling=0, exif=exif)


def palette(path):
    drawing().convert("RGB").quantize(64).save(path, "PNG")


def deep(path):
    """Sixteen bits of linear light."""
    light = np.round(from_srgb(np.asarray(drawing()) / 255) * 65535).astype(np.uint16)
    path.write_bytes(png(light[..., None].repeat(3, axis=-1)))


def web(path):
    drawing().convert("RGB").save(path, "WEBP", lossless=True)


def heic(path):
    pillow_heif.from_pillow(drawing().convert("RGB")).save(path, quality=95)


def logo(path):
    """Black on nothing, as logos for white paper are: all it shows is where it is opaque, and how much."""
    image = Image.new("LA", (WIDTH, HEIGHT), (0, 0))
    image.putalpha(drawing())
    image.save(path, "PNG")


def bitmap(path):
    drawing().save(path, "BMP")


FILES = {"camera": camera, "palette": palette, "deep": deep, "web": web, "heic": heic, "logo": logo, "bitmap": bitmap}


@pytest.fixture(params=FILES)
def scene(request, tmp_path):
    FILES[request.param](tmp_path / "photo")
    return load(CAUSTIC, {"target.image": str(tmp_path / "photo"), "target.pixels": PIXELS})


def averaged(values: np.ndarray) -> np.ndarray:
    """Area means by summed areas, another way than the program's."""
    for _ in range(2):
        summed = np.concatenate([np.zeros((1, values.shape[1])), values.cumsum(0)])
        edges = np.linspace(0, len(values), PIXELS + 1)
        below = np.floor(edges).astype(int)
        cut = summed[below] + (edges - below)[:, None] * np.vstack([values, values[-1:]])[below]
        values = (np.diff(cut, axis=0) * PIXELS / len(values)).T
    return values


def likeness(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def test_the_target_has_the_light_of_the_drawing_the_right_way_round(scene):
    seen = scene.target.irradiance()[:, ::-1]  # by a person at the lens: x max is at the left
    wanted = averaged(from_srgb(middle() / 255))
    assert likeness(seen, wanted) > 0.999
    levels = (to_srgb(np.clip(light / light.max(), 0, 1)) * 255 for light in (seen, wanted))
    assert np.abs(np.subtract(*levels)).mean() < 3.0  # of 255: JPEG, HEIC and 64 colours have their own
    for other in (np.rot90(turned, k) for turned in (wanted, wanted[:, ::-1]) for k in range(4)):
        assert other is wanted or np.array_equal(other, wanted) or likeness(seen, other) < 0.6


def test_the_figure_shows_the_tones_of_the_drawing_where_they_belong(scene):
    target = scene.target
    flux = target.irradiance()
    figure = irradiance_triptych(flux, flux, View(target.x, target.y, target.seen_from))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    shown, axes = np.asarray(canvas.buffer_rgba())[..., 0] / 255.0, figure.axes[0]
    box = axes.get_window_extent()
    assert box.width == pytest.approx(box.height, rel=0.02)  # a circle is round
    scale = from_srgb(middle() / 255).max() / (averaged(from_srgb(middle() / 255)).max() * HEADROOM)
    for grey, (x, y) in zip(RAMP, PLACES, strict=True):
        column, row = box.x0 + box.width * x / WIDTH, box.y1 - box.height * (y - TOP) / WIDTH
        found = shown[shown.shape[0] - 1 - int(row), int(column)]
        assert found == pytest.approx(to_srgb(from_srgb(grey / 255) * scale), abs=5 / 255), f"grey {grey}"
