"""The light of the part: through the clear apertures that a mount leaves, tailored for and proved of part.step."""

import math
import shutil
from dataclasses import replace

import cadquery
import numpy as np
import pytest
import torch
from torch.quasirandom import SobolEngine

import bstcad
from bstcad import commands
from bstcad.analysis.light import mount_losses
from bstcad.analysis.shape import describe
from bstcad.cad import mounting
from bstcad.commands import ProofOptions
from bstcad.optics.lens.interfaces import cross
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from bstcad.optics.trace.measure import Effort, measure
from bstcad.scene.mount import Mount
from bstcad.scene.scene import load
from bstcad.verify import step_checks
from tests import suite
from tests.conftest import draws_nothing, proofs, quick_effort
from tests.efforts import designed_quickly
from tests.lenses import net
from tests.scenes import DISK

BOX = {"shape": "rectangle", "width": 6.4, "height": 5.6, "corner_radius": 1.5}
CUT = {"datum": "front", "rim": {"shape": "circle", "diameter": 9.0}}
FLANGE = {"outline": {"shape": "circle", "diameter": 20.0}, "z": 16.0, "thickness": 1.0}
MOUNTS = {  # mounts of the small scene: 8 x 6 mm, a front of curvature 0.002 at z = 15, a back at 25
    "a flange, draft and bevel": {
        "datum": "flange",
        "rim": BOX,
        "flange": FLANGE | {"z": 16.5},
        "draft": 12.0,
        "bevel": 0.3,
    },
    "draft below a curved front": {"rim": BOX, "draft": 5.0, "bevel": 0.2, "curvature": -0.06},
}


@pytest.fixture(scope="module")
def design(small_design):
    return bstcad.open(small_design.folder)


def held(design, mount, curvature=None):
    """The lens of the design in a mount, and that mount."""
    mount, lens = Mount.model_validate(mount), design.lens
    lens = lens if curvature is None else lens.with_front(Sphere(lens.front.z, curvature))
    return lens.with_clear(mount.clear(lens)), mount


@pytest.mark.parametrize("name", suite.in_turns(MOUNTS, 2))
def test_the_light_is_that_of_rays_through_the_faces_of_the_part(design, name, tmp_path):
    """Polygons along the edges of part.step's faces decide which rays get through: all parallel, or from a point."""
    table = dict(MOUNTS[name])
    curved = table.pop("curvature", None)
    lens, mount = held(design, table, curved)
    mounting.write_if_it_fits(lens, mount, tmp_path / "part.step", "part", design.scene.part)
    found = step_checks.lens_of_part(tmp_path, lens, mount)
    for measured, designed in zip(found.apertures, lens.apertures, strict=True):
        assert type(measured) is type(designed)
        assert np.abs(measured.depth(*designed.rim_points())).max() < 1e-4
    around, screen = polygons(tmp_path / "part.step"), replace(design.scene.target.screen, pixels=8)
    wide = found.apertures[0].half_extent[0] < 0.98 * found.apertures[1].half_extent[0]
    for source in (design.scene.source, CollimatedSource(Rectangle(9.0, 7.0))):
        light = measure(
            found, [Channel(source, lens.index)], screen, np.ones(screen.shape), Effort(512, accuracy=0, witness=False)
        )
        seen = independent(source, lens, around, screen)
        assert light.flux["on target"] == pytest.approx(seen.sum(), rel=1.5e-3)
        picture, seen = light.picture / light.picture.sum(), seen / seen.sum()
        assert np.abs(picture - seen).max() < 0.015 * seen.max()
    assert wide == bool(mount.draft)  # of parallel light the front's edge takes the most


def polygons(path):
    """(n, 2) corners in mm along the outer edges of front and back: of the faces around the axis, the lowest and the
    highest."""
    found = []
    for face in cadquery.importers.importStep(str(path)).faces().vals():
        box = face.BoundingBox()
        if not (box.xmin < 0 < box.xmax and box.ymin < 0 < box.ymax):
            continue  # it is beside the axis; the places of its edges take a tenth of a second
        edge = np.array([(p.x, p.y, p.z) for p in _along(face.outerWire())])
        if inside(edge[:, :2], np.zeros((2, 1)))[0] and not face.innerWires():
            found.append((edge[:, 2].mean(), edge[:, :2]))
    (_, front), (_, back) = sorted(found, key=lambda pair: pair[0])
    return front, back


def _along(wire):
    """Places along a closed wire in its order."""
    ordered = cadquery.Wire.assembleEdges(wire.Edges())
    return ordered.positions(np.linspace(0, 1, 200, endpoint=False), mode="length")


def inside(corners, places):
    """Return True for the points (2, n) inside a polygon: a line along +x crosses an odd number of its sides."""
    x, y = places
    odd = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            odd ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return odd


def independent(source, lens, around, screen, count=1 << 17):
    """(rows, columns) flux of Sobol's rays that meet both faces within the polygons."""
    window = Rectangle(7.0, 6.4)  # no rim is wider
    points = SobolEngine(2, scramble=True, seed=5).draw(count, dtype=torch.float64) - 0.5
    x, y = points[:, 0] * window.width, points[:, 1] * window.height
    rays = source.rays_through(x, y, lens.front.z, window.area / count)
    flux = rays.flux.numpy().copy()
    for interface, polygon in zip(lens.unbounded().interfaces, around, strict=True):
        rays = cross(rays, interface).rays
        flux *= inside(polygon, rays.position[:2].numpy())
    x, y, _ = screen.receiver.to(rays).position.numpy()
    seen, _, _ = np.histogram2d(y, x, bins=screen.shape, range=(screen.y, screen.x), weights=flux)
    return seen[::-1]


def test_walls_that_lean_leave_the_front_what_their_height_makes_of_it():
    """d = tan(draft) (h - bevel) + bevel below a plane front; of a curved one the highest wall counts."""
    lens = Lens.between(Plane(15.0), net(m=9, half=9.0), Rectangle(16.0, 16.0), 1.5)
    lean = {"draft": 4.0, "bevel": 0.3}
    tangent = math.tan(math.radians(4.0))
    box = {"shape": "rectangle", "width": 12.0, "height": 10.0, "corner_radius": 2.0}
    for flange, top in ((None, 19.9), ({"outline": FLANGE["outline"], "z": 17.0, "thickness": 1.0}, 17.0)):
        front, back = Mount.model_validate({"rim": box, "flange": flange} | lean).clear(lens)
        taken = tangent * (top - 15.0 - 0.3) + 0.3
        assert (front.width, front.height, front.corner_radius) == pytest.approx(
            (12 - 2 * taken, 10 - 2 * taken, 2 - taken)
        )
        assert (back.width, back.height, back.corner_radius) == (12.0, 10.0, 2.0)
    bowl = lens.with_front(Sphere(15.0, 0.05))
    front, _ = Mount.model_validate({"rim": box, "draft": 4.0}).clear(bowl)
    by = (12.0 - front.width) / 2  # nearest to the axis is the middle of the long side, where the front is lowest
    height = 19.9 - (20 + 15.0 - math.sqrt(400 - (5.0 - by) ** 2))
    assert by == pytest.approx(tangent * height, rel=1e-9)
    assert Mount().clear(lens) is None and Mount(datum="front").clear(lens) is None


def test_what_a_flange_stands_in_the_way_of():
    """Parallel light at 20 degrees through a plate: its beam is what three circles, each shifted on, have in common."""
    clear = Circle(5.0), Circle(5.0)
    lens = Lens.between(Plane(15.0), net(m=9, half=9.0), Rectangle(16.0, 16.0), 1.5, clear=clear)
    light = [Channel(CollimatedSource(Rectangle(30.0, 30.0), tilt=(0.0, 20.0)), 1.5)]
    outside, glass = math.tan(math.radians(20)), math.tan(math.asin(math.sin(math.radians(20)) / 1.5))

    def common(shift):
        """Area (mm²) of two circles of radius 5 mm with their centres so far apart."""
        return 50 * math.acos(shift / 10) - shift / 2 * math.sqrt(100 - shift**2)

    within, none = 5 * glass, (16.0, 18.0)
    assert mount_losses(lens, light, none).on_flange == 0
    assert mount_losses(lens, light, (16.0, 24.0)).on_flange == pytest.approx(
        1 - common(within + 4 * outside) / common(within), abs=2e-3
    )
    assert mount_losses(lens, light, (12.0, 18.0)).on_flange == pytest.approx(
        1 - common(within + 3 * outside) / common(within), abs=2e-3
    )
    square = 16.0 * (16.0 - within)
    assert mount_losses(lens, light).cut == pytest.approx(1 - common(within) / square, abs=2e-3)


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """The scene whose lens was once tailored and proved uncut: (scene, folder, contents of its report, proof)."""
    table = {"lens.back.control_points": 33, "target.pixels": 48, "tailoring.quality": "draft", "mount": CUT}
    scene, folder = load(DISK).changed(table), tmp_path_factory.mktemp("cut") / "cut"
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        kept = proofs(patch)
        report = commands.write(designed_quickly(scene), folder, ProofOptions(replace(quick_effort(), places=1025)))
    return scene, folder, report, kept[0]


@suite.in_turn(0, 2)
def test_a_lens_is_tailored_for_what_the_mount_leaves_of_it(cut):
    _, folder, contents, proof = cut
    assert proof.passed and proof.light.rrmsd < 0.03  # of the uncut lens through these apertures over 0.4
    assert proof.lens.clear == (Circle(4.5), Circle(4.5))
    assert "mount-cut" in contents.remarks
    assert bstcad.open(folder).lens.clear == (Circle(4.5), Circle(4.5))


@suite.in_turn(0, 2)
def test_the_figures_of_its_shape_are_those_of_what_is_left(cut):
    """The corners of the whole square are thicker than the edge of the circle that is cut out of it."""
    _, folder, contents, proof = cut
    lens, turn = bstcad.open(folder).lens, torch.linspace(0, 2 * math.pi, 4001, dtype=torch.float64)
    x, y = 4.5 * turn.cos(), 4.5 * turn.sin()
    edge = lens.back.sag_and_slope(x, y)[0] - lens.front.sag_and_slope(x, y)[0]
    assert contents.shape["edge_thickness_min"] == pytest.approx(float(edge.min()), abs=1e-5)
    assert proof.shape["thickness_max"] < describe(lens, 129)["thickness_max"] - 1e-3


@suite.in_turn(0, 2)
def test_a_part_with_another_rim_is_judged_by_its_own_light_and_fails_by_name(cut, tmp_path):
    scene, folder, _, before = cut
    made = bstcad.open(folder)
    other = scene.changed({"mount": CUT | {"rim": {"shape": "circle", "diameter": 7.5}}})
    copy = tmp_path / "other"
    shutil.copytree(folder, copy)
    mounting.write_if_it_fits(made.lens, other.mount, copy / "part.step", "other", scene.part)
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        proof = commands.verify(copy, options=ProofOptions(quick_effort()))
    failed = {check.id: check.where for check in proof.checks if not check.passed}
    assert proof.flux["on target"] < 0.8 * before.light.flux["on target"] and proof.rrmsd > 0.2
    assert "\u00d87.5 mm, but the lens was tailored for \u00d89 mm" in failed["clear-aperture"]
    assert "the mount leaves \u00d87.5 mm of the back and cuts away" in failed["rrmsd"]


def test_a_mirror_cut_to_a_circle_gets_the_light_of_the_cone_that_its_rim_leaves():
    """A uniform cone of half angle a from z = 120: the rim takes ∮ (1 - cos θ(φ)) dφ / (2π (1 - cos a)) of it."""
    mount = {"rim": {"shape": "circle", "diameter": 40.0}, "draft": 2.0, "bevel": 0.3}
    scene = load(DISK.with_name("mirror.toml")).changed({"lens.back.control_points": 33, "mount": mount})
    lens = scene.as_mounted(scene.flat_lens(33))
    line = torch.linspace(-1.0, 1.0, 33, dtype=torch.float64)
    lens = lens.with_back(replace(lens.back, heights=2.0 * line[:, None] ** 2 + line**2))  # a bowl
    assert lens.clear[1] == Circle(20.0)
    turn = torch.linspace(0, 2 * math.pi, 4001, dtype=torch.float64)[:-1]
    rim, _, _ = lens.back.sag_and_slope(20 * turn.cos(), 20 * turn.sin())
    caps = 1 - (120 - rim) / ((120 - rim) ** 2 + 20**2).sqrt()
    met = float(caps.mean()) / (1 - math.cos(math.radians(16)))
    screen = Screen(620.0, (-600.0, 600.0), (-600.0, 600.0), 8)
    light = measure(lens, scene.channels(), screen, np.ones(screen.shape), quick_effort())
    assert light.flux["missed the lens"] == pytest.approx(1 - met, abs=2e-4)
