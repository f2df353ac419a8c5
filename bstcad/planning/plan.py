"""Plan a design before it is made: simulated and neglected effects, predicted time, RRMSD and memory.

The sentence of a plan, its table and the page of the workbench state the same predictions (prediction.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from bstcad.analysis.etendue import FORBIDDEN, etendue
from bstcad.analysis.light import blur
from bstcad.analysis.sharp_throw import sharp_throw
from bstcad.designs.pipeline import reachable_part
from bstcad.manufacture.tolerance.grades import making_of
from bstcad.optics.lens.lens import Lens
from bstcad.optics.receivers.goal import worst
from bstcad.optics.surfaces.sides import as_pair, scaled
from bstcad.optics.trace.reach import unreached
from bstcad.planning.cold_run import round_numbers
from bstcad.planning.effect_estimates import coarse_lens, left_out, simulated
from bstcad.planning.net_choice import rrmsd_ratio
from bstcad.planning.prediction import QUALITIES, REMAINING_BLUR, Pilot, predict, run_pilot
from bstcad.planning.reduction import replace_net
from bstcad.report.record import too_steep
from bstcad.report.units import paragraphs
from bstcad.runs.processes import Tick
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.quality import Tailoring
from bstcad.scene.scene import Scene
from bstcad.scene.schema import MAX_CONTROL_POINTS
from bstcad.verify.nominal import DEFAULT_RRMSD_LIMIT

PilotRun = Callable[[Scene, Tick], Pilot]  # designs a pilot of a scene

CAVEAT = "Estimates assume one target and one tailored face; with several, the lens deflects light differently."


def plan(
    scene: Scene,
    text: str = "",
    keys: Sequence[str] = (),
    tick: Tick = lambda: None,
    pilot: PilotRun | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield the entries of `plan --json`: first the effects, then the predictions (see `predict_qualities`).

    simulated: effects that are simulated.  goals: for each target its key, left_out (neglected effects, ordered by
    change of the RRMSD), blur, unreachable, sharp_throw and etendue.  Those of the most blurred target are repeated
    outside goals.

    unreachable: part of the target that light cannot reach (optics.trace.reach.unreached); None: none, or a tailored
    front.

    sharp_throw: longest throw of a sharp picture (analysis.sharp_throw.SharpThrow), with cells of a pixel;
    None: an even target, or not known.

    etendue: {fits, narrowest, unit} of analysis.etendue.Etendue; None: a source without extent.

    blur: width (in the target's unit and in pixels) of the image of an extended source through the coarse lens, and the
    RRMSD of the target convolved with this image; None: a source without extent, or no light passes.

    caveat: sentence that states how the lens of the estimates differs from the scene's; only if it differs.

    verdict: {kind, sentence}, see `verdict`; yielded with the predictions, and with effects that determine the verdict.

    text: text of the scene file, for line numbers.  keys: keys that --set sets.  tick: called regularly, may raise.
    pilot: function that designs a small version of the scene; None: `run_pilot`.
    """
    at, scenes = toml_positions(text), scene.single_target_scenes()
    requested = [{"what": what, "key": key, **_request_of(key, at, keys)} for what, key in simulated(scene)]
    lenses = [coarse_lens(alone) for alone in scenes]
    goals = list(map(_goal_effects, scenes, lenses, scene.target_keys))
    worst_goal = worst((goal["blur"] or {}).get("rrmsd", 0.0) for goal in goals)
    entries = {"simulated": requested, **goals[worst_goal], "goals": goals}
    del entries["key"]
    if len(goals) > 1 or scene.lens.front.is_tailored:
        entries["caveat"] = CAVEAT
    if early := verdict(scene, entries):
        entries["verdict"] = early
    yield entries
    prediction = round_numbers(predict_qualities(scene, lenses, tick, pilot), 3)
    yield prediction | {"verdict": verdict(scene, entries | prediction)}


def verdict(scene: Scene, entries: Mapping[str, Any]) -> dict[str, str] | None:
    """Return the verdict of a plan, {kind, sentence}; None if the present entries do not determine it.

    kind: "etendue" (with any lens, much of the light cannot fit into the target), "blurred" (with any lens, the blur by
    the source exceeds the allowed RRMSD), "within", "open" or "beyond" (the interval of nine of ten designs is below,
    around or above the requested RRMSD, on pixels or half pixels, whichever is harder to reach), "no limit" (no RRMSD
    is requested), or "not predicted".
    """
    requested = scene.accept.rrmsd
    allowed = DEFAULT_RRMSD_LIMIT if requested is None else requested
    targets = zip(scene.targets, entries["goals"], strict=True)
    images = [(each["blur"]["rrmsd"], each["blur"]["width"], target) for target, each in targets if each["blur"]]
    blurred, width, target = max(images, key=lambda image: image[0], default=(0.0, 0.0, scene.target))
    target_width = max(high - low for low, high in (target.x, target.y))
    prediction: Any = entries.get("not_predicted")
    fits = min(
        (each["etendue"] for each in entries["goals"] if each.get("etendue")), key=lambda e: e["fits"], default=None
    )
    if fits is not None and fits["fits"] < FORBIDDEN:
        kind = "etendue"
    elif REMAINING_BLUR * blurred > allowed:
        kind = "blurred"
    elif "predicted" not in entries:
        return None
    elif entries["predicted"] is None:
        kind = "not predicted"
    else:
        quality = scene.tailoring.quality if scene.tailoring.quality in QUALITIES else "standard"
        likely = entries["predicted"][quality]
        prediction = {"quality": quality, "seconds": likely["seconds"][1]}
        limits = [("", likely["rrmsd"], requested), ("half ", likely["rrmsd_half"], scene.accept.rrmsd_half)]
        # the limit that is hardest to keep; without limits, that of the RRMSD on pixels
        cells, interval, requested = max(limits, key=lambda each: 0.0 if each[2] is None else each[1][1] / each[2])
        low, _, high = prediction["rrmsd"] = interval
        prediction["cells"] = f"{cells}pixels"
        if requested is None:
            kind = "no limit"
        else:
            kind = "within" if high <= requested else "beyond" if low > requested else "open"
    image: dict[str, Any] = {"rrmsd": blurred, "least": REMAINING_BLUR * blurred, "width": width}
    image |= {"target": target_width, "unit": target.unit, "optic": scene.optic}
    [sentence] = paragraphs(
        "plan.txt.j2", "verdict", kind=kind, image=image, fits=fits, asked=requested, likely=prediction
    )
    return {"kind": kind, "sentence": sentence}


def _goal_effects(scene: Scene, lens: Lens, key: str) -> dict[str, Any]:
    """Return the entries of `plan` for one target; lens: a coarse lens for it."""
    goal = replace(scene.goals[0], key=key)
    goal = goal.restricted(reachable_part(scene, goal)[0])
    part, target = goal.reachable, goal.picture
    whole, deflection = goal.whole, lens.passes.largest_deflection(scene.index)
    beyond = None if part is None or whole is None else unreached(whole, part, deflection)
    estimates, image = left_out(scene, lens, target), blur(scene.channels(), lens, scene.target.screen, target)
    fits = etendue(scene.light, lens, goal)
    rounded = {"blur": image and round_numbers(asdict(image), 3), "unreachable": beyond and round_numbers(beyond, 3)}
    size = next((each.blur_pixels or 0.0 for each in estimates if each.kind == "source size"), 0.0)
    width = image.width if image else size * scene.target.screen.pixel_side
    light, making = scene.with_source_scaled(0.0).channels(), making_of(scene.tolerance, lens)
    throw = sharp_throw(light, lens, scene.target.screen, making, source_image=width)
    sharp = None if scene.target.uniform else throw
    rounded["sharp_throw"] = sharp and round_numbers(asdict(sharp), 3)
    rounded["etendue"] = fits and round_numbers(asdict(fits), 3)
    return {"key": key, "left_out": [asdict(estimate) for estimate in estimates], **rounded}


def reach_drawn(scene: Scene) -> tuple[bytes, ...]:
    """Return a PNG per target, which shows the part that light can reach; raise SceneError for a tailored front."""
    from bstcad.figures.drawing import png
    from bstcad.figures.light_figures import View, reach_picture

    if scene.lens.front.is_tailored:
        raise SceneError(
            "--png: draws the part of the target that light can reach through a tailored back, but in this scene the "
            "front is tailored; omit --png"
        )
    images = []
    for alone in scene.single_target_scenes():
        [goal] = alone.goals
        part, _ = reachable_part(alone, goal)
        lit = np.ones(goal.picture.shape, dtype=bool) if part is None else part
        images.append(png(reach_picture(goal.picture, lit, View.of(alone))))
    return tuple(images)


def _request_of(key: str, at: Mapping[str, int], keys: Sequence[str]) -> dict[str, Any]:
    """Return {line, asked_by} for a key: its line by `at` (None: default or one of `keys`), and what sets it."""
    for other in keys:
        if other == key or key.startswith(f"{other}.") or other.startswith(f"{key}."):
            return {"line": None, "asked_by": f"--set {other}"}
    line = line_of(key, at)
    return {"line": line, "asked_by": key if line is None else f"{key}, line {line}"}


# --- predictions ------------------------------------------------------------------------------------------------------


def predict_qualities(
    scene: Scene,
    lenses: Sequence[Lens],
    tick: Tick = lambda: None,
    pilot: PilotRun | None = None,
) -> dict[str, Any]:
    """Return {predicted, not_predicted, finer, notes}: predictions for each quality, or the reason why there are none.

    notes: remarks on steepness and on limits that end a design early.  finer: {control_points, predicted} for a net
    with twice the spans per side; None: net too large, or no predictions.  lenses: a coarse lens per target.
    pilot: as in `plan`.
    """
    entries: dict[str, Any] = {"predicted": None, "not_predicted": None, "finer": None, "notes": []}
    try:
        flown = (pilot or run_pilot)(scene, tick)
    except SceneError as refusal:
        return entries | {"not_predicted": f"a small version of this scene was refused: {refusal}"}
    predicted = predict(scene, flown)
    entries |= {"predicted": predicted, "notes": [*too_steep(flown.steep), *_limit_notes(scene.tailoring, predicted)]}
    net = scaled(scene.lens.back.net, 2)
    if max(as_pair(net)) <= MAX_CONTROL_POINTS:
        finer = replace_net(scene, net)
        gain = rrmsd_ratio(scene, finer, lenses)
        entries["finer"] = {"control_points": net, "predicted": predict(finer, flown, gain)}
    return entries


def _limit_notes(limits: Tailoring, predicted: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> Iterator[str]:
    """Yield remarks on limits of the scene that the predictions ignore."""
    max_time, accuracy = limits.max_time, limits.accuracy
    if max_time is not None and (exceeding := [q for q, each in predicted.items() if each["seconds"][1] > max_time]):
        yield f"tailoring.max_time = {max_time:g} would end a {' or '.join(exceeding)} design early, with more error."
    if accuracy is not None and (early := [q for q, each in predicted.items() if each["rrmsd"][1] < accuracy]):
        yield f"tailoring.accuracy = {accuracy:g} would end a {' or '.join(early)} design early, at this RRMSD."
