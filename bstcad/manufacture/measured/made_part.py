"""Judge a made part by a cloud of its back face: form error, predicted light, and checks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from bstcad.analysis import shape
from bstcad.manufacture.measured import alignment as aligning
from bstcad.manufacture.measured.alignment import Alignment, BackFace, Pose, equal_turns, turn_about_axis
from bstcad.manufacture.measured.cloud import Cloud
from bstcad.manufacture.measured.form_error import Deviation, FormError, deviation, fit_form_error, minimum_zone
from bstcad.manufacture.measured.shrinkage import AxisScales, axis_scales, orders, scale
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import Goal, worst
from bstcad.optics.trace.measure import Effort, Light
from bstcad.optics.trace.wavefront_error import wavefront_error
from bstcad.verify.checks import WAVEFRONT
from bstcad.verify.nominal import Nominal
from bstcad.verify.verdict import Check

MAX_RMS_DISTANCE = 3e-3  # RMS distance after alignment / BackFace.reach, above which a part is of another design
MIN_RELIEF = 0.5  # fine relief, as a fraction of the design's, below which a part is of another design
MIN_DESIGN_RELIEF = 3e-5  # RMS fine relief of a design / BackFace.reach, below which a part is not judged by relief
SCALE_TOLERANCE = 2e-4  # relative tolerance of the scale, about the size of a thermal expansion
SCALE_SIGMAS = 3.0  # tolerance of the scale, in standard uncertainties, if larger than SCALE_TOLERANCE
MIN_MEASURED_FRACTION = 0.8  # minimum measured fraction of the face; elsewhere the form is extrapolated
COVERAGE_POINTS = 20  # mean number of points in a cell of the grid from which the coverage is counted
RELIEF_POINTS = 20_000  # maximum number of points from which the fine relief is estimated
SAMPLE_ACCURACY = 2.0  # accuracy of the light of a sample of the form, relative to that of the light of the part
MAX_TURNED = 3  # maximum number of turned poses whose light is predicted
MAX_OUTLIER_FRACTION = 0.1  # fraction of outliers near the face above which face and outliers are indistinguishable


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted light of a made part on a target."""

    light: Light  # light of the lens with the fitted form
    high: float  # RRMSD with the uncertainty of the form: quadratic mean over samples, at least that of `light`
    uncertainty: float  # standard uncertainty of the RRMSD: RMS difference of the samples', with pose and form
    turned: tuple[float, ...] = ()  # RRMSDs in other poses that fit as well

    def facts(self) -> dict[str, Any]:
        """Return the entries of report.json; None if no light falls on the target."""
        figures = {"rrmsd_predicted": self.light.rrmsd, "rrmsd_high": self.high, "rrmsd_uncertainty": self.uncertainty}
        finite = {key: value if math.isfinite(value) else None for key, value in figures.items()}
        return finite | {"rrmsd_turned": [value for value in self.turned if math.isfinite(value)]}

    @property
    def orientation(self) -> str:
        """Sentence on the light in all poses that fit as well; "" if there is one pose, or no light."""
        every = [value for value in (self.light.rrmsd, *self.turned) if math.isfinite(value)]
        if len(every) < 2:
            return ""
        if max(every) - min(every) <= 2 * math.sqrt(2) * self.uncertainty:  # two σ of a difference of two figures
            return f"the RRMSD is the same there within its uncertainty, {min(every):.3g} to {max(every):.3g}"
        return f"the RRMSD depends on it, {min(every):.3g} to {max(every):.3g}: mark the orientation and measure again"


@dataclass(frozen=True, eq=False)
class MadePart:
    """Judgement of a made part."""

    checks: tuple[Check, ...]
    facts: dict[str, Any]  # entry `measured` of report.json
    deviation: Deviation
    # Predicted picture on each target, (rows, columns), row 0 = y max, scaled to the sum of the target's picture.
    irradiances: tuple[np.ndarray, ...] = field(repr=False)
    outliers: np.ndarray = field(repr=False)  # points left out of the fit (n, 3), mm, in the frame of the design


def judge(cloud: Cloud, lens: Lens, nominal: Nominal, effort: Effort | None = None) -> MadePart:
    """Judge a made part by the cloud of its back face; raise ValueError if the cloud cannot be aligned with that face.

    lens: lens as re-read from the STEP file.  effort: upper limit of the effort of measuring the light (None: FULL).
    """
    lens = replace(lens, outline=lens.apertures[1])  # if a mount cuts the rim, the face ends there
    face = BackFace.of(lens)
    part = aligned(cloud, face, nominal.scene.accept.decentre)
    alignment, (size, _), axes = part.alignment, part.scale, part.axes
    form = fit_form_error(face, alignment)
    figures = deviation(lens, alignment, form)
    cheap = replace(nominal.effort(effort), witness=False)
    angles = equal_turns(face, alignment)
    chosen = angles[:: max(1, math.ceil(len(angles) / MAX_TURNED))]
    turned = [_turned_form(face, alignment, angle) for angle in chosen]
    lights = [_light(lens, form, nominal, goal, effort=cheap, turned=turned) for goal in nominal.goals]
    checks = (
        *part.checks,
        *_light_checks(nominal, lights),
        *_wavefront(lens.with_back(form.add_to(lens.back_net)), nominal),
    )
    facts = _facts(face, alignment, figures, cloud) | {
        "scale": size,
        **axes.facts(),
        "stretch": axes.stretch,
        "moulding_shrinkage": _moulding_shrinkage(nominal, size, axes),
        "passed": all(check.passed for check in checks),
    }
    predicted = [each.facts() for each in lights]
    heaviest = worst(each["rrmsd_predicted"] for each in predicted)
    facts |= predicted[heaviest]
    facts["alignment"]["equal_turns"] = list(angles)
    facts["orientation"] = _orientation(alignment, angles, lights[heaviest])
    facts["goals"] = [{"key": goal.key} | of for goal, of in zip(nominal.goals, predicted, strict=True)]
    irradiances = tuple(each.light.picture for each in lights)
    return MadePart(checks, facts, figures, irradiances=irradiances, outliers=alignment.outliers)


@dataclass(frozen=True)
class AlignedPart:
    """A cloud aligned with the face of a lens, and what the cloud alone tells of the part."""

    alignment: Alignment
    scale: tuple[float, float]  # scale relative to the design, one for all axes, and its standard uncertainty
    axes: AxisScales
    checks: tuple[Check, ...]  # checks of the cloud


def aligned(cloud: Cloud, face: BackFace, decentre: float | None) -> AlignedPart:
    """Return the cloud aligned with a face; ValueError if it cannot be aligned.

    decentre: accept.decentre (mm).
    """
    try:
        alignment, exchange = _align(face, cloud.points)
    except ValueError as error:
        raise ValueError(f"{cloud.path}: {error}") from None
    size, axes = scale(face, alignment), axis_scales(face, alignment)
    checks = (
        *_cloud_checks(cloud, face, alignment, exchange),
        _scale_check(size, axes.stretch),
        _decentre_check(alignment, decentre),
    )
    return AlignedPart(alignment, size, axes, checks)


def _cloud_checks(cloud: Cloud, face: BackFace, alignment: Alignment, exchange: str) -> Iterator[Check]:
    """Check that a cloud is in mm and has the design's axes, and that it is of this face, complete and clean.

    exchange: exchange of axes that the cloud needs, in words.
    """
    extent = f"its extent fits the lens if its unit is {cloud.unit}"
    yield Check.true("made part: the cloud is in mm", cloud.unit == "mm", extent, id="made-unit")
    yield Check.true("made part: the axes of the cloud are the design's", not exchange, exchange, id="made-axes")
    yield from _identity_checks(face, alignment)
    name, measured = "made part: measured fraction of the face", _coverage(face.lens, alignment.points)
    yield Check.at_least(name, measured, MIN_MEASURED_FRACTION, id="made-covered")
    name, where = "made part: fraction of outliers among the points of the face", "clean the part and measure it again"
    yield Check.at_most(name, alignment.outlier_fraction, MAX_OUTLIER_FRACTION, where=where, id="made-outliers")


def _scale_check(scale: tuple[float, float], stretch: str) -> Check:
    """Check the scale of a cloud; stretch: axes along which the part is stretched, in words."""
    (factor, uncertainty), name = scale, "made part: error of the scale of the cloud"
    known = np.isfinite(uncertainty)
    limit = max(SCALE_TOLERANCE, SCALE_SIGMAS * uncertainty) if known else None
    size = f"size of cloud / design: {factor:.5f}" if known else "this form of face does not tell the scale of its part"
    where = "; ".join(filter(None, (size, stretch)))
    return Check.at_most(name, abs(factor - 1), limit, where=where, id="made-scale")


def _decentre_check(alignment: Alignment, decentre: float | None) -> Check:
    """Check the decentre of a part in the frame of its cloud."""
    x, y, _ = alignment.pose.shift
    name, where = "made part: decentre in the frame of the cloud", f"x {x:+.4g} mm, y {y:+.4g} mm"
    return Check.at_most(name, math.hypot(x, y), decentre, "mm", where=where, id="made-decentre")


def _light_checks(nominal: Nominal, lights: Sequence[Prediction]) -> Iterator[Check]:
    """Check the RRMSD on each target: the largest of all poses that fit equally well."""
    for goal, each in zip(nominal.goals, lights, strict=True):
        name, high = f"made part: RRMSD predicted{goal.suffix}", each.high
        where, rrmsd = f"standard uncertainty {each.uncertainty:.2g}", max(each.light.rrmsd, *each.turned, -math.inf)
        yield Check.at_most(name, rrmsd, nominal.scene.accept.rrmsd, where=where, id="made-rrmsd")
        name = f"made part: RRMSD predicted, with the uncertainty of the form{goal.suffix}"
        yield Check.at_most(name, high, None, id="made-rrmsd-high")


def _wavefront(lens: Lens, nominal: Nominal) -> Iterator[Check]:
    """Yield the check of the wavefront behind the made lens, if the scene states a wavefront."""
    wave, limit = nominal.scene.wavefront, nominal.scene.accept.wavefront
    if wave is None:
        return
    light, value, failure = nominal.heaviest, math.nan, ""
    try:
        value = wavefront_error(light.source.central, light.through(lens), wave).without_tilt.rms
    except ValueError as error:
        failure = str(error)
    name = f"made part: {WAVEFRONT}, predicted"
    yield Check.at_most(name, value, limit, unit="waves", where=failure, id="made-wavefront")


def _align(face: BackFace, points: np.ndarray) -> tuple[Alignment, str]:
    """Return the alignment and the exchange of axes that the cloud needs, in words; "" if it fits as given."""
    pose, distance = aligning.first_pose(face, points)
    if distance <= aligning.START_TOLERANCE * face.reach:
        alignment = aligning.align(face, points, pose)
        if _is_of_face(face, alignment):
            return alignment, ""
    if turned := aligning.find_turned_pose(face, points, pose, distance):
        alignment = aligning.align(face, points, turned)
        if _is_of_face(face, alignment):
            return alignment, ""
    if exchange := aligning.find_axis_exchange(face, points, distance):
        matrix, words = exchange
        exchanged = points @ matrix.T
        alignment = aligning.align(face, exchanged, aligning.first_pose(face, exchanged)[0])
        if _is_of_face(face, alignment):
            return alignment, f"{words}{': the face is flipped' if matrix[2, 2] < 0 else ''}"
    return aligning.align(face, points, pose), ""


def _is_of_face(face: BackFace, alignment: Alignment) -> bool:
    return all(check.passed for check in _identity_checks(face, alignment))


def _identity_checks(face: BackFace, alignment: Alignment) -> tuple[Check, Check]:
    """Return the checks that the part is of this design: its distance, and its fine relief, which forms the picture."""
    relief, limit = _relief(face, alignment.points), MAX_RMS_DISTANCE * face.reach
    other = "the cloud is of another lens or of another face"
    name = "made part: distance from the design after alignment, RMS"
    distance = Check.at_most(name, alignment.rms, limit, "mm", where=other, id="made-distance")
    name, least = "made part: fine relief of the face, relative to the design", None if relief is None else MIN_RELIEF
    return distance, Check.at_least(name, 1.0 if relief is None else relief, least, where=other, id="made-relief")


def _relief(face: BackFace, points: np.ndarray) -> float | None:
    """Return the ratio of fine relief, made face to design, by regression; None if the design has none."""
    points = points[np.random.default_rng(0).permutation(len(points))[:RELIEF_POINTS]]
    columns = orders(points)  # removed, as lenses of equal power have similar polynomials
    off = face.height(points)
    sag = points[:, 2] - off
    fine, change = (part - columns @ shape.least_squares(columns, part) for part in (sag - sag.mean(), off))
    if aligning.root_mean_square(fine) <= MIN_DESIGN_RELIEF * face.reach:
        return None
    return 1 + float(fine @ change / (fine @ fine))


def _coverage(lens: Lens, points: np.ndarray) -> float:
    """Return the fraction of equal cells over the outline that contain points."""
    cells = int(np.clip(np.sqrt(len(points) / COVERAGE_POINTS), 4, 64))
    edges = [np.linspace(-a, a, cells + 1) for a in lens.outline.half_extent]
    measured = np.histogram2d(points[:, 0], points[:, 1], bins=edges)[0] > 0
    middles = np.meshgrid(*((edge[:-1] + edge[1:]) / 2 for edge in edges), indexing="ij")
    return float(measured[lens.outline.depth(*middles) >= 0].mean())


def _light(
    lens: Lens, form: FormError, nominal: Nominal, goal: Goal, *, effort: Effort, turned: Sequence[FormError] = ()
) -> Prediction:
    """Return the light of the lens with the form error, with its uncertainty.

    The uncertainty is the RMS difference of the RRMSDs of samples of the form: of its field, and of its pose along the
    principal axes of the pose's covariance.  turned: form errors in other poses that fit equally well.
    """

    def light_with(form: FormError, effort: Effort) -> Light:
        return nominal.light(lens.with_back(form.add_to(lens.back_net)), goal, effort)

    light, quick = light_with(form, effort), replace(effort, accuracy=SAMPLE_ACCURACY * effort.accuracy)
    samples = form.posterior_samples(np.random.default_rng(nominal.scene.tailoring.seed))
    rrmsds = np.array([light_with(sample, quick).rrmsd for sample in samples])
    others = tuple(light_with(each, quick).rrmsd for each in turned)
    high = max(light.rrmsd, aligning.root_mean_square(rrmsds))
    return Prediction(light, high, aligning.root_mean_square(rrmsds - light.rrmsd), turned=others)


def _turned_form(face: BackFace, alignment: Alignment, angle: float) -> FormError:
    """Return the form error in the pose that is turned about the axis by an angle (degrees)."""
    start = aligning.identity_pose(face).compose(turn_about_axis(face, angle), face.reach)
    return fit_form_error(face, aligning.align(face, alignment.points, start))


def _orientation(alignment: Alignment, angles: Sequence[float], predicted: Prediction) -> str:
    """Return a sentence on poses that fit equally well, and the light in them; "" if there are none."""
    if alignment.turns_freely or len(angles) >= aligning.MAX_FOLD:
        found = "The form of the face does not determine the rotation about its axis: all rotations fit equally well"
    elif angles:
        listed = ", ".join(f"{angle:.3g}" for angle in angles)
        found = f"{len(angles) + 1} poses fit equally well: the part may be turned about its axis by {listed} degrees"
    else:
        return ""
    return f"{'; '.join(filter(None, (found, predicted.orientation)))}."


def _moulding_shrinkage(nominal: Nominal, scale: float, axes: AxisScales) -> list[float] | None:
    """Return the shrinkage (or three along x, y, z) by which the next part has the size of the design; None: no mould.

    scale, axes: size of the part relative to the design, which was made in the cavity of the scene's [moulding].
    """
    moulding = nominal.scene.moulding
    if moulding is None or not (moulding.is_uniform or np.isfinite(axes.uncertainties).all()):
        return None
    found = moulding.as_measured([scale] * 3 if moulding.is_uniform else axes.scales)
    return list(found[:1] if moulding.is_uniform else found)


def _facts(face: BackFace, alignment: Alignment, error: Deviation, cloud: Cloud) -> dict[str, Any]:
    """Return the entries of `measured` in report.json; lengths in mm, angles in degrees, slopes in rad."""
    figures = {key: value for key, value in asdict(error).items() if key not in ("x", "y", "form", "worst")}
    distances, (width, pose) = face.distance(alignment.outliers)[0], minimum_zone(face, alignment)
    return {
        "cloud": cloud.path.name,
        "sha256": cloud.sha256,
        "unit": cloud.unit,
        "columns": cloud.columns,
        "points": len(alignment.points),
        "left_out": {
            "without data": cloud.without_data,
            "duplicated": cloud.duplicates,
            "outside the outline": alignment.outside,
            "off the face": alignment.off_face,
        },
        "outliers": {
            "points": len(distances),
            "share": alignment.outlier_fraction,
            "above": int((distances > 0).sum()),
            "farthest": float(np.abs(distances).max(initial=0.0)),
        },
        "alignment": _pose_entries(alignment.pose) | {"undetermined": list(alignment.undetermined)},
        "minimum_zone": {"width": width, **_pose_entries(pose)},
        **figures,
        "worst_at": list(error.worst),
    }


def _pose_entries(pose: Pose) -> dict[str, float]:
    keys = ("dx", "dy", "dz", "rotation_x", "rotation_y", "rotation_z")
    return dict(zip(keys, map(float, (*pose.shift, *pose.angles)), strict=True))
