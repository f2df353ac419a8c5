"""A freeform front that is tailored: what may be written, the flat lens that tailoring starts from, and its design."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.designs import folder as folders
from bstcad.designs.pipeline import purpose, resolved
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.sides import in_proportion
from bstcad.scene.errors import SceneError
from bstcad.scene.fronts import NetFront, net_extent
from bstcad.scene.scene import load

DISK, MIRROR = "templates/disk.toml", "templates/mirror.toml"  # a square lens, its front at 15, its back at 20
BEAM = {"kind": "collimated", "wavelength": 633.0, "aperture": {"shape": "circle", "radius": 8.0}}
WAVE = {"kind": "plane", "z": 60.0}
FLAT = {"kind": "bspline", "z": 15.0, "optimise": True}


@pytest.fixture(scope="module")
def disk():
    return load(DISK, {"target.pixels": 16})


def with_front(scene, more=None, **front):
    return scene.changed({"lens.front": FLAT | front} | (more or {}))


def a_net(scene, m=17):
    """A front that is bent, of the scene's outline."""
    half_x, half_y = net_extent(scene.lens.outline, m)
    x, y = (torch.linspace(-half, half, m, dtype=torch.float64) for half in (half_x, half_y))
    heights = 0.1 * torch.cos(x[:, None] / 2) * torch.cos(y[None, :] / 3)
    return BSplineSurface(15.0, heights, (-half_x, half_x), (-half_y, half_y))


# ---- what is written -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("more", [{}, {"control_points": 129}, {"control_points": [33, 129]}], ids=str)
def test_a_front_that_is_tailored_goes_through_its_file(disk, more, tmp_path):
    scene = with_front(disk, **more)
    (tmp_path / "scene.toml").write_text(scene.toml())
    assert load(tmp_path / "scene.toml") == scene == scene.changed({})
    front = scene.lens.front
    assert front.is_tailored and not front.fixed and front.free == () and front.file is None
    assert scene.lens.front_sags == (0.0, 0.0) and scene.rim_sags == disk.rim_sags  # those of a plane
    assert len(scene.warnings()) == len(disk.warnings()) + 1  # see the next test


def test_a_front_without_a_goal_of_its_own_is_said_to_stay_as_it_is(disk):
    further = disk.target.model_copy(update={"z": 2 * disk.target.z})
    idle = [
        warning
        for goals in ({}, {"wavefront": WAVE}, {"target": [disk.target, further]}, {"lens.back.optimise": False})
        for warning in with_front(disk, {"source": BEAM} | goals).warnings()
        if warning.startswith("lens.front.optimise: ")
    ]
    assert len(idle) == 1 and "the front hardly changes; add a second [[target]] or a [wavefront], or" in idle[0]
    assert not any("optimise" in warning for warning in disk.changed({"lens.front": a_net(disk)}).warnings())


def test_a_given_net_may_be_where_tailoring_starts(disk, tmp_path):
    scene = disk.changed({"lens.front": a_net(disk)})
    assert not scene.lens.front.is_tailored and scene.lens.front.fixed and "optimise" not in scene.toml()
    tailored = scene.changed({"lens.front.optimise": True})
    assert tailored.lens.front.is_tailored and tailored.lens.tailored_faces == ("front", "back")
    for name, data in folders.scene_files(tailored).items():
        (tmp_path / name).write_bytes(data)
    assert load(tmp_path / "scene.toml") == tailored
    one, other = purpose(tailored, "cpu"), purpose(scene, "cpu")
    assert one["files"] == other["files"] and one != other


@pytest.mark.parametrize(("path", "changes", "sentence"), [
    (DISK, {"lens.front": {"kind": "bspline", "z": 15.0}}, "lens.front.file: missing, and the front is not tailored; "
     'add file = "outputs/earlier", or optimise = true'),
    (DISK, {"lens.front": FLAT | {"optimise": ["heights"]}}, "lens.front.optimise: ['heights'] is neither true nor"),
    (DISK, {"lens.front": FLAT | {"control_points": 4}}, "lens.front.control_points: 4 is not between 5 and 2049"),
    (DISK, {"lens.front": FLAT | {"control_points": [9, 17]}, "lens.outline": {"shape": "circle", "radius": 8.0}},
     "lens.front.control_points: a round lens (lens.outline) needs a square net, not 9 x 17"),
    (DISK, {"lens.front": FLAT | {"control_points": 5}, "lens.outline": {"shape": "circle", "radius": 8.0}},
     "lens.front.control_points: 5 is too few for a round lens"),
    (DISK, {"lens.back.optimise": False, "lens.front": {"kind": "sphere", "z": 15.0, "optimise": True}},
     "lens.back.optimise: false leaves no face to tailor"),
    (MIRROR, {"lens.front": FLAT | {"z": 0.0}}, "lens.front.optimise: no light meets the front of a mirror"),
    (MIRROR, {"lens.back.optimise": False}, "lens.back.optimise: false leaves no face to tailor"),
    (MIRROR, {"lens.front": FLAT | {"reflect": True}, "lens.material": "PMMA"}, "lens.front.reflect: no light"),
    (DISK, {"lens.front": FLAT | {"optimise": False, "reflect": True}}, "lens.front.reflect: the face that reflects"),
    (DISK, {"lens.front": FLAT | {"reflect": True}, "lens.index": None, "lens.material": None}, "lens: needs exactly"),
    (DISK, {"lens.front": FLAT, "tailoring.method": "integration"},
     "lens.front.optimise: point-by-point integration cannot tailor"),
    (DISK, {"lens.front": FLAT | {"z": 19.8}}, "lens.back.z: the lens is 0.2 mm thick at its centre"),
])  # fmt: skip
def test_what_cannot_be_is_refused(path, changes, sentence):
    with pytest.raises(SceneError, match="^" + re.escape(sentence)) as refused:
        load(path).changed(changes)
    assert "\n" not in str(refused.value)


def test_a_given_net_has_the_control_points_of_its_file(disk):
    scene = disk.changed({"lens.front": a_net(disk)})
    with pytest.raises(SceneError, match=r"^lens\.front\.control_points: .*file"):
        scene.changed({"lens.front.control_points": 33, "lens.front.optimise": True})


# ---- the flat lens ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("net", "of", "to", "found"), [
    (65, 65, 129, 129), (33, 65, 33, 17), (33, 65, (129, 65), (65, 33)), ((9, 17), (17, 33), 33, 17), (9, 513, 5, 5),
])  # fmt: skip
def test_a_net_in_proportion_has_its_share_of_spans(net, of, to, found):
    assert in_proportion(net, of=of, to=to) == found


@pytest.mark.parametrize(("points", "final", "coarse"), [
    (None, (65, 65), (33, 33)), (129, (129, 129), (65, 65)), ([33, 129], (33, 129), (17, 65)),
])  # fmt: skip
def test_the_flat_lens_has_two_flat_nets_in_proportion(disk, points, final, coarse):
    scene = with_front(disk, **({} if points is None else {"control_points": points}))
    whole, first = scene.flat_lens(65), scene.flat_lens(33, as_wide_as=65)
    assert whole.tailored_numbers == (0, 1) and whole.nets == (whole.front, whole.back)
    assert whole.front.shape == final and first.front.shape == coarse and first.back.shape == (33, 33)
    assert whole.front.z == 15.0 and not whole.front.heights.any() and whole.front.heights.dtype == torch.float64
    assert (first.front.x, first.front.y) == (whole.front.x, whole.front.y)  # as wide as the last
    assert whole.front.x[1] == net_extent(scene.lens.outline, scene.lens.front_net(65))[0]
    own = scene.flat_lens(33).front
    assert own.x[1] == net_extent(scene.lens.outline, scene.lens.front_net(33))[0] > whole.front.x[1]
    assert scene.flat_lens(33).to(torch.float32).front.heights.dtype == torch.float32


def test_the_front_may_be_tailored_alone(disk):
    lens = with_front(disk, {"lens.back.optimise": False}).flat_lens(33)
    assert lens.tailored_numbers == (0,) and lens.nets == (lens.front,) and lens.last_tailored.surface is lens.front
    assert lens.back.is_net and not lens.back.heights.any()
    assert disk.flat_lens(33).tailored_numbers == (1,) and disk.flat_lens(33).front == disk.lens.front.surface


def test_a_back_whose_net_is_chosen_later_has_a_front_beside_it(disk):
    scene = with_front(disk, {"lens.back.control_points": None}, control_points=129)
    assert scene.flat_lens(33).front.shape == (33, 33) and scene.flat_lens(257).front.shape == (129, 129)
    assert with_front(disk, {"lens.back.control_points": None}).flat_lens(33).front.shape == (33, 33)


def test_tailoring_starts_from_the_given_net(disk):
    net = a_net(disk)
    scene = disk.changed({"lens.front": net}).changed({"lens.front.optimise": True})
    whole, first = scene.flat_lens(65).front, scene.flat_lens(33, as_wide_as=65).front
    assert torch.equal(whole.heights, scene.lens.front.file.surface(15.0).heights) and whole.shape == (17, 17)
    assert first.shape == (9, 9) and first.x == whole.x
    x = torch.linspace(-8.0, 8.0, 41, dtype=torch.float64)
    assert (first.sag_and_slope(x, 0 * x)[0] - whole.sag_and_slope(x, 0 * x)[0]).abs().max() < 0.02  # of 0.1 mm


# ---- its design ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "only_front", "moved"), [(None, False, 0.0), (33, True, 1e-3), ([9, 17], False, 1e-3)], ids=str
)
def test_both_nets_of_a_design_come_back_to_the_last_bit(disk, points, only_front, moved, tmp_path):
    more = {"lens.back.control_points": 17, "lens.back.optimise": not only_front}
    scene = with_front(disk, more, **({} if points is None else {"control_points": points}))
    g = torch.Generator().manual_seed(1)
    lens = scene.flat_lens(17)
    lens = lens.with_heights(0.1 * torch.randn(net.shape, generator=g, dtype=torch.float64) for net in lens.nets)
    lens = lens.with_front(replace(lens.front, z=15.0 + moved))  # as it is moved clear of the back
    design = folders.DesignedLens(resolved(scene, lens), lens, scene.goals)
    assert design.scene == scene and "optimise = true" in scene.toml()  # from which it is designed again
    for name, data in folders.scene_files(design.scene).items():
        (tmp_path / name).write_bytes(data)
    folders.write_design(design, (), tmp_path)
    nominal = folders.read_nominal(tmp_path)
    again = nominal.scene
    assert again == scene and nominal.lens.tailored_numbers == lens.tailored_numbers
    for one, other in ((lens.front, nominal.lens.front), (lens.back, nominal.lens.back)):
        assert np.array_equal(one.control_points(), other.control_points())
    read = folders.DesignedLens(again, nominal.lens, nominal.goals)
    assert design.is_lens_of(read)
    heights = nominal.lens.front.heights.clone()
    heights[3, 3] += 1e-9
    other = nominal.lens.with_front(replace(nominal.lens.front, heights=heights))
    assert not replace(read, lens=other).is_lens_of(design)
    with np.load(tmp_path / "design.npz") as arrays:
        kept = dict(arrays)
    np.savez(tmp_path / "design.npz", **kept | {"front_control_points": kept["front_control_points"][:-1]})
    with pytest.raises(SceneError, match=r"front_control_points is not .* numbers, as scene.toml requires"):
        folders.read_nominal(tmp_path)


def test_a_step_file_of_two_nets_is_twice_as_large(disk):
    one, two = folders.step_size(disk), folders.step_size(with_front(disk))
    assert two - folders.OTHER_BYTES[0] == pytest.approx(2 * (one - folders.OTHER_BYTES[0]), rel=1e-12)
    wide = with_front(disk, control_points=[65, 129])
    assert folders.step_size(wide) > two and folders.step_size(wide, 33) < one + two
    assert isinstance(with_front(disk).lens.front, NetFront)
