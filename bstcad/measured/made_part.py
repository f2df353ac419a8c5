"""Judgement of a made part: from a cloud of its back face to its form error, its predicted light, and checks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from bstcad.analysis import shape
from bstcad.measured import alignment as aligning
from bstcad.measured.alignment import Alignment, Face, Pose
from bstcad.measured.cloud import Cloud
from bstcad.measured.form_error import Deviation, Form, deviation, fitted, minimum_zone
from bstcad.optics.goal import Goal, worst
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, Light, measure
from bstcad.optics.wavefront_error import wavefront_error
from bstcad.verify.checks import WAVEFRONT, Nominal
from bstcad.verify.verdict import Check

FARTHEST = 3e-3  # of the half width, RMS after alignment: a part beyond is of another design
RELIEF = 0.5  # of the design's fine relief: a part with less is of another design
COARSE = 4  # degree of the polynomial that is no fine relief: parts of one optical power share it
NO_RELIEF = 3e-5  # of the half width, RMS: a face with less fine relief is not recognised by it
SCALE = 2e-4  # off 1: size of thermal expansion
SURE = 3.0  # times its uncertainty, for a scale to be off
COVERED = 0.8  # of the face: elsewhere the form is a guess
IN_A_CELL = 20  # mean points in a cell of the grid that tells the measured share of the face
SAMPLED = 20_000  # points for the fine relief
OUTLIERS = 0.1  # of the points near the face: with more, face and outliers cannot be told apart


@dataclass(frozen=True, eq=False)
class MadePart:
    """Result of a cloud of a made part."""

    checks: tuple[Check, ...]
    facts: dict[str, Any]  # entry `measured` of report.json
    deviation: Deviation
    # predicted on each target, (rows, columns), row 0 = y max, with the target's sum
    irradiances: tuple[np.ndarray, ...] = field(repr=False)
    outliers: np.ndarray = field(repr=False)  # (n, 3) mm on the design, left out of the fit


def judge(cloud: Cloud, lens: Lens, nominal: Nominal, effort: Effort | None = None) -> MadePart:
    """The made part of a lens by the cloud of its back face; ValueError if the cloud is not of that face.

    lens: as re-read from the STEP file.  effort: of a measurement of its light.
    """
    lens = replace(lens, outline=lens.apertures[1])  # where a mount cuts the rim, the part has no face beyond
    face = Face.of(lens)
    try:
        placed, axes = _aligned(face, cloud.points)
    except ValueError as error:
        raise ValueError(f"{cloud.path}: {error}") from None
    form = fitted(face, placed)
    deviates = deviation(lens, placed, form)
    least = replace(nominal.effort(effort), witness=False)
    lights = [_light(lens, form, nominal, goal, effort=least) for goal in nominal.goals]
    scale, uncertainty = aligning.scale(face, placed)
    x, y, _ = placed.pose.shift
    checks = (
        Check.true(
            "made part: the cloud is in mm", cloud.unit == "mm", f"its extent is the lens's in {cloud.unit}",
            id="made-unit",
        ),
        Check.true("made part: the axes of the cloud are the design's", not axes, axes, id="made-axes"),
        *_of_this_lens(face, placed),
        Check.at_least(
            "made part: share of the face that was measured", _covered(lens, placed.points), COVERED,
            id="made-covered",
        ),
        Check.at_most(
            "made part: outliers among the points of the face, as a share", placed.outlier_share, OUTLIERS,
            where="clean the part and measure it again", id="made-outliers",
        ),
        Check.at_most(
            "made part: scale of the cloud, off 1", abs(scale - 1), max(SCALE, SURE * uncertainty),
            where=f"it is {scale:.5f} times the design", id="made-scale",
        ),
        Check.at_most(
            "made part: decentre in the frame of the cloud", math.hypot(x, y), nominal.scene.accept.decentre, "mm",
            where=f"x {x:+.4g} mm, y {y:+.4g} mm", id="made-decentre",
        ),
        *(
            check
            for goal, (light, high) in zip(nominal.goals, lights, strict=True)
            for check in (
                Check.at_most(
                    f"made part: RRMSD predicted{goal.suffix}", light.rrmsd, nominal.scene.accept.rrmsd, id="made-rrmsd"
                ),
                Check.at_most(
                    f"made part: RRMSD, were all that the points leave open against it{goal.suffix}", high, None,
                    id="made-rrmsd-high",
                ),
            )
        ),
        *_wavefront(replace(lens, back=form.on(lens.back)), nominal),
    )  # fmt: skip
    facts = _facts(face, placed, deviates, cloud) | {"scale": scale, "passed": all(check.passed for check in checks)}
    predicted = [_predicted(*found) for found in lights]
    facts |= predicted[worst(each["rrmsd_predicted"] for each in predicted)]
    facts["goals"] = [{"key": goal.key} | of for goal, of in zip(nominal.goals, predicted, strict=True)]
    irradiances = tuple(light.picture for light, _ in lights)
    return MadePart(checks, facts, deviates, irradiances=irradiances, outliers=placed.outliers)


def _predicted(light: Light, high: float) -> dict[str, float | None]:
    """RRMSD of a light, and with all that the points leave open against it; None: none of it falls on the target."""
    found = {"rrmsd_predicted": light.rrmsd, "rrmsd_high": high}
    return {key: value if math.isfinite(value) else None for key, value in found.items()}


def _wavefront(lens: Lens, nominal: Nominal) -> Iterator[Check]:
    """The check of the wavefront behind the made lens, where one is asked for."""
    wave, asked = nominal.scene.wavefront, nominal.scene.accept.wavefront
    if wave is None:
        return
    light, value, none = nominal.heaviest, math.nan, ""
    try:
        value = wavefront_error(light.source.central, light.through(lens), wave).without_tilt.rms
    except ValueError as error:
        none = str(error)
    name = f"made part: {WAVEFRONT}, predicted"
    yield Check.at_most(name, value, asked, unit="waves", where=none, id="made-wavefront")


def _aligned(face: Face, points: np.ndarray) -> tuple[Alignment, str]:
    """(the alignment, the exchange of axes in words, "" if the cloud fits as it is)."""
    pose, kept = aligning.first_pose(face, points)
    if kept > aligning.NEAR * face.reach and (exchange := aligning.exchanged_axes(face, points, kept)):
        matrix, words = exchange
        turned = points @ matrix.T
        placed = aligning.aligned(face, turned, aligning.first_pose(face, turned)[0])
        if all(check.passed for check in _of_this_lens(face, placed)):
            return placed, f"{words}{': the face is flipped' if matrix[2, 2] < 0 else ''}"
    return aligning.aligned(face, points, pose), ""


def _of_this_lens(face: Face, placed: Alignment) -> tuple[Check, Check]:
    """Is it a part of this design, by its distance from it and by the relief that makes its picture?"""
    share, limit = _relief(face, placed.points), FARTHEST * face.reach
    other = "the cloud is of another lens or of another face"
    return (
        Check.at_most(
            "made part: distance from the design after alignment, RMS", placed.rms, limit, "mm", where=other,
            id="made-distance",
        ),
        Check.at_least(
            "made part: fine relief of the face, as a part of the design's", 1.0 if share is None else share,
            None if share is None else RELIEF, where=other, id="made-relief",
        ),
    )  # fmt: skip


def _relief(face: Face, points: np.ndarray) -> float | None:
    """Share of the design's fine relief in the made face, by regression; None: the design has no fine relief."""
    points = points[np.random.default_rng(0).permutation(len(points))[:SAMPLED]]
    x, y = (points[:, :2] / face.reach).T
    columns = np.stack([x**i * y**j for i in range(COARSE + 1) for j in range(COARSE + 1 - i)], axis=1)
    off = face.height(points)
    sag = points[:, 2] - off
    fine, change = (part - columns @ shape.least_squares(columns, part) for part in (sag - sag.mean(), off))
    if aligning.root_mean_square(fine) <= NO_RELIEF * face.reach:
        return None
    return 1 + float(fine @ change / (fine @ fine))


def _covered(lens: Lens, points: np.ndarray) -> float:
    """The share of equal cells over the outline that hold points."""
    cells = int(np.clip(np.sqrt(len(points) / IN_A_CELL), 4, 64))
    edges = [np.linspace(-a, a, cells + 1) for a in lens.outline.half_extent]
    held = np.histogram2d(points[:, 0], points[:, 1], bins=edges)[0] > 0
    middles = np.meshgrid(*((edge[:-1] + edge[1:]) / 2 for edge in edges), indexing="ij")
    return float(held[lens.outline.depth(*middles) >= 0].mean())


def _light(lens: Lens, form: Form, nominal: Nominal, goal: Goal, *, effort: Effort) -> tuple[Light, float]:
    """(light of the lens with the form error, RRMSD with the remaining uncertainty added, mean of both signs)."""
    draw = np.random.default_rng(nominal.scene.tailoring.seed).normal(size=form.spread.shape)

    def of(form: Form) -> Light:
        made = replace(lens, back=form.on(lens.back))
        how = {"effort": effort, "ghost": nominal.scene.ghost, "draw": nominal.scene.draw}
        return measure(made, nominal.channels, goal.receiver, goal.picture, **how)

    light = of(form)
    return light, max(
        light.rrmsd, math.hypot(*(of(form.drawn(draw, sign)).rrmsd for sign in (1.0, -1.0))) / math.sqrt(2)
    )


def _facts(face: Face, placed: Alignment, deviates: Deviation, cloud: Cloud) -> dict[str, Any]:
    """The entries of `measured` in report.json; lengths in mm, angles in degrees, slopes in rad."""
    figures = {key: value for key, value in asdict(deviates).items() if key not in ("x", "y", "form", "worst")}
    apart, (width, pose) = face.distance(placed.outliers)[0], minimum_zone(face, placed)
    return {
        "cloud": cloud.path.name,
        "sha256": cloud.sha256,
        "unit": cloud.unit,
        "columns": cloud.columns,
        "points": len(placed.points),
        "left_out": {
            "without data": cloud.without_data,
            "outside the outline": placed.outside,
            "off the face": placed.off_face,
        },
        "outliers": {
            "points": len(apart),
            "share": placed.outlier_share,
            "above": int((apart > 0).sum()),
            "farthest": float(np.abs(apart).max(initial=0.0)),
        },
        "alignment": _removed(placed.pose) | {"undetermined": list(placed.undetermined)},
        "minimum_zone": {"width": width, **_removed(pose)},
        **figures,
        "worst_at": list(deviates.worst),
    }


def _removed(pose: Pose) -> dict[str, float]:
    """Pose of the part in its cloud."""
    keys = ("dx", "dy", "dz", "rotation_x", "rotation_y", "rotation_z")
    return dict(zip(keys, map(float, (*pose.shift, *pose.angles)), strict=True))
