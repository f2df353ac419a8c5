"""Folders of earlier versions open, with all that they say."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

import bstcad
from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.figures.figure_jobs import NoPictures
from tests.conftest import quick_effort

BEFORE = Path(__file__).parent / "data" / "before_goals.zip"  # "one" target and "two", of 17 x 17 control points


@pytest.mark.parametrize(("name", "keys"), [("one", ["target"]), ("two", ["target[0]", "target[1]"])])
def test_a_folder_whose_report_has_no_goals_opens_and_is_verified(name, keys, tmp_path):
    """The old report kept the first target apart; the second of the two is the worse one."""
    with zipfile.ZipFile(BEFORE) as archive:
        archive.extractall(tmp_path)
    folder = tmp_path / name
    told = json.loads((folder / "report.json").read_text())
    opened = bstcad.open(folder)
    found = opened.report
    assert [goal.key for goal in found.goals] == keys and "goals" not in told
    assert found.rrmsd == max(goal["rrmsd"] for goal in told.get("targets", [told]))
    assert (found.verdict, len(found.checks), found.seconds_total) == (
        told["verdict"], len(told["checks"]), told["seconds_total"],
    )  # fmt: skip
    with np.load(folder / "design.npz") as design:
        assert all(np.array_equal(light, design[key]) for light, key in zip(
            found.irradiances, ("irradiance", "irradiance_2"), strict=False,
        ))  # fmt: skip
    assert opened.export("zemax") and opened.export("datasheet")
    again = commands.verify(folder, options=ProofOptions(quick_effort(), NoPictures))
    assert [check.name for check in again.checks if not check.passed] == []
    assert [goal.rrmsd for goal in again.goals] == pytest.approx([goal.rrmsd for goal in found.goals], rel=0.05)
    written = json.loads((folder / "report.json").read_text())
    assert [goal["key"] for goal in written["goals"]] == keys and "targets" not in written
