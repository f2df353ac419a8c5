"""Checkpoints: the state of tailoring in one file beside the output folder, so that no work is lost.

A checkpoint is complete or absent: it is written under another name, flushed to disk and renamed.  The file holds
numbers and text only: a line with the format's version, a line with the SHA-256 of the rest, and an npz archive of the
arrays, in which the array `tree` is the JSON text of everything else.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import repeat
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import torch

from bstcad import files

MAGIC = b"bstcad checkpoint 3\n"
LARGEST = 8 << 30  # bytes; 2049 x 2049 control points need 1 GB
EVERY = 10.0  # least seconds between two checkpoints
SHARE = 0.02  # the most of the run's time that checkpoints may take
ARRAY = "array"  # {"array": "3"} in the tree stands for the array of that name

Purpose = dict[str, Any]  # the design that a checkpoint belongs to: numbers, text, None, lists and dicts of them
# A state is a record: a frozen dataclass of numbers, text, None, arrays, tensors, tuples and such records.


class CheckpointError(files.SentenceError, ValueError):
    """An unusable checkpoint; the text is one sentence with a remedy."""


def as_tree(value: Any) -> Any:
    """A frozen dataclass as a dict of its fields, its records likewise; arrays are shared, not copied."""
    if is_dataclass(value):
        return {field.name: as_tree(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: as_tree(part) for key, part in value.items()}
    return [as_tree(part) for part in value] if isinstance(value, list | tuple) else value


def as_record(kind: Any, tree: Any) -> Any:
    """The inverse of `as_tree` for a value of a kind, as dataclasses annotate types; TypeError for another value."""
    if kind is Any:
        return tree
    if isinstance(kind, type) and is_dataclass(kind):
        kinds = get_type_hints(kind)
        if not isinstance(tree, dict) or tree.keys() != {field.name for field in fields(kind)}:
            raise TypeError(f"no {kind.__name__}")
        return kind(**{name: as_record(kinds[name], part) for name, part in tree.items()})
    origin, parts = get_origin(kind) or kind, get_args(kind)
    if origin in (Union, UnionType):
        return as_record(_which(parts, tree), tree)
    if kind is float and isinstance(tree, int) and not isinstance(tree, bool):
        return tree
    if not isinstance(tree, origin):
        raise TypeError(f"{type(tree).__name__} is no {origin.__name__}")
    if origin is tuple and parts:
        each = repeat(parts[0], len(tree)) if parts[-1] is ... else parts
        return tuple(as_record(kind, part) for kind, part in zip(each, tree, strict=True))
    if issubclass(origin, Mapping) and parts:
        return {key: as_record(parts[1], part) for key, part in tree.items()}
    return tree


def _which(kinds: tuple[Any, ...], tree: Any) -> Any:
    """The first of several kinds that fits a tree; records differ by the names of their fields."""
    for kind in kinds:
        try:
            as_record(kind, tree)
        except (TypeError, ValueError):
            continue
        return kind
    raise TypeError(f"{type(tree).__name__} is none of {len(kinds)} kinds")


def path_for(folder: Path) -> Path:
    """The checkpoint of an output folder: a hidden file beside it."""
    folder = folder.resolve()
    return folder.with_name(f".{folder.name}.checkpoint")


def write(path: Path, purpose: Purpose, state: Any) -> None:
    """Put a checkpoint of a design (`purpose`) at `path`, whole or not at all; OSError."""
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps([purpose, _without_arrays(as_tree(state), arrays)])
    packed = io.BytesIO()
    np.savez(packed, tree=np.frombuffer(tree.encode(), dtype=np.uint8), **arrays)  # type: ignore[arg-type]
    body = packed.getbuffer()
    building = path.with_name(f"{path.name}-{os.getpid()}")
    try:
        with building.open("wb") as file:
            file.write(MAGIC)
            file.write(hashlib.sha256(body).hexdigest().encode() + b"\n")
            file.write(body)
            file.flush()
            os.fsync(file.fileno())
        os.replace(building, path)
    except BaseException:
        with contextlib.suppress(OSError):
            building.unlink()
        raise


def _in_refuge(name: str, purpose: Purpose, state: Any) -> Path:
    """Put a checkpoint into a new temporary folder; the path of the checkpoint.  An error leaves no folder."""
    folder = Path(tempfile.mkdtemp(prefix="bstcad-"))
    try:
        write(folder / name, purpose, state)
    except BaseException:
        folder.rmdir()
        raise
    return folder / name


def read(path: Path, kind: type = dict) -> tuple[Purpose, Any]:
    """(purpose, state) of the checkpoint at `path`, the state a record of a kind; CheckpointError.

    kind `dict`: the state as `as_tree` makes it, with tuples for lists.
    """
    try:
        content = files.contents(path, LARGEST)
    except ValueError as error:
        raise CheckpointError(f"{path}: cannot be read ({error}); start without --resume") from error
    magic, digest, body = content[: len(MAGIC)], content[len(MAGIC) : len(MAGIC) + 65], content[len(MAGIC) + 65 :]
    if magic != MAGIC:
        found = repr(magic.partition(b"\n")[0].decode("latin-1"))
        raise CheckpointError(f"{path}: is no checkpoint of this version ({found}); start without --resume")
    if digest != hashlib.sha256(body).hexdigest().encode() + b"\n":
        raise CheckpointError(f"{path}: is damaged (its checksum does not fit); start without --resume")
    try:
        if any(part.compress_type for part in zipfile.ZipFile(io.BytesIO(body)).infolist()):
            raise ValueError  # we write none: it could unpack to any size
        with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
            purpose, tree = json.loads(arrays["tree"].tobytes())
            return purpose, as_record(kind, _with_arrays(tree, arrays))
    except Exception as error:  # a foreign file with a right checksum
        raise CheckpointError(f"{path}: is no checkpoint of bstcad's; start without --resume") from error


def _without_arrays(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Move each array of a tree into `arrays` and leave its name there."""
    if isinstance(value, torch.Tensor):
        return {"tensor": _without_arrays(value.detach().cpu().numpy(), arrays)}
    if isinstance(value, np.ndarray):
        arrays[str(len(arrays))] = value
        return {ARRAY: str(len(arrays) - 1)}
    if isinstance(value, dict):
        return {key: _without_arrays(v, arrays) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_arrays(v, arrays) for v in value]
    return value


def _with_arrays(value: Any, arrays: Any) -> Any:
    if isinstance(value, dict):
        if value.keys() == {ARRAY}:
            return arrays[value[ARRAY]]
        if value.keys() == {"tensor"}:
            return torch.from_numpy(_with_arrays(value["tensor"], arrays))
        return {key: _with_arrays(v, arrays) for key, v in value.items()}
    return tuple(_with_arrays(v, arrays) for v in value) if isinstance(value, list) else value


def on_device(state: Any, device: str) -> Any:
    """A state with its tensors on a device: a file knows none."""
    if isinstance(state, torch.Tensor):
        return state.to(device)
    if is_dataclass(state) and not isinstance(state, type):
        return replace(state, **{f.name: on_device(getattr(state, f.name), device) for f in fields(state)})
    if isinstance(state, Mapping):
        return {key: on_device(value, device) for key, value in state.items()}
    return type(state)(on_device(value, device) for value in state) if isinstance(state, list | tuple) else state


@dataclass
class Keeper:
    """Holds the latest state of a design and writes it to disk now and then."""

    path: Path
    purpose: Purpose
    say: Callable[[str], None] = print  # called with a sentence when writing fails
    every: float = EVERY
    latest: Any = None
    kind: type = dict  # of the states

    def __post_init__(self) -> None:
        self._written: Any = None  # the state in the file
        self._own = False  # did this run write the file?
        self._due = time.monotonic() + self.every

    def __call__(self, state: Any) -> None:
        """Take a state from which the design could go on; nobody may change it afterwards."""
        self.latest = state
        if time.monotonic() >= self._due:
            self.flush()

    def flush(self) -> bool:
        """Write the latest state; is a checkpoint on disk?  A full disk does not end a design."""
        if self.latest is not None and (self.latest is not self._written or not self.path.exists()):
            began = time.monotonic()
            try:
                write(self.path, self.purpose, self.latest)
            except (OSError, MemoryError) as error:
                reason = getattr(error, "strerror", None) or "not enough memory"
                self.say(f"{self.path}: cannot be written ({reason}); the design goes on without a checkpoint")
            else:
                self._written, self._own = self.latest, True
            ended = time.monotonic()
            self._due = ended + max(self.every, (ended - began) / SHARE)
        return self._written is not None and self.path.exists()

    def kept(self) -> str:
        """At the end of a run keep the latest state: beside the folder, else among the system's temporary files.

        A sentence for the user: how to go on.  "" without a state.
        """
        self.say = lambda text: None
        if self.flush():
            return "what was found so far is kept; the same command with --resume goes on from there"
        if self.latest is None:
            return ""
        try:
            refuge = _in_refuge(self.path.name.removeprefix("."), self.purpose, self.latest)
        except (OSError, MemoryError):
            return "there was no room for what was found so far, neither beside the folder nor among temporary files"
        return f"what was found so far is kept in {refuge}; move it to {self.path} and --resume goes on from there"

    def found(self) -> Any:
        """The state to go on from, None without a checkpoint; CheckpointError for a checkpoint of another design."""
        if not self.path.exists():
            return None
        purpose, state = read(self.path, self.kind)
        for key, then, now in _differences(purpose, self.purpose):
            raise CheckpointError(
                f"{self.path}: is of another design ({key} was {then}, now it is {now}); "
                "give the scene as it was, or start without --resume"
            )
        self.latest = self._written = state
        return state

    def remove(self) -> None:
        """The design is written: the checkpoint goes."""
        self.latest = self._written = None
        self.path.unlink(missing_ok=True)

    def withdraw(self) -> None:
        """The scene is refused: the checkpoint of this run goes, that of an earlier run stays."""
        self.latest = None
        if self._own:
            self.remove()


def _differences(then: Any, now: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Dotted keys under which two trees differ, with both values."""
    if isinstance(then, dict) and isinstance(now, dict):
        for name in sorted(then.keys() | now.keys()):
            yield from _differences(then.get(name), now.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(then) != json.dumps(now):
        yield key, json.dumps(then)[:60], json.dumps(now)[:60]
