"""The wavefront behind a lens with errors, for the study of tolerances.

The OPD of a ray, by its place on the plane before the lens, is nearly linear in the errors, and its RMS is a norm, as
RRMSD is that of a picture: the same model superposes it (study.py).  The wanted wave stays in the room; piston and tilt
are removed anew for each lens, so that a lens may aim its light elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bstcad.optics.emitters import Emitter
from bstcad.optics.lens import Lens
from bstcad.optics.wavefront import Wave
from bstcad.optics.wavefront_error import exit_pupil, moved_pupil, residual, wavefront_error
from bstcad.tolerance.perturbations import Perturbation, Setup, perturbed

RAYS = 192  # a side


@dataclass(frozen=True, eq=False)
class Wavefronts:
    """Wavefront errors of a setup with errors, in waves of the main wavelength; its first channel is of that line."""

    setup: Setup
    perturbations: tuple[Perturbation, ...]
    wave: Wave
    wavelength: float  # nm
    rays: int = RAYS  # a side

    figure = "wavefront RMS"

    def of(self, amounts: Sequence[float]) -> np.ndarray:
        """(rays²,) OPD without piston and tilt, times the root of each ray's share of the flux: its norm is the RMS."""
        setup = perturbed(self.setup, self.perturbations, amounts)
        source, lens = _main(setup)
        pupil = exit_pupil(source, lens, self.wave.z, self.rays)
        if setup.placed is not None:
            pupil = moved_pupil(pupil, setup.placed, self.wave.z)
        return residual(pupil, self.wave, self.wavelength).ravel().numpy()

    @property
    def designed(self) -> float:
        """RMS (waves) of the setup as it is, by as many rays as a report's."""
        return wavefront_error(*_main(self.setup), self.wave).without_tilt.rms


def _main(setup: Setup) -> tuple[Emitter, Lens]:
    """The light of the main line, and the lens as it meets it."""
    channel = setup.channels[0]
    return channel.source, channel.through(setup.lens)
