"""OCC without its talk: it prints statistics, and what it dislikes about a file; our sentence is enough."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from OCP.Message import Message


@contextmanager
def silence() -> Iterator[None]:
    """OCC prints nothing inside the block."""
    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)
