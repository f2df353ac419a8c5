"""The page offers a dome for a lamp whose light beyond 55 degrees is lost, and states the light that it gains."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from bstcad.app import dome_offer
from bstcad.app.followers import take_change
from bstcad.app.scene_text import changed
from bstcad.optics.light.point import PointSource
from bstcad.runs.files import SentenceError
from bstcad.scene.scene import of_text
from tests.app.conftest import PATIENCE, SEEN

KEYS = ("centre", "radius", "half_angle", "control_points")
LAMP = """\
# A lamp in front of a plate: the comment stays
name = "lamp"

[source]
kind = "point"
profile = "lambertian"

[lens]
material = "PMMA"
outline = { shape = "circle", diameter = 20.0 }
front = { kind = "plane", z = 15.0 }
back = { kind = "bspline", z = 20.0, control_points = 33 }

[target]
z = 200.0
x = [-200.0, 200.0]
y = [-200.0, 200.0]
pixels = 24
uniform = true

[tailoring]
quality = "draft"
rays = 96
"""


def fault(text):
    """The sentence that refuses a scene; None: it is valid."""
    try:
        of_text(text, tomllib.loads(text), Path("lamp.toml"))
    except SentenceError as refusal:
        return str(refusal)
    return None


def take(text, kind):
    return take_change(text, "lens.back.kind", kind, is_valid=lambda each: fault(each) is None)


def test_a_blank_becomes_a_dome_about_its_lamp_and_a_blank_again():
    """The vertex stays where it is, and the front bends no light: its centre is the lamp."""
    text = changed(LAMP, "source.position", [0.0, 0.0, -5.0])
    dome, followed = take(text, "radial")
    scene = of_text(dome, tomllib.loads(dome), Path("lamp.toml"))
    assert scene.lens.back.z == 20.0 and scene.lens.back.centre == (0.0, 0.0, -5.0) and "the comment stays" in dome
    front = scene.lens.front
    assert front.z + 1 / front.curvature == pytest.approx(-5.0, abs=1e-12)
    assert scene.lens.back.control_points == 33 and scene.lens.back.half_angle == 85.0
    assert {"lens.outline", "lens.front", "lens.back.radius"} <= {*followed}
    plate, _ = take(dome, "bspline")
    again = of_text(plate, tomllib.loads(plate), Path("lamp.toml")).lens
    assert again.back.z == 20.0 and again.back.control_points == 33 and again.front.kind == "plane"
    assert again.outline.half_extent[0] == pytest.approx(25.0 * math.sin(math.radians(85.0)))


@pytest.mark.parametrize(("half", "expected"), [(200.0, 85.0), (40.0, 54.0), (0.5, 43.0)])
def test_the_half_angle_is_what_one_face_can_turn_to_the_edge_of_the_target(half, expected):
    """Snell's law: light at the rim leaves at 85 degrees to the normal, and PMMA turns it by 43.1 degrees."""
    data = tomllib.loads(changed(changed(LAMP, "target.x", [-half, half]), "target.y", [-half, half]))
    turned = 85.0 - math.degrees(math.asin(math.sin(math.radians(85.0)) / 1.4914))
    edge = math.degrees(math.atan(half / 200.0))
    assert dome_offer.half_angle(data) == expected == min(math.floor(edge + turned), 85)


@pytest.mark.parametrize(("text", "rotate"), [("THU", 0), ("THU", 90), ("I", 0)])
def test_letters_need_the_half_angle_of_their_own_edges(text, rotate):
    """The lit part of the traced target, not the target's edges: letters have a dark margin."""
    letters = changed(changed(changed(LAMP, "target.uniform", None), "target.text", text), "target.rotate", rotate)
    letters = changed(letters, "target.pixels", 128)
    data = tomllib.loads(letters)
    lit = of_text(letters, data, Path("lamp.toml")).targets[0].irradiance() > 0.0
    half = min(400.0 / 128 * lit.any(axis=axis).sum() / 2 for axis in (0, 1))
    turned = 85.0 - math.degrees(math.asin(math.sin(math.radians(85.0)) / 1.4914))
    expected = math.degrees(math.atan(half / 200.0)) + turned
    assert dome_offer.half_angle(data) == pytest.approx(expected - 0.5, abs=1.0)  # rounded down; pixels of 3 mm
    assert dome_offer.half_angle(data) < 80.0
    dark = changed(letters, "target.invert", True)  # light around the letters
    assert dome_offer.half_angle(tomllib.loads(dark)) == 85.0


def test_a_front_that_is_replaced_takes_its_comment_along():
    line = 'front = { kind = "plane", z = 15.0 }  '
    noted = LAMP.replace(line.strip(), f"{line}# flat, to be glued\n{' ' * len(line)}# to the window")
    noted = noted.replace("control_points = 33 }", "control_points = 33 }  # as many as needed")
    dome, _ = take(noted, "radial")
    assert "glued" in noted and "glued" not in dome and "window" not in dome
    assert "# as many as needed" in dome and "the comment stays" in dome


@pytest.mark.parametrize("lamp", [0.0, -5.0])
def test_a_front_about_the_lamp_stays_about_the_lamp(lamp):
    """z + 1 / c is the position of the lamp, whichever of the two a person changes; other fronts do not follow."""
    dome, _ = take(changed(LAMP, "source.position", [0.0, 0.0, lamp]), "radial")
    for key, value in (("lens.front.z", 6.0), ("lens.front.curvature", -0.16)):
        text, followed = take_change(dome, key, value, is_valid=lambda each: fault(each) is None)
        front = tomllib.loads(text)["lens"]["front"]
        assert front["z"] + 1 / front["curvature"] == pytest.approx(lamp, abs=1e-8) and value in front.values()
        assert {key, *followed} == {"lens.front.z", "lens.front.curvature"}
    flat = changed(dome, "lens.front.curvature", -0.05)
    assert take_change(flat, "lens.front.z", 6.0, is_valid=lambda each: fault(each) is None)[1] == ()


def test_the_light_in_a_cone_is_the_integral_of_the_lamp_s_intensity():
    """Lambertian: sin² of the angle, for a lamp beside the axis the flux through the tilted disc of the same rim."""
    lamp = PointSource()
    for angle in (40.0, 69.0, 85.0):
        found = dome_offer.flux_within(lamp, angle, 20.0)
        assert found == pytest.approx(math.sin(math.radians(angle)) ** 2, abs=2e-4)  # cells at the rim of the grid
    # The form factor of a parallel disc of radius a = 20 sin α at h = 20 cos α, from a point at the distance r beside.
    a, h, r = 20 * math.sin(math.radians(50.0)), 20 * math.cos(math.radians(50.0)), 6.0
    beside = (1 - (h * h + r * r - a * a) / math.sqrt((h * h + r * r + a * a) ** 2 - 4 * r * r * a * a)) / 2
    found = dome_offer.flux_within(replace(lamp, position=(r, 0.0, 0.0)), 50.0, 20.0)
    assert found == pytest.approx(beside, abs=5e-4)


@pytest.mark.thorough
def test_the_page_offers_a_dome_which_one_press_makes_and_which_has_a_preview(open_page, shared):
    page = open_page(shared.address)
    path = shared.folder / "lamp.toml"
    path.write_text(LAMP, encoding="utf-8")
    page.goto(f"{shared.root}/scene/lamp")
    page.wait_for_selector("#offer:visible", timeout=PATIENCE)
    words = page.inner_text("#offer p")
    lost = 1 - math.sin(math.atan(10.0 / 15.0)) ** 2  # light beside the front; more goes through the sides
    assert f"{100 * (1 - math.sin(math.radians(85.0)) ** 2):.0f} %" in words.split("would miss ")[1]
    assert 100 * lost - 1 < float(words.split(" %")[0].split()[-1]) < 100 * lost + 25
    seen = page.get_attribute(SEEN, "src")
    page.click("#offer button")
    page.wait_for_selector(f"{SEEN}:not([src='{seen}'])", timeout=PATIENCE)
    assert page.is_hidden("#offer") and page.is_hidden("#fault")
    values = {key: page.input_value(f"input[type=text][data-key='lens.back.{key}']") for key in KEYS}
    assert values == {"centre": "", "radius": "20", "half_angle": "85", "control_points": "33"}
    assert page.locator("#solid-figure.drawn").count() == 1 and 'kind = "radial"' in page.input_value("#text")
    on_target = page.locator("#figures tr", has_text="Light on the target").inner_text()
    assert float(on_target.split(" %")[0].split()[-1]) > 95
