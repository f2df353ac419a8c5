"""Settings of tailoring and bounds on the faces that it makes, without the scene file in which a user states them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from bstcad.optics.surfaces.sides import Sides, side

Method = Literal["least-squares", "adam", "integration"]
Precision = Literal["float32", "float64"]
Solution = Literal["convex", "concave"]

COARSEST_GRID = 64  # fewest cells per side to which the transport grid is reduced; they cost almost no time
CONIC_CONSTANTS = (-1e3, 1e3)  # range of conic constants
SEARCH_RANGE = 0.999  # fraction of the possible range of a front's sag at the rim that tailoring searches


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of tailoring, each with its value; scene/quality.py finds those of a scene."""

    seed: int  # seed of all random numbers
    method: Method  # least squares, Adam (Wang et al. 2023) or point-by-point integration
    levels: tuple[Sides, ...]  # control points per side of the nets, coarse to fine
    transport_grid: int  # cells per side of the transport map
    transport_iterations: int  # maximum number of iterations of the transport map
    rays: int  # flux tubes (method adam: rays) per side of their grid
    stage1_iterations: int  # steps of stage 1 for each net, with method adam
    rounds: int  # maximum rounds of map and slope fit in stage 1
    stage2_iterations: int  # maximum number of evaluations of the merit in stage 2 or 3
    overshoot: float  # weight of light beside the target, per pixel² of distance
    source_points: int  # number of points that represent an extended source
    # two faces and two targets: no rays (convex) or all (concave) cross between them; None: feasibility.py chooses
    solution: Solution | None = None
    precision: Precision  # precision of the arrays in tailoring
    accuracy: float | None = None  # RRMSD on pixels at which tailoring ends; None: it ends by its other limits
    max_time: float | None = None  # maximum time (s), report included; None: no limit

    @property
    def side(self) -> int:
        """Control points per side of the square net with as many points as the finest of `levels`."""
        return side(self.levels[-1])


@dataclass(frozen=True)
class Bounds:
    """Bounds on tailored faces everywhere inside the outline; a field that is None is no bound.

    A tool cuts the back from +z and the front from -z; for the tool a valley is concave and a ridge convex.
    """

    concave: float | None = None  # maximum curvature of a valley, 1/mm
    convex: float | None = None  # maximum curvature of a ridge, 1/mm
    slope: float | None = None  # maximum |∇z|
    thinnest: float = 0.0  # minimum thickness along z, mm
    thickest: float | None = None  # maximum thickness along z, mm
    edge: float | None = None  # minimum thickness along the rim, mm
