"""The lens: the interfaces that light crosses, the outline of the solid, and which interfaces are freeform."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.interfaces import Interface
from bstcad.optics.outlines import EVERYWHERE, Outline
from bstcad.optics.passes import LENS, MIRROR, Face, Passes
from bstcad.optics.rays import Status
from bstcad.optics.sides import Sides
from bstcad.optics.surfaces import Surface, sag


class Dimming(Protocol):
    """The losses of a lens (losses.Losses)."""

    def on(self, interfaces: Sequence[Interface]) -> tuple[Interface, ...]:
        """The same interfaces, each with its losses."""


@dataclass(frozen=True)
class Lens:
    """A solid between two surfaces, in air, its sides parallel to the axis; and interfaces before and behind it.

    A lens refracts: light travels along +z, enters through the front and leaves through the back.  A mirror reflects
    at its back: light comes from above, along -z, and leaves along +z; its front is the rear of the plate, and dark.
    A second-surface mirror reflects at its front, and light crosses its back twice.
    What light does at which face stands in `passes`, and a face that it meets twice is two of the interfaces.
    Whoever follows light walks `interfaces`; whoever searches surfaces goes by `freeform`.
    """

    front: Surface
    back: Surface
    outline: Outline  # both faces of the solid end on it
    index: float  # refractive index at the design wavelength; of a mirror that no light enters it does not matter
    reflects: bool = False  # does a face reflect?  Without `way` True says a mirror, False a lens
    losses: Dimming | None = None  # losses at its faces and in its glass; None: no flux is lost there
    clear: tuple[Outline, Outline] | None = None  # apertures of front and back that pass light; None: the outline
    before: tuple[Interface, ...] = ()  # that light crosses before the solid, such as a window
    behind: tuple[Interface, ...] = ()  # and behind it, such as a fold mirror
    shaped: tuple[int, ...] | None = None  # numbers of the interfaces that tailoring shapes; None: the back alone
    way: Passes | None = None  # passes of the light through the solid, if neither a lens's nor a mirror's

    def __post_init__(self) -> None:
        if self.way is not None:
            object.__setattr__(self, "reflects", self.way.reflects)
            if self.way in (LENS, MIRROR):  # said by `reflects` alone, so that equal lenses are equal
                object.__setattr__(self, "way", None)

    @cached_property
    def interfaces(self) -> tuple[Interface, ...]:
        """All that light crosses, in its order."""
        own = self._lossless
        return (*self.before, *(own if self.losses is None else self.losses.on(own)), *self.behind)

    @property
    def passes(self) -> Passes:
        """The passes of the light through the solid."""
        return self.way or (MIRROR if self.reflects else LENS)

    @property
    def _lossless(self) -> tuple[Interface, ...]:
        """The faces of the solid that light meets, at each pass."""
        surfaces = {"front": self.front.optical, "back": self.back}
        apertures = dict(zip(("front", "back"), self.apertures, strict=True))
        lost = (Status.MISSED_FRONT, *(Status.VIGNETTED for _ in self.passes.steps[1:]))
        return tuple(
            Interface(surfaces[step.face], apertures[step.face], law, missed)
            for step, law, missed in zip(self.passes.steps, self.passes.laws(self.index), lost, strict=True)
        )

    @property
    def optical_faces(self) -> dict[str, Surface]:
        """The faces of the solid that light meets, by name, in the order of light: of a mirror the back alone."""
        return {face: self.front if face == "front" else self.back for face in self.passes.faces}

    @property
    def deflection(self) -> float:
        """The largest angle by which a face of it deflects a ray, over the slope angle of the face, both small."""
        return max(self.passes.deflection(face, self.index) for face in self.passes.faces)

    def number_of(self, face: Face) -> int:
        """Return which of the interfaces a face of the solid is first; ValueError for one that no light meets."""
        return len(self.before) + [step.face for step in self.passes.steps].index(face)

    @property
    def solid(self) -> slice:
        """The numbers of the interfaces that are faces of the solid."""
        return slice(len(self.before), len(self.before) + len(self.passes.steps))

    @property
    def freeform(self) -> tuple[int, ...]:
        """The numbers of the interfaces that are nets which tailoring shapes, in the order of the light."""
        return (self.number_of("back"),) if self.shaped is None else self.shaped

    def shapes(self, face: Face) -> bool:
        """Does tailoring shape this face of the solid?"""
        first = len(self.before)
        return any(first + k in self.freeform for k in self.passes.numbers_of(face))

    @property
    def shapes_both(self) -> bool:
        """Does tailoring shape front and back of the solid, which light crosses one after the other?"""
        return self.shapes("front") and self.shapes("back") and not self.passes.reflects

    def shaping(self, *faces: Face) -> Lens:
        """Return the same lens, of which tailoring shapes these faces of the solid, in the order of the light."""
        return replace(self, shaped=tuple(self.number_of(face) for face in faces))

    @property
    def nets(self) -> tuple[BSplineSurface, ...]:
        """The surfaces of `freeform`."""
        interfaces = self.interfaces
        return tuple(interfaces[k].surface for k in self.freeform)

    @property
    def front_vertex(self) -> float:
        """z (mm) where the front crosses the axis; the heights of a net that is tailored are counted from elsewhere."""
        return float(sag(self.front, 0.0, 0.0)) if self.shapes("front") else float(self.front.z)

    @property
    def last_freeform(self) -> Interface:
        """The last freeform interface, which follows a transport map in stage 1."""
        return self.interfaces[self.freeform[-1]]

    def with_front(self, front: Surface) -> Lens:
        """The lens with another front."""
        return replace(self, front=front)

    def with_back(self, back: Surface) -> Lens:
        """The lens with another back."""
        return replace(self, back=back)

    def with_last_net(self, net: BSplineSurface) -> Lens:
        """The lens with another surface in place of the last of `nets`."""
        return self._with_surface(self.freeform[-1], net)

    def with_nets(self, nets: Iterable[BSplineSurface]) -> Lens:
        """The lens with other surfaces in place of `nets`."""
        lens = self
        for k, net in zip(self.freeform, nets, strict=True):
            lens = lens._with_surface(k, net)
        return lens

    def refined(self, sides: Sides) -> Lens:
        """The same lens with so many control points a side, or along x and along y, in each of its `nets`."""
        return self.with_nets(net.refined(sides) for net in self.nets)

    def with_heights(self, heights: Iterable[Tensor]) -> Lens:
        """The lens whose `nets` have other heights (mm)."""
        return self.with_nets(replace(net, heights=h) for net, h in zip(self.nets, heights, strict=True))

    def _with_surface(self, k: int, surface: Surface) -> Lens:
        solid, steps = self.solid, self.passes.steps
        if solid.start <= k < solid.stop:
            return self.with_back(surface) if steps[k - solid.start].face == "back" else self.with_front(surface)
        name, at = ("before", k) if k < solid.start else ("behind", k - solid.stop)
        around = list(getattr(self, name))
        around[at] = replace(around[at], surface=surface)
        return replace(self, **{name: tuple(around)})

    @property
    def like(self) -> Tensor:
        """A tensor of the precision and on the device of the lens: the heights of a net, else float64 on the CPU."""
        last = self.nets[-1]
        return last.heights if last.is_net else torch.zeros(0, dtype=torch.float64)

    @property
    def apertures(self) -> tuple[Outline, Outline]:
        """The clear apertures of front and back: light that meets a face outside of its own is lost."""
        return self.clear or (self.front.outline or self.outline, self.outline)

    @property
    def entrance(self) -> Surface:
        """The surface that light meets first; the plane through its vertex is where rays are counted."""
        return self.interfaces[0].surface

    def unbounded(self) -> Lens:
        """The same solid without an edge: no light misses its faces."""
        return replace(self, outline=EVERYWHERE, clear=(EVERYWHERE, EVERYWHERE))

    def grown(self, by: float) -> Lens:
        """The same surfaces, the clear apertures of the solid larger by a factor."""
        return replace(self, clear=tuple(aperture.scaled(by) for aperture in self.apertures))

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Lens:
        """The same lens with its tensors in another precision or on another device."""
        return self._each(lambda surface: surface.to(dtype, device))

    def plain(self) -> Lens:
        """The same lens in float64 on the CPU, without gradient."""
        return self._each(lambda surface: surface.plain())

    def _each(self, change) -> Lens:
        before, behind = (
            tuple(replace(i, surface=change(i.surface)) for i in around) for around in (self.before, self.behind)
        )
        return replace(self, front=change(self.front), back=change(self.back), before=before, behind=behind)
