"""The edges of a written lens lie on its faces and on its wall, and a hair beside they are seen to lie beside."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bstcad.cad import patches, solid_edges, step_reading, step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.outlines import Circle, Rectangle
from bstcad.optics.surfaces import Plane, Sphere

OUTLINES = [Rectangle(24.0, 20.0), Circle(12.0)]
FRONTS = [Plane(8.0), Sphere(8.0, 0.02), Sphere(8.0, -0.06), Sphere(8.0, 1e-6), Sphere(8.0, 3e-5)]


def through_file(lens, path):
    step_writing.write(lens_solid(lens), path, "lens")
    return step_reading.read(path).shape


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda outline: outline.shape)
@pytest.mark.parametrize("front", FRONTS, ids=str)
def test_a_written_lens_is_off_by_its_rim_at_most(make_lens, tmp_path, outline, front):
    lens = make_lens(front, outline)
    (off_faces, _), (off_wall, _) = solid_edges.off(through_file(lens, tmp_path / "lens.step"), lens)
    bound = 2 * patches.RIM if isinstance(outline, Circle) else 1e-9  # mm; 14 decimals of a centre 3e4 mm away
    assert off_faces <= bound and off_wall <= bound


@pytest.mark.parametrize(
    ("change", "off"),
    [
        ({"outline": Rectangle(24.0 + 2e-6, 20.0)}, 1e-6),
        ({"outline": Rectangle(24.0, 20.0 - 2e-6)}, 1e-6),
        ({"front": Plane(8.0 + 1e-6)}, 1e-6),
        ({"front": Plane(8.0 - 1e-6)}, 0.0),  # the rim lies between the faces: form and vertex are other checks
    ],
    ids=["wider", "narrower", "front above the rim", "front below the rim"],
)
def test_a_lens_of_another_wall_is_off_by_the_difference(make_lens, tmp_path, change, off):
    lens = make_lens()
    shape = through_file(lens, tmp_path / "lens.step")
    (off_faces, _), (off_wall, where) = solid_edges.off(shape, replace(lens, **change))
    assert off_wall == pytest.approx(off, abs=1e-9) and off_faces <= 1e-9 and where.startswith("at (")


def test_a_rim_as_rough_as_they_come_is_followed_as_nearly(make_lens, tmp_path):
    """Heights that jump by half a millimetre from one control point to the next: 32 parts between two knot lines
    leave 4.7e-8 mm."""
    lens = make_lens(Plane(-8.0), Circle(13.0), 129, 0.5)
    (off_faces, _), (off_wall, _) = solid_edges.off(through_file(lens, tmp_path / "lens.step"), lens)
    assert off_faces <= 2 * patches.RIM and off_wall <= 2 * patches.RIM
