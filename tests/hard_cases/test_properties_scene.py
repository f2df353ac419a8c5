"""Laws of the scene reader, for values that nobody chose: what is valid is kept and comes back, the rest is a sentence.

Hypothesis draws the values, the same ones in every run.
"""

from __future__ import annotations

import re
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from bstcad.scene.scene import SceneError, load
from tests.hard_cases.lenses import examples

DISK = Path(__file__).parent.parent.parent / "templates" / "disk.toml"
NUMBERS = {  # a key of templates/disk.toml and what may stand there
    "source.wavelength": st.floats(405.0, 1080.0),
    "lens.index": st.floats(1.3, 2.5),
    "lens.front.z": st.floats(5.0, 19.0),
    "lens.back.z": st.floats(19.6, 400.0),
    "lens.back.control_points": st.integers(5, 2049),
    "lens.outline.width": st.floats(1.0, 200.0),
    "target.z": st.floats(401.0, 1e7),
    "target.pixels": st.integers(8, 96),
    "tailoring.seed": st.integers(0, 2**63 - 1),
    "tailoring.rounds": st.integers(1, 100),
    "tailoring.overshoot": st.floats(0.0, 1e3),
    "accept.rrmsd": st.floats(1e-6, 10.0),
    "accept.form": st.floats(1e-12, 1.0),
}
WORDS = {
    "name": st.from_regex(r"[a-z][a-z0-9_-]{0,20}", fullmatch=True),
    "title": st.text(max_size=40).map("a {}".format).filter(str.isprintable),
    "tailoring.quality": st.sampled_from(["draft", "standard", "fine"]),
}
OVERRIDES = st.fixed_dictionaries({}, optional=NUMBERS | WORDS)


def at(scene, key: str):
    for part in key.split("."):
        scene = getattr(scene, part)
    return scene


@given(OVERRIDES)
@examples(60)
def test_what_is_asked_for_is_kept_and_comes_back(tmp_path_factory, overrides):
    """Any valid value stands in the scene as it was given; and the scene's own file loads to an equal one."""
    scene = load(DISK, {"target.pixels": 16, **overrides})
    for key, value in overrides.items():
        assert at(scene, key) == value
    path = tmp_path_factory.getbasetemp() / "again.toml"
    path.write_text(scene.toml(), encoding="utf-8")
    assert load(path) == scene


@given(OVERRIDES)
@examples(30)
def test_text_on_the_command_line_is_read_as_the_value(overrides):
    """As `--set` hands it over; a title is text whatever it looks like only if it is no TOML value."""
    overrides = {key: value for key, value in overrides.items() if key not in WORDS}
    told = {key: repr(value) for key, value in overrides.items()}
    assert load(DISK, {"target.pixels": "16", **told}) == load(DISK, {"target.pixels": 16, **overrides})


TABLES = ("", "source.", "lens.", "lens.front.", "lens.back.", "lens.outline.", "target.", "target.outline.",
          "tailoring.", "accept.")  # fmt: skip
VALUES = st.one_of(
    st.integers(-(2**40), 2**40), st.floats(allow_nan=False), st.booleans(), st.text(max_size=8),
    st.lists(st.integers(0, 3), max_size=3),
)  # fmt: skip


def is_a_sentence(text: str) -> bool:
    return "\n" not in text and len(text) < 500 and not re.search(r"pydantic|Traceback|validation error", text)


@given(st.sampled_from(TABLES), st.from_regex(r"[a-z][a-z0-9_]{2,12}", fullmatch=True), VALUES)
@examples(80)
def test_an_unknown_key_is_a_sentence_that_names_it(table, key, value):
    known = {"name", "title", "source", "lens", "target", "tailoring", "effects", "accept", "tolerance"}
    key = f"zz{key}" if not table and key in known else key
    try:
        load(DISK, {"target.pixels": 16, table + key: value})
    except SceneError as error:
        assert is_a_sentence(str(error))
        infinite = isinstance(value, float) and not abs(value) < 1e300
        assert (table + key in str(error)) or infinite
        return
    at(load(DISK, {"target.pixels": 16, table + key: value}), table + key)  # it was a key after all
