"""The report as a record, for scripts: what report.json holds, with the irradiance that was traced."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bstcad.report.units import number, percent
from bstcad.verify.verdict import Check


@dataclass(frozen=True, eq=False)
class Report:
    """What the files of a design are worth, traced through the geometry re-read from lens.step."""

    name: str
    verdict: str  # "passed", "passed with remarks" or "failed"
    passed: bool  # every check
    rrmsd: float  # of the irradiance against the target, by the flux into each pixel
    rrmsd_tent: float  # the same by linear binning
    rrmsd_noise: float  # noise floor of rrmsd
    light_on_target: float  # part of what the source sends out
    efficiency: float  # flux on the target over flux that leaves the back face
    flux: Mapping[str, float]  # where the source's flux goes; sums to 1
    given_up: tuple[str, ...]  # what was asked and is not so, in a sentence each
    checks: tuple[Check, ...]
    prescription: Mapping[str, Any]  # every surface as it was designed: vertex, radius, curvature, glass …
    shape: Mapping[str, float | None]  # thickness, radii (mm), slope (degrees), volume (mm³) …
    seconds_total: float  # to the verified lens
    irradiance: np.ndarray = field(repr=False)  # (rows, columns), row 0 = y max, with the target's sum
    facts: Mapping[str, Any] = field(repr=False)  # all of report.json

    @classmethod
    def of(cls, facts: Mapping[str, Any], irradiance: np.ndarray) -> Report:
        """The record of the contents of a report.json."""
        as_they_are = (
            "name", "verdict", "passed", "rrmsd", "rrmsd_tent", "rrmsd_noise", "light_on_target", "efficiency", "flux",
            "prescription", "shape", "seconds_total",
        )  # fmt: skip
        return cls(
            **{key: facts[key] for key in as_they_are},
            given_up=tuple(facts["given_up"]),
            checks=tuple(Check(**check) for check in facts["checks"]),
            irradiance=irradiance,
            facts=facts,
        )

    def __repr__(self) -> str:
        """The verdict and the two figures that matter most; then each remark and each check that failed."""
        failed = [f"{check.name} ({check.where})" if check.where else check.name for check in self.checks
                  if not check.passed]  # fmt: skip
        return "\n  ".join(
            [
                f"Report {self.name!r}: {self.verdict}, RRMSD {number(self.rrmsd)}, "
                f"{percent(self.light_on_target)} of the source's light is on the target",
                *(f"failed: {name}" for name in failed),
                *(f"given up: {sentence}" for sentence in self.given_up),
            ]
        )
