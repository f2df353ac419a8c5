"""Drawing of the figures of a report: one style, and PNG files of limited size.

Figures use the object interface of matplotlib (no window, no global state) and colours for colour-blind readers.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, VERMILION, GREEN = "#0072b2", "#d55e00", "#009e73"  # colours of Okabe and Ito
GREY, GLASS = "#6b6b6b", "#d6e8f2"
DARK_GROUND, DARK_TEXT = "#14181c", "#e6eaee"  # background and text of a page in dark mode
STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.6,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.3,
    "hatch.linewidth": 0.25,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.5,
}
DPI = 144
MARGIN = 0.06  # margin around a picture (inches)
MAX_PNG_BYTES = 300_000  # size above which a PNG is encoded again with fewer pixels (bytes)
MAX_PALETTE_COLOURS = 600  # largest number of colours that a palette of 256 shows without a visible difference


def styled(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate `draw` to run with STYLE, whatever the user's matplotlibrc states."""

    @functools.wraps(draw)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        import matplotlib

        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapper


def new_figure(width: float, height: float, layout: str = "constrained") -> Figure:
    """Return an empty figure, width x height (inches); layout "none": its axes are placed by hand, which is quicker."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    if (engine := figure.get_layout_engine()) is not None:
        engine.set(w_pad=0.08)
    return figure


def footnote(figure: Figure, text: str) -> None:
    """Write grey text under a figure."""
    figure.supxlabel(text, x=0.01, ha="left", fontsize=8, color=GREY)


@styled
def png(figure: Figure, ground: str = "#ffffff") -> bytes:
    """Return the figure as PNG on the colour `ground`, cropped to MARGIN, with fewer pixels if above MAX_PNG_BYTES."""
    picture = _encode(figure, DPI, ground)
    if len(picture) > MAX_PNG_BYTES:
        picture = _encode(figure, DPI * 0.95 * (MAX_PNG_BYTES / len(picture)) ** 0.5, ground)
    return picture


def darken(figure: Figure) -> Figure:
    """Recolour the text, axes and background of the figure for dark mode, and return the figure."""
    from matplotlib.text import Text

    figure.set_facecolor(DARK_GROUND)
    for axes in figure.axes:
        axes.set_facecolor(DARK_GROUND)
        axes.tick_params(colors=DARK_TEXT, which="both")
        for spine in axes.spines.values():
            spine.set_edgecolor(DARK_TEXT)
    for text in figure.findobj(Text):
        text.set_color(DARK_TEXT)
    return figure


def _encode(figure: Figure, dpi: float, ground: str) -> bytes:
    """Return PNG bytes at `dpi` without alpha, with a palette if the figure has at most MAX_PALETTE_COLOURS colours."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image, ImageChops, ImageOps

    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # a tight bounding box by matplotlib would draw everything twice
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    box = ImageChops.difference(picture, Image.new("RGB", picture.size, ground)).getbbox()
    picture = ImageOps.expand(picture.crop(box), round(MARGIN * dpi), ground)
    small = io.BytesIO()
    if picture.getcolors(MAX_PALETTE_COLOURS) is not None:
        picture = picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    picture.save(small, "PNG", compress_level=6)
    return small.getvalue()


def steps(name: str, count: int) -> Any:
    """Return a colour map of matplotlib in `count` equal steps: no visible loss, and PNG files a third as large."""
    import matplotlib

    return matplotlib.colormaps[name].resampled(count)


def round_up(value: float) -> float:
    """Return `value` rounded up to 1, 2 or 5 times a power of ten, as the end of a scale; 1 if it is not positive."""
    if value <= 0.0:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= value * (1 - 1e-12)))
