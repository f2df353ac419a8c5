"""The net of a scene that states none: cells where light is needed, limits that hold, one line that says it."""

import json
import math

import numpy as np
import pytest

import bstcad
from bstcad.cli import run
from bstcad.optics.trace.measure import tubes_picture
from bstcad.planning import net_choice
from bstcad.planning.effect_estimates import coarse_lens
from bstcad.planning.net_choice import area_cells, choose_net, net_rrmsd, with_net
from bstcad.scene.errors import SceneError

FREE = {"lens.back.control_points": None, "tailoring.levels": None}
PLATE = bstcad.load("templates/caustic_portrait.toml").changed(FREE)


@pytest.fixture(scope="module")
def free():
    """The choice for the plate."""
    return choose_net(PLATE)


def sides(scene):
    return [each.net for each in choose_net(scene).possible]


def test_a_net_that_is_stated_stays_and_levels_state_it_too():
    stated = PLATE.changed({"lens.back.control_points": 77})
    assert with_net(stated) == (stated, None)
    by_levels, choice = with_net(PLATE.changed({"tailoring.levels": [33, 150]}))
    assert by_levels.lens.back.control_points == 150 and choice is None


def test_it_is_among_those_that_are_tried_and_the_least_that_is_worth_it(free):
    errors, seconds = ([getattr(each, key) for each in free.possible] for key in ("rrmsd", "seconds"))
    assert errors == sorted(errors, reverse=True)

    def better(one, other):
        less, longer = errors[one] / errors[other], seconds[other] / seconds[one]
        return less > 2 or (less > 1.25 and longer < 3)

    finer = range(free.index + 1, len(errors))
    assert not any(better(free.index, other) for other in finer)
    assert all(any(better(one, other) for other in range(one + 1, len(errors))) for one in range(free.index))
    assert with_net(PLATE)[0].lens.back.net == free.net


def test_a_picture_of_fewer_pixels_gets_a_coarser_net():
    assert [max(sides(PLATE.changed({"target.pixels": pixels}))) for pixels in (64, 512)] == [257, 1025]


def test_a_picture_narrower_than_half_a_tile_has_its_net_too():
    """Cells are counted over tiles of 16 x 16 pixels, and again over tiles half of that further on."""
    assert sides(PLATE.changed({"target.pixels": [24, 8]})) == sides(PLATE.changed({"target.pixels": [8, 24]}))
    left = net_choice.ControlCells(np.ones((24, 16)), np.eye(24, 16) * (np.arange(16) < 8))
    assert not left.target[8:, 8:].any()  # half a tile further on it is dark
    assert math.isfinite(net_rrmsd(left, PLATE.changed({"lens.back.control_points": 65})))


def test_several_targets_get_the_net_of_the_most_demanding_one():
    target = PLATE.target.model_dump(mode="json", exclude_none=True)
    two = PLATE.changed({"target": [target | {"pixels": 64}, target | {"z": 640.0, "pixels": 256}]})
    alone = [choose_net(each).net for each in two.single_target_scenes()]
    assert alone[0] < alone[1] == choose_net(two).net == with_net(two)[0].lens.back.net


def test_time_memory_and_the_tool_bound_it(free, monkeypatch):
    timely = choose_net(PLATE.changed({"tailoring.max_time": 25.0}))
    assert timely.net < free.net and "tailoring.max_time = 25" in timely.line
    assert all(each.seconds <= 25 for each in timely.possible)
    letters = bstcad.load("templates/machinable_letters.toml").changed(FREE | {"lens.tool_radius": None})
    blunt = choose_net(letters.changed({"lens.tool_radius": 3.0}))
    assert (choose_net(letters).net, blunt.net) == (1025, 257) and "lens.tool_radius = 3.0" in blunt.line
    scarce = type("Memory", (), {"total": 3e9})
    monkeypatch.setattr(net_choice.psutil, "virtual_memory", lambda: scarce)
    fitting = choose_net(PLATE)
    assert fitting.net < free.net and "memory" in fitting.line


def test_an_oblong_plate_gets_square_cells():
    wide = PLATE.changed({
        "lens.outline": {"shape": "rectangle", "width": 100.0, "height": 25.0}, "target.y": [-12.5, 12.5],
        "source.aperture": {"shape": "rectangle", "width": 100.0, "height": 25.0}, "target.pixels": [512, 128],
    })  # fmt: skip
    scene, choice = with_net(wide)
    width, height = scene.lens.cells
    assert width == pytest.approx(height, rel=0.02) and not any("cells" in doubt for doubt in scene.warnings())
    assert " x " in choice.line.partition(" control")[0]


def test_cells_are_those_of_the_light_that_a_pixel_asks_for():
    """A pixel's light comes from its share of the lens in an even beam; in a Gaussian beam dim light is wide."""
    lens = coarse_lens(PLATE)
    light = area_cells(PLATE, lens)
    arrives = float(tubes_picture(lens, PLATE.channels(), PLATE.target.screen, 257).sum())
    assert arrives > 0.98
    assert light.cells_per_pixel.sum() == pytest.approx(1e4 * arrives, rel=2e-3)  # light that misses lights no pixel
    np.testing.assert_allclose(light.cells_per_pixel, 1e4 * light.target, rtol=0.1, atol=1e-4)
    point = bstcad.load("templates/portrait.toml").changed(FREE | {"target.image": np.ones((64, 64))})
    area = area_cells(point, coarse_lens(point)).cells_per_pixel
    middle, corner = area[240:272, 240:272].mean(), area[:32, :32].mean()
    assert corner > 3 * middle  # exp(-2 r² / w²): the rim of the lens has an eighth of the middle's flux density


def test_fine_detail_asks_for_more_cells():
    def error(picture):
        scene = PLATE.changed({"target.image": picture, "target.pixels": 128, "target.gamma": 1.0})
        return net_rrmsd(area_cells(scene, coarse_lens(scene)), scene.changed({"lens.back.control_points": 65}))

    y, x = np.mgrid[:128, :128]
    smooth, fine = (1.2 + np.cos(2 * math.pi * (x + y) / period) for period in (64, 6))
    assert error(smooth) < error(np.where(x < 64, 1.2, fine)) < error(fine)


def test_what_a_source_blurs_asks_for_no_finer_net():
    sun = bstcad.load("templates/sun_caustic.toml").changed(FREE)
    assert max(sides(sun)) > choose_net(sun).net


def test_a_scene_without_a_net_is_a_scene_and_asks_for_a_choice_where_one_is_needed():
    assert bstcad.load("templates/caustic_portrait.toml").changed(FREE) == PLATE
    assert "control_points" not in PLATE.toml() and PLATE.channels()
    with pytest.raises(SceneError, match=r"lens\.back\.control_points: "):
        _ = PLATE.lens.back.net


def test_plan_says_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("bstcad.planning.plan.predict_qualities", lambda *given: {"predicted": None})
    path = tmp_path / "scene.toml"
    path.write_text(PLATE.changed({"target.pixels": 64, "target.sample": "camera"}).toml())
    assert run(["plan", str(path), "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out, parse_constant=pytest.fail)["control_points"]  # no Infinity, which JSON does not have
    assert told["possible"][told["number"]] == {"net": 257, "times_rrmsd": 1.0, "times_seconds": 1.0}
    [fewer] = [each for each in told["possible"] if each["net"] == 129]
    words = f"fewer, 129, would give about {fewer['times_rrmsd']:g} times the RRMSD in {fewer['times_seconds']:g} t"
    assert fewer["times_rrmsd"] > 1 > fewer["times_seconds"] and words in err
    assert err.count("\n") == 1 and "257 control points are chosen" in err and "fewer, 129" in err
