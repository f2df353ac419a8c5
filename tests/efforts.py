"""Efforts of tailoring for small designs, whose laws do not depend on the numbers of rays."""

from __future__ import annotations

from dataclasses import replace

from bstcad.designs import pipeline
from bstcad.designs.designed_lens import DesignedLens
from bstcad.optics.trace.measure import Effort
from bstcad.scene.scene import Scene
from bstcad.tailoring.effort import FULL, TailoringEffort
from bstcad.tailoring.source_image import ErrorRays

LITTLE = TailoringEffort(  # effort of tailoring that resolves designs of some 20 control points and pixels per side
    stage=Effort(96, accuracy=0, witness=False),
    stage_pixels=48,
    fine=Effort(48, accuracy=0.0, witness=False),
    flux=Effort(32, accuracy=1.0, witness=False),
    wavefront_tubes=48,
    coarsest_grid=16,
    trial_cells=24,
    trial_pixels=32,
    trial_iterations=20,
    blur=ErrorRays(32, points=4),
    compared_tubes=16,
    compared_evaluations=2,
)
FEWEST_RAYS = Effort(256, places=65, points=1024, tubes=97)  # verifies the small design: an RRMSD to a few percent
FEW_RAYS = replace(FULL, fine=Effort(128, accuracy=0.0, witness=False))  # rates lenses within bounds by few rays


def designed_quickly(scene: Scene, effort: TailoringEffort = LITTLE) -> DesignedLens:
    """Return the design of a scene by little effort, on the CPU and without a comparison of precisions."""
    return pipeline.design(scene, device="cpu", options=pipeline.DesignOptions(compare_later=True, effort=effort))
