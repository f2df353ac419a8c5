"""What a scene says, as frozen records in mm, degrees and nm; whether it is possible is for limits.py to say.

The records are the engine's own nouns (bstcad.optics) where one exists.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from bstcad.optics.channels import Channel, channels_of, drawn_channels, merged
from bstcad.optics.lens import Lens
from bstcad.optics.media import refractive_index
from bstcad.optics.outlines import Outline
from bstcad.optics.sources import Collimated, Point
from bstcad.scene import effects
from bstcad.scene.effects import Effects
from bstcad.scene.front import Front
from bstcad.scene.machining import Bounds, bounds_of
from bstcad.scene.mount import Mount
from bstcad.scene.part import Part
from bstcad.scene.quality import SHOWN_DRAW, SHOWN_POINTS, Tailoring
from bstcad.scene.target import OutlineField, Record, Target
from bstcad.scene.tolerance import Tolerancing

if TYPE_CHECKING:
    from bstcad.optics.measure import Draw, GhostLight

MESH = 1e-3  # mm; how far facets may lie from a lens of up to 100 mm


class Back(Record):
    """The freeform face before tailoring: a flat B-spline net at z."""

    kind: Literal["bspline"] = "bspline"
    z: float  # mm
    control_points: int  # along each side
    reflect: bool = False  # a mirror: light comes from above it, along -z, and is thrown back along +z


class LensBlank(Record):
    """The lens before tailoring: light enters through the front and leaves through the back.

    Or the mirror: a plate whose back, its upper face, reflects, and whose front is its rear.
    """

    material: str | None = None  # of a lens exactly one of material and index, of a mirror neither
    index: float | None = None  # at the source's one wavelength; of several lines only a material knows it
    outline: OutlineField
    front: Front
    back: Back
    # What the back keeps to everywhere while it is tailored (machining.py); None: there is no such bound.
    tool_radius: float | None = None  # mm; of a valley of the back at least, so that the tool fits into it
    mould: bool = False  # the tool cuts a mould of the back, whose valleys are the ridges of the lens
    max_slope: float | None = None  # degrees; of the back's tangent plane against z = const
    min_thickness: float = 0.5  # mm; between front and back, along z: the back is moved clear of the front by so much
    max_thickness: float | None = None  # mm
    edge_thickness: float | None = None  # mm; of the rim, at least

    @model_validator(mode="after")
    def _one_medium(self) -> Self:
        given = [name for name in ("material", "index") if getattr(self, name) is not None]
        if self.back.reflect and given:
            raise ValueError(f"light does not enter a mirror (back.reflect), so it has no {given[0]}; remove it")
        if not self.back.reflect and len(given) != 1:
            raise ValueError('needs exactly one of material and index; give for example material = "PMMA"')
        return self


class Accept(Record):
    """What the report holds the lens to."""

    rrmsd: float | None = None  # box pixels, through the re-read STEP; None: verify.checks.POOR
    form: float = 1e-6  # mm, STEP against the optimised surface
    efficiency: float | None = None  # least flux inside the target over flux that leaves the back
    light_on_target: float | None = None  # least part on it of the light that enters the lens; None: verify.checks.HALF
    leak: float | None = None  # most of the light on the target that may fall where it wants none
    decentre: float | None = None  # mm; of a measured part in the frame of its cloud; None: stated, not judged


class Output(Record):
    """What the written files are like."""

    mesh_tolerance: float | None = None  # mm; distance of the STL's and 3MF's facets from the lens; see Scene
    export: tuple[
        Literal["sag", "points", "zemax", "turning", "dxf", "svg", "preview", "datasheet"], ...
    ] = ()  # files for the shop


class Wanted(Record):
    """A source, a lens blank, a target, and how well the one is to make the other."""

    name: str  # also the output folder's
    title: str = ""
    source: Annotated[Collimated | Point, Field(discriminator="kind")]
    lens: LensBlank
    target: Target
    tailoring: Tailoring = Tailoring()
    effects: Effects = ()
    accept: Accept = Accept()
    tolerance: Tolerancing = ()  # of bstcad tolerance: how exactly the lens is made, mounted and lit
    output: Output = Output()
    part: Part = Part()  # what lens.step says of it besides its shape
    mount: Mount | None = None  # how it is held; with it there is part.step

    @property
    def index(self) -> float:
        """The lens's refractive index at the source's main wavelength; 1 for a mirror, which light does not enter."""
        return self.index_at(self.source.main_wavelength)

    def index_at(self, wavelength: float) -> float:
        """The same at any wavelength (nm)."""
        if self.lens.back.reflect:
            return 1.0
        if self.lens.index is not None:
            return self.lens.index
        return refractive_index(self.lens.material, wavelength)

    @property
    def rim(self) -> Outline:
        """On what the back ends, in its mount if there is one: no light gets through beyond."""
        return self.lens.outline if self.mount is None else self.mount.rim_of(self.lens.outline).outline

    def as_mounted(self, lens: Lens) -> Lens:
        """A lens of this scene, with the clear apertures that the mount leaves of its faces."""
        return lens if self.mount is None else replace(lens, clear=self.mount.clear(lens))

    @property
    def optic(self) -> str:
        """What is to be made: "lens" or "mirror"."""
        return "mirror" if self.lens.back.reflect else "lens"

    def channels(self, points: int | None = None, draw: int = 0) -> tuple[Channel, ...]:
        """The light as a weighted sum; a point or a collimated beam of one wavelength is one channel.

        points: of an extended source, shared out among its lines (default: tailoring.source_points); draw: which ones.
        """
        if points is None:
            points = self.tailoring.resolved(self.lens.back.control_points).source_points
        return self._with_losses(channels_of(self.source, self.index_at, points, draw))

    @property
    def draw(self) -> Draw | None:
        """How a measurement draws points of an extended source, by their number and a seed; None: it is a point."""
        if self.source.extent is None:
            return None
        return lambda points, seed: self._with_losses(drawn_channels(self.source, self.index_at, points, seed))

    def _with_losses(self, found: tuple[Channel, ...]) -> tuple[Channel, ...]:
        losses = {nm: effects.losses(self.effects, self.lens, nm) for nm, _ in self.source.lines}
        return merged([replace(c, losses=losses[c.source.wavelength]) for c in found])

    def of_size(self, share: float) -> Self:
        """The same with a source of so much of its size: 0 makes it a point, or a beam of parallel light."""
        if self.source.extent is None:
            return self
        return self.model_copy(update={"source": self.source.of_size(share)})

    def judging_channels(self) -> tuple[Channel, ...]:
        """The same light for a verification: more points of an extended source, and other ones than tailoring knows."""
        return self.channels(SHOWN_POINTS, SHOWN_DRAW)

    @property
    def bounds(self) -> Bounds | None:
        """What the back has to keep to, so that it can be made; None: nothing."""
        return bounds_of(self)

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
