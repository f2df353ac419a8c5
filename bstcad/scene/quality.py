"""Quality: how much work goes into a surface."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

# What a quality stands for; a knob set in the scene goes before it.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "method": "least-squares",
        "transport_grid": 256,
        "transport_iterations": 40,
        "rays": 512,
        "stage1_iterations": 1000,
        "rounds": 4,
        "stage2_iterations": 8,
        "overshoot": 0.03,
        "source_points": 16,
        "precision": "float64",
    },
    "standard": {
        "method": "least-squares",
        "transport_grid": 512,
        "transport_iterations": 40,
        "rays": 1536,
        "stage1_iterations": 1000,
        "rounds": 5,
        "stage2_iterations": 98,
        "overshoot": 0.03,
        "source_points": 64,
        "precision": "float64",
    },
    "fine": {
        "method": "least-squares",
        "transport_grid": 512,
        "transport_iterations": 40,
        "rays": 2048,
        "stage1_iterations": 1000,
        "rounds": 5,
        "stage2_iterations": 300,
        "overshoot": 0.03,
        "source_points": 128,
        "precision": "float64",
    },
    "paper": {  # the procedure of Wang et al. 2023: Adam, no penalty
        "method": "adam",
        "transport_grid": 1024,
        "transport_iterations": 40,
        "rays": 1024,
        "stage1_iterations": 1000,
        "rounds": 5,
        "stage2_iterations": 500,
        "overshoot": 0.0,
        "source_points": 64,
        "precision": "float32",
    },
}

COARSEST_GRID = 64  # cells a side of the transport in stage 1's first rounds: so many cost next to nothing
SHOWN_POINTS = 128  # of an extended source in the pictures and margins of a verification, not in its RRMSD
SHOWN_DRAW = 1 << 12  # which draw of them that is; a line of a spectrum takes the next one


class Tailoring(BaseModel):
    """How much work goes into the surface; a knob that is None takes its quality's value (PRESETS)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    quality: Literal["draft", "standard", "fine", "paper"] = "standard"
    seed: int = 0  # of every random choice
    method: Literal["least-squares", "adam", "integration"] | None = None  # stage 1; integration: and no stage 2
    levels: tuple[int, ...] | None = None  # control points along a side, coarse to fine
    transport_grid: int | None = None  # cells along a side of the transport problem
    transport_iterations: int | None = None
    rays: int | None = None  # along one side of the light's cross-section; least-squares: ray tubes
    stage1_iterations: int | None = None  # adam: steps a level
    rounds: int | None = None  # least-squares: of transport map and slope fit in stage 1
    stage2_iterations: int | None = None
    overshoot: float | None = None  # weight of light outside the target (per pixel² of mean squared overshoot)
    source_points: int | None = None  # of an extended source, as so many channels
    precision: Literal["float32", "float64"] | None = None
    accuracy: float | None = None  # RRMSD at which tailoring ends, though it could go on
    max_time: float | None = None  # seconds from command to report; stage 1 runs whole

    def resolved(self, control_points: int) -> Tailoring:
        """The same with every knob set.

        If not given: at least two rays a control cell each way (a draft: in all), at most two cells of the transport.
        """
        preset = dict(PRESETS[self.quality], levels=coarse_to_fine(control_points))
        # fewer than two each way leave a checkerboard that no ray sees; a draft's few steps do not get that far
        each_way = 2**0.5 if self.quality == "draft" else 2
        preset["rays"] = max(preset["rays"], math.ceil(each_way * control_points))
        if (self.method or preset["method"]) == "integration":
            preset["stage2_iterations"] = 0
        if self.quality != "paper":  # what a map has that is finer, no net follows; in corners it folds
            preset["transport_grid"] = min(preset["transport_grid"], max(2 * (control_points - 1), COARSEST_GRID))
        return Tailoring.model_validate(preset | self.model_dump(exclude_none=True))


def coarse_to_fine(control_points: int) -> tuple[int, ...]:
    """Nets of 33, 129 and 513 control points as far as they are clearly coarser, then the one asked for."""
    return (*(m for m in (33, 129, 513) if 1.5 * m < control_points), control_points)
