"""Transliteration of names and titles for file formats whose text is ASCII or Latin-1.

Accents are dropped, other letters are spelled by their names in Unicode ("ж": "zhe"), and other signs have their code.
"""

from __future__ import annotations

import re
import unicodedata

SIGNS = {
    "ß": "ss", "ẞ": "SS", "µ": "u", "μ": "u", "°": " degrees", "×": "x", "−": "-", "·": "-", "•": "-", "⁄": "/",
    "’": "'", "‘": "'", "‚": "'", "„": '"', "œ": "oe", "Œ": "OE", "№": "No",
}  # fmt: skip
LETTER = re.compile(r"(?:LETTER|LIGATURE|SYLLABLE) (?:(?:DOTLESS|FINAL|SMALL|SHORT) )?(\w+)")  # part of a Unicode name
QUOTES = ("Pi", "Pf")  # Unicode categories of opening and closing quotation marks
DASHES = ("Pd",)  # Unicode category of dashes


def transliterate(text: str, encoding: str = "ascii") -> str:
    """Return a text whose characters are printable and exist in an encoding; spaces replace control characters."""
    return "".join(_spelled(sign, encoding) for sign in text)


def _spelled(sign: str, encoding: str) -> str:
    if not sign.isprintable():
        return " "
    if sign.isascii() or sign.encode(encoding, "ignore"):
        return sign
    if sign in SIGNS:
        return SIGNS[sign]
    category, name = unicodedata.category(sign), unicodedata.name(sign, "")
    if category[0] == "M":
        return ""
    plain = unicodedata.normalize("NFKD", sign)
    if category != "Lo" and plain != sign:  # a kana or a Hangul syllable is one sound with its marks
        return transliterate(plain, encoding)
    if found := LETTER.search(name):
        return found[1].capitalize() if category == "Lu" else found[1].lower()
    return '"' if category in QUOTES else "-" if category in DASHES else f"U+{ord(sign):04X}"
