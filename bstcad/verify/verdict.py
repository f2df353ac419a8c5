"""The verdict on a design, and its checks, each of a value against a limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

NO_LIMIT = "no limit was asked"  # verdict on a design whose scene sets no limit on the light
VERDICTS = ("passed", "passed with remarks", NO_LIMIT, "failed")


@dataclass(frozen=True)
class Check:
    """One check of a verdict."""

    name: str  # statement that is true if the check passes, or name of the quantity, in English; not stable (use `id`)
    value: float | bool | None  # measured value; None: could not be measured
    limit: float | bool | None  # limit; None: the value is stated, but not judged
    unit: str  # unit of value and limit; empty: a pure number
    passed: bool  # True if the value is within the limit
    where: str = ""  # position or reason of a failure: "control point (12, 40)", counted from 0, x or u first
    id: str = ""  # section in checks.md without "check-", such as "rrmsd"; empty: a script's check without a section

    @property
    def topic(self) -> str:
        """Name of the section that `bstcad docs` prints; empty if there is none."""
        return self.id and f"check-{self.id}"

    @classmethod
    def at_most(
        cls, name: str, value: float, limit: float | None, unit: str = "", where: str = "", *, id: str = ""
    ) -> Check:
        """Return a check that passes if value <= limit, or limit is None; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit, passed=limit is None or value <= limit, where=where, id=id)

    @classmethod
    def at_least(
        cls, name: str, value: float, limit: float | None, unit: str = "", where: str = "", *, id: str = ""
    ) -> Check:
        """Return a check that passes if value >= limit, or limit is None; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit, passed=limit is None or value >= limit, where=where, id=id)

    @classmethod
    def _judged(
        cls, name: str, value: float, limit: float | None, unit: str, *, passed: bool, where: str, id: str
    ) -> Check:
        """Return the check; a value that is not finite could not be measured and fails."""
        finite = math.isfinite(value)
        passed = bool(passed) and finite
        where = "" if passed else where
        return cls(name, float(value) if finite else None, limit, unit=unit, passed=passed, where=where, id=id)

    @classmethod
    def true(cls, name: str, value: bool, where: str = "", *, id: str = "") -> Check:
        """Return a check that passes if `value` is True."""
        return cls(name, bool(value), True, unit="", passed=bool(value), where="" if value else where, id=id)


def verdict(passed: bool, given_up: Sequence[str], asked: bool = True) -> str:
    """Return one of VERDICTS; given_up: texts of the report's remarks.

    asked: True if the scene limits the light; otherwise checks can show that a lens is bad, but not that it is good.
    """
    clean, remarked, no_limit, failed = VERDICTS
    if not passed:
        return failed
    if not asked:
        return no_limit
    return remarked if given_up else clean
