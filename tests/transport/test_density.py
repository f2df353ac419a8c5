"""A density keeps its mass, its scale and its orientation, and says no to a picture without light."""

import numpy as np
import pytest

from bstcad.transport import Density


def test_picture_keeps_mass_by_area_for_sizes_that_do_not_divide():
    picture = np.random.default_rng(0).random((37, 53))
    d = Density.from_picture(picture, 20, width=1.0, height=1.0)
    areas = np.kron(picture, np.ones((20, 20))).reshape(20, 37, 20, 53).mean(axis=(1, 3))
    np.testing.assert_allclose(d.values, areas[::-1].T / picture.mean(), rtol=1e-12)
    assert d.mass_error < 1e-14


def test_row_0_is_y_max_and_column_0_is_x_min():
    picture = np.zeros((8, 8))
    picture[0, 1] = 1.0
    assert np.argwhere(Density.from_picture(picture, 8).values).tolist() == [[1, 7]]


def test_a_wide_rectangle_sits_centred_with_one_scale():
    d = Density.from_picture(np.ones((10, 20)), 40, width=2.0, height=1.0, floor=1e-2)
    lit = d.values > 0
    assert lit.all(axis=0).tolist() == [10 <= j < 30 for j in range(40)]
    assert np.ptp(d.values[lit]) < 1e-13


def test_floor_lifts_only_darker_cells():
    picture = np.zeros((16, 16))
    picture[:4] = 3.0
    d = Density.from_picture(picture, 16, floor=0.01)
    assert d.values.min() / d.values.max() == pytest.approx(0.01 * 0.75 / 3.0, rel=1e-12)
    assert Density.from_picture(picture, 16).values.min() == 0.0


def test_lifting_reaches_the_floor_of_the_mean():
    values = np.zeros((8, 8))
    values[2:4, 5] = 1e300
    d = Density.from_values(values).lifted(1e-3)
    assert d.values.min() == pytest.approx(1e-3, rel=2e-3)
    assert d.values.mean() == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize(
    ("picture", "sentence"),
    [
        (np.zeros((8, 8)), "black everywhere"),
        (-np.ones((8, 8)), "not negative"),
        (np.full((8, 8), np.nan), "finite"),
        (np.ones((8, 8, 3)), "rows x columns"),
    ],
)
def test_a_bad_picture_is_refused_in_a_sentence(picture, sentence):
    with pytest.raises(ValueError, match=sentence):
        Density.from_picture(picture, 16)
