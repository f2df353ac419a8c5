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

    name: str  # in English, free to change
    value: float | bool | None  # None: could not be measured
    limit: float | bool | None  # None: stated, not judged
    unit: str  # of value and limit; empty: a pure number
    passed: bool  # does the value keep the limit?
    where: str = ""  # of a check that failed, the place: "control point (12, 40)", counted from 0, x or u first
    id: str = ""  # its section in checks.md without "check-", such as "rrmsd"; empty: of a script, which none explains

    @property
    def topic(self) -> str:
        """The name by which `bstcad docs` explains it; empty: none does."""
        return self.id and f"check-{self.id}"

    @classmethod
    def at_most(
        cls, name: str, value: float, limit: float | None, unit: str = "", where: str = "", *, id: str = ""
    ) -> Check:  # fmt: skip
        """Passes if value <= limit; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit, passed=limit is None or value <= limit, where=where, id=id)

    @classmethod
    def at_least(
        cls, name: str, value: float, limit: float | None, unit: str = "", where: str = "", *, id: str = ""
    ) -> Check:  # fmt: skip
        """Passes if value >= limit; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit, passed=limit is None or value >= limit, where=where, id=id)

    @classmethod
    def _judged(
        cls, name: str, value: float, limit: float | None, unit: str, *, passed: bool, where: str, id: str
    ) -> Check:  # fmt: skip
        """A value that is not finite was not measured: the file holds nothing of the kind."""
        finite = math.isfinite(value)
        passed = bool(passed) and finite
        where = "" if passed else where
        return cls(name, float(value) if finite else None, limit, unit=unit, passed=passed, where=where, id=id)

    @classmethod
    def true(cls, name: str, value: bool, where: str = "", *, id: str = "") -> Check:
        """Passes if it is so."""
        return cls(name, bool(value), True, unit="", passed=bool(value), where="" if value else where, id=id)


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
