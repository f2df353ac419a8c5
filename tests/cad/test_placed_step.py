"""A lens that another program turned, moved or put into an assembly is the same lens, and both readers place it."""

from __future__ import annotations

import cadquery
import numpy as np
import pytest
import torch
from cadquery import Location, Vector

from bstcad.cad import step_writing
from bstcad.cad.solid import lens_solid
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.step_text import part21
from bstcad.verify import step_checks
from tests.cad.conftest import FRONT, OUTLINE, rough_back

DIGITS = 1e-12  # cadquery writes directions with twelve; control points lie up to 40 mm from the origin of the lens
ORIGIN, FAR = Vector(0, 0, 0), Vector(100, 20, -7)
MOVES = {  # the location, and how the placement is stated
    "lifted": (Location(Vector(0, 0, 5)), "shifted by (0, 0, 5) mm"),
    "by a nanometre": (Location(Vector(1e-6, 0, 0)), "shifted by (1e-06, 0, 0) mm"),
    "turned": (Location(ORIGIN, Vector(0, 0, 1), 90), "rotated by 90° about z"),
    "face down": (Location(ORIGIN, Vector(1, 0, 0), 180), "rotated by 180° about x"),
    "tilted and moved": (
        Location(FAR, Vector(2, 1, 2), 37), "rotated by 37° about (0.666667, 0.333333, 0.666667), then shifted by ("
    ),
}  # fmt: skip


def in_assembly(solid, path, *places):
    """Write a part within nested assemblies, the outermost place first."""
    whole = cadquery.Assembly(name="whole")
    for number, place in enumerate(places[:-1]):
        inner = cadquery.Assembly(name=f"part {number}", loc=place)
        inner.add(solid, name="lens", loc=places[-1])
        whole.add(inner)
    if len(places) == 1:
        whole.add(solid, name="lens", loc=places[0])
    whole.export(str(path))
    return path


def failed(found):
    return [check for check in found.checks if not check.passed]


@pytest.mark.parametrize("how", ["stated", "moved coordinates"])
@pytest.mark.parametrize("move", MOVES)
def test_a_moved_lens_passes_and_its_placement_is_stated(make_lens, tmp_path, move, how):
    place, words = MOVES[move]
    lens, path = make_lens(m=9), tmp_path / "lens.step"
    solid = lens_solid(lens)
    step_writing.write(solid, path, "lens")
    alone = step_checks.examine(path)
    assert not alone.placement.moves
    if how == "stated":
        in_assembly(solid, path, place)
        stated = part21.read(path).placement
        assert stated.words.startswith(words)
        np.testing.assert_allclose(stated.rotation, np.array(matrix(place))[:, :3], rtol=0, atol=DIGITS)
    else:
        step_writing.write(cadquery.Shape.cast(moved(solid, place)), path, "lens")
        assert not part21.read(path).placement.moves
    found = step_checks.examine(path)
    assert failed(found) == []
    net = lens.back.control_points()
    placed = np.array(matrix(place))
    expected = net @ placed[:, :3].T + placed[:, 3]
    assert np.abs(part21.read(path).surface.control_points - expected).max() < 40 * DIGITS
    assert np.abs(found.placement(found.lens.back.control_points()) - expected).max() < 40 * DIGITS
    if how == "stated":
        assert found.placement.words.startswith(words)
        assert found.lens.front_vertex == pytest.approx(alone.lens.front_vertex, abs=1e-12)
    elif move == "lifted":  # along its axis, where no frame can be told from another
        assert not found.placement.moves and found.lens.front_vertex == pytest.approx(13.0, abs=1e-12)
    else:
        np.testing.assert_allclose(found.placement.rotation, placed[:, :3], rtol=0, atol=1e-12)
        rotated = found.placement.shift - placed[:, 3]  # on the axis of the lens
        assert np.abs(np.cross(rotated, found.placement.rotation[:, 2])).max() < 1e-9


@pytest.mark.parametrize(("unit", "name", "size"), [("INCH", "inch", 25.4), ("M", "metre", 1e3)])
def test_a_lens_in_another_unit_passes_in_mm(make_lens, tmp_path, unit, name, size):
    """Both readers convert it; a design's own folder takes millimetres alone."""
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.Interface import Interface_Static
    from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer

    lens, path = make_lens(m=9), tmp_path / "lens.step"
    solid, writer = lens_solid(lens), STEPControl_Writer()
    before = Interface_Static.CVal_s("write.step.unit")
    try:
        Interface_Static.SetCVal_s("write.step.unit", unit)
        assert writer.Transfer(solid.wrapped, STEPControl_AsIs) == IFSelect_RetDone
        assert writer.Write(str(path)) == IFSelect_RetDone
    finally:
        Interface_Static.SetCVal_s("write.step.unit", before)
    text, found = part21.read(path), step_checks.examine(path)
    assert text.unit == name and failed(found) == []
    net = lens.back.control_points()
    assert np.abs(text.surface.control_points - net).max() < 1e-12 * size  # of the digits that OCC writes
    assert np.abs(found.lens.back.control_points() - net).max() < 1e-12 * size
    with pytest.raises(ValueError, match=f"lengths are in {name}; export it in millimetres"):
        part21.read_lens(path)


def matrix(place):
    motion = place.wrapped.Transformation()
    return [[motion.Value(i, j) for j in range(1, 5)] for i in range(1, 4)]


def moved(solid, place):
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform

    return BRepBuilderAPI_Transform(solid.wrapped, place.wrapped.Transformation(), True).Shape()


def test_two_freeform_faces_in_nested_assemblies(make_lens, tmp_path):
    """Places follow each other; the light's side is found though the lens lies upside down."""
    lens = make_lens(m=9)
    front = BSplineSurface(8.0, 0.1 * torch.flip(lens.back.heights, [0]), lens.back.x, lens.back.y)
    lens = lens.between(front, rough_back(OUTLINE, 9), OUTLINE, 1.49)
    places = Location(Vector(1, 2, 3), Vector(0, 1, 1), 50), Location(Vector(10, 0, -4), Vector(1, 0, 0), 170)
    path = in_assembly(lens_solid(lens), tmp_path / "lens.step", *places)
    found, text = step_checks.examine(path), part21.read(path)
    assert failed(found) == []
    assert np.abs(found.lens.back.control_points() - lens.back.control_points()).max() < 1e-11
    assert np.abs(found.lens.front.control_points() - lens.front.control_points()).max() < 1e-11
    placed = np.array(matrix(places[0] * places[1]))
    off = text.front.control_points - (front.control_points() @ placed[:, :3].T + placed[:, 3])
    assert np.abs(off).max() < 40 * DIGITS


def test_a_mirrored_lens_and_two_places_are_refused(make_lens, tmp_path):
    solid, path = lens_solid(make_lens(FRONT, m=9)), tmp_path / "lens.step"
    step_writing.write(solid.mirror("YZ"), path, "lens")
    with pytest.raises(ValueError, match=r"lens\.step: read by .*as in a mirror image; export the lens"):
        step_checks.examine(path)
    pair = cadquery.Assembly(name="pair").add(solid, name="a").add(solid, name="b", loc=Location(Vector(50, 0, 0)))
    pair.export(str(path))
    with pytest.raises(ValueError, match=r"lens\.step: read as text: the file places its lens more than once"):
        step_checks.examine(path)
