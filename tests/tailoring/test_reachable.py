"""The part of a target that a design can light: found before it, lit without total reflection, stated in its report."""

import json
import math

import numpy as np
import pytest
import torch

from bstcad import cli
from bstcad.designs.pipeline import reachable_part
from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.reach import largest_deflection
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load
from bstcad.tailoring import reachable
from bstcad.tailoring.driver import Edge
from bstcad.tailoring.grazing import Grazing
from tests import suite
from tests.conftest import draws_nothing, quick_effort, verify_with
from tests.efforts import designed_quickly

SCENE = """
name = "wide"
[source]
kind = "collimated"
wavelength = 587.6
aperture = { shape = "rectangle", width = 4.0, height = 4.0 }
[lens]
index = 1.4936
outline = { shape = "rectangle", width = 4.0, height = 4.0 }
front = { kind = "plane", z = 0.0 }
back = { kind = "bspline", z = 2.0, control_points = 33 }
[target]
z = 202.0
x = [-200.0, 200.0]
y = [-200.0, 200.0]
pixels = 48
uniform = true
[tailoring]
quality = "draft"
rays = 192
"""
POINT = {
    "source": {"kind": "point", "position": [0, 0, 0], "wavelength": 587.6, "profile": "uniform", "half_angle": 10.0},
    "lens.front.z": 18.0,
    "lens.back.z": 20.0,
}
MIRROR = {"lens.index": None, "lens.back.reflect": True, "source.z": 300.0}


@pytest.fixture
def wide(tmp_path):
    """A scene file of a target of which light can reach a disc."""
    path = tmp_path / "wide.toml"
    path.write_text(SCENE)
    return path


def part_of(scene):
    return reachable_part(scene, *scene.goals)


def radii(scene):
    """(rows, columns) distance of each pixel's middle from the middle of the target (mm)."""
    n, size = scene.target.pixels, scene.target.size[0]
    line = (np.arange(n) + 0.5) * size / n - size / 2
    return np.hypot(*np.meshgrid(line, line))


def test_parallel_light_reaches_a_disc(wide):
    """The disc has the radius L tan δ and at most half the lens more, since its edge sends light there."""
    scene = load(wide)
    part, edge = part_of(scene)
    radius, r = 200.0 * math.tan(largest_deflection(1.4936)), radii(scene)
    pixel = math.hypot(*[400.0 / 48] * 2)
    assert part[r < radius - pixel].all() and not part[r > radius + 2.9 + pixel].any()
    assert math.degrees(edge.angle) == pytest.approx(85.0)


@pytest.mark.parametrize(
    "change",
    [{"target.z": 602.0}, {"target.x": [-4, 4], "target.y": [-4, 4], "target.z": 8.0}, {"target.x": [-20, 20]}],
    ids=["far", "as near as wide", "narrow"],
)
def test_a_target_within_reach_is_whole(wide, change):
    """Near the lens, too, where its middle alone could not reach the corners: other places do."""
    assert part_of(load(wide, change | {"target.y": change.get("target.y", [-20, 20])})) == (None, None)


@pytest.mark.parametrize("half", [20.0, 150.0, 160.0, 170.0, 180.0], ids="{:g}".format)
def test_few_points_that_reach_all_say_what_all_points_say(wide, half, monkeypatch):
    """Targets from one within reach to one whose corners are beyond it."""
    scene = load(wide, {"target.x": [-half, half], "target.y": [-half, half]})
    found = part_of(scene)
    tried = []
    monkeypatch.setattr(reachable, "_reaches_all", lambda *given, **more: tried.append(given))
    wanted = part_of(scene)
    assert len(tried) == 1 and found[1] == wanted[1]
    assert found[0] is wanted[0] is None or np.array_equal(found[0], wanted[0])


def test_black_parts_out_of_reach_do_not_count(wide):
    """Letters in the middle of the same target."""
    assert part_of(load(wide, {"target.uniform": None, "target.text": "I"}))[0] is None


def test_a_tilt_turns_part_of_the_target_away(wide):
    """Tilted by 60° about y its far edge lies aslant behind, the other one before: their bounds differ."""
    part, _ = part_of(load(wide, {"target.tilt": [0.0, 60.0]}))
    columns = part.any(0)
    assert 0.2 < part.mean() < 0.9 and columns[: len(columns) // 2].sum() != columns[len(columns) // 2 :].sum()


def test_a_point_source_and_a_tilted_beam_shift_what_is_reached(wide):
    """Light that comes aslant is bent further to its own side than to the other."""
    part, _ = part_of(load(wide, POINT))
    assert 0.5 < part.mean() < 1.0 and part[24, 24]
    part, _ = part_of(load(wide, {"source.tilt": [0.0, 20.0]}))
    assert part[:, 24:].mean() > part[:, :24].mean() + 0.1


def test_a_mirror_reaches_what_a_lens_cannot(wide):
    assert part_of(load(wide, MIRROR)) == (None, None)


def test_nothing_within_reach_is_refused(wide):
    with pytest.raises(SceneError, match="^target: "):
        part_of(load(wide, {"target.x": [900.0, 1300.0]}))


def test_refuse_names_angle_and_remedy(wide, capsys):
    code = cli.run(["generate", str(wide), "--set", "target.unreachable=refuse", "-o", str(wide.parent / "out")])
    said = " ".join(capsys.readouterr().err.split())
    assert code == 2 and "cannot be lit" in said and "48 degrees" in said and "mirror" in said
    assert not (wide.parent / "out").exists()


@suite.in_turn(1, 2)
def test_each_of_several_targets_is_cut_to_what_light_can_reach(wide):
    """A small target near by, which light reaches whole, and the wide one behind it, of which it reaches a disc."""
    text = wide.read_text()
    near = "[[target]]\nz = 102.0\nx = [-40.0, 40.0]\ny = [-40.0, 40.0]\npixels = 24\nuniform = true\n"
    wide.write_text(text.replace("[target]", near + "[[target]]"))
    scene = load(wide)
    made = designed_quickly(scene.changed({"tailoring.stage2_iterations": 4}))
    part, _ = part_of(scene.single_target_scenes()[1])
    assert made.goals[0].reachable is None and np.array_equal(made.goals[1].reachable, part)
    assert not made.goals[1].picture[~part].any() and made.goals[1].picture[part].all()
    with pytest.raises(SceneError, match=r"^target\[1\]: "):
        designed_quickly(scene.changed({"target[1].unreachable": "refuse"}))


def test_the_pull_is_zero_up_to_its_angle_and_falls_with_its_gradient():
    """A wedge of a slope whose light leaves at θ': (η² sin² θ - sin² θ'_most) / cos² θ'_most is u."""
    index, square, most = 1.5, Rectangle(4.0, 4.0), math.radians(85)
    x = torch.linspace(-2.0, 2.0, 9, dtype=torch.float64)
    for leaving in (80.0, 88.0):
        u = (math.sin(math.radians(leaving)) ** 2 - math.sin(most) ** 2) / math.cos(most) ** 2
        slope = math.tan(math.asin(math.sin(math.radians(leaving)) / index))
        heights = (slope * x)[:, None].expand(9, 9).contiguous()
        lens = Lens.between(Plane(0.0), BSplineSurface(9.0, heights, (-2.0, 2.0), (-2.0, 2.0)), square, index)
        pull = Grazing.of(Edge(Channel(CollimatedSource(square), index), most), lens)
        value, gradient, worst = pull(heights)
        if u < 0:
            assert value == 0 and not gradient.any() and worst < 0
            continue
        assert worst == pytest.approx(u, rel=1e-6) and value == pytest.approx(100 * u * u, rel=1e-6)
        step = 1e-6 * torch.sin(torch.arange(81.0, dtype=torch.float64)).view(9, 9)
        ahead, behind = pull(heights + step)[0], pull(heights - step)[0]
        assert (ahead - behind) / 2 == pytest.approx(float((gradient * step).sum()), rel=1e-4)


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """(folder, code) of the draft of the scene, as generate writes it."""
    folder = tmp_path_factory.mktemp("reach")
    (folder / "wide.toml").write_text(SCENE + "[accept]\nrrmsd = 0.3\n")  # so few points and evaluations end at 0.18
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        verify_with(patch, quick_effort())
        yield folder / "out", cli.run(["generate", str(folder / "wide.toml"), "-o", str(folder / "out")])


@suite.in_turn(0, 2)
def test_a_design_lights_its_part_without_total_reflection(designed):
    folder, code = designed
    report = json.loads((folder / "report.json").read_text())
    assert code == 0 and report["flux"]["total internal reflection"] == 0
    assert report["rrmsd"] < 0.3 < 0.65 < report["rrmsd_whole"]
    assert report["unreachable"]["angle"] == pytest.approx(47.97, abs=0.01)
    assert 0.25 < report["unreachable"]["area"] < 0.35
    assert any("cannot be lit" in sentence for sentence in report["given_up"])


@suite.in_turn(0, 2)
def test_a_verification_keeps_to_the_part(designed):
    """The verification compares the stored target with the scene's on that part."""
    folder, _ = designed
    before = json.loads((folder / "report.json").read_text())
    assert cli.run(["verify", str(folder)]) == 0
    after = json.loads((folder / "report.json").read_text())
    for key in ("rrmsd", "rrmsd_whole", "unreachable"):
        assert after[key] == pytest.approx(before[key], rel=1e-9)
