"""The templates of the report, and what is kept of them from run to run."""

import sys

import pytest

from bstcad.report import units


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the template a.txt.j2 in place of the package's own."""
    (tmp_path / "a.txt.j2").write_text("{{ title }}")
    monkeypatch.setattr(units, "__file__", str(tmp_path / "units.py"))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    for each in (units.environment, units._plain_text):
        monkeypatch.setattr(units, each.__name__, units.cache(each.__wrapped__))
    return tmp_path


def refuse(*_, **__):
    raise PermissionError("a folder for reading alone")


@pytest.mark.parametrize("new_process", [False, True])
def test_a_kept_template_escapes_for_html_and_not_in_plain_text(folder, new_process):
    for _ in range(2):  # compiled, then kept
        for environment, text in ((units.environment, "&lt;b&gt;"), (units._plain_text, "<b>")):
            assert environment().get_template("a.txt.j2").render(title="<b>") == text
            if new_process:
                environment.cache_clear()
    kept = list((folder / "__pycache__").iterdir())
    assert sorted(path.name.partition("-")[0] for path in kept) == ["escaped", "plain"]


def test_a_template_that_has_changed_is_compiled_again(folder):
    for text in ("old {{ title }}", "new {{ title }}"):
        (folder / "a.txt.j2").write_text(text)
        units.environment.cache_clear()
        assert units.environment().get_template("a.txt.j2").render(title="x") == text.replace("{{ title }}", "x")


@pytest.mark.parametrize("forbidden", [True, False])
def test_where_nothing_may_be_written_templates_are_compiled(folder, monkeypatch, forbidden):
    if forbidden:
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
    else:
        monkeypatch.setattr(units.Path, "mkdir", refuse)
    assert units.environment().get_template("a.txt.j2").render(title="x") == "x"
    assert not (folder / "__pycache__").is_dir()
