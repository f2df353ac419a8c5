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
from bstcad.optics.sides import as_pair, scaled
from bstcad.pipeline import reachable_part
from bstcad.report.record import simulated, too_steep
from bstcad.report.units import paragraphs
from bstcad.scene.blank import MAX_CONTROL_POINTS
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.scene import Scene
from bstcad.sweep.cold_run import rounded
from bstcad.sweep.estimates import coarse_lens, left_out
from bstcad.sweep.net_choice import gain
from bstcad.sweep.prediction import FLOWN, QUALITIES, UNDONE, Interval, fly, of_net, predictions
from bstcad.verify.checks import DEFAULT_RRMSD_LIMIT

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
    at, scenes = toml_positions(text), scene.single_target_scenes()
    asked = [{"what": what, "key": key, **_asked(key, at, keys)} for what, key in simulated(scene)]
    lenses = [coarse_lens(alone) for alone in scenes]
    goals = list(map(_effects, scenes, lenses, scene.target_keys))
    blurred = worst((goal["blur"] or {}).get("rrmsd", 0.0) for goal in goals)
    found = {"simulated": asked, **goals[blurred], "goals": goals}
    del found["key"]
    if len(goals) > 1 or scene.lens.front.is_tailored:
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
    wide = max(high - low for low, high in (target.x, target.y))
    likely: Any = found.get("not_predicted")
    if UNDONE * blurred > allowed:
        kind = "blurred"
    elif "predicted" not in found:
        return None
    elif found["predicted"] is None:
        kind = "not predicted"
    else:
        quality = scene.tailoring.quality if scene.tailoring.quality in QUALITIES else "standard"
        (low, _, high), (_, seconds, _) = (found["predicted"][quality][key] for key in ("rrmsd", "seconds"))
        likely = {"quality": quality, "seconds": seconds, "rrmsd": found["predicted"][quality]["rrmsd"]}
        kind = "no limit" if asked is None else "within" if high <= asked else "beyond" if low > asked else "open"
    image = {"rrmsd": blurred, "least": UNDONE * blurred, "width": width, "target": wide}
    [sentence] = paragraphs(
        "plan.txt.j2", "verdict", kind=kind, image=image | {"unit": target.unit, "optic": scene.optic}, asked=asked,
        likely=likely,
    )  # fmt: skip
    return {"kind": kind, "sentence": sentence}


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

    if scene.lens.front.is_tailored:
        raise SceneError(
            "--png: draws what light can reach by way of a tailored back, and here the front is tailored; leave it "
            "out: `bstcad generate` says first what such a lens cannot do"
        )
    found = []
    for alone in scene.single_target_scenes():
        [goal] = alone.goals
        part, _ = reachable_part(alone, goal)
        lit = np.ones(goal.picture.shape, dtype=bool) if part is None else part
        found.append(png(reach_picture(goal.picture, lit, View.of(alone))))
    return tuple(found)


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
    if max(as_pair(net)) <= MAX_CONTROL_POINTS:
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
