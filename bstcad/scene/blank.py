"""The lens before tailoring: its outline, its front, its back, and the bounds that the back keeps to."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, Union

import numpy as np
import torch
from pydantic import BeforeValidator, Discriminator, Field, Tag

from bstcad.optics.key import Key
from bstcad.optics.media import refractive_index
from bstcad.optics.outlines import STRICT, Circle, Outline, Rectangle
from bstcad.optics.passes import LENS, MIRROR, SECOND_SURFACE, Face, Passes
from bstcad.optics.sides import Sides, both, coarser, in_proportion, plain
from bstcad.optics.surfaces import Conic, Plane, Recess, Sphere, Surface, Toroid
from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import COORDINATES, LENGTHS, FileContent, OneOrTwo, Record, from_file, leaving_out
from bstcad.step_text import part21
from bstcad.step_text.placement import own_frame

if TYPE_CHECKING:  # which loads numba
    from bstcad.optics.bspline import BSplineSurface

# Largest and least (1 + k) c² r² of a conic at the rim: a sphere that stands upright has 1; below the least, a cone.
UPRIGHT, CONE = 0.85, -7.0
STEEP_NET = 60.0  # degrees; steepest slope at the rim of a surface for which a net stands
STEEPEST = 80.0  # degrees; steepest slope at the rim of a front with an outline of its own, a height over a plane
FLATTEST = 1e-3  # mm; least sag of such a front at its rim, by which its edge is one
LEAST_BESIDE = 1e-2  # mm; least distance between the outline of a front and that of the lens
CONIC_CONSTANTS = (-1e3, 1e3)
INDICES = (1.01, 5.0)  # range of the refractive index
BOUNDS = ("tool_radius", "max_slope", "max_thickness", "edge_thickness")  # the keys of LensBlank that bound the back

NET_FILE = "front.npz"  # the copy of a given net beside a design
NET_REMEDY = "give the folder of a design, its design.npz or its lens.step"
LEVEL = 1e-9  # sine of the angle between a side of a net and an axis of the file; a larger one is a turn
UNIFORM = 1e-9  # mm; a net further from uniform in x and y is not one of ours
ROUNDING = 1e-12  # mm; a net whose vertex is so near to zero is measured from there already
LARGEST_NET = 2049  # control points a side
FITTED = 1e-6  # mm; largest distance of a net from the surface for which it stands: a toroid, or one of one's own
FITS = (33, 65, 129, 257, 513, 1025)  # control points a side of such a net, tried in turn
OBLONG = 1.5  # a cell of the net longer than so many times its width is doubted
FEWEST_ROUND = 6  # control points a side; a net of 5 has no two spans to reach past the rim of a round lens

Outlined = Annotated[Rectangle | Circle, Field(discriminator="shape")]


# ---- fronts ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GivenNet(FileContent):
    """A B-spline surface with its vertex at z = 0; the scene keeps it whole, so that a design can be repeated."""

    name = NET_FILE
    shape: tuple[int, int]  # control points along x and along y
    x: tuple[float, float]  # extent (mm)
    y: tuple[float, float]
    data: bytes = field(repr=False)  # heights (m, n) over the vertex (mm), x along the first axis, as float64

    @classmethod
    def of(cls, surface: BSplineSurface) -> GivenNet:
        """The net of a surface, wherever that lies."""
        resting = surface.plain().moved(0.0)
        vertex = resting.from_vertex()
        heights = (vertex if abs(vertex.z) > ROUNDING else resting).heights
        return cls(surface.shape, tuple(surface.x), tuple(surface.y), heights.numpy().astype("<f8").tobytes())

    def surface(self, z: float) -> BSplineSurface:
        """The surface with its vertex at z (mm)."""
        from bstcad.optics.bspline import BSplineSurface

        heights = np.frombuffer(self.data, "<f8").reshape(self.shape).astype(np.float64)
        return BSplineSurface(z, torch.from_numpy(heights), self.x, self.y)

    @property
    def copy(self) -> bytes:
        """An .npz file that `read_net` reads as this net: control_points (m, n, 3) in mm."""
        file = io.BytesIO()
        np.savez_compressed(file, control_points=self.surface(0.0).control_points())
        return file.getvalue()


def read_net(path: Path) -> GivenNet:
    """The back face of the design at `path`; SceneError if there is none, or it is damaged.

    That of a STEP file lies as the file places it, of which the shift along z is of no matter.
    """
    from bstcad.optics.bspline import SMALLEST_NET, BSplineSurface

    name = repr(str(path))
    path = path / "design.npz" if path.is_dir() else path
    if not os.path.lexists(path):
        raise SceneError(f"lens.front.file: {name} not found; {NET_REMEDY}, relative to the scene file")
    try:
        net = _net_of_step(path) if path.suffix.lower() in (".step", ".stp") else files.net(path, LARGEST_NET)
    except Exception as error:  # numpy, zipfile, zlib and tokenize each raise their own for a damaged file
        raise SceneError(f"lens.front.file: {name} cannot be read ({files.first_line(error)}); {NET_REMEDY}") from None
    shape = net.shape[:2]
    axes = (np.linspace(net[0, 0, i], net[-1, -1, i], count) for i, count in enumerate(shape))
    uniform = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    if min(shape) < SMALLEST_NET or not np.isfinite(net).all() or not np.abs(net[..., :2] - uniform).max() <= UNIFORM:
        raise SceneError(f"lens.front.file: {name} holds no net of a design; {NET_REMEDY}")
    return GivenNet.of(BSplineSurface.from_control_points(net, 0.0))


def _net_of_step(path: Path) -> np.ndarray:
    from bstcad.optics.bspline import knots

    text = part21.read(path)
    if text.solids != 1:
        raise ValueError(f"{text.solids} solids in it, and a lens is one")
    surface, shape = text.surface, text.surface.control_points.shape[:2]
    ours = (np.array_equal(full, knots(m)) for full, m in zip(surface.full_knots, shape, strict=True))
    if surface.degrees != (2, 2) or not all(ours):
        raise ValueError("its freeform face has other knots than bstcad's")
    return _along_axes(surface.control_points)


def _along_axes(net: np.ndarray) -> np.ndarray:
    """A net (m, n, 3) as a height over x and y, with x rising along its first axis and y along its second.

    ValueError if its lens is turned so that the axis is not along z, or the sides of the net not along x and y.
    """
    frame = own_frame(net)
    sines = np.abs(frame.rotation)
    if not (np.abs(sines - sines.round()).max() <= LEVEL and sines[2, 2] > 0.5):
        over = "a front is a height over x and y, and the sides of its net lie along them"
        raise ValueError(f"its lens is {frame.turn_words}, and {over}: export it unturned")
    along = np.abs(net[-1, 0, :2] - net[0, 0, :2])
    net = net.transpose(1, 0, 2) if along[1] > along[0] else net
    for axis in (0, 1):
        net = np.flip(net, axis) if net[-1, -1, axis] < net[0, 0, axis] else net
    return np.ascontiguousarray(net)


Z = Key("Where it crosses the axis, its vertex.", "mm", *COORDINATES, example=8.0)
CURVATURE = Key("Curvature at the vertex; positive bends towards +z.", "1/mm", -1e3, 1e3)
OUTLINE = Key(
    "Outline of its own, inside the lens's: the lens's underside around it is a plane through its rim.",
    example={"shape": "circle", "diameter": 10.0},
)
OPTIMISE = Key("Parameters that tailoring finds: true for all of them, or a list of names.")
NetFile = from_file(GivenNet, read_net, "file = 'outputs/earlier'")


def _some(*names: str) -> Any:
    """The type of `optimise`: false, true for all of these parameters, or a list of them."""
    listed = Annotated[tuple[Literal[names], ...], BeforeValidator(tuple), Tag("list")]
    tag = Discriminator(lambda given: "list" if isinstance(given, list | tuple) else "flag")
    return Annotated[Annotated[bool, Tag("flag")] | listed, tag]


class _Front:
    optimise: bool | tuple[str, ...] = False
    outline: Circle | None = None
    given: GivenNet | None = None  # the net of a freeform front, or the one that its tailoring starts from
    shaped = False  # is it a net that tailoring shapes?
    reflect: bool = False

    @property
    def surface(self) -> Surface:
        """The surface in the terms of optics."""
        return self.optical if self.outline is None else Recess(self.optical, self.outline)

    @property
    def optical(self) -> Surface:
        """The surface without an outline of its own."""
        of, _ = FRONTS[self.kind]
        return of(**{each.name: getattr(self, each.name) for each in fields(of)})

    def traced(self, outline: Outline) -> Surface:
        """Return the surface that a lens of this outline has: the front's own, or the net that stands for it."""
        return self.surface

    @property
    def fixed(self) -> bool:
        """Is nothing of it left for tailoring to find?"""
        return not (self.free or self.shaped)

    @property
    def free(self) -> tuple[str, ...]:
        """The parameters of the surface that tailoring is to find, by name."""
        names = tuple(self.surface.parameters()) if self.optimise else ()
        return names if self.optimise is True else tuple(name for name in names if name in self.optimise)

    def designed(self, surface: Surface) -> Self:
        """The same front with the parameters of this surface, and nothing left to find."""
        return replace(self, **surface.plain().parameters(), optimise=False) if self.free else self

    def complaints(self, outline: Outline) -> Iterator[str]:
        """Everything that keeps the front from a lens of this outline, each as "key: sentence"."""
        own, half = self.outline, min(outline.half_extent)
        if own is None:
            return
        if not own.radius <= half - LEAST_BESIDE:
            size = f"{2 * own.radius:g} mm, and the lens is {2 * half:g} mm wide"
            yield f"outline.diameter: {size}; make it smaller, or leave the outline out"
        if self.free:
            yield "optimise: a front with an outline of its own keeps its shape; leave out one of the two"
        reached = self.optical.reaches(*(torch.tensor(p, dtype=torch.float64) for p in own.farthest))
        _, slope, _ = self.optical.relative_sag_and_slope(*(torch.tensor(p, dtype=torch.float64) for p in own.farthest))
        steep = math.degrees(math.atan(abs(float(slope)))) if bool(reached) else 90.0
        if not steep <= STEEPEST:
            stands = "does not reach it" if steep == 90.0 else f"stands at {steep:.3g} degrees there"
            why = f"the {self.kind} {stands}, and a height over a plane carries {STEEPEST:g}"
            yield f"outline.diameter: at its rim, {own.radius:g} mm from the axis, {why}; make the outline smaller"
        if not max(map(abs, self.surface.sags(own))) >= FLATTEST:
            yield f"outline: a front so flat (curvature {self.curvature:g} 1/mm) has no edge of its own; leave it out"


@dataclass(frozen=True)
class PlaneFront(_Front):
    """z = const."""

    z: Annotated[float, Z]
    kind: Annotated[Literal["plane"], Key("A plane across the axis.")] = "plane"

    __pydantic_config__ = STRICT


@dataclass(frozen=True)
class SphereFront(_Front):
    """A sphere; of curvature 0 it is a plane."""

    z: Annotated[float, Z]
    curvature: Annotated[float, CURVATURE] = 0.0
    outline: Annotated[Circle | None, OUTLINE] = None
    optimise: Annotated[_some("curvature"), OPTIMISE] = False
    kind: Annotated[Literal["sphere"], Key("A sphere.")] = "sphere"

    __pydantic_config__ = STRICT

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It ends inside the lens."""
        yield from super().complaints(outline)
        if self.outline is not None:
            return
        if not bool(self.surface.reaches(*(torch.tensor(p, dtype=torch.float64) for p in outline.farthest))):
            rim, radius = math.hypot(*outline.farthest), 1 / abs(self.curvature)
            remedy = "make it smaller, or give lens.front an outline of its own"
            yield f"curvature: a sphere of radius {radius:g} mm ends before the rim, at {rim:g} mm; {remedy}"


@dataclass(frozen=True)
class ConicFront(_Front):
    """A conic that is turned about the axis."""

    z: Annotated[float, Z]
    curvature: Annotated[float, CURVATURE] = 0.0
    conic_constant: Annotated[float, Key("0 is a sphere, -1 a paraboloid.", "", *CONIC_CONSTANTS)] = 0.0
    outline: Annotated[Circle | None, OUTLINE] = None
    optimise: Annotated[_some("curvature", "conic_constant"), OPTIMISE] = False
    kind: Annotated[Literal["conic"], Key("A conic turned about the axis.")] = "conic"

    __pydantic_config__ = STRICT

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It ends in the lens or nearly, is nearly a cone, or its shape does not depend on its free parameter."""
        yield from super().complaints(outline)
        outline = self.outline or outline
        rim = sum(p * p for p in outline.farthest) ** 0.5
        bend = (1 + self.conic_constant) * (self.curvature * rim) ** 2
        conic = f"a conic of constant {self.conic_constant:g} and radius {1 / (self.curvature or 1):g} mm"
        if bend > UPRIGHT:
            yield f"curvature: {conic} ends or stands nearly upright {rim:g} mm from the axis; make it smaller"
        if bend < CONE:
            yield f"conic_constant: {conic} is nearly a cone {rim:g} mm from the axis; give a constant nearer to -1"
        if self.free == ("conic_constant",) and self.curvature == 0:
            yield "optimise: a front of curvature 0 has one shape for all conic constants; give a curvature, or true"


class _FittedFront(_Front):
    """A front for which the lens has a net within FITTED; its curvatures are curvature_x and curvature_y."""

    def traced(self, outline: Outline) -> Surface:
        """Return the net that stands for it, its vertex at z."""
        return _net_of(self.surface, outline)

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It ends before the rim, or stands too steeply there for a net."""
        x, y = map(torch.from_numpy, outline.places())
        _, z_x, z_y = self.surface.relative_sag_and_slope(x, y)
        slope = math.degrees(math.atan(float(torch.hypot(z_x, z_y).max())))
        if slope <= STEEP_NET and bool(self.surface.reaches(x, y).all()):
            return
        half = dict(zip(("curvature_x", "curvature_y"), outline.half_extent, strict=True))
        name = max(half, key=lambda name: abs(getattr(self, name)) * half[name])
        why = f"ends before the rim, or is steeper than {STEEP_NET:g} degrees there; make the curvature smaller"
        yield f"{name}: a radius of {1 / abs(getattr(self, name)):g} mm {why}"


@dataclass(frozen=True)
class ToroidFront(_FittedFront):
    """A toroid, of another curvature along x than along y."""

    z: Annotated[float, Z]
    curvature_x: Annotated[
        float, Key("Curvature along x at the vertex; positive bends towards +z.", "1/mm", -1e3, 1e3, example=0.02)
    ] = 0.0
    curvature_y: Annotated[
        float, Key("Curvature along y; the circle along x is turned about its centre.", "1/mm", -1e3, 1e3, example=0.01)
    ] = 0.0
    kind: Annotated[Literal["toroid"], Key("A toroid; of one curvature 0 a cylinder.")] = "toroid"

    __pydantic_config__ = STRICT


@lru_cache(maxsize=16)
def _net_of(surface: Surface, outline: Outline) -> BSplineSurface:
    return fitted(surface, outline).from_vertex().moved(surface.z)


@dataclass(frozen=True)
class NetFront(_Front):
    """A freeform front: the back of an earlier design, moved along z, or one that is tailored, from there or flat."""

    z: Annotated[float, Z]
    file: Annotated[
        NetFile | None, Key("Folder of a design, its design.npz or its lens.step.", example="outputs/earlier")
    ] = None
    optimise: Annotated[bool, Key("It is tailored, from the net of the file, or else flat.", example=True)] = False
    control_points: Annotated[
        OneOrTwo | None,
        Key(
            "Control points along each side, or [along x, along y]; as many as the back's if absent.",
            "",
            5,
            LARGEST_NET,
            example=513,
        ),
        BeforeValidator(lambda given: tuple(given) if isinstance(given, list) else given),  # as strict reading asks
    ] = None
    reflect: Annotated[
        bool, Key("A mirror: light comes along -z through the back, and leaves through the back.", example=True)
    ] = False
    kind: Annotated[Literal["bspline"], Key("A freeform face: of an earlier design, or tailored.")] = "bspline"

    written = leaving_out(optimise=False, reflect=False)
    __pydantic_config__ = STRICT

    @property
    def surface(self) -> Surface:
        """The surface in the terms of optics; flat before it is tailored."""
        return Plane(self.z) if self.file is None else self.file.surface(self.z)

    @property
    def given(self) -> GivenNet | None:
        """The net of the file."""
        return self.file

    @property
    def shaped(self) -> bool:
        """Is it a net that tailoring shapes?"""
        return self.optimise

    @property
    def free(self) -> tuple[str, ...]:
        """None by name: it has its heights."""
        return ()

    def complaints(self, outline: Outline) -> Iterator[str]:
        """It is of nothing, or of a lens of another outline; a net may also end at the sides of a rectangle."""
        if self.reflect and not self.optimise:
            yield "reflect: tailoring begins with the face that reflects; add optimise = true"
        if self.file is None:
            if not self.optimise:
                yield 'file: missing, and the front is not tailored; add file = "outputs/earlier", or optimise = true'
            yield from (f"control_points: {complaint}" for complaint in of_net(outline, self.control_points))
            return
        if self.control_points is not None:
            yield "control_points: the front has those of its file; remove one of the two"
        own, sides = net_extent(outline, self.file.shape), outline.half_extent
        for name, ends, half, side in zip("xy", (self.file.x, self.file.y), own, sides, strict=True):
            middle = (ends[0] + ends[1]) / 2
            if abs(middle) > UNIFORM and abs(ends[1] - ends[0] - 2 * half) <= 4 * UNIFORM:
                place = f"its net lies about {name} = {middle:.6g} mm and not about the axis"
                yield f"file: {place}; export the lens centred on its axis, or give its design"
                continue
            known = (half,) if outline.is_round else (half, side)
            if min(max(abs(ends[0] + end), abs(ends[1] - end)) for end in known) > UNIFORM:
                covers = f"{name} = {ends[0]:g} to {ends[1]:g} mm, and not {-half:g} to {half:g} mm"
                yield f"file: its net covers {covers}; give a design of the same outline"


FRONTS = {  # by their kind: the surface of optics, and the record
    "plane": (Plane, PlaneFront), "sphere": (Sphere, SphereFront), "conic": (Conic, ConicFront),
    "toroid": (Toroid, ToroidFront),
}  # fmt: skip


def as_front(value: Any, outline: Outline | None = None) -> Any:
    """The front of a scene that is a surface of optics; any other value stays as it is.

    outline: of the lens, for a surface of another kind than a scene has: it becomes a net within FITTED.
    """
    if not hasattr(value, "relative_sag_and_slope"):
        return value
    if value.is_net:
        return NetFront(value.z + value.moved(0.0).from_vertex().z, GivenNet.of(value))
    if value.kind in FRONTS:
        _, front = FRONTS[value.kind]
        own = {} if value.outline is None else {"outline": value.outline}
        return front(value.z, **value.parameters(), **own)
    if outline is None:
        raise ValueError(f"a scene has no {value.kind}; give it by scene.changed, which fits a net to it")
    return as_front(fitted(value, outline))


def fitted(surface: Surface, outline: Outline) -> BSplineSurface:
    """The net of least size that lies within FITTED of a surface inside the outline; SceneError if there is none."""
    from bstcad.optics.bspline import BSplineSurface

    for m in FITS:
        half_x, half_y = net_extent(outline, m)
        net = BSplineSurface.fitted(surface, (-half_x, half_x), (-half_y, half_y), m)
        along = (torch.linspace(-half, half, 2 * m + 1, dtype=torch.float64) for half in outline.half_extent)
        x, y = torch.meshgrid(*along, indexing="ij")
        inside = outline.contains(x, y)
        off = (net.sag_and_slope(x, y)[0] - surface.plain().sag_and_slope(x, y)[0])[inside].abs().max()
        if off <= FITTED:
            return net
    raise SceneError(
        f"lens.front: {FITS[-1]} x {FITS[-1]} control points come within {float(off):.2g} mm of the {surface.kind}, "
        f"and {FITTED:g} mm are allowed; give a smoother surface, finite to ±{half_x:g} mm in x and ±{half_y:g} mm in y"
    )


def net_extent(outline: Outline, net: Sides) -> tuple[float, float]:
    """Half the width of a net in x and y (mm): it reaches two spans past the rim of the lens.

    So x(t) is linear all over the lens.  In the end spans x(t) is quadratic, and the slope z'(t) / x'(t) a Möbius
    function of t, whose derivative grows eightfold inwards across 1.5 control points, whatever the heights: the light's
    rim would be too bright, and dark beside it.  A net of 5 has no spans to spare.
    """
    reach = ((m - 1) / (m - 5) if m > 5 else 1.0 for m in both(net))
    half_x, half_y = (share * half for share, half in zip(reach, outline.half_extent, strict=True))
    return half_x, half_y


def of_net(outline: Outline, points: Sides | None) -> Iterator[str]:
    """Complaints about the number of control points of a net over an outline; None: they are chosen later."""
    m, n = both(points or FEWEST_ROUND)
    if outline.is_round and m != n:
        yield f"a round lens (lens.outline) takes a square net, not one of {m} x {n}; give one number"
    if outline.is_round and m < FEWEST_ROUND:
        few = f"{m} are too few for a round lens, whose net reaches two spans beyond its rim"
        yield f"{few}; give {FEWEST_ROUND} or more"


Front = Annotated[
    Annotated[Union[*(front for _, front in FRONTS.values()), NetFront], Field(discriminator="kind")],
    BeforeValidator(as_front),
]


# ---- back and lens ---------------------------------------------------------------------------------------------------


class Back(Record):
    """The freeform face before tailoring: a flat B-spline net at z; not optimised it stays so."""

    kind: Annotated[Literal["bspline"], Key("The freeform face that bstcad finds.")] = "bspline"
    z: Annotated[float, Key("Place of the flat face before tailoring.", "mm", *COORDINATES, example=20.0)]
    control_points: Annotated[
        OneOrTwo | None,
        Key(
            "Control points of the net along each side, or [along x, along y]; chosen if absent.",
            "",
            5,
            2049,
            example=257,
        ),
    ] = None
    reflect: Annotated[bool, Key("A mirror: light comes along -z and goes back along +z.")] = False
    optimise: Annotated[
        bool, Key("It is tailored; false: it stays flat, and the front is tailored alone.", example=False)
    ] = True

    written = leaving_out(optimise=True)

    @property
    def net(self) -> Sides:
        """Control points a side, or along x and along y if these differ; SceneError where they are left out."""
        if self.control_points is None:
            raise SceneError(
                "lens.back.control_points: left out, and nothing has chosen it yet; use bstcad.design, or give a number"
            )
        return plain(self.control_points)


@dataclass(frozen=True)
class Bounds:
    """Bounds on tailored faces everywhere inside the outline; None: unbounded.

    Valleys and ridges are those of the back, which a tool sees from +z; a front's tool sees them from -z.
    """

    concave: float | None = None  # largest curvature of a valley (1/mm), of the back one towards +z
    convex: float | None = None  # of a ridge (1/mm)
    slope: float | None = None  # steepest |∇z|
    thinnest: float = 0.0  # mm; between front and back, along the axis
    thickest: float | None = None  # mm
    edge: float | None = None  # mm; least thickness along the rim


class LensBlank(Record):
    """The lens before tailoring: light enters through the front and leaves through the back.

    A mirror is a plate whose back, its upper face, reflects; its front is the rear of the plate.  Where the front
    reflects, light crosses the back on its way to it and on its way out.
    """

    material: Annotated[str | None, Key("Name on refractiveindex.info; or give the index.")] = None
    index: Annotated[float | None, Key("Refractive index at one wavelength.", "", *INDICES, example=1.49)] = None
    outline: Annotated[Outlined, Key("Rim of the lens.", example={"shape": "rectangle", "width": 24.0, "height": 24.0})]
    front: Annotated[Front, Key("The face that light enters.", example={"kind": "plane", "z": 8.0})]
    back: Annotated[
        Back, Key("The face that is tailored.", example={"kind": "bspline", "z": 20.0, "control_points": 257})
    ]
    tool_radius: Annotated[
        float | None, Key("Least radius of a tailored face's valleys, where a tool fits in.", "mm", 1e-6, 1e9)
    ] = None
    mould: Annotated[bool, Key("The tool cuts a mould: tool_radius bounds the ridges.", example=True)] = False
    max_slope: Annotated[
        float | None, Key("Steepest angle of a tailored face against z = const.", "degrees", 1e-3, 89.0)
    ] = None
    min_thickness: Annotated[float, Key("Least thickness along z; faces make way to keep it.", "mm", *LENGTHS)] = 0.5
    max_thickness: Annotated[float | None, Key("Greatest thickness along z.", "mm", *LENGTHS)] = None
    edge_thickness: Annotated[float | None, Key("Least thickness along the rim.", "mm", *LENGTHS)] = None

    @property
    def passes(self) -> Passes:
        """The faces that light meets, in its order, and what each does to it."""
        return MIRROR if self.back.reflect else SECOND_SURFACE if self.front.reflect else LENS

    @property
    def optic(self) -> str:
        """ "lens" or "mirror"."""
        return self.passes.optic

    def index_at(self, wavelength: float) -> float:
        """The refractive index at a wavelength (nm); 1 where light does not enter the solid."""
        if not self.passes.enters:
            return 1.0
        return refractive_index(self.material, wavelength) if self.index is None else self.index

    @property
    def bounded_by(self) -> tuple[str, ...]:
        """The keys that bound the tailored faces."""
        return tuple(key for key in BOUNDS if getattr(self, key) is not None)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the faces keep to while they are tailored; None: none is asked for."""
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

    @property
    def front_surface(self) -> Surface:
        """The front as the lens has it, before tailoring."""
        return self.front.traced(self.outline)

    @property
    def shaped(self) -> tuple[Face, ...]:
        """The faces that tailoring shapes, in the order of the light."""
        tailored = {"front": self.front.shaped, "back": self.back.optimise}
        return tuple(face for face in self.passes.faces if tailored[face])

    def front_net(self, net: Sides) -> Sides | None:
        """Control points of a freeform front beside a back with those of `net`; None: the front has few numbers.

        A front that tailoring shapes keeps its proportion to the back, such as both once have; a given one has its own.
        """
        if not self.front.shaped:
            front = self.front.given or self.front_surface
            return plain(front.shape) if isinstance(front, GivenNet) or front.is_net else None
        own = self.front.given.shape if self.front.given else self.front.control_points
        if own is None:
            return net
        if self.back.control_points is None:  # the proportion is not known yet
            return coarser(plain(own), max(both(net)))
        return in_proportion(net, of=self.back.net, to=plain(own))

    def nets(self, net: Sides | None = None) -> tuple[Sides, ...]:
        """Control points of the freeform faces: of the back, `net` or as the scene has it, then of the front."""
        back = net or self.back.net
        front = self.front_net(back)
        return (back,) if front is None else (back, front)

    def flat_front(self, net: Sides, as_wide_as: Sides | None = None) -> Surface:
        """The front before tailoring, beside a back with control points of `net`; as_wide_as: as Scene.flat_lens."""
        if not self.front.shaped:
            return self.front_surface
        if self.front.given is not None:
            return self.front.given.surface(self.front.z).refined(self.front_net(net))
        from bstcad.optics.bspline import BSplineSurface

        half_x, half_y = net_extent(self.outline, self.front_net(as_wide_as or net))
        heights = torch.zeros(both(self.front_net(net)), dtype=torch.float64)
        return BSplineSurface(self.front.z, heights, (-half_x, half_x), (-half_y, half_y))

    @property
    def cells(self) -> tuple[float, float]:
        """Width and height of a cell of the net (mm)."""
        half_x, half_y = net_extent(self.outline, self.back.net)
        m, n = both(self.back.net)
        return 2 * half_x / (m - 1), 2 * half_y / (n - 1)

    def doubts(self) -> Iterator[str]:
        """Oblong cells: along their longer side the net carries less detail than it could with as many points."""
        if self.back.control_points is None:
            return
        (width, height), (m, n) = self.cells, both(self.back.net)
        if max(width, height) <= OBLONG * min(width, height):
            return
        even = math.sqrt(width * height)
        better = [round((points - 1) * side / even) + 1 for points, side in ((m, width), (n, height))]
        if min(better) >= FEWEST_ROUND and max(better) <= LARGEST_NET:
            yield (
                f"lens.back.control_points: cells of {width:.3g} x {height:.3g} mm; {better} makes them square with as "
                "many points"
            )

    def complaints(self) -> Iterator[str]:
        """Everything that is wrong with the table by itself."""
        given = [name for name in ("material", "index") if getattr(self, name) is not None]
        if self.front.reflect and self.back.reflect:
            yield "lens.front.reflect: the back reflects all light before (lens.back.reflect); remove one of the two"
        if not self.passes.enters and given:
            yield f"lens: light does not enter a mirror (lens.back.reflect), so it has no {given[0]}; remove it"
        if self.passes.enters and len(given) != 1:
            yield 'lens: needs exactly one of material and index; give for example material = "PMMA"'
        of_back = of_net(self.outline, self.back.control_points)
        yield from (f"lens.back.control_points: {complaint}" for complaint in of_back)
        if not self.back.optimise and not self.front.shaped:
            tailored = f'lens.front = {{ kind = "bspline", z = {self.front.z:g}, optimise = true }}'
            yield f"lens.back.optimise: false leaves no face to tailor; write {tailored}, or remove it"
        yield from (f"lens.front.{complaint}" for complaint in self.front.complaints(self.outline))
        (falls, rises), least, most = self.front_sags, self.min_thickness, self.max_thickness
        highest = "thinnest place" if self.front.surface.is_net else "rim"
        for where, front in (("centre", self.front.z), (highest, self.front.z + rises)):
            if not self.back.z - front >= least:
                thick = f"{self.back.z - front:g} mm thick at its {where}, and lens.min_thickness asks for {least:g} mm"
                yield f"lens.back.z: the lens is {thick}; move the back to z = {front + least:g} or further"
        if self.mould and self.tool_radius is None:
            yield "lens.mould: says whose valleys lens.tool_radius is for, and there is none; add it, or remove mould"
        for key in ("min_thickness", "edge_thickness"):
            if most is not None and most < (getattr(self, key) or 0.0):
                asked = f"lens.{key} asks for {getattr(self, key):g} mm"
                yield f"lens.max_thickness: {most:g} mm, and {asked}; allow more, or ask for less"
        if most is not None and most - least < rises - falls:
            thick = (
                f"{least:g} mm at its thinnest place under a flat back the lens is {least + rises - falls:.6g} mm thick"
            )
            yield f"lens.max_thickness: {most:g} mm, and {thick} at its thickest, since its front is curved; allow more"
