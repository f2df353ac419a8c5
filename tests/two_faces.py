"""A lens with two bent nets, by hand, for two targets: no solver is needed to prove and to report it."""

from __future__ import annotations

from dataclasses import replace

import torch

from bstcad.designs.course import BY_HAND, DesignCourse
from bstcad.designs.designed_lens import DesignedLens
from bstcad.scene.scene import load

DISK = "templates/disk.toml"
CHANGES = {
    "name": "two-faces", "title": "Two faces, two targets", "source": {
        "kind": "collimated", "aperture": {"shape": "circle", "radius": 3.5}, "wavelength": 633.0,
    },
    "lens.outline": {"shape": "rectangle", "width": 8.0, "height": 8.0},
    "lens.front": {"kind": "bspline", "z": 8.0, "optimise": True, "control_points": 33},
    "lens.back": {"kind": "bspline", "z": 14.0, "control_points": 65},
    "lens.tool_radius": 0.5, "lens.max_slope": 60.0,
    "tailoring": {"quality": "draft"}, "accept": {"rrmsd": 3.0},
    "target": [
        {"z": 60.0, "x": [-5.0, 5.0], "y": [-5.0, 5.0], "pixels": 16, "uniform": True,
         "outline": {"shape": "circle", "radius": 4.0}},
        {"z": 150.0, "x": [-8.0, 8.0], "y": [-6.0, 6.0], "pixels": [24, 18], "uniform": True, "weight": 2.5},
    ],
}  # fmt: skip

SMALL = CHANGES | {  # changes of a scene that is tailored in a few seconds
    "lens.tool_radius": None, "lens.max_slope": None, "lens.front.control_points": 17, "lens.back.control_points": 25,
    "tailoring": {"quality": "draft", "rays": 64, "transport_grid": 32, "rounds": 3, "stage2_iterations": 30},
}  # fmt: skip
# Changes of a scene with a picture and a wave.
WITH_WAVE = {"target": CHANGES["target"][:1], "wavefront": {"kind": "plane", "z": 60.0}}


def bent(net, size, along=(2.0, 3.0)):
    """The net with waves of this height (mm), which do not vanish on the axis."""
    sides = zip((net.x, net.y), net.shape, strict=True)
    x, y = (torch.linspace(*ends, count, dtype=torch.float64) for ends, count in sides)
    waves = torch.cos(x / along[0])[:, None] * torch.cos(y / along[1])
    return replace(net, heights=size * waves)


def scene_of(**changes):
    """The scene of both targets."""
    return load(DISK).changed(CHANGES | changes)


def made_of(scene, front=0.06, back=-0.08):
    """The lens by hand; front, back: height of the waves of each face (mm)."""
    flat = scene.flat_lens(scene.lens.back.net)
    lens = flat.with_front(bent(flat.front, front)).with_back(bent(flat.back, back, (3.0, 2.0)))
    return DesignedLens(scene, scene.as_mounted(lens), scene.goals, DesignCourse(stopped=BY_HAND))
