"""The lens: its interfaces in the order of the light, the outline of the solid, and the freeform interfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor

from bstcad.optics.lens.interfaces import Interface
from bstcad.optics.lens.passes import BACK, FRONT, LENS, Face, Passes
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

    faces: tuple[Face, ...]  # faces of the solid; the lowest, at smallest z, first
    outline: Outline  # outline of the faces
    index: float  # refractive index at the design wavelength; unused for a first-surface mirror
    passes: Passes = LENS  # passes of the light through the solid: its faces, in the order in which they act on it
    losses: LensLosses | None = None  # losses at its faces and in its glass; None: no losses
    before: tuple[Interface, ...] = ()  # interfaces before the solid, such as a window
    behind: tuple[Interface, ...] = ()  # interfaces behind the solid, such as a fold mirror
    tailored: tuple[int, ...] | None = None  # numbers of the interfaces that tailoring shapes; None: the back alone

    @classmethod
    def between(
        cls, front: Surface, back: Surface, outline: Outline, index: float, *,
        clear: Sequence[Outline] | None = None, **others: Any,
    ) -> Lens:  # fmt: skip
        """Return the lens between two surfaces; clear: clear apertures of front and back.  others: see `Lens`."""
        return cls((Face(FRONT, front), Face(BACK, back)), outline, index, **others).with_clear(clear)

    @property
    def front(self) -> Surface:
        """Lowest surface, at smaller z."""
        return self.faces[0].surface

    @property
    def back(self) -> Surface:
        """Highest surface, at larger z."""
        return self.faces[-1].surface

    def face(self, name: str) -> Face:
        """Return the face of a name; KeyError if there is none."""
        return {face.name: face for face in self.faces}[name]

    def name_of(self, surface: Surface) -> str:
        """Return the name of the face whose surface this is (not an equal one); StopIteration if there is none."""
        return next(face.name for face in self.faces if face.surface is surface)

    @property
    def reflects(self) -> bool:
        """True if a face reflects the light."""
        return self.passes.reflects

    @cached_property
    def interfaces(self) -> tuple[Interface, ...]:
        """All interfaces, in the order of the light."""
        own = self._lossless
        return (*self.before, *(own if self.losses is None else self.losses.on(own)), *self.behind)

    @property
    def _lossless(self) -> tuple[Interface, ...]:
        """Interfaces of the solid without losses, one for each step of `passes`."""
        apertures = dict(zip((face.name for face in self.faces), self.apertures, strict=True))
        lost = (Status.MISSED_FRONT, *(Status.VIGNETTED for _ in self.passes.steps[1:]))
        return tuple(
            Interface(self.face(step.face).surface.optical, apertures[step.face], law, missed)
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
    def optical_faces(self) -> tuple[Face, ...]:
        """Faces that light meets, in the order of the light; the back alone for a first-surface mirror."""
        return tuple(map(self.face, self.passes.faces))

    @property
    def deflection(self) -> float:
        """Largest ratio of the deflection of a ray at a face to the slope angle of the face, for small angles."""
        return max(self.passes.deflection(face, self.index) for face in self.passes.faces)

    def number_of(self, face: str) -> int:
        """Return the number of the first interface of a face of the solid; ValueError if no light meets the face."""
        return len(self.before) + [step.face for step in self.passes.steps].index(face)

    @property
    def solid(self) -> slice:
        """Numbers of the interfaces that are faces of the solid."""
        return slice(len(self.before), len(self.before) + len(self.passes.steps))

    @property
    def tailored_numbers(self) -> tuple[int, ...]:
        """Numbers of the interfaces whose nets tailoring shapes, in the order of the light."""
        return (self.number_of(BACK),) if self.tailored is None else self.tailored

    def is_tailored(self, face: str) -> bool:
        """Return True if tailoring shapes this face of the solid."""
        first = len(self.before)
        return any(first + k in self.tailored_numbers for k in self.passes.numbers_of(face))

    @property
    def tailored_faces(self) -> tuple[Face, ...]:
        """Faces of the solid that tailoring shapes, the highest first: the back, then the front."""
        return tuple(face for face in reversed(self.faces) if self.is_tailored(face.name))

    @property
    def described_faces(self) -> tuple[Face, ...]:
        """Faces that reports describe: the highest, and each other that tailoring shapes; the highest first."""
        return tuple(face for face in reversed(self.faces) if face is self.faces[-1] or self.is_tailored(face.name))

    @property
    def has_two_tailored_faces(self) -> bool:
        """True if tailoring shapes two faces of a lens, which light crosses one after the other."""
        return len(self.tailored_faces) > 1 and not self.reflects

    def with_tailored(self, *faces: str) -> Lens:
        """Return the lens in which tailoring shapes these faces of the solid, given in the order of the light."""
        return replace(self, tailored=tuple(self.number_of(face) for face in faces))

    @property
    def nets(self) -> tuple[BSplineSurface, ...]:
        """Surfaces of the interfaces in `tailored_numbers`; TypeError if one is not a net."""
        return tuple(self.interfaces[k].net for k in self.tailored_numbers)

    @property
    def front_vertex(self) -> float:
        """z (mm) where the front crosses the axis; a tailored net has another reference plane for its heights."""
        return float(sag(self.front, 0.0, 0.0)) if self.is_tailored(FRONT) else float(self.front.z)

    @property
    def last_tailored(self) -> Interface:
        """Last freeform interface, which realises the transport map in stage 1."""
        return self.interfaces[self.tailored_numbers[-1]]

    def with_surface(self, name: str, surface: Surface) -> Lens:
        """Return the lens with another surface of a face; its clear aperture stays."""
        return replace(self, faces=tuple(replace(f, surface=surface) if f.name == name else f for f in self.faces))

    def with_front(self, front: Surface) -> Lens:
        """Return the lens with another front."""
        return self.with_surface(self.faces[0].name, front)

    def with_back(self, back: Surface) -> Lens:
        """Return the lens with another back."""
        return self.with_surface(self.faces[-1].name, back)

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
            return self.with_surface(steps[k - solid.start].face, surface)
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
    def apertures(self) -> tuple[Outline, ...]:
        """Clear apertures of the faces; light that meets a face outside its clear aperture is lost."""
        return tuple(face.clear or face.surface.outline or self.outline for face in self.faces)

    @property
    def clear(self) -> tuple[Outline, ...] | None:
        """Stated clear apertures of the faces; None: there are none, and `apertures` follows from the outlines."""
        found = tuple(face.clear for face in self.faces if face.clear is not None)
        return found or None

    def with_clear(self, clear: Sequence[Outline] | None) -> Lens:
        """Return the lens with other clear apertures, one for each face; None: none is stated."""
        each = zip(self.faces, clear or (None,) * len(self.faces), strict=True)
        return replace(self, faces=tuple(replace(face, clear=aperture) for face, aperture in each))

    @property
    def entrance(self) -> Surface:
        """Surface that light meets first; rays are launched through the plane of its vertex."""
        return self.interfaces[0].surface

    def unbounded(self) -> Lens:
        """Return the lens with unlimited apertures of the solid: they stop no ray."""
        return replace(self, outline=EVERYWHERE).with_clear([EVERYWHERE] * len(self.faces))

    def with_apertures_scaled(self, by: float) -> Lens:
        """Return the lens with the clear apertures of the solid scaled by a factor."""
        return self.with_clear([aperture.scaled(by) for aperture in self.apertures])

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
        faces = tuple(replace(face, surface=change(face.surface)) for face in self.faces)
        return replace(self, faces=faces, before=before, behind=behind)
