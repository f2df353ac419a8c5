"""Course of a design: its stages, its convergence and the circumstances, as they stand in report.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field
from typing_extensions import TypedDict

BY_HAND = "by hand"  # DesignCourse.stopped of a lens that was changed after its design, or designed elsewhere

Fraction = Annotated[float, Field(ge=-1e-6, le=1 + 1e-6)]  # number from 0 to 1, with the rounding error of a sum
Size = Annotated[float, Field(ge=0, le=1e12)]  # number from 0 to 1e12
Rrmsd = Annotated[float, Field(gt=0, le=1e3)]
Scalar = str | float | int | bool | None
Seconds = Annotated[float, Field(ge=0, le=1e9)]


@dataclass(frozen=True)
class StageRecord:
    """One stage of the design."""

    name: str  # name of the stage, such as stage 2
    seconds: Seconds  # wall time
    rrmsd: Rrmsd | None = None  # RRMSD after the stage
    cpu_seconds: Seconds | None = None  # CPU time; None: unknown, or another process took part

    @property
    def stage(self) -> str:
        """Name of the stage without that of its round: "stage 3" of "stage 3, full size"."""
        return self.name.partition(", ")[0]

    @property
    def is_round(self) -> bool:
        """True for one of several rounds of a stage."""
        return self.stage != self.name

    @property
    def is_coarse(self) -> bool:
        """True for a round with few pixels ("stage 2, 96 x 96 pixels, …"), whose size does not depend on the scene."""
        return " pixels, " in self.name


@dataclass(frozen=True)
class CurvePoint:
    """One point of the convergence curve."""

    seconds: Seconds  # time since the start
    rrmsd: Rrmsd  # RRMSD of the best lens so far, by flux tubes; at the end of a stage, final RRMSD by new rays


class PrecisionTest(TypedDict):
    """Comparison of a short run of tailoring in float32 and in float64; see tailoring.stage2.PrecisionComparison."""

    control_points: int  # number of control points along the longer side
    merit: Size  # difference of the merits before the first step, relative to the larger one
    gradient: Size  # norm of the difference of the gradients before the first step, relative to the larger norm
    evaluations: int  # number of evaluations in each precision
    rrmsd_float64: Rrmsd  # RRMSD after the evaluations in float64
    rrmsd_float32: Rrmsd  # RRMSD after the evaluations in float32
    heights: Size  # largest difference between the heights of a control point after the evaluations (mm)


@dataclass(frozen=True)
class DesignCourse:
    """Course of a design; a field is None if unknown, as when the earlier report of the design is missing."""

    seconds_total: Seconds = 0.0  # time from the command to the verified lens and the pictures of its report
    stages: tuple[StageRecord, ...] = ()
    history: tuple[CurvePoint, ...] = ()
    machine: Mapping[str, Scalar] | None = None
    versions: Mapping[str, str] | None = None  # versions of the libraries
    # grid (cells per side), iterations, mass_error and stopped (reason) of the transport; steep_share, steepest_deg
    transport: Mapping[str, Scalar] | None = None
    skipped_steps: int | None = None  # number of steps skipped because merit or gradient was not finite
    stopped: str | None = None  # reason why tailoring ended
    twins: PrecisionTest | None = None  # comparison of float32 with float64

    def with_stages(self, *last: StageRecord) -> DesignCourse:
        """Return this record with the stages `last` at its end, instead of earlier stages with their names."""
        names = [stage.name for stage in last]
        again = sum(stage.seconds for stage in self.stages if stage.name in names)
        seconds = self.seconds_total - again + sum(stage.seconds for stage in last)
        stages = (*(stage for stage in self.stages if stage.name not in names), *last)
        return replace(self, stages=stages, seconds_total=seconds)
