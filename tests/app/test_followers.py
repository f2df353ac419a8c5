"""Keys that follow another one: what a person would draw, nothing in silence, and nothing after a wrong entry."""

import re
import tomllib
from pathlib import Path

import pytest

from bstcad.app.followers import impossible_choices, take_change
from bstcad.app.form import form
from bstcad.app.scene_text import changed, typed
from bstcad.runs.files import SentenceError
from bstcad.scene import effects, new_scene
from bstcad.scene.scene import of_text
from tests import suite
from tests.app.conftest import SMALL

ROOT = Path(__file__).parents[2]
PLATES = {light: new_scene.Plate.of(light, "60x40").text(light) for light in new_scene.LIGHTS}
OTHERS = ("mirror", "two_pictures", "disk")
TEXTS = PLATES | {name: (ROOT / "templates" / f"{name}.toml").read_text(encoding="utf-8") for name in OTHERS}


def fault(text):
    """The sentence that refuses a scene; None: it is valid."""
    try:
        of_text(text, tomllib.loads(text), ROOT / "templates" / "x.toml")
    except SentenceError as refusal:
        return str(refusal)
    return None


def is_valid(text):
    return fault(text) is None


def take(text, key, words, **options):
    return take_change(text, key, typed(key, words, tomllib.loads(text)), is_valid=is_valid, **options)


def target(text):
    found = tomllib.loads(text)["target"]
    return found["z"], found["x"], found["y"]


def test_y_follows_x_only_with_a_closed_lock():
    text, followed = take(SMALL, "target.x", "-10; 30")
    assert target(text) == (100.0, [-10.0, 30.0], [-8.0, 8.0]) and followed == ()
    text, followed = take(SMALL, "target.x", "-10; 30", locked=True)
    assert target(text) == (100.0, [-10.0, 30.0], [-20.0, 20.0]) and followed == ("target.y",)
    text, followed = take(text, "target.y", "0; 20", locked=True)
    assert target(text)[1] == [0.0, 20.0] and followed == ("target.x",)
    text, followed = take(PLATES["sun"], "lens.outline.width", "30", locked=True)
    for table in (tomllib.loads(text)["lens"]["outline"], tomllib.loads(text)["source"]["aperture"]):
        assert table == {"shape": "rectangle", "width": 30.0, "height": 20.0}
    assert set(followed) == {"lens.outline.height", "source.aperture.width", "source.aperture.height"}


@pytest.mark.parametrize(("key", "wrong", "other"), [
    ("target.x", "-20000000000; 8", "target.y"), ("target.x", "8; -8", "target.y"),
    ("lens.back.z", "-3", "target.z"), ("lens.back.z", "1e9", "target.z"),
    ("lens.outline.diameter", "1e-9", "source.aperture.radius"),
])  # fmt: skip
def test_a_wrong_entry_changes_no_other_field_and_leaves_no_trace(key, wrong, other):
    text, followed = take(SMALL, key, wrong, valid_text=SMALL, locked=True)
    assert text == changed(SMALL, key, typed(key, wrong, tomllib.loads(SMALL))) and followed == ()
    assert not is_valid(text)
    mended = {"target.x": "-4; 4", "lens.back.z": "5", "lens.outline.diameter": "14"}[key]
    at_once, after = (take(*given, mended, valid_text=SMALL, locked=True)[0] for given in ((SMALL, key), (text, key)))
    assert after == at_once
    own = changed(text, other, 9.0 if other != "target.y" else [-9.0, 9.0])  # what a person changed meanwhile stays
    assert changed(take(own, key, mended, valid_text=SMALL, locked=True)[0], key, None) == changed(own, key, None)


@pytest.mark.parametrize("name", suite.in_turns(TEXTS, 5))
def test_a_choice_that_is_offered_is_possible_or_told_why_not(name, monkeypatch):
    """Each is typed as the page sends it; what is not possible is greyed, all else makes a valid scene."""
    monkeypatch.setattr(effects, "_REGISTERED", {})  # of other tests of this process
    text = TEXTS[name]
    greyed, data = impossible_choices(text, fault), tomllib.loads(text)
    for field in form(data).fields():
        for choice in field.choices if field.control == "choice" and field.key.rpartition(".")[2] != "sample" else ():
            done = fault(take(text, field.key, choice, valid_text=text)[0])
            assert done == greyed.get(field.key, {}).get(choice), (field.key, choice)
    usual = {"two_pictures": {"tailoring.quality": {"paper"}, "tailoring.method": {"adam", "integration"}}}
    usual["two_pictures"] |= {f"target[{k}].kind": {"intensity"} for k in (0, 1)}
    usual["mirror"] = {"lens.front.kind": {"bspline"}}
    usual["led"] = {"effects[0].kind": {"own"}}
    if name in ("laser", "sun", "mirror", "two_pictures"):  # a dome needs a lamp before the lens
        usual.setdefault(name, {})["lens.back.kind"] = {"radial"}
    usual.setdefault(name, {})
    assert {key: {*choices} for key, choices in greyed.items()} == usual[name]


def test_two_divergences_keep_their_rotation():
    """`rotate` stays while a pair is left that it turns, and goes with the last one."""
    turned = PLATES["sun"].replace("divergence = 0.53", "divergence = [0.5, 0.2]\nrotate = 20.0")
    assert tomllib.loads(take(turned, "source.profile", "gaussian")[0])["source"]["rotate"] == 20.0
    round_cone = PLATES["laser"].replace('profile = "gaussian"', 'profile = "gaussian"\nrotate = 20.0')
    round_cone = re.sub(r"radius_1e2 = [\d.]+", "radius_1e2 = [20.0, 9.0]", round_cone)
    assert tomllib.loads(round_cone)["source"]["rotate"] == 20.0
    assert "rotate" not in tomllib.loads(take(round_cone, "source.profile", "uniform")[0])["source"]


def test_a_circle_takes_the_beam_with_it():
    wide = PLATES["sun"].replace("height = 40.0 } # the light", "height = 38.0 } # the light")  # no longer alike
    for text in (PLATES["sun"], wide):
        text, followed = take(text, "lens.outline.shape", "circle")
        lens, source = (tomllib.loads(text)[name] for name in ("lens", "source"))
        assert lens["outline"] == {"shape": "circle", "diameter": 40.0} and source["aperture"]["shape"] == "circle"
        assert source["aperture"]["diameter"] in (40.0, 38.0) and followed == ("source.aperture.shape",)
    text, followed = take(PLATES["laser"], "source.profile", "uniform")
    assert "radius_1e2" not in tomllib.loads(text)["source"] and followed == ("source.radius_1e2",)
    assert tomllib.loads(take(text, "source.profile", "gaussian")[0])["source"]["radius_1e2"] == 30.0
