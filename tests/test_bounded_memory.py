"""Angles and sizes at which the image of a source has no end: a plan keeps within its memory, or is refused."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from bstcad.optics.trace.source_images import ImageSamples
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.tailoring.source_image import IMAGE_NODES, MAX_TRANSFORM_BYTES, VALUE_BYTES, widest
from tests import suite

LAMP = {"kind": "point", "position": [0.0, 0.0, 0.0], "profile": "lambertian", "half_angle": 40.0}
SQUARE = {"shape": "rectangle", "width": 20.0, "height": 20.0}
LIGHTS = {
    "point": LAMP,
    "led": LAMP | {"diameter": 1.0},
    "chip": LAMP | {"width": 1.0, "height": 2.0},
    "sun": {"kind": "collimated", "aperture": SQUARE, "divergence": 0.53},
}
ENDS = [-100.0, 100.0]
SCENE = {
    "name": "tilted",
    "lens": {
        "material": "PMMA",
        "outline": SQUARE,
        "front": {"kind": "plane", "z": 15.0},
        "back": {"kind": "bspline", "z": 20.0, "control_points": 33},
    },
    "target": {"z": 1000.0, "x": ENDS, "y": ENDS, "pixels": 48, "uniform": True},
    "tailoring": {"quality": "draft", "transport_grid": 32},
}
CASES = [
    *((light, {"target.tilt": [angle, 0.0]}) for light, angle in (("led", 85.0), ("led", 89.0), ("chip", 88.0))),
    ("sun", {"target.x": [-0.01, 0.01], "target.y": [-0.01, 0.01]}),
    ("led", {"target.z": 1e6, "target.x": [-1.0, 1.0], "target.y": [-1.0, 1.0]}),
    ("point", {"lens.outline": {"shape": "rectangle", "width": 2000.0, "height": 20.0}}),
]
MOST = 1 << 30  # bytes beyond the libraries; an image without an end took 21 GB
PLANS = """
import json, resource, sys
from pathlib import Path
import bstcad.planning.preview
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.planning.plan import plan
held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
for source, scene, changes in json.load(sys.stdin):
    try:
        scene = Scene.model_validate(scene | {"source": source}).changed(changes)
        scene.warnings()
        resource.setrlimit(resource.RLIMIT_AS, (held + int(sys.argv[1]), -1))
        print(json.dumps(next(plan(scene))["blur"]))
    except SceneError as refusal:
        print(json.dumps(str(refusal)))
"""


@pytest.mark.parametrize("part", suite.in_turns(range(2), 2))
def test_a_plan_keeps_within_its_memory_or_is_refused(part):
    cases = CASES[part::2]
    given = json.dumps([(LIGHTS[light], SCENE, changes) for light, changes in cases])
    run = subprocess.run(
        [sys.executable, "-c", PLANS, str(MOST)], input=given, capture_output=True, text=True, timeout=300, check=True
    )
    found = [json.loads(line) for line in run.stdout.splitlines()]
    assert len(found) == len(cases)
    assert all(key in said for said in found if isinstance(said, str) for key in [": ", "; "])  # what, and what to do


def test_a_wall_beside_the_lamp_names_the_way_that_works():
    scene = Scene.model_validate(SCENE | {"source": LIGHTS["led"]})
    with pytest.raises(SceneError, match=r"90 degrees is not between .* turn the lamp .* target\.z .* target\.tilt"):
        scene.changed({"target.tilt": [90.0, 0.0]})
    assert any("5 degrees from edge-on" in said for said in scene.changed({"target.tilt": [85.0, 0.0]}).warnings())
    assert scene.changed({"target.tilt": [60.0, 0.0]}).warnings() == scene.warnings()
    beam = scene.changed({"source": LIGHTS["sun"], "target.tilt": [85.0, 0.0]})  # its light meets such a plane evenly
    assert not any("edge-on" in said for said in beam.warnings())


def test_light_that_lands_far_away_takes_no_room():
    target = np.random.default_rng(1).random((20, 30))
    offset = torch.tensor([[0.0, 3.0, -4.0], [1.0, -2.0, 2.0]], dtype=torch.float64)[..., None]
    near = ImageSamples(offset, torch.ones((3, 1), dtype=torch.float64))
    far = ImageSamples(torch.cat([offset, torch.full((2, 1, 1), 1e9)], 1), torch.ones((4, 1), dtype=torch.float64))
    assert far.mean((30, 20)).shape == (41, 61)
    assert far.deviation(target) == pytest.approx(near.deviation(target), rel=1e-12)


@pytest.mark.parametrize("pixels", [(48, 48), (512, 512), (2048, 1024)])
@pytest.mark.parametrize("lines", [1, 8])
def test_the_transforms_of_all_images_have_a_most(pixels, lines):
    screen = Scene.model_validate(SCENE | {"source": LAMP}).changed({"target.pixels": list(pixels)}).target.screen
    border = widest(screen, lines)
    assert 16 <= border <= max(screen.shape)
    size = lines * IMAGE_NODES**2 * VALUE_BYTES * (max(screen.shape) + 4 * border) ** 2
    assert border == 16 or size <= MAX_TRANSFORM_BYTES
