"""The bstcad command line in a process that ends, with all that it started, when the process that wanted it is gone.

python -m bstcad.runs.cold_process generate SCENE …
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

LOOK = 0.5  # seconds between two looks


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK)
    os.killpg(0, signal.SIGKILL)  # it began a session, and so a group, of its own


def main() -> None:
    """Run a command, watched."""
    if hasattr(os, "killpg") and os.getpgrp() == os.getpid():
        threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    from bstcad import cli

    cli.main(sys.argv[1:])


if __name__ == "__main__":
    main()
