"""The front of the lens as a scene has it: a surface, and what of its shape tailoring is to find."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import torch
from pydantic import BeforeValidator, Discriminator, Field, PlainSerializer, Tag, ValidationInfo

from bstcad.optics.outlines import STRICT, Circle, Outline
from bstcad.optics.surfaces import Conic, Plane, Sphere, Surface
from bstcad.scene.given_net import NAME, UNIFORM, GivenNet, read_net

if TYPE_CHECKING:  # which loads numba
    from bstcad.optics.bspline import BSplineSurface

STEEPEST = 0.85  # (1 + k) c² r² of a conic at the rim, and least; a sphere that stands upright has 1
SHARPEST = -7.0


def _some(*names: str) -> Any:
    """What tailoring may change: nothing (false), all of these (true) or a list of some."""
    listed = Annotated[tuple[Literal[names], ...], BeforeValidator(tuple), Tag("list")]
    told = Discriminator(lambda given: "list" if isinstance(given, list | tuple) else "flag")
    return Annotated[Annotated[bool, Tag("flag")] | listed, told]


class _Front:
    @property
    def free(self) -> tuple[str, ...]:
        """The parameters of the surface that tailoring is to find, by name."""
        asked, names = getattr(self, "optimise", False), tuple(self.surface.parameters())
        return names if asked is True else tuple(name for name in names if asked and name in asked)

    @property
    def given(self) -> GivenNet | None:
        """The net of a front that is given by one."""
        return getattr(self, "file", None)

    def found(self, surface: Surface) -> Self:
        """The same front with the parameters of this surface, and nothing left to find."""
        return replace(self, **surface.plain().parameters(), optimise=False) if self.free else self

    def complaints(self, outline: Outline) -> Iterator[str]:
        """What keeps it from being the front of a lens of this outline, each as "key: sentence"."""
        return iter(())


@dataclass(frozen=True)
class PlaneFront(_Front):
    """z = const."""

    z: float  # mm
    kind: Literal["plane"] = "plane"

    __pydantic_config__ = STRICT

    @property
    def surface(self) -> Plane:
        """The surface as the physics has it."""
        return Plane(self.z)


@dataclass(frozen=True)
class SphereFront(_Front):
    """A sphere; of curvature 0 it is a plane."""

    z: float  # vertex (mm)
    curvature: float = 0.0  # 1/mm; positive bends towards +z
    optimise: _some("curvature") = False
    kind: Literal["sphere"] = "sphere"

    __pydantic_config__ = STRICT

    @property
    def surface(self) -> Sphere:
        """The surface as the physics has it."""
        return Sphere(self.z, self.curvature)

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It ends inside the lens."""
        if not bool(self.surface.reaches(*(torch.tensor(p, dtype=torch.float64) for p in outline.farthest))):
            yield (
                f"curvature: a sphere of radius {1 / abs(self.curvature):g} mm ends inside the lens, "
                f"whose rim is {_rim(outline):g} mm from the axis; make the curvature smaller"
            )


@dataclass(frozen=True)
class ConicFront(_Front):
    """A conic that is turned about the axis."""

    z: float  # vertex (mm)
    curvature: float = 0.0  # at the vertex (1/mm); positive bends towards +z
    conic_constant: float = 0.0  # 0: a sphere, -1: a paraboloid
    optimise: _some("curvature", "conic_constant") = False
    kind: Literal["conic"] = "conic"

    __pydantic_config__ = STRICT

    @property
    def surface(self) -> Conic:
        """The surface as the physics has it."""
        return Conic(self.z, self.curvature, self.conic_constant)

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It ends in the lens or nearly, is nearly a cone, or its shape does not depend on what is free of it."""
        rim = _rim(outline)
        bend = (1 + self.conic_constant) * (self.curvature * rim) ** 2
        what = f"a conic of constant {self.conic_constant:g} and radius {1 / (self.curvature or 1):g} mm"
        if bend > STEEPEST:
            yield (
                f"curvature: {what} ends inside the lens or stands nearly upright at its rim, {rim:g} mm from the "
                "axis; make the curvature smaller"
            )
        if bend < SHARPEST:
            yield (
                f"conic_constant: {what} is nearly a cone at the rim, {rim:g} mm from the axis; "
                "give a constant nearer to -1 or make the curvature smaller"
            )
        if self.free == ("conic_constant",) and self.curvature == 0:
            yield (
                "optimise: a front of curvature 0 has the same shape whatever its conic constant is; "
                "give a curvature, or let both be found by optimise = true"
            )


def _rim(outline: Outline) -> float:
    return sum(p * p for p in outline.farthest) ** 0.5


def _net(given: Any, info: ValidationInfo) -> Any:
    """A path becomes the net it leads to; relative to the scene file if there is one."""
    if isinstance(given, GivenNet):
        return given
    if not isinstance(given, str | Path):
        raise ValueError(f"{given!r} is no file name; write for example file = 'outputs/earlier'")
    context = info.context or {}
    if given in (known := context.get("pictures", {})):
        return known[given]
    path = Path(context.get("folder", "."), given)
    return read_net(path if os.path.lexists(path) else Path(os.path.expanduser(given)))


NetField = Annotated[GivenNet, BeforeValidator(_net), PlainSerializer(lambda net: NAME, return_type=str)]


@dataclass(frozen=True)
class GivenFront(_Front):
    """The freeform back of an earlier design, moved along z."""

    z: float  # where it crosses the axis (mm)
    file: NetField  # a design's folder, its design.npz or lens.step
    kind: Literal["bspline"] = "bspline"

    __pydantic_config__ = STRICT

    @property
    def surface(self) -> BSplineSurface:
        """The surface as the physics has it."""
        return self.file.surface(self.z)

    @property
    def free(self) -> tuple[str, ...]:
        """Nothing: it is as it is given."""
        return ()

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It is that of a lens of another outline."""
        m = self.file.m
        reach = (m - 1) / (m - 5) if isinstance(outline, Circle) and m > 5 else 1.0  # two spans past a round rim
        for name, ends, half in zip("xy", (self.file.x, self.file.y), outline.half_extent, strict=True):
            if max(abs(ends[0] + reach * half), abs(ends[1] - reach * half)) > UNIFORM:
                yield (
                    f"file: its net covers {name} = {ends[0]:g} to {ends[1]:g} mm, and that of a lens of this outline "
                    f"{-reach * half:g} to {reach * half:g} mm; give a design of the same outline"
                )
                return


def as_front(value: Any) -> Any:
    """The front of a scene that a surface of the physics is; what is none stays as it is."""
    if not hasattr(value, "relative_sag_and_slope"):
        return value
    if value.kind == "bspline":
        return GivenFront(value.z + value.moved(0.0).from_vertex().z, GivenNet.of(value))
    return {"plane": PlaneFront, "sphere": SphereFront, "conic": ConicFront}[value.kind](
        value.z, *value.parameters().values()
    )


Front = Annotated[
    Annotated[PlaneFront | SphereFront | ConicFront | GivenFront, Field(discriminator="kind")],
    BeforeValidator(as_front),
]
