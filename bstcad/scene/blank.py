"""The lens before tailoring: its outline, its front, its back, and the bounds that the back keeps to."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import torch
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from bstcad.optics.key import Key
from bstcad.optics.outlines import STRICT, Circle, Outline
from bstcad.optics.surfaces import Conic, Plane, Sphere, Surface
from bstcad.scene.fields import COORDINATES, LENGTHS, Outlined, Record, from_file
from bstcad.scene.given_net import NAME, UNIFORM, GivenNet, read_net

if TYPE_CHECKING:
    from bstcad.optics.bspline import BSplineSurface


# (1 + k) c² r² of a conic at the rim: at most, where a sphere that stands upright has 1, and at least (nearly a cone).
UPRIGHT, CONE = 0.85, -7.0
CONIC_CONSTANTS = (-1e3, 1e3)
INDICES = (1.01, 5.0)  # of refraction
BOUNDS = ("tool_radius", "max_slope", "max_thickness", "edge_thickness")  # the keys of LensBlank that bound the back

Z = Key("Where it crosses the axis, its vertex.", "mm", *COORDINATES, example=8.0)
CURVATURE = Key("Curvature at the vertex; positive bends towards +z.", "1/mm", -1e3, 1e3)
OPTIMISE = Key("Parameters that tailoring finds: true for all of them, or a list of names.")


def _some(*names: str) -> Any:
    """The type of `optimise`: false, true for all of these parameters, or a list of them."""
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

    z: Annotated[float, Z]
    kind: Annotated[Literal["plane"], Key("A plane across the axis.")] = "plane"

    __pydantic_config__ = STRICT

    @property
    def surface(self) -> Plane:
        """The surface as the physics has it."""
        return Plane(self.z)


@dataclass(frozen=True)
class SphereFront(_Front):
    """A sphere; of curvature 0 it is a plane."""

    z: Annotated[float, Z]
    curvature: Annotated[float, CURVATURE] = 0.0
    optimise: Annotated[_some("curvature"), OPTIMISE] = False
    kind: Annotated[Literal["sphere"], Key("A sphere.")] = "sphere"

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

    z: Annotated[float, Z]
    curvature: Annotated[float, CURVATURE] = 0.0
    conic_constant: Annotated[float, Key("0 is a sphere, -1 a paraboloid.", "", *CONIC_CONSTANTS)] = 0.0
    optimise: Annotated[_some("curvature", "conic_constant"), OPTIMISE] = False
    kind: Annotated[Literal["conic"], Key("A conic turned about the axis.")] = "conic"

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
        if bend > UPRIGHT:
            yield (
                f"curvature: {what} ends inside the lens or stands nearly upright at its rim, {rim:g} mm from the "
                "axis; make the curvature smaller"
            )
        if bend < CONE:
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


NetFile = from_file(GivenNet, read_net, lambda net: NAME, "file = 'outputs/earlier'")


@dataclass(frozen=True)
class GivenFront(_Front):
    """The freeform back of an earlier design, moved along z."""

    z: Annotated[float, Z]
    file: Annotated[NetFile, Key("Folder of a design, its design.npz or its lens.step.", example="outputs/earlier")]
    kind: Annotated[Literal["bspline"], Key("The freeform back of an earlier design.")] = "bspline"

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


class Back(Record):
    """The freeform face before tailoring: a flat B-spline net at z."""

    kind: Annotated[Literal["bspline"], Key("The freeform face that bstcad finds.")] = "bspline"
    z: Annotated[float, Key("Place of the flat face before tailoring.", "mm", *COORDINATES, example=20.0)]
    control_points: Annotated[int, Key("Control points of the net along each side.", "", 5, 2049, example=257)]
    reflect: Annotated[bool, Key("A mirror: light comes along -z and goes back along +z.")] = False


@dataclass(frozen=True)
class Bounds:
    """Bounds on a back everywhere inside the outline; None: unbounded."""

    concave: float | None = None  # largest curvature of a valley towards +z (1/mm)
    convex: float | None = None  # of a ridge (1/mm)
    slope: float | None = None  # steepest |∇z|
    thinnest: float = 0.0  # mm; between front and back, along the axis
    thickest: float | None = None  # mm
    edge: float | None = None  # mm; least thickness along the rim


class LensBlank(Record):
    """The lens before tailoring: light enters through the front and leaves through the back.

    A mirror is a plate whose back, its upper face, reflects; its front is the rear of the plate.
    """

    material: Annotated[str | None, Key("Name on refractiveindex.info; or give the index.")] = None
    index: Annotated[float | None, Key("Refractive index at one wavelength.", "", *INDICES, example=1.49)] = None
    outline: Annotated[Outlined, Key("Rim of the lens.", example={"shape": "rectangle", "width": 24.0, "height": 24.0})]
    front: Annotated[Front, Key("The face that light enters.", example={"kind": "plane", "z": 8.0})]
    back: Annotated[
        Back, Key("The face that is tailored.", example={"kind": "bspline", "z": 20.0, "control_points": 257})
    ]
    tool_radius: Annotated[
        float | None, Key("Least radius of the back's valleys, where a tool fits in.", "mm", 1e-6, 1e9)
    ] = None
    mould: Annotated[bool, Key("The tool cuts a mould: tool_radius bounds the ridges.")] = False
    max_slope: Annotated[float | None, Key("Steepest angle of the back against z = const.", "degrees", 1e-3, 89.0)] = (
        None
    )
    min_thickness: Annotated[float, Key("Least thickness along z; the back is moved to keep it.", "mm", *LENGTHS)] = 0.5
    max_thickness: Annotated[float | None, Key("Greatest thickness along z.", "mm", *LENGTHS)] = None
    edge_thickness: Annotated[float | None, Key("Least thickness along the rim.", "mm", *LENGTHS)] = None

    @model_validator(mode="after")
    def _one_medium(self) -> Self:
        given = [name for name in ("material", "index") if getattr(self, name) is not None]
        if self.back.reflect and given:
            raise ValueError(f"light does not enter a mirror (back.reflect), so it has no {given[0]}; remove it")
        if not self.back.reflect and len(given) != 1:
            raise ValueError('needs exactly one of material and index; give for example material = "PMMA"')
        return self

    @property
    def optic(self) -> str:
        """ "lens" or "mirror"."""
        return "mirror" if self.back.reflect else "lens"

    @property
    def bounded_by(self) -> tuple[str, ...]:
        """The keys that bound the back."""
        return tuple(key for key in BOUNDS if getattr(self, key) is not None)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the back keeps to while it is tailored; None: there are none."""
        if not self.bounded_by:
            return None
        curvature = None if self.tool_radius is None else 1 / self.tool_radius
        return Bounds(
            concave=None if self.mould else curvature,
            convex=curvature if self.mould else None,
            slope=None if self.max_slope is None else math.tan(math.radians(self.max_slope)),
            thinnest=self.min_thickness,
            thickest=self.max_thickness,
            edge=self.edge_thickness,
        )

    @property
    def front_sags(self) -> tuple[float, float]:
        """Lowest and highest sag of the front inside the outline (mm), and zero."""
        return self.front.surface.sags(self.outline)

    def room(self) -> Iterator[str]:
        """Complaints about a front that is no surface of this lens, and about a blank that is too thin."""
        yield from (f"lens.front.{complaint}" for complaint in self.front.complaints(self.outline))
        highest = "rim" if self.front.surface.curvature is not None else "thinnest place"
        least = self.min_thickness
        for where, front in (("centre", self.front.z), (highest, self.front.z + self.front_sags[1])):
            if not self.back.z - front >= least:
                yield (
                    f"lens.back.z: the lens is {self.back.z - front:g} mm thick at its {where}, and lens.min_thickness "
                    f"asks for {least:g} mm; move the back to z = {front + least:g} or further"
                )

    def complaints(self) -> Iterator[str]:
        """Complaints about bounds that contradict each other, or that not even a flat back meets."""
        if self.mould and self.tool_radius is None:
            yield (
                "lens.mould: says whose valleys lens.tool_radius is for, and there is none; add it in mm, or remove "
                "mould"
            )
        most = self.max_thickness
        if most is None:
            return
        for key in ("min_thickness", "edge_thickness"):
            least = getattr(self, key)
            if least is not None and not least <= most:
                yield (
                    f"lens.max_thickness: {most:g} mm, and lens.{key} asks for {least:g} mm; allow more, or ask for "
                    "less"
                )
        falls, rises = self.front_sags
        if not most - self.min_thickness >= rises - falls:
            yield (
                f"lens.max_thickness: {most:g} mm, and {self.min_thickness:g} mm at its thinnest place under a flat "
                f"back the lens is {self.min_thickness + rises - falls:.6g} mm thick at its thickest, since its front "
                "is curved; allow more"
            )
