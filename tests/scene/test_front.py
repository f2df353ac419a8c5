"""Fronts in scene files: what may be written, what is refused, and that a given net travels with its scene."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import cadquery
import numpy as np
import pytest
import torch

import bstcad
from bstcad.cad import step_reading, step_writing
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere, Toroid, sag
from bstcad.scene.errors import SceneError
from bstcad.scene.fronts import FRONTS, NET_FILE, ConicFront, Front, NetFront, SphereFront, net_extent
from bstcad.scene.scene import load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
DISK = TEMPLATES / "disk.toml"  # 16 x 16 mm, plane front at 15, back at 20
SQUARE = Rectangle(16.0, 16.0)


def a_face(outline=SQUARE, m=11, z=30.0):
    """The back of some earlier lens."""
    half_x, half_y = net_extent(outline, m)
    x, y = (torch.linspace(-half, half, m, dtype=torch.float64) for half in (half_x, half_y))
    heights = 0.02 * x[:, None] + 0.1 * torch.sin(x[:, None] / 2) * torch.cos(y[None, :] / 3)
    return BSplineSurface(z, heights, (-half_x, half_x), (-half_y, half_y))


@pytest.fixture
def earlier(tmp_path):
    """A folder as of a design, with what is read of one."""
    folder = tmp_path / "earlier"
    folder.mkdir()
    face = a_face()
    np.savez_compressed(folder / "design.npz", control_points=face.control_points(), target=np.ones((8, 8)))
    lens = Lens.between(Plane(20.0), face, Rectangle(16.0, 16.0), 1.5)
    step_writing.write_lens(lens, folder / "lens.step", "earlier")
    return folder


def given(path, **more):
    return {"lens.front": {"kind": "bspline", "z": 15.0, "file": str(path)}, **more}


@pytest.mark.parametrize("name", [".", "design.npz", "lens.step"])
def test_the_back_of_a_design_is_moved_to_the_vertex_asked_for(earlier, name):
    front = load(DISK, given(earlier / name)).lens.front.surface
    x, y = np.random.default_rng(0).uniform(-8.0, 8.0, (2, 100))
    face = a_face()
    assert np.abs((sag(front, x, y) - 15.0) - (sag(face, x, y) - sag(face, 0.0, 0.0))).max() < 1e-12
    assert abs(sag(front, 0.0, 0.0) - 15.0) < 1e-14 and front.z == 15.0


def test_a_given_front_travels_with_its_scene(earlier, tmp_path):
    """The copy loads to an equal scene, again and again, to the last bit."""
    scene = load(DISK, given(earlier))
    for k in range(3):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / NET_FILE).write_bytes(scene.lens.front.file.copy)
        (folder / "scene.toml").write_text(scene.toml())
        again = load(folder / "scene.toml")
        assert again == scene and again.lens.front.file.data == scene.lens.front.file.data
        scene = again
    moved = scene.changed({"lens.front.z": 14.5})
    assert torch.equal(moved.lens.front.surface.heights, scene.lens.front.surface.heights)


def test_a_scene_takes_each_front_of_the_table():
    """The union is written out for type checkers."""
    union, *_ = get_args(Front)
    assert set(get_args(union)) == {NetFront, *(front for _, front in FRONTS.values())}
    assert all(kind == front.kind == surface.kind for kind, (surface, front) in FRONTS.items())


def test_a_surface_of_the_physics_is_a_front():
    scene = load(DISK)
    for surface in (Plane(14.0), Sphere(14.0, 0.01), Conic(14.0, 0.01, -2.0)):
        assert scene.changed({"lens.front": surface}).lens.front.surface == surface
    face = a_face(z=12.0)
    front = scene.changed({"lens.front": face}).lens.front.surface
    assert np.abs(front.control_points() - face.control_points()).max() < 1e-12


@pytest.mark.parametrize(("front", "free"), [
    ("{kind='sphere',z=15,optimise=true}", ("curvature",)),
    ("{kind='sphere',z=15,optimise=[]}", ()),
    ("{kind='conic',z=15,curvature=0.01,optimise=['conic_constant']}", ("conic_constant",)),
    ("{kind='conic',z=15,optimise=['conic_constant','curvature']}", ("curvature", "conic_constant")),
])  # fmt: skip
def test_what_tailoring_may_change_is_named(front, free, tmp_path):
    scene = load(DISK, {"lens.front": front})
    assert scene.lens.front.free == free
    (tmp_path / "scene.toml").write_text(scene.toml())
    assert load(tmp_path / "scene.toml") == scene


def test_a_found_front_leaves_nothing_free():
    found = Conic(15.0, torch.tensor(0.01), torch.tensor(-2.0))
    front = ConicFront(15.0, 0.0, 0.0, optimise=True).with_parameters(found)
    assert front == ConicFront(15.0, pytest.approx(0.01), -2.0) and front.free == ()
    assert SphereFront(15.0, 0.02).with_parameters(Sphere(15.0, 0.03)) == SphereFront(15.0, 0.02)


def spoilt(place, value):
    net = a_face().control_points()
    net[place] += value
    return {"control_points": net}


DAMAGED = {  # the arrays of design.npz
    "no net": {"target": np.ones(3)},
    "nan": spoilt((3, 3, 2), np.nan),
    "not uniform": spoilt((3, 3, 0), 0.1),
    "too small": {"control_points": a_face().control_points()[:4, :4]},
}


@pytest.mark.parametrize("how", [*DAMAGED, "design.npz", "lens.step", "empty folder"])
def test_a_damaged_design_is_refused(earlier, how):
    path = earlier / how
    if path.exists():
        path.write_bytes(path.read_bytes()[:300])
    elif how in DAMAGED:
        np.savez(earlier / "design.npz", **DAMAGED[how])
    else:
        (earlier / "design.npz").unlink()
    with pytest.raises(SceneError, match=r"^lens\.front\.file: .*; give the folder of a design") as caught:
        load(DISK, given(path if path.exists() else earlier))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("outline", [Rectangle(16.0, 12.0), Circle(8.5), Rectangle(16.1, 16.0)])
def test_a_face_of_another_outline_is_refused(outline):
    with pytest.raises(SceneError, match=r"^lens\.front\.file: its net covers [xy] = .*; give a design of the same"):
        load(DISK).changed({"lens.front": a_face(outline, z=15.0)})


@pytest.mark.parametrize("how", ["lifted", "turned", "face down"])
def test_the_placement_of_a_step_file_is_applied(earlier, how):
    """(x, y, z) comes to lie at (-y, x, z) by a quarter turn about z, at (x, -y, -z) by half a turn about x."""
    place = {
        "lifted": cadquery.Location(cadquery.Vector(0, 0, 5)),
        "turned": cadquery.Location(cadquery.Vector(0, 0, 0), cadquery.Vector(0, 0, 1), 90),
        "face down": cadquery.Location(cadquery.Vector(0, 0, 0), cadquery.Vector(1, 0, 0), 180),
    }[how]
    front = load(DISK, given(placed(earlier, place))).lens.front.surface
    x, y = np.random.default_rng(0).uniform(-8.0, 8.0, (2, 100))
    sign, at = {"lifted": (1, (x, y)), "turned": (1, (y, -x)), "face down": (-1, (x, -y))}[how]
    face = a_face()
    assert np.abs((sag(front, x, y) - 15.0) - sign * (sag(face, *at) - sag(face, 0.0, 0.0))).max() < 1e-11


def placed(earlier, place):
    """The lens of a folder as an assembly of another program has it."""
    solid = cadquery.Shape.cast(step_reading.solid(earlier / "lens.step").shape)
    cadquery.Assembly(name="whole").add(solid, name="lens", loc=place).export(str(earlier / "placed.step"))
    return earlier / "placed.step"


@pytest.mark.parametrize(
    ("place", "sentence"),
    [
        (((1e-6, 0, 0),), "its net is centred at x = 1e-06 mm and not on the axis; export the lens centred"),
        (((0, 3, 0),), "its net is centred at y = 3 mm and not on the axis"),
        (((0, 0, 0), (1, 0, 0), 90), r"cannot be read \(its lens is rotated by 90° about x, but the axis"),
        (((0, 0, 0), (0, 0, 1), 30), "its lens is rotated by 30° about z, but"),
    ],
)
def test_a_placement_that_is_no_front_is_refused(earlier, place, sentence):
    vectors = [cadquery.Vector(*each) if isinstance(each, tuple) else each for each in place]
    with pytest.raises(SceneError, match=rf"^lens\.front\.file: .*{sentence}") as caught:
        load(DISK, given(placed(earlier, cadquery.Location(*vectors))))
    assert "\n" not in str(caught.value)


def test_a_net_follows_a_bowl_to_the_rim_where_it_reaches_past_it():
    """z = c x² / 2: x(t) is linear inside the outline, so that h_i = c (x_i² - p² / 4) / 2 are exact; no heights are so
    for a net that ends at the rim."""
    m, c = 17, 0.05
    half = net_extent(Rectangle(16.0, 12.0), m)[0]
    x = torch.linspace(-8.0, 8.0, 201, dtype=torch.float64)

    def slope(heights, half):
        net = BSplineSurface(0.0, torch.as_tensor(heights)[:, None].expand(m, m), (-half, half), (-half, half))
        return net.sag_and_slope(x, 0 * x)[1].numpy()

    along, pitch = np.linspace(-half, half, m), 2 * half / (m - 1)
    assert np.abs(slope(c * (along**2 - pitch**2 / 4) / 2, half) - c * x.numpy()).max() < 1e-14
    slopes = np.stack([slope(unit, 8.0) for unit in np.eye(m)], axis=1)  # of each height alone
    best = np.linalg.lstsq(slopes, c * x.numpy(), rcond=None)[0]
    assert np.abs(slopes @ best - c * x.numpy()).max() > 0.1 * c  # 0.1 mm of its place


def test_a_front_that_comes_too_near_to_the_back_is_refused():
    face = a_face(z=15.0)
    high = BSplineSurface(15.0, 60.0 * face.heights, face.x, face.y)
    with pytest.raises(SceneError, match=re.escape("lens.back.z: the lens is") + ".* thick at its thinnest point"):
        load(DISK).changed({"lens.front": high})


@pytest.mark.parametrize("outline", [Rectangle(16.0, 12.0), Circle(8.0)], ids=lambda outline: outline.shape)
@pytest.mark.parametrize(("curvatures", "same"), [
    ((0.03, 0.03), Sphere(15.0, 0.03)), ((-0.08, -0.08), Sphere(15.0, -0.08)), ((0.0, 0.0), Plane(15.0)),
    ((0.02, -0.05), Toroid(15.0, 0.02, -0.05)), ((0.1, 0.0), Toroid(15.0, 0.1, 0.0)),
])  # fmt: skip
def test_the_net_of_a_toroid_lies_within_a_nanometre(outline, curvatures, same):
    """A toroid of two equal curvatures lies on the sphere, too; its vertex is at z to the bit."""
    scene = load(DISK).changed({"lens.outline": outline, "lens.front": Toroid(15.0, *curvatures)})
    net = scene.lens.front_surface
    x, y = torch.linspace(-8.0, 8.0, 301, dtype=torch.float64), torch.linspace(-8.0, 8.0, 300, dtype=torch.float64)
    x, y = torch.meshgrid(x, y, indexing="ij")
    inside = outline.contains(x, y)
    assert np.abs(sag(net, x, y) - sag(same, x, y))[inside].max() < 1.1e-6
    assert sag(net, 0.0, 0.0) == 15.0 and net.is_net and scene.lens.nets(33) == ((33), net.shape[0])


def test_a_toroid_stands_in_its_scene_with_both_curvatures(tmp_path):
    scene = load(DISK).changed({"lens.front": bstcad.Toroid(14.0, 0.01, -0.02)})
    (tmp_path / "scene.toml").write_text(scene.toml())
    again = load(tmp_path / "scene.toml")
    assert again == scene and again.lens.front.surface == Toroid(14.0, 0.01, -0.02) and again.lens.front.fixed
    assert torch.equal(again.lens.front_surface.heights, scene.lens.front_surface.heights)


@pytest.mark.parametrize(("keys", "sentence"), [
    ({"curvature_x": 0.13}, "curvature_x: a toroid of radius 7.69231 mm .* steeper than 60"),
    ({"curvature_y": -0.11}, "curvature_y: a toroid of radius 9.09091 mm .* make the curvature smaller"),
    ({"curvature_x": 0.08, "curvature_y": 0.1}, "curvature_y: a toroid of radius 10 mm"),  # at the corners
    ({"optimise": True}, "optimise: unknown key"),
])  # fmt: skip
def test_a_toroid_that_no_lens_can_have_is_refused_by_its_key(keys, sentence):
    with pytest.raises(SceneError, match=rf"^lens\.front\.{sentence}"):
        load(DISK).changed({"lens.front": {"kind": "toroid", "z": 15.0, **keys}})
