"""A scene: frozen tables in mm, degrees and nm, read from TOML or changed by values of Python.

A fault is reported before any work starts, as one sentence (SceneError): the key, the fault and a remedy.  Only the
first fault is reported, and each check relies on earlier checks.  Unknown keys are refused, never ignored.  A table is
a record of bstcad.optics if there is one for it.
"""

from __future__ import annotations

import datetime
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import tomli_w
from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_serializer, model_validator

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import (
    Channel,
    SourceSampler,
    channels_of,
    drawn_channels,
    given_channels,
    merge_wavelengths,
)
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.wavefront import MAX_RAY_ANGLE, PlaneWave, Wave, ZernikeWave
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.surfaces.key import Key
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.sides import Sides
from bstcad.runs import files
from bstcad.scene import effects, elements, lighting, mount, picture, quality, scene_file
from bstcad.scene.accept import Accept
from bstcad.scene.beam import Collimated, of_beam
from bstcad.scene.blank import LensBlank, export_complaints
from bstcad.scene.dome_back import complete, forget_outlines
from bstcad.scene.dotted_keys import OUTLINES, override, tables_at
from bstcad.scene.effects import Effects
from bstcad.scene.elements import Around, Elements, LightPath
from bstcad.scene.errors import SceneError, explain, line_of, toml_positions, with_target_key
from bstcad.scene.fronts import as_front, net_extent
from bstcad.scene.lamp import Point
from bstcad.scene.moulding import CAVITY, MISSING, Moulding
from bstcad.scene.mount import Mount, Part
from bstcad.scene.picture import Picture
from bstcad.scene.quality import VERIFICATION_POINTS, VERIFICATION_SET, Tailoring, Tolerance
from bstcad.scene.schema import FileContent, Record, contents, of_model
from bstcad.scene.target import FAR_Z, AngularTarget, Target, Targets, coplanar_complaints
from bstcad.tailoring.settings import SEARCH_RANGE

if TYPE_CHECKING:
    from bstcad.optics.trace.measure import GhostTracer

MESH_TOLERANCE = 1e-3  # mm; default maximum distance of mesh facets from a lens up to 100 mm wide
IMAGE_KEY = re.compile(r"target(\[\d+\])?\.image|source\.profile\.image")  # dotted keys of images
FLOAT32_ROUNDING = 2.0**-24  # largest relative rounding error of a coordinate in float32
FINEST_MESH = 4 * FLOAT32_ROUNDING  # smallest tolerance of a mesh, as a fraction of the largest coordinate


class Output(Record):
    """Settings of the written files: accuracy of the meshes, and further file formats."""

    mesh_tolerance: Annotated[float | None, Key("Maximum distance of meshes from the lens.", "mm", 1e-6, 1e3)] = None
    export: Annotated[tuple[files.Export, ...], Key("Additional files for the shop.", example=["zemax", "dxf"])] = ()
    zero: Annotated[Literal["top", "bottom"], Key("Side of the blank on which Z of a raster is 0.")] = "top"


class Scene(Record):
    """A scene that has passed every check: source, lens, targets, effort, limits and files."""

    name: Annotated[
        str,
        AfterValidator(lambda name: picture.safe_name(name) or name),
        Key("Name of the design and of its folder.", example="my-lens"),
    ]
    title: Annotated[str, Key("Title of the report, one line.")] = ""
    source: Annotated[Collimated | Point, Field(discriminator="kind"), Key("The source of light.")]
    lens: Annotated[LensBlank, Key("The lens before tailoring, and the bounds on its tailored faces.")]
    targets: Annotated[Targets, Field(alias="target"), Key("Picture and its position; several: [[target]] tables.")]
    before: Annotated[Elements, Key("Windows and mirrors that light meets before the lens: [[before]] tables.")] = ()
    behind: Annotated[Elements, Key("Windows and mirrors that light meets behind the lens: [[behind]] tables.")] = ()
    wavefront: Annotated[Annotated[Wave, Field(discriminator="kind")] | None, Key("Wavefront behind the lens.")] = None
    tailoring: Annotated[Tailoring, Key("Effort and settings of tailoring.")] = Tailoring()
    effects: Annotated[
        Effects, Key("Effects simulated besides refraction: [[effects]] tables; fresnel if the flux is stated.")
    ] = ()
    accept: Annotated[Accept, Key("The limits of the checks in the report.")] = Accept()
    tolerance: Annotated[tuple[Tolerance, ...], Key("Tolerances of part, mount and source: [[tolerance]].")] = ()
    output: Annotated[Output, Key("Accuracy of the meshes, and files for the shop.")] = Output()
    part: Annotated[Part, Key("Data of the part for STEP files and data sheet.")] = Part()
    mount: Annotated[Mount | None, Key("Mount of the lens; with this table bstcad writes part.step.")] = None
    moulding: Annotated[Moulding | None, Key("Shrinkage of a moulded part, for the cavity of its mould.")] = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.states_effects:
            object.__setattr__(self, "effects", effects.default(self.source, self.lens))  # not a stated key
        self.refuse()
        return self

    def refuse(self) -> None:
        """Raise SceneError with the first fault of the scene, if it has one."""
        for complaint in self._complaints():
            raise SceneError("; ".join((complaint, *self._metre_questions())))

    def _complaints(self) -> Iterator[str]:
        """Yield the faults of the scene; each check relies on the absence of the faults before it."""
        source, lens = self.source, self.lens
        if not picture.safe_name(self.name):
            yield f"name: {self.name!r} cannot be the name of a folder; use letters a-z, digits, '-' or '_'"
        if not (self.title.isprintable() and len(self.title) <= 200):  # the terminal prints the title too
            yield "title: must be one line of up to 200 printable characters; shorten it"
        yield from self._of_targets(lambda target: target.complaints())
        yield from lighting.dome_complaints(source, lens, self._of_dome)
        yield from lighting.encapsulant_complaints(source, lens, self._of_dome)
        ends = getattr(lens.front, "outline", None) is not None
        of_export = export_complaints(
            self.output.export, not lens.back.chart.flat, lens.passes.index_before, front_ends=ends,
            tool_radius=None if lens.mould else lens.tool_radius,
        )  # fmt: skip
        yield from (f"output.export: {complaint}" for complaint in of_export)
        if CAVITY in self.output.export and self.moulding is None:
            yield f"output.export: {MISSING}"
        yield from lens.complaints()
        yield from lighting.complaints(source, lens)
        yield from effects.complaints(self.effects, lens)
        yield from self.light_path.complaints()
        try:
            self.channels()
        except ValueError as error:  # no data of the material or the metal for an effect
            yield f"effects: {error}"
        if not self.before:  # otherwise self.light_path checks the order
            yield from lighting.order_complaints(source, lens)
        if not self.light_path.is_folded:
            yield from self._of_targets(lambda target: target.behind(lens))
        if not self.before:
            yield from lighting.unlit_complaints(source.central, lens, self.rim)
        if not self.light_path.is_folded:
            yield from self._of_targets(lambda target: target.unfaced(lens))
        if len(self.targets) > 1 or self.wavefront is not None:
            for key, target in zip(self.target_keys, self.targets, strict=True):
                if target.screen.receiver.frame is None:
                    several = "several targets, or a wavefront, need targets on planes"
                    yield f"{key}: {several}; make it a plane, or keep one target without a wavefront"
        yield from coplanar_complaints(self.targets)
        yield from self.accept.complaints(self.targets, self.source)
        if self.accept.glare is not None and self.behind:
            yield "accept.glare: is judged on the light behind the lens and does not go with [[behind]]; remove one"
        if self.wavefront is not None and self.light_path.is_folded:
            yield "wavefront: cannot be set with a mirror in [[behind]], which reverses the wave; remove one of them"
        yield from _wavefront_complaints(self.wavefront, source, lens, accept=self.accept)
        yield from self.tailoring.complaints(lens)
        yield from _method_complaints(self)
        yield from quality.tolerance_complaints(self.tolerance)
        yield from _mesh_complaints(self.output.mesh_tolerance, lens)
        yield from self.part.complaints(lens)
        if self.mount is not None:
            yield from mount.complaints(self.mount, lens)

    @property
    def _of_dome(self) -> dict[str, bool]:
        """True for each key that the scene has and that does not go with a dome."""
        tables = {key: bool(getattr(self, key)) for key in ("before", "behind", "wavefront")}
        return tables | {"tailoring.method": self.tailoring.chosen_method != "least-squares"}

    def _of_targets(self, sentences: Callable[[Target], Iterable[str]]) -> Iterator[str]:
        """Yield the sentences on each target, with that target's key."""
        for key, target in zip(self.target_keys, self.targets, strict=True):
            yield from (with_target_key(sentence, key) for sentence in sentences(target))

    def _metre_questions(self) -> list[str]:
        """Return a question for each length that looks like metres."""
        return [*dict.fromkeys(self._of_targets(lambda target: target.metres(self.lens)))]

    def warnings(self) -> tuple[str, ...]:
        """Return sentences on settings that are possible but probably not intended."""
        doubts = [*self._metre_questions(), *self.lens.doubts(), *_doubts_of_goals(self)]
        if self.source.parallel:
            key = "mount.rim" if self.mount and self.mount.rim else "lens.outline"
            doubts += lighting.doubts(self.source, self.rim, key)
        elif not self.light_path.is_folded:
            doubts += self._of_targets(lambda target: target.grazed(self.lens))
        return (*doubts, *self.source.remarks, *self.picture_remarks())

    def picture_remarks(self) -> tuple[str, ...]:
        """Return sentences on changes of the pictures that the scene does not state."""
        return tuple(self._of_targets(Target.remarks))

    # ---- the targets ----

    @property
    def target(self) -> Target:
        """The first target."""
        return self.targets[0]

    @property
    def target_keys(self) -> tuple[str, ...]:
        """Dotted keys of the targets in messages: target, or target[0], target[1], … if there are several."""
        several = len(self.targets) > 1
        return tuple(f"target[{k}]" for k in range(len(self.targets))) if several else ("target",)

    @property
    def goals(self) -> tuple[Goal, ...]:
        """One Goal per target: key, screen, picture and weight."""
        pairs = zip(self.target_keys, self.targets, strict=True)
        return tuple(
            Goal(
                key,
                target.screen,
                target.irradiance(),
                target.weight,
                cell_picture=target.irradiance,
                is_shape=target.photo is None and target.text is None,
            )
            for key, target in pairs
        )

    def single_target_scenes(self) -> tuple[Self, ...]:
        """Return one scene per target, with only this target and no wavefront; for one target, the scene itself."""
        if len(self.targets) == 1:
            return (self,)
        alone = {"wavefront": None, "point": (), "uniformity": None, "cut_off": None}  # which name a target or the wave
        without = {"wavefront": None, "accept": self.accept.model_copy(update=alone)}
        return tuple(self.model_copy(update={"targets": (each,), **without}) for each in self.targets)

    @model_serializer(mode="wrap")
    def _written(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Return the tables as they are written in a file: `target` is one table, or a list of several."""
        found = {("target" if name == "targets" else name): value for name, value in handler(self).items()}
        forget_outlines(found.get("lens"), found.get("mount"))
        if len(found.get("target", ())) == 1:
            found["target"] = found["target"][0]
        omitted = {"before", "behind"} | (set() if self.states_effects else {"effects"})  # `effects` may be a default
        return {name: value for name, value in found.items() if value and name != "effects" or name not in omitted}

    # ---- the lens and its light ----

    @property
    def states_effects(self) -> bool:
        """True if the scene states its effects, perhaps as an empty list, instead of the default."""
        return "effects" in self.model_fields_set

    @property
    def optic(self) -> str:
        """Kind of the optic: "lens" or "mirror"."""
        return self.lens.optic

    @property
    def folded(self) -> bool:
        """True if the light reaches the targets along -z, after an odd number of mirrors behind the lens."""
        return elements.reversal(self.behind) < 0

    @property
    def index(self) -> float:
        """Refractive index of the lens at the source's main wavelength; 1 if light does not enter the solid."""
        return self.lens.index_at(self.source.main_wavelength)

    @property
    def rim(self) -> Outline:
        """Rim of the back after the lens is cut to its mount; no light passes outside this rim."""
        return self.lens.outline if self.mount is None else self.mount.rim_of(self.lens.outline).outline

    @property
    def rim_sags(self) -> tuple[float, float]:
        """Smallest and largest sag (mm) at the rim of a front that is optimised.

        Between these limits the blank keeps lens.min_thickness at the rim, and the rim stays behind the source.
        """
        lens, source = self.lens, self.source
        lowest = source.start_plane - lens.front.z if source.start_plane is not None else -math.inf
        return SEARCH_RANGE * lowest, SEARCH_RANGE * (lens.back.z - lens.front.z - lens.min_thickness)

    @property
    def light_path(self) -> LightPath:
        """The path of the light through the scene."""
        targets = dict(zip(self.target_keys, self.targets, strict=True))
        return LightPath(self.source, self.before, self.lens, behind=self.behind, targets=targets)

    @property
    def elements(self) -> tuple[tuple[str, Elements], ...]:
        """Windows and mirrors, each list with the key of its tables."""
        return ("before", self.before), ("behind", self.behind)

    def around(self, wavelength: float) -> Around | None:
        """Return the interfaces before and behind the lens at a wavelength (nm); None if there are none."""
        if not (self.before or self.behind):
            return None
        met = elements.interfaces(self.before, self.light_path.sense, wavelength)
        before = tuple(replace(interface, status_if_missed=Status.MISSED_FRONT) for interface in met)
        return before, elements.interfaces(self.behind, 1, wavelength)

    def clearance(self, highest: float) -> tuple[float, str]:
        """Return (gap, key) of the element or target next to a lens that ends at z = highest; gap (mm) < 0: overlap."""
        room = [(elements.lowest(self.behind) - highest, "behind[0].z")] if self.behind else []
        if not self.light_path.is_folded:
            for target, key in zip(self.targets, self.target_keys, strict=True):
                room.append((target.clearance(self.lens, highest), f"{key}.z"))
        return min(room)

    def flat_lens(self, net: Sides, as_wide_as: Sides | None = None) -> Lens:
        """Return the lens before tailoring, with a flat net as its back.

        net: control points per side of the back's net, or (along x, along y).  A tailored front is a net too, flat
        or as in its file; its control points have the ratio to the back's that the scene states.  as_wide_as: the
        finest net to which `net` will be refined (default: `net`), whose spans determine how far the nets extend past
        the rim.
        """
        blank, passes = self.lens, self.lens.passes
        outline, front = blank.back.lit(blank.outline), blank.flat_front(net, as_wide_as)
        back = blank.back.flat(net, net_extent(outline, as_wide_as or net))
        clear = None if back.chart.flat else (front.outline or blank.outline, outline)
        return self.assembled(Lens.between(front, back, outline, self.index, clear=clear, passes=passes))

    def assembled(self, lens: Lens) -> Lens:
        """Return the lens with the scene's windows, mirrors and mount, and with its tailored faces marked."""
        before, behind = self.around(self.source.main_wavelength) or ((), ())
        return self.as_mounted(replace(lens, before=before, behind=behind).with_tailored(*self.lens.tailored_faces))

    def as_mounted(self, lens: Lens) -> Lens:
        """Return the lens with the clear apertures that the mount leaves; the mount of a dome cuts nothing."""
        if self.mount is None or not self.lens.back.chart.flat:
            return lens
        return lens.with_clear(self.mount.clear(lens))

    def channels(self, points: int | None = None, number: int = 0) -> tuple[Channel, ...]:
        """Return the light as a weighted sum of channels; a point source of one wavelength is one channel.

        points: number of points of an extended source, divided among its lines (default: tailoring.source_points).
        number: number of the point set; other numbers give other points.
        """
        if points is None:
            points = self.tailoring.points_of_source
        return self._with_losses(channels_of(self.light, self.lens.index_at, points, number))

    def verification_channels(self) -> tuple[Channel, ...]:
        """Return the channels of a verification: an extended source has other points than in tailoring."""
        return self.channels(VERIFICATION_POINTS, VERIFICATION_SET)

    @property
    def sampler(self) -> SourceSampler | None:
        """Function of (points, seed) that samples the channels of an extended source; None for other sources."""
        if (bundles := given_channels(self.source, self.lens.index_at)) is not None:
            return SourceSampler(lambda points, seed: self._with_losses(bundles(seed)), bundles.largest_side)
        if self.source.extent is None:
            return None
        return SourceSampler(
            lambda points, seed: self._with_losses(drawn_channels(self.light, self.lens.index_at, points, seed))
        )

    def _with_losses(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        lines = [nm for nm, _ in self.source.lines]
        losses = {nm: effects.losses(self.effects, self.lens, nm) for nm in lines}
        around = {nm: self.around(nm) for nm in lines}
        own = ((c, c.source.main_wavelength) for c in channels)
        return merge_wavelengths([replace(c, losses=losses[nm], around=around[nm]) for c, nm in own])

    @property
    def light(self) -> Emitter:
        """The source, which a dome needs by the points of a sphere about its centre instead of by points of planes."""
        return self.lens.back.light(self.source, self.lens.front.surface)

    def with_source_scaled(self, share: float) -> Self:
        """Return the scene with the size of its source times `share`; 0 makes it a point or a parallel beam."""
        if self.source.extent is None:
            return self
        return self.model_copy(update={"source": self.source.scaled(share)})

    @property
    def ghost(self) -> GhostTracer | None:
        """Function that traces the light reflected twice inside the lens; None if the scene has no effect `ghost`."""
        return effects.ghost(self.effects)

    @property
    def loses_reflections(self) -> bool:
        """True if the light that Fresnel reflection takes is simulated."""
        return effects.reflection_of(self.effects) is not None

    @property
    def limits_light(self) -> bool:
        """True if [accept] or tailoring.accuracy limits the light."""
        return self.accept.limits_light or self.tailoring.accuracy is not None

    @property
    def mesh_tolerance(self) -> float:
        """Tolerance (mm) of STL and 3MF; default 1 µm, and in proportion more for a lens wider than 100 mm."""
        if self.output.mesh_tolerance is not None:
            return self.output.mesh_tolerance
        return MESH_TOLERANCE * max(1.0, 2 * max(self.lens.outline.half_extent) / 100.0)

    # ---- from and to files ----

    @property
    def files(self) -> dict[str, FileContent]:
        """Contents of all files that the scene names, by the names of their copies."""
        return {content.name: content for _, content in contents(self)}

    def changed(self, changes: Mapping[str, Any]) -> Scene:
        """Return the scene with other values, by dotted key: scene.changed({"lens.back.z": 21.0, "target.text": "HI"}).

        A value is a number, a text, a list, a record (bstcad.Sphere(8.0, 0.01)) or, for target.image, an array of
        irradiance.  None removes the key.  "target[1].text" is a key of the second of several targets.  A value
        replaces its alternatives (text, image, …).  A path is relative to the working folder.  lens.front may be your
        own bstcad.Surface; the scene contains a net within 1e-6 mm of it, inside the outline.  A source or a target of
        your own class stays; keys of such a target can be changed.  Raises SceneError.
        """
        given: dict[str, FileContent] = {}
        own: dict[str, Any] = {"source": self.source} if self.source.kind == Emitter.kind else {}
        placeholder = Collimated(self.lens.outline, self.source.wavelength, z=self.source.start_plane)
        data = _from_python(self.model_copy(update={"source": placeholder}) if own else self, "", given)
        if not self.states_effects:
            del data["effects"]
        outline = changes.get("lens.outline", self.lens.outline)
        forget_outlines(data["lens"], data.get("mount"))
        for key, value in changes.items():
            if key == "lens.front":
                value = as_front(value, outline)
            override(data, key, _from_python(value, key, given), key)
        made = _validated(data, Path("."), given)
        if any(key.startswith("source") for key in changes):
            own = {}
        own_class = any(type(target) not in (Target, AngularTarget) for target in self.targets)
        if own_class and "target" not in changes:
            pairs = zip(self.targets, made.targets, strict=True)
            own["targets"] = tuple(before.model_copy(update=dict(after)) for before, after in pairs)
        if own:
            made = made.model_copy(update=own)
            made.refuse()
        return made

    def toml(self) -> str:
        """Return the text of a file from which an equal scene is loaded; images have the file names of their copies."""
        unused = {"seed"} if self.source.extent else {"seed", "source_points"}
        optic = f"refractive index {self.index:.6g}" if self.lens.passes.enters else f"a {self.optic}"
        comment = f"# {optic}; quality {self.tailoring.quality}"
        if self.lens.back.control_points is not None:  # the settings depend on them
            settings = asdict(self.tailoring.resolved(self.lens.back.net))
            comment += ": " + ", ".join(f"{key} {value}" for key, value in settings.items() if key not in unused)
        return f"{comment}\n" + tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))


# ---- complaints on several tables ------------------------------------------------------------------------------------


def _wavefront_complaints(wave: Wave | None, source: Emitter, lens: LensBlank, accept: Accept) -> Iterator[str]:
    """Yield complaints about a wave that the lens cannot give to this light, or that has no rays."""
    if wave is None:
        if accept.wavefront is not None:
            yield "accept.wavefront: the scene has no [wavefront] to limit; add that table, or remove this key"
        return
    if source.extent is not None:
        sizes = " and ".join(f"source.{key}" for key, _, _ in source.sizes())
        yield f"wavefront: light of an extended source ({sizes}) has no single wavefront; make it {source.simple_name}"
    yield from (f"wavefront.{complaint}" for complaint in wave.complaints(lens.back.z))
    if isinstance(wave, ZernikeWave) and not wave.steepest(source.main_wavelength) < math.sin(MAX_RAY_ANGLE):
        yield "wavefront.coefficients: the wave is too steep to have rays; make them smaller, or the radius larger"


def _method_complaints(scene: Scene) -> Iterator[str]:
    """Yield complaints about a method that works for one picture only, if the scene has several goals."""
    goals = len(scene.targets) + (scene.wavefront is not None)
    who, key = quality.BASELINES.get(scene.tailoring.chosen_method, ("", ""))
    if who and goals > 1:
        yield f"{key}: {who} works for one picture, and the scene has {goals} goals; choose another {key}"


def _doubts_of_goals(scene: Scene) -> Iterator[str]:
    """Yield warnings: with fewer goals than tailored faces a face is idle; with more goals none is met exactly."""
    lens, wave = scene.lens, scene.wavefront
    different: list[Target] = []
    for target in scene.targets:  # light parallel to the axis makes one picture on every plane, which is one goal
        alike = target.model_copy(update={"z": 0.0, "weight": 1.0})
        if alike not in different or not (isinstance(wave, PlaneWave) and wave.normal == (0.0, 0.0, 1.0)):
            different.append(alike)
    pictures, shaped = len(different), lens.tailored_faces
    goals = pictures + (wave is not None)
    if goals < len(shaped) and not lens.passes.reflects:  # light crosses the other face of such a mirror twice
        idle, busy = shaped
        yield (
            f"lens.{idle}.optimise: for one picture the {busy} is tailored, and the {idle} hardly changes; add a "
            "second [[target]] or a [wavefront], or set lens.back.optimise = false to have the front tailored alone"
        )
    if goals > len(shaped):
        faces, remedy = "two tailored faces", "set their weights, or remove a goal"
        if len(shaped) == 1:
            faces, remedy = "one tailored face", "a mirror has no second face, so set the weights"
            if not lens.back.chart.flat:
                remedy = "a dome has no second face, so set the weights"
            elif "front" in lens.passes.faces:
                front = f'lens.front = {{ kind = "bspline", z = {lens.front.z:g}, optimise = true }}'
                remedy = f"tailor the front too, {front}" if lens.back.optimise else "remove lens.back.optimise = false"
        key = "target" if pictures > 1 else "wavefront"
        yield f"{key}: {faces} cannot meet {goals} goals exactly, only by weighted least squares; {remedy}"


def _mesh_complaints(tolerance: float | None, lens: LensBlank) -> Iterator[str]:
    """Yield complaints about a mesh tolerance (mm) below the rounding of float32, in which STL stores coordinates."""
    size = max(*lens.outline.half_extent, abs(lens.front.z), abs(lens.back.z))
    if tolerance is not None and tolerance < (smallest := FINEST_MESH * size):
        rounded = f"STL rounds coordinates of {size:g} mm by up to {FLOAT32_ROUNDING * size:.1g} mm"
        yield f"output.mesh_tolerance: {tolerance:g} mm is too fine, as {rounded}; give {smallest:.2g} mm or more"


# ---- files and changes -----------------------------------------------------------------------------------------------


def load(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Read the scene in a TOML file; overrides {"lens.back.z": "20.0"} replace values of the file.

    The text of an override is read as a TOML value, or else as a text.  Raises SceneError.
    """
    path = Path(path)
    return of_text(*scene_file.read(path), path, overrides)


def of_text(
    text: str, data: dict[str, Any], path: Path, overrides: Mapping[str, Any] | None = None, bounds: Sequence[Path] = ()
) -> Scene:
    """Read the scene from the text of a TOML file; overrides: as for `load`.

    data: the tables of the text.  path: its file, which need not exist.  bounds: folders; a path into one of them must
    not lead out of them by symbolic links.  Raises SceneError, with the line of the fault as a note.
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
    data: dict[str, Any], folder: Path, given: Mapping[str, FileContent] | None = None, bounds: Sequence[Path] = ()
) -> Scene:
    """Return the scene with the tables `data` of a file.

    given: contents of files by their names; other files are read, relative to `folder`.  bounds: see `of_text`.
    """
    for key in data["tolerances"] if isinstance(data.get("tolerances"), dict) else ():
        table = "lens" if key.endswith("_thickness") else "accept"
        raise SceneError(f"tolerances.{key}: this table is now called [{table}]; write {table}.{key}")
    if isinstance(data.get("part"), dict) and type(date := data["part"].get("date")) is datetime.date:
        data["part"]["date"] = date.isoformat()  # TOML reads a date as an object
    if isinstance(listed := data.get("target"), list) and len(listed) == 1:  # messages call a single target "target"
        [data["target"]] = listed
    scene_file.check_plain(data)
    complete(data.get("lens"), data.get("mount"))
    for outline in OUTLINES:
        for key, table in tables_at(data, outline):
            _circle(table, key)
    try:
        # Validation from JSON is strict (no "8" for 8.0, no true for 1) and still accepts lists for tuples.
        context = {"folder": folder, "contents": given or {}, "bounds": bounds}
        scene = Scene.model_validate_json(json.dumps(data), strict=True, context=context)
    except ValidationError as error:
        raise SceneError(explain(error, data)) from None
    for key, target in zip(scene.target_keys, scene.targets, strict=True):
        try:
            target.irradiance()  # finds a damaged or black picture before any work starts
        except SceneError as error:
            raise SceneError(with_target_key(str(error), key)) from None
    return scene


def _circle(outline: Any, key: str) -> None:
    """Replace the diameter of a circle in the table `outline` by its radius, the field of the record."""
    if not isinstance(outline, dict):
        return
    if key == "lens.front.outline" and outline.setdefault("shape", "circle") != "circle":
        raise SceneError(f'{key}.shape: must be "circle", as the edge of the front must be level; write "circle"')
    if outline.get("shape") not in ("circle", "rectangle"):
        raise SceneError(f'{key}.shape: must be "circle" or "rectangle"; write one of them')
    if outline["shape"] == "circle" and "diameter" in outline:
        if "radius" in outline:
            raise SceneError(f"{key}: has both radius and diameter; give one of them")
        if type(diameter := outline.pop("diameter")) not in (int, float):
            raise SceneError(f"{key}.diameter: {diameter!r} is not a number; write one, without quotes")
        outline["radius"] = diameter / 2


def _from_python(value: Any, key: str, given: dict[str, FileContent]) -> Any:
    """Return a value of Python (record, array, path, tuple) under a dotted key as a TOML value; None stays None.

    The content of a file goes into `given`, under a name that no file can have, and that name is returned.
    """
    if hasattr(value, "__array__") and np.ndim(value) and IMAGE_KEY.fullmatch(key):
        value = _image(np.asarray(value), key.removesuffix(".image"))
        value = of_beam(value) if key.startswith("source") else value
    if isinstance(value, FileContent):
        name = f"\0{len(given)}"
        given[name] = value
        return name
    if isinstance(value, AngularTarget):
        value = {**dict(value), "z": None if value.z == FAR_Z else value.z}
    elif isinstance(value, BaseModel):
        value = {field.alias or name: getattr(value, name) for name, field in type(value).model_fields.items()}
    elif is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "__array__"):
        value = np.asarray(value).tolist()  # includes a single number of numpy or torch
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
    raise SceneError(f"{key}: a value of type {kind} is not possible; give a number, a text, a list or a record")


def _image(values: np.ndarray, key: str) -> Picture:
    try:
        return picture.from_array(values)
    except SceneError as error:
        raise SceneError(with_target_key(str(error), key)) from None


if __name__ == "__main__":
    sys.stdout.buffer.write(json.dumps(of_model(Scene), indent=1, ensure_ascii=False).encode() + b"\n")
