"""A scene: frozen tables in mm, degrees and nm, read from TOML or changed by values of Python.

Each fault is one sentence (SceneError) before any work starts: where, which fault, and a remedy.  The first one counts,
and complaints behind it rely on its absence.  Keys of features that are not built yet are refused, never ignored.  The
tables are the engine's own nouns (bstcad.optics) where one exists.
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import tomli_w
import torch
from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_serializer, model_validator

from bstcad.optics.channels import Channel, channels_of, drawn_channels, merged
from bstcad.optics.collimated import Collimated
from bstcad.optics.emitters import Emitter
from bstcad.optics.goal import Goal
from bstcad.optics.key import Key
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.point import Point
from bstcad.optics.rays import Status
from bstcad.optics.sides import Sides, both
from bstcad.optics.wavefront import ALONG, PlaneWave, SphericalWave, Wave, ZernikeWave
from bstcad.runs import files
from bstcad.scene import effects, elements, lighting, mount, picture, scene_file
from bstcad.scene.blank import LensBlank, as_front, net_extent
from bstcad.scene.dotted_keys import OUTLINES, override, tables_at
from bstcad.scene.effects import Effects
from bstcad.scene.elements import Around, Elements, Way
from bstcad.scene.errors import SceneError, about, explain, line_of, toml_positions
from bstcad.scene.mount import Mount, Part
from bstcad.scene.picture import Picture
from bstcad.scene.quality import JUDGE_DRAW, JUDGE_POINTS, PRESETS, WHOLE, Tailoring, Tolerance, tolerance_complaints
from bstcad.scene.schema import FILE, FileContent, Record, contents, of_model
from bstcad.scene.target import Target, Targets, coplanar

if TYPE_CHECKING:
    from bstcad.optics.measure import Draw, GhostLight

MESH = 1e-3  # mm; how far facets may lie from a lens of up to 100 mm
IMAGE = re.compile(r"target(\[\d+\])?\.image")  # the keys of images
INSIDE = 0.999  # of the way to where a front would be refused: where the search may go
SINGLE = 2.0**-24  # of a coordinate: the rounding of float32
FINEST = 4 * SINGLE  # of the largest coordinate: no tolerance of a mesh is finer


class Accept(Record):
    """Limits of the checks in the report; None: the check only states its value."""

    rrmsd: Annotated[float | None, Key("Greatest RRMSD of light on a target.", "", 1e-6, 10.0, of_light=True)] = None
    form: Annotated[float, Key("Greatest distance of lens.step from the tailored surface.", "mm", 1e-12, 1.0)] = 1e-6
    efficiency: Annotated[
        float | None,
        Key("Least share on the target of the light that leaves the back.", "", 0.0, 1.0, example=0.9, of_light=True),
    ] = None
    light_on_target: Annotated[
        float | None, Key("Least share on the target of the light in the lens.", "", 0.0, 1.0, of_light=True)
    ] = None
    leak: Annotated[
        float | None, Key("Greatest share of the light where the target is dark.", "", 0.0, 1.0, of_light=True)
    ] = None
    decentre: Annotated[
        float | None, Key("Greatest decentre of a measured part in its points' frame.", "mm", 1e-6, 1e3)
    ] = None
    wavefront: Annotated[
        float | None, Key("Greatest RMS of the wavefront error, in waves.", "", 1e-9, 1e6, example=0.1, of_light=True)
    ] = None


class Output(Record):
    """The written files."""

    mesh_tolerance: Annotated[float | None, Key("Greatest distance of mesh facets from the lens.", "mm", 1e-6, 1e3)] = (
        None
    )
    export: Annotated[
        tuple[Literal[files.EXPORTS], ...],
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
    targets: Annotated[
        Targets, Field(alias="target"), Key("The picture and where it falls, or several: [[target]] tables.")
    ]
    before: Annotated[Elements, Key("Windows and mirrors that light meets before the lens: [[before]] tables.")] = ()
    behind: Annotated[Elements, Key("Windows and mirrors that light meets behind the lens: [[behind]] tables.")] = ()
    wavefront: Annotated[
        Annotated[PlaneWave | SphericalWave | ZernikeWave, Field(discriminator="kind")] | None,
        Key("The wave that the light behind the lens shall be."),
    ] = None
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
        self.refuse()
        return self

    def refuse(self) -> None:
        """Raise SceneError, the first sentence on what keeps the scene from being built."""
        for complaint in self._complaints():
            raise SceneError("; ".join((complaint, *self._metres())))

    def _complaints(self) -> Iterator[str]:
        """Everything that keeps the scene from being built: the first one counts, and those behind rely on it."""
        source, lens = self.source, self.lens
        if not picture.safe_name(self.name):
            yield f"name: {self.name!r} makes no folder name; use letters a-z, digits, '-' or '_'"
        if not (self.title.isprintable() and len(self.title) <= 200):  # it goes to the terminal too
            yield "title: must be one line of up to 200 characters that can be printed; shorten it"
        yield from self._of_targets(Target.complaints)
        yield from lens.complaints()
        yield from lighting.complaints(source, lens)
        yield from effects.complaints(self.effects, lens)
        yield from self.way.complaints()
        try:
            self.channels()
        except ValueError as error:  # data of the material or the metal that an effect lacks
            yield f"effects: {error}"
        if not self.before:  # else elements.complaints looks at the order
            yield from lighting.order(source, lens)
        if not self.way.is_folded:
            yield from self._of_targets(lambda target: target.behind(lens))
        if not self.before:
            yield from lighting.unlit(source.central, lens, self.rim)
        if not self.way.is_folded:
            yield from self._of_targets(lambda target: target.unfaced(lens))
        yield from coplanar(self.targets)
        if self.wavefront is not None and self.way.is_folded:
            yield "wavefront: is asked for behind the lens, and behind has a mirror, which turns it; remove one of them"
        yield from _of_wavefront(self.wavefront, source, lens, accept=self.accept)
        yield from self.tailoring.complaints(lens)
        yield from _of_method(self)
        yield from tolerance_complaints(self.tolerance)
        yield from _mesh(self.output.mesh_tolerance, lens)
        yield from self.part.complaints(lens)
        if self.mount is not None:
            yield from mount.complaints(self.mount, lens)

    def _of_targets(self, sentences: Callable[[Target], Iterable[str]]) -> Iterator[str]:
        """Sentences on each target, by its own key."""
        for key, target in zip(self.target_keys, self.targets, strict=True):
            yield from (about(sentence, key) for sentence in sentences(target))

    def _metres(self) -> list[str]:
        """Questions where lengths look as if they were in metres, each once."""
        return [*dict.fromkeys(self._of_targets(lambda target: target.metres(self.lens)))]

    def warnings(self) -> tuple[str, ...]:
        """Sentences on settings that are possible but perhaps not meant."""
        doubts = [*self._metres(), *self.lens.doubts(), *_of_goals(self)]
        if self.source.parallel:
            key = "mount.rim" if self.mount and self.mount.rim else "lens.outline"
            doubts += lighting.doubts(self.source, self.rim, key)
        elif not self.way.is_folded:
            doubts += self._of_targets(lambda target: target.grazed(self.lens))
        return (*doubts, *self.of_pictures())

    def of_pictures(self) -> tuple[str, ...]:
        """Sentences on what happens to the pictures and what the scene does not ask for."""
        return tuple(self._of_targets(Target.remarks))

    # ---- the targets ----

    @property
    def target(self) -> Target:
        """The target, the first of several."""
        return self.targets[0]

    @property
    def target_keys(self) -> tuple[str, ...]:
        """By which sentences call the targets: target, or target[0], target[1], …"""
        several = len(self.targets) > 1
        return tuple(f"target[{k}]" for k in range(len(self.targets))) if several else ("target",)

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The targets' pictures on their screens."""
        pairs = zip(self.target_keys, self.targets, strict=True)
        return tuple(Goal(key, target.screen, target.irradiance(), target.weight) for key, target in pairs)

    def each_alone(self) -> tuple[Self, ...]:
        """The scene once for each target, which it has alone, and no wavefront: what is known of one picture at a time.

        A front that is tailored keeps nothing to do then; see `warnings`.
        """
        if len(self.targets) == 1:
            return (self,)
        less = {"wavefront": None, "accept": self.accept.model_copy(update={"wavefront": None})}
        return tuple(self.model_copy(update={"targets": (each,), **less}) for each in self.targets)

    @model_serializer(mode="wrap")
    def _written(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """As a file has it: `target` is a table, or a list of several."""
        found = {("target" if name == "targets" else name): value for name, value in handler(self).items()}
        if len(found.get("target", ())) == 1:
            found["target"] = found["target"][0]
        return {name: value for name, value in found.items() if value or name not in ("before", "behind")}

    # ---- the lens and its light ----

    @property
    def optic(self) -> str:
        """ "lens" or "mirror"."""
        return self.lens.optic

    @property
    def folded(self) -> bool:
        """Does the light come to the targets along -z, by an odd number of mirrors behind the lens?"""
        return elements.turns(self.behind) < 0

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
        falls = source.begins - lens.front.z if source.begins is not None else -math.inf
        return INSIDE * falls, INSIDE * (lens.back.z - lens.front.z - lens.min_thickness)

    @property
    def way(self) -> Way:
        """The way of the light."""
        targets = dict(zip(self.target_keys, self.targets, strict=True))
        return Way(self.source, self.before, self.lens, behind=self.behind, targets=targets)

    @property
    def elements(self) -> tuple[tuple[str, Elements], ...]:
        """The windows and mirrors by the keys of their tables."""
        return ("before", self.before), ("behind", self.behind)

    def around(self, wavelength: float) -> Around | None:
        """The interfaces before and behind the lens for light of a wavelength (nm); None: there are none."""
        if not (self.before or self.behind):
            return None
        met = elements.interfaces(self.before, self.way.sense, wavelength)
        before = tuple(replace(interface, status_if_missed=Status.MISSED_FRONT) for interface in met)
        return before, elements.interfaces(self.behind, 1, wavelength)

    def clearance(self, highest: float) -> tuple[float, str]:
        """How far (mm) what follows passes a lens up to z = highest (mm), negative where it cuts it; and its key."""
        room = [(elements.lowest(self.behind) - highest, "behind[0].z")] if self.behind else []
        if not self.way.is_folded:
            for target, key in zip(self.targets, self.target_keys, strict=True):
                room.append((target.clearance(self.lens, highest), f"{key}.z"))
        return min(room)

    def flat_lens(
        self, net: Sides, dtype: torch.dtype = torch.float64, device: str | torch.device = "cpu",
        as_wide_as: Sides | None = None,
    ) -> Lens:  # fmt: skip
        """The lens before tailoring, its back a flat net of so many control points a side, or along x and along y.

        A front that is tailored is a net beside it, of as many more or fewer control points as in the scene, flat or as
        its file has it.  as_wide_as: the net of the back that `net` is the first level of, whose spare spans past the
        rim it has (default: itself); the front's likewise.
        """
        from bstcad.optics.bspline import BSplineSurface  # loads numba, which a scene alone does not need

        half_x, half_y = net_extent(self.lens.outline, as_wide_as or net)
        heights = torch.zeros(both(net), dtype=dtype, device=device)
        back = BSplineSurface(self.lens.back.z, heights, (-half_x, half_x), (-half_y, half_y))
        lens = Lens(
            self.lens.flat_front(net, as_wide_as).to(heights.dtype, device), back, self.lens.outline, self.index,
            way=self.lens.passes,
        )  # fmt: skip
        return self.assembled(lens)

    def assembled(self, lens: Lens) -> Lens:
        """A lens of this scene with all that the scene tells of it: what is around it, which faces are tailored."""
        before, behind = self.around(self.source.main_wavelength) or ((), ())
        return self.as_mounted(replace(lens, before=before, behind=behind).shaping(*self.lens.shaped))

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
        lines = [nm for nm, _ in self.source.lines]
        losses = {nm: effects.losses(self.effects, self.lens, nm) for nm in lines}
        around = {nm: self.around(nm) for nm in lines}
        own = ((c, c.source.wavelength) for c in channels)
        return merged([replace(c, losses=losses[nm], around=around[nm]) for c, nm in own])

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
    def limits_light(self) -> bool:
        """Does the scene set a limit on the light, by [accept] or by tailoring.accuracy?"""
        marked = (name for name, field in Accept.model_fields.items() if any(key.of_light for key in field.metadata))
        return any(limit is not None for limit in (*(getattr(self.accept, n) for n in marked), self.tailoring.accuracy))

    @property
    def mesh_tolerance(self) -> float:
        """Of STL and 3MF (mm): as asked for, else 1 µm, and more in proportion for a lens wider than 100 mm."""
        if self.output.mesh_tolerance is not None:
            return self.output.mesh_tolerance
        return MESH * max(1.0, 2 * max(self.lens.outline.half_extent) / 100.0)

    # ---- from and to files ----

    @property
    def files(self) -> dict[str, FileContent]:
        """The contents of all files that the scene names, by the names of their copies."""
        return {content.name: content for _, content in contents(self)}

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """The scene with other values, by dotted key: scene.changed({"lens.back.z": 21.0, "target.text": "HI"}).

        A value is of Python's own types: a number, a text, a list, a record (bstcad.Sphere(8.0, 0.01)), for
        target.image an array of irradiance; None takes the key out.  Of several targets "target[1].text" is the
        second's.  Of alternatives (text, image, …) the one given
        replaces the others; a path is relative to the working folder.  lens.front may be a bstcad.Surface of one's own:
        the scene holds a net within 1e-6 mm of it, inside the outline.  A source and targets of classes of one's own
        stay, with other values of the target's keys.  Raises SceneError.
        """
        given: dict[str, FileContent] = {}
        own: dict[str, Any] = {"source": self.source} if self.source.kind == Emitter.kind else {}
        standing_in = Collimated(self.lens.outline, self.source.wavelength, z=self.source.begins)
        data = _from_python(self.model_copy(update={"source": standing_in}) if own else self, "", given)
        outline = changes.get("lens.outline", self.lens.outline)
        for key, value in changes.items():
            if key == "lens.front":
                value = as_front(value, outline)
            override(data, key, _from_python(value, key, given), key)
        made = _validated(data, Path("."), given)
        if any(key.startswith("source") for key in changes):
            own = {}
        if any(type(target) is not Target for target in self.targets) and "target" not in changes:
            pairs = zip(self.targets, made.targets, strict=True)
            own["targets"] = tuple(before.model_copy(update=dict(after)) for before, after in pairs)
        if own:
            made = made.model_copy(update=own)
            made.refuse()
        return made

    def toml(self) -> str:
        """The scene as a file that loads to an equal scene; an image is named by the basename of its copy."""
        unused = set() if self.source.extent else {"source_points"}
        optic = f"refractive index {self.index:.6g}" if self.lens.passes.enters else f"a {self.optic}"
        comment = f"# {optic}; quality {self.tailoring.quality}"
        if self.lens.back.control_points is not None:  # by which they are set
            knobs = self.tailoring.resolved(self.lens.back.net).model_dump(exclude={"quality", "seed"} | unused)
            comment += ": " + ", ".join(f"{key} {value}" for key, value in knobs.items())
        return f"{comment}\n" + tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


# ---- complaints of several tables: a sentence with a remedy each -----------------------------------------------------


def _of_wavefront(wave: Wave | None, source: Emitter, lens: LensBlank, accept: Accept) -> Iterator[str]:
    """A wave that a lens cannot give to this light, or that no ray has."""
    if wave is None:
        if accept.wavefront is not None:
            yield "accept.wavefront: limits the error of a [wavefront], and there is none; add one, or remove it"
        return
    if source.extent is not None:
        sizes = " and ".join(f"source.{key}" for key, _, _ in source.sizes())
        yield f"wavefront: light of a source of some size ({sizes}) has no one wavefront; make it {source.simple}"
    yield from (f"wavefront.{complaint}" for complaint in wave.complaints(lens.back.z))
    if isinstance(wave, ZernikeWave) and not wave.steepest(source.main_wavelength) < math.sin(ALONG):
        yield "wavefront.coefficients: the wave is too steep to have rays; make them smaller, or the radius larger"


def _of_method(scene: Scene) -> Iterator[str]:
    """A method that knows one picture, in a scene of several goals."""
    goals = len(scene.targets) + (scene.wavefront is not None)
    method = scene.tailoring.method or PRESETS[scene.tailoring.quality]["method"]
    who, key = WHOLE.get(method, ("", ""))
    if who and goals > 1:
        yield f"{key}: {who} serves one picture alone, and the scene has {goals} goals; choose another {key}"


def _of_goals(scene: Scene) -> Iterator[str]:
    """As many goals as tailored faces can all be met: with fewer a front is idle, with more none is met whole."""
    lens, wave, different = scene.lens, scene.wavefront, []
    for target in scene.targets:  # parallel light along the axis repeats a picture on every plane: that is one goal
        alike = target.model_copy(update={"z": 0.0, "weight": 1.0})
        if alike not in different or not (isinstance(wave, PlaneWave) and wave.normal == (0.0, 0.0, 1.0)):
            different.append(alike)
    pictures, shaped = len(different), lens.shaped
    goals = pictures + (wave is not None)
    if goals < len(shaped) and not lens.passes.reflects:  # light crosses the other face of such a mirror twice
        idle, busy = shaped
        yield (
            f"lens.{idle}.optimise: one picture is the {busy}'s work, and the {idle} hardly changes; add a "
            "second [[target]] or a [wavefront], or set lens.back.optimise = false to have the front tailored alone"
        )
    if goals > len(shaped):
        faces, remedy = "two tailored faces, which meet", "state what matters by weight, or ask for less"
        if len(shaped) == 1:
            faces = "one tailored face, which meets"
            front = f'lens.front = {{ kind = "bspline", z = {lens.front.z:g}, optimise = true }}'
            also = "remove lens.back.optimise = false"
            if lens.back.optimise:
                also = f"have the front tailored too, {front}"
            alone = "a mirror has no second face, so state what matters by weight"
            remedy = also if "front" in lens.passes.faces else alone
        key = "target" if pictures > 1 else "wavefront"
        yield f"{key}: {goals} goals for {faces} them only as far as least squares by their weights go; {remedy}"


def _mesh(tolerance: float | None, lens: LensBlank) -> Iterator[str]:
    """A tolerance of the mesh (mm) below the rounding of STL's single precision, SINGLE of a coordinate."""
    size = max(*lens.outline.half_extent, abs(lens.front.z), abs(lens.back.z))
    if tolerance is not None and tolerance < (least := FINEST * size):
        rounded = f"coordinates of {size:g} mm in an STL file are rounded by up to {SINGLE * size:.1g} mm"
        yield f"output.mesh_tolerance: {tolerance:g} mm, and {rounded}; ask for {least:.2g} mm or more"


# ---- files and changes -----------------------------------------------------------------------------------------------


def load(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """The scene in a TOML file; overrides {"lens.back.z": "20.0"} go before what the file says.

    An override's text is read as a TOML value and, where it is none, as text.  Raises SceneError.
    """
    path = Path(path)
    return of_text(*scene_file.read(path), path, overrides)


def of_text(
    text: str, data: dict[str, Any], path: Path, overrides: Mapping[str, Any] | None = None, bounds: Sequence[Path] = ()
) -> Scene:  # fmt: skip
    """The scene in the text of a TOML file of that path, which need not be there; data: the tables of the text.

    bounds: folders that no link in them may lead out of to a file that the scene names.
    """
    try:
        for key, value in (overrides or {}).items():
            override(data, key, scene_file.toml_value(value) if isinstance(value, str) else value, f"--set {key}")
        return _validated(data, path.parent, bounds=bounds)
    except RecursionError:
        raise SceneError(f"{path}: {scene_file.NESTED}") from None
    except SceneError as error:
        key = str(error).partition(":")[0]
        names = [name.removesuffix("[0]").replace("[0].", ".") for name in overrides or ()]
        replaced = any(key == name or key.startswith((f"{name}.", f"{name}[")) for name in (*names, *(overrides or ())))
        if not replaced and (line := line_of(key, toml_positions(text))):
            error.add_note(f"line {line} of {path}")
        raise


def _validated(
    data: dict[str, Any], folder: Path, given: Mapping[str, FileContent] = MappingProxyType({}),
    bounds: Sequence[Path] = (),
) -> Scene:  # fmt: skip
    """The scene that tables as of a file make.

    given: the contents of files by their names; other files are relative to `folder`.
    """
    for key in data["tolerances"] if isinstance(data.get("tolerances"), dict) else ():
        table = "lens" if key.endswith("_thickness") else "accept"
        raise SceneError(f"tolerances.{key}: this table is called [{table}] now; write {table}.{key}")
    if isinstance(data.get("part"), dict) and type(date := data["part"].get("date")) is datetime.date:
        data["part"]["date"] = date.isoformat()  # as TOML has dates
    if isinstance(listed := data.get("target"), list) and len(listed) == 1:  # of which sentences speak without a number
        [data["target"]] = listed
    scene_file.check_plain(data)
    for outline in OUTLINES:
        for key, table in tables_at(data, outline):
            _circle(table, key)
    try:
        # By way of JSON, pydantic is strict (no "8" for 8.0, no true for 1) and still takes lists for tuples.
        context = {"folder": folder, "contents": given, "bounds": bounds}
        scene = Scene.model_validate_json(json.dumps(data), strict=True, context=context)
    except ValidationError as error:
        raise SceneError(explain(error, data)) from None
    for key, target in zip(scene.target_keys, scene.targets, strict=True):
        try:
            target.irradiance()  # a damaged or black picture is found before any work
        except SceneError as error:
            raise SceneError(about(str(error), key)) from None
    return scene


def _circle(outline: Any, place: str) -> None:
    """A circle may be written by its diameter; the record has one noun, the radius."""
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


def _from_python(value: Any, key: str, given: dict[str, FileContent]) -> Any:
    """A value of Python (record, array, path, tuple) under a dotted key as TOML could have it; None stays None.

    The content of a file is put into `given`, and a name that no file has stands for it.
    """
    if hasattr(value, "__array__") and np.ndim(value) and IMAGE.fullmatch(key):
        value = _image(np.asarray(value), key.removesuffix(".image"))
    if isinstance(value, FileContent):
        name = f"\0{len(given)}"
        given[name] = value
        return name
    if isinstance(value, BaseModel):
        value = {field.alias or name: getattr(value, name) for name, field in type(value).model_fields.items()}
    elif is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "__array__"):
        value = np.asarray(value).tolist()  # also a single number of numpy or torch
    if isinstance(value, Mapping):
        table = {str(k): _from_python(part, f"{key}.{k}".lstrip("."), given) for k, part in value.items()}
        return {name: part for name, part in table.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_from_python(part, f"{key}[{i}]", given) for i, part in enumerate(value)]
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    kind = type(value).__name__
    raise SceneError(f"{key}: no scene holds a value of type {kind}; give a number, a text, a list or a record")


def _image(values: np.ndarray, key: str) -> Picture:
    """An array as the picture of the target of this key."""
    try:
        return picture.from_array(values)
    except SceneError as error:
        raise SceneError(about(str(error), key)) from None


if __name__ == "__main__":
    FILE.write_text(json.dumps(of_model(Scene), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
