"""Names in ASCII and Latin-1: letters are spelled, and no sign is replaced by a question mark."""

import numpy as np
import pytest

from bstcad.photometry import eulumdat, ies
from bstcad.photometry.intensity import Intensity, Luminaire
from bstcad.runs.transliteration import transliterate


@pytest.mark.parametrize(
    ("text", "spelled"),
    [
        ("für Zoë, Straße, Ærø, Łódź, İıﬁ", "fur Zoe, Strasse, Aero, Lodz, Iifi"),
        ("жα かガ 한", "zhealpha kaga han"),
        ("“50 µm” – 3 × 2°… ½", '"50 um" - 3 x 2 degrees... 1/2'),
        ("光\ud800😀", "U+5149 U+1F600"),
        ("a\x18b\u202fc\u0301", "a b c"),
    ],
)
def test_letters_are_spelled_and_other_signs_have_their_code(text, spelled):
    assert transliterate(text) == spelled


def test_latin_1_keeps_its_own_signs():
    assert transliterate("Größe 5 µm, Ж", "latin-1") == "Größe 5 µm, Zhe"


def test_photometric_files_state_the_name_of_the_lens_without_question_marks():
    table = Intensity("C", np.arange(0.0, 360.0, 15.0), np.linspace(0.0, 90.0, 10), candela=np.ones((24, 10)))
    luminaire = Luminaire("Straße Ж", size=(10.0, 10.0, 0.0))
    assert b"[LUMCAT] Strasse Zhe\r\n" in ies.write(table, luminaire)
    assert "\r\nStraße Zhe\r\n".encode("latin-1") in eulumdat.write(table, luminaire)
