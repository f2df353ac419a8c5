"""The tables of a scene, as frozen records in mm, degrees and nm; check.py says whether it can be built.

The records are the engine's own nouns (bstcad.optics) where one exists.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal, Self

import torch
from pydantic import Field

from bstcad.optics.channels import Channel, channels_of, drawn_channels, merged
from bstcad.optics.key import Key
from bstcad.optics.lens import Lens
from bstcad.optics.media import refractive_index
from bstcad.optics.outlines import Outline
from bstcad.optics.sources import Collimated, Point
from bstcad.scene import effects
from bstcad.scene.blank import Bounds, LensBlank
from bstcad.scene.effects import Effects
from bstcad.scene.fields import Record
from bstcad.scene.mount import Mount
from bstcad.scene.part import Part
from bstcad.scene.quality import JUDGE_DRAW, JUDGE_POINTS, Tailoring
from bstcad.scene.target import Target
from bstcad.scene.tolerance import Tolerancing

if TYPE_CHECKING:
    from bstcad.optics.measure import Draw, GhostLight

MESH = 1e-3  # mm; how far facets may lie from a lens of up to 100 mm


class Accept(Record):
    """Limits of the checks in the report; None: the check has a default limit, or only states its value."""

    rrmsd: Annotated[
        float | None,
        Key("Greatest RRMSD of the irradiance; 0.25 if absent.", "", 1e-6, 10.0),
    ] = None
    form: Annotated[float, Key("Greatest distance of lens.step from the tailored surface.", "mm", 1e-12, 1.0)] = 1e-6
    efficiency: Annotated[
        float | None, Key("Least share on the target of the light that leaves the back.", "", 0.0, 1.0)
    ] = None
    light_on_target: Annotated[
        float | None, Key("Least share on the target of the light in the lens; 0.5 if absent.", "", 0.0, 1.0)
    ] = None
    leak: Annotated[
        float | None,
        Key("Greatest share of the light where the target is dark.", "", 0.0, 1.0),
    ] = None
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


class SceneModel(Record):
    """The tables of a scene: a source, a lens blank, a target, and how well the one is to make the other."""

    name: Annotated[str, Key("Name of the design and of its folder.", example="my-lens")]
    title: Annotated[str, Key("One line for the report.")] = ""
    source: Annotated[Collimated | Point, Field(discriminator="kind"), Key("The light.")]
    lens: Annotated[LensBlank, Key("The lens before tailoring, and the bounds on its back.")]
    target: Annotated[Target, Key("The picture and where it falls.")]
    tailoring: Annotated[Tailoring, Key("How much work goes into the surface.")] = Tailoring()
    effects: Annotated[Effects, Key("What is simulated beyond refraction: [[effects]] tables.")] = ()
    accept: Annotated[Accept, Key("The limits that the report holds the design to.")] = Accept()
    tolerance: Annotated[Tolerancing, Key("How exactly the lens is made, mounted and lit: [[tolerance]] tables.")] = ()
    output: Annotated[Output, Key("Accuracy of the meshes, and files for the shop.")] = Output()
    part: Annotated[Part, Key("The title block that lens.step states.")] = Part()
    mount: Annotated[Mount | None, Key("How the lens is held; with it there is part.step.")] = None

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

    def flat_lens(self, m: int, dtype: torch.dtype = torch.float64, device: str | torch.device = "cpu") -> Lens:
        """The lens before tailoring, its back a flat net of m x m control points.

        The net of a round lens reaches two spans past the rim, where x(t) is linear.
        """
        from bstcad.optics.bspline import BSplineSurface  # loads numba, which a scene alone does not need

        outline = self.lens.outline
        reach = (m - 1) / (m - 5) if outline.is_round else 1.0
        half_x, half_y = (reach * half for half in outline.half_extent)
        heights = torch.zeros((m, m), dtype=dtype, device=device)
        back = BSplineSurface(self.lens.back.z, heights, (-half_x, half_x), (-half_y, half_y))
        front = self.lens.front.surface.to(heights.dtype, device)
        return self.as_mounted(Lens(front, back, outline, self.index, reflects=self.lens.back.reflect))

    def as_mounted(self, lens: Lens) -> Lens:
        """A lens of this scene, with the clear apertures that the mount leaves of its faces."""
        return lens if self.mount is None else replace(lens, clear=self.mount.clear(lens))

    @property
    def optic(self) -> str:
        """What is to be made: "lens" or "mirror"."""
        return self.lens.optic

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

    def with_source_scaled(self, share: float) -> Self:
        """The scene with a source of this share of its size: 0 makes it a point, or a beam of parallel light."""
        if self.source.extent is None:
            return self
        return self.model_copy(update={"source": self.source.scaled(share)})

    def judging_channels(self) -> tuple[Channel, ...]:
        """The same light for a verification: more points of an extended source, and other ones than tailoring knows."""
        return self.channels(JUDGE_POINTS, JUDGE_DRAW)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the back keeps to, so that it can be made; None: there are none."""
        return self.lens.bounds

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
