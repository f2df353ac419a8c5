"""The cavity of a mould: its nets and its volume are the part's, multiplied by the factors of the shrinkage."""

import math

import cadquery as cq
import numpy as np
import pytest
import torch
from OCP.BRep import BRep_Tool
from OCP.Geom import Geom_BSplineSurface

from bstcad.cad import cavity, mounting
from bstcad.cad.solid import named_solid
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.scene.moulding import Moulding
from bstcad.scene.mount import Mount, Part
from tests import suite
from tests.cad.test_dome import dome
from tests.cad.test_trimming import occ_volume

UNIFORM, OF_PART = Moulding(shrinkage=0.005), Moulding(shrinkage=(0.005, 0.006, 0.004), relative_to="part")
FLANGE = Mount.model_validate({"datum": "flange", "draft": 1.0, "flange": {
    "outline": {"shape": "circle", "diameter": 14.0}, "z": 1.0, "thickness": 1.0, "bevel": 0.1,
    "screws": {"count": 3, "diameter": 1.2, "circle": 11.0},
}})  # fmt: skip
CUT = Mount.model_validate({"rim": {"shape": "rectangle", "width": 5.0, "height": 4.0, "corner_radius": 0.5}})


def relief(z, size, seed):
    heights = size * np.random.default_rng(seed).normal(size=(17, 17))
    return BSplineSurface(z, torch.from_numpy(heights), (-5.0, 5.0), (-5.0, 5.0))


def lens(front=None):
    return Lens.between(front or Sphere(0.3, -0.01), relief(5.0, 0.02, 0), Circle(4.0), 1.49)


def poles(face):
    """Control points (m, n, 3) and knots of a face that is a polynomial B-spline."""
    surface = BRep_Tool.Surface_s(face.wrapped)
    assert isinstance(surface, Geom_BSplineSurface) and not (surface.IsURational() or surface.IsVRational())
    u, v = range(1, surface.NbUPoles() + 1), range(1, surface.NbVPoles() + 1)
    points = [[(p.X(), p.Y(), p.Z()) for p in (surface.Pole(i, j) for j in v)] for i in u]
    return np.array(points), [surface.UKnot(k) for k in range(1, surface.NbUKnots() + 1)]


PARTS = {  # lens, mount, faces that are nets
    "lens": (lens, None, ("back",)),
    "two nets": (lambda: lens(relief(0.0, 0.02, 1)), None, ("back", "front")),
    "flange": (lens, FLANGE, ("back",)),
    "cut rim": (lens, CUT, ("back",)),
    "dome": (dome, None, ("back",)),
}


@pytest.mark.parametrize("moulding", [UNIFORM, OF_PART], ids=["uniform", "per axis"])
@pytest.mark.parametrize("kind", suite.in_turns(PARTS, 2))
def test_the_nets_are_scaled_exactly_and_the_solid_is_valid(kind, moulding, tmp_path):
    make, mount, nets = PARTS[kind]
    made = make()
    part = named_solid(made) if mount is None else mounting.part_of(made, mount)
    found, about = cavity.cavity(made, moulding, mount)
    assert about == (0.0 if mount is FLANGE else made.front.z) and found.faces == part.faces
    (tmp_path / "cavity.step").write_bytes(cavity.step_file(found, "cavity", Part(number="17", density=1.2)))
    again = cq.importers.importStep(str(tmp_path / "cavity.step")).val()
    assert found.solid.isValid() and again.isValid() and len(again.Faces()) == len(part.faces)
    factors = np.array(moulding.factors)
    for name in nets:
        place = part.faces.index(name)
        (before, knots), (after, same), (written, _) = (
            poles(solid.Faces()[place]) for solid in (part.solid, found.solid, again)
        )
        wanted = before * factors + [0.0, 0.0, (1 - factors[2]) * about]
        assert np.abs(after - wanted).max() < 1e-14 * np.abs(wanted).max() and knots == same
        assert np.abs(written - wanted).max() < 1e-12
    if kind == "lens":
        volumes = occ_volume(found.solid, 1e-4), occ_volume(part.solid, 1e-4)
        assert volumes[0] == pytest.approx(math.prod(factors) * volumes[1], rel=1e-5)  # OCC integrates to 1e-4


def test_a_length_of_the_cavity_is_the_stated_one():
    """Bounding boxes of the outline: 8 mm of the part are 8 / (1 - s) or 8 (1 + s) of the cavity."""
    for moulding, width in ((UNIFORM, 8 / 0.995), (Moulding(shrinkage=0.005, relative_to="part"), 8 * 1.005)):
        box = cavity.cavity(lens(), moulding)[0].solid.BoundingBox(1e-4)
        assert box.xlen == pytest.approx(width, abs=1e-5) and box.ylen == pytest.approx(width, abs=1e-5)
