"""Values of the light that [accept] limits: test points, uniformity, sharpness of a cut-off, intensities of glare."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from bstcad.analysis.far_field import ANGLE_STEP, PLANE_STEP, RAYS, SEED, FarField
from bstcad.analysis.light_values import GLARE_ANGLES, Estimate, LightSets, glare
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.measure import SETS, Light
from bstcad.scene.accept import Accept, CutOff, PointLimit, Uniformity, pixel_size, step_of
from bstcad.verify.verdict import Check

PER_LX = 1e6  # lx per lm/mm², and mm² per m²
GLARE_TABLES = 8  # number of independent far fields from which the intensities of glare are measured
QUANTITIES = {"relative": "relative to the mean of the lit pixels", "lx": "illuminance", "cd": "luminous intensity"}
DOUBTFUL = 2.0  # standard errors within which a limit that is missed may be met


@dataclass(frozen=True)
class LightValue:
    """A measured value of the light, and its limits."""

    name: str  # name of the value, with position and size of the disc
    id: str  # section in checks.md without "check-"
    value: float | None  # None: could not be measured
    standard_error: float | None  # standard error of the value; None: not known
    least: float | None  # smallest value allowed; None: no limit
    most: float | None  # largest value allowed; None: no limit
    unit: str  # lx, cd, cd/klm; empty: a ratio
    margin: float | None  # distance to the nearer limit, negative outside; None: not measured

    @classmethod
    def of(
        cls, name: str, found: Estimate | None, least: float | None, most: float | None = None, *, unit: str = "",
        id: str,
    ) -> LightValue:  # fmt: skip
        """Return a value with its margin; found: None if it could not be measured."""
        if found is None:
            return cls(name, id, None, None, least=least, most=most, unit=unit, margin=None)
        ends = [] if least is None else [found.value - least]
        ends += [] if most is None else [most - found.value]
        return cls(
            name, id, found.value, found.standard_error, least=least, most=most, unit=unit,
            margin=min(ends) if ends else None,
        )  # fmt: skip

    def checks(self) -> Iterator[Check]:
        """Yield one check for each limit, which a name with two limits states."""
        both = self.least is not None and self.most is not None
        value = float("nan") if self.value is None else self.value
        for limit, judge, which in ((self.least, Check.at_least, "least"), (self.most, Check.at_most, "most")):
            if limit is not None:
                error = self.standard_error or 0.0
                near = abs(value - limit) < DOUBTFUL * error
                where = f"the difference is within {DOUBTFUL:g} standard errors of {error:.2g}" if near else ""
                name = f"{self.name}, at {which}" if both else self.name
                yield judge(name, value, limit, self.unit, where=where, id=self.id)


def light_values(
    accept: Accept, goals: Sequence[Goal], lights: Sequence[Light], *, lens: Lens, far: FarField
) -> tuple[LightValue, ...]:
    """Return the values that [accept] limits.

    lights: the light on each goal behind the lens.  far: light of the source for the intensity behind the lens.
    """
    numbers = {point.target for point in accept.point}
    numbers |= {table.target for table in (accept.uniformity, accept.cut_off) if table is not None}
    sets = {}
    for k in numbers:
        goal, light = goals[k], lights[k]
        wanted = goal.picture if goal.whole is None else goal.whole  # with the part that no face can light
        pictures = [each.numpy() for each in light.sets]
        sets[k] = LightSets.of(goal.screen, pictures, light.on_screen, target=wanted)
    found = [
        _point_value(point, f"{k + 1}", sets[point.target], goals[point.target], lumens=far.lumens)
        for k, point in enumerate(accept.point)
    ]
    if accept.uniformity is not None:
        number = accept.uniformity.target
        found += _uniformity_values(accept.uniformity, sets[number], goals[number])
    if accept.cut_off is not None:
        number = accept.cut_off.target
        found.append(_cut_off_value(accept.cut_off, sets[number], goals[number]))
    if accept.glare is not None:
        per_kilolumen = replace(far, lumens=None, grid=None)
        fields = (replace(per_kilolumen, seed=SEED + k * SETS) for k in range(GLARE_TABLES))
        largest = glare([field.table(lens, RAYS // 3) for field in fields])
        found += [
            LightValue.of(
                f"largest intensity at {angle:g} degrees from the axis, means over cells of {PLANE_STEP:g} by "
                f"{ANGLE_STEP:g} degrees, per 1000 lm behind the lens",
                value, None, limit, unit="cd/klm", id="glare",
            )
            for angle, value, limit in zip(GLARE_ANGLES, largest, accept.glare, strict=True)
        ]  # fmt: skip
    return tuple(found)


def _point_value(point: PointLimit, number: str, on: LightSets, goal: Goal, *, lumens: float | None) -> LightValue:
    """Return the value at a test point; number: its number, from 1, which stands for a name.

    lumens: luminous flux of the source; None: not known, and the scene was refused if the point needs it.
    """
    screen, unit = goal.screen, goal.screen.receiver.unit
    radius = pixel_size(screen) if point.radius is None else point.radius
    estimate = on.mean(point.at, radius, relative=point.unit == "relative")
    unit_of_value = ""
    if point.unit != "relative":
        assert estimate is not None  # only relative means may not exist
        assert lumens is not None
        scale, unit_of_value = lumens * (PER_LX if point.unit == "lx" else 1.0), point.unit
        estimate = Estimate(scale * estimate.value, scale * estimate.standard_error)
    x, y = point.at
    what = QUANTITIES[point.unit]
    name = (
        f"test point {point.name or number} at ({x:g}, {y:g}) {unit}: mean over a radius of {radius:.3g} "
        f"{unit}, {what}{goal.suffix}"
    )
    return LightValue.of(name, estimate, point.least, point.most, unit=unit_of_value, id="point")


def _uniformity_values(limits: Uniformity, on: LightSets, goal: Goal) -> Iterator[LightValue]:
    """Yield the values of uniformity that have a limit."""
    radius = pixel_size(goal.screen) if limits.radius is None else limits.radius
    to_mean, to_max = on.ratios(radius) or (None, None)
    over = f"of the even part, means over a radius of {radius:.3g} {goal.screen.receiver.unit}{goal.suffix}"
    if limits.min_to_mean is not None:
        yield LightValue.of(f"uniformity, smallest / mean {over}", to_mean, limits.min_to_mean, id="uniformity")
    if limits.min_to_max is not None:
        yield LightValue.of(f"uniformity, smallest / largest {over}", to_max, limits.min_to_max, id="uniformity")


def _cut_off_value(limits: CutOff, on: LightSets, goal: Goal) -> LightValue:
    """Return the sharpness of a cut-off."""
    step, unit = step_of(limits, goal.screen), goal.screen.receiver.unit
    name = f"sharpness of the cut-off along x = {limits.at:g} {unit}, step of {step:.3g} {unit}{goal.suffix}"
    return LightValue.of(name, on.sharpness(limits.at, step), limits.least, limits.most, id="cut-off")
