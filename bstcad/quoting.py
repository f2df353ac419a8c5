"""Sentences that quote a file, which may hold anything."""

from __future__ import annotations

LONGEST = 600  # characters of a sentence


def one_line(text: object) -> str:
    """The text without what would break a line or steer a terminal, its middle left out if that is long.

    Sentences quote files, and a file may hold anything.
    """
    text = _cut(str(text))
    return text if text.isprintable() else _cut("".join(c if c.isprintable() else repr(c)[1:-1] for c in text))


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]}…{text[1 - LONGEST // 2 :]}"
