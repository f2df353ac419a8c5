"""A plate for the sun, as `bstcad new` proposes it: the verdict against the judge that shares no code with bstcad."""

import json
import math

import pytest

from bstcad import cli
from tests.benchmarks.independent import judge
from tests.conftest import draws_nothing, quick_effort, verify_with

SMALL = {
    "lens.back.control_points": 33, "target.pixels": 32, "tailoring.rays": 192, "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 10, "output.mesh_tolerance": 0.05,
}  # fmt: skip
SUN = math.radians(0.53) / 2  # angular radius of the sun (rad)


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    """A plate of 40 x 30 mm that throws letters on a wall 200 mm behind it: its folder."""
    with pytest.MonkeyPatch.context() as patch:
        draws_nothing(patch)
        verify_with(patch, quick_effort())
        patch.chdir(tmp_path_factory.mktemp("sun"))
        assert cli.run(["new", "plate", "--light", "sun", "--size", "40x30", "--distance", "200"]) == 0
        settings = [part for key, value in SMALL.items() for part in ("--set", f"{key}={value}")]
        assert cli.run(["generate", "plate.toml", "--quality", "draft", "-o", "plate", *settings]) in (0, 1)
        yield (tmp_path_factory.getbasetemp() / "sun0" / "plate").resolve()


def test_the_stated_rrmsd_is_that_of_rays_from_the_sun(plate):
    report = json.loads((plate / "report.json").read_text())
    judged = judge(plate, points=1 << 16)
    assert judged.error < 0.01 * judged.rrmsd
    assert report["rrmsd"] == pytest.approx(judged.rrmsd, rel=0.03)  # few tubes add half a per cent
    assert not any("size of the source" in sentence for sentence in report["given_up"])


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
