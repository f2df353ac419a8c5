"""Files: reading is limited in size, writing follows no links, a folder has one run at a time, errors are one sentence.

A folder from elsewhere may contain a pipe, a device, a terabyte of zeros, or a link to a private file.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import re
import stat
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    import numpy as np

MAX_SENTENCE = 600  # largest length of a text from `one_line` (characters)
MADE_PART_FILES = ("deviation.npz",)  # file by which the folder of a made part is recognised
DESIGN_FILES = ("report.json", "lens.step", "scene.toml")  # files, any of which marks a design's folder
# Kinds of files for a shop, as in `bstcad export --as` and the scene's output.export.
Export = Literal[
    "sag", "points", "zemax", "turning", "spiral", "raster", "heightmap",
    "tiles", "dxf", "svg", "preview", "cavity", "datasheet", "ies", "ldt", "csv", "tm25",
]  # fmt: skip
EXPORTS: tuple[str, ...] = get_args(Export)
HEIGHT_EXPORTS = {  # kinds that need a back of heights z(x, y), which a dome is not, and what they are
    "zemax": "a table of", "turning": "a table of", "spiral": "a path over", "raster": "a path over",
    "heightmap": "a picture of",
}  # fmt: skip
PATHS = ("spiral", "raster")  # kinds that are paths of a round tool
TOOL_RADII = (1e-3, 1e3)  # smallest and largest radius of such a tool (mm)
MAX_ARCHIVE_SIZE = 600_000_000  # largest .npz (bytes), enough for a net of 2049 x 2049 and pictures of 4096 x 4096
MAX_ARRAY_HEADER = 4096  # largest header of an array in an .npz archive (bytes), with a margin
MAX_FOLDER_NAME = 230  # largest name of a folder of a design (bytes); names beside it are longer, up to 255
NO_MEMORY = re.compile(  # words of Python, torch, the system and the dynamic loader for a lack of memory
    "not enough memory|out of memory|bad_alloc|can(not|'t) allocate memory|failed to map segment|can't start new thread"
)


# --- errors -----------------------------------------------------------------------------------------------------------


class SentenceError(Exception):
    """Error whose text is one sentence for the user: the subject, the fault and the remedy."""


class SceneError(SentenceError, ValueError):
    """A scene or another input is invalid."""

    def __init__(self, sentence: object = "") -> None:
        super().__init__(one_line(sentence))


class MachineError(SentenceError, RuntimeError):
    """The machine could not do the work, although the scene is valid."""


def one_line(text: object) -> str:
    """Return a text with control characters escaped; of a text over MAX_SENTENCE characters the middle is left out."""
    text = _cut(str(text))
    return text if text.isprintable() else _cut("".join(c if c.isprintable() else repr(c)[1:-1] for c in text))


def _cut(text: str) -> str:
    return text if len(text) <= MAX_SENTENCE else f"{text[: MAX_SENTENCE // 2]}…{text[1 - MAX_SENTENCE // 2 :]}"


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, without a full stop, to be quoted within a sentence."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def note(error: BaseException) -> str:
    """Return the notes that were added to an error, such as a sentence on how to resume; "" without notes."""
    return "; ".join(getattr(error, "__notes__", ()))


def _command(error: BaseException) -> str:
    context = getattr(error, "ctx", None)
    return f"bstcad {context.info_name}" if context and context.parent else "bstcad"


def sentence_of(error: BaseException) -> str | None:
    """Return the sentence for the user about an error of the input or the machine; None for a fault of bstcad."""
    if hasattr(error, "format_message"):  # an error of typer: an unknown option, a missing argument
        text = error.format_message().splitlines()[0].rstrip(".").replace(". Did", "; did")
        return text[:1].lower() + text[1:] + ("" if text.endswith("?") else f"; see {_command(error)} --help")
    if isinstance(error, SentenceError):
        return str(error)
    by_words = isinstance(error, RuntimeError | ImportError) and NO_MEMORY.search(str(error).lower())
    if by_words or isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return (
            "this machine has too little memory for this design; free some, or reduce lens.back.control_points, "
            "target.pixels or tailoring.rays"
        )
    if not isinstance(error, OSError):
        return None
    if not error.filename:
        try:
            os.getcwd()
        except OSError:
            return "the working folder was deleted; change to another folder (cd) and try again"
    where = f"{error.filename}: " if error.filename else ""
    if error.errno == errno.ENAMETOOLONG:
        return f"{where}is longer than the names of files may be on this system; give a shorter name"
    return f"{where}{error.strerror or error}; check that the path exists, is writable and has free space"


# --- reading ----------------------------------------------------------------------------------------------------------


def contents(path: Path, largest: int) -> bytes:
    """Return the bytes of a file.  ValueError with the reason if it cannot be read or exceeds `largest` bytes.

    The kind and size are checked before opening: a pipe, or a file of /proc with a stated size of 0, may never end.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("it is a folder" if stat.S_ISDIR(found.st_mode) else "it is a pipe or a device")
        if found.st_size > largest:
            raise ValueError(f"it is larger than {largest / 1e6:.4g} MB")
        if found.st_size == 0:
            return b""
        with path.open("rb") as file:
            return file.read(found.st_size)  # limited, since a larger argument would allocate a larger buffer
    except OSError as error:
        raise ValueError(error.strerror or type(error).__name__) from error


def within(path: Path, *folders: Path) -> Path:
    """Return the path with links resolved.  ValueError if that is in none of these folders, or if links form a loop."""
    try:
        found = path.resolve()
        endless = found.is_symlink()  # newer versions of pathlib return a link; older ones raise
    except (OSError, RuntimeError):
        endless = True
    if endless:
        raise ValueError("is a link that leads back to itself")
    if not any(found.is_relative_to(folder) for folder in folders):
        raise ValueError(f"is a link that leads out of the folder {folders[0].name}")
    return found


def arrays(path: Path, shapes: Mapping[str, tuple[int, ...]], largest: int) -> dict[str, np.ndarray]:
    """Return arrays as float64, by name, from an .npz archive of at most `largest` bytes; shapes: their shapes by name.

    An archive may unpack to a million times its size, and an array's header may claim any size: both are checked
    against the shape before memory is allocated.  ValueError for a damaged archive.
    """
    with _archive(path, largest) as archive:
        return {name: _array(archive, name, shape) for name, shape in shapes.items()}


def names(path: Path) -> list[str]:
    """Return the names of the arrays in an .npz archive; [] for other files."""
    try:
        with _archive(path, MAX_ARCHIVE_SIZE) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except ValueError:
        return []


def net(path: Path, most: int) -> np.ndarray:
    """Return control_points (m, n, 3) of an .npz archive; ValueError if damaged, not finite, or if m or n > `most`."""
    import numpy as np

    with _archive(path, MAX_ARCHIVE_SIZE) as archive:
        with archive.open(_member(archive, "control_points")) as file:
            (m, n, *_), _ = _header(file, "control_points")
        found = _array(archive, "control_points", (min(m, most), min(n, most), 3))
    if not np.isfinite(found).all():
        raise ValueError("its control points are not finite")
    return found


@contextlib.contextmanager
def _archive(path: Path, largest: int) -> Iterator[zipfile.ZipFile]:
    """Yield an .npz archive of at most `largest` bytes; ValueError for any fault of it within the block."""
    data = io.BytesIO(contents(path, largest))
    try:
        with zipfile.ZipFile(data) as archive:
            yield archive
    except (ValueError, MemoryError):
        raise
    except Exception as error:  # zipfile, zlib, struct, numpy and tokenize raise errors of their own
        raise ValueError(first_line(error)) from error


def _member(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo:
    member = archive.getinfo(f"{name}.npy")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others unpack to more than they state
        raise ValueError(f"{name} is compressed by an unknown method")
    return member


def _array(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...]) -> np.ndarray:
    import numpy as np  # loaded late, since --help needs this module without numpy

    member = _member(archive, name)
    if member.file_size > 8 * math.prod(shape) + MAX_ARRAY_HEADER:
        raise ValueError(f"{name} is larger than an array of shape {shape}")
    file = io.BytesIO(archive.read(member))
    found, kind = _header(file, name)
    if found != shape or kind not in "fiu":
        raise ValueError(f"{name} is not a {shape} array of numbers, as scene.toml requires")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False).astype(np.float64)


def _header(file: IO[bytes], name: str) -> tuple[tuple[int, ...], str]:
    import numpy as np

    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"{name} is not an array written by bstcad")
    shape, _, numbers = np.lib.format.read_array_header_1_0(file)
    return shape, numbers.kind


# --- writing ----------------------------------------------------------------------------------------------------------


def check_free(folder: Path, ours: Sequence[str] = DESIGN_FILES, whose: str = "a design's") -> None:
    """Raise SceneError unless a design may use the folder: it must be new or empty, or contain an earlier design.

    ours: names of files, of which an earlier design's folder has at least one.  whose: their owner, for the message.
    """
    if (size := len(os.fsencode(folder.name))) > MAX_FOLDER_NAME:
        raise SceneError(f"{folder.name}: has {size} bytes, and {MAX_FOLDER_NAME} is the maximum; give a shorter name")
    try:
        folder.resolve()
    except (OSError, RuntimeError):  # newer and older versions of pathlib
        raise SceneError(f"{folder}: is a link that leads back to itself; give another folder") from None
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; give another folder")
    if folder.is_dir() and any(folder.iterdir()) and not any((folder / name).exists() for name in ours):
        raise SceneError(f"{folder}: contains files that are not {whose}; give a new folder")
    parent = next(parent for parent in folder.absolute().parents if parent.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise SceneError(f"{folder}: cannot be created, since {parent} is not writable; give another folder")


def put(path: Path, *parts: bytes | memoryview) -> None:
    """Write a file completely, or leave the old one unchanged; a link is replaced, and the linked file is unchanged."""
    with atomic_file(path) as file:
        file.writelines(parts)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[io.BufferedRandom]:
    """Yield a temporary file to write and read; it replaces the file at `path` if the block ends without an error."""
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
    """Return the folder at `path`, created if necessary; a link is replaced."""
    if path.is_symlink():
        path.unlink()
    path.mkdir(exist_ok=True)
    return path


def beside(folder: Path, kind: str) -> Path:
    """Return the path of a hidden file beside an output folder; kind: such as "lock" or "checkpoint"."""
    folder = folder.resolve()
    return folder.with_name(f".{folder.name}.{kind}")


@contextlib.contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Lock an output folder against other runs within the block.  SceneError if another run uses it.

    The system releases the lock when the run's process ends, so the lock file of a killed run locks nothing.
    """
    from filelock import FileLock, Timeout  # loaded late: it takes a quarter of a second

    path = beside(folder, "lock")
    if path.is_symlink():  # not ours; its target stays as it is
        path.unlink()
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise SceneError(
            f"{folder}: is in use by another run ({_lock_owner(path)}); wait for it, or give another folder with -o"
        ) from None
    with contextlib.suppress(OSError):  # on a full disk the file contains no process id
        path.write_text(str(os.getpid()))
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # before the release, since the next run creates a new file
        lock.release()


def _lock_owner(path: Path) -> str:
    try:
        return f"process {int(path.read_text()[:20])}"
    except (OSError, ValueError):
        return "unknown process"
