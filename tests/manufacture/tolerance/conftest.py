"""The small design as a setup, and few rays for the figures of the design itself and for wavefronts."""

from dataclasses import replace
from functools import partial

import pytest

from bstcad.designs.folder import read_nominal
from bstcad.manufacture.tolerance import tolerancing
from bstcad.manufacture.tolerance.perturbations import Setup
from bstcad.manufacture.tolerance.study import Wavefronts
from tests.conftest import quick_effort


@pytest.fixture(scope="session")
def setup(small_design):
    nominal = read_nominal(small_design.folder)
    return Setup(nominal.lens, nominal.channels, nominal.goals[0].screen)


@pytest.fixture(scope="module", autouse=True)
def few_rays():
    """Measure designs before their study by the rays that resolve the small design, instead of by millions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tolerancing, "Effort", partial(replace, quick_effort()))
        patch.setattr(tolerancing, "Wavefronts", partial(Wavefronts, rays=96))
        yield
