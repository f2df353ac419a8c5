"""The hard cases catch the faults that they are there for: a constant or a function is replaced by a wrong one."""

import pytest
import torch

from bstcad.optics.lens import interfaces
from bstcad.optics.receivers import irradiance
from bstcad.optics.surfaces import surfaces
from bstcad.optics.surfaces.rays import Status
from tests.hard_cases import test_02_critical_angle, test_03_grazing, test_07_flat_sphere, test_11_ledger

DOUBLE = torch.float64


def held(figure, value, bound, unit=""):
    assert value <= bound


def by_the_usual_formula(surface, x, y):
    """R - sqrt(R² - r²): its digits cancel."""
    c = surface.curvature
    return (1 - torch.sqrt(1 - c * c * (x * x + y * y))) / (c + 1e-30), c * x, c * y


LINES = {**irradiance.LEDGER, "lost through the sides": Status.MISSED_FRONT}
FAULTS = {
    "refraction has no cap": (
        interfaces, "MIN_COS_REFRACTION", 1e-30,
        lambda: test_02_critical_angle.test_the_gradient_is_the_derivative_up_to_its_cap(0.0, DOUBLE, held),
    ),
    "a sphere goes on at its equator": (
        surfaces, "MIN_COS2", -1e9,
        lambda: test_03_grazing.test_along_the_axis_at_the_equator(0.1, DOUBLE, held),
    ),
    "a sag cancels": (
        surfaces.Sphere, "relative_sag_and_slope", by_the_usual_formula,
        lambda: test_07_flat_sphere.test_sag_and_slope_have_all_their_digits(1e-9, DOUBLE, held),
    ),
    "a line of the ledger is another": (
        irradiance, "LEDGER", LINES, lambda: test_11_ledger.test_every_ray_is_in_its_line(held, DOUBLE),
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_the_fault_is_seen(fault, monkeypatch):
    module, name, wrong, law = FAULTS[fault]
    law()
    monkeypatch.setattr(module, name, wrong)
    with pytest.raises(AssertionError):
        law()
