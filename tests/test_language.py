"""Plain words (CONTRIBUTING, *Style*): docstrings and comments begin with a verb or with their noun."""

import ast
import functools
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = [ROOT / "generate_lens.py", *sorted((ROOT / "bstcad").rglob("*.py")), *sorted((ROOT / "tests").rglob("*.py"))]
# First words that stand for a noun, or that continue a sentence which nobody has begun.
STANDS_FOR_A_NOUN = (
    "of|that|those|these|they|them|it|its|the same|what|which|whose|whether|how|where|why|as|nobody|"
    "by|from|to|at|in|with|for|on|and|or|so|than|times"
)
IN_DOCSTRING = re.compile(rf"(?:{STANDS_FOR_A_NOUN})\b", re.IGNORECASE)
IN_COMMENT = re.compile(rf"(?:{STANDS_FOR_A_NOUN}|is|are|does|do|has|have)\b", re.IGNORECASE)
COMMENT_AT_FAULT = re.compile(rf"#[#: ]*{IN_COMMENT.pattern}", re.IGNORECASE)  # a comment at fault, or a string like it
# The start of a docstring at fault, after the colon of a definition or at the top, or a string like it.
DOCSTRING_AT_FAULT = re.compile(rf"(?:\A|:)(?:\s*#.*\n)*\s*[rRuU]?[\"']+\s*(?:{STANDS_FOR_A_NOUN})\b", re.IGNORECASE)
CONSTANT_AT_FAULT = re.compile(
    rf"^(?: {{4}})*[A-Za-z_(\[][^#\n]*[:=].*{COMMENT_AT_FAULT.pattern}", re.IGNORECASE | re.MULTILINE
)
DIRECTIVE = re.compile(r"(?:fmt|noqa|type|pragma):")


def comments_of(text: str) -> dict[int, str]:
    """Return the comment of each line that has one, without its mark."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {t.start[0]: t.string.lstrip("#: ") for t in tokens if t.type == tokenize.COMMENT}


def offences(text: str) -> list[str]:
    """Docstrings, and comments beside constants and fields of records, that begin badly: "LINE: first words"."""
    if not (CONSTANT_AT_FAULT.search(text) or DOCSTRING_AT_FAULT.search(text)):
        return []  # most files, whose trees would take two seconds
    tree, lines, found = ast.parse(text), text.split("\n"), []
    comments = functools.cache(lambda: comments_of(text))  # tokens take ten times as long as the tree
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            docstring = ast.get_docstring(node)
            if docstring and IN_DOCSTRING.match(docstring):
                found.append((getattr(node, "lineno", 1), docstring))
        if isinstance(node, (ast.Module, ast.ClassDef)):
            for statement in node.body:
                named = isinstance(statement, (ast.Assign, ast.AnnAssign))
                if not (named and COMMENT_AT_FAULT.search(lines[statement.lineno - 1])):
                    continue
                comment = comments().get(statement.lineno, "")
                if IN_COMMENT.match(comment) and not DIRECTIVE.match(comment):
                    found.append((statement.lineno, comment))
    return [f"{line}: {words[:60]}" for line, words in sorted(found)]


def test_docstrings_and_comments_begin_with_a_verb_or_a_noun():
    bad = [f"{path.relative_to(ROOT)}:{each}" for path in SOURCES for each in offences(path.read_text())]
    assert not bad, f"{len(bad)} begin in mid-sentence:\n" + "\n".join(bad)


@pytest.mark.parametrize(
    "text",
    [
        '"""Of the points of its placeholder."""',
        'def f():\n    """The same with all figures."""',
        'class A:\n    """A record."""\n\n    x: float  # in mm',
        "MOST = 4  # times the mean",
        "FAR: float = 1.0  # as far as that",
    ],
)
def test_a_sentence_without_its_noun_is_found(text):
    assert len(offences(text)) == 1


def test_sentences_with_their_noun_pass():
    constant = "MAX_WEIGHT = 4.0  # largest local weight of the merit\n"
    text = f'"""Fit slopes."""\n\n{constant}\ndef f():\n    """Return z (mm)."""\n'
    assert not offences(text)
