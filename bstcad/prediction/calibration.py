"""What this machine takes for two fixed pieces of work, in which seconds are expressed.

One is the merit and gradient of 1024 x 1024 ray tubes through a fixed small lens, on all processors, as most of a
design is; the other is text and transforms on one processor, as the rest is.  Seconds of two machines compare when
each is divided by what these take there, with one version of bstcad.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.channels import Channel
from bstcad.optics.irradiance import Screen
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Rectangle
from bstcad.optics.sources import Collimated
from bstcad.optics.surfaces import Plane
from bstcad.tailoring.merit import TubeMerit
from bstcad.tailoring.stage2 import Problem

TUBES = 1024  # a side
NET, WIDTH, THICKNESS, INDEX = 257, 20.0, 5.0, 1.49  # control points a side; mm
SCREEN, PIXELS = 200.0, 512  # mm from the front; a side
WAVE, PERIODS = 0.003, 3  # mm; over the width
REPEATS = 3  # of a piece of work, at least
LONG, PER_TURN = 2.5, 4  # seconds of a calibration; works of one processor beside each evaluation, which takes longer
NUMBERS, CELLS = 40_000, 512  # of the work of one processor: numbers written and read; a side of what is transformed


@dataclass(frozen=True)
class Units:
    """Seconds that either piece of work takes."""

    tubes: float  # an evaluation, on all processors
    serial: float  # text and transforms, on one

    def times(self, factor: float) -> Units:
        """Of a machine that takes so many times as long."""
        return Units(factor * self.tubes, factor * self.serial)


def units() -> Units:
    """What this machine takes now, found in three seconds or so.

    A design takes longer than that, and processors that others use too change their pace by two within seconds.  What
    counts is their mean pace, so that both pieces of work are done in turn and over again, and averaged without the
    tenth that took least and most.
    """
    from scipy.stats import trim_mean  # a third of a second to load, which a design need not pay

    kernel, tubes, serial = Kernel(), [], []
    began = time.perf_counter()
    while time.perf_counter() - began < LONG or len(tubes) < REPEATS:
        tubes.append(_seconds(kernel.once))
        serial.extend(_seconds(serial_work) for _ in range(PER_TURN))
    return Units(*(float(trim_mean(found, 0.1)) for found in (tubes, serial)))


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def least(work: Callable[[], object]) -> float:
    """Seconds of a piece of work: the least of a few, since all that disturbs it makes it longer."""
    return min(_seconds(work) for _ in range(REPEATS))


def serial_work() -> float:
    """Numbers to text and back, as in a STEP file, and a cosine transform, as in a fit of slopes."""
    from scipy.fft import dctn

    written = ",".join(f"{k / 7:.12g}" for k in range(NUMBERS))
    read = np.array([float(word) for word in written.split(",")])
    return float(dctn(np.resize(read, (CELLS, CELLS)), workers=1)[0, 0])


class Kernel:
    """The evaluation, set up once a process."""

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
        self.once()  # what is compiled, or allocated, the first time does not count

    def seconds(self) -> float:
        """What one evaluation takes now."""
        return least(self.once)

    def once(self) -> None:
        """The evaluation."""
        self._problem([self._lens.back.heights])
