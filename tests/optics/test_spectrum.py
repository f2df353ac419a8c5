"""Spectra: shares of the flux, and the line that stands for all."""

import math

import pytest

from bstcad.optics import spectrum


@pytest.mark.parametrize(
    ("wavelength", "main"),
    [
        (587.6, 587.6),
        (((587.6, 3.0),), 587.6),
        (((486.1, 1.0), (587.6, 1.0), (656.3, 1.0)), 587.6),
        (((656.3, 1.0), (587.6, 1.0), (486.1, 1.0)), 587.6),  # sorted or not
        (((486.1, 1.0), (587.6, 1.0), (656.3, 2.0)), 656.3),
        (((486.1, 1.0), (587.6, 2.0), (656.3, 2.0)), 587.6),  # of two in the middle the shorter
    ],
    ids=str,
)
def test_the_main_line_is_the_heaviest_and_of_equals_the_middle_one(wavelength, main):
    lines = spectrum.lines(wavelength)
    assert spectrum.main(wavelength) == lines[0][0] == main
    assert math.fsum(share for _, share in lines) == pytest.approx(1, abs=1e-15)


def test_shares_are_those_of_the_weights():
    shares = dict(spectrum.lines(((400.0, 1.0), (500.0, 5.0), (600.0, 2.0))))
    assert shares == {400.0: 0.125, 500.0: 0.625, 600.0: 0.25}
    assert spectrum.lines(587.6) == spectrum.lines(((587.6, 0.1),)) == ((587.6, 1.0),)
