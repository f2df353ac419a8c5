"""How many threads a grid is worth."""

from __future__ import annotations

from contextlib import contextmanager

import numba

BLOCKS = 8  # independent pieces of work; fixed, so that no sum depends on the number of threads
ONE_THREAD = 128  # cells a side


def threads_for(n: int) -> int:
    """Threads that pay on n x n cells: small grids finish before a second thread has woken up on a busy machine."""
    return 1 if n <= ONE_THREAD else min(2, numba.config.NUMBA_NUM_THREADS)


@contextmanager
def threads(n: int):
    """Run the compiled kernels on `threads_for(n)` threads."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads_for(n))
    try:
        yield
    finally:
        numba.set_num_threads(before)
