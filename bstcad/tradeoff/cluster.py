"""Runs of a sweep on the workers of a cluster; their records are kept here as they come.

Seconds are those of the machine where a run took place, beside whatever else ran there, so that they do not compare:
errors do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from bstcad.runs.cluster import Cluster
from bstcad.tradeoff import runs
from bstcad.tradeoff.runs import FAILED, Order, Record


class Workers:
    """The machines of a sweep that are the workers of a cluster, and what they do with an order."""

    def __init__(self, cluster: Cluster, work: Callable[[Order], Record] = runs.carry_out) -> None:
        self._cluster, self._work = cluster, work

    @property
    def room(self) -> int:
        """How many runs at a time."""
        return self._cluster.room

    def prepare(self, scene_of: Mapping[str, bytes], tick: Callable[[], None]) -> None:
        """Nothing: seconds are not compared."""

    def start(self, order: Order) -> None:
        """Hand it to the scheduler."""
        self._cluster.start(order, self._work, order)

    def next(self, tick: Callable[[], None]) -> Record:
        """Wait until one of them has ended."""
        answer = self._cluster.next(tick)
        if answer.reason:
            return Record(answer.key.settings, FAILED, answer.reason, where=answer.where, version=runs.version())
        return replace(answer.value, where=answer.where)
