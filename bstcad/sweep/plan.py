"""A plan of a scene before its design: effects that are simulated and left out; seconds, RRMSD and memory predicted.

Seconds and memory follow from amounts of work,

    seconds = Σ amount · price · unit,

with the units of this machine (cold_run.units); RRMSD from pilots, designs of a half and a quarter of the size or so.
tests/benchmarks/prediction_fit.py fitted the constants on whole designs; the intervals hold nine of ten of these.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.analysis.cost import ControlCells, control_cells, limits
from bstcad.analysis.light import blur
from bstcad.analysis.steepness import Steepness
from bstcad.optics.goal import worst
from bstcad.optics.lens import Lens
from bstcad.optics.measure import Effort, rrmsd_by_rays
from bstcad.optics.reach import unreached
from bstcad.optics.sides import both, coarser, scaled
from bstcad.pipeline import (
    check_thickness,
    reachable_part,
    reached,
    second_stage,
    steepness,
    task_of,
    transport_of,
    within_reach,
)
from bstcad.report.record import simulated, too_steep
from bstcad.report.units import about, number, quantity, two_digits
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.quality import COARSEST_GRID, PRESETS, Tailoring
from bstcad.scene.scene import Scene
from bstcad.sweep.cold_run import PIXELS, TUBES, Units, rounded
from bstcad.sweep.cold_run import units as measured_units
from bstcad.sweep.estimates import coarse_lens, left_out
from bstcad.tailoring import stage1
from bstcad.tailoring.run import EVALUATED, Driver, silent
from bstcad.tailoring.slope_map import SUBCELLS
from bstcad.tailoring.stage1 import aimed
from bstcad.tailoring.stage2 import JOINT, blurred_sheets, sheets
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT

FITTED = Path(__file__).with_name("fitted.json")
Interval = tuple[float, float, float]  # low, likely, high
ALONE = "The lens is one for this target alone, by its back alone: one of several goals or faces turns light otherwise."


def plan(
    scene: Scene,
    text: str = "",
    keys: Sequence[str] = (),
    units: Callable[[], Units] = measured_units,
    tick: Callable[[], None] = lambda: None,
) -> Iterator[dict[str, Any]]:
    """The entries of `plan --json`: first simulated and goals: of each target its key, left_out by change of the RRMSD,
    blur, unreachable, which stand outside of the list too, of the target that is blurred most; then the predictions.

    unreachable: what light cannot reach, as optics.reach.unreached has it; None: it reaches all that is to be lit.

    blur: width (mm, and pixels) of the image that a source of some size throws through the coarse lens, and the RRMSD
    of the target convolved with this image; None: the source has no size.

    caveat: what the lens of the estimates lacks of the scene's, a sentence; only there if it lacks anything.

    verdict: {kind, sentence}, with the effects only where these decide it: see `verdict`.

    text: of the scene file, whose lines are named.  keys: that the command line gives instead.  units: measures the
    units of this machine.  tick: called now and then; an exception from it ends the plan.
    """
    at, scenes = toml_positions(text), scene.each_alone()
    asked = [{"what": what, "key": key, **_asked(key, at, keys)} for what, key in simulated(scene)]
    lenses = [coarse_lens(alone) for alone in scenes]
    goals = list(map(_effects, scenes, lenses, scene.target_keys))
    blurred = worst((goal["blur"] or {}).get("rrmsd", 0.0) for goal in goals)
    found = {"simulated": asked, **goals[blurred], "goals": goals}
    del found["key"]
    if len(goals) > 1 or scene.lens.front.shaped:
        found["caveat"] = ALONE
    if early := verdict(scene, found):
        found["verdict"] = early
    yield found
    likely = rounded(outlook(scene, lenses[0], units, tick), 3)
    yield likely | {"verdict": verdict(scene, found | likely)}


def verdict(scene: Scene, found: Mapping[str, Any]) -> dict[str, str] | None:
    """Return what a plan comes to, {kind, sentence}; None: the entries that are known so far do not decide it.

    kind: blurred (by the source's image, beyond the RRMSD that is allowed, whatever the lens), within, open or beyond
    (of the RRMSD that is asked, by what nine of ten designs keep to), no limit (is asked), not predicted.
    """
    asked = scene.accept.rrmsd
    allowed = DEFAULT_RRMSD_LIMIT if asked is None else asked
    targets = zip(scene.targets, found["goals"], strict=True)
    images = [(each["blur"]["rrmsd"], each["blur"]["width"], target) for target, each in targets if each["blur"]]
    blurred, width, target = max(images, key=lambda image: image[0], default=(0.0, 0.0, scene.target))
    wide = max(high - low for low, high in (target.screen.x, target.screen.y))
    least, most = (number(two_digits(value)) for value in (UNDONE * blurred, blurred))
    if UNDONE * blurred > allowed:
        permits = "" if asked is None else f", where {number(asked)} is allowed"
        sentence = (
            f"The picture will be blurred: through each place of the {scene.optic} the source throws an image of "
            f"itself {about(width, 'mm')} wide on the target, which is {quantity(wide, 'mm')} wide. The RRMSD will be "
            f"{least} to {most} whatever the {scene.optic}{permits}. Take a smaller source, "
            f"one further before the {scene.optic}, a target nearer behind it, or a coarser picture."
        )
        return {"kind": "blurred", "sentence": sentence}
    if "predicted" not in found:
        return None
    if found["predicted"] is None:
        text = f"No RRMSD is predicted: {found.get('not_predicted')}."
        if blurred > NOTABLE:
            text += f" The source's image, {about(width, 'mm')} wide on the target, makes one of {least} to {most}."
        return {"kind": "not predicted", "sentence": text}
    quality = scene.tailoring.quality if scene.tailoring.quality in QUALITIES else "standard"
    (low, likely, high), (_, time, _) = (found["predicted"][quality][key] for key in ("rrmsd", "seconds"))
    took = about(time, "s") if time < 2 * MINUTE else about(time / MINUTE, "minutes")
    text = f"An RRMSD of about {about(likely)} in about {took}, in {quality} quality"
    if asked is None:
        kept = f"[accept] rrmsd = {two_digits(high):g}"
        kind, words = "no limit", f"none is asked; nine of ten designs would keep {kept}"
    elif high <= asked:
        kind, words = "within", f"{number(asked)} is allowed"
    elif low > asked:
        kind, words = "beyond", f"{number(asked)} is allowed, and will hardly be reached"
    else:
        kind, words = "open", f"{number(asked)} is allowed, and {about(low)} to {about(high)} may come out"
    if COARSE * width > wide:
        words += (
            f". The source's image on the target is {about(width, 'mm')} wide, and the target {quantity(wide, 'mm')}: "
            "finer detail is lost"
        )
    return {"kind": kind, "sentence": f"{text}; {words}."}


def _effects(scene: Scene, lens: Lens, key: str) -> dict[str, Any]:
    """The entries key, left_out, blur and unreachable of `plan` for one target; lens: a coarse one for it."""
    goal = replace(scene.goals[0], key=key)
    goal = goal.restricted(reachable_part(scene, goal)[0])
    part, target = goal.reachable, goal.picture
    beyond = None if part is None else unreached(goal.whole, part, None if lens.reflects else scene.index)
    estimates, image = left_out(scene, lens, target), blur(scene.channels(), lens, scene.target.screen, target)
    return {
        "key": key, "left_out": [asdict(estimate) for estimate in estimates],
        "blur": image and rounded(asdict(image), 3), "unreachable": beyond and rounded(beyond, 3),
    }  # fmt: skip


def reach_drawn(scene: Scene) -> tuple[bytes, ...]:
    """A PNG of each target and the part of it that light can reach.  SceneError for a front that is tailored."""
    from bstcad.report.drawing import png
    from bstcad.report.light_figures import View, reach_picture

    if scene.lens.front.shaped:
        raise SceneError(
            "--png: draws what light can reach by way of a tailored back, and here the front is tailored; leave it "
            "out: `bstcad generate` says first what such a lens cannot do"
        )
    return tuple(
        png(reach_picture(each.target.irradiance(), _reached_part(each), View.of(each))) for each in scene.each_alone()
    )


def _reached_part(scene: Scene) -> np.ndarray:
    """(rows, columns) True in the pixels that light can reach."""
    [goal] = scene.goals
    part, _ = reachable_part(scene, goal)
    return np.ones(goal.picture.shape, dtype=bool) if part is None else part


def _asked(key: str, at: Mapping[str, int], keys: Sequence[str]) -> dict[str, Any]:
    """The line of the file that asks for an effect, None if the command line does, or nobody; and that in words."""
    for other in keys:
        if other == key or key.startswith(f"{other}.") or other.startswith(f"{key}."):
            return {"line": None, "asked_by": f"--set {other}"}
    line = line_of(key, at)
    return {"line": line, "asked_by": key if line is None else f"{key}, line {line}"}


@cache
def fitted() -> Mapping[str, Any]:
    """The constants of the fit: prices, memory, rrmsd, and within: the factors that nine of ten designs keep to."""
    return json.loads(FITTED.read_text(encoding="utf-8"))


# --- amounts of work --------------------------------------------------------------------------------------------------

NET, CELLS, ITERATIONS = 513, 256, 40  # a side, or in all: amounts are in multiples of these, of TUBES and of PIXELS
JUDGED, TRACED = 2.0, 6.0e6  # judging PIXELS² pixels between stages takes as long as 2 x TUBES² tubes; tubes a second
RAYS, ROUGHLY = 3.5, 1.0  # of a proof, and of a draft's, in units of a second of rays


# By kind of work: the stage in which it is done, and the unit that it is in, a field of cold_run.Units.
KINDS = {
    "start": ("start", "serial"),  # imports, and the end of the process
    "pixels": ("start", "serial"),
    "rounds": ("stage 1", "serial"),
    "transport": ("stage 1", "serial"),
    "slope fit": ("stage 1", "serial"),  # control points of the last two rounds
    "front": ("stage 1", "serial"),  # sought
    "other way": ("stage 1", "serial"),  # rays of its last fit, if it is tried
    "rays found": ("stage 1", "tubes"),  # of a point, through given places of the back, by Broyden's method
    "first judging": ("stage 1", "tubes"),
    "evaluations": ("stage 2", "tubes"),
    "roots": ("stage 2", "tubes"),  # rays of a point, whose hits are found by Newton's method
    "launched": ("stage 2", "tubes"),  # tubes of a point, at the start of each round
    "crossings": ("stage 2", "tubes"),  # of tubes and pixel borders
    "variable": ("stage 2", "tubes"),  # control points, in each evaluation
    "images": ("stage 2", "tubes"),  # of a source of some size, at the start of each round
    "blurs": ("stage 2", "serial"),  # by these images, in each evaluation
    "writing": ("write", "serial"),
    "net written": ("write", "serial"),
    "rays": ("verify", "tubes"),
    "tubes": ("verify", "tubes"),
    "points": ("verify", "tubes"),  # of a source of some size
    "net read": ("verify", "serial"),
    "report": ("report", "serial"),
    "pictures": ("report", "serial"),
    "steps of Adam": ("Adam", "tubes"),  # of the paper's procedure, of which no design is predicted
}


def amounts(scene: Scene, other_way: bool = False) -> dict[str, float]:
    """The amounts of KINDS in a design; other_way: does its stage 1 try the other way?"""
    (columns, rows), knobs = scene.target.columns_rows, scene.tailoring.resolved(scene.lens.back.net)
    m, net, pixels = max(both(scene.lens.back.net)), (knobs.side / NET) ** 2, columns * rows / PIXELS**2
    wide = scene.source.extent is not None  # tailored by one sheet a line
    spread = len(scene.with_source_scaled(0.0).channels()) if wide else len(scene.channels()) ** 0.5
    point = scene.source.kind == "point"
    judged = JUDGED * pixels ** (2 / 3)  # rays as run.BETWEEN has them
    adam, slopes = knobs.method == "adam", knobs.method == "least-squares"
    counts = blurred_sheets(knobs, (columns, rows)) if wide else sheets(knobs)
    rounds = [] if adam else [(tubes / TUBES, evaluations) for tubes, evaluations in counts]
    traced = spread * sum(tubes**2 * count for tubes, count in rounds)
    steps = knobs.stage1_iterations * len(knobs.levels) + knobs.stage2_iterations
    grids = [knobs.transport_grid]  # cells a side of the transport in each round; Wang et al.'s is one map
    if slopes:
        grids = [max(COARSEST_GRID, knobs.transport_grid // 2 ** min(left, 2)) for left in range(knobs.rounds)]
    fitted = min(2 * knobs.side, knobs.rays)
    found = sum((SUBCELLS * grid / TUBES) ** 2 for grid in grids) + (fitted / TUBES) ** 2
    return {
        "start": 1.0,
        "pixels": pixels,
        "rounds": knobs.rounds if slopes else 0.0,
        "transport": sum((grid / CELLS) ** 2 for grid in grids) * knobs.transport_iterations / ITERATIONS,
        "slope fit": sum(math.prod(both(level)) / NET**2 for level in knobs.levels[-2:]) if slopes else 0.0,
        "front": 1.0 if scene.lens.front.free else 0.0,
        "other way": (aimed(m, knobs.rays) / TUBES) ** 2 if other_way else 0.0,
        "rays found": found if point else 0.0,
        "first judging": judged,
        "evaluations": traced + len(rounds) * judged * EVALUATED / TRACED,  # each round is judged at its end
        "roots": traced if point else 0.0,
        "launched": spread * sum(tubes**2 for tubes, _ in rounds) if point else 0.0,
        "crossings": spread * sum(tubes * count for tubes, count in rounds) * math.sqrt(pixels),
        "variable": net * sum(count for _, count in rounds),
        "images": float(len(rounds)) if wide else 0.0,
        "blurs": pixels * sum(count for _, count in rounds) if wide else 0.0,
        "writing": 1.0,
        "net written": net,
        "rays": (ROUGHLY if knobs.quality == "draft" else RAYS) * (2.0 if point else 1.0),
        "tubes": 0.0 if wide else ((2 * knobs.side + 5) / TUBES) ** 2,
        "points": 1.0 if wide else 0.0,
        "net read": net,
        "report": 1.0,
        "pictures": pixels,
        "steps of Adam": steps * spread * (knobs.rays / TUBES) ** 2 if adam else 0.0,
    }


def seconds(work: Mapping[str, float], prices: Mapping[str, float], unit: Units) -> float:
    """Σ amount · price · unit."""
    return sum(amount * prices.get(kind, 0.0) * getattr(unit, KINDS[kind][1]) for kind, amount in work.items())


def memory_amounts(scene: Scene) -> dict[str, float]:
    """The amounts that take memory; their prices are GB."""
    (columns, rows), knobs = scene.target.columns_rows, scene.tailoring.resolved(scene.lens.back.net)
    corners = (knobs.rays / TUBES) ** 2
    roots = corners if scene.source.kind == "point" else 0.0
    pixels = columns * rows / PIXELS**2
    goals = len(scene.targets) + (scene.wavefront is not None)
    if goals > 1:
        corners *= A_GOAL * goals * JOINT[-1][0] ** 2
    return {
        "libraries": 1.0, "corners": corners, "roots": roots, "net": len(scene.lens.nets()) * (knobs.side / NET) ** 2,
        "pixels": pixels,
    }  # fmt: skip


def memory_gb(scene: Scene, prices: Mapping[str, float]) -> float:
    """The most that both processes of a design hold, as a sum."""
    return sum(amount * prices[kind] for kind, amount in memory_amounts(scene).items())


# --- pilots -----------------------------------------------------------------------------------------------------------
# A pilot is the design of a scene as small as makes sense, by the same steps, to see its RRMSD.  Net, pixels, tubes and
# cells of the transport are those of the scene over one factor, so that a pixel has the control cells and the tubes
# that it has in the scene, light is as scarce where it is, and the search makes as many evaluations.  The pilot does
# not see detail that is finer than its pixels, which is measured on the picture.  The pilot of a draft, which is
# quickly made, is larger: the error after a few evaluations depends on the size.

QUALITIES = ("draft", "standard", "fine")
# Most pixels, control points and tubes a side; more pixels where the control points would be fewer than FEWEST_POINTS.
SIZES = {"draft": (256, 385, 768), "standard": (128, 193, 512)}
FEWEST_POINTS = 65  # control points a side
A_GOAL = 3.0  # times the memory of corners for one target, that each of several goals takes (6.2 GB; 5.9 measured)
MINUTE = 60.0  # s
NOTABLE = 0.01  # RRMSD by the source's image that is worth a sentence
COARSE = 10.0  # images of the source beside each other on a target: where there are fewer, a plan says so
UNDONE = 0.5  # of the blur by a source of some size, that stage 3 leaves
PILOT_CELLS = (16, 256)  # a side of its transport, at least and at most
PILOT_JUDGED = Effort(rays=2048, accuracy=0.02, witness=False)  # few rays are noisier than smooth light is wrong


@dataclass(frozen=True)
class Pilot:
    """The result of a pilot."""

    rrmsd: float
    factor: float  # pixels a side of the scene over those of the pilot
    detail: float  # of the scene's picture, finer than the pilot's pixels
    blurred: float  # RRMSD that a source of some size blurs, by the scene's pixels less than by the pilot's
    doubtful: bool  # did stage 1 try the other way as well?
    lens: Lens
    steep: Steepness  # that its target's light needs of the back


def pilots(scene: Scene, lens: Lens, tick: Callable[[], None] = lambda: None) -> dict[str, Pilot]:
    """By quality; a fine pilot would be dear, and its quality goes by that of standard.

    lens: a coarse one for the scene, whose front the pilots have.  SceneError where a design would be refused: no light
    reaches the target, or the lens would be too thick or too thin.
    """
    found = {quality: _pilot(scene, lens, quality, tick) for quality in SIZES}
    return found | {"fine": found["standard"]}


def _pilot(scene: Scene, lens: Lens, quality: str, tick: Callable[[], None]) -> Pilot:
    small, factor, knobs = _small(scene, quality)
    target = small.target
    goals, edge = within_reach(small, silent)
    task = replace(task_of(small, goals, knobs, edge), free=())  # it has a front already
    flat = small.flat_lens(knobs.levels[0], as_wide_as=knobs.levels[-1])
    first = [step for step in stage1.steps(task, replace(flat, front=lens.front)) if tick() is None]
    sent = transport_of(first[-1], first[-1].lens, target.screen)
    *_, rounds = (step for step in first if step.state is not None)
    judged = [step.judged for step in first if step.judged is not None]
    reached(first[-1].lens, judged[-1])
    check_thickness(first[-1].lens, scene)
    driver, second = Driver(), second_stage(task, first[-1].lens)[1]
    last = driver.run((step for step in second if tick() is None), task.whole, lambda state: state, lambda: "")
    made, best = last.lens, driver.best
    if best is not None and last.judged is not None and best.beats(task.whole.judged(made, last.judged)):
        made, _ = task.whole.better(made, best.lens.applied(made))  # a design hands on its best lens
    unseen = detail(scene.target.irradiance(), max(target.columns_rows))
    steep = steepness(task.heaviest.source, made, goals[0], sent=sent)
    doubtful = stage1.doubtful(task, rounds.lens, judged[0], rounds.state)
    blurred = _blurred(scene, made) - _blurred(small, made) if factor > 1 else 0.0
    rrmsd = rrmsd_by_rays(
        made, small.channels(), target.screen, target=goals[0].picture, effort=PILOT_JUDGED, draw=small.draw
    )
    return Pilot(rrmsd, factor, unseen, blurred=blurred, doubtful=doubtful, lens=made, steep=steep)


def _blurred(scene: Scene, lens: Lens) -> float:
    """RRMSD of the target convolved with the image that a source of some size throws; 0 for a point."""
    image = blur(scene.channels(), lens, scene.target.screen, scene.target.irradiance())
    return 0.0 if image is None else image.rrmsd


def _small(scene: Scene, quality: str) -> tuple[Scene, float, Tailoring]:
    """The scene of a pilot, the pixels a side of the scene over those of the pilot, and the pilot's knobs."""
    own, (columns, rows) = scene.lens.back.net, scene.target.columns_rows
    m = max(both(own))
    pixels, net, tubes = SIZES[quality]
    fewest, most = ((m - 1) / (points - 1) for points in (FEWEST_POINTS, net))
    factor = max(min(max(max(columns, rows) / pixels, most), fewest), 1.0)
    less = {"lens.back.control_points": coarser(own, round((m - 1) / factor) + 1), "tailoring.levels": None}
    small = scene.changed(less | {"target.pixels": scene.target.fewer_pixels(factor)})
    whole, knobs = (Tailoring(quality=quality).resolved(each.lens.back.net) for each in (scene, small))
    cells = int(np.clip(round(whole.transport_grid / factor), *PILOT_CELLS))
    rays = min(round(whole.rays / factor), tubes)
    return small, factor, knobs.model_copy(update={"rays": rays, "transport_grid": cells})


def detail(picture: np.ndarray, pixels: int) -> float:
    """RMS of the waves of a picture with more half waves over its longer side than so many pixels, over its RMS."""
    from scipy.fft import dctn

    energy = dctn(picture, norm="ortho") ** 2
    half_waves = np.hypot(*np.meshgrid(*(np.arange(n) * max(picture.shape) / n for n in picture.shape), indexing="ij"))
    return float(np.sqrt(energy[half_waves > pixels].sum() / energy.sum()))


def _cells(scene: Scene, lens: Lens) -> ControlCells:
    """Of a net of as many control points as the scene has, by the way that light takes through a pilot's lens."""
    light = max(scene.with_source_scaled(0.0).channels(), key=lambda channel: channel.weight)
    few = control_cells(light, lens.plain(), scene.target.screen, scene.target.irradiance())
    pairs = zip(both(scene.lens.back.net), lens.back.shape, strict=True)
    finer = math.prod((many - 2) / (known - 2) for many, known in pairs)
    return replace(few, a_pixel=finer * few.a_pixel)


# --- predictions ------------------------------------------------------------------------------------------------------

FIT_NETS, FIT_PIXELS = (65, 1025), (120, 512)  # a side, of the fit; pixels: of the longer side
ASPECT = 2.0  # of the target, or its inverse
ENDS = {"quality", "seed", "accuracy", "max_time", "source_points"}  # keys of [tailoring] that set no amount of work
GAINED = 0.43  # times the RRMSD: with 1025 control points instead of 513, for the portrait, the largest gain of the fit


def complaint(scene: Scene) -> str:
    """Why no figures are predicted for a scene, in a sentence; "" if they are."""
    reasons = (f"{sample}, and {here}" for outside, sample, here in _bounds(scene) if outside)
    return next((f"predictions were fitted on {reason}" for reason in reasons), "")


def _bounds(scene: Scene) -> Iterator[tuple[Any, str, str]]:
    """(does the scene lie outside of the fit?, the scenes of the fit, this scene)"""
    net, (columns, rows), front = scene.lens.back.net, scene.target.columns_rows, scene.lens.front.kind
    integrated = scene.tailoring.method == "integration"
    yield integrated, "tailored lenses", 'tailoring.method = "integration" tailors none'
    yield len(scene.source.lines) > 1, "one wavelength", "source.wavelength has several"
    yield len(scene.targets) > 1, "one target", f"the scene has {len(scene.targets)}"
    yield scene.wavefront is not None, "pictures alone", "the scene has a [wavefront]"
    tilted = scene.source.tilt or scene.target.tilt
    yield tilted, "sources and targets that look along the axis", "here one is tilted"
    yield front not in ("plane", "sphere"), "plane and spherical fronts", f'lens.front.kind = "{front}"'
    keys = " and ".join(f"lens.{key}" for key in scene.lens.bounded_by)
    yield scene.lens.bounds is not None, "backs of any shape", f"the scene bounds it by {keys}"
    kinds = " and ".join(effect.kind for effect in scene.effects)
    yield kinds, "designs without effects", f"the scene asks for {kinds}"
    for key, value, (least, most) in (
        ("lens.back.control_points", max(both(net)), FIT_NETS),
        ("target.pixels", max(columns, rows), FIT_PIXELS),
    ):
        yield not least <= value <= most, f"{key} from {least} to {most}", f"here there are {value}"
    oblong = not 1 / ASPECT <= columns / rows <= ASPECT
    yield oblong, "targets of nearly equal sides", f"this one has {columns} x {rows} pixels"
    preset = Tailoring(quality=scene.tailoring.quality).resolved(net)
    for key, value in sorted(scene.tailoring.model_dump(exclude=ENDS, exclude_none=True).items()):
        yield value != getattr(preset, key), "the qualities as they are", f"tailoring.{key} is set"


def outlook(
    scene: Scene, lens: Lens, units: Callable[[], Units], tick: Callable[[], None] = lambda: None
) -> dict[str, Any]:  # fmt: skip
    """Predictions of a scene in each quality, and with about twice the control points; or why there are none.

    lens: a coarse one for the scene, from which the pilots start.
    """
    found = {"predicted": None, "not_predicted": complaint(scene) or None, "finer": None, "notes": []}
    if found["not_predicted"]:
        return found
    try:
        small = pilots(scene, lens, tick)
    except SceneError as refusal:
        return found | {"not_predicted": f"a small design of this scene is refused: {refusal}"}
    unit, likely = units(), rrmsds(small)

    def each(scene: Scene, rrmsds: Mapping[str, float]) -> dict[str, dict[str, Interval]]:
        return {q: forecast(scene, q, rrmsds[q], unit, other_way=small[q].doubtful) for q in QUALITIES}

    predicted = each(scene, likely)
    found |= {"predicted": predicted, "notes": [*too_steep(small["standard"].steep), *_ends_early(scene, predicted)]}
    net = scaled(scene.lens.back.net, 2)
    if max(both(net)) <= FIT_NETS[1]:
        finer = scene.changed({"lens.back.control_points": net, "tailoring.levels": None})
        cells, blurred = _cells(scene, small["standard"].lens), UNDONE * _blurred(scene, small["standard"].lens)
        for quality, value in likely.items():  # as reports of designs estimate it
            gains = {limit.by: limit.rrmsd for limit in limits(value, cells)}
            likely[quality] = min(value, max(value * max(gains["control points"], GAINED), blurred))
        found["finer"] = {"control_points": net, "predicted": each(finer, likely)}
    return found


def forecast(scene: Scene, quality: str, rrmsd: float, unit: Units, other_way: bool = False) -> dict[str, Interval]:
    """Of a quality whose RRMSD is likely to be this: seconds of the command, RRMSD, GB of both processes as a sum.

    other_way: does its stage 1 try the other way?
    """
    known, wanted = fitted(), of_quality(scene, quality)
    likely = {
        "seconds": seconds(amounts(wanted, other_way), known["prices"], unit),
        "rrmsd": rrmsd,
        "memory_gb": memory_gb(wanted, known["memory"]),
    }
    within = known["within"]
    return {key: (value / within[key], value, value * within[key]) for key, value in likely.items()}


def of_quality(scene: Scene, quality: str) -> Scene:
    """The scene in a quality, every knob as the preset has it."""
    unset = {f"tailoring.{key}": None for key in (*PRESETS[quality], "levels")}
    return scene.changed(unset | {"tailoring.quality": quality})


def rrmsds(small: Mapping[str, Pilot]) -> dict[str, float]:
    """RRMSD of each quality by its pilot; none is above that of the quality below it, which does less."""
    least, by_quality = math.inf, {}
    for quality in QUALITIES:
        least = by_quality[quality] = min(least, rrmsd(small[quality], fitted()["rrmsd"][quality]))
    return by_quality


def rrmsd(small: Pilot, constants: Mapping[str, float]) -> float:
    """The pilot's RRMSD (of `fine` a share of it), less the smaller the pilot; shares of unseen detail and blur."""
    seen = constants["pilot"] * small.factor ** constants["power"] * small.rrmsd
    return seen + constants["detail"] * small.detail + UNDONE * small.blurred


def _ends_early(scene: Scene, predicted: Mapping[str, Mapping[str, Interval]]) -> Iterator[str]:
    """Limits of the scene that no prediction reckons with."""
    most, enough = scene.tailoring.max_time, scene.tailoring.accuracy
    if most is not None and (late := [q for q, each in predicted.items() if each["seconds"][1] > most]):
        yield f"tailoring.max_time = {most:g} would end {' and '.join(late)} before that, with more error."
    if enough is not None and (early := [q for q, each in predicted.items() if each["rrmsd"][1] < enough]):
        yield f"tailoring.accuracy = {enough:g} would end {' and '.join(early)} as soon as it is reached, in less time."
