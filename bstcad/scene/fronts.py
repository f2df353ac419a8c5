"""Fronts of a scene: planes, spheres, conics, fitted surfaces, and nets that a file has or that are tailored."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
import torch
from pydantic import BeforeValidator, Discriminator, Field, Tag

from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import STRICT, Circle, Outline
from bstcad.optics.surfaces.sides import MIN_SIDE, Sides, as_pair
from bstcad.optics.surfaces.surfaces import Conic, Plane, Recess, Sphere, Surface, Toroid
from bstcad.runs import files
from bstcad.scene.errors import SceneError
from bstcad.scene.schema import (
    COORDINATES,
    MAX_CONTROL_POINTS,
    NET_SIZES,
    FileContent,
    OneOrTwo,
    from_file,
    leaving_out,
)
from bstcad.step_text import part21
from bstcad.step_text.placement import own_frame
from bstcad.tailoring.settings import CONIC_CONSTANTS

if TYPE_CHECKING:  # importing this module loads numba
    from bstcad.optics.surfaces.bspline import BSplineSurface

# Range of (1 + k) c² r² of a conic at the rim: at 1 its tangent is vertical; below the minimum it is nearly a cone.
MIN_CONIC_BEND, MAX_CONIC_BEND = -7.0, 0.85
MAX_FITTED_SLOPE = 60.0  # degrees; steepest slope at the rim of a surface to which a net is fitted
MAX_RECESS_SLOPE = 80.0  # degrees; steepest slope at the rim of a front with an outline of its own
MAX_DOME_SLOPE = 89.5  # degrees; the same for the front of a dome
MIN_RECESS_SAG = 1e-3  # mm; smallest sag at the rim of a front with its own outline, so that there is an edge
MIN_RECESS_GAP = 1e-2  # mm; smallest distance between the outlines of the front and of the lens
CURVATURES = (-1e3, 1e3)  # range of curvatures, 1/mm

NET_FILE = "front.npz"  # file in a design's folder with the net that was read from lens.front.file
NET_REMEDY = "give the folder of a design, its design.npz or its lens.step"
MAX_AXIS_SINE = 1e-9  # sine of the largest angle between the axes of a net and x, y, z that counts as no rotation
UNIFORM_TOLERANCE = 1e-9  # mm; largest deviation in x or y of a control point from a uniform grid
VERTEX_TOLERANCE = 1e-12  # mm; a net whose vertex is this near to z = 0 is not shifted
FIT_TOLERANCE = 1e-6  # mm; largest difference in z of a fitted net and its surface (a toroid, or a user's class)
FIT_SIZES = (33, 65, 129, 257, 513, 1025)  # control points per side of a fitted net, tried in this order
MIN_ROUND_POINTS = 6  # fewest control points per side for a round lens, whose net ends two spacings past the rim


@dataclass(frozen=True)
class FileNet(FileContent):
    """The net in a file: a B-spline surface, vertex at z = 0.  A Scene contains the heights, not the file's path."""

    name = NET_FILE
    shape: tuple[int, int]  # control points along x and along y
    x: tuple[float, float]  # ends of the net along x, mm, in the frame of the lens
    y: tuple[float, float]  # ends of the net along y, mm
    data: bytes = field(repr=False)  # heights of the control points above the vertex, (m, n), mm, float64

    @classmethod
    def of(cls, surface: BSplineSurface) -> FileNet:
        """Return the net of a surface, moved along z so that its vertex is at z = 0."""
        resting = surface.plain().moved(0.0)
        vertex = resting.from_vertex()
        heights = (vertex if abs(vertex.z) > VERTEX_TOLERANCE else resting).heights
        return cls(surface.shape, surface.x, surface.y, heights.numpy().astype("<f8").tobytes())

    def surface(self, z: float) -> BSplineSurface:
        """Return the net as a surface with its vertex at z (mm)."""
        from bstcad.optics.surfaces.bspline import BSplineSurface

        heights = np.frombuffer(self.data, "<f8").reshape(self.shape).astype(np.float64)
        return BSplineSurface(z, torch.from_numpy(heights), self.x, self.y)

    @property
    def copy(self) -> bytes:
        """Content of an .npz file that `read_net` reads as this net: control_points (m, n, 3) in mm."""
        file = io.BytesIO()
        np.savez_compressed(file, control_points=self.surface(0.0).control_points())
        return file.getvalue()


def read_net(path: Path) -> FileNet:
    """Read the back of a design from its folder, design.npz or lens.step; SceneError if it is missing or damaged.

    A net from a STEP file keeps its position in x and y, and its vertex is moved to z = 0.
    """
    from bstcad.optics.surfaces.bspline import BSplineSurface

    name = repr(str(path))
    path = path / "design.npz" if path.is_dir() else path
    if not os.path.lexists(path):
        raise SceneError(f"lens.front.file: {name} not found; {NET_REMEDY}, relative to the scene file")
    try:
        net = _net_of_step(path) if path.suffix.lower() in (".step", ".stp") else files.net(path, MAX_CONTROL_POINTS)
    except ValueError as error:
        reason = files.first_line(error).removeprefix(f"{path.name}: ")
        raise SceneError(f"lens.front.file: {name} cannot be read ({reason}); {NET_REMEDY}") from None
    shape = net.shape[:2]
    axes = (np.linspace(net[0, 0, i], net[-1, -1, i], count) for i, count in enumerate(shape))
    uniform = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    deviation = np.abs(net[..., :2] - uniform).max()
    if min(shape) < MIN_SIDE or not deviation <= UNIFORM_TOLERANCE:
        raise SceneError(f"lens.front.file: {name} does not contain the net of a design; {NET_REMEDY}")
    return FileNet.of(BSplineSurface.from_control_points(net, 0.0))


def _net_of_step(path: Path) -> np.ndarray:
    from bstcad.optics.surfaces.bspline import knots

    text = part21.read(path)
    if text.solids != 1:
        raise ValueError(f"it has {text.solids} solids, and a lens is one solid")
    surface, shape = text.surface, text.surface.control_points.shape[:2]
    uniform = (np.array_equal(full, knots(m)) for full, m in zip(surface.full_knots, shape, strict=True))
    if surface.degrees != (2, 2) or not all(uniform):
        raise ValueError("its freeform face does not have the degree and the knots of a net by bstcad")
    return _along_axes(surface.control_points)


def _along_axes(net: np.ndarray) -> np.ndarray:
    """Exchange or reverse the array axes of a net (m, n, 3) so that x grows along the first and y along the second.

    ValueError if the axis of its lens is not along z, or the sides of the net are not along x and y.
    """
    frame = own_frame(net)
    sines = np.abs(frame.rotation)
    if not (np.abs(sines - sines.round()).max() <= MAX_AXIS_SINE and sines[2, 2] > 0.5):
        needed = "the axis of a front must be along z, and the sides of its net along x and y"
        raise ValueError(f"its lens is {frame.turn_words}, but {needed}: export it without this rotation")
    along = np.abs(net[-1, 0, :2] - net[0, 0, :2])
    net = net.transpose(1, 0, 2) if along[1] > along[0] else net
    for axis in (0, 1):
        net = np.flip(net, axis) if net[-1, -1, axis] < net[0, 0, axis] else net
    return np.ascontiguousarray(net)


VERTEX_Z = Key("Position of the vertex on the axis.", "mm", *COORDINATES, example=8.0)
CURVATURE = Key("Curvature (1 / radius) at the vertex; positive: rim at larger z.", "1/mm", *CURVATURES)
OUTLINE = Key("Outline of the curved part; around it the face is plane.", example={"shape": "circle", "diameter": 10.0})
OPTIMISE = Key("Parameters that tailoring finds: true for all, or a list of names.")
FrontFile = Annotated[FileNet, *from_file(FileNet, read_net, "file = 'outputs/earlier'")]
ParameterName = TypeVar("ParameterName", bound=str)
FlagOrNames = Annotated[  # type of `optimise`: false, true for all parameters of the surface, or a list of names
    Annotated[bool, Tag("flag")] | Annotated[tuple[ParameterName, ...], BeforeValidator(tuple), Tag("list")],
    Discriminator(lambda given: "list" if isinstance(given, list | tuple) else "flag"),
]


class _Front:
    __dataclass_fields__: ClassVar[dict[str, Any]]  # each kind of front is a dataclass
    z: float
    kind: str
    optimise: bool | tuple[str, ...] = False
    outline: Circle | None = None
    file: FileNet | None = None  # net of a freeform front, at which its tailoring starts if it is tailored
    control_points: Sides | None = None
    reflect: bool = False

    @property
    def surface(self) -> Surface:
        """The front as a surface of bstcad.optics."""
        of, _ = FRONTS[self.kind]
        surface = of(**{each.name: getattr(self, each.name) for each in fields(of)})
        return surface if self.outline is None else Recess(surface, self.outline)

    @property
    def is_tailored(self) -> bool:
        """True if the front is a net that tailoring shapes."""
        return self.kind == "bspline" and self.optimise is True

    def traced(self, outline: Outline) -> Surface:
        """Return the front of a lens of this outline as it is traced: `surface`, or a net fitted to it."""
        return self.surface

    @property
    def fixed(self) -> bool:
        """True if tailoring does not change the front."""
        return not (self.free or self.is_tailored)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters of the surface that tailoring finds."""
        chosen = self.optimise
        names = self.surface.parameters() if chosen else ()
        return tuple(name for name in names if not isinstance(chosen, tuple) or name in chosen)

    def with_parameters(self, surface: Surface) -> Self:
        """Return the front, fixed, with the parameters of `surface`; a front without free parameters is unchanged."""
        return replace(self, **surface.plain().parameters(), optimise=False) if self.free else self

    def complaints(self, outline: Outline, steepest: float = MAX_RECESS_SLOPE) -> Iterator[str]:
        """Yield the faults of the front for a lens of this outline, as "key: sentence" with a key of lens.front.

        steepest: largest slope (degrees) at the rim of a front with an outline of its own.
        """
        own, half = self.outline, min(outline.half_extent)
        if own is None:
            return
        if not own.radius <= half - MIN_RECESS_GAP:
            size = f"{2 * own.radius:g} mm is too large, as the lens is {2 * half:g} mm wide"
            yield f"outline.diameter: {size}; make it smaller, or remove the outline"
        if self.free:
            yield "optimise: a front with an outline of its own cannot be optimised; remove outline or optimise"
        surface, (x, y) = self.surface, _farthest(own)
        _, slope, _ = surface.optical.relative_sag_and_slope(x, y)
        steep = math.degrees(math.atan(abs(float(slope)))) if bool(surface.optical.reaches(x, y)) else 90.0
        if not steep <= steepest:
            ends = f"does not reach the rim of this outline, {own.radius:g} mm from the axis"
            steeply = f"has a slope of {steep:.3g} degrees at its rim, and {steepest:g} is the maximum"
            yield f"outline.diameter: the {self.kind} {ends if steep == 90.0 else steeply}; make the outline smaller"
        if not max(map(abs, surface.sags(own))) >= MIN_RECESS_SAG:
            flat = f"a front of curvature {surface.curvature:g} 1/mm is too flat to have an edge"
            yield f"outline: {flat}; remove the outline"


def _farthest(outline: Outline) -> tuple[torch.Tensor, ...]:
    """Return x and y (mm) of the point of an outline that is farthest from the axis, as tensors."""
    return torch.tensor(outline.farthest, dtype=torch.float64).unbind()


@dataclass(frozen=True)
class PlaneFront(_Front):
    """A plane, z = const."""

    z: Annotated[float, VERTEX_Z]
    kind: Annotated[Literal["plane"], Key("A plane perpendicular to the axis.")] = "plane"

    __pydantic_config__ = STRICT


@dataclass(frozen=True)
class SphereFront(_Front):
    """A sphere; a plane if the curvature is 0."""

    z: Annotated[float, VERTEX_Z]
    curvature: Annotated[float, CURVATURE] = 0.0
    outline: Annotated[Circle | None, OUTLINE] = None
    optimise: Annotated[FlagOrNames[Literal["curvature"]], OPTIMISE] = False
    kind: Annotated[Literal["sphere"], Key("A sphere.")] = "sphere"

    __pydantic_config__ = STRICT

    def complaints(self, outline: Outline, steepest: float = MAX_RECESS_SLOPE) -> Iterator[str]:
        """Yield the faults: those of every front, and a sphere that does not reach the rim of the lens."""
        yield from super().complaints(outline, steepest)
        if self.outline is not None:
            return
        if not bool(self.surface.reaches(*_farthest(outline))):
            rim, radius = f"the rim, {math.hypot(*outline.farthest):g} mm from the axis", 1 / abs(self.curvature)
            remedy = "make the curvature smaller, or give lens.front an outline of its own"
            yield f"curvature: a sphere of radius {radius:g} mm does not reach {rim}; {remedy}"


@dataclass(frozen=True)
class ConicFront(_Front):
    """A conic of revolution about the axis."""

    z: Annotated[float, VERTEX_Z]
    curvature: Annotated[float, CURVATURE] = 0.0
    conic_constant: Annotated[float, Key("Conic constant: 0 is a sphere, -1 a paraboloid.", "", *CONIC_CONSTANTS)] = 0.0
    outline: Annotated[Circle | None, OUTLINE] = None
    optimise: Annotated[FlagOrNames[Literal["curvature", "conic_constant"]], OPTIMISE] = False
    kind: Annotated[Literal["conic"], Key("A conic of revolution about the axis.")] = "conic"

    __pydantic_config__ = STRICT

    def complaints(self, outline: Outline, steepest: float = MAX_RECESS_SLOPE) -> Iterator[str]:
        """Yield the faults: a conic too steep at the rim, nearly a cone, or independent of its free parameter."""
        yield from super().complaints(outline, steepest)
        outline = self.outline or outline
        rim = sum(p * p for p in outline.farthest) ** 0.5
        bend = (1 + self.conic_constant) * (self.curvature * rim) ** 2
        conic = f"a conic of constant {self.conic_constant:g} and radius {1 / (self.curvature or 1):g} mm"
        if bend > MAX_CONIC_BEND:
            yield f"curvature: {conic} ends or is too steep {rim:g} mm from the axis; make the curvature smaller"
        if bend < MIN_CONIC_BEND:
            yield f"conic_constant: {conic} is nearly a cone {rim:g} mm from the axis; give a constant nearer to -1"
        if self.free == ("conic_constant",) and self.curvature == 0:
            same = "a front of curvature 0 has the same shape with all conic constants"
            yield f"optimise: {same}; give a curvature, or write optimise = true"


class FittedFront(_Front):
    """A front that is traced as a fitted net; a subclass has the keys curvature_x and curvature_y."""

    def traced(self, outline: Outline) -> Surface:
        """Return the net fitted to the surface within FIT_TOLERANCE, with its vertex at self.z."""
        return net_of(self.surface, outline)

    def complaints(self, outline: Outline, steepest: float = MAX_RECESS_SLOPE) -> Iterator[str]:
        """Yield the faults: a surface that does not reach the rim, or is too steep there for a net."""
        x, y = map(torch.from_numpy, outline.rim_points())
        _, z_x, z_y = self.surface.relative_sag_and_slope(x, y)
        slope = math.degrees(math.atan(float(torch.hypot(z_x, z_y).max())))
        if slope <= MAX_FITTED_SLOPE and bool(self.surface.reaches(x, y).all()):
            return
        half = dict(zip(("curvature_x", "curvature_y"), outline.half_extent, strict=True))
        name = max(half, key=lambda name: abs(getattr(self, name)) * half[name])
        why = f"does not reach the rim, or is steeper than {MAX_FITTED_SLOPE:g} degrees there"
        yield f"{name}: a toroid of radius {1 / abs(getattr(self, name)):g} mm {why}; make the curvature smaller"


@dataclass(frozen=True)
class ToroidFront(FittedFront):
    """A toroid, with different curvatures along x and y."""

    z: Annotated[float, VERTEX_Z]
    curvature_x: Annotated[float, Key("Curvature along x; positive: rim at larger z.", "1/mm", *CURVATURES)] = 0.0
    curvature_y: Annotated[float, Key("Curvature along y; positive: rim at larger z.", "1/mm", *CURVATURES)] = 0.0
    kind: Annotated[Literal["toroid"], Key("A toroid; a cylinder if one curvature is 0.")] = "toroid"

    __pydantic_config__ = STRICT


@lru_cache(maxsize=16)
def net_of(surface: Surface, outline: Outline) -> BSplineSurface:
    """Return the net fitted to a surface (fit_net), with its vertex at the z (mm) of the surface."""
    return fit_net(surface, outline).from_vertex().moved(surface.z)


@dataclass(frozen=True)
class NetFront(_Front):
    """A freeform front: the back of an earlier design, moved along z, or a net that is tailored."""

    z: Annotated[float, VERTEX_Z]
    file: Annotated[
        FrontFile | None,
        Key("Design whose back becomes this front: its folder, design.npz or lens.step.", example="outputs/earlier"),
    ] = None
    optimise: Annotated[bool, Key("Tailor the front, from the net of file or from a plane.", example=True)] = False
    control_points: Annotated[
        OneOrTwo | None,
        Key("Control points per side, or [along x, along y]; as for the back if absent.", "", *NET_SIZES, example=513),
        BeforeValidator(lambda given: tuple(given) if isinstance(given, list) else given),  # strict: a tuple
    ] = None
    reflect: Annotated[bool, Key("Mirror behind glass: light enters and leaves via the back.", example=True)] = False
    kind: Annotated[Literal["bspline"], Key("A freeform face of an earlier design, or a tailored one.")] = "bspline"

    written = leaving_out(optimise=False, reflect=False)
    __pydantic_config__ = STRICT

    @property
    def surface(self) -> Surface:
        """The front before tailoring as a surface of bstcad.optics: the net of the file, or a plane without a file."""
        return Plane(self.z) if self.file is None else self.file.surface(self.z)

    @property
    def free(self) -> tuple[str, ...]:
        """Empty: a net has heights instead of parameters."""
        return ()

    def complaints(self, outline: Outline, steepest: float = MAX_RECESS_SLOPE) -> Iterator[str]:
        """Yield the faults: keys that need or exclude each other, or the net of a lens with another outline.

        A net may end two control-point spacings outside the outline (net_extent), or at the sides of a rectangle.
        """
        if self.reflect and not self.optimise:
            yield "reflect: the face that reflects must be tailored; add optimise = true"
        if self.file is None:
            if not self.optimise:
                yield 'file: missing, and the front is not tailored; add file = "outputs/earlier", or optimise = true'
            yield from (f"control_points: {complaint}" for complaint in net_complaints(outline, self.control_points))
            return
        if self.control_points is not None:
            yield "control_points: the file gives the control points of the front; remove this key, or file"
        own, sides = net_extent(outline, self.file.shape), outline.half_extent
        for name, ends, half, side in zip("xy", (self.file.x, self.file.y), own, sides, strict=True):
            middle = (ends[0] + ends[1]) / 2
            if abs(middle) > UNIFORM_TOLERANCE and abs(ends[1] - ends[0] - 2 * half) <= 4 * UNIFORM_TOLERANCE:
                position = f"its net is centred at {name} = {middle:.6g} mm and not on the axis"
                yield f"file: {position}; export the lens centred on its axis, or give its design"
                continue
            known = (half,) if outline.is_round else (half, side)
            if min(max(abs(ends[0] + end), abs(ends[1] - end)) for end in known) > UNIFORM_TOLERANCE:
                covers = f"{name} = {ends[0]:g} to {ends[1]:g} mm, and not {-half:g} to {half:g} mm"
                yield f"file: its net covers {covers}; give a design of the same outline"


# Surface of bstcad.optics and record of each kind of front that is not a net.
FRONTS: dict[str, tuple[type[Any], Callable[..., Any]]] = {
    "plane": (Plane, PlaneFront),
    "sphere": (Sphere, SphereFront),
    "conic": (Conic, ConicFront),
    "toroid": (Toroid, ToroidFront),
}


def as_front(value: Any, outline: Outline | None = None) -> Any:
    """Return the front of a scene for a surface of bstcad.optics; return any other value as it is.

    outline: that of the lens, inside which a net is fitted to a surface not in FRONTS; None: ValueError instead.
    """
    if not hasattr(value, "relative_sag_and_slope"):
        return value
    if value.is_net:
        return NetFront(value.z + value.moved(0.0).from_vertex().z, FileNet.of(value))
    if value.kind in FRONTS:
        _, front = FRONTS[value.kind]
        own = {} if value.outline is None else {"outline": value.outline}
        return front(value.z, **value.parameters(), **own)
    if outline is None:
        raise ValueError(f"a scene cannot contain a surface {value.kind!r}; use scene.changed, which fits a net to it")
    return as_front(fit_net(value, outline))


def fit_net(surface: Surface, outline: Outline) -> BSplineSurface:
    """Fit the smallest net within FIT_TOLERANCE of a surface inside the outline; SceneError if there is none."""
    from bstcad.optics.surfaces.bspline import BSplineSurface

    for m in FIT_SIZES:
        half_x, half_y = net_extent(outline, m)
        net = BSplineSurface.fitted(surface, (-half_x, half_x), (-half_y, half_y), m)
        along = (torch.linspace(-half, half, 2 * m + 1, dtype=torch.float64) for half in outline.half_extent)
        x, y = torch.meshgrid(*along, indexing="ij")
        inside = outline.contains(x, y)
        error = (net.sag_and_slope(x, y)[0] - surface.plain().sag_and_slope(x, y)[0])[inside].abs().max()
        if error <= FIT_TOLERANCE:
            return net
    raise SceneError(
        f"lens.front: a net of {m} x {m} control points deviates from the {surface.kind} by {float(error):.2g} mm, and "
        f"{FIT_TOLERANCE:g} mm is the maximum; give a smoother surface, finite to ±{half_x:g} mm in x and "
        f"±{half_y:g} mm in y"
    )


def net_extent(outline: Outline, net: Sides) -> tuple[float, float]:
    """Return the half widths in x and y (mm) of a net that extends two control-point spacings past the rim of the lens.

    Then x is linear in the spline parameter t inside the rim.  In the end spans, which are 1.5 spacings wide, x(t) is
    quadratic, and d/dx of the slope z'(t) / x'(t) grows eightfold inwards, for any heights.  With light there, the edge
    of the picture would be too bright, with a dark line beside it.  A net of 5 control points per side ends at the rim.
    """
    reach = ((m - 1) / (m - 5) if m > 5 else 1.0 for m in as_pair(net))
    half_x, half_y = (factor * half for factor, half in zip(reach, outline.half_extent, strict=True))
    return half_x, half_y


def net_complaints(outline: Outline, points: Sides | None) -> Iterator[str]:
    """Yield complaints about a net's control points per side for a lens of this outline; points None: chosen later."""
    m, n = as_pair(points or MIN_ROUND_POINTS)
    if outline.is_round and m != n:
        yield f"a round lens (lens.outline) needs a square net, not {m} x {n} control points; give one number"
    if outline.is_round and m < MIN_ROUND_POINTS:
        few = f"{m} is too few for a round lens, whose net extends two control-point spacings past its rim"
        yield f"{few}; give {MIN_ROUND_POINTS} or more"


Front = Annotated[
    Annotated[PlaneFront | SphereFront | ConicFront | ToroidFront | NetFront, Field(discriminator="kind")],
    BeforeValidator(as_front),
]
