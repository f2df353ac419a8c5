"""Checkpoints: the state of tailoring in one file beside the output folder, so that no work is lost.

A checkpoint is complete or absent: it is written under another name, flushed to disk and renamed.  The file contains
only numbers and text: a line with the version of the format, a line with the SHA-256 of the rest, and an npz archive of
the arrays, in which the array `tree` is the JSON text of everything else.
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

MAGIC = b"bstcad checkpoint 9\n"  # first line of the file; increase the number if fields of a state or Purpose change
DIGEST_SIZE = 65  # length of the line with the SHA-256 (bytes)
MAX_SIZE = 8 << 30  # largest size of a checkpoint (bytes); 2049 x 2049 control points need 1 GB
MAX_WRITING_FRACTION = 0.02  # largest fraction of the run's time that checkpoints may take

Purpose = dict[str, Any]  # description of the design of a checkpoint: numbers, text, None, and lists and dicts of them
# A state is a record: a frozen dataclass of numbers, text, None, arrays, tensors, tuples, mappings and such records.


# --- the file ---------------------------------------------------------------------------------------------------------


def write(path: Path, purpose: Purpose, state: Any) -> None:
    """Write a checkpoint: description of the design (`purpose`) and state.  After an OSError the old file is intact."""
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps([purpose, state], default=partial(_packed, arrays))
    with files.atomic_file(path) as file:  # without a copy of the state in memory
        file.write(MAGIC + bytes(DIGEST_SIZE))
        np.savez(file, tree=np.frombuffer(tree.encode(), dtype=np.uint8), **arrays)  # type: ignore[arg-type]
        file.seek(len(MAGIC) + DIGEST_SIZE)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(len(MAGIC))
        file.write(digest.encode() + b"\n")


def read(path: Path, kind: type, device: str = "cpu") -> tuple[Purpose, Any]:
    """Return (purpose, state) of a checkpoint; kind: class of the state; device: torch device for its tensors.

    Mappings become dicts, and lists become tuples.  SceneError if the file is not a checkpoint of this version.
    """
    try:
        content = files.contents(path, MAX_SIZE)
    except ValueError as error:
        raise SceneError(f"{path}: cannot be read ({error}); start without --resume") from error
    begin = len(MAGIC) + DIGEST_SIZE
    magic, digest, body = content[: len(MAGIC)], content[len(MAGIC) : begin], content[begin:]
    if magic != MAGIC:
        found = repr(magic.partition(b"\n")[0].decode("latin-1"))
        raise SceneError(f"{path}: is not a checkpoint of this version ({found}); start without --resume")
    if digest != hashlib.sha256(body).hexdigest().encode() + b"\n":
        raise SceneError(f"{path}: is damaged (its checksum is wrong); start without --resume")
    try:
        if any(part.compress_type for part in zipfile.ZipFile(io.BytesIO(body)).infolist()):
            raise ValueError  # compressed data could unpack to any size; we write none
        with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
            unpacked = partial(_unpacked, arrays, _records(kind, {}), device)
            purpose, state = json.loads(arrays["tree"].tobytes(), object_hook=unpacked)
        if not isinstance(state, kind):
            raise TypeError
    except Exception as error:  # a foreign file with a valid checksum
        raise SceneError(f"{path}: is not a checkpoint of bstcad; start without --resume") from error
    return purpose, state


def _packed(arrays: dict[str, np.ndarray], value: Any) -> dict[str, Any]:
    """Encode a record as {"@module.Class": fields}, an array as {"@array": its name in `arrays`}, a mapping as dict."""
    if isinstance(value, torch.Tensor):
        return {"@tensor": _packed(arrays, value.detach().cpu().numpy())["@array"]}
    if isinstance(value, np.ndarray):
        arrays[name := str(len(arrays))] = value
        return {"@array": name}
    if is_dataclass(value):
        return {f"@{_name(type(value))}": {field.name: getattr(value, field.name) for field in fields(value)}}
    return dict(value)


def _unpacked(arrays: Mapping[str, np.ndarray], records: Mapping[str, type], device: str, found: dict) -> Any:
    """Decode a dict from `_packed` whose inner values are already decoded; records: classes by their "module.Class"."""
    (kind, content), *_ = [*found.items(), ("", None)]
    if kind in ("@array", "@tensor"):
        array = arrays[content]
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError  # every number of a state is finite
        return array if kind == "@array" else torch.from_numpy(array).to(device)
    if kind.startswith("@"):
        return records[kind[1:]](**content)
    return {key: _as_tuples(part) for key, part in found.items()}


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


def _records(kind: Any, known: dict[str, type]) -> dict[str, type]:
    """Add the dataclasses in a type annotation and in their fields to `known`, by "module.Class"; return `known`."""
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
    """Keeper of the latest state of a design, which it writes to the checkpoint `path` at intervals."""

    path: Path
    purpose: Purpose
    say: Callable[[str], None] = print  # called with a sentence when writing fails
    interval: float = 10.0  # shortest time between two checkpoints (s)
    latest: Any = None  # latest state
    kind: type = dict  # class of the states

    def __post_init__(self) -> None:
        self._written: Any = None  # state in the file
        self._own = False  # True once this run has written the file
        self._due = time.monotonic() + self.interval

    def __call__(self, state: Any) -> None:
        """Keep a state to continue from, and write it if `interval` has passed; the caller must not change it later."""
        self.latest = state
        if time.monotonic() >= self._due:
            self.flush()

    def flush(self) -> bool:
        """Write the latest state; return True if this or an earlier state is on disk.  A full disk raises no error."""
        if self.latest is not None and (self.latest is not self._written or not self.path.exists()):
            began = time.monotonic()
            try:
                write(self.path, self.purpose, self.latest)
            except (OSError, MemoryError) as error:
                reason = getattr(error, "strerror", None) or "not enough memory"
                self.say(f"{self.path}: cannot be written ({reason}); the design continues without a new checkpoint")
            else:
                self._written, self._own = self.latest, True
            ended = time.monotonic()
            self._due = ended + max(self.interval, (ended - began) / MAX_WRITING_FRACTION)
        return self._written is not None and self.path.exists()

    def keep_at_exit(self) -> str:
        """Write the latest state at the end of a run, to `path` or else among temporary files.

        Return a sentence for the user: how to resume, or that the state is lost; "" without a state.
        """
        self.say = lambda text: None
        if self.flush():
            return "the design so far is kept; run the same command with --resume to continue it"
        if self.latest is None:
            return ""
        path = Path(tempfile.mkdtemp(prefix="bstcad-")) / self.path.name.removeprefix(".")
        try:
            write(path, self.purpose, self.latest)
        except (OSError, MemoryError):
            path.parent.rmdir()
            return "the design so far is lost: it can be written neither beside the folder nor among temporary files"
        return f"the design so far is kept in {path}; move it to {self.path} and use --resume to continue it"

    def load(self) -> Any:
        """Return the state in the file; None if there is no file.  SceneError if it is damaged or of another design."""
        if not self.path.exists():
            return None
        purpose, state = read(self.path, self.kind, self.purpose.get("device", "cpu"))
        for key, then, now in _differences(purpose, self.purpose):
            raise SceneError(
                f"{self.path}: is of another design ({key} was {then}, now it is {now}); "
                "restore this value, or start without --resume"
            )
        self.latest = self._written = state
        return state

    def remove(self) -> None:
        """Delete the checkpoint, since the design has been written."""
        self.latest = self._written = None
        self.path.unlink(missing_ok=True)

    def withdraw(self) -> None:
        """Delete the checkpoint, since the scene is refused, if this run wrote it; that of an earlier run stays."""
        self.latest = None
        if self._own:
            self.remove()


def _differences(then: Any, now: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield the differences of two purposes: (dotted key, earlier value, present value)."""
    if isinstance(then, dict) and isinstance(now, dict):
        for name in sorted(then.keys() | now.keys()):
            yield from _differences(then.get(name), now.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(then) != json.dumps(now):
        yield key, json.dumps(then)[:60], json.dumps(now)[:60]
