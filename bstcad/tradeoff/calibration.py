"""The calibration kernel: merit and gradient of 1024 x 1024 ray tubes through a fixed small lens.

Seconds of two machines compare when each is divided by what this takes there, with one version of bstcad.
"""

from __future__ import annotations

import math
import time

import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.collimated import Collimated
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.surfaces import Plane
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.stage2 import Problem

TUBES = 1024  # a side
NET, WIDTH, THICKNESS, INDEX = 257, 20.0, 5.0, 1.49  # control points a side; mm
SCREEN, PIXELS = 200.0, 512  # mm from the front; a side
WAVE, PERIODS = 0.003, 3  # mm; over the width
REPEATS = 3


class Kernel:
    """The kernel, set up once a process."""

    def __init__(self, tubes: int = TUBES) -> None:
        u = torch.linspace(-math.pi * PERIODS, math.pi * PERIODS, NET, dtype=torch.float64)
        heights = WAVE * u.cos()[:, None] * u.cos()
        outline = Rectangle(WIDTH, WIDTH)
        half = WIDTH / 2
        back = BSplineSurface(THICKNESS, heights, (-half, half), (-half, half))
        self._lens = Lens(Plane(0.0), back, outline, INDEX)
        screen = Screen(SCREEN, (-half, half), (-half, half), PIXELS)
        target = torch.full((PIXELS, PIXELS), 1.0, dtype=torch.float64)
        channel = Channel(Collimated(outline), INDEX)
        self._problem = Problem(self._lens, TubeMerit.of((channel,), self._lens, tubes, screen, target, 0.03))
        self._once()  # what is compiled, or allocated, the first time does not count

    def seconds(self) -> float:
        """What one evaluation takes now: the least of a few, since all that disturbs it makes it longer."""
        return min(self._once() for _ in range(REPEATS))

    def _once(self) -> float:
        began = time.perf_counter()
        self._problem(self._lens.back.heights)
        return time.perf_counter() - began
