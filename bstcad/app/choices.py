"""The choices of a form that a scene cannot have, each with the reason, found by trying them."""

from __future__ import annotations

from collections.abc import Callable

from bstcad.app import scene_text
from bstcad.app.followers import take_change
from bstcad.app.form import form
from bstcad.runs.files import SentenceError

SAFE = ("rotate", "fit", "seen_from", "sample")  # they change the picture alone, and reading a photo takes long


def impossible(text: str, fault: Callable[[str], str | None]) -> dict[str, dict[str, str]]:
    """Return, by key and choice, why a valid scene would be refused with it; {} for a scene that is wrong itself.

    fault: the sentence that refuses the scene of a text; None for a valid one.
    """
    if fault(text) is not None:
        return {}
    found: dict[str, dict[str, str]] = {}
    for field in form(scene_text.tables(text)).fields():
        if field.control != "choice" or field.key.rpartition(".")[2] in SAFE:
            continue
        for choice in field.choices:
            if choice != field.value and (why := _refusal(text, field.key, choice, fault)) is not None:
                found.setdefault(field.key, {})[choice] = why
    return found


def _refusal(text: str, key: str, choice: str, fault: Callable[[str], str | None]) -> str | None:
    """Return the sentence that refuses a scene with another choice; None: it is possible."""
    try:
        value = scene_text.typed(key, choice, scene_text.tables(text))
        return fault(take_change(text, key, value, is_sound=lambda each: fault(each) is None)[0])
    except SentenceError as refusal:
        return str(refusal)
