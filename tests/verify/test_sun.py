"""A plate for the sun, as `bstcad new` proposes it: the verdict against the judge that shares no code with bstcad."""

import json
import math

import numpy as np
import pytest

from bstcad import cli
from tests import suite
from tests.benchmarks.independent import judge
from tests.conftest import quickly

SMALL = {
    "lens.back.control_points": 33, "target.pixels": 32, "tailoring.rays": 192, "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 10, "output.mesh_tolerance": 0.05,
}  # fmt: skip
SUN = math.radians(0.53) / 2  # angular radius of the sun (rad)


def plate_of(settings, folder):
    """A plate of 40 x 30 mm that throws letters on a wall 200 mm behind it: its folder."""
    with pytest.MonkeyPatch.context() as patch:
        quickly(patch)
        patch.chdir(folder)
        assert cli.run(["new", "plate", "--light", "sun", "--size", "40x30", "--distance", "200"]) == 0
        words = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
        assert cli.run(["generate", "plate.toml", "--quality", "draft", "-o", "plate", *words]) in (0, 1)
        return (folder / "plate").resolve()


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    return plate_of(SMALL, tmp_path_factory.mktemp("sun"))


@suite.in_turn(1, 3)
def test_the_stated_rrmsd_is_that_of_rays_from_the_sun(plate):
    report = json.loads((plate / "report.json").read_text())
    judged = judge(plate, points=1 << 16)
    assert judged.error < 0.01 * judged.rrmsd
    assert report["rrmsd"] == pytest.approx(judged.rrmsd, rel=0.03)  # few tubes add half a per cent
    assert not any("size of the source" in sentence for sentence in report["given_up"])


@suite.in_turn(1, 3)
def test_the_finest_detail_is_the_image_of_the_sun(plate):
    """2 · 200 mm · tan(0.265°) through a plate that bends little, on pixels of 1.25 mm; at 100 mm half of it."""
    report = json.loads((plate / "report.json").read_text())
    found, image = report["finest_detail"], 2 * 200 * math.tan(SUN)
    assert found["source_image"] == pytest.approx(image, rel=0.02)
    assert found["width"] == pytest.approx(math.sqrt(image**2 + 4 / 3 * 1.25**2), rel=0.02)
    assert found["nearer_distance"] == 100 and found["of"] == "source.divergence = 0.53 degrees"
    page = (plate / "report.html").read_text(encoding="utf-8")
    assert "Finest detail on the target" in page
    assert "it would be 1.7 mm with the target 100 mm instead of 200 mm from the lens" in page


@suite.in_turn(2, 3)
def test_the_light_of_two_divergences_is_that_of_rays(tmp_path):
    """An ellipse of directions, turned by 30 degrees: RRMSD and picture; exchanged axes have another picture."""
    folder = plate_of(SMALL | {"source.divergence": "[1.6, 0.4]", "source.rotate": 30}, tmp_path)
    report, text = json.loads((folder / "report.json").read_text()), (folder / "scene.toml").read_text(encoding="utf-8")
    judged, light = judge(folder, points=1 << 15), np.load(folder / "design.npz")["irradiance"].astype(float)
    assert report["rrmsd"] == pytest.approx(judged.rrmsd, rel=0.03)
    assert report["finest_detail"]["of"] == "source.divergence = [1.6, 0.4] degrees"
    mean = math.hypot(1.6, 0.4) / math.sqrt(2)  # full angle of the disc of the same variance
    assert report["finest_detail"]["source_image"] == pytest.approx(400 * math.tan(math.radians(mean / 2)), rel=0.03)
    (folder / "scene.toml").write_text(text.replace("rotate = 30.0", "rotate = -60.0"), encoding="utf-8")
    own, other = (part.picture / part.picture.mean() for part in (judged, judge(folder, points=1 << 14)))
    light /= light.mean()
    assert np.sqrt(((own - light) ** 2).mean()) < 0.1 < 0.5 < np.sqrt(((other - light) ** 2).mean())
