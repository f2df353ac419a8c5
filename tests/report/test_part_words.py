"""What is said of a made part: that a drawing's tolerance is one which the part meets, and the tightest."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from bstcad.report import part_words


@given(width=st.floats(1e-6, 10), rms=st.floats(1e-8, 1))
def test_the_tolerances_for_a_drawing_are_met_by_less_than_a_hundredth(width, rms):
    profile, surface = part_words.drawing({"minimum_zone": {"width": width}, "rms": rms})
    code, bound = surface[1].split(" < ")
    assert code == "3/—RMSt" and profile[0] == "profile"
    for asked, found in ((float(profile[1]), width), (float(bound) / 1e6, rms)):
        assert found * (1 - 1e-9) <= asked <= 1.0101 * found
