"""The freeform back of an earlier design, given as the front of another."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.step_text import part21

if TYPE_CHECKING:  # which loads numba
    from bstcad.optics.bspline import BSplineSurface

NAME = "front.npz"  # of the copy beside a design
REMEDY = "give the folder of a design, its design.npz or its lens.step"
UNIFORM = 1e-9  # mm; a net further from uniform in x and y is not one of ours
ROUNDING = 1e-12  # mm; a net whose vertex is so near to zero is measured from there already
LARGEST = 2049  # control points a side


@dataclass(frozen=True)
class GivenNet:
    """A B-spline surface with its vertex at z = 0; the scene keeps it whole, so that a design can be repeated."""

    m: int  # control points a side
    x: tuple[float, float]  # extent (mm)
    y: tuple[float, float]
    data: bytes = field(repr=False)  # heights (m, m) over the vertex (mm), x along the first axis, as float64

    @classmethod
    def of(cls, surface: BSplineSurface) -> GivenNet:
        """The net of a surface, wherever that lies."""
        resting = surface.plain().moved(0.0)
        vertex = resting.from_vertex()
        heights = (vertex if abs(vertex.z) > ROUNDING else resting).heights
        return cls(surface.m, tuple(surface.x), tuple(surface.y), heights.numpy().astype("<f8").tobytes())

    def surface(self, z: float) -> BSplineSurface:
        """The surface with its vertex at z (mm)."""
        from bstcad.optics.bspline import BSplineSurface

        heights = np.frombuffer(self.data, "<f8").reshape(self.m, self.m).astype(np.float64)
        return BSplineSurface(z, torch.from_numpy(heights), self.x, self.y)

    def archive(self) -> bytes:
        """An .npz file that `read_net` reads as this net: control_points (m, m, 3) in mm."""
        file = io.BytesIO()
        np.savez_compressed(file, control_points=self.surface(0.0).control_points())
        return file.getvalue()


def read_net(path: Path) -> GivenNet:
    """The back face of the design at `path`; SceneError if there is none, or it is damaged."""
    from bstcad.optics.bspline import BSplineSurface
    from bstcad.optics.spline_basis import SMALLEST_NET

    said = str(path)
    path = path / "design.npz" if path.is_dir() else path
    if not os.path.lexists(path):
        raise SceneError(f"lens.front.file: {said!r} not found; {REMEDY}, relative to the scene file")
    try:
        net = _of_step(path) if path.suffix.lower() in (".step", ".stp") else files.net(path, LARGEST)
    except Exception as error:  # numpy, zipfile, zlib and tokenize each raise their own for a damaged file
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise SceneError(f"lens.front.file: {said!r} cannot be read ({reason}); {REMEDY}") from None
    m = len(net)
    ends = ((net[0, 0, i], net[-1, -1, i]) for i in (0, 1))
    uniform = np.stack(np.meshgrid(*(np.linspace(*end, m) for end in ends), indexing="ij"), axis=-1)
    if m < SMALLEST_NET or not np.isfinite(net).all() or not np.abs(net[..., :2] - uniform).max() <= UNIFORM:
        raise SceneError(f"lens.front.file: {said!r} holds no net of a design; {REMEDY}")
    return GivenNet.of(BSplineSurface.from_control_points(net, 0.0))


def _of_step(path: Path) -> np.ndarray:
    from bstcad.optics.spline_basis import knots

    text = part21.read(path)
    surface, m = text.surface, len(text.surface.control_points)
    if text.unit != "millimetre" or surface.control_points.shape != (m, m, 3) or surface.rational:
        raise ValueError(f"no plain square net in millimetres, but {surface.control_points.shape[:2]} in {text.unit}")
    if surface.degrees != (2, 2) or not all(np.array_equal(full, knots(m)) for full in surface.full_knots):
        raise ValueError("its freeform face has other knots than bstcad's")
    return surface.control_points
