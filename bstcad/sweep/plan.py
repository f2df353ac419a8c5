"""A plan of a scene before its design: effects that are simulated and left out; seconds, RRMSD and memory predicted.

The sentence of a plan, its table and the page of the workbench have the same predictions (prediction.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from bstcad.analysis.light import blur
from bstcad.optics.goal import worst
from bstcad.optics.lens import Lens
from bstcad.optics.reach import unreached
from bstcad.optics.sides import both, scaled
from bstcad.pipeline import reachable_part
from bstcad.report.record import simulated, too_steep
from bstcad.report.units import about, number, quantity, two_digits
from bstcad.scene.blank import LARGEST_NET
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.scene import Scene
from bstcad.sweep.cold_run import rounded
from bstcad.sweep.estimates import coarse_lens, left_out
from bstcad.sweep.net_choice import gain
from bstcad.sweep.prediction import FLOWN, QUALITIES, UNDONE, Interval, fly, of_net, predictions
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT

MINUTE = 60.0  # s
NOTABLE = 0.01  # RRMSD by the source's image that is worth a sentence
COARSE = 10.0  # images of the source beside each other on a target: where there are fewer, a plan says so
ALONE = "The lens is one for this target alone, by its back alone: one of several goals or faces turns light otherwise."


def plan(
    scene: Scene,
    text: str = "",
    keys: Sequence[str] = (),
    tick: Callable[[], None] = lambda: None,
) -> Iterator[dict[str, Any]]:
    """The entries of `plan --json`: first simulated and goals: of each target its key, left_out by change of the RRMSD,
    blur, unreachable, which stand outside of the list too, of the target that is blurred most; then the predictions.

    unreachable: what light cannot reach, as optics.reach.unreached has it; None: it reaches all that is to be lit.

    blur: width (in its unit, and in pixels) of the image that a source of some size throws through the coarse lens, and
    the RRMSD of the target convolved with this image; None: the source has no size.

    caveat: what the lens of the estimates lacks of the scene's, a sentence; only there if it lacks anything.

    verdict: {kind, sentence}, with the effects only where these decide it: see `verdict`.

    text: of the scene file, whose lines are named.  keys: that the command line gives instead.  tick: called now and
    then; an exception from it ends the plan.
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
    likely = rounded(outlook(scene, lenses, tick), 3)
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
    wide, unit = max(high - low for low, high in (target.x, target.y)), target.unit
    least, most = (number(two_digits(value)) for value in (UNDONE * blurred, blurred))
    if UNDONE * blurred > allowed:
        permits = "" if asked is None else f", where {number(asked)} is allowed"
        sentence = (
            f"The picture will be blurred: through each place of the {scene.optic} the source throws an image of "
            f"itself {about(width, unit)} wide on the target, which is {quantity(wide, unit)} wide. The RRMSD will be "
            f"{least} to {most} whatever the {scene.optic}{permits}. Take a smaller source, "
            f"one further before the {scene.optic}, a target nearer behind it, or a coarser picture."
        )
        return {"kind": "blurred", "sentence": sentence}
    if "predicted" not in found:
        return None
    if found["predicted"] is None:
        text = f"No RRMSD is predicted: {found.get('not_predicted')}."
        if blurred > NOTABLE:
            text += f" The source's image, {about(width, unit)} wide on the target, makes one of {least} to {most}."
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
            f". The source's image on the target is {about(width, unit)} wide, and the target {quantity(wide, unit)}: "
            "finer detail is lost"
        )
    return {"kind": kind, "sentence": f"{text}; {words}."}


def _effects(scene: Scene, lens: Lens, key: str) -> dict[str, Any]:
    """The entries key, left_out, blur and unreachable of `plan` for one target; lens: a coarse one for it."""
    goal = replace(scene.goals[0], key=key)
    goal = goal.restricted(reachable_part(scene, goal)[0])
    part, target = goal.reachable, goal.picture
    beyond = None if part is None else unreached(goal.whole, part, lens.passes.largest_turn(scene.index))
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


# --- predictions ------------------------------------------------------------------------------------------------------


def outlook(scene: Scene, lenses: Sequence[Lens], tick: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Predictions of a scene in each quality, and with about twice the control points; or why there are none.

    lenses: a coarse one for each of its targets.
    """
    found = {"predicted": None, "not_predicted": None, "finer": None, "notes": []}
    try:
        pilots = {quality: fly(scene, quality, tick) for quality in FLOWN}
    except SceneError as refusal:
        return found | {"not_predicted": f"a small design of this scene is refused: {refusal}"}
    predicted, steep = predictions(scene, pilots), pilots[FLOWN[-1]].steep
    found |= {"predicted": predicted, "notes": [*too_steep(steep), *_ends_early(scene, predicted)]}
    net = scaled(scene.lens.back.net, 2)
    if max(both(net)) <= LARGEST_NET:
        finer = of_net(scene, net)
        found["finer"] = {"control_points": net, "predicted": predictions(finer, pilots, gain(scene, finer, lenses))}
    return found


def _ends_early(scene: Scene, predicted: Mapping[str, Mapping[str, Interval]]) -> Iterator[str]:
    """Limits of the scene that no prediction reckons with."""
    most, enough = scene.tailoring.max_time, scene.tailoring.accuracy
    if most is not None and (late := [q for q, each in predicted.items() if each["seconds"][1] > most]):
        yield f"tailoring.max_time = {most:g} would end {' and '.join(late)} before that, with more error."
    if enough is not None and (early := [q for q, each in predicted.items() if each["rrmsd"][1] < enough]):
        yield f"tailoring.accuracy = {enough:g} would end {' and '.join(early)} as soon as it is reached, in less time."
