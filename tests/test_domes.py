"""A dome from its scene to its files and back; what does not go with a dome."""

import re

import numpy as np
import pytest

import bstcad
from bstcad import commands
from bstcad.commands import ProofOptions
from bstcad.optics.measure import Effort
from bstcad.optics.radial import RadialSurface
from bstcad.scene.errors import SceneError

SCENE = """
name = "dome"
[source]
kind = "point"
position = [0.0, 0.0, 0.0]
profile = "lambertian"
[lens]
material = "PMMA"
front = { kind = "sphere", z = 8.0, curvature = -0.125 }
back = { kind = "radial", radius = 15.0, half_angle = 75.0, control_points = 33 }
[target]
z = 200.0
x = [-200.0, 200.0]
y = [-150.0, 150.0]
pixels = 24
uniform = true
[tailoring]
quality = "draft"
transport_grid = 32
rays = 64
stage2_iterations = 10
[accept]
light_on_target = 0.85
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("dome") / "dome.toml"
    path.write_text(SCENE)
    return bstcad.load(path)


def test_a_dome_is_designed_written_and_proved_from_its_files(scene, tmp_path):
    """The files hold the dome, its light passes the checks, and the opened folder has the same lens."""
    report = commands.generate(
        scene, tmp_path / "out", device="cpu", options=ProofOptions(Effort(128, places=33, points=64))
    )
    assert report.passed, [check for check in report.checks if not check.passed]
    assert report.rrmsd < 0.03 and report.efficiency > 0.85
    assert report.flux["missed the lens"] == pytest.approx(np.cos(np.radians(75.0)) ** 2, abs=5e-3)
    again = bstcad.open(tmp_path / "out")
    assert isinstance(again.lens.back, RadialSurface)
    for change in (lambda: again.export("points"), lambda: again.with_lens(again.lens), again.tolerance):
        with pytest.raises(SceneError, match="is not possible for a dome yet"):
            change()
    assert again.lens.back.shape == (33, 33) and again.report.rrmsd == pytest.approx(report.rrmsd)
    assert float(again.lens.back.at(*again.lens.back.heights.new_zeros(2, 1)).position[2]) == pytest.approx(
        15.0, abs=0.5
    )


@pytest.mark.parametrize(("change", "key"), [
    ({"lens.tool_radius": 3.0}, "lens.tool_radius"),
    ({"source.tilt": [0.0, 5.0]}, "source.tilt"),
    ({"lens.back.centre": [1.0, 0.0, 0.0]}, "lens.back.centre"),
    ({"lens.back.radius": 7.0}, "lens.back.radius"),
    ({"lens.front": {"kind": "toroid", "z": 8.0}}, "lens.front.kind"),
    ({"source": {"kind": "collimated", "aperture": {"shape": "circle", "radius": 5.0}}}, "source.kind"),
    ({"behind": [{"kind": "window", "z": 60.0, "thickness": 2.0, "index": 1.5,
                  "outline": {"shape": "circle", "diameter": 90.0}}]}, "behind"),
    ({"wavefront": {"kind": "plane", "z": 45.0}}, "wavefront"),
    ({"tailoring.method": "adam"}, "tailoring.method"),
])  # fmt: skip
def test_what_does_not_go_with_a_dome_is_refused_with_its_key(scene, change, key):
    with pytest.raises(SceneError, match=f"^{re.escape(key)}: [^\n]+$"):
        scene.changed(change)


def test_a_front_about_the_lamp_ends_at_the_half_angle(scene):
    """The sphere's rim is seen from the centre at the half angle, but for the margin."""
    x = scene.lens.front.outline.radius
    assert np.degrees(np.arcsin(x / 8.0)) == pytest.approx(75.0, abs=1e-3)
