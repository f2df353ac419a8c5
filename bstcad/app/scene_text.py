"""Changes of a scene's text that leave the rest as a person wrote it, and what a person types as a value.

A text is taken as pieces: headers, keys with their values, and the lines between.  Pieces that do not change stand as
they did, and tomlkit keeps the writing inside those that do.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Item, Table

from bstcad.app.kinds import STEP, cast, node_at, of_kind, records_at, table_at
from bstcad.app.words import as_words as as_words
from bstcad.app.words import braced, quoted
from bstcad.app.words import shown as shown
from bstcad.app.words import typed as typed
from bstcad.scene import scene_file
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import TAGS, schema

ALIGNED = 2  # spaces before a comment: where there are more, comments stand in a column, which is kept

Steps = tuple[str | int, ...]  # of a table or a key: names, and the number of a table in its list


# ---- a change of the text --------------------------------------------------------------------------------------------


def tables(text: str) -> dict[str, Any]:
    """The tables of a scene's text."""
    found = scene_file.tables(text, Path("the text"))
    if _has_huge(found):
        raise SceneError("the text: has a number of over 300 digits; shorten it")
    return found


def _has_huge(value: Any) -> bool:
    """Is a whole number in it that no decimal number can be?"""
    if isinstance(value, dict | list):
        return any(map(_has_huge, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int) and abs(value) >= 10**300


def changed(text: str, key: str, value: Any) -> str:
    """The text with another value of a dotted key, as `dotted_keys.override` sets it; None takes the key out.

    A value may be as JSON has it: 20 is written 20.0 where the schema has decimal numbers.

    With another kind (source.kind, lens.outline.shape) the table becomes one of that kind: a key that both kinds have,
    with one meaning, stays; others go; and those that the new kind needs come, made of what was there.  Comments go
    with their key or table: behind it, below that in the same column, and inside the table.
    """
    was = tables(text)
    wanted = _wanted(was, key, value)
    if same(was, wanted):
        return text
    try:
        found = "".join(piece.text for piece in _rewritten(pieces(text), (), was, wanted))
    except TOMLKitError:  # it refuses what tomllib takes
        found = ""
    if not same(tables(found), wanted):
        raise SceneError(f"{key}: the text is written in a way that cannot be changed here; change it there by hand")
    return found


def _wanted(was: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The tables with another value; where the schema has a list, a first table is a list, and an empty list goes."""
    from bstcad.scene.dotted_keys import override  # loads torch

    wanted, node = copy.deepcopy(was), node_at(key, was)
    with contextlib.suppress(ValueError):
        value = value if node is None else cast(node, value)
    override(wanted, key, value, key)
    place, _, last = key.rpartition(".")
    if last in TAGS and value is not None and value != table_at(place, was).get(last):
        table = table_at(place, wanted)
        new = of_kind(place, {last: value}, was)
        table.clear()
        table.update(new)
    name = STEP.match(key)[1]
    listed = schema()["properties"].get(name, {}).get("type") == "array"
    if listed and name not in was and isinstance(wanted.get(name), dict):
        wanted[name] = [wanted[name]]
    if value is None and wanted.get(name) == []:
        del wanted[name]
    return wanted


def same(one: Any, other: Any) -> bool:
    """Are two values of TOML the same?  A whole number is its decimal number; true is not 1."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(value, other[name]) for name, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    return repr(one) == repr(other) or (one == other and bool not in (type(one), type(other)))


# ---- pieces of a text ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """Some lines of a text; the pieces, one after the other, are the whole text."""

    text: str  # with its line's end
    role: Literal["header", "key", "comment", "blank"]  # a comment has a line of its own
    path: Steps = ()  # of a header's table, of a key
    table: Steps = ()  # of a key: that of the header above it

    @property
    def stated(self) -> bool:
        """Does it state something, a header or a key?"""
        return self.role in ("header", "key")

    @functools.cached_property
    def item(self) -> Item:
        """What tomlkit reads: the value of a key, the table of a header."""
        return _read(self.text)[1]

    @functools.cached_property
    def column(self) -> int:
        """Where its comment stands in the line; 0: it has none."""
        last = self.text.rstrip("\r\n").rpartition("\n")[2]
        if not self.stated:
            return len(last) - len(last.lstrip())
        return len(last) - len(self.item.trivia.comment) if self.item.trivia.comment else 0


BLANK = Piece("\n", "blank")


def pieces(text: str) -> list[Piece]:
    """The pieces of a valid text."""
    found: list[Piece] = []
    table: Steps = ()
    counts: dict[Steps, int] = {}  # of each list of tables: the number of the last one so far
    lines = iter(re.findall(r"[^\n]*\n|[^\n]+", text))
    for line in lines:
        start = line.strip()[:1]
        if start in ("", "#"):
            found.append(Piece(line, "comment" if start else "blank"))
        elif start == "[":
            table = _numbered(_names(line), counts, listed=line.strip().startswith("[["))
            found.append(Piece(line, "header", table))
        else:
            while not _whole(line):
                line += next(lines)
            found.append(Piece(line, "key", (*table, *_names(line)), table))
    return found


def _whole(lines: str) -> bool:
    """Do some lines hold a key with all of its value?"""
    try:
        return bool(tomllib.loads(lines))
    except tomllib.TOMLDecodeError:
        return False


@functools.lru_cache(4096)  # lines; most are those of the text before a change
def _names(lines: str) -> tuple[str, ...]:
    return _read(lines)[0]


def _read(lines: str) -> tuple[tuple[str, ...], Item]:
    """The names of a key or a header, lens . back . z, and what tomlkit has of it."""
    node: Any = tomlkit.parse(lines)
    names: list[str] = []
    while isinstance(node, tomlkit.TOMLDocument) or (isinstance(node, Table) and len(node)):
        [name] = node
        names.append(str(name))
        node = (node.value if isinstance(node, Table) else node).item(name)
        node = node[0] if isinstance(node, AoT) else node
    return tuple(names), node


def _numbered(names: Sequence[str], counts: dict[Steps, int], listed: bool) -> Steps:
    """The path of a header; listed: it begins another table of its list."""
    path: Steps = ()
    for k, name in enumerate(names, start=1):
        path += (name,)
        if listed and k == len(names):
            counts[path] = counts.get(path, -1) + 1
        path += (counts[path],) if path in counts else ()
    return path


def _behind(found: Sequence[Piece], k: int) -> int:
    """The place behind a piece and the lines that go on with its comment, below it in the same column."""
    column, k = found[k].column, k + 1
    while column and k < len(found) and found[k].role == "comment" and found[k].column == column:
        k += 1
    return k


def _end(found: Sequence[Piece], k: int) -> int:
    """The place behind a table whose last piece this is: also behind comments below, if a blank line follows them."""
    end = over = _behind(found, k)
    while over < len(found) and found[over].role == "comment":
        over += 1
    return end if over < len(found) and found[over].stated else over


# ---- other pieces ----------------------------------------------------------------------------------------------------


def _rewritten(found: list[Piece], path: Steps, was: Any, wanted: Any) -> list[Piece]:
    """The pieces with `wanted` at a path where `was` stood."""
    if same(was, wanted):
        return found
    stated = {piece.path: k for k, piece in enumerate(found) if piece.stated}
    k = stated.get(path)
    if k is not None and found[k].role == "key":
        return [*found[:k], _revalued(found[k], wanted), *found[k + 1 :]]
    if isinstance(was, dict) and isinstance(wanted, dict):
        return _with_table(found, path, was, wanted)
    if isinstance(was, dict) and _of_tables(wanted) and k is not None:
        found, was, stated = [_listed(piece, path) for piece in found], [was], {(*path, 0): k}
    if isinstance(was, list) and _of_tables(wanted) and (*path, 0) in stated:
        return _with_list(found, path, was, wanted)
    return _with(_without(found, path), path, wanted)


def _with_table(found: list[Piece], path: Steps, was: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[Piece]:
    """The same for a table: what comes stands where the first that goes has stood, or in the schema's order."""
    gone = [name for name in was if name not in wanted]
    for name, value in wanted.items():
        if name in was:
            found = _rewritten(found, (*path, name), was[name], value)
        else:
            found = _with(found, (*path, name), value, instead=(*path, *gone[:1]))
    for name in gone:
        found = _without(found, (*path, name))
    return found


def _with_list(found: list[Piece], path: Steps, was: Sequence[Any], wanted: Sequence[Any]) -> list[Piece]:
    """The same for a list of tables that have headers: one is another, one goes, or one comes behind the last."""
    k = next((k for k, (one, other) in enumerate(zip(was, wanted, strict=False)) if not same(one, other)), len(wanted))
    if len(was) > len(wanted):
        return _without(found, (*path, k))
    for k, part in enumerate(wanted):
        known = k < len(was)
        found = _rewritten(found, (*path, k), was[k], part) if known else _with_block(found, (*path, k), part)
    return found


def _listed(piece: Piece, path: Steps) -> Piece:
    """A piece of a table as one of the first table of a list: [target] is [[target]]."""
    text, n = piece.text, len(path)
    if piece.path == path:
        text = text.replace("[", "[[", 1).replace("]", "]]", 1)
    inner = [(*at[:n], 0, *at[n:]) if at[:n] == path else at for at in (piece.path, piece.table)]
    return replace(piece, text=text, path=inner[0], table=inner[1])


def _revalued(piece: Piece, wanted: Any) -> Piece:
    """A key with another value; a comment in a column stays in it."""
    item, trivia = piece.item, piece.item.trivia
    old = item.as_string()
    head = piece.text[: -len(old + trivia.comment_ws + trivia.comment + trivia.trail)]
    new, space = _raw(_edited(item, wanted)), trivia.comment_ws
    if trivia.comment and len(space) > ALIGNED and "\n" not in old + new:
        space = " " * max(ALIGNED, len(space) + len(old) - len(new))
    return replace(piece, text=head + new + space + trivia.comment + trivia.trail)


def _edited(item: Any, wanted: Any) -> Any:
    """A value of tomlkit's with another content: what is the same in it stays as it is written."""
    was = item.unwrap() if isinstance(item, Item) else item
    if same(was, wanted):
        return item
    if isinstance(was, dict) and isinstance(wanted, dict) and was.keys() == wanted.keys():
        for name, value in wanted.items():
            item[name] = _edited(item[name], value)
        return item
    if isinstance(was, dict) and isinstance(wanted, dict):
        parts = {name: _raw(_edited(item[name], v)) if name in was else shown(v) for name, v in wanted.items()}
        return tomlkit.value(braced(parts))
    if isinstance(was, list) and isinstance(wanted, list) and was and wanted:
        del item[len(wanted) :]
        for k, value in enumerate(wanted):
            if k < len(was):
                item[k] = _edited(item[k], value)
            else:
                item.append(tomlkit.value(shown(value)))
        return item
    return tomlkit.value(shown(wanted))


def _raw(item: Any) -> str:
    """A value of tomlkit's, which has some as Python's own, as it is written."""
    return item.as_string() if isinstance(item, Item) else shown(item)


def _without(found: list[Piece], path: Steps) -> list[Piece]:
    """The pieces without a key or a table, and what goes with it."""
    own = [k for k, piece in enumerate(found) if piece.stated and piece.path[: len(path)] == path]
    dropped = {j for k in own for j in range(k, _behind(found, k))}
    for k, after in itertools.pairwise(own):
        inside = found[after].role == "header" or found[after].table[: len(path)] == path
        if inside and not any(piece.stated for piece in found[k + 1 : after]):
            dropped |= set(range(k, after))
    if own and found[own[0]].role == "header":
        end = _end(found, own[-1])
        dropped |= set(range(own[-1], end))
        if own[0] and found[own[0] - 1].role == "blank" and (end == len(found) or found[end].role == "blank"):
            dropped.add(own[0] - 1)
    return [piece for k, piece in enumerate(found) if k not in dropped]


def _with(found: list[Piece], path: Steps, value: Any, instead: Steps = ()) -> list[Piece]:
    """The pieces with a key or a table that was not there; instead: the key whose place it takes."""
    if _has_header(path, value):
        return _with_block(found, path, value)
    parent = path[:-1]
    beside = {  # the keys of the same table, also where only a key of a table in it has a line
        k: piece.path[: len(path)] for k, piece in enumerate(found)
        if piece.role == "key" and piece.path[: len(parent)] == parent and len(piece.table) <= len(parent)
    }  # fmt: skip
    near = next((k for k, key in beside.items() if key == instead), None)
    if near is not None:
        return _inserted(found, near, [_line(path, value, beside=found[near])])
    before = [k for k, key in beside.items() if _rank(key) <= _rank(path)]
    headers = [k for k, piece in enumerate(found) if piece.role == "header" and piece.path == parent]
    if before or headers:
        near = max(before, key=lambda k: (_rank(beside[k]), k)) if before else headers[0]
        return _inserted(found, _behind(found, near), [_line(path, value, beside=found[near])])
    if beside:
        return _inserted(found, min(beside), [_line(path, value, beside=found[min(beside)])])
    where = next(
        (k for k, piece in enumerate(found) if piece.stated and piece.path[: len(parent)] == parent), len(found)
    )
    new = _block(parent, {path[-1]: value}) if parent else [_line(path, value, beside=None)]
    return _inserted(found, where, [*new, BLANK])


def _with_block(found: list[Piece], path: Steps, value: Any) -> list[Piece]:
    """The same for tables with headers: behind the table that they are in or follow, or the schema has before them."""
    above = (*path[:-1], path[-1] - 1) if isinstance(path[-1], int) else path[:-1]
    if not above:
        sections = {piece.path[:1] for piece in found if piece.stated and (piece.role, len(piece.path)) != ("key", 1)}
        above = max((each for each in sections if _rank(each) < _rank(path)), key=_rank, default=(None,))
    last = max((k for k, p in enumerate(found) if p.stated and p.path[: len(above)] == above), default=-1)
    where = next((k for k, piece in enumerate(found) if k > last and piece.role == "header"), len(found))
    if stated := [k for k in range(where) if found[k].stated]:
        where = _end(found, stated[-1])
    free = where == len(found) or found[where].role == "blank"
    return _inserted(found, where, [BLANK] * bool(where) + _block(path, value) + [BLANK] * (not free))


def _inserted(found: list[Piece], where: int, new: Sequence[Piece]) -> list[Piece]:
    """The pieces with others at a place; lines end as theirs do."""
    end = "\r\n" if any(piece.text.endswith("\r\n") for piece in found) else "\n"
    before = [*found[:where], *(replace(piece, text=piece.text.replace("\n", end)) for piece in new)]
    if where and not found[where - 1].text.endswith("\n"):
        before[where - 1] = replace(found[where - 1], text=found[where - 1].text + end)
    return [*before, *found[where:]]


def _line(path: Steps, value: Any, beside: Piece | None) -> Piece:
    """A key in the table of another key, or under a header."""
    table, indent = path[:-1], ""
    if beside is not None and beside.role == "key":
        table, indent = beside.table, re.match(r"[ \t]*", beside.text)[0]
    return Piece(f"{indent}{'.'.join(map(quoted, path[len(table) :]))} = {shown(value)}\n", "key", path, table)


def _block(path: Steps, value: Any) -> list[Piece]:
    """A table, or a list of tables, under headers."""
    if isinstance(value, list):
        blocks = [_block((*path, k), part) for k, part in enumerate(value)]
        return blocks[0] + [piece for block in blocks[1:] for piece in (BLANK, *block)]
    names = ".".join(quoted(step) for step in path if isinstance(step, str))
    inner = {name: part for name, part in value.items() if _has_header((*path, name), part)}
    header = Piece(f"[[{names}]]\n" if isinstance(path[-1], int) else f"[{names}]\n", "header", path)
    lines = [_line((*path, name), part, beside=None) for name, part in value.items() if name not in inner]
    blocks = [piece for name, part in inner.items() for piece in (BLANK, *_block((*path, name), part))]
    return [header, *lines, *blocks]


def _of_tables(value: Any) -> bool:
    """Is it a list of tables?"""
    return isinstance(value, list) and bool(value) and all(isinstance(part, dict) for part in value)


def _has_header(path: Steps, value: Any) -> bool:
    """Does a table, or a list of tables, get a header of its own?  Inside a section only one that has tables itself."""
    if isinstance(value, list):
        return len(path) == 1 and _of_tables(value)
    inner = isinstance(value, dict) and (len(path) == 1 or any(isinstance(part, dict) for part in value.values()))
    return inner and all(isinstance(step, str) for step in path)


def _rank(path: Steps) -> int:
    """The place of a key among those that its table may have: its kind comes first, then all in the schema's order."""
    union = records_at(".".join(step for step in path[:-1] if isinstance(step, str)), {})
    names = [*TAGS, *(name for record in union for name in record["properties"])]
    return names.index(path[-1]) if path[-1] in names else len(names)
