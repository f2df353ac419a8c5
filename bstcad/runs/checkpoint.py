"""Checkpoints: the state of tailoring in one file beside the output folder, so that no work is lost.

A checkpoint is complete or absent: it is written under another name, flushed to disk and renamed.  The file holds
numbers and text only: a line with the format's version, a line with the SHA-256 of the rest, and an npz archive of the
arrays, in which the array `tree` is the JSON text of everything else.
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import torch

from bstcad.runs import files
from bstcad.runs.files import SceneError

MAGIC = b"bstcad checkpoint 8\n"  # to be raised whenever a record of a state, or the purpose, changes its fields
DIGEST = 65  # bytes of the line with the SHA-256
LARGEST = 8 << 30  # bytes; 2049 x 2049 control points need 1 GB
SHARE = 0.02  # the most of the run's time that checkpoints may take

Purpose = dict[str, Any]  # the design that a checkpoint belongs to: numbers, text, None, lists and dicts of them
# A state is a record: a frozen dataclass of numbers, text, None, arrays, tensors, tuples, mappings and such records.


# --- the file ---------------------------------------------------------------------------------------------------------


def write(path: Path, purpose: Purpose, state: Any) -> None:
    """Put a checkpoint of a design (`purpose`) at `path`, whole or not at all; OSError."""
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps([purpose, state], default=partial(_packed, arrays))
    with files.whole(path) as file:  # no copy of the state in memory
        file.write(MAGIC + bytes(DIGEST))
        np.savez(file, tree=np.frombuffer(tree.encode(), dtype=np.uint8), **arrays)  # type: ignore[arg-type]
        file.seek(len(MAGIC) + DIGEST)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(len(MAGIC))
        file.write(digest.encode() + b"\n")


def read(path: Path, kind: type, device: str = "cpu") -> tuple[Purpose, Any]:
    """(purpose, state) of the checkpoint at `path`, the state of a kind, its tensors on a device; SceneError.

    Mappings come back as dicts, lists as tuples.
    """
    try:
        content = files.contents(path, LARGEST)
    except ValueError as error:
        raise SceneError(f"{path}: cannot be read ({error}); start without --resume") from error
    begin = len(MAGIC) + DIGEST
    magic, digest, body = content[: len(MAGIC)], content[len(MAGIC) : begin], content[begin:]
    if magic != MAGIC:
        found = repr(magic.partition(b"\n")[0].decode("latin-1"))
        raise SceneError(f"{path}: is no checkpoint of this version ({found}); start without --resume")
    if digest != hashlib.sha256(body).hexdigest().encode() + b"\n":
        raise SceneError(f"{path}: is damaged (its checksum does not fit); start without --resume")
    try:
        if any(part.compress_type for part in zipfile.ZipFile(io.BytesIO(body)).infolist()):
            raise ValueError  # we write none: it could unpack to any size
        with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
            unpacked = partial(_unpacked, arrays, _records(kind, {}), device)
            purpose, state = json.loads(arrays["tree"].tobytes(), object_hook=unpacked)
        if not isinstance(state, kind):
            raise TypeError
    except Exception as error:  # a foreign file with a right checksum
        raise SceneError(f"{path}: is no checkpoint of bstcad's; start without --resume") from error
    return purpose, state


def _packed(arrays: dict[str, np.ndarray], value: Any) -> dict[str, Any]:
    """A value that JSON does not have: {"@array": its name in `arrays`}, {"@module.Class": fields}, or a mapping."""
    if isinstance(value, torch.Tensor):
        return {"@tensor": _packed(arrays, value.detach().cpu().numpy())["@array"]}
    if isinstance(value, np.ndarray):
        arrays[name := str(len(arrays))] = value
        return {"@array": name}
    if is_dataclass(value):
        return {f"@{_name(type(value))}": {field.name: getattr(value, field.name) for field in fields(value)}}
    return dict(value)


def _unpacked(arrays: Mapping[str, np.ndarray], records: Mapping[str, type], device: str, found: dict) -> Any:
    """The inverse of `_packed`, from the innermost value outwards; records: classes by name."""
    (kind, content), *_ = [*found.items(), ("", None)]
    if kind == "@array":
        return arrays[content]
    if kind == "@tensor":
        return torch.from_numpy(arrays[content]).to(device)
    if kind.startswith("@"):
        return records[kind[1:]](**content)
    return {key: _as_tuples(part) for key, part in found.items()}


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


def _records(kind: Any, known: dict[str, type]) -> dict[str, type]:
    """The dataclasses that an annotated type names, by their names, and those that their fields name."""
    if isinstance(kind, type) and is_dataclass(kind) and _name(kind) not in known:
        known[_name(kind)] = kind
        for hint in get_type_hints(kind).values():
            _records(hint, known)
    for part in get_args(kind):
        _records(part, known)
    return known


def _name(kind: Any) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


# --- when it is written -----------------------------------------------------------------------------------------------


@dataclass
class Keeper:
    """Holds the latest state of a design and writes it to disk now and then."""

    path: Path
    purpose: Purpose
    say: Callable[[str], None] = print  # called with a sentence when writing fails
    every: float = 10.0  # seconds between two checkpoints, at least
    latest: Any = None
    kind: type = dict  # of the states

    def __post_init__(self) -> None:
        self._written: Any = None  # the state in the file
        self._own = False  # did this run write the file?
        self._due = time.monotonic() + self.every

    def __call__(self, state: Any) -> None:
        """Take a state from which the design could go on; the caller may not change it afterwards."""
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
            return "the design so far is kept; the same command with --resume goes on from there"
        if self.latest is None:
            return ""
        place = Path(tempfile.mkdtemp(prefix="bstcad-")) / self.path.name.removeprefix(".")
        try:
            write(place, self.purpose, self.latest)
        except (OSError, MemoryError):
            place.parent.rmdir()
            return "there was no room for the design so far, neither beside the folder nor among temporary files"
        return f"the design so far is kept in {place}; move it to {self.path} and --resume goes on from there"

    def found(self) -> Any:
        """The state to go on from, None without a checkpoint; SceneError for a checkpoint of another design."""
        if not self.path.exists():
            return None
        purpose, state = read(self.path, self.kind, self.purpose.get("device", "cpu"))
        for key, then, now in _differences(purpose, self.purpose):
            raise SceneError(
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
