"""What light crosses besides the lens: windows and mirrors, the tables [[before]] and [[behind]] of a scene.

They stand where they are and are no part of the lens: no file is written of them.  Light meets those before the lens,
then the lens, then those behind it, each once, in the order of the tables, and loses none of its flux at their faces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field

from bstcad.optics.emitters import Emitter
from bstcad.optics.interfaces import Interface, Reflect, Refract
from bstcad.optics.key import Key
from bstcad.optics.media import refractive_index
from bstcad.optics.rays import Status, Vector, axes
from bstcad.optics.surfaces import Plane, Sphere
from bstcad.optics.tilted import TiltedSurface
from bstcad.optics.unfolding import Image, image
from bstcad.scene.blank import INDICES, LensBlank, Outlined
from bstcad.scene.errors import about
from bstcad.scene.schema import COORDINATES, LENGTHS, Record, leaving_out
from bstcad.scene.target import WAYS, Target, is_faced

MAX_TILT = 40.0  # degrees; a mirror at 45 sends light across the axis, where it goes neither up nor down along z
CURVATURES = (-1e3, 1e3)  # 1/mm
UPRIGHT = 0.85  # (c r)² of a sphere at its rim, at most: of a hemisphere 1
TURNED = Annotated[
    tuple[float, float] | None,
    Key("Tilt about x, then about y.", "degrees", -MAX_TILT, MAX_TILT, example=[0.0, 20.0]),
]
RIM = Key("Outline of what light may pass, as seen along z.", example={"shape": "circle", "diameter": 40.0})


class Window(Record):
    """A plate, its faces planes or spheres; tilted about its middle."""

    kind: Annotated[Literal["window"], Key("A plate that light goes through.")]
    z: Annotated[float, Key("Place of the face with the lower z.", "mm", *COORDINATES, example=40.0)]
    thickness: Annotated[float, Key("Thickness on the axis.", "mm", *LENGTHS, example=3.0)]
    material: Annotated[str | None, Key("Name on refractiveindex.info; or give the index.", example="N-BK7")] = None
    index: Annotated[float | None, Key("Refractive index.", "", *INDICES, example=1.5168)] = None
    outline: Annotated[Outlined, RIM]
    curvature: Annotated[
        tuple[float, float],
        Key("Curvatures of the face with the lower z and of the other.", "1/mm", *CURVATURES, example=[0.01, 0.011]),
    ] = (0.0, 0.0)
    tilt: TURNED = None

    written = leaving_out(curvature=(0.0, 0.0))

    @property
    def vertices(self) -> tuple[float, float]:
        """z (mm) of both faces on the axis before it is tilted, the lower one first."""
        return self.z, self.z + self.thickness

    @property
    def curvatures(self) -> tuple[float, float]:
        """Those of both faces (1/mm)."""
        return self.curvature

    def complaints(self, key: str) -> Iterator[str]:
        """Everything that is wrong with the table by itself; key: of the table."""
        if (self.material is None) == (self.index is None):
            yield f'{key}: needs exactly one of material and index; give for example material = "N-BK7"'
        lower, upper = self.faces()
        pairs = zip(upper.sags(self.outline), lower.sags(self.outline), strict=True)
        thinnest = upper.z - lower.z + min(above - below for above, below in pairs)
        if not self.tilt and not thinnest > 0:
            yield f"{key}.curvature: the faces of the window cross each other inside its outline; make it thicker"

    def faces(self) -> tuple[Plane | Sphere | TiltedSurface, ...]:
        """Both faces, the lower one first."""
        return _placed(self, self.z + self.thickness / 2)

    def interfaces(self, sense: int, wavelength: float) -> tuple[Interface, ...]:
        """The faces in the order of light along +z or -z."""
        n = refractive_index(self.material, wavelength) if self.index is None else self.index
        first, second = self.faces()[::sense]
        return (
            Interface(first, self.outline, Refract(1.0, n), Status.BLOCKED),
            Interface(second, self.outline, Refract(n, 1.0), Status.BLOCKED),
        )


class Mirror(Record):
    """A mirror, its face a plane or a sphere."""

    kind: Annotated[Literal["mirror"], Key("A mirror, which sends light back along z.")]
    z: Annotated[float, Key("Place of the face on the axis.", "mm", *COORDINATES, example=120.0)]
    outline: Annotated[Outlined, RIM]
    curvature: Annotated[float, Key("Curvature; positive bends towards +z.", "1/mm", *CURVATURES, example=0.002)] = 0.0
    tilt: TURNED = None

    written = leaving_out(curvature=0.0)

    @property
    def vertices(self) -> tuple[float, ...]:
        """z (mm) of the face on the axis."""
        return (self.z,)

    @property
    def curvatures(self) -> tuple[float, ...]:
        """That of the face (1/mm)."""
        return (self.curvature,)

    def complaints(self, key: str) -> Iterator[str]:
        """Nothing is wrong with the table by itself."""
        yield from ()

    def faces(self) -> tuple[Plane | Sphere | TiltedSurface, ...]:
        """The face."""
        return _placed(self, self.z)

    def interfaces(self, sense: int, wavelength: float) -> tuple[Interface, ...]:
        """The face."""
        return (Interface(*self.faces(), self.outline, Reflect(), Status.BLOCKED),)


Element = Annotated[Window | Mirror, Field(discriminator="kind")]
Elements = tuple[Element, ...]
Around = tuple[tuple[Interface, ...], tuple[Interface, ...]]  # before and behind the lens


def _placed(element: Window | Mirror, middle: float) -> tuple[Plane | Sphere | TiltedSurface, ...]:
    """The faces of an element that is tilted about the point of the axis at z = middle (mm)."""
    made: list[Plane | Sphere | TiltedSurface] = []
    for z, c in zip(element.vertices, element.curvatures, strict=True):
        if element.tilt and any(element.tilt):
            n = axes(element.tilt)[2]
            x, y, rise = (part * (z - middle) for part in n)
            made.append(TiltedSurface(middle + rise, (x, y), n, c))
        else:
            made.append(Sphere(z, c) if c else Plane(z))
    return tuple(made)


def turns(elements: Sequence[Window | Mirror]) -> int:
    """1, or -1 behind an odd number of mirrors: how they change the way of the light along z."""
    return -1 if sum(element.kind == "mirror" for element in elements) % 2 else 1


def interfaces(elements: Sequence[Window | Mirror], sense: int, wavelength: float) -> tuple[Interface, ...]:
    """What light of a wavelength (nm) meets, which comes along +z or -z.

    Light beside them is BLOCKED; before the lens `Scene.around` has it miss the lens.
    """
    found: list[Interface] = []
    for element in elements:
        found += element.interfaces(sense, wavelength)
        sense *= turns((element,))
    return tuple(found)


@dataclass(frozen=True)
class Station:
    """A part of the scene on the way of the light."""

    key: str  # of its place
    words: str
    low: float  # mm; its lowest and its highest z
    high: float

    @classmethod
    def of(cls, key: str, element: Window | Mirror) -> Station:
        """That of a window or a mirror."""
        ends = [face.z + sag for face in element.faces() for sag in face.sags(element.outline)]
        return cls(f"{key}.z", f"the {element.kind}", min(ends), max(ends))


@dataclass(frozen=True)
class Way:
    """The way of the light through a scene."""

    source: Emitter
    before: Elements
    lens: LensBlank
    behind: Elements
    targets: Mapping[str, Target]  # by their keys

    @property
    def sense(self) -> int:
        """The way along z, 1 or -1, of the light that leaves the source."""
        return turns(self.before) * self.lens.passes.sense

    @property
    def is_folded(self) -> bool:
        """Is there a mirror behind the lens?"""
        return any(element.kind == "mirror" for element in self.behind)

    def complaints(self) -> Iterator[str]:
        """Elements that are wrong by themselves, not in the order of the light, or that stage 1 cannot aim past."""
        for name, elements in (("before", self.before), ("behind", self.behind)):
            for k, element in enumerate(elements):
                key = f"{name}[{k}]"
                (x, y), steepest = element.outline.farthest, max(map(abs, element.curvatures))
                if not steepest**2 * (x * x + y * y) < UPRIGHT:
                    ends = "its sphere ends inside the outline, or stands nearly upright there"
                    yield f"{key}.curvature: {ends}; make one of them smaller"
                if name == "behind" and steepest:
                    aims = "stage 1 aims from the lens at the target, past planes alone"
                    yield f"{key}.curvature: {aims}; leave it out, or put the element before the lens"
                yield from element.complaints(key)
        for key, target in self.targets.items():
            if self.behind and target.screen.plane.frame is None:
                yield f"{key}: windows and mirrors behind a lens are for planes alone; leave out [[behind]]"
        if self.before or self.behind:
            yield from self._out_of_order()
        if self.is_folded:
            yield from self._unfaced()

    def _out_of_order(self) -> Iterator[str]:
        """Elements that light on its way from the source to the targets does not meet in their order."""
        lens, sense = self.lens, self.sense
        key, start = f"source.{self.source.start_key}", self.source.nearest(upwards=sense > 0)
        optic = Station("lens.front.z", f"the {lens.optic}", lens.front.z + lens.front_sags[0], lens.back.z)
        before, behind = (
            [(Station.of(f"{name}[{k}]", element), element.kind == "mirror") for k, element in enumerate(of)]
            for name, of in (("before", self.before), ("behind", self.behind))
        )
        stops = [*before, (optic, lens.passes.turn < 0), *behind]
        if start is not None:
            stops.insert(0, (Station(key, "the source", start, start), False))
        elif sense < 0:
            yield f"{key}: missing, and the light comes down along -z; add the plane where it starts"
            return
        for (here, reverses), (there, _) in pairwise(stops):
            sense = -sense if reverses else sense
            if not (there.low - here.high if sense > 0 else here.low - there.high) > 0:
                ends = " does not follow ".join(f"{p.words}, z = {p.low:.6g} to {p.high:.6g}," for p in (there, here))
                yield f"{there.key}: {ends} along {WAYS[sense]}, as the light goes; move one of them"
        sense = turns(self.behind)
        for key, target in self.targets.items():
            if self.behind:
                last = self.behind[-1]
                sentences = target.follows(last.kind, last.vertices[-(sense > 0)], sense)
                yield from (about(sentence, key) for sentence in sentences)

    def _unfaced(self) -> Iterator[str]:
        """Targets that the lens sees by way of mirrors from the edge, or from their rear."""
        behind = interfaces(self.behind, 1, self.source.main_wavelength)
        vertex: Vector = (0.0, 0.0, self.lens.back.z)
        for key, target in self.targets.items():
            seen = Image.of(image(behind, target.screen.plane))
            if not is_faced(seen, vertex):
                way = "by way of the mirrors the target is edge-on to the lens, or shows it its rear"
                yield f"{key}.tilt: {way}; turn the target or a mirror"


def lowest(elements: Sequence[Window | Mirror]) -> float:
    """The least z (mm) of the first of the elements."""
    return Station.of("", elements[0]).low
