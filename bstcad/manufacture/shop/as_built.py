"""Tailor the back of a lens anew to its blank as it was built: a measured front, thickness or index.

A blank that was moulded, polished or melted differs from the scene by amounts that its maker measures before the back
is cut.  Instead of a tighter blank, the back is made for this blank: stage 2 (stage 3 for an extended source) refines
the earlier back in its last round.  The result is a design of its own, with the files and the proof of a design.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bstcad.designs.designed_lens import DesignedLens
from bstcad.designs.pipeline import DesignOptions, Earlier, design
from bstcad.manufacture.measured.cloud import load as load_cloud
from bstcad.manufacture.measured.compensation import measured_form
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net, is_net
from bstcad.optics.surfaces.outlines import Outline
from bstcad.optics.surfaces.surfaces import Plane, sag
from bstcad.scene.blank import INDEX_OFFSETS
from bstcad.scene.dome_back import RadialBack
from bstcad.scene.errors import SceneError
from bstcad.scene.fronts import FIT_SIZES, FileNet, NetFront, fit_net, net_extent
from bstcad.scene.scene import Scene
from bstcad.tailoring import effort as efforts
from bstcad.tailoring.driver import NO_HOOKS, Hooks, NetParameters, Parameters

KEYS = FRONT, "thickness", "index"
OPTION = "--as-built"
RAYS = 1.6  # rays per side of the RRMSDs before, relative to those between the stages: an error of 1 to 2 %
EXAMPLE = "front=cloud.csv,thickness=12.05,index=1.4912"


@dataclass(frozen=True)
class AsBuilt:
    """A blank as it was built; None: as in the scene."""

    thickness: float | None = None  # distance of the vertices of front and back (mm)
    index: float | None = None  # refractive index at the main wavelength of the source
    front: float | Path | None = None  # curvature (1/mm) of the front, or file of its measured points

    @classmethod
    def parse(cls, given: str) -> AsBuilt:
        """Return the blank of a text such as EXAMPLE; SceneError for other words, or words without a value."""
        found: dict[str, Any] = {}
        for word in filter(None, (part.strip() for part in given.split(","))):
            key, equals, value = (part.strip() for part in word.partition("="))
            if key not in KEYS or not equals or not value:
                raise SceneError(f"{OPTION} {word}: is not one of {', '.join(KEYS)} with a value; write {EXAMPLE}")
            if key in found:
                raise SceneError(f"{OPTION} {word}: {key} is given twice; give it once")
            number = _number(value)
            if number is None and key != FRONT:
                raise SceneError(f"{OPTION} {word}: the value is not a finite number; write {EXAMPLE}")
            found[key] = Path(value) if number is None else number
        if not found:
            raise SceneError(f"{OPTION}: names nothing that differs from the scene; write {EXAMPLE}")
        return cls(**found)


@dataclass(frozen=True)
class Retailored:
    """A back that was tailored anew."""

    made: DesignedLens
    design: float  # RRMSD of the earlier design
    before: float  # RRMSD of the earlier back on the blank as built

    def sentence(self, after: float) -> str:
        """Return a sentence with the three RRMSDs; after: RRMSD of the new design."""
        return (
            f"RRMSD {self.design:.3g} as designed, {self.before:.3g} with the earlier back on the blank as built, "
            f"{after:.3g} with the back tailored anew"
        )


def retailor(made: DesignedLens, built: AsBuilt, hooks: Hooks = NO_HOOKS) -> Retailored:
    """Return the design for a blank as built, from an earlier design; SceneError if a value does not suit the scene."""
    scene, shift = as_built(made, built)
    old = replace(made.lens.plain(), index=made.heaviest.index, losses=None)
    flat = scene.flat_lens(scene.lens.back.net)
    earlier = Earlier(old, _moved(made.lens, flat, shift, scene.lens.dome), made.transport)
    options = DesignOptions(compare_later=True, earlier=earlier)
    found = design(scene, device=made.device, hooks=hooks, options=options)
    before = earlier.parameters.apply_to(flat)
    states = (made, made.lens), (found, scene.as_mounted(replace(before.plain(), index=scene.index)))
    rays = efforts.FULL.between_stages(made.goals, RAYS)
    rrmsds = (max(light.rrmsd for light in of.lights(lens, of.goals, rays)) for of, lens in states)
    return Retailored(found, *rrmsds)


def as_built(made: DesignedLens, built: AsBuilt) -> tuple[Scene, float]:
    """Return (scene of the blank as built, shift (mm) of the back's vertex relative to the earlier design)."""
    scene, lens = made.scene, made.lens
    changes: dict[str, Any] = {}
    shift = 0.0
    if built.thickness is not None:
        shift = built.thickness - (lens.back_net.vertex_z - lens.front.z)
        key = scene.lens.back.vertex_key
        changes[key] = getattr(scene.lens.back, key.removeprefix("lens.back.")) + shift
    if built.index is not None:
        if not scene.lens.passes.enters:
            raise SceneError(f"{OPTION} index: light does not enter a mirror; leave it out")
        if not abs(built.index - scene.index) <= INDEX_OFFSETS[1]:
            other = f"differs from the {scene.index:.5g} of the scene by more than {INDEX_OFFSETS[1]:g}"
            raise SceneError(f"{OPTION} index={built.index:g}: {other}; design the lens for this material")
        if scene.lens.material is None:
            changes["lens.index"] = built.index
        else:
            changes["lens.index_offset"] = (scene.lens.index_offset or 0.0) + built.index - scene.index
    if built.front is not None:
        changes |= _front(made, built.front)
    try:
        return scene.changed(changes), shift
    except SceneError as error:
        raise SceneError(f"{OPTION}: {error}") from None


def _front(made: DesignedLens, given: float | Path) -> dict[str, Any]:
    """Return the change of the scene for a front of a curvature (1/mm), or as measured points show it."""
    front = made.scene.lens.front
    if isinstance(given, Path):
        return {"lens.front": _measured_front(made, given)}
    if "curvature" not in made.lens.front.parameters() or front.is_tailored:
        known = f"a front of kind {front.kind!r} has no curvature"
        raise SceneError(f"{OPTION} front={given:g}: {known}; give a file of measured points of the front")
    return {"lens.front.curvature": given}


def _measured_front(made: DesignedLens, path: Path) -> NetFront:
    """Return the front as a net: the nominal front plus the form error in a cloud of its points.

    The rigid motion of the cloud is removed, since the position of the front in the part defines the part's axes.
    """
    scene, lens = made.scene, made.lens
    made.scene.lens.require_heights(f"{OPTION} front")
    if lens.front.outline is not None:
        why = "a front with an outline of its own cannot be replaced by measured points yet"
        raise SceneError(f"{OPTION} front={path}: {why}; give its curvature")
    outline = lens.apertures[0]
    nominal = lens.front if is_net(lens.front) else fit_net(lens.front.plain(), lens.outline)
    below = Plane(nominal.z + float(nominal.sags(outline)[0]) - (lens.back_net.vertex_z - lens.front.z))
    face = Lens.between(below, nominal, outline, lens.index)  # the front as a back, with which clouds are compared
    try:
        form = measured_form(load_cloud(path, outline), face, scene.accept.decentre)
    except ValueError as error:
        raise SceneError(f"{OPTION} front: {error}") from None
    side = next((m for m in FIT_SIZES if m >= max(*form.random_field.shape, *nominal.shape)), FIT_SIZES[-1])
    return NetFront(lens.front.z, file=FileNet.of(_sampled(nominal, form, lens.outline, side)))


def _sampled(nominal: BSplineSurface, form: Any, outline: Outline, side: int) -> BSplineSurface:
    """Return the net of side x side control points through the nominal surface plus its form error, at its points."""
    half_x, half_y = net_extent(outline, side)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, side), np.linspace(-half_y, half_y, side), indexing="ij")
    heights = sag(nominal, x.ravel(), y.ravel()) + form.at(x.ravel(), y.ravel())
    net = torch.from_numpy(interpolating_net(heights.reshape(side, side)))
    return BSplineSurface(0.0, net, (-half_x, half_x), (-half_y, half_y))


def _moved(lens: Lens, flat: Lens, shift: float, dome: RadialBack | None) -> Parameters:
    """Return the parameters of a lens, its back moved by a shift (mm), for the lens `flat` before tailoring.

    dome: back of the scene if it is a dome.
    """
    old = Parameters.of(lens)
    faces = [face.name for face in lens.tailored_faces]
    nets = {face: old.nets[lens.tailored_numbers.index(lens.number_of(face))] for face in faces}
    if BACK in nets and dome is None:
        nets[BACK] = NetParameters(nets[BACK].z + shift, nets[BACK].heights)
    elif BACK in nets and dome is not None:  # the dome grows about its centre
        nets[BACK] = NetParameters(nets[BACK].z, dome.radius / (dome.radius - shift) * nets[BACK].heights)
    shaped = sorted(filter(flat.is_tailored, faces), key=flat.number_of)  # a front as built is tailored no more
    front = {} if flat.front.is_net else flat.front.parameters()
    return Parameters(tuple(nets[face] for face in shaped), front, old.back + (shift if dome is None else 0.0))


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
