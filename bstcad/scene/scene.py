"""A scene: frozen tables in mm, degrees and nm, read from TOML or changed by values of Python.

Each fault is one sentence (SceneError) before any work starts: where, which fault, and a remedy.  The first one counts,
and complaints behind it rely on its absence.  Keys of features that are not built yet are refused, never ignored.  The
tables are the engine's own nouns (bstcad.optics) where one exists.
"""

from __future__ import annotations

import copy
import datetime
import json
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import tomli_w
import torch
from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_validator

from bstcad.optics import sampling
from bstcad.optics.channels import Channel, channels_of, drawn_channels, merged
from bstcad.optics.key import Key
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.rays import TiltedPlane
from bstcad.optics.sides import Sides, both
from bstcad.optics.sources import Collimated, Point, Source
from bstcad.runs import files
from bstcad.scene import effects, mount, picture
from bstcad.scene.blank import INDICES, GivenNet, LensBlank, as_front, net_extent
from bstcad.scene.effects import Effects
from bstcad.scene.errors import SceneError, explain, line_of, toml_positions
from bstcad.scene.mount import Mount, Part
from bstcad.scene.picture import Picture
from bstcad.scene.quality import JUDGE_DRAW, JUDGE_POINTS, Tailoring, Tolerance, tolerance_complaints
from bstcad.scene.schema import FILE, Record, of_model
from bstcad.scene.target import PICTURES, Target

if TYPE_CHECKING:
    from bstcad.optics.measure import Draw, GhostLight

MESH = 1e-3  # mm; how far facets may lie from a lens of up to 100 mm
LARGEST_FILE = 1_000_000  # bytes of a scene file
DOTS = 100  # in a line of one: tomllib takes the square of a dotted key's length to read it
DEEPEST = 20  # tables and lists in one another; a scene has four
NESTED = "is nested too deeply; give a scene file like those in templates"
OUTLINES = ("source.aperture", "lens.outline", "target.outline", "lens.front.outline")
ONE_OF = {  # alternatives among the keys of a table: a later one replaces the others
    "target": PICTURES, "lens": ("material", "index"), **dict.fromkeys(OUTLINES, ("radius", "diameter")),
}  # fmt: skip
INSIDE = 0.999  # of the way to where a front would be refused: where the search may go
TINY, FAR = 0.5, 10.0  # mm; in metres no lens is wider than the one, no target further than the other
NARROW = 20.0  # times narrower than the lens: the light of a lens is seldom gathered so far
EDGE_ON = math.radians(1.0)  # a plane seen under less than that has no picture
SINGLE = 2.0**-24  # of a coordinate: the rounding of float32
FINEST = 4 * SINGLE  # of the largest coordinate: no tolerance of a mesh is finer
COVERED = 0.9  # of the lens's width: a beam narrower than that leaves a part dark that somebody pays for
MAX_LEAN = 89.0  # degrees from the lens's axis, of parallel light
SAMPLES = 200  # a side of the lens, at which light is looked for
PROFILES = {  # the width that a profile of the irradiance needs, by the kind of source
    ("collimated", "gaussian"): "radius_1e2",
    ("point", "gaussian"): "half_angle_1e2",
    ("point", "uniform"): "half_angle",
    ("point", "lambertian"): "half_angle",
}
UNBOUNDED = ("point", "lambertian")  # the profile that does without: it lights the half space


class Accept(Record):
    """Limits of the checks in the report; None: the check has a default limit, or only states its value."""

    rrmsd: Annotated[float | None, Key("Greatest RRMSD of the irradiance; 0.25 if absent.", "", 1e-6, 10.0)] = None
    form: Annotated[float, Key("Greatest distance of lens.step from the tailored surface.", "mm", 1e-12, 1.0)] = 1e-6
    efficiency: Annotated[
        float | None, Key("Least share on the target of the light that leaves the back.", "", 0.0, 1.0, example=0.9)
    ] = None
    light_on_target: Annotated[
        float | None, Key("Least share on the target of the light in the lens; 0.5 if absent.", "", 0.0, 1.0)
    ] = None
    leak: Annotated[float | None, Key("Greatest share of the light where the target is dark.", "", 0.0, 1.0)] = None
    decentre: Annotated[
        float | None, Key("Greatest decentre of a measured part in its points' frame.", "mm", 1e-6, 1e3)
    ] = None


class Output(Record):
    """The written files."""

    mesh_tolerance: Annotated[float | None, Key("Greatest distance of mesh facets from the lens.", "mm", 1e-6, 1e3)] = (
        None
    )
    export: Annotated[
        tuple[Literal["sag", "points", "zemax", "turning", "dxf", "svg", "preview", "datasheet"], ...],
        Key("Files for the shop.", example=["zemax", "dxf"]),
    ] = ()


class Scene(Record):
    """A scene that can be built: it has passed every check."""

    name: Annotated[
        str,
        AfterValidator(lambda name: picture.safe_name(name) or name),
        Key("Name of the design and of its folder.", example="my-lens"),
    ]
    title: Annotated[str, Key("One line for the report.")] = ""
    source: Annotated[Collimated | Point, Field(discriminator="kind"), Key("The light.")]
    lens: Annotated[LensBlank, Key("The lens before tailoring, and the bounds on its back.")]
    target: Annotated[Target, Key("The picture and where it falls.")]
    tailoring: Annotated[Tailoring, Key("How much work goes into the surface.")] = Tailoring()
    effects: Annotated[Effects, Key("What is simulated beyond refraction: [[effects]] tables.")] = ()
    accept: Annotated[Accept, Key("The limits that the report holds the design to.")] = Accept()
    tolerance: Annotated[
        tuple[Tolerance, ...], Key("How exactly the lens is made, mounted and lit: [[tolerance]] tables.")
    ] = ()
    output: Annotated[Output, Key("Accuracy of the meshes, and files for the shop.")] = Output()
    part: Annotated[Part, Key("The title block that lens.step states.")] = Part()
    mount: Annotated[Mount | None, Key("How the lens is held; with it there is part.step.")] = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for complaint in self._complaints():
            raise SceneError("; ".join((complaint, *_metres(self.target, self.lens))))
        return self

    def _complaints(self) -> Iterator[str]:
        """Everything that keeps the scene from being built: the first one counts, and those behind rely on it."""
        source, lens, target = self.source, self.lens, self.target
        if not picture.safe_name(self.name):
            yield f"name: {self.name!r} makes no folder name; use letters a-z, digits, '-' or '_'"
        if not (self.title.isprintable() and len(self.title) <= 200):  # it goes to the terminal too
            yield "title: must be one line of up to 200 characters that can be printed; shorten it"
        yield from target.complaints()
        yield from lens.complaints()
        yield from _of_source(source, lens)
        yield from effects.complaints(self.effects, lens)
        try:
            self.channels()
        except ValueError as error:  # data of the material or the metal that an effect lacks
            yield f"effects: {error}"
        yield from _order(source, lens, target)
        yield from _unlit(self)
        yield from _tilted(self)
        yield from self.tailoring.complaints(lens)
        yield from tolerance_complaints(self.tolerance)
        yield from _mesh(self.output.mesh_tolerance, lens)
        yield from self.part.complaints(lens)
        if self.mount is not None:
            yield from mount.complaints(self.mount, lens)

    def warnings(self) -> tuple[str, ...]:
        """Sentences on settings that are possible but perhaps not meant."""
        doubts = [*_metres(self.target, self.lens), *self.lens.doubts()]
        if isinstance(self.source, Collimated):
            key = "mount.rim" if self.mount and self.mount.rim else "lens.outline"
            doubts += _beam(self.source.aperture, self.rim, key)
        return (*doubts, *self.target.remarks())

    # ---- the lens and its light ----

    @property
    def optic(self) -> str:
        """ "lens" or "mirror"."""
        return self.lens.optic

    @property
    def index(self) -> float:
        """The lens's refractive index at the source's main wavelength; 1 for a mirror, which light does not enter."""
        return self.lens.index_at(self.source.main_wavelength)

    @property
    def rim(self) -> Outline:
        """The rim on which the back ends, in its mount if there is one: no light gets through beyond."""
        return self.lens.outline if self.mount is None else self.mount.rim_of(self.lens.outline).outline

    @property
    def rim_sags(self) -> tuple[float, float]:
        """Between which sags at the rim (mm) a front may be bent that is optimised.

        The blank keeps lens.min_thickness at the rim, and the rim stays behind the source.
        """
        lens, source = self.lens, self.source
        start = source.position[2] if isinstance(source, Point) else source.z
        falls = start - lens.front.z if start is not None else -math.inf
        return INSIDE * falls, INSIDE * (lens.back.z - lens.front.z - lens.min_thickness)

    def clearance(self, highest: float) -> float:
        """How far (mm) the target's plane passes a lens that reaches up to z = highest (mm); negative: it cuts it."""
        plane = TiltedPlane(self.target.screen.middle, self.target.tilt or (0.0, 0.0))
        return -plane.height((0.0, 0.0, highest)) - self.lens.outline.reach(*plane.axes[2][:2])

    def flat_lens(
        self, net: Sides, dtype: torch.dtype = torch.float64, device: str | torch.device = "cpu",
        as_wide_as: Sides | None = None,
    ) -> Lens:  # fmt: skip
        """The lens before tailoring, its back a flat net of so many control points a side, or along x and along y.

        as_wide_as: the net that it is the first level of, whose spare spans past the rim it has (default: itself).
        """
        from bstcad.optics.bspline import BSplineSurface  # loads numba, which a scene alone does not need

        half_x, half_y = net_extent(self.lens.outline, as_wide_as or net)
        heights = torch.zeros(both(net), dtype=dtype, device=device)
        back = BSplineSurface(self.lens.back.z, heights, (-half_x, half_x), (-half_y, half_y))
        front = self.lens.front.surface.to(heights.dtype, device)
        return self.as_mounted(Lens(front, back, self.lens.outline, self.index, reflects=self.lens.back.reflect))

    def as_mounted(self, lens: Lens) -> Lens:
        """A lens of this scene, with the clear apertures that the mount leaves of its faces."""
        return lens if self.mount is None else replace(lens, clear=self.mount.clear(lens))

    def channels(self, points: int | None = None, draw: int = 0) -> tuple[Channel, ...]:
        """The light as a weighted sum; a point or a collimated beam of one wavelength is one channel.

        points: of an extended source, shared out among its lines (default: tailoring.source_points); draw: which ones.
        """
        if points is None:
            points = self.tailoring.points_of_source
        return self._with_losses(channels_of(self.source, self.lens.index_at, points, draw))

    def judging_channels(self) -> tuple[Channel, ...]:
        """The same light for a verification: more points of an extended source, and other ones than tailoring knows."""
        return self.channels(JUDGE_POINTS, JUDGE_DRAW)

    @property
    def draw(self) -> Draw | None:
        """How a measurement draws points of an extended source, by their number and a seed; None: it is a point."""
        if self.source.extent is None:
            return None
        return lambda points, seed: self._with_losses(drawn_channels(self.source, self.lens.index_at, points, seed))

    def _with_losses(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        losses = {nm: effects.losses(self.effects, self.lens, nm) for nm, _ in self.source.lines}
        return merged([replace(c, losses=losses[c.source.wavelength]) for c in channels])

    def with_source_scaled(self, share: float) -> Self:
        """The scene with a source of this share of its size: 0 makes it a point, or a beam of parallel light."""
        if self.source.extent is None:
            return self
        return self.model_copy(update={"source": self.source.scaled(share)})

    @property
    def ghost(self) -> GhostLight | None:
        """How a verification follows the light that is reflected twice inside the lens; None: it is left out."""
        return effects.ghost(self.effects)

    @property
    def mesh_tolerance(self) -> float:
        """Of STL and 3MF (mm): as asked for, else 1 µm, and more in proportion for a lens wider than 100 mm."""
        if self.output.mesh_tolerance is not None:
            return self.output.mesh_tolerance
        return MESH * max(1.0, 2 * max(self.lens.outline.half_extent) / 100.0)

    # ---- from and to files ----

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """The scene with other values, by dotted key: scene.changed({"lens.back.z": 21.0, "target.text": "HI"}).

        A value is of Python's own types: a number, a text, a list, a record (bstcad.Sphere(8.0, 0.01)), for
        target.image an array of irradiance; None takes the key out.  Of alternatives (text, image, …) the one given
        replaces the others; a path is relative to the working folder.  lens.front may be a bstcad.Surface of one's own:
        the scene holds a net within 1e-6 mm of it, inside the outline.  Raises SceneError.
        """
        pictures: dict[str, Picture] = {}
        data = _from_python(self, "", pictures)
        outline = changes.get("lens.outline", self.lens.outline)
        for key, value in changes.items():
            if key == "lens.front":
                value = as_front(value, outline)
            _override(data, key, _from_python(value, key, pictures), key)
        return _validated(data, Path("."), pictures)

    def toml(self) -> str:
        """The scene as a file that loads to an equal scene; an image is named by the basename of its copy."""
        unused = set() if self.source.extent else {"source_points"}
        optic = "a mirror" if self.lens.back.reflect else f"refractive index {self.index:.6g}"
        comment = f"# {optic}; quality {self.tailoring.quality}"
        if self.lens.back.control_points is not None:  # by which they are set
            knobs = self.tailoring.resolved(self.lens.back.net).model_dump(exclude={"quality", "seed"} | unused)
            comment += ": " + ", ".join(f"{key} {value}" for key, value in knobs.items())
        return f"{comment}\n" + tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


# ---- complaints of several tables: a sentence with a remedy each -----------------------------------------------------


def _of_source(source: Source, lens: LensBlank) -> Iterator[str]:
    """Complaints about the profile, the spectrum and the size of a source before this lens."""
    profile = source.kind, source.profile
    width = PROFILES.get(profile)
    if width and profile != UNBOUNDED and getattr(source, width) is None:
        unit = "mm" if width == "radius_1e2" else "degrees"
        yield f"source.{width}: missing, and a {source.profile} profile needs it; add it in {unit}"
    for other in PROFILES.values():
        if other != width and getattr(source, other, None) is not None:
            yield f"source.{other}: has no meaning for a {source.profile} profile; remove it or change the profile"
    yield from _spectrum(source, lens)
    yield from _cone(source) if isinstance(source, Collimated) else _size(source, lens)


def _spectrum(source: Source, lens: LensBlank) -> Iterator[str]:
    """Lines without a weight, of several indices, or of which the material's index is not known or no glass's."""
    listed = source.wavelength if isinstance(source.wavelength, tuple) else ((source.wavelength, 1.0),)
    if not listed:
        yield "source.wavelength: no line is in it; give one wavelength in nm, or lines such as [[587.6, 1.0]]"
    for nm, weight in listed:
        if not weight > 0:
            yield f"source.wavelength: the weight {weight:g} of the line at {nm:g} nm is not above 0; remove the line"
    if len({nm for nm, _ in listed}) > 1 and lens.index is not None:
        lines = f"the {len(listed)} lines of source.wavelength"
        yield f'lens.index: one index does not hold for {lines}; set lens.material instead, such as material = "PMMA"'
    try:
        indices = [lens.index_at(nm) for nm, _ in listed]
    except ValueError as error:
        yield f"lens.material: {error}"
        return
    low, high = INDICES
    for index in (n for n in indices if lens.material is not None and not low <= n <= high):
        found = f"the index of {lens.material} is {index:.4g} there, not between {low:g} and {high:g}"
        yield f"lens.material: {found}; choose a material that lets the source's light through"


def _cone(source: Collimated) -> Iterator[str]:
    """Parallel light whose directions lean too far from the axis."""
    lean = math.degrees(math.acos(max(-1.0, min(1.0, source.axes[2][2]))))
    if not lean + (source.divergence or 0.0) / 2 < MAX_LEAN:
        key, light = ("divergence", "some of the light runs") if source.divergence else ("tilt", "the light runs")
        yield f"source.{key}: {light} {MAX_LEAN:g} degrees off the lens's axis or more; make it smaller"


def _size(source: Point, lens: LensBlank) -> Iterator[str]:
    """A disc or a rectangle that is not described, or that is larger than its distance from the lens."""
    given = [name for name in ("width", "height") if getattr(source, name) is not None]
    if given and source.diameter is not None:
        yield f"source.diameter: the source also has a {given[0]}; give a diameter, or width and height"
    for other in {"width", "height"} - set(given) if given else ():
        yield f"source.{other}: missing, and a source with a {given[0]} needs it; add it in mm"
    sizes = {name: getattr(source, name) or 0.0 for name in ("diameter", "width", "height")}
    name = max(sizes, key=sizes.get)
    distance = abs((lens.back if lens.back.reflect else lens.front).z - source.position[2])
    if source.extent is not None and not sizes[name] <= distance:
        far = f"the {distance:g} mm from the source to the {lens.optic}"
        yield f"source.{name}: {sizes[name]:g} mm is more than {far}; make the source smaller or move it away"


def _order(source: Source, lens: LensBlank, target: Target) -> Iterator[str]:
    """Light, lens and target that do not follow each other along z; a mirror's light comes from above."""
    front, back = lens.front.z + lens.front_sags[0], lens.back.z
    key, start = ("source.position", _nearest(source, lens)) if isinstance(source, Point) else ("source.z", source.z)
    if not lens.back.reflect:
        if start is not None and not start < front:
            yield f"{key}: the light starts at z = {start:g}, not before the front at z = {front:g}; move one of them"
    elif start is None:
        yield f"{key}: missing, and a mirror's light comes from above; add the plane it starts from, above z = {back:g}"
    elif not start > back:
        yield f"{key}: the light starts at z = {start:g}, not above the mirror at z = {back:g}; move one of them"
    if lens.back.reflect and lens.front.outline is not None:
        yield "lens.front.outline: the front of a mirror is the rear of its plate, which no light meets; remove it"
    if lens.back.reflect and lens.front.free:
        yield "lens.front.optimise: the front of a mirror is the rear of its plate, which no light meets; remove it"
    if not target.z > back:
        place = "above the mirror, whose face" if lens.back.reflect else "behind the lens, whose back"
        yield f"target.z: the target at z = {target.z:g} is not {place} is at z = {back:g}; move it further along +z"


def _nearest(source: Point, lens: LensBlank) -> float:
    """z (mm) of the place of a point, disc or rectangle that is nearest to the lens."""
    reach = 0.0 if source.extent is None else source.extent.reach(*(axis[2] for axis in source.axes[:2]))
    return source.position[2] + (-reach if lens.back.reflect else reach)


def _unlit(scene: Scene) -> Iterator[str]:
    """A source that is turned or moved sideways and sends no light to the lens inside its rim."""
    source, lens, rim = scene.source.central, scene.lens, scene.rim
    if not (source.tilted or getattr(source, "centre", None)):
        return
    z, sags = lens.back.z, (0.0,)
    if not lens.back.reflect:
        z, sags = lens.front.z, lens.front.surface.sags(rim)
    x, y = sampling.grid(source.window(rim, z, sags), SAMPLES)
    if not bool((source.irradiance(x, y, z) > 0).any()):
        key = "tilt" if source.tilted else "centre"
        yield f"source.{key}: none of the light goes to the {lens.optic}; turn or move the source towards it"


def _tilted(scene: Scene) -> Iterator[str]:
    """A tilted target that does not face the lens, cuts it, or comes down to it."""
    if scene.target.tilt is None:
        return
    screen, back, optic = scene.target.screen, scene.lens.back.z, scene.optic
    plane = screen.plane
    vertex = (0.0, 0.0, back)
    lowest = min(plane.point(x, y)[2] for x in screen.x for y in screen.y)
    if not -plane.height(vertex) > math.sin(EDGE_ON) * math.dist(plane.centre, vertex):
        yield f"target.tilt: the target plane is edge-on to the {optic}, or shows it its rear; turn it less, or move it"
    if not scene.clearance(back) > 0:
        yield f"target.tilt: the target plane cuts into the {optic}; turn it less, or move the target further along +z"
    if not lowest > back:
        edge = f"comes down to z = {lowest:.6g}, not beyond the {optic}, whose back is at z = {back:g}"
        yield f"target.tilt: an edge of the target {edge}; turn it less, make it smaller or move it along +z"


def _mesh(tolerance: float | None, lens: LensBlank) -> Iterator[str]:
    """A tolerance of the mesh (mm) below the rounding of STL's single precision, SINGLE of a coordinate."""
    size = max(*lens.outline.half_extent, abs(lens.front.z), abs(lens.back.z))
    if tolerance is not None and tolerance < (least := FINEST * size):
        rounded = f"coordinates of {size:g} mm in an STL file are rounded by up to {SINGLE * size:.1g} mm"
        yield f"output.mesh_tolerance: {tolerance:g} mm, and {rounded}; ask for {least:.2g} mm or more"


def _metres(target: Target, lens: LensBlank) -> Iterator[str]:
    """A question where lengths look as if they were in metres."""
    outline, widest = lens.outline, max(target.size)
    name, size = ("radius", outline.radius) if outline.is_round else ("width", outline.width)
    across, question = 2 * max(outline.half_extent), "are these metres? lengths are in mm"
    if across < TINY:
        yield f"lens.outline.{name}: {size:g} mm; {question}"
    elif 0 < target.z <= FAR and target.z - lens.back.z < across / 4:
        yield f"target.z: {target.z:g} mm; {question}"
    elif widest < min(across / NARROW, FAR):
        yield f"target.x: {target.size[0]:g} mm wide; {question}"


def _beam(aperture: Outline, rim: Outline, key: str) -> Iterator[str]:
    """A parallel beam that is wider than the lens, or leaves part of it dark; key: of the rim."""
    sides = [*zip("xy", aperture.half_extent, rim.half_extent, strict=True)]
    if any(b > h for _, b, h in sides):
        yield "source.aperture: the beam is wider than the lens; what passes beside it is lost"
    for axis, b, h in [side for side in sides if side[1] < COVERED * side[2]][:1]:
        yield (
            f"source.aperture: the beam is {2 * b:g} mm wide along {axis} and the lens {2 * h:g} mm; the lens "
            f"stays unlit beyond {axis} = -{b:g} and {b:g} mm, so widen the beam or make {key} smaller"
        )


# ---- files and changes -----------------------------------------------------------------------------------------------


def load(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """The scene in a TOML file; overrides {"lens.back.z": "20.0"} go before what the file says.

    An override's text is read as a TOML value and, where it is none, as text.  Raises SceneError.
    """
    path = Path(path)
    text, data = _read(path)
    try:
        for key, value in (overrides or {}).items():
            _override(data, key, _toml_value(value) if isinstance(value, str) else value, f"--set {key}")
        return _validated(data, path.parent)
    except RecursionError:
        raise SceneError(f"{path}: {NESTED}") from None
    except SceneError as error:
        key = str(error).partition(":")[0]
        replaced = any(f"{key}.".startswith(f"{name}.") for name in overrides or ())
        if not replaced and (line := line_of(key, toml_positions(text))):
            error.add_note(f"line {line} of {path}")
        raise


def _read(path: Path) -> tuple[str, dict[str, Any]]:
    """The text and the tables of a scene file."""
    if os.path.isdir(path):
        inside = min(path.glob("*.toml"), default=path / "scene.toml")
        raise SceneError(f"{path}: is a folder; give a scene file, such as {inside}")
    if not os.path.isfile(path):
        raise SceneError(f"{path}: no such scene file; give the path of a TOML file, such as templates/thu.toml")
    try:
        text = files.contents(path, LARGEST_FILE).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SceneError(f"{path}: is not UTF-8 text; give a TOML file") from None
    except ValueError as error:
        raise SceneError(f"{path}: cannot be read ({error}); give the path of a scene file") from None
    if _dotted(text):
        raise SceneError(f"{path}: has a line of over {DOTS} dots, which is no scene file; shorten that line")
    try:
        return text, tomllib.loads(text)
    except RecursionError:
        raise SceneError(f"{path}: {NESTED}") from None
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: not valid TOML: {_fault(text, str(error))}") from None
    except ValueError:
        raise SceneError(f"{path}: has a number of too many digits; shorten it") from None


def _fault(text: str, fault: str) -> str:
    """A fault of tomllib, "Expected ']' (at line 3, column 5)", with its line and a remedy."""
    lines = text.split("\n")
    fault = fault.replace("at end of document", f"at line {len(lines)}, column {len(lines[-1]) + 1}")
    line = lines[int(re.search(r"at line (\d+)", fault)[1]) - 1]
    remedy = "write paths with / or in single quotes" if "\\" in line else "mend that line"
    return f"{fault[:1].lower()}{fault[1:]}; {remedy}"


def _dotted(text: str) -> bool:
    """Has a line that is no comment more than DOTS dots, so that reading it could take hours?"""
    return any(line.count(".") > DOTS for line in text.split("\n") if not line.lstrip().startswith("#"))


def _toml_value(text: str) -> Any:
    """An override as TOML has it, or else as a text."""
    try:
        table = {} if _dotted(text) else tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return table["value"] if len(table) == 1 else text


def _override(data: dict[str, Any], key: str, value: Any, shown: str) -> None:
    """Set a dotted key, `shown` so in a sentence; None takes it out.  It replaces its alternatives (ONE_OF)."""
    *tables, last = key.split(".")
    if not all((*tables, last)):
        raise SceneError(f"{shown}: is no dotted key; write one such as lens.back.control_points")
    table = data
    for name in tables:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise SceneError(f"{shown}: {name} is not a table; set it whole instead")
    if value is None:
        table.pop(last, None)
        return
    alternatives = ONE_OF.get(".".join(tables), ())
    for name in alternatives if last in alternatives else ():
        table.pop(name, None)
    table[last] = copy.deepcopy(value)  # a later key may go into it


def _validated(data: dict[str, Any], folder: Path, pictures: Mapping[str, Picture] = MappingProxyType({})) -> Scene:
    """The scene that tables as of a file make; `pictures` by their name, others are files relative to `folder`."""
    for key in data["tolerances"] if isinstance(data.get("tolerances"), dict) else ():
        table = "lens" if key.endswith("_thickness") else "accept"
        raise SceneError(f"tolerances.{key}: this table is called [{table}] now; write {table}.{key}")
    if isinstance(data.get("part"), dict) and type(date := data["part"].get("date")) is datetime.date:
        data["part"]["date"] = date.isoformat()  # as TOML has dates
    _plain(data)
    for key in OUTLINES:
        _circle(data, key)
    try:
        # By way of JSON, pydantic is strict (no "8" for 8.0, no true for 1) and still takes lists for tuples.
        context = {"folder": folder, "contents": pictures}
        scene = Scene.model_validate_json(json.dumps(data), strict=True, context=context)
    except ValidationError as error:
        raise SceneError(explain(error, data)) from None
    scene.target.irradiance()  # a damaged or black picture is found before any work
    return scene


def _circle(data: dict[str, Any], place: str) -> None:
    """A circle may be written by its diameter; the record has one noun, the radius."""
    outline: Any = data
    for key in place.split("."):
        outline = outline.get(key) if isinstance(outline, dict) else None
    if not isinstance(outline, dict):
        return
    if place == "lens.front.outline" and outline.setdefault("shape", "circle") != "circle":
        raise SceneError(f'{place}.shape: must be "circle", on which a front of revolution ends level; write that')
    if outline.get("shape") not in ("circle", "rectangle"):
        raise SceneError(f'{place}.shape: must be "circle" or "rectangle"; write one of them')
    if outline["shape"] == "circle" and "diameter" in outline:
        if "radius" in outline:
            raise SceneError(f"{place}: has both radius and diameter; give one of them")
        if type(diameter := outline.pop("diameter")) not in (int, float):
            raise SceneError(f"{place}.diameter: {diameter!r} is not a number; write one, without quotes")
        outline["radius"] = diameter / 2


def _plain(data: Any, key: str = "", depth: int = 0) -> None:
    """SceneError for values that JSON does not have: dates, infinity, NaN, half characters."""
    if depth > DEEPEST:
        raise RecursionError
    if isinstance(data, dict | list):
        for name, value in data.items() if isinstance(data, dict) else enumerate(data):
            where = f"{key}[{name}]" if isinstance(data, list) else f"{key}.{name}".lstrip(".")
            _plain(name, where, depth + 1)
            _plain(value, where, depth + 1)
    elif isinstance(data, int | float) and not abs(data) < 1e300:  # also NaN
        shown = data if isinstance(data, float) else "a number of over 300 digits"  # too many may not be written out
        raise SceneError(f"{key}: {shown} is not a finite number; give one")
    elif isinstance(data, str) and not data.isascii() and any("\ud800" <= c <= "\udfff" for c in data):
        raise SceneError(f"{key}: holds half a character; write the text again in UTF-8")
    elif not isinstance(data, str | int | float):
        raise SceneError(f"{key}: {data} is a date or a time; give a number or a text")


def _from_python(value: Any, key: str, pictures: dict[str, Picture]) -> Any:
    """A value of Python (record, array, path, tuple) under a dotted key as TOML could have it; None stays None.

    A picture, or a given net, is put into `pictures`, and a name that no file has stands for it.
    """
    if hasattr(value, "__array__") and np.ndim(value) and key == "target.image":
        value = picture.from_array(np.asarray(value))
    if isinstance(value, Picture | GivenNet):
        name = f"\0{len(pictures)}"
        pictures[name] = value
        return name
    if isinstance(value, BaseModel):
        value = {name: getattr(value, name) for name in type(value).model_fields}
    elif is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "__array__"):
        value = np.asarray(value).tolist()  # also a single number of numpy or torch
    if isinstance(value, Mapping):
        table = {str(k): _from_python(part, f"{key}.{k}".lstrip("."), pictures) for k, part in value.items()}
        return {name: part for name, part in table.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_from_python(part, f"{key}[{i}]", pictures) for i, part in enumerate(value)]
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    kind = type(value).__name__
    raise SceneError(f"{key}: no scene holds a value of type {kind}; give a number, a text, a list or a record")


if __name__ == "__main__":
    FILE.write_text(json.dumps(of_model(Scene), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
