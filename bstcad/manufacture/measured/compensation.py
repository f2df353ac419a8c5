"""Compensate the back of a lens: the net to cut next, from the measured deviation of the parts cut last.

A shop cuts the net c_n (mm above the design's net z), and the part has c_n + e, e the error of machine and tool.  The
cloud of the part gives its deviation d_n from the design.  The next net is

    c_(n+1) = c_n - g F d_n,

g the gain and F a low pass to what tool and gauge can do.  With g = 1/n in round n, the net is the mean of what all
rounds ask for, so that errors that do not repeat are averaged (stochastic approximation, Robbins and Monro 1951).  The
deviation that repeats then becomes (1 - g F) d_n; it grows if |1 - g F| > 1, that is for a gain above 2.

F is the Gaussian filter of ISO 16610-61 for areas: a wave of the period λ keeps the part exp(-π (α λ_c / λ)²) of its
height, α = sqrt(ln 2 / π), so that half is left at the cutoff λ_c.  The polynomial of the second degree in the
deviation is not filtered.  Height and tilt of the correction are zero: a cloud does not tell them from its own
position.

Several clouds show what repeats: the deviation is their mean, and its standard error is that of their differences.
With one cloud the standard error is that of the fitted form (form_error.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.fft
import torch

from bstcad.manufacture.measured import alignment as aligning
from bstcad.manufacture.measured import made_part
from bstcad.manufacture.measured.alignment import BackFace, root_mean_square
from bstcad.manufacture.measured.cloud import Cloud
from bstcad.manufacture.measured.form_error import FormError, fit_form_error, frequencies
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net
from bstcad.optics.surfaces.surfaces import sampled

METHODS = "form", "light"  # values of Settings.by
MAX_GAIN = 1.5  # largest gain; above 2 a round makes the error larger, and filters and noise need a margin
CUTOFF_PITCHES = 4.0  # cutoff of the low pass without a measure of the light, in pitches of the control points
INDIFFERENCE = 0.03  # relative difference of two RRMSDs up to which the longer cutoff is taken
CUTOFFS = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # cutoffs (pitches) of which the light chooses
MIN_CUTOFF_PITCHES = 2.0  # smallest cutoff: the net has no shorter waves
GROWTH = 1.25  # ratio of the deviation's RMS to that of the last round above which the rounds diverge
SCALE = "made-scale"  # check that does not refuse a cloud: an error of power of a weak lens resembles a wrong scale
MIN_RATIO = 2.0  # smallest RMS of a correction relative to its standard error; below it nothing is cut
REALIGNMENTS = 2  # largest number of alignments by the fine relief after that by least squares
MIN_DISPLACEMENT = 1e-6  # displacement of the relief / half of the larger side, below which the alignment stays
RELIEF_PERIODS = 1 / 10  # longest waves of the fine relief, relative to the width of the net
COARSE_DEGREE = 6  # degree of the polynomial that is removed before waves are separated
MIN_RELIEF = 1e-7  # smallest RMS slope of fine relief that has a place
MAP_POINTS = 201  # points per side of the maps


@dataclass(frozen=True)
class CompensationSettings:
    """Settings of a round."""

    gain: float | None = None  # part of the deviation that is corrected; None: 1 / number of the round
    cutoff: float | None = None  # cutoff λ_c of the low pass (mm); None: the light chooses
    by: Literal["form", "light"] = "form"  # correct the whole deviation, or only what changes the picture

    def cutoff_of(self, net: BSplineSurface) -> float:
        """Return the cutoff (mm) for a net."""
        return CUTOFF_PITCHES * max(net.pitch) if self.cutoff is None else self.cutoff

    def refuse(self, net: BSplineSurface) -> None:
        """Raise ValueError, with the option, for settings by which the rounds diverge or the net cannot follow."""
        if self.by not in METHODS:
            raise ValueError(f"--by {self.by}: is not one of {', '.join(METHODS)}")
        if self.gain is not None and not 0 < self.gain <= MAX_GAIN:
            why = "a gain above 2 enlarges the deviation in each round"
            raise ValueError(f"--gain {self.gain:g}: is not between 0 and {MAX_GAIN:g}, and {why}; give a value near 1")
        shortest, width = MIN_CUTOFF_PITCHES * max(net.pitch), min(high - low for low, high in (net.x, net.y))
        if not shortest <= self.cutoff_of(net) <= width:
            allowed = f"{shortest:.3g} mm, two pitches of the control points, and {width:.3g} mm, the width of the net"
            raise ValueError(f"--cutoff {self.cutoff:g}: is not between {allowed}; give a value between them")


USUAL = CompensationSettings()


@dataclass(frozen=True)
class Statistics:
    """Figures (mm) of a deviation over the face, along z."""

    pv: float  # peak to valley
    rms: float


@dataclass(frozen=True, eq=False)
class CompensationRound:
    """A round: what was measured, and what to cut next."""

    number: int  # 1 for the first correction of a design
    net: BSplineSurface  # back to cut next, with the knots of the design's
    correction: BSplineSurface  # change (mm) from the net that was cut to the next
    deviation: Statistics  # measured deviation of the parts from the design, mean of the clouds
    expected: Statistics  # deviation that this round leaves, if the errors repeat
    corrected: Statistics  # size of the correction
    standard_error: float  # RMS standard error (mm) of the measured deviation
    noise: float  # RMS noise (mm) of the points
    parts: int  # number of clouds
    gain: float
    cutoff: float  # mm
    found: BSplineSurface  # measured deviation (mm), mean of the clouds, without height and tilt
    left: BSplineSurface  # deviation (mm) that this round leaves
    volume: float  # volume (mm³) of the correction about its mean
    volume_by_form: float  # volume (mm³) of the whole correction; equal to `volume` by form
    left_by_form: BSplineSurface  # deviation (mm) that the whole correction leaves
    may_stay: Statistics | None = None  # form error that a correction by light leaves; None: by form


def transmission(net: BSplineSurface, cutoff: float) -> np.ndarray:
    """Return the part of the height (m, n) that the low pass keeps of each cosine of a net (ISO 16610-61)."""
    return np.exp2(-((cutoff * frequencies(net)) ** 2))  # exp(-π α² (λ_c f)²), π α² = ln 2


def low_passed(form: FormError, cutoff: float) -> FormError:
    """Return the form error whose random field went through the low pass; polynomial and motion stay."""
    amplitude = scipy.fft.dctn(form.random_field.heights.numpy(), norm="ortho")
    kept = scipy.fft.idctn(amplitude * transmission(form.random_field, cutoff), norm="ortho")
    return replace(form, random_field=replace(form.random_field, heights=torch.from_numpy(kept)))


def measured_form(cloud: Cloud, lens: Lens, decentre: float | None) -> FormError:
    """Return the form error in a cloud of the back; ValueError, with the cloud and its first fault, if it cannot serve.

    The alignment by least squares takes low orders of the form for a motion, by µm.  The fine relief then lies beside
    its place, which looks like a form error of tens of nm in its waves, and would be cut there.  The part is therefore
    aligned again by its fine relief, and the motion that the relief determines is no form error.
    decentre: accept.decentre (mm) of the scene.
    """
    face = BackFace.of(lens)
    part = made_part.aligned(cloud, face, decentre)
    alignment = part.alignment
    for check in part.checks:
        if not check.passed and check.id != SCALE:
            where = f" ({check.where})" if check.where else ""
            why = f"no correction is computed from this cloud, since a check fails: {check.name}{where}"
            raise ValueError(f"{cloud.path}: {why}")
    net = lens.back_net
    for turn in range(REALIGNMENTS + 1):
        form = fit_form_error(face, alignment)
        beside = form.motion + _displacement(_on_nodes(replace(form, motion=np.zeros(6)), net), net, face)
        if turn == REALIGNMENTS or np.abs(beside).max() < MIN_DISPLACEMENT * face.reach:
            break
        pose = alignment.pose.compose(-beside, face.reach)
        alignment = aligning.at_pose(face, cloud.points, pose, alignment.out)
    return replace(form, motion=np.zeros_like(form.motion))


def next_round(
    lens: Lens, cut: BSplineSurface, clouds: Sequence[Cloud], settings: CompensationSettings,
    before: Sequence[Statistics],
    decentre: float | None = None, rate: Callable[[BSplineSurface], float] | None = None,
    staying: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> CompensationRound:  # fmt: skip
    """Return the next round; ValueError, in one sentence, if it would diverge or there is nothing to correct.

    lens: the design, as re-read from its STEP file.  cut: net that was cut last, the design's in the first round.
    clouds: measured points of the parts that were cut from it.  before: deviations of the earlier rounds.  rate:
    returns the RRMSD of the light of a back; with it, and without a stated cutoff, the low pass is the one of CUTOFFS
    that is expected to leave the least RRMSD (`best_cutoff`).  staying: returns the part (m, n) of a deviation that may
    stay, given it and the mask of the points inside the outline; needed by light.
    """
    face_lens = replace(lens, outline=lens.apertures[1])  # if a mount cuts the rim, the face ends there
    settings.refuse(lens.back_net)
    forms = [measured_form(cloud, face_lens, decentre) for cloud in clouds]
    net = lens.back_net
    cutoff = settings.cutoff_of(net)
    if settings.cutoff is None and rate is not None:
        cutoff = best_cutoff(forms, net, rate)
    maps = np.stack([_on_nodes(form, net) for form in forms])
    filtered = np.stack([_on_nodes(low_passed(form, cutoff), net) for form in forms])
    inside = _inside(face_lens, net)
    mean, kept = (_without_plane(part.mean(0), inside) for part in (maps, filtered))
    filtered = np.stack([_without_plane(part, inside) for part in filtered])
    found = _statistics(mean, inside)
    error = _standard_error(forms, filtered, inside, cutoff)
    wanted = root_mean_square(kept[inside])
    if not wanted > MIN_RATIO * error:
        least = (
            f"the repeatable deviation is {_in_micrometres(wanted)} RMS, and it is known to {_in_micrometres(error)}"
        )
        raise ValueError(f"nothing is cut: {least}; measure more parts, or more points of each, if it has to be less")
    if before and found.rms > GROWTH * before[-1].rms:
        grown = f"{_in_micrometres(before[-1].rms)} RMS before the last correction and {_in_micrometres(found.rms)} now"
        remedy = (
            "check datum, sign and axes of the measurement and of the machine; remove the last round to begin again"
        )
        raise ValueError(f"the rounds diverge: the deviation was {grown}; {remedy}")
    gain = 1 / (len(before) + 1) if settings.gain is None else settings.gain
    stays = staying(kept, inside) if settings.by == "light" and staying is not None else np.zeros_like(kept)
    whole, change = -gain * kept, -gain * (kept - stays)
    left = mean + change
    correction, deviation, residue, by_form = (
        replace(net, heights=torch.from_numpy(interpolating_net(part))) for part in (change, mean, left, mean + whole)
    )
    following = replace(cut, heights=cut.heights + correction.heights)
    noise = float(np.sqrt(np.mean([form.noise**2 for form in forms])))
    return CompensationRound(
        len(before) + 1, following, correction, found=deviation, left=residue, deviation=found,
        expected=_statistics(left, inside), corrected=_statistics(change, inside), standard_error=error, noise=noise,
        parts=len(forms), gain=gain, cutoff=cutoff, volume=volume(change, inside, net),
        volume_by_form=volume(whole, inside, net), left_by_form=by_form,
        may_stay=_statistics(stays, inside) if settings.by == "light" else None,
    )  # fmt: skip


def volume(correction: np.ndarray, inside: np.ndarray, net: BSplineSurface) -> float:
    """Return the volume (mm³) between a correction (m, n) in mm, at the points of a net, and its mean."""
    part = correction[inside]
    return float(np.abs(part - part.mean()).sum() * math.prod(net.pitch))


def best_cutoff(forms: Sequence[FormError], net: BSplineSurface, rate: Callable[[BSplineSurface], float]) -> float:
    """Return the cutoff (mm) of CUTOFFS after whose low pass the light is expected to have the least RRMSD.

    A low pass leaves a part of the deviation, and cuts a part of the noise of the measurement into the next part: what
    remains is (1 - F) d + F ε.  The irradiance follows the second derivatives of the face, so that noise of a few nm at
    the shortest waves harms the picture more than µm at the longest ones.  ε is a sample of the uncertainty of the
    forms.  (Letters, 200 000 points with 20 nm of noise: RRMSD 0.074 after two rounds with a cutoff of 4 pitches.)
    """
    mean = np.mean([_on_nodes(form, net) for form in forms], axis=0)
    width = min(high - low for low, high in (net.x, net.y))
    found: dict[float, float] = {}
    for pitches in CUTOFFS:
        if found and pitches * max(net.pitch) > width / 2:
            break
        cutoff, chance = pitches * max(net.pitch), np.random.default_rng(0)
        kept = np.zeros_like(mean)
        for form in forms:
            sample = form.posterior_sample(chance)
            kept += _on_nodes(low_passed(sample, cutoff), net) / len(forms)
        left = torch.from_numpy(interpolating_net(mean - kept))
        found[cutoff] = rate(replace(net, heights=net.heights + left))
    least = min(found.values())
    return max(cutoff for cutoff, rrmsd in found.items() if rrmsd <= (1 + INDIFFERENCE) * least)


def _displacement(deviation: np.ndarray, net: BSplineSurface, face: BackFace) -> np.ndarray:
    """Return the motion (6,), as in BackFace.columns, of a part whose relief a deviation (m, n) shows beside its place.

    A part displaced by (a, b) and turned by c about the axis deviates by -z_x a - z_y b - (x z_y - y z_x) c.  The
    motion is found from waves shorter than RELIEF_PERIODS of the width.
    """
    ends = zip((net.x, net.y), net.shape, strict=True)
    x, y = np.meshgrid(*(np.linspace(*side, count) for side, count in ends), indexing="ij")
    _, z_x, z_y = (part.reshape(net.shape) for part in sampled(net, x.ravel(), y.ravel()))
    columns = (-z_x, -z_y, (y * z_x - x * z_y) / face.reach)
    off, *parts = (_fine(part, net).ravel() for part in (deviation, *columns))
    relief = np.stack(parts, axis=1)
    known, motion = np.sqrt((relief**2).mean(0)) > MIN_RELIEF, np.zeros(6)  # a face without fine relief has no place
    if known.any():
        found = np.linalg.lstsq(relief[:, known], off, rcond=1e-3)[0]
        motion[np.array([0, 1, 5])[known]] = found
    return motion


def _fine(values: np.ndarray, net: BSplineSurface) -> np.ndarray:
    """Return the waves of values (m, n) at the points of a net that are shorter than RELIEF_PERIODS of its width."""
    u, v = np.meshgrid(*(np.linspace(-1.0, 1.0, count) for count in values.shape), indexing="ij")
    orders = range(COARSE_DEGREE + 1)
    columns = np.stack([u**i * v**j for i in orders for j in orders if i + j <= COARSE_DEGREE], axis=-1)
    columns = columns.reshape(values.size, -1)
    smooth = columns @ np.linalg.lstsq(columns, values.ravel(), rcond=None)[0]
    amplitude = scipy.fft.dctn(values - smooth.reshape(values.shape), norm="ortho")
    shortest = RELIEF_PERIODS * min(high - low for low, high in (net.x, net.y))
    return scipy.fft.idctn(np.where(frequencies(net) * shortest > 1, amplitude, 0.0), norm="ortho")


def _on_nodes(form: FormError, net: BSplineSurface) -> np.ndarray:
    """Return the heights (m, n) of a form error at as many points as a net has control points, evenly over it."""
    x, y = (np.linspace(*ends, count) for ends, count in zip((net.x, net.y), net.shape, strict=True))
    x, y = np.meshgrid(x, y, indexing="ij")
    return form.at(x.ravel(), y.ravel()).reshape(net.shape)


def _inside(lens: Lens, net: BSplineSurface) -> np.ndarray:
    x, y = (
        torch.linspace(*ends, count, dtype=torch.float64) for ends, count in zip((net.x, net.y), net.shape, strict=True)
    )
    return lens.outline.contains(*torch.meshgrid(x, y, indexing="ij")).numpy()


def _without_plane(values: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return values (m, n) minus their least-squares plane over the face."""
    u, v = np.meshgrid(*(np.linspace(-1.0, 1.0, count) for count in values.shape), indexing="ij")
    columns = np.stack([np.ones_like(u), u, v], axis=-1)
    return values - columns @ np.linalg.lstsq(columns[inside], values[inside], rcond=None)[0]


def _statistics(values: np.ndarray, inside: np.ndarray) -> Statistics:
    return Statistics(float(np.ptp(values[inside])), root_mean_square(values[inside]))


def _standard_error(forms: Sequence[FormError], maps: np.ndarray, inside: np.ndarray, cutoff: float) -> float:
    """Return the RMS standard error (mm) of the mean of `maps` (k, m, n): by their differences or the fitted form."""
    if len(maps) > 1:
        return root_mean_square(maps.std(0, ddof=1)[inside]) / math.sqrt(len(maps))
    [form] = forms
    kept = form.spread * transmission(form.random_field, cutoff)
    return float(np.sqrt(np.sum(kept**2) / kept.size))


def _in_micrometres(length: float) -> str:
    """Return a length (mm) in µm."""
    return f"{1e3 * length:.3g} µm"


def maps(lens: Lens, nets: Sequence[BSplineSurface]) -> tuple[np.ndarray, ...]:
    """Return x (n,), y (n,) (mm) and the values (n, n; rows y) of nets over the face, NaN outside the outline."""
    axes = [np.linspace(-a, a, MAP_POINTS) for a in lens.apertures[1].half_extent]
    x, y = np.meshgrid(*axes)
    inside = lens.apertures[1].contains(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    found = [np.where(inside, sampled(net, x.ravel(), y.ravel())[0].reshape(x.shape) - net.z, np.nan) for net in nets]
    return (*axes, *found)
