"""Of an earlier report everything is kept that fits, and nothing that does not."""

from __future__ import annotations

import json

import pytest

from bstcad.report import previous_report
from bstcad.report.record import Contents, Making


def test_a_written_report_is_kept_whole(small_design):
    told = json.loads((small_design.folder / "report.json").read_text())
    found = previous_report.making(small_design.folder / "report.json")
    whole = Contents.of(told)
    assert vars(found) == {key: getattr(whole, key) for key in vars(found)} and found.history and found.stages
    assert previous_report.contents(small_design.folder / "report.json") == whole
    assert whole.facts() == told and list(whole.facts()) == list(told)


def test_what_only_some_designs_have_is_kept_too(small_design, tmp_path):
    told = json.loads((small_design.folder / "report.json").read_text())
    told["blur"] = {"width": 3.0, "pixels": 1.5, "rrmsd": 0.05}
    told["lines"] = [
        {"wavelength": 550.0, "share": 0.5, "rrmsd": 0.1},
        {"wavelength": 650.0, "share": 0.5, "rrmsd": 0.2},
    ]
    told["judges"] = [{"name": "batoid", "version": "0.9", "declined": "it knows no mirrors"}]
    (tmp_path / "report.json").write_text(json.dumps(told))
    assert previous_report.contents(tmp_path / "report.json") == Contents.of(told)


def test_a_judge_that_is_none_is_left_out(small_design, tmp_path):
    told = json.loads((small_design.folder / "report.json").read_text())
    for judges in ([{"name": "batoid"}], [{"name": "a", "version": "1", "more": 1}], "batoid"):
        (tmp_path / "report.json").write_text(json.dumps(told | {"judges": judges}))
        assert previous_report.contents(tmp_path / "report.json") == Contents.of(told)


def test_a_report_of_before_the_processors_time_was_told_is_kept(small_design, tmp_path):
    told = json.loads((small_design.folder / "report.json").read_text())
    for stage in told["stages"]:
        del stage["cpu_seconds"]
    for key in ("convergence", "remaining_error", "limits"):
        del told[key]
    (tmp_path / "report.json").write_text(json.dumps(told))
    found = previous_report.contents(tmp_path / "report.json")
    assert found == Contents.of(told) and len(found.stages) == len(told["stages"]) and found.limits == ()


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
    assert previous_report.making(tmp_path / "report.json") == Making()
    assert previous_report.contents(tmp_path / "report.json") is None


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in BAD.items() for value in values])
def test_a_report_with_one_entry_that_does_not_fit_is_read_without_it(small_design, tmp_path, key, value):
    told = json.loads((small_design.folder / "report.json").read_text())
    (tmp_path / "report.json").write_text(json.dumps(told | {key: value, "more": [[1]]}))
    found = previous_report.contents(tmp_path / "report.json")
    if key in previous_report.NEEDED:
        assert found is None
    else:
        assert getattr(found, key) in (None, (), {}, "") and "more" not in found.facts()
    assert getattr(previous_report.making(tmp_path / "report.json"), key) == getattr(Making(), key)
