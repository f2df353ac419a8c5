"""Each tutorial as it is written: its commands at the quality that it names, and the output that its page shows."""

import json
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
sys.path.append(str(DOCS / "_ext"))
pytest.importorskip("sphinx")
from tutorial_runs import PAGES, follow  # noqa: E402

pytestmark = pytest.mark.bench
SHOWN = re.compile(r"^(?:```\{literalinclude\} |!\[[^]]*\]\()\.\./_made/[\w-]+/([^)\s]+)\)?\n((?::.*\n)*)", re.M)
MARGIN = 0.02  # smallest margin of a value, as a fraction of its limit, so that another machine gives the same verdict


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_passes_as_it_is_written(page, tmp_path):
    """A command that does not end with 0, such as a design that fails its limits, ends the test."""
    folder = tmp_path / page.stem
    follow(page, folder)
    for name, options in SHOWN.findall(page.read_text(encoding="utf-8")):
        assert (folder / name).stat().st_size > 0
        for words in re.findall(r'^:start-at: "?(.*?)"?$', options, re.M):
            assert words in (folder / name).read_text(encoding="utf-8")
    for report in (json.loads(path.read_text()) for path in folder.glob("outputs/*/report.json")):
        for value in report.get("values", ()):
            least, most = value.get("least"), value.get("most")
            assert least is None or value["value"] > (1 + MARGIN) * least
            assert most is None or value["value"] < (1 - MARGIN) * most
        for check in report["checks"]:
            if check["id"] in ("rrmsd", "light-on-target") and check["limit"] is not None:
                assert abs(check["value"] / check["limit"] - 1) > MARGIN
