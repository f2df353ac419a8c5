"""A scene without effects pays for none: what runs is what runs where the module of effects cannot be loaded."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
# A design and its measurement: every call of torch and of a compiled kernel, by name and in order, hashed.
PROBE = """
import hashlib, json, sys
import numba.core.dispatcher, torch
from torch.utils._python_dispatch import TorchDispatchMode

calls = []

class Told(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        calls.append(str(function))
        return function(*arguments, **(keywords or {}))

class Kernel:
    def __init__(self, function):
        self.function = function

    def __call__(self, *arguments):
        calls.append(self.function.__name__)
        return self.function(*arguments)

from bstcad.optics.kernels import clip, crossing, forward, reductions, splat, spline
from bstcad.transport import monge_ampere  # its kernels, too, if it has any

kernels = 0
for module in (clip, crossing, forward, reductions, splat, spline, monge_ampere):
    for name, value in list(vars(module).items()):
        if isinstance(value, numba.core.dispatcher.Dispatcher) and value.targetoptions.get("nogil"):
            setattr(module, name, Kernel(value))
            kernels += 1

import numpy as np
from bstcad import pipeline
from bstcad.optics.measure import Effort, measure
from bstcad.scene import scene as scenes

made = scenes.load("templates/" + sys.argv[1] + ".toml", {
    "tailoring.quality": "draft", "lens.back.control_points": "17", "target.pixels": "24", "tailoring.rays": "32",
    "tailoring.stage2_iterations": "3", "tailoring.rounds": "2", "tailoring.transport_grid": "32",
    "tailoring.transport_iterations": "5",
})

def probed():
    calls.clear()
    with Told():
        found = pipeline.design(made)
        light = measure(found.lens, made.channels(), found.goals[0].receiver, found.goals[0].picture, Effort(32))
    return {
        "calls": len(calls), "kernels": kernels, "kinds": len(set(calls)),
        "hash": hashlib.sha256("\\n".join(calls).encode()).hexdigest(),
        "net": hashlib.sha256(found.lens.back.heights.numpy().tobytes() + light.picture.tobytes()).hexdigest(),
    }

usual, loaded = probed(), "bstcad.optics.losses" in sys.modules
sys.modules["bstcad.optics.losses"] = None  # importing it is an ImportError
absent = probed()
del sys.modules["bstcad.optics.losses"]
import bstcad.optics.losses
print(json.dumps({"usual": usual, "loaded": loaded, "absent": absent, "with": probed()}))
"""


def test_without_effects_every_call_is_that_of_a_build_that_has_none():
    ran = subprocess.run([sys.executable, "-c", PROBE, "thu"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout.splitlines()[-1])
    usual = found["usual"]
    assert found["loaded"] is False  # nothing has even loaded it
    assert found["absent"] == usual == found["with"]
    assert usual["calls"] > 1000 and usual["kernels"] > 5
