"""JSON of previews and plans for the page: pictures, formatted figures, and the solid that a person can rotate."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from bstcad.figures.figure_jobs import light_path_of
from bstcad.figures.light_figures import View
from bstcad.figures.rendering import data_url, turnable
from bstcad.manufacture.tolerance.as_made import AsMade
from bstcad.manufacture.tolerance.lit_by import LitBy
from bstcad.planning.prediction import Interval
from bstcad.planning.preview import Preview
from bstcad.report.record import LEFT_OUT, LeftOut, changes
from bstcad.report.report import lit_sentences, made_sentences
from bstcad.report.units import Rows, duration, number, paragraphs, quantity, tables

SOLID_CELLS = 96  # cells per side of the mesh of the solid on the page
# Error of the preview's thicknesses and relief, as a fraction of the relief.  The largest differences from finished
# lenses among ten templates are 0.007 for a back that is lit up to its rim, and 0.43 for a back with dark areas.
SHAPE_ERROR, DARK_SHAPE_ERROR = 0.03, 0.45
MIN_LIT_FRACTION = 0.99  # smallest lit fraction of the area of a back that counts as lit up to the rim


def of_preview(found: Preview) -> dict[str, Any]:
    """Return the pictures on each target, the lens with its light, and the figures."""
    path = light_path_of(found, [light for _, light in found.pictures])
    seen = [(*pair, image) for pair, image in zip(found.pictures, found.source_images, strict=True)]
    views = [View.of(found.scene, k) for k in range(len(found.pictures))]
    targets = []
    for key, view, value, (wanted, light, image) in zip(
        found.scene.target_keys, views, found.rrmsds, seen, strict=True
    ):
        tones = {"wanted": view.tones(wanted, wanted), "light": view.tones(light, wanted)}
        target = {name: data_url(view.picture(each)) for name, each in tones.items()}
        target |= {"key": key, "rrmsd": number(value), "seen": view.words, "pixels": list(light.shape[::-1])}
        targets.append(target | {"source_image": image and quantity(image.width, image.unit)})
    solid = json.loads(turnable(found.lens, path, cells=SOLID_CELLS) or "null")
    head = {"seconds": round(found.seconds, 3), "targets": targets, "figures": figures(found)}
    return head | {"remarks": list(found.remarks), "solid": solid}


def of_made(found: Preview, made: AsMade | None, lit: LitBy | None) -> dict[str, Any]:
    """Return pairs of pictures on each target, as designed and as changed, and the sentences on them.

    made: the picture as made; lit: the picture in another light; None: not wanted.
    """
    changed: list[tuple[str, Any, np.ndarray]] = []
    sentences: list[str] = []
    if made is not None:
        changed += [(f"as made, {made.words}", goal, goal.made) for goal in made.goals]
        sentences += made_sentences(made.facts(), found.scene.optic)
    if lit is not None:
        changed += [(f"in the light of {lit.words}", goal, goal.lit) for goal in lit.goals]
        sentences += lit_sentences(lit.facts(), found.scene.optic)
    targets = []
    for words, goal, picture in changed:
        view = View.of(found.scene, [each.key for each in found.scene.goals].index(goal.key))
        tones = {"designed": view.tones(goal.designed, goal.target), "made": view.tones(picture, goal.target)}
        pictures = {name: data_url(view.picture(each)) for name, each in tones.items()}
        told = {"key": goal.key, "words": words, "rrmsds": [number(value) for value in goal.rrmsds]}
        targets.append(pictures | told)
    return {"targets": targets, "several": len(found.scene.targets) > 1, "sentences": sentences}


def figures(found: Preview) -> Rows:
    """Return the figures of a lens's light and shape as rows (name, value)."""
    apart, optic = SHAPE_ERROR if found.lit_fraction >= MIN_LIT_FRACTION else DARK_SHAPE_ERROR, found.scene.optic
    light = {"flux": found.flux, "lumens": found.scene.source.luminous_flux}
    shown = tables("preview_figures.txt.j2", **light, shape=found.shape, optic=optic, apart=apart)
    return shown["figures"]


def of_plan(plan: Mapping[str, Any]) -> dict[str, Any]:
    """Return the effects in `plan --json`: simulated ones, rows of those left out, net, verdict and throw."""
    rows = [
        [" ".join(filter(None, (LEFT_OUT[entry.kind], entry.detail and f"({entry.detail})"))), *changes(entry), of]
        for goal in plan["goals"]
        for of in [goal["key"] if len(plan["goals"]) > 1 else ""]
        for entry in (LeftOut(**item) for item in goal["left_out"])
    ]
    simulated = [item["what"] for item in plan["simulated"]]
    sharp = " ".join(sentence for goal in plan["goals"] for sentence in paragraphs("plan.txt.j2", "throw", goal=goal))
    known = {"net": plan["net"], "verdict": plan.get("verdict"), "sharp": sharp}
    return {"simulated": simulated, "left_out": rows, **known}


def of_predictions(plan: Mapping[str, Any]) -> dict[str, Any]:
    """Return the predicted seconds and RRMSD of each quality in `plan --json`, or the reason why there are none."""
    if plan["predicted"] is None:
        none = {"not_predicted": plan["not_predicted"], "notes": [], "qualities": {}}
        return none | {"verdict": plan["verdict"] if plan["verdict"]["kind"] == "blurred" else None}
    keys = "seconds", "rrmsd", "rrmsd_half"
    known = {name: quality_words(*(each[key] for key in keys)) for name, each in plan["predicted"].items()}
    return {"not_predicted": None, "notes": plan["notes"], "qualities": known, "verdict": plan["verdict"]}


def quality_words(seconds: Interval, rrmsd: Interval, half: Interval) -> dict[str, str]:
    """Return the predicted seconds and RRMSD of a quality in words, with their 90 % intervals; half: on half pixels."""
    (least, likely, most), (low, error, high) = seconds, rrmsd
    span = f"{duration(least)} to {duration(most)}; RRMSD {number(low)} to {number(high)}"
    known = {"seconds": duration(likely), "rrmsd": number(error), "half": number(half[1])}
    return known | {"range": f"nine of ten designs: {span}"}
