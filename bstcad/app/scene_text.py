"""Changes of a scene's text that preserve everything else as a person wrote it.

A text is split into pieces: headers, keys with their values, and the lines between.  Unchanged pieces stay as they are,
and tomlkit preserves the style inside a changed piece.
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

from bstcad.app.kinds import KEY_PART, cast, convert_table, node_at, records_at, table_at
from bstcad.app.words import as_toml as as_toml
from bstcad.app.words import as_words as as_words
from bstcad.app.words import inline_table, toml_key
from bstcad.app.words import typed as typed
from bstcad.scene import scene_file
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import TAGS, schema

MIN_COMMENT_GAP = 2  # usual number of spaces before a comment; wider gaps align comments in a column, which is kept

KeyPath = tuple[str | int, ...]  # path of a table or a key: names, and numbers of tables in lists


# ---- a change of the text --------------------------------------------------------------------------------------------


def tables(text: str) -> dict[str, Any]:
    """Return the tables of a scene's text."""
    found = scene_file.tables(text, Path("the text"))
    if _has_huge(found):
        raise SceneError("the text contains a number of over 300 digits; shorten it")
    return found


def _has_huge(value: Any) -> bool:
    """Return True if the value contains an integer of more than 300 digits."""
    if isinstance(value, dict | list):
        return any(map(_has_huge, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int) and abs(value) >= 10**300


def changed(text: str, key: str, value: Any) -> str:
    """Return the text with another value of a dotted key, as `dotted_keys.override` sets it; None removes the key.

    A value may come from JSON: 20 is written as 20.0 if the schema has a float.
    With another kind (source.kind, lens.outline.shape) the table is converted: keys with the same meaning in both kinds
    stay, other keys are removed, and missing keys are added with values that fit the scene.  A key or table is removed
    with its comments: after it on the line, on the lines below in the same column, and inside the table.
    """
    before = tables(text)
    after = _changed_tables(before, key, value)
    if is_same(before, after):
        return text
    try:
        found = "".join(piece.text for piece in _update(pieces(text), (), before, after))
    except TOMLKitError:  # tomlkit refuses some texts that tomllib accepts
        found = ""
    if not is_same(tables(found), after):
        raise SceneError(f"{key}: the form cannot change this text, because of its layout; edit the text itself")
    return found


def _changed_tables(before: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Return the tables with another value of a key.  A new table becomes a list if the schema requires a list."""
    from bstcad.scene.dotted_keys import override  # loads torch

    after, node = copy.deepcopy(before), node_at(key, before)
    with contextlib.suppress(ValueError):
        value = value if node is None else cast(node, value)
    override(after, key, value, key)
    parent, _, last = key.rpartition(".")
    if last in TAGS and value is not None and value != table_at(parent, before).get(last):
        table = table_at(parent, after)
        new = convert_table(parent, {last: value}, before)
        table.clear()
        table.update(new)
    name = KEY_PART.match(key)[1]
    listed = schema()["properties"].get(name, {}).get("type") == "array"
    if listed and name not in before and isinstance(after.get(name), dict):
        after[name] = [after[name]]
    if value is None and after.get(name) == []:
        del after[name]
    return after


def is_same(one: Any, other: Any) -> bool:
    """Return True if two values of TOML are equal; 1 and 1.0 are equal, 1 and `true` are not."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(is_same(value, other[name]) for name, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(is_same, one, other))
    return repr(one) == repr(other) or (one == other and bool not in (type(one), type(other)))


# ---- pieces of a text ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """Lines of a text; the pieces in sequence make the whole text."""

    text: str  # lines with their line ends
    role: Literal["header", "key", "comment", "blank"]  # "comment" is a comment on its own line
    path: KeyPath = ()  # path of the header's table, or of the key
    table: KeyPath = ()  # path of the header above a key

    @property
    def is_statement(self) -> bool:
        """True for a header or a key."""
        return self.role in ("header", "key")

    @functools.cached_property
    def item(self) -> Item:
        """Value of the key, or table of the header, as tomlkit reads it."""
        return _read(self.text)[1]

    @functools.cached_property
    def column(self) -> int:
        """Column of the comment in its line; 0 without a comment."""
        last = self.text.rstrip("\r\n").rpartition("\n")[2]
        if not self.is_statement:
            return len(last) - len(last.lstrip())
        return len(last) - len(self.item.trivia.comment) if self.item.trivia.comment else 0


BLANK = Piece("\n", "blank")


def pieces(text: str) -> list[Piece]:
    """Split a valid text into pieces."""
    found: list[Piece] = []
    table: KeyPath = ()
    counts: dict[KeyPath, int] = {}  # number of the last table so far, by list of tables
    lines = iter(re.findall(r"[^\n]*\n|[^\n]+", text))
    for line in lines:
        start = line.strip()[:1]
        if start in ("", "#"):
            found.append(Piece(line, "comment" if start else "blank"))
        elif start == "[":
            table = _numbered(_names(line), counts, listed=line.strip().startswith("[["))
            found.append(Piece(line, "header", table))
        else:
            while not _is_complete(line):
                line += next(lines)
            found.append(Piece(line, "key", (*table, *_names(line)), table))
    return found


def _is_complete(lines: str) -> bool:
    try:
        return bool(tomllib.loads(lines))
    except tomllib.TOMLDecodeError:
        return False


@functools.lru_cache(4096)  # most lines stay the same from change to change
def _names(lines: str) -> tuple[str, ...]:
    return _read(lines)[0]


def _read(lines: str) -> tuple[tuple[str, ...], Item]:
    """Return the names of a key or a header, such as lens, back, z, and its item as tomlkit reads it."""
    node: Any = tomlkit.parse(lines)
    names: list[str] = []
    while isinstance(node, tomlkit.TOMLDocument) or (isinstance(node, Table) and len(node)):
        [name] = node
        names.append(str(name))
        node = (node.value if isinstance(node, Table) else node).item(name)
        node = node[0] if isinstance(node, AoT) else node
    return tuple(names), node


def _numbered(names: Sequence[str], counts: dict[KeyPath, int], listed: bool) -> KeyPath:
    """Return the path of a header, and count its table in `counts`.  listed: the header begins a table of a list."""
    path: KeyPath = ()
    for k, name in enumerate(names, start=1):
        path += (name,)
        if listed and k == len(names):
            counts[path] = counts.get(path, -1) + 1
        path += (counts[path],) if path in counts else ()
    return path


def _after_comment(found: Sequence[Piece], k: int) -> int:
    """Return the index after piece `k` and after the lines that continue its comment in the same column."""
    column, k = found[k].column, k + 1
    while column and k < len(found) and found[k].role == "comment" and found[k].column == column:
        k += 1
    return k


def _table_end(found: Sequence[Piece], k: int) -> int:
    """Return the index after a table with last piece `k`, and after comments below that no statement follows."""
    end = over = _after_comment(found, k)
    while over < len(found) and found[over].role == "comment":
        over += 1
    return end if over < len(found) and found[over].is_statement else over


# ---- changes of pieces -----------------------------------------------------------------------------------------------


def _update(found: list[Piece], path: KeyPath, before: Any, after: Any) -> list[Piece]:
    if is_same(before, after):
        return found
    stated = {piece.path: k for k, piece in enumerate(found) if piece.is_statement}
    k = stated.get(path)
    if k is not None and found[k].role == "key":
        return [*found[:k], _set_value(found[k], after), *found[k + 1 :]]
    if isinstance(before, dict) and isinstance(after, dict):
        return _update_table(found, path, before, after)
    if isinstance(before, dict) and _is_table_list(after) and k is not None:
        found, before, stated = [_as_list_item(piece, path) for piece in found], [before], {(*path, 0): k}
    if isinstance(before, list) and _is_table_list(after) and (*path, 0) in stated:
        return _update_list(found, path, before, after)
    return _add(_remove(found, path), path, after)


def _update_table(
    found: list[Piece], path: KeyPath, before: Mapping[str, Any], after: Mapping[str, Any]
) -> list[Piece]:
    """Change a table to `after`; new keys are put in place of the first removed key, or else in the schema's order."""
    gone = [name for name in before if name not in after]
    for name, value in after.items():
        if name in before:
            found = _update(found, (*path, name), before[name], value)
        else:
            found = _add(found, (*path, name), value, instead=(*path, *gone[:1]))
    for name in gone:
        found = _remove(found, (*path, name))
    return found


def _update_list(found: list[Piece], path: KeyPath, before: Sequence[Any], after: Sequence[Any]) -> list[Piece]:
    """Change a list of tables with headers to `after`: tables change, one table is removed, or tables are appended."""
    k = next(
        (k for k, (one, other) in enumerate(zip(before, after, strict=False)) if not is_same(one, other)), len(after)
    )
    if len(before) > len(after):
        return _remove(found, (*path, k))
    for k, part in enumerate(after):
        known = k < len(before)
        found = _update(found, (*path, k), before[k], part) if known else _add_table(found, (*path, k), part)
    return found


def _as_list_item(piece: Piece, path: KeyPath) -> Piece:
    """Return a piece of a table as a piece of the first table of a list: [target] becomes [[target]]."""
    text, n = piece.text, len(path)
    if piece.path == path:
        text = text.replace("[", "[[", 1).replace("]", "]]", 1)
    inner = [(*at[:n], 0, *at[n:]) if at[:n] == path else at for at in (piece.path, piece.table)]
    return replace(piece, text=text, path=inner[0], table=inner[1])


def _set_value(piece: Piece, after: Any) -> Piece:
    """Return the piece of a key with the value `after`; an aligned comment stays in its column."""
    item, trivia = piece.item, piece.item.trivia
    old = item.as_string()
    head = piece.text[: -len(old + trivia.comment_ws + trivia.comment + trivia.trail)]
    new, space = _source_text(_edit_value(item, after)), trivia.comment_ws
    if trivia.comment and len(space) > MIN_COMMENT_GAP and "\n" not in old + new:
        space = " " * max(MIN_COMMENT_GAP, len(space) + len(old) - len(new))
    return replace(piece, text=head + new + space + trivia.comment + trivia.trail)


def _edit_value(item: Any, after: Any) -> Any:
    """Return an item of tomlkit with the content `after`; equal parts keep their style."""
    before = item.unwrap() if isinstance(item, Item) else item
    if is_same(before, after):
        return item
    if isinstance(before, dict) and isinstance(after, dict) and before.keys() == after.keys():
        for name, value in after.items():
            item[name] = _edit_value(item[name], value)
        return item
    if isinstance(before, dict) and isinstance(after, dict):
        parts = {
            name: _source_text(_edit_value(item[name], v)) if name in before else as_toml(v)
            for name, v in after.items()
        }
        return tomlkit.value(inline_table(parts))
    if isinstance(before, list) and isinstance(after, list) and before and after:
        del item[len(after) :]
        for k, value in enumerate(after):
            if k < len(before):
                item[k] = _edit_value(item[k], value)
            else:
                item.append(tomlkit.value(as_toml(value)))
        return item
    return tomlkit.value(as_toml(after))


def _source_text(item: Any) -> str:
    return item.as_string() if isinstance(item, Item) else as_toml(item)


def _remove(found: list[Piece], path: KeyPath) -> list[Piece]:
    own = [k for k, piece in enumerate(found) if piece.is_statement and piece.path[: len(path)] == path]
    dropped = {j for k in own for j in range(k, _after_comment(found, k))}
    for k, after in itertools.pairwise(own):
        inside = found[after].role == "header" or found[after].table[: len(path)] == path
        if inside and not any(piece.is_statement for piece in found[k + 1 : after]):
            dropped |= set(range(k, after))
    if own and found[own[0]].role == "header":
        end = _table_end(found, own[-1])
        dropped |= set(range(own[-1], end))
        if own[0] and found[own[0] - 1].role == "blank" and (end == len(found) or found[end].role == "blank"):
            dropped.add(own[0] - 1)
    return [piece for k, piece in enumerate(found) if k not in dropped]


def _add(found: list[Piece], path: KeyPath, value: Any, instead: KeyPath = ()) -> list[Piece]:
    """Add a key or a table.  instead: path of the key at whose position it is put."""
    if _has_header(path, value):
        return _add_table(found, path, value)
    parent = path[:-1]
    beside = {  # keys of the same table, by index; a dotted line states a key of an inner table
        k: piece.path[: len(path)]
        for k, piece in enumerate(found)
        if piece.role == "key" and piece.path[: len(parent)] == parent and len(piece.table) <= len(parent)
    }
    near = next((k for k, key in beside.items() if key == instead), None)
    if near is not None:
        return _insert(found, near, [_key_piece(path, value, beside=found[near])])
    before = [k for k, key in beside.items() if _rank(key) <= _rank(path)]
    headers = [k for k, piece in enumerate(found) if piece.role == "header" and piece.path == parent]
    if before or headers:
        near = max(before, key=lambda k: (_rank(beside[k]), k)) if before else headers[0]
        return _insert(found, _after_comment(found, near), [_key_piece(path, value, beside=found[near])])
    if beside:
        return _insert(found, min(beside), [_key_piece(path, value, beside=found[min(beside)])])
    where = next(
        (k for k, piece in enumerate(found) if piece.is_statement and piece.path[: len(parent)] == parent), len(found)
    )
    new = _table_pieces(parent, {path[-1]: value}) if parent else [_key_piece(path, value, beside=None)]
    return _insert(found, where, [*new, BLANK])


def _add_table(found: list[Piece], path: KeyPath, value: Any) -> list[Piece]:
    """Add tables with headers, after the table that contains or precedes them, else by the schema's order."""
    above = (*path[:-1], path[-1] - 1) if isinstance(path[-1], int) else path[:-1]
    if not above:
        sections = {
            piece.path[:1] for piece in found if piece.is_statement and (piece.role, len(piece.path)) != ("key", 1)
        }
        above = max((each for each in sections if _rank(each) < _rank(path)), key=_rank, default=(None,))
    last = max((k for k, p in enumerate(found) if p.is_statement and p.path[: len(above)] == above), default=-1)
    where = next((k for k, piece in enumerate(found) if k > last and piece.role == "header"), len(found))
    if stated := [k for k in range(where) if found[k].is_statement]:
        where = _table_end(found, stated[-1])
    free = where == len(found) or found[where].role == "blank"
    return _insert(found, where, [BLANK] * bool(where) + _table_pieces(path, value) + [BLANK] * (not free))


def _insert(found: list[Piece], where: int, new: Sequence[Piece]) -> list[Piece]:
    end = "\r\n" if any(piece.text.endswith("\r\n") for piece in found) else "\n"
    before = [*found[:where], *(replace(piece, text=piece.text.replace("\n", end)) for piece in new)]
    if where and not found[where - 1].text.endswith("\n"):
        before[where - 1] = replace(found[where - 1], text=found[where - 1].text + end)
    return [*before, *found[where:]]


def _key_piece(path: KeyPath, value: Any, beside: Piece | None) -> Piece:
    """Return the piece of a key, in the table of the key `beside` it or under a header."""
    table, indent = path[:-1], ""
    if beside is not None and beside.role == "key":
        table, indent = beside.table, re.match(r"[ \t]*", beside.text)[0]
    return Piece(f"{indent}{'.'.join(map(toml_key, path[len(table) :]))} = {as_toml(value)}\n", "key", path, table)


def _table_pieces(path: KeyPath, value: Any) -> list[Piece]:
    if isinstance(value, list):
        blocks = [_table_pieces((*path, k), part) for k, part in enumerate(value)]
        return blocks[0] + [piece for block in blocks[1:] for piece in (BLANK, *block)]
    names = ".".join(toml_key(step) for step in path if isinstance(step, str))
    inner = {name: part for name, part in value.items() if _has_header((*path, name), part)}
    header = Piece(f"[[{names}]]\n" if isinstance(path[-1], int) else f"[{names}]\n", "header", path)
    lines = [_key_piece((*path, name), part, beside=None) for name, part in value.items() if name not in inner]
    blocks = [piece for name, part in inner.items() for piece in (BLANK, *_table_pieces((*path, name), part))]
    return [header, *lines, *blocks]


def _is_table_list(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(part, dict) for part in value)


def _has_header(path: KeyPath, value: Any) -> bool:
    """Return True if a table or list of tables gets a header; an inner table gets one only if it contains tables."""
    if isinstance(value, list):
        return len(path) == 1 and _is_table_list(value)
    inner = isinstance(value, dict) and (len(path) == 1 or any(isinstance(part, dict) for part in value.values()))
    return inner and all(isinstance(step, str) for step in path)


def _rank(path: KeyPath) -> int:
    """Return the rank of a key in its table: the kind comes first, then all keys in the schema's order."""
    union = records_at(".".join(step for step in path[:-1] if isinstance(step, str)), {})
    names = [*TAGS, *(name for record in union for name in record["properties"])]
    return names.index(path[-1]) if path[-1] in names else len(names)
