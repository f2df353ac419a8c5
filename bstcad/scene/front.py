"""The front of the lens as a scene has it: a surface, and what of its shape tailoring is to find."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Discriminator, Field, Tag

from bstcad.optics.outlines import STRICT
from bstcad.optics.surfaces import Conic, Plane, Sphere, Surface


def _some(*names: str) -> Any:
    """What tailoring may change: nothing (false), all of these (true) or a list of some."""
    listed = Annotated[tuple[Literal[names], ...], Tag("list")]
    told = Discriminator(lambda given: "list" if isinstance(given, list | tuple) else "flag")
    return Annotated[Annotated[bool, Tag("flag")] | listed, told]


class _Front:
    @property
    def free(self) -> tuple[str, ...]:
        """The parameters of the surface that tailoring is to find, by name."""
        asked, names = getattr(self, "optimise", False), tuple(self.surface.parameters())
        return names if asked is True else tuple(name for name in names if asked and name in asked)

    def found(self, surface: Surface) -> Self:
        """The same front with the parameters of this surface, and nothing left to find."""
        return replace(self, **surface.plain().parameters(), optimise=False) if self.free else self


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


def _as_record(front: Any) -> Any:
    """A surface of the physics may stand for the front that it is."""
    return vars(front) if type(front) in (Plane, Sphere, Conic) else front


Front = Annotated[
    Annotated[PlaneFront | SphereFront | ConicFront, Field(discriminator="kind")], BeforeValidator(_as_record)
]
