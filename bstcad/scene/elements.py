"""Windows and mirrors before and behind the lens: the tables [[before]] and [[behind]] of a scene.

These elements are not part of the lens or of its files.  Light meets the elements before the lens, then the lens, then
the elements behind it, each once, in the order of the tables.  Light loses no flux at their faces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from bstcad.optics.lens.interfaces import Interface, Reflect, Refract
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.rays import Status, Vector, axes
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.surfaces.tilted import TiltedSurface
from bstcad.optics.trace.unfolding import Image, image
from bstcad.scene.blank import INDICES, LensBlank, Outlined, stated_index
from bstcad.scene.errors import with_target_key
from bstcad.scene.fronts import CURVATURES
from bstcad.scene.schema import COORDINATES, LENGTHS, Record, leaving_out
from bstcad.scene.target import DIRECTIONS, Target, is_faced

MAX_TILT = 40.0  # largest tilt (degrees): a mirror at 45 reflects light across the axis, neither up nor down along z
MAX_SPHERE_BEND = 0.85  # largest (c r)² of a sphere at its rim; a hemisphere has 1
TILT = Key("Tilt about x, then about y.", "degrees", -MAX_TILT, MAX_TILT, example=[0.0, 20.0])
RIM = Key("Clear aperture around the axis, seen along z.", example={"shape": "circle", "diameter": 40.0})


class Window(Record):
    """A transparent plate with plane or spherical faces, tilted about its centre."""

    kind: Annotated[Literal["window"], Key("A plate that transmits light.")]
    z: Annotated[float, Key("Position of the face with the lower z.", "mm", *COORDINATES, example=40.0)]
    thickness: Annotated[float, Key("Thickness on the axis.", "mm", *LENGTHS, example=3.0)]
    material: Annotated[str | None, Key("Material on refractiveindex.info; or give the index.", example="N-BK7")] = None
    index: Annotated[float | None, Key("Refractive index.", "", *INDICES, example=1.5168)] = None
    outline: Annotated[Outlined, RIM]
    curvature: Annotated[
        tuple[float, float], Key("Curvature of each face, smaller z first.", "1/mm", *CURVATURES, example=[0.01, 0.011])
    ] = (0.0, 0.0)
    tilt: Annotated[tuple[float, float] | None, TILT] = None

    written = leaving_out(curvature=(0.0, 0.0))

    @property
    def vertices(self) -> tuple[float, float]:
        """Positions z (mm) of both faces on the axis before the tilt, the lower one first."""
        return self.z, self.z + self.thickness

    @property
    def curvatures(self) -> tuple[float, float]:
        """Curvatures (1/mm) of both faces, the lower one first."""
        return self.curvature

    def complaints(self, key: str) -> Iterator[str]:
        """Yield the faults of the table; key: dotted key of the table."""
        if (self.material is None) == (self.index is None):
            yield f'{key}: needs exactly one of material and index; give for example material = "N-BK7"'
        lower, upper = self.faces()
        pairs = zip(upper.sags(self.outline), lower.sags(self.outline), strict=True)
        thinnest = upper.z - lower.z + min(above - below for above, below in pairs)
        if not self.tilt and not thinnest > 0:
            yield f"{key}.curvature: the faces of the window cross inside its outline; make the window thicker"

    def faces(self) -> tuple[Plane | Sphere | TiltedSurface, ...]:
        """Return both faces, the lower one first."""
        return _tilted_faces(self, self.z + self.thickness / 2)

    def interfaces(self, sense: int, wavelength: float) -> tuple[Interface, ...]:
        """Return the faces in the order in which light along sense · z (sense 1 or -1) meets them; wavelength in nm."""
        n = stated_index(self.material, self.index, wavelength)
        pairs = zip(self.faces()[::sense], (Refract(1.0, n), Refract(n, 1.0)), strict=True)
        return tuple(Interface(face, self.outline, law, Status.BLOCKED) for face, law in pairs)


class Mirror(Record):
    """A mirror with a plane or spherical face."""

    kind: Annotated[Literal["mirror"], Key("A mirror, which reverses the direction of light along z.")]
    z: Annotated[float, Key("Position of the face on the axis.", "mm", *COORDINATES, example=120.0)]
    outline: Annotated[Outlined, RIM]
    curvature: Annotated[float, Key("Curvature; positive: rim at larger z.", "1/mm", *CURVATURES, example=0.002)] = 0.0
    tilt: Annotated[tuple[float, float] | None, TILT] = None

    written = leaving_out(curvature=0.0)

    @property
    def vertices(self) -> tuple[float, ...]:
        """Position z (mm) of the only face on the axis, as a tuple."""
        return (self.z,)

    @property
    def curvatures(self) -> tuple[float, ...]:
        """Curvature of the only face (1/mm), as a tuple."""
        return (self.curvature,)

    def complaints(self, key: str) -> Iterator[str]:
        """Yield nothing: every table of a mirror is possible."""
        yield from ()

    def faces(self) -> tuple[Plane | Sphere | TiltedSurface, ...]:
        """Return the only face, as a tuple."""
        return _tilted_faces(self, self.z)

    def interfaces(self, sense: int, wavelength: float) -> tuple[Interface, ...]:
        """Return the face as an interface, which depends neither on the sense nor on the wavelength."""
        return tuple(Interface(face, self.outline, Reflect(), Status.BLOCKED) for face in self.faces())


Element: TypeAlias = Annotated[Window | Mirror, Field(discriminator="kind")]
Elements: TypeAlias = tuple[Element, ...]
Around: TypeAlias = tuple[tuple[Interface, ...], tuple[Interface, ...]]  # interfaces before the lens, and behind it


def _tilted_faces(element: Window | Mirror, middle: float) -> tuple[Plane | Sphere | TiltedSurface, ...]:
    """Return the faces of an element, tilted about the point of the axis at z = middle (mm)."""
    faces: list[Plane | Sphere | TiltedSurface] = []
    for z, c in zip(element.vertices, element.curvatures, strict=True):
        if element.tilt and any(element.tilt):
            n = axes(element.tilt)[2]
            x, y, height = (part * (z - middle) for part in n)
            faces.append(TiltedSurface(middle + height, (x, y), n, c))
        else:
            faces.append(Sphere(z, c) if c else Plane(z))
    return tuple(faces)


def reversal(elements: Sequence[Window | Mirror]) -> int:
    """Return -1 if the elements contain an odd number of mirrors, which reverse the light along z, or else 1."""
    return -1 if sum(element.kind == "mirror" for element in elements) % 2 else 1


def interfaces(elements: Sequence[Window | Mirror], sense: int, wavelength: float) -> tuple[Interface, ...]:
    """Return the interfaces of the elements for light that starts along sense · z (sense 1 or -1); wavelength in nm.

    The status of light outside their outlines is BLOCKED; `Scene.around` makes it MISSED_FRONT before the lens.
    """
    found: list[Interface] = []
    for element in elements:
        found += element.interfaces(sense, wavelength)
        sense *= reversal((element,))
    return tuple(found)


@dataclass(frozen=True)
class Station:
    """Source, element or lens on the path of the light, and its extent along z."""

    key: str  # key that states the position
    words: str  # name in messages
    low: float  # lowest z, mm
    high: float  # highest z, mm

    @classmethod
    def of(cls, key: str, element: Window | Mirror) -> Station:
        """Return the station of a window or a mirror; key: dotted key of its table."""
        ends = [face.z + sag for face in element.faces() for sag in face.sags(element.outline)]
        return cls(f"{key}.z", f"the {element.kind}", min(ends), max(ends))


@dataclass(frozen=True)
class LightPath:
    """The path of the light through a scene: source, elements, lens, elements, targets."""

    source: Emitter
    before: Elements
    lens: LensBlank
    behind: Elements
    targets: Mapping[str, Target]  # targets by key

    @property
    def sense(self) -> int:
        """Direction along z, 1 or -1, of the light that leaves the source."""
        return reversal(self.before) * self.lens.passes.sense

    @property
    def is_folded(self) -> bool:
        """True if there is a mirror behind the lens."""
        return any(element.kind == "mirror" for element in self.behind)

    def complaints(self) -> Iterator[str]:
        """Yield the faults of each element, of the elements' order, and of targets that the lens sees in mirrors."""
        for name, elements in (("before", self.before), ("behind", self.behind)):
            for k, element in enumerate(elements):
                key = f"{name}[{k}]"
                (x, y), steepest = element.outline.farthest, max(map(abs, element.curvatures))
                if not steepest**2 * (x * x + y * y) < MAX_SPHERE_BEND:
                    ends = "the sphere ends inside the outline, or is too steep at its rim"
                    yield f"{key}.curvature: {ends}; make the curvature or the outline smaller"
                if name == "behind" and steepest:
                    plane = "behind the lens only plane faces are possible"
                    yield f"{key}.curvature: {plane}; remove the curvature, or put the element before the lens"
                yield from element.complaints(key)
        for key, target in self.targets.items():
            if self.behind and target.screen.receiver.frame is None:
                yield f"{key}: windows and mirrors behind the lens need a target on a plane; remove [[behind]]"
        if self.before or self.behind:
            yield from self._out_of_order()
        if self.is_folded:
            yield from self._unfaced()

    def _out_of_order(self) -> Iterator[str]:
        """Yield complaints about elements that light does not meet in the order of their tables."""
        lens, sense = self.lens, self.sense
        key, start = f"source.{self.source.start_key}", self.source.nearest_z(upwards=sense > 0)
        optic = Station("lens.front.z", f"the {lens.optic}", lens.front.z + lens.front_sags[0], lens.back.z)
        before, behind = (
            [(Station.of(f"{name}[{k}]", element), element.kind == "mirror") for k, element in enumerate(of)]
            for name, of in (("before", self.before), ("behind", self.behind))
        )
        stops = [*before, (optic, lens.passes.reversal < 0), *behind]
        if start is not None:
            stops.insert(0, (Station(key, "the source", start, start), False))
        elif sense < 0:
            yield f"{key}: missing, and the light travels along -z; add the plane where it starts"
            return
        for (one, reverses), (other, _) in pairwise(stops):
            sense = -sense if reverses else sense
            if not (other.low - one.high if sense > 0 else one.low - other.high) > 0:
                follows = " must follow ".join(f"{p.words}, z = {p.low:.6g} to {p.high:.6g} mm," for p in (other, one))
                yield f"{other.key}: {follows} along {DIRECTIONS[sense]}, as the light travels; move one of them"
        sense = reversal(self.behind)
        for key, target in self.targets.items():
            if self.behind:
                last = self.behind[-1]
                sentences = target.follows(last.kind, last.vertices[-(sense > 0)], sense)
                yield from (with_target_key(sentence, key) for sentence in sentences)

    def _unfaced(self) -> Iterator[str]:
        """Yield complaints about targets whose image in the mirrors faces the lens edge-on or with its rear."""
        behind = interfaces(self.behind, 1, self.source.main_wavelength)
        vertex: Vector = (0.0, 0.0, self.lens.back.z)
        for key, target in self.targets.items():
            seen = Image.of(image(behind, target.screen.receiver))
            if not is_faced(seen, vertex):
                view = "seen from the lens in the mirrors, the target is edge-on or turned away"
                yield f"{key}.tilt: {view}; tilt the target or a mirror"


def lowest(elements: Sequence[Window | Mirror]) -> float:
    """Return the lowest z (mm) of the first element."""
    return Station.of("", elements[0]).low
