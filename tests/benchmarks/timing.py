"""How long a call takes on a machine that may be busy."""

import statistics
import time


def median_seconds(call, runs=5):
    """Median over runs, after one that compiles and warms the caches."""
    call()
    spent = []
    for _ in range(runs):
        before = time.perf_counter()
        call()
        spent.append(time.perf_counter() - before)
    return statistics.median(spent)
