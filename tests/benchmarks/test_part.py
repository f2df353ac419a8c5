"""A lens of 513 x 513 control points as a part: how long its CAD takes, and whether three ways find its volume.

pytest -s -m bench tests/benchmarks/test_part.py
"""

import time

import cadquery as cq
import numpy as np
import pytest
import torch
from OCP.BRepAdaptor import BRepAdaptor_Curve

from bstcad.cad import mass_properties, mounting, solid_properties, step_writing
from bstcad.cad.mesh import lens_mesh, volume_and_area
from bstcad.cad.trimming import trimmed_solid
from bstcad.optics.bspline import BSplineSurface
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Circle
from bstcad.optics.surfaces import Sphere, sag
from bstcad.scene.mount import Flange, Mount, Round, Screws
from bstcad.step_text import part21
from tests.cad.test_trimming import occ_volume, stadium, uses, worst_gap
from tests.exact_volume import exact_volume

pytestmark = pytest.mark.bench
M, RADIUS = 513, 12.0  # control points a side; mm


def round_lens():
    """As wavy as a picture makes it, its net two spans wider than the rim."""
    half = RADIUS * (M - 1) / (M - 9)
    x, y = np.meshgrid(*[np.linspace(-half, half, M)] * 2, indexing="ij")
    heights = (
        0.4 * np.sin(0.5 * x + 0.4) * np.cos(0.35 * y) - 0.004 * (x**2 + y**2) + 0.003 * np.sin(4 * x) * np.cos(3 * y)
    )
    back = BSplineSurface(6.0, torch.from_numpy(heights), (-half, half), (-half, half))
    return Lens(Sphere(0.0, -0.01), back, Circle(RADIUS), 1.49)


def timed(what, work, *arguments):
    began = time.perf_counter()
    found = work(*arguments)
    print(f"\n{what}: {time.perf_counter() - began:.2f} s", end="")
    return found


def test_a_round_lens_with_a_flange_and_holes(tmp_path):
    lens, path = round_lens(), tmp_path / "part.step"
    screws = Screws(count=3, diameter=3.2, circle=30.0)
    flange = Flange(outline=Round(shape="circle", diameter=36.0), z=1.0, thickness=2.0, screws=screws)
    mount = Mount(flange=flange)
    part = timed("built", mounting.part_of, lens, mount)
    said = timed("area, volume, centroid", solid_properties.of_solid, part.solid)
    timed("STEP written", step_writing.write, part.solid, path, "part", step_writing.NOTHING, part.faces, said)
    again = timed("STEP read", cq.importers.importStep, str(path)).val()
    assert part.solid.isValid() and again.isValid()
    assert set(map(tuple, map(sorted, uses(part.solid).values()))) == {(False, True)} and part21.read(path).closed
    assert worst_gap(part.solid) < 1e-7
    assert off_the_rim(part, lens) < 1e-7
    around = 2 * np.pi * (18.0**2 - RADIUS**2) - 3 * np.pi * 1.6**2 * 2.0
    wanted = exact_volume(lens) + around
    ways = {
        "said in the file": said.volume,
        "OCC, as written": occ_volume(part.solid, 1e-7),
        "mesh": volume_and_area(lens_mesh(lens, 1400))[0] + around,
    }
    for way, volume in ways.items():
        print(f"\nvolume, {way}: {volume / wanted - 1:.1e} off the integral", end="")
        assert volume == pytest.approx(wanted, rel=1e-6)
    assert mass_properties.of_lens(lens).volume == pytest.approx(exact_volume(lens), rel=1e-12)


def off_the_rim(part, lens):
    """Largest distance (mm) of the back's edge from the circle of the rim, lifted onto the back."""
    face, worst = part.solid.Faces()[part.faces.index("back")], 0.0
    for edge in face.outerWire().Edges():
        curve = BRepAdaptor_Curve(edge.wrapped)
        for t in np.linspace(curve.FirstParameter(), curve.LastParameter(), 5001).tolist():
            p = curve.Value(t)
            across = abs(np.hypot(p.X(), p.Y()) - RADIUS)
            worst = max(worst, across, abs(p.Z() - float(sag(lens.back, p.X(), p.Y()))))
    return worst


def test_a_trim_to_a_wire_and_three_holes():
    lens = round_lens()
    wire = stadium().scale(2.0)
    holes = [(4.0, 3.0, 1.6), (-4.4, 2.0, 1.0), (0.6, -4.0, 2.2)]
    solid = timed("cut to a wire, three holes", trimmed_solid, lens, wire, holes)
    assert solid.isValid() and len(solid.Faces()) == 2 + 4 + 6
