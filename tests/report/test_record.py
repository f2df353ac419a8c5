"""report.json and tolerance.json: written by their keys and read back strictly."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bstcad.designs.course import DesignCourse
from bstcad.manufacture.tolerance import tolerances
from bstcad.report import record
from bstcad.report.record import KEYS, Contents, of_json
from tests.report.test_report import CONTENTS, REPORT

GOLDEN = {  # files as the first version wrote them, with every entry that a report may have
    "report": (Contents, lambda found, path: record.write_json(found, path)),
    "tolerance": (tolerances.Tolerances, tolerances.write),
}
TOLD = {name: json.loads(Path(__file__).with_name(f"golden_{name}.json").read_text()) for name in GOLDEN}


@pytest.mark.parametrize("name", GOLDEN)
def test_a_file_of_before_is_read_and_written_again_to_the_last_character(tmp_path, name):
    kind, write = GOLDEN[name]
    path = Path(__file__).with_name(f"golden_{name}.json")
    found = record.read_as(kind, path, "")
    assert found.facts() == TOLD[name] and list(found.facts()) == list(TOLD[name])
    write(found, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == path.read_text()


def test_a_written_report_is_kept_whole(small_design):
    path = small_design.folder / "report.json"
    found = record.read(path)
    assert found.facts() == json.loads(path.read_text()) and found.course == record.read_course(path)
    assert found.history and found.stages and found.course.twins == found.twins


def test_figures_on_cells_are_kept_for_the_worst_target_and_for_each(small_design):
    """The lists are empty, and not in the file, if nothing was measured inside the pixels (a golden file above)."""
    facts = json.loads((small_design.folder / "report.json").read_text())
    found = of_json(json.dumps(facts))
    [goal] = found.goals
    assert facts["rrmsd_by_cell"] == facts["goals"][0]["rrmsd_by_cell"] and found.rrmsd_by_cell == goal.rrmsd_by_cell
    assert [each.pixels for each in goal.rrmsd_by_cell] == [4, 2, 1, 0.5, 0.25]
    assert goal.on_cells(1.0).rrmsd == found.rrmsd and found.right_down_to == goal.right_down_to
    pixel = math.sqrt(60 / 64 * 50 / 48)  # mm
    assert [each.cell for each in goal.rrmsd_by_cell] == pytest.approx([pixel * k for k in (4, 2, 1, 0.5, 0.25)])
    real = [each.pixels for each in goal.rrmsd_by_cell if each.blurred is not None]
    assert real == [0.5, 0.25]  # an assumed lamp of 0.1 mm has an image of 0.58 mm, 0.58 pixels
    assert not {"rrmsd_by_cell", "right_down_to"} & {*CONTENTS.facts(), *CONTENTS.facts()["goals"][0]}


WRONG = {  # key of report.json: values that are none of ours
    "seconds_total": ["1", True, -1.0, 1e10, None],
    "stages": [{}, [1], [{"name": "a\nb", "seconds": 1.0, "rrmsd": None}], [[]] * 101, [{"name": "a"}]],
    "history": [[{"seconds": 1.0, "rrmsd": 0.0}], [None]],
    "machine": [{"cores": [2]}, {"a": "x" * 3000}, []],
    "transport": [{"grid": [1]}],
    "skipped_steps": [True, -1, 1.5],
    "stopped": [1, "a\x1b[2J"],
    "flux": [{"on target": 2.0}],
    "verdict": ["fine"],
    "order": [{"file": "lens.step"}],
    "blur": [{"width": 3.0, "pixels": 1.0, "rrmsd": 0.1, "more": 1}],
    "rrmsd_by_cell": [None, [{"cell": 1.0}], [{"cell": 1, "unit": 1, "pixels": 1, "rrmsd": 0.1, "standard_error": 0}]],
    "right_down_to": [-1.0, "1 mm"],
    "more": [1],  # a key that there is not
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in WRONG.items() for value in values])
def test_a_report_with_an_entry_that_does_not_fit_is_refused_in_one_sentence(tmp_path, key, value):
    path = tmp_path / "report.json"
    path.write_text(json.dumps(TOLD["report"] | {key: value}))
    with pytest.raises(ValueError, match="report.json: cannot be read .*; run bstcad verify") as refused:
        record.read(path)
    assert str(refused.value).isprintable() and len(str(refused.value)) < 400
    assert record.read_course(path) == DesignCourse()


def _with(key, text):
    """A report as JSON with this text as the value of a key."""
    return json.dumps(TOLD["report"] | {key: "@"}).replace('"@"', text)


DIGITS = "9" * 1_000_000
FOREIGN = {  # texts of JSON that are no report
    "nesting of lists": "[" * 100_000 + "]" * 100_000,
    "nesting of dicts": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "nesting below a key": _with("prescription", "[" * 3000 + "]" * 3000),
    **{
        f"{number} of {key}": _with(key, number)
        for number in ("NaN", "-Infinity", "1e999")
        for key in ("rrmsd", "seed")
    },
    **{
        f"{number} of any value": _with("prescription", f'{{"a": [{number}]}}')
        for number in ("NaN", "Infinity", "1e999")
    },
    "digits of an integer": _with("seed", DIGITS),
    "digits of a float": _with("rrmsd", DIGITS),
    "digits of any value": _with("prescription", f'{{"a": {DIGITS}}}'),
    "digits of a place of an earlier version": _with("goals", f'[{{"z": {"9" * 400}}}]'),
    "a key of a million characters": _with("rrmsd", f'0, "{"x" * 1_000_000}": 1'),
    "a key that steers a terminal": _with("rrmsd", '0, "\\u001b[2J\\u202e": 1'),
    "half of a character": _with("name", '"\\ud800"'),
    "a byte-order mark": b"\xef\xbb\xbf{}",
    "no UTF-8": b'{"name": "\xff"}',
    "nothing": "",
    **{
        kind: text
        for kind, text in {"list": "[1]", "number": "3", "null": "null", "text": '"x"', "flag": "true"}.items()
    },
}


@pytest.mark.parametrize("kind", [Contents, tolerances.Tolerances], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("what", FOREIGN)
def test_foreign_json_is_refused_in_one_sentence(what, kind):
    with pytest.raises(ValueError) as refused:
        of_json(FOREIGN[what], kind)
    assert type(refused.value) is ValueError and str(refused.value).isprintable() and len(str(refused.value)) <= 600


@pytest.mark.parametrize("value", [None, 1, -1e308, "x", True, [], {}, [[]], {"a": [1]}], ids=str)
@pytest.mark.parametrize("key", TOLD["report"])
def test_a_value_of_another_type_is_read_and_written_again_or_refused_in_one_sentence(tmp_path, key, value):
    try:
        found = of_json(json.dumps(TOLD["report"] | {key: value}))
    except ValueError as error:
        assert type(error) is ValueError and str(error).isprintable() and len(str(error)) <= 600
    else:
        record.write_json(found, tmp_path / "report.json")
        assert record.read(tmp_path / "report.json") == found


def test_the_last_of_several_equal_keys_counts():
    assert of_json(_with("rrmsd", '0.5, "rrmsd": 0.25')).rrmsd == 0.25


def test_a_missing_key_is_named():
    for key in KEYS:
        with pytest.raises(ValueError, match=f"^{key}: Field required"):
            of_json(json.dumps({name: value for name, value in TOLD["report"].items() if name != key}))


def test_contract_keys_come_first_in_one_order(tmp_path):
    record.write_json(CONTENTS, tmp_path / "report.json")
    written = json.loads((tmp_path / "report.json").read_text())
    assert list(written) == [*KEYS, "leak", "contrast", "optic", "twins", "rrmsd_asked", "given_up", "remarks"]
    known_as_none = {"leak": None, "contrast": None, "optic": "lens", "twins": None, "given_up": [], "remarks": []}
    assert written == REPORT | known_as_none


@pytest.mark.parametrize("bad", [math.nan, math.inf, np.float64("nan"), np.float32("-inf")])
def test_a_number_that_is_not_finite_is_named_and_nothing_written(tmp_path, bad):
    report = replace(CONTENTS, checks=(CONTENTS.checks[0], replace(CONTENTS.checks[1], value=bad)))
    with pytest.raises(ValueError, match=r"'checks\[1\].value'"):
        record.write_json(report, tmp_path / "report.json")
    assert not (tmp_path / "report.json").exists()


def test_numpy_numbers_and_readable_floats(tmp_path):
    report = replace(CONTENTS, rrmsd=np.float64(0.1) + 0.2, seed=np.int64(7), passed=np.bool_(True))
    record.write_json(report, tmp_path / "report.json")
    text = (tmp_path / "report.json").read_text()
    assert '"rrmsd": 0.3,' in text and '"seed": 7' in text and '"passed": true' in text
    assert sum('"limit"' in line for line in text.splitlines()) == len(CONTENTS.checks)  # each check is one line


def test_rounding_keeps_the_ledger_closed(tmp_path):
    parts = np.random.default_rng(0).random(5) ** 4
    record.write_json(replace(CONTENTS, flux=dict(enumerate(parts / parts.sum()))), tmp_path / "report.json")
    assert abs(sum(record.read(tmp_path / "report.json").flux.values()) - 1.0) < 1e-11  # 12 digits
