"""The README: its table of designs, its pictures, its length; test_docs.py runs its commands and blocks."""

import json
import re
from pathlib import Path

from tests.benchmarks.accuracy import at_usual_speed

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_table_of_designs_says_what_is_on_record():
    """Made by `make accuracy`, as its page has them; a design of another kind of scene has no cell."""
    designs = at_usual_speed(json.loads((ROOT / "docs" / "accuracy.json").read_text(encoding="utf-8")))
    rows = re.findall(r"^\|[^|]*`(\w+)\.toml`\)[^|]*\|(.*)$", README, re.M)
    assert {name for name, _ in rows} == set(designs)
    for name, cells in rows:
        for quality, cell in zip(("draft", "standard", "paper"), cells.split("|"), strict=False):
            record = designs[name].get(quality)
            said = re.match(r"\W*([\d.]+)\W* in (?:(\d+) min )?(\d+) s", cell)
            assert bool(said) is bool(record), f"{name}, {quality}"
            if record:
                seconds = 60 * int(said[2] or 0) + int(said[3])
                assert (said[1], seconds) == (f"{record['rrmsd']:.3f}", round(record["seconds"])), f"{name}, {quality}"


def test_the_pictures_are_there_and_small():
    pictures = re.findall(r"(?:\]\(|src=\")(docs/[\w.-]+)", README)
    assert len(pictures) >= 2
    for name in pictures:
        assert (ROOT / name).stat().st_size < 300_000


def test_it_is_short():
    assert len(README.splitlines()) <= 120
