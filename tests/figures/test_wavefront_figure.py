"""The figure of a wavefront error: every place has its colour, and all numbers are stated."""

from dataclasses import replace

import numpy as np

from bstcad.figures.drawing import png
from bstcad.figures.wavefront_figure import wavefront_map
from bstcad.optics.trace.wavefront_error import OpdSize, WavefrontError
from tests.figures.test_figures import pixel_at

X, Y = np.linspace(-8.0, 8.0, 65), np.linspace(-4.0, 12.0, 65)
INSIDE = np.hypot(X, Y[:, None] - 4.0) < 7.5
ERROR = WavefrontError(
    40.0, 632.8, OpdSize(0.4, 2.0), OpdSize(0.123, 0.87), tilt=(12.0, -3.0), angle_rms=21.0, angle_max=77.0,
    floor=5.6e-11, flux=0.9, rays=1000, x=X, y=Y, opd=np.where(INSIDE, 0.05 * X + 0 * Y[:, None], np.nan),
)  # fmt: skip


def test_late_light_is_red_early_light_blue_and_no_light_white():
    figure = wavefront_map(ERROR)
    face = figure.axes[0]
    late, early, dark = (pixel_at(figure, face, *place) for place in ((6.0, 4.0), (-6.0, 4.0), (7.5, 11.5)))
    assert late[0] > late[2] + 0.2 and early[2] > early[0] + 0.2 and dark.min() == 1.0
    assert face.images[0].get_clim() == (-0.5, 0.5)


def test_the_figure_says_its_numbers_and_what_was_removed():
    figure = wavefront_map(ERROR)
    title, foot = figure.axes[0].get_title(loc="left"), figure.get_supxlabel()
    assert title == "OPD at z = 40 mm, piston and tilt removed:\nRMS 0.123 waves, PV 0.87 waves"
    for words in ("tilt: (12, −3) µrad", "RMS 0.4 waves", "RMS 21 µrad, maximum 77 µrad", "5.6 × 10⁻¹¹ waves"):
        assert words in foot
    assert any(axes.get_ylabel() == "waves of 632.8 nm" for axes in figure.axes)


def test_a_wavefront_without_error_is_drawn_too():
    assert png(wavefront_map(replace(ERROR, opd=np.where(INSIDE, 0.0, np.nan)))).startswith(b"\x89PNG")
