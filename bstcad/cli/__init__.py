"""The command line.  Exit codes: 0 every check passed, 1 lens written but a check failed, 2 wrong input."""

from __future__ import annotations

import contextlib
import gc
import sys
import traceback
from collections.abc import Sequence

import typer

from bstcad.cli import designing, proving, showing, sweeping  # noqa: F401  each adds its commands
from bstcad.cli.application import Stopped, app, note, sentence_of
from bstcad.runs import signals, worker

INTERRUPTED, BROKEN = 130, 70  # exit codes: Ctrl-C; a fault of bstcad itself


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code."""
    worker.keep_freed()
    code = run(arguments)
    worker.end()
    gc.freeze()  # the system takes the memory back; a last walk over millions of objects would take a second
    sys.exit(code)


def run(arguments: Sequence[str] | None = None) -> int:
    """The exit code of the command; whatever is wrong with the input is one sentence on stderr."""
    try:
        with signals.endings():
            code = app(args=arguments, prog_name="bstcad", standalone_mode=False) or 0
    except signals.Ended as ended:
        return _ended(ended)
    except Stopped as kept:
        return _say(f"stopped{kept}", INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        if ended := signals.ended():  # and on the way out a terminal that is gone could not be written to
            return _ended(ended)
        sentence, code = sentence_of(error), 2
        if sentence is None:
            traceback.print_exc()
            sentence, code = "the fault above is bstcad's, not yours; please report it with the scene file", BROKEN
        return _say("; ".join(filter(None, (sentence, note(error)))), code)
    return _say("stopped; there was no lens yet, and nothing is kept", code) if code == INTERRUPTED else code


def _ended(ended: signals.Ended) -> int:
    return _say(f"ended by {ended.name}; {note(ended) or 'nothing is kept'}", 128 + ended.number)


def _say(sentence: str, code: int) -> int:
    with contextlib.suppress(OSError):  # a terminal that is gone
        print(f"bstcad: {sentence}", file=sys.stderr)
    return code
