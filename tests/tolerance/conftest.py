"""The small design as a setup."""

import pytest

from bstcad.folder import read_nominal
from bstcad.tolerance.perturbations import Setup


@pytest.fixture(scope="session")
def setup(small_design):
    _, nominal = read_nominal(small_design.folder)
    return Setup(nominal.lens, nominal.channels, nominal.goals[0].receiver)
