"""A surface, a receiver, an emitter, a merit, an effect, checks, sections, a judge of one's own: the package stays."""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import bstcad
from bstcad.api import Design
from bstcad.cad import mesh, patches
from bstcad.designs import pipeline
from bstcad.exports.data_sheet import DataSheet
from bstcad.figures.figure_jobs import light_path_of
from bstcad.figures.light_figures import View
from bstcad.manufacture.tolerance.perturbations import Setup, kinds
from bstcad.optics.light.emitters import Emitter, all_alive
from bstcad.optics.receivers.receivers import Receiver
from bstcad.optics.surfaces.motion import Motion
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.rays import Rays, Status
from bstcad.optics.surfaces.surfaces import sag
from bstcad.report import record
from bstcad.report.units import about
from bstcad.scene import fronts
from bstcad.scene.errors import SceneError
from bstcad.scene.target import Target
from bstcad.verify.judges import faces, mitsuba
from bstcad.verify.nominal import Nominal
from tests import suite
from tests.conftest import draws_nothing, quick_effort
from tests.efforts import LITTLE, designed_quickly

OUTLINE = Rectangle(16.0, 16.0)


@dataclass(frozen=True)
class Asphere(bstcad.Surface):
    """z = z0 + c r² / (1 + sqrt(1 - c² r²)) + a4 r⁴ + a6 r⁶, r² = x² + y² (mm)."""

    z: float
    curvature: float
    a4: float
    a6: float
    kind: str = "asphere"

    def relative_sag_and_slope(self, x, y):
        r2 = x * x + y * y
        root = torch.sqrt(1 - self.curvature**2 * r2)
        over_r = self.curvature / root + r2 * (4 * self.a4 + 6 * self.a6 * r2)
        return self.curvature * r2 / (1 + root) + r2 * r2 * (self.a4 + self.a6 * r2), over_r * x, over_r * y

    def sags(self, outline):
        rim = float(self.relative_sag_and_slope(*(torch.tensor(p) for p in outline.farthest))[0])
        return min(rim, 0.0), max(rim, 0.0)


@pytest.fixture(scope="module")
def scene():
    """A disc by 33 x 33 control points, to a 48 x 48 picture."""
    changes = {"lens.back.control_points": 33, "target.pixels": 48, "tailoring.quality": "draft", "tailoring.rays": 192}
    return bstcad.load("templates/disk.toml").changed(changes)


@pytest.fixture(scope="module")
def design(scene, tmp_path_factory):
    """Return the design of the scene, written."""
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        design = Design(designed_quickly(scene))
        design.write(tmp_path_factory.mktemp("own") / "disk", progress=False, effort=quick_effort())
    return design


@pytest.mark.parametrize("ask", [
    lambda lens: patches.front_patch(lens), lambda lens: faces.face(lens.front, OUTLINE),
    lambda lens: mesh.chordal_error(mesh.lens_mesh(lens, 8), lens), lambda lens: lens.front.scaled(1.01, 0.0),
], ids=["CAD", "judge", "mesh", "tolerance"])  # fmt: skip
def test_a_surface_that_no_net_stands_for_is_refused_by_its_kind(scene, ask):
    """Nothing takes it for a sphere of its curvature."""
    back = scene.flat_lens(33).back
    with pytest.raises(ValueError, match="the asphere is no plane, sphere or conic; pass it to scene.changed"):
        ask(bstcad.Lens.between(Asphere(15.0, 0.01, 1e-6, 0.0), back, OUTLINE, 1.5))


def test_a_surface_that_no_net_comes_near_is_refused(scene, monkeypatch):
    monkeypatch.setattr(fronts, "FIT_SIZES", fronts.FIT_SIZES[:2])
    rough = Asphere(15.0, 0.0, 0.5, 0.0)
    with pytest.raises(bstcad.SceneError, match="lens.front: .* the asphere .* 1e-06 mm is the maximum"):
        scene.changed({"lens.front": rough})


@dataclass(frozen=True)
class Cylinder(Receiver):
    """Around the y axis; s is the way along its arc from the z axis (mm)."""

    radius: float
    names = ("s", "y")

    @property
    def middle(self):
        return 0.0, 0.0, self.radius

    def path(self, rays):
        (x, _, _), (d_x, _, d_z), z = rays.position, rays.direction, rays.above(0.0)
        a, b, c = d_x * d_x + d_z * d_z, x * d_x + z * d_z, x * x + z * z - self.radius**2
        inside = (c < 0) & (d_z > 0)
        status = rays.lose(~inside, Status.TURNED_BACK)
        return torch.where(inside, (torch.sqrt((b * b - a * c).clamp(min=0)) - b) / a, 0.0), status

    def coordinates(self, rays):
        return self.radius * torch.atan2(rays.position[0], rays.above(0.0)), rays.position[1]

    def point(self, x, y):
        angle = torch.as_tensor(x) / self.radius
        across, along = self.radius * torch.sin(angle), self.radius * torch.cos(angle)
        return (across, y, along) if isinstance(x, torch.Tensor) else (across.numpy(), y, along.numpy())

    def normal(self, aim):
        return torch.sin(aim[0] / self.radius), 0.0, torch.cos(aim[0] / self.radius)


class OnCylinder(Target):
    """A target around the lens."""

    @property
    def screen(self):
        return replace(super().screen, surface=Cylinder(self.z))


def test_a_receiver_of_its_own_is_refused_where_it_cannot_be(scene):
    """A cylinder that cuts the lens, which is 8 mm wide to each side, and one that would be seen past a window."""
    around = scene.model_copy(update={"targets": (OnCylinder(**dict(scene.target)),)})
    lens = around.lens
    assert around.target.clearance(lens, 20.0) == pytest.approx(np.sqrt(500.0**2 - 8.0**2) - 20.0)
    with pytest.raises(SceneError, match=r"^target\.z: the plane of the target cuts the lens; move the target"):
        around.changed({"target.z": 21.0})
    rim = {"shape": "circle", "radius": 90.0}
    window = {"kind": "window", "z": 100.0, "thickness": 3.0, "index": 1.5, "outline": rim}
    with pytest.raises(SceneError, match=r"^target: windows and mirrors behind the lens"):
        around.changed({"behind": [window]})


@dataclass(frozen=True)
class Directions(Receiver):
    """Directions by a sphere around the origin: h to the side from the z axis, v up from the plane y = 0 (degrees)."""

    radius: float
    unit = "degrees"
    names = ("h", "v")

    @property
    def middle(self):
        return 0.0, 0.0, self.radius

    def position_text(self, origin=0.0):
        return f"all directions, {self.radius / 1000:g} m away"

    def per_radian(self, z):
        return math.degrees(self.throw(z) / self.radius)

    def areas(self, x, y, shape):
        rows, columns = shape
        heights = np.abs(np.diff(np.sin(np.radians(np.linspace(*y[::-1], rows + 1)))))
        return np.repeat(heights[:, None] / heights.mean(), columns, axis=1)

    def path(self, rays):
        place, direction = (*rays.position[:2], rays.above(0.0)), rays.direction
        b, c = dot(place, direction), dot(place, place) - self.radius**2
        status = rays.lose(~(c < 0), Status.TURNED_BACK)
        return torch.where(c < 0, torch.sqrt((b * b - c).clamp(min=0)) - b, 0.0), status

    def coordinates(self, rays):
        x, y, z = (*rays.position[:2], rays.above(0.0))
        return torch.rad2deg(torch.atan2(x, z)), torch.rad2deg(torch.asin(y / self.radius))

    def point(self, x, y):
        h, v = (torch.deg2rad(torch.as_tensor(angle, dtype=torch.float64)) for angle in (x, y))
        there = torch.cos(v) * torch.sin(h), torch.sin(v), torch.cos(v) * torch.cos(h)
        return tuple(self.radius * (p if isinstance(x, torch.Tensor) else p.numpy()) for p in there)

    def normal(self, aim):
        return tuple(p / self.radius for p in self.point(*aim))


def dot(a, b):
    return sum(p * q for p, q in zip(a, b, strict=True))


class OverDirections(Target):
    """A target over directions."""

    @property
    def screen(self):
        return replace(super().screen, surface=Directions(self.z))


@suite.in_turn(0, 3)
def test_light_over_directions_is_stated_in_degrees(scene, tmp_path, monkeypatch):
    """Even light a solid angle, by design, proof and report; pages, sheets and sentences have the receiver's words."""
    draws_nothing(monkeypatch)
    few = replace(quick_effort(), rays=192)  # a receiver without kernels takes ten times as long a ray
    asked = scene.changed({"target.z": 10_000.0, "target.x": [-20.0, 20.0], "target.y": [-40.0, 40.0],
                           "target.outline": None, "target.pixels": [24, 48], "accept.rrmsd": 0.1,
                           "tailoring.rays": 96})  # fmt: skip
    far = asked.model_copy(update={"targets": (OverDirections(**dict(asked.target)),)})
    design = Design(designed_quickly(far))
    report = design.write(tmp_path / "far", progress=False, effort=few)
    assert report.passed and report.rrmsd < 0.05, report
    lit = bstcad.measure(design.lens, far.channels(), far.target.screen, design.target, few)
    flux = lit.picture.sum(1)
    v = np.radians(np.linspace(40.0, -40.0, 49))
    intensity = flux / (np.sin(v[:-1]) - np.sin(v[1:]))
    assert intensity[2:-2] == pytest.approx(intensity.mean(), rel=0.05)
    assert flux[3] < 0.85 * flux[24]  # cos 36 degrees, nearly

    contents = record.read(tmp_path / "far" / "report.json")
    [goal] = contents.goals
    place = "all directions, 10 m away"
    assert (goal.where, goal.unit, contents.finest_detail.unit) == (place, "degrees", "degrees")
    detail = contents.finest_detail
    assert detail.pixel == pytest.approx(40 / 24) and detail.nearer_distance is None
    page = (tmp_path / "far" / "report.html").read_text(encoding="utf-8")
    finest = contents.remaining_error["octaves"][-1]["period"]
    assert about(detail.width, "degrees") in page and about(finest[0], "degrees") in page
    sheet = DataSheet(
        scene=far, designed=design.lens, shape=contents.shape, order=contents.order, target=design.target,
        irradiance=design.target, figures=contents.goals, passed=True, version="1",
    )  # fmt: skip
    [words] = [dict(rows) for rows in sheet.tables.values() if "Picture" in dict(rows)]
    assert words["Size"].startswith("40 × 80 degrees") and words["Screen"] == f"{place} in lens.step"
    assert words["Extent"] == "h ±20, v ±40 degrees"
    view = View.of(far)
    assert view.labels == ("h (degrees)", "v (degrees)") and np.ptp(view.tones(design.target, design.target)) == 0
    shown = light_path_of(Nominal(far, design.lens, far.goals), [design.target])
    assert f"Target 40 × 80 degrees at {place}" in shown.words


def test_a_receiver_of_its_own_is_moved_as_its_points_are():
    """Rays meet the moved cylinder where a point of it is, under that point's own coordinates, and at its normal."""
    motion = Motion.of(shift=(3.0, -2.0, 5.0), turn=(4.0, 7.0, 10.0), about=(0.0, 0.0, 20.0))
    moved = Cylinder(100.0).moved(motion)
    x, y = (p.double() for p in torch.meshgrid(torch.linspace(-40, 40, 9), torch.linspace(-30, 30, 7), indexing="xy"))
    places = torch.stack(moved.point(x, y))
    way = places - torch.tensor([1.0, 2.0, 0.0]).view(3, 1, 1)
    start = torch.tensor([1.0, 2.0, -15.0], dtype=torch.float64).view(3, 1, 1).expand_as(way)
    flux, lost = torch.ones_like(x), torch.zeros(x.shape, dtype=torch.uint8)
    landed = moved.land(Rays(start, way / way.norm(dim=0), flux, lost, z=15.0))
    assert landed.alive.all() and torch.allclose(landed.position, torch.stack([x, y]), atol=1e-9)
    step = 1e-4  # mm along the arc and along y
    along = [torch.stack(moved.point(x + a, y + b)) - places for a, b in ((step, 0.0), (0.0, step))]
    normal = torch.stack([torch.as_tensor(n).expand_as(x) for n in moved.normal(torch.stack([x, y]))])
    for tangent in along:
        assert ((tangent * normal).sum(0).abs() < 1e-5 * step).all()
    back = moved.moved(motion.inverse).point(x, y)
    assert torch.allclose(torch.stack(back), torch.stack(Cylinder(100.0).point(x, y)), atol=1e-9)
    assert moved.labels == Cylinder(100.0).labels


@dataclass(frozen=True)
class Oval(Emitter):
    """Parallel light along +z, E = 2 / (π w v) exp(-2 (x² / w² + y² / v²))."""

    w: float
    v: float
    wavelength: float = 587.6
    parallel = True

    def irradiance(self, x, y, z):
        return 2 / (np.pi * self.w * self.v) * torch.exp(-2 * ((x / self.w) ** 2 + (y / self.v) ** 2))

    def window(self, outline, z, sags):
        return Rectangle(*(2 * half for half in outline.half_extent))

    def rays_through(self, x, y, z, area):
        place = torch.stack([x, y, torch.zeros_like(x)])
        along = torch.stack([torch.zeros_like(x), torch.zeros_like(x), torch.ones_like(x)])
        return Rays(place, along, self.irradiance(x, y, z) * area, all_alive(x), axial=True, z=z - 20.0)


@suite.in_turn(2, 3)
@pytest.mark.filterwarnings("ignore:Pydantic serializer")  # no file says of which kind such a source is
def test_light_of_an_emitter_of_its_own_is_spread_evenly(scene, tmp_path, monkeypatch):
    """Design, proof and report know it: an oval beam, much brighter in its middle, on an even square."""
    draws_nothing(monkeypatch)
    asked = scene.changed({"target.x": [-20.0, 20.0], "target.y": [-20.0, 20.0], "target.outline": None})
    oval = asked.model_copy(update={"source": Oval(5.0, 8.0)})
    design = Design(designed_quickly(oval))
    report = design.write(tmp_path / "oval", progress=False, effort=quick_effort())
    assert report.passed and report.rrmsd < 0.1, report
    assert sum(report.flux.values()) == pytest.approx(1, abs=1e-12)
    flat, even = oval.flat_lens(33), oval.target.irradiance()
    assert bstcad.measure(flat, oval.channels(), oval.target.screen, even, quick_effort()).rrmsd > 0.5


def test_an_emitter_of_its_own_answers_or_declines_in_a_sentence(scene):
    """Sizes and position follow from its class; errors that would move its light are refused, and others are not."""
    oval = scene.model_copy(update={"source": Oval(5.0, 8.0)})
    setup = Setup(scene.flat_lens(33), oval.channels(), scene.target.screen)
    assert (oval.source.lumens, oval.source.with_wider_cone(0.1)) == (None, None)
    assert "source.axial" not in (known := kinds(setup)) and "lens.clocking" not in known and "source.size" not in known
    known["lens.thickness"].apply(setup, 0.1)
    with pytest.raises(SceneError, match="^tolerance: the emitter Oval .* moved"):
        known["lens.decentre_x"].apply(setup, 0.1)
    assert mitsuba.cannot(setup.lens, setup.channels) == "Mitsuba has no lamp for the light of Oval"


@pytest.mark.filterwarnings("ignore:Pydantic serializer")
def test_changes_of_a_scene_keep_source_and_targets_of_its_own(scene):
    around = scene.model_copy(update={"targets": (OnCylinder(**dict(scene.target)),), "source": Oval(5.0, 8.0)})
    changed = around.changed({"target.z": 300.0, "lens.min_thickness": 0.5})
    assert changed.target.screen.receiver == Cylinder(300.0) and changed.lens.min_thickness == 0.5
    assert changed.source is around.source
    assert around.changed({"source": scene.source, "target": scene.target}) == scene


def test_a_merit_of_its_own_is_refused_for_several_goals(scene):
    two = scene.changed({"target": [scene.target, scene.target.model_copy(update={"z": 2 * scene.target.z})]})
    with pytest.raises(SceneError, match="^merit: "):
        pipeline.design(two, options=pipeline.DesignOptions(lambda picture, target: ((picture - target) ** 2).sum()))


@suite.in_turn(1, 3)
def test_a_merit_of_its_own_is_made_less_than_by_rrmsd(scene):
    """A letter on black, which 33 x 33 control points cannot draw, leaves an error that each merit shares out."""
    scene = scene.changed({"target.uniform": None, "target.outline": None, "target.text": "L"})

    def relative(picture, target):
        weight = 1 / (target + 0.1 * target.mean())
        return (weight * (picture - target) ** 2).sum() / (weight * target**2).sum()

    options = (pipeline.DesignOptions(merit, compare_later=True, effort=LITTLE) for merit in (None, relative))
    designs = [Design(pipeline.design(scene, options=each)) for each in options]
    merits = []
    for made in designs:
        channels, screen = made.scene.channels(), made.scene.target.screen
        picture = bstcad.RayTubes.launched(made.lens, channels, 192).picture(made.lens, screen)
        merits.append(float(relative(picture / picture.sum(), torch.from_numpy(made.target))))
    assert merits[1] < 0.9 * merits[0]


def test_checks_and_sections_of_a_script_join_verdict_and_page(design, monkeypatch):
    draws_nothing(monkeypatch)

    def weight(proof, folder):
        assert (folder / "lens.step").is_file()
        yield bstcad.Check.at_most("weight", proof.shape["volume"] * 1.19e-3, 1e-6, "g")

    def budget(report):
        return "Light budget", f"<p id='budget'>{report.light_on_target:.3f}</p>"

    report = design.verify(checks=[weight], sections=[budget], progress=False, effort=quick_effort())
    assert not report.passed and [check.name for check in report.checks if not check.passed] == ["weight"]
    page = (design.folder / "report.html").read_text(encoding="utf-8")
    assert f"<h2>Light budget</h2>\n<p id='budget'>{report.light_on_target:.3f}</p>" in page
    assert json.loads((design.folder / "report.json").read_text())["verdict"] == "failed"
    assert design.verify(progress=False, effort=quick_effort()).passed


@dataclass(frozen=True)
class Dust:
    """exp(-cover / cos θ) goes on at each face."""

    wavelength: float
    cover: float = 0.02

    def share(self, cos_in, cos_out, path):
        return torch.exp(-self.cover / cos_in)


@dataclass(frozen=True)
class Haze:
    """Absorption, written once more: exp(-a s) in the glass."""

    wavelength: float
    in_glass = True

    def share(self, cos_in, cos_out, path):
        return torch.exp(-0.01 * path)


def with_effects(scene, *effects):
    return scene.changed({"effects": list(effects)})


def test_an_effect_of_a_script_is_that_of_the_package_with_the_same_law(scene):
    """Absorption by a script's loss and by bstcad's: one picture, one ledger, one gradient through the flux tubes."""
    lens = scene.flat_lens(33)
    pictures, gradients = [], []
    for named in (bstcad.effect("haze", Haze), {"kind": "absorption", "coefficient": 0.01}):
        lossy = with_effects(scene, named)
        heights = lens.back.heights.clone().requires_grad_()
        tubes = bstcad.RayTubes.launched(lens, lossy.channels(), 96)
        picture = tubes.picture(lens.with_back(replace(lens.back, heights=heights)), lossy.target.screen)
        gradients += torch.autograd.grad((picture * torch.from_numpy(scene.target.irradiance())).sum(), heights)
        even = lossy.target.irradiance()
        pictures.append(bstcad.measure(lens, lossy.channels(), lossy.target.screen, even, quick_effort()))
    own, absorbed = pictures
    assert own.flux["taken by haze"] == pytest.approx(absorbed.flux["absorbed in the glass"], rel=1e-9)
    assert own.flux["taken by haze"] > 0.01 * absorbed.flux["on target"]
    assert np.allclose(own.picture, absorbed.picture, rtol=1e-9, atol=1e-15)
    assert gradients[0].abs().max() > 0
    assert torch.allclose(*gradients, rtol=1e-9, atol=1e-9 * float(gradients[1].abs().max()))


def test_an_aspheric_front_of_order_six_becomes_an_exact_face_and_an_effect_is_proved_with_it(
    scene, tmp_path, monkeypatch
):  # fmt: skip
    """Both by one design, opened again without the class of the surface, and by the name of the effect."""
    draws_nothing(monkeypatch)
    front = Asphere(15.0, -0.0005, 2e-7, -1e-10)
    scene = with_effects(scene.changed({"lens.front": front}), bstcad.effect("dust", Dust))
    design = Design(designed_quickly(scene))
    x, y = np.meshgrid(np.linspace(-8, 8, 400), np.linspace(-8, 8, 400))
    assert np.abs(sag(design.lens.front, x, y) - sag(front, x, y)).max() <= 1e-6  # mm
    few = replace(quick_effort(), rays=256)  # an effect without kernels takes ten times as long a ray
    report = design.write(tmp_path / "own", progress=False, effort=few)
    form = {check.name: check for check in report.checks if check.name.startswith("form")}
    assert len(form) >= 2 and report.passed, report
    taken, through = report.flux["taken by dust"], report.flux["on target"] + report.flux["off target"]
    two_faces = 1 - np.exp(-2 * 0.02)
    assert two_faces < taken / (through + taken) < 1.3 * two_faces  # at a slant, and from light that the sides take
    assert sum(report.flux.values()) == pytest.approx(1, abs=1e-12)
    assert 'name = "dust"' in (tmp_path / "own" / "scene.toml").read_text()
    again = bstcad.open(tmp_path / "own")
    assert torch.equal(again.lens.front.heights, design.lens.front.heights)
    assert again.scene.effects == design.scene.effects


def test_an_effect_that_nobody_knows_or_that_is_named_twice_is_refused_in_a_sentence(scene):
    unknown = {"kind": "own", "name": "fog"}
    with pytest.raises(bstcad.SceneError, match="effects.* 'fog'"):
        with_effects(scene, unknown)
    twice = bstcad.effect("dust", Dust)
    with pytest.raises(bstcad.SceneError, match="'dust' is named twice"):
        with_effects(scene, twice, twice)


def test_a_share_that_is_no_tensor_is_named(scene):
    class Half:
        def __init__(self, wavelength):
            pass

        def share(self, cos_in, cos_out, path):
            return 0.5

    half = with_effects(scene, bstcad.effect("half", Half))
    with pytest.raises(ValueError, match=r"effect 'half': share\(\) returned float; return a tensor of the shape"):
        bstcad.measure(scene.flat_lens(33), half.channels(), half.target.screen, half.target.irradiance())


def test_an_installed_package_brings_an_effect_along(scene, tmp_path, monkeypatch):
    """The entry point is found when the scene file is read."""
    (tmp_path / "dusty_lenses.py").write_text(
        "class Dust:\n    def __init__(self, nm): pass\n    def share(self, cos_in, cos_out, path): return cos_in\n"
    )
    facts = tmp_path / "dusty_lenses-1.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: dusty-lenses\nVersion: 1\n")
    (facts / "entry_points.txt").write_text("[bstcad.effects]\nspray = dusty_lenses:Dust\n")
    path = tmp_path / "scene.toml"
    path.write_text('effects = [{ kind = "own", name = "spray" }]\n' + scene.toml())
    monkeypatch.syspath_prepend(tmp_path)
    [channel] = bstcad.load(path).channels()
    assert channel.losses.own[0].line == "taken by spray"
