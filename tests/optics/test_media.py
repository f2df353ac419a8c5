"""Indices against the values their publishers print, and the sentences a wrong name gets."""

import pytest

from bstcad.optics.media import MEDIA, refractive_index


@pytest.mark.parametrize(
    ("material", "wavelength", "published"),
    [
        ("N-BK7", 587.5618, 1.51680),  # SCHOTT data sheet: n_d
        ("N-BK7", 486.1327, 1.52238),  # n_F
        ("N-SF11", 587.5618, 1.78472),  # n_d
        ("fused silica", 589.2938, 1.45841),  # Malitson 1965, table I
        ("fused silica", 1013.98, 1.45025),
        ("PMMA", 650.0, 1.488),  # Wang et al. 2023, section 4
        ("PMMA", 587.5618, 1.4914),  # the usual catalogue value, 1.490 to 1.492
        ("polycarbonate", 587.6, 1.5848),  # Sultanova et al. 2009, table 2
        ("polystyrene", 587.6, 1.5917),
        ("water", 589.3, 1.33334),  # Daimon and Masumura 2007, 20 °C
    ],
)
def test_index_is_the_published_one(material, wavelength, published):
    atol = 1.1e-3 if material in ("PMMA", "polycarbonate", "polystyrene") else 2e-5  # batches of a polymer differ
    assert refractive_index(material, wavelength) == pytest.approx(published, abs=atol)


@pytest.mark.parametrize("medium", MEDIA, ids=lambda m: m.name)
def test_dispersion_is_normal_over_the_whole_range(medium):
    indices = [medium.index(medium.shortest + k / 50 * (medium.longest - medium.shortest)) for k in range(51)]
    assert all(1.3 < n < 2.0 for n in indices)
    assert all(shorter > longer for shorter, longer in zip(indices, indices[1:], strict=False))


def test_names_are_read_as_people_write_them():
    assert refractive_index("nbk7", 550.0) == refractive_index("N-BK7", 550.0)
    assert refractive_index("Acrylic", 550.0) == refractive_index("PMMA", 550.0)


@pytest.mark.parametrize(
    ("material", "wavelength", "words"),
    [("PMNA", 650.0, "'PMMA'"), ("unobtainium", 650.0, "known are"), ("PMMA", 0.65, "404.7 to 1083 nm")],
)
def test_a_wrong_request_gets_one_sentence(material, wavelength, words):
    with pytest.raises(ValueError, match=words) as caught:
        refractive_index(material, wavelength)
    assert "\n" not in str(caught.value)
