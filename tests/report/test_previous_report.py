"""Of an earlier report everything is kept that fits, and nothing that does not."""

from __future__ import annotations

import json

import pytest

from bstcad.commands import KEPT
from bstcad.report import previous_report


def test_a_written_report_is_kept_whole(small_design):
    told = json.loads((small_design.folder / "report.json").read_text())
    found = previous_report.kept(small_design.folder / "report.json", KEPT)
    assert found == {key: told[key] for key in KEPT} and found["history"] and found["stages"]


BAD = {
    "seconds_total": ["1", True, -1.0, 1e10, None, [1]],
    "stages": [{}, [1], [{"name": "a", "seconds": 1.0}], [{"name": "a\nb", "seconds": 1.0, "rrmsd": None}], [[]] * 101],
    "history": [[{"seconds": 1.0, "rrmsd": 0.0}], [{"seconds": "1", "rrmsd": 0.1}], [None], {"seconds": 1.0}],
    "machine": [{"memory_gb": "much"}, {"cores": [2]}, {"a": "x" * 300}, []],
    "versions": [{"python": 3.11}, {"python": None}, [], {str(i): "1" for i in range(101)}],
    "transport": [{"grid": None}, {"grid": [1]}, {"grid": {"n": 1}}],
    "skipped_steps": [True, -1, "0", 1.5],
    "stopped": [1, "x" * 300, "a\x1b[2J", None],
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in BAD.items() for value in values])
def test_what_does_not_fit_is_left_out(tmp_path, key, value):
    (tmp_path / "report.json").write_text(json.dumps({key: value, "quality": "draft"}))
    assert previous_report.kept(tmp_path / "report.json", KEPT) == {}


def test_a_key_of_which_nothing_is_known_is_kept_if_it_is_plain(tmp_path):
    (tmp_path / "report.json").write_text(json.dumps({"a": {"b": 1.0, "c": "d"}, "e": {"f": [[1]]}, "g": [1, 2]}))
    assert previous_report.kept(tmp_path / "report.json", dict.fromkeys("aeg", object)).keys() == {"a", "g"}
