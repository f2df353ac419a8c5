"""EULUMDAT files as two packages of others read them, and the letter L in the frame of an observer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import photompy
import pyldt

from bstcad.photometry.intensity import Intensity

KLM = 1000.0  # lm, to which the intensities of a file refer


def read_by_others(path: Path) -> dict[str, Intensity]:
    """Return the intensities (cd) up to γ = 90° that photompy and pyldt read, on the grid that they state."""
    whole = photompy.LDTFile.read(path).photometry.expanded()
    phis, thetas, candela = (np.asarray(part, dtype=float) for part in (whole.phis, whole.thetas, whole.values))
    kept = thetas <= 90.0
    assert not candela[:, ~kept].any()  # the reader adds angles without light
    theirs = pyldt.LdtReader.read(path)
    head = theirs.header
    planes, along = (np.asarray(part, dtype=float) for part in (head.c_angles, head.g_angles))
    factor = float(np.sum(head.lamp_flux)) / KLM
    return {
        "photompy": Intensity("C", phis, thetas[kept], candela[:, kept]),
        "pyldt": Intensity("C", planes, along, factor * np.array(theirs.intensities, dtype=float)),
    }


def seen(table: Intensity, right: float, up: float, width: float = 2.5) -> float:
    """Return the mean intensity about a direction, to the right and up (degrees) for an observer behind the lamp.

    CIE 121 and LM-63, type C: for a luminaire that shines downwards, C increases counterclockwise seen from above, that
    is for an observer behind the lamp who looks along the light.  In a scene x (C = 0) is on the left of an observer
    who looks along +z with y up; counterclockwise from the left is downwards, so C = 90° is below.
    """
    at_right, at_up = np.meshgrid(right + width * np.linspace(-1, 1, 9), up + width * np.linspace(-1, 1, 9))
    c = np.degrees(np.arctan2(at_up, at_right)) - 180.0  # polar angles are counterclockwise from the right
    return float(table.between(c % 360.0, np.hypot(at_right, at_up)).mean())


def assert_is_an_l(table: Intensity, size: float = 1.0) -> None:
    """Assert that an L of 28 x 38 degrees times `size` is upright, with its foot to the right, for an observer."""
    lit = [seen(table, size * right, size * up, 1.5 * size) for right, up in ((-9, 14), (-9, -15), (9, -15))]
    dark = [seen(table, size * right, size * up, 1.5 * size) for right, up in ((9, 14), (9, 0), (16, -15), (-9, 23))]
    assert min(lit) > 5 * max(dark)
