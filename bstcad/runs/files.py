"""Files: reading is bounded, writing follows no links, a folder has one run at a time; errors are one sentence.

A folder that somebody sent may hold a pipe, a device, a terabyte of nothing or a link to another file of the reader's.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import stat
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

LONGEST = 600  # characters of a sentence that quotes a file
PART = ("deviation.npz",)  # a file that only the folder of a made part has
OURS = ("report.json", "lens.step", "scene.toml")  # files that only a design's folder has
# Kinds of files for a shop, as `bstcad export --as` and the scene's output.export name them.
EXPORTS = ("sag", "points", "zemax", "turning", "dxf", "svg", "preview", "datasheet")
LARGEST = 600_000_000  # bytes of an archive: a net of 2049 x 2049 and pictures of 4096 x 4096
HEADER = 4096  # bytes of an array's header, and to spare
NO_MEMORY = (  # Python, torch, the system and the loader of libraries each say it in their own way
    "not enough memory", "out of memory", "bad_alloc", "cannot allocate memory", "can't allocate memory",
    "failed to map segment", "can't start new thread",
)  # fmt: skip


# --- errors -----------------------------------------------------------------------------------------------------------


class SentenceError(Exception):
    """An error whose text is one sentence for the user: the fault, its place and the remedy."""


class SceneError(SentenceError, ValueError):
    """A scene, or another input, that cannot be used."""

    def __init__(self, sentence: object = "") -> None:
        super().__init__(one_line(sentence))


class MachineError(SentenceError, RuntimeError):
    """This machine could not do the work though the scene is right."""


def one_line(text: object) -> str:
    """The text without characters that break a line or steer a terminal; the middle of a long text is left out."""
    text = _cut(str(text))
    return text if text.isprintable() else _cut("".join(c if c.isprintable() else repr(c)[1:-1] for c in text))


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]}…{text[1 - LONGEST // 2 :]}"


def first_line(error: BaseException) -> str:
    """The first line of an error's text, to be quoted within a sentence."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def note(error: BaseException) -> str:
    """The notes of an error, such as how to go on."""
    return "; ".join(getattr(error, "__notes__", ()))


def _command(error: BaseException) -> str:
    """The command whose arguments typer refused."""
    context = getattr(error, "ctx", None)
    return f"bstcad {context.info_name}" if context and context.parent else "bstcad"


def sentence_of(error: BaseException) -> str | None:
    """The sentence for a user whose input is wrong; None if the error is not about the input."""
    if hasattr(error, "format_message"):  # typer's own: an unknown option, a missing argument
        text = error.format_message().splitlines()[0].rstrip(".").replace(". Did", "; did")
        return text[:1].lower() + text[1:] + ("" if text.endswith("?") else f"; see {_command(error)} --help")
    if isinstance(error, SentenceError):
        return str(error)
    by_words = isinstance(error, RuntimeError | ImportError) and any(words in str(error).lower() for words in NO_MEMORY)
    if by_words or isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return (
            "the memory of this machine is too little for that; free some, or give fewer lens.back.control_points, "
            "target.pixels or tailoring.rays"
        )
    if not isinstance(error, OSError):
        return None
    if not error.filename:
        try:
            os.getcwd()
        except OSError:
            return "the working folder was deleted; go to another one (cd) and try again"
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}; check that the path exists, may be written and has space left"


# --- reading ----------------------------------------------------------------------------------------------------------


def contents(path: Path, largest: int) -> bytes:
    """The bytes of a file; ValueError says why it cannot be read: it is none, or holds over `largest` bytes.

    Asked before it is opened: a pipe does not end, nor do some files of /proc that say they are empty.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("it is a folder" if stat.S_ISDIR(found.st_mode) else "it is a pipe or a device")
        if found.st_size > largest:
            raise ValueError(f"it holds over {largest / 1e6:.4g} MB")
        if found.st_size == 0:
            return b""
        with path.open("rb") as file:
            return file.read(found.st_size)  # no more than stat states: a buffer of that size is made at once
    except OSError as error:
        raise ValueError(error.strerror or type(error).__name__) from error


def within(path: Path, *folders: Path) -> Path:
    """Return the path without its links; ValueError if they lead out of these folders, or back to themselves."""
    try:
        found = path.resolve()
        endless = found.is_symlink()  # the newer pathlib; the older raises
    except (OSError, RuntimeError):
        endless = True
    if endless:
        raise ValueError("leads by its links back to itself")
    if not any(found.is_relative_to(folder) for folder in folders):
        raise ValueError(f"leads by links out of the folder {folders[0].name}")
    return found


def arrays(path: Path, shapes: Mapping[str, tuple[int, ...]], largest: int) -> dict[str, np.ndarray]:
    """Arrays of float64 from an .npz archive of at most `largest` bytes, by name, as the shapes say.

    An archive may unfold to a million times its size, and an array's header may claim any: both are held to the shape
    before memory is spent.  Raises whatever zipfile and numpy raise for a damaged one.
    """
    with zipfile.ZipFile(io.BytesIO(contents(path, largest))) as archive:
        return {name: _array(archive, name, shape) for name, shape in shapes.items()}


def names(path: Path) -> list[str]:
    """The names of the arrays in an .npz archive; [] for other files."""
    try:
        with zipfile.ZipFile(io.BytesIO(contents(path, LARGEST))) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except (ValueError, zipfile.BadZipFile):
        return []


def net(path: Path, most: int) -> np.ndarray:
    """control_points (m, n, 3) as float64 from an .npz archive, m, n at most `most`; raises as `arrays` does."""
    with zipfile.ZipFile(io.BytesIO(contents(path, LARGEST))) as archive:
        with archive.open("control_points.npy") as file:
            (m, n, *_), _ = _header(file, "control_points")
        return _array(archive, "control_points", (min(m, most), min(n, most), 3))


def _array(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...]) -> np.ndarray:
    import numpy as np  # loaded with the first array: --help quotes files, too

    member = archive.getinfo(f"{name}.npy")
    known = member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # which unpack no more than they state
    if member.file_size > 8 * math.prod(shape) + HEADER or not known:
        raise ValueError(f"{name} holds {member.file_size} bytes, more than {shape} numbers")
    file = io.BytesIO(archive.read(member))
    found, kind = _header(file, name)
    if found != shape or kind not in "fiu":
        raise ValueError(f"{name} is not {shape} numbers, as scene.toml asks")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False).astype(np.float64)


def _header(file: IO[bytes], name: str) -> tuple[tuple[int, ...], str]:
    """Shape and kind of the numbers of an array in numpy's format."""
    import numpy as np

    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"{name} is no array of this program")
    shape, _, numbers = np.lib.format.read_array_header_1_0(file)
    return shape, numbers.kind


# --- writing ----------------------------------------------------------------------------------------------------------


def check_free(folder: Path, ours: Sequence[str] = OURS, whose: str = "a design's") -> None:
    """SceneError unless a design may take the folder: a new one, empty, or an earlier design's.

    ours: files of which one tells whose folder it is.
    """
    try:
        folder.resolve()
    except (OSError, RuntimeError):  # the newer pathlib, the older
        raise SceneError(f"{folder}: leads by its links back to itself; give another folder") from None
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; give another folder")
    if folder.is_dir() and any(folder.iterdir()) and not any((folder / name).exists() for name in ours):
        raise SceneError(f"{folder}: holds files that are not {whose}; give a new folder")
    parent = next(parent for parent in folder.absolute().parents if parent.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise SceneError(f"{folder}: cannot be made, since {parent} may not be written; give another folder")


def put(path: Path, *parts: bytes | memoryview) -> None:
    """Write a file whole over an older one, or not at all; a link gives way, and its target stays as it is."""
    with whole(path) as file:
        file.writelines(parts)


@contextlib.contextmanager
def whole(path: Path) -> Iterator[io.BufferedRandom]:
    """A file to be written and read, which takes its place, as that of `put` does, when the block ends."""
    new = path.with_name(f".{path.name.removeprefix('.')}.new")
    new.unlink(missing_ok=True)
    try:
        with new.open("x+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise


def folder_in_place(path: Path) -> Path:
    """The folder at `path`, made if there is none; a link gives way."""
    if path.is_symlink():
        path.unlink()
    path.mkdir(exist_ok=True)
    return path


def beside(folder: Path, kind: str) -> Path:
    """The hidden file of a kind, "lock" or "checkpoint", beside an output folder."""
    folder = folder.resolve()
    return folder.with_name(f".{folder.name}.{kind}")


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other runs out of an output folder within the block; SceneError if another run works there.

    The system takes the lock off with the end of its process: the file that a killed run leaves behind locks nothing.
    """
    from filelock import FileLock, Timeout  # a quarter of a second, which --help need not pay

    path = beside(folder, "lock")
    if path.is_symlink():  # somebody's: its target stays as it is
        path.unlink()
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise SceneError(
            f"{folder}: is being designed by another run ({_holder(path)}); wait for it or give another folder with -o"
        ) from None
    with contextlib.suppress(OSError):  # on a full disk the file names no process
        path.write_text(str(os.getpid()))
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # before the release: the next run makes a new file
        lock.release()


def _holder(path: Path) -> str:
    try:
        return f"process {int(path.read_text()[:20])}"
    except (OSError, ValueError):
        return "of a process unknown"
