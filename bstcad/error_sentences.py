"""An error in one sentence, for the terminal."""

from __future__ import annotations

import errno
import os

# Errors that are sentences; by name, since --help loads no scene.
SAID = ("SceneError", "CheckpointError", "MachineError")
NO_MEMORY = (
    "not enough memory", "out of memory", "bad_alloc", "cannot allocate memory", "can't allocate memory",
    "failed to map segment", "can't start new thread",
)  # fmt: skip


class InputError(ValueError):
    """Wrong input; its text is one sentence with a remedy."""


def note(error: BaseException) -> str:
    """What else there is to say, such as how to go on."""
    return "; ".join(getattr(error, "__notes__", ()))


def sentence(error: Exception) -> str | None:
    """What to tell a user whose input is wrong; None if the error is not about the input."""
    if hasattr(error, "format_message"):  # typer's own: an unknown option, a missing argument
        text = error.format_message().splitlines()[0].rstrip(".").replace(". Did", "; did")
        return text[:1].lower() + text[1:] + ("" if text.endswith("?") else "; see bstcad --help")
    if isinstance(error, InputError) or type(error).__name__ in SAID:
        return str(error)
    if _out_of_memory(error):
        return (
            "the memory of this machine is too little for that; free some, or give fewer lens.back.control_points, "
            "target.pixels or tailoring.rays"
        )
    if isinstance(error, OSError) and not error.filename and not _here():
        return "the working folder was deleted; go to another one (cd) and try again"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; check that the path exists, may be written and has space left"
    return None


def _out_of_memory(error: Exception) -> bool:
    """Python, torch, the system and the loader of libraries each say it in their own way."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    return isinstance(error, RuntimeError | ImportError) and any(words in str(error).lower() for words in NO_MEMORY)


def _here() -> bool:
    """Is there a working folder?"""
    try:
        os.getcwd()
    except OSError:
        return False
    return True
