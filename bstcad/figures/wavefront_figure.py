"""Figure of a wavefront error: a map over the plane on which the error is stated, and cuts through the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bstcad.figures.drawing import BLUE, GREY, VERMILION, footnote, new_figure, round_up, steps, styled
from bstcad.report.units import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bstcad.optics.trace.wavefront_error import WavefrontError

LOOKING = "Seen from behind, looking towards the lens: x grows to the right.  +: the light arrives late."
REMOVED = "piston and tilt removed"


@styled
def wavefront_map(error: WavefrontError) -> Figure:
    """Draw the OPD (waves) at z = error.z, without piston and tilt, and cuts along x and y through its centre."""
    figure = new_figure(9.0, 4.3)
    face, cut = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    edge = round_up(float(np.nanmax(np.abs(error.opd))))
    pitch = (error.x[1] - error.x[0]) / 2
    ends = error.x[0] - pitch, error.x[-1] + pitch, error.y[0] - pitch, error.y[-1] + pitch
    shades = {"cmap": steps("RdBu_r", 41), "vmin": -edge, "vmax": edge}
    image = face.imshow(error.opd, extent=ends, origin="lower", interpolation_stage="data", **shades)
    figures = error.without_tilt
    face.set(xlabel="x (mm)", ylabel="y (mm)")
    face.set_title(
        f"OPD at z = {error.z:g} mm, {REMOVED}:\nRMS {number(figures.rms)} waves, PV {number(figures.pv)} waves"
    )
    face.spines[:].set_visible(False)
    figure.colorbar(image, ax=face, label=f"waves of {error.wavelength:g} nm", fraction=0.046, pad=0.03)
    _cuts(cut, error, edge)
    footnote(figure, f"{LOOKING}\n{words(error)}")
    return figure


def _cuts(axes: Axes, error: WavefrontError, edge: float) -> None:
    row, column = (len(along) // 2 for along in (error.y, error.x))
    for along, line, colour, name in (
        (error.x, error.opd[row], BLUE, f"along x (y = {error.y[row]:.3g} mm)"),
        (error.y, error.opd[:, column], VERMILION, f"along y (x = {error.x[column]:.3g} mm)"),
    ):
        axes.plot(along, line, color=colour, linewidth=1.0, label=name)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.set(xlabel="mm", ylabel="waves", ylim=(-edge, edge), title="Cuts through the centre")
    axes.legend(loc="upper center")


def words(error: WavefrontError) -> str:
    """Return a line on the removed tilt, the angles of the rays to the requested rays, and the rounding error."""
    piston, (along_x, along_y) = error.without_piston, error.tilt
    return (
        f"Removed tilt: ({number(along_x)}, {number(along_y)}) µrad; with this tilt, RMS {number(piston.rms)} waves.  "
        f"Angles to the requested rays: RMS {number(error.angle_rms)} µrad, maximum {number(error.angle_max)} µrad.  "
        f"Rounding error: {number(error.floor)} waves."
    )
