"""What a process does with memory that is freed."""

from __future__ import annotations

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's names for mallopt (malloc.h)
KEPT = (1 << 31) - 1  # bytes


def keep_freed() -> None:
    """Up to 2 GB of it stay with the process; where the C library is not glibc, nothing changes.

    glibc gives every freed array of more than 32 MiB back to the system, which hands the next one out page by page,
    cleared: an eighth of the time of an evaluation of a few million tubes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(MMAP_THRESHOLD, KEPT)
