"""A verdict, and each of its lines, judged by a limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

NO_LIMIT = "no limit was asked"
VERDICTS = ("passed", "passed with remarks", NO_LIMIT, "failed")


@dataclass(frozen=True)
class Check:
    """One line of the verdict."""

    name: str  # as checks.md explains it
    value: float | bool | None  # None: could not be measured
    limit: float | bool | None  # None: stated, not judged
    unit: str  # of value and limit; empty: a pure number
    passed: bool  # does the value keep the limit?
    where: str = ""  # of a check that failed, the place: "control point (12, 40)", counted from 0, x or u first

    @classmethod
    def at_most(cls, name: str, value: float, limit: float | None, unit: str = "", where: str = "") -> Check:
        """Passes if value <= limit; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit=unit, passed=limit is None or bool(value <= limit), where=where)

    @classmethod
    def at_least(cls, name: str, value: float, limit: float | None, unit: str = "", where: str = "") -> Check:
        """Passes if value >= limit; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit=unit, passed=limit is None or bool(value >= limit), where=where)

    @classmethod
    def _judged(cls, name: str, value: float, limit: float | None, unit: str, passed: bool, where: str) -> Check:
        """A value that is not finite was not measured: the file holds nothing of the kind."""
        finite = math.isfinite(value)
        passed &= finite
        return cls(
            name, float(value) if finite else None, limit, unit=unit, passed=passed, where="" if passed else where
        )

    @classmethod
    def true(cls, name: str, value: bool, where: str = "") -> Check:
        """Passes if it is so."""
        return cls(name, bool(value), True, unit="", passed=bool(value), where="" if value else where)


def verdict(passed: bool, given_up: Sequence[str], asked: bool = True) -> str:
    """Return one of VERDICTS; given_up: the wishes of the scene that were given up, which are the remarks.

    asked: does the scene set any limit on the light?  Without one only a failed check says that a lens is not good;
    nothing says that it is.
    """
    clean, remarked, no_limit, failed = VERDICTS
    if not passed:
        return failed
    if not asked:
        return no_limit
    return remarked if given_up else clean
