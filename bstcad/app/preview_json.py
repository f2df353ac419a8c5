"""A preview, a plan and a finished design as the page gets them: pictures, figures in words, and the solid to turn."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from bstcad.app.preview import Preview
from bstcad.report.figure_jobs import light_path_of
from bstcad.report.light_figures import View
from bstcad.report.record import LEFT_OUT, LeftOut, changes
from bstcad.report.rendering import data_url, turnable
from bstcad.report.units import Rows, duration, number, quantity, tables
from bstcad.sweep.prediction import Interval

CELLS = 96  # of the lens to be turned, a side
# Largest difference of a finished lens's thicknesses and relief from the preview's, as a part of the relief, among ten
# templates: of a back that is lit up to its rim (0.007), and of one dark in places (0.43), where it bends on.
SPREAD, DARK_SPREAD = 0.03, 0.45
LIT = 0.99  # share of the back that light passes, from which on it counts as lit up to its rim


def of_preview(found: Preview) -> dict[str, Any]:
    """The pictures on each target, the lens with its light, and figures."""
    path = light_path_of(found.scene, found.lens, found.pictures)
    seen = [(*pair, image) for pair, image in zip(found.pictures, found.source_images, strict=True)]
    views = [View.of(found.scene, k) for k in range(len(found.pictures))]
    targets = [
        {
            "key": key, "rrmsd": number(value), "wanted": data_url(view.picture(view.tones(wanted, wanted))),
            "light": data_url(view.picture(view.tones(light, wanted))), "seen": view.words,
            "pixels": list(light.shape[::-1]), "source_image": image and quantity(image.width, image.unit),
        }
        for key, view, value, (wanted, light, image) in zip(
            found.scene.target_keys, views, found.rrmsds, seen, strict=True
        )
    ]  # fmt: skip
    return {
        "seconds": round(found.seconds, 3), "targets": targets, "figures": figures(found),
        "remarks": list(found.remarks), "solid": json.loads(turnable(found.lens, path, cells=CELLS) or "null"),
    }  # fmt: skip


def figures(found: Preview) -> Rows:
    """(name, value) of the light and the shape of a lens."""
    apart, optic = SPREAD if found.lit >= LIT else DARK_SPREAD, found.scene.optic
    shown = tables("preview_figures.txt.j2", flux=found.flux, shape=found.shape, optic=optic, apart=apart)
    return shown["figures"]


def of_plan(plan: Mapping[str, Any]) -> dict[str, Any]:
    """The effects that are left out, a row each."""
    rows = [
        [" ".join(filter(None, (LEFT_OUT[entry.kind], entry.detail and f"({entry.detail})"))), *changes(entry), of]
        for goal in plan["goals"]
        for of in [goal["key"] if len(plan["goals"]) > 1 else ""]
        for entry in (LeftOut(**item) for item in goal["left_out"])
    ]
    simulated = [item["what"] for item in plan["simulated"]]
    return {"simulated": simulated, "left_out": rows, "net": plan["net"], "verdict": plan.get("verdict")}


def of_predictions(plan: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds and RRMSD of each quality as predicted, or why they are not."""
    if plan["predicted"] is None:
        none = {"not_predicted": plan["not_predicted"], "notes": [], "qualities": {}}
        return none | {"verdict": plan["verdict"] if plan["verdict"]["kind"] == "blurred" else None}
    known = {quality: told(each["seconds"], each["rrmsd"]) for quality, each in plan["predicted"].items()}
    return {"not_predicted": None, "notes": plan["notes"], "qualities": known, "verdict": plan["verdict"]}


def told(seconds: Interval, rrmsd: Interval) -> dict[str, str]:
    """Return a quality in words, with the ranges that nine of ten designs keep to."""
    (least, likely, most), (low, error, high) = seconds, rrmsd
    span = f"{duration(least)} to {duration(most)}; RRMSD {number(low)} to {number(high)}"
    return {"seconds": duration(likely), "rrmsd": number(error), "range": f"nine of ten designs: {span}"}
