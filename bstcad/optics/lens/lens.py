"""The lens: its interfaces in the order of the light, the outline of the solid, and the freeform interfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.passes import LENS, MIRROR, Face, Passes
from bstcad.optics.surfaces.bspline import BSplineSurface, is_net, require_net
from bstcad.optics.surfaces.outlines import EVERYWHERE, Outline
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.surfaces.sides import Sides
from bstcad.optics.surfaces.surfaces import Surface, sag


class LensLosses(Protocol):
    """Losses of a lens at one wavelength (losses.Losses)."""

    def on(self, interfaces: Sequence[Interface]) -> tuple[Interface, ...]:
        """Return the interfaces with their losses."""


@dataclass(frozen=True)
class Lens:
    """A solid between two surfaces, its sides parallel to the axis, with interfaces before and behind it.

    A lens refracts: light travels along +z, enters through the front and leaves through the back.  A mirror reflects
    at its back: light comes from above, along -z, and leaves along +z; its front, the rear of the plate, gets no light.
    A second-surface mirror reflects at its front, and light crosses its back twice.
    `passes` states which face acts on the light in which order; a face that light meets twice is two interfaces.
    Rays are traced through `interfaces`; the surfaces that tailoring shapes are those of `tailored_numbers`.
    """

    front: Surface  # lower surface, at smaller z
    back: Surface  # upper surface, at larger z
    outline: Outline  # outline of front and back
    index: float  # refractive index at the design wavelength; unused for a first-surface mirror
    reflects: bool = False  # True if a face reflects; without `own_passes` it selects MIRROR (True) or LENS (False)
    losses: LensLosses | None = None  # losses at its faces and in its glass; None: no losses
    clear: tuple[Outline, Outline] | None = None  # clear apertures (front, back); None: see `apertures`
    before: tuple[Interface, ...] = ()  # interfaces before the solid, such as a window
    behind: tuple[Interface, ...] = ()  # interfaces behind the solid, such as a fold mirror
    tailored: tuple[int, ...] | None = None  # numbers of the interfaces that tailoring shapes; None: the back alone
    own_passes: Passes | None = None  # passes of the light through the solid; None: determined by `reflects`

    def __post_init__(self) -> None:
        if self.own_passes is not None:
            object.__setattr__(self, "reflects", self.own_passes.reflects)
            if self.own_passes in (LENS, MIRROR):  # stated by `reflects` alone, so that equal lenses compare equal
                object.__setattr__(self, "own_passes", None)

    @cached_property
    def interfaces(self) -> tuple[Interface, ...]:
        """All interfaces, in the order of the light."""
        own = self._lossless
        return (*self.before, *(own if self.losses is None else self.losses.on(own)), *self.behind)

    @property
    def passes(self) -> Passes:
        """Passes of the light through the solid: the faces, in the order in which they act on it."""
        return self.own_passes or (MIRROR if self.reflects else LENS)

    @property
    def _lossless(self) -> tuple[Interface, ...]:
        """Interfaces of the solid without losses, one for each step of `passes`."""
        surfaces = {"front": self.front.optical, "back": self.back}
        apertures = dict(zip(("front", "back"), self.apertures, strict=True))
        lost = (Status.MISSED_FRONT, *(Status.VIGNETTED for _ in self.passes.steps[1:]))
        return tuple(
            Interface(surfaces[step.face], apertures[step.face], law, missed)
            for step, law, missed in zip(self.passes.steps, self.passes.laws(self.index), lost, strict=True)
        )

    @property
    def front_net(self) -> BSplineSurface:
        """Tailored front; TypeError if the front is not a net."""
        return require_net(self.front)

    @property
    def back_net(self) -> BSplineSurface:
        """Back, which is a net in every scene; TypeError for another surface, which only a script can give."""
        return require_net(self.back)

    @property
    def optical_faces(self) -> dict[str, Surface]:
        """Faces that light meets, by name, in the order of the light; the back alone for a first-surface mirror."""
        return {face: self.front if face == "front" else self.back for face in self.passes.faces}

    @property
    def deflection(self) -> float:
        """Largest ratio of the deflection of a ray at a face to the slope angle of the face, for small angles."""
        return max(self.passes.deflection(face, self.index) for face in self.passes.faces)

    def number_of(self, face: Face) -> int:
        """Return the number of the first interface of a face of the solid; ValueError if no light meets the face."""
        return len(self.before) + [step.face for step in self.passes.steps].index(face)

    @property
    def solid(self) -> slice:
        """Numbers of the interfaces that are faces of the solid."""
        return slice(len(self.before), len(self.before) + len(self.passes.steps))

    @property
    def tailored_numbers(self) -> tuple[int, ...]:
        """Numbers of the interfaces whose nets tailoring shapes, in the order of the light."""
        return (self.number_of("back"),) if self.tailored is None else self.tailored

    def is_tailored(self, face: Face) -> bool:
        """Return True if tailoring shapes this face of the solid."""
        first = len(self.before)
        return any(first + k in self.tailored_numbers for k in self.passes.numbers_of(face))

    @property
    def has_two_tailored_faces(self) -> bool:
        """True if tailoring shapes front and back of a lens, which light crosses one after the other."""
        return self.is_tailored("front") and self.is_tailored("back") and not self.passes.reflects

    def with_tailored(self, *faces: Face) -> Lens:
        """Return the lens in which tailoring shapes these faces of the solid, given in the order of the light."""
        return replace(self, tailored=tuple(self.number_of(face) for face in faces))

    @property
    def nets(self) -> tuple[BSplineSurface, ...]:
        """Surfaces of the interfaces in `tailored_numbers`; TypeError if one is not a net."""
        return tuple(self.interfaces[k].net for k in self.tailored_numbers)

    @property
    def front_vertex(self) -> float:
        """z (mm) where the front crosses the axis; a tailored net has another reference plane for its heights."""
        return float(sag(self.front, 0.0, 0.0)) if self.is_tailored("front") else float(self.front.z)

    @property
    def last_tailored(self) -> Interface:
        """Last freeform interface, which realises the transport map in stage 1."""
        return self.interfaces[self.tailored_numbers[-1]]

    def with_front(self, front: Surface) -> Lens:
        """Return the lens with another front."""
        return replace(self, front=front)

    def with_back(self, back: Surface) -> Lens:
        """Return the lens with another back."""
        return replace(self, back=back)

    def with_last_net(self, net: BSplineSurface) -> Lens:
        """Return the lens with another surface in place of the last of `nets`."""
        return self._with_surface(self.tailored_numbers[-1], net)

    def with_nets(self, nets: Iterable[BSplineSurface]) -> Lens:
        """Return the lens with other surfaces in place of `nets`."""
        lens = self
        for k, net in zip(self.tailored_numbers, nets, strict=True):
            lens = lens._with_surface(k, net)
        return lens

    def refined(self, sides: Sides) -> Lens:
        """Return the lens with its `nets` refined to this number of control points per side, or (along x, along y)."""
        return self.with_nets(net.refined(sides) for net in self.nets)

    def with_heights(self, heights: Iterable[Tensor]) -> Lens:
        """Return the lens with other heights (mm) of its `nets`."""
        return self.with_nets(replace(net, heights=h) for net, h in zip(self.nets, heights, strict=True))

    def _with_surface(self, k: int, surface: Surface) -> Lens:
        solid, steps = self.solid, self.passes.steps
        if solid.start <= k < solid.stop:
            return self.with_back(surface) if steps[k - solid.start].face == "back" else self.with_front(surface)
        around = list(self.interfaces)
        around[k] = replace(around[k], surface=surface)
        return replace(self, before=tuple(around[: solid.start]), behind=tuple(around[solid.stop :]))

    @cached_property
    def plan(self) -> Outline:
        """Outline of the lens seen along the axis (mm); a circle for a dome, whose `outline` is one of directions."""
        return self.back.plan(self.outline)

    @property
    def shares_outline(self) -> bool:
        """True if front and back end over one outline, in one chart; otherwise the lens stands on a base (base.py)."""
        return self.front.chart == self.back.chart

    @property
    def like(self) -> Tensor:
        """Tensor of the precision and device of the lens: the heights of a net, else an empty one (float64, CPU)."""
        last = self.last_tailored.surface
        return last.heights if is_net(last) else torch.zeros(0, dtype=torch.float64)

    @property
    def apertures(self) -> tuple[Outline, Outline]:
        """Clear apertures of front and back; light that meets a face outside its clear aperture is lost."""
        return self.clear or (self.front.outline or self.outline, self.outline)

    @property
    def entrance(self) -> Surface:
        """Surface that light meets first; rays are launched through the plane of its vertex."""
        return self.interfaces[0].surface

    def unbounded(self) -> Lens:
        """Return the lens with unlimited apertures of the solid: they stop no ray."""
        return replace(self, outline=EVERYWHERE, clear=(EVERYWHERE, EVERYWHERE))

    def with_apertures_scaled(self, by: float) -> Lens:
        """Return the lens with the clear apertures of the solid scaled by a factor."""
        front, back = self.apertures
        return replace(self, clear=(front.scaled(by), back.scaled(by)))

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Lens:
        """Return the lens with its tensors in another precision or on another device."""
        return self._map_surfaces(lambda surface: surface.to(dtype, device))

    def plain(self) -> Lens:
        """Return the lens in float64 on the CPU, without gradient."""
        return self._map_surfaces(lambda surface: surface.plain())

    def _map_surfaces(self, change: Callable[[Surface], Surface]) -> Lens:
        before, behind = (
            tuple(replace(i, surface=change(i.surface)) for i in around) for around in (self.before, self.behind)
        )
        return replace(self, front=change(self.front), back=change(self.back), before=before, behind=behind)
