"""What batoid and mitsuba make of every template, through its STEP file; run by `make bench`."""

from __future__ import annotations

import pytest

from bstcad.judges import comparison
from bstcad.scene.new_scene import templates
from tests.benchmarks.written_lenses import of_template

pytestmark = pytest.mark.bench

RAYS = 1 << 22
DECLINED = {("sun_caustic", "mitsuba")}  # the sun's directions


@pytest.mark.parametrize("template", templates())
def test_other_programs_agree(template, tmp_path):
    lens = of_template(template, {"tailoring.quality": "draft"}, tmp_path)
    target, channels = lens.scene.target, lens.scene.judging_channels()
    for name in comparison.JUDGES:
        found = comparison.compare(name, lens.lens, channels, target.screen, target.irradiance(), rays=RAYS)
        assert bool(found.declined) is ((template, name) in DECLINED)
        if found.declined:
            print(f"\n{template}, {name}: {found.declined}", end="")
            continue
        print(
            f"\n{template}, {name}: RRMSD {found.rrmsd:.4f}, by bstcad {found.rrmsd_ours:.4f}, apart "
            f"{found.difference:.4f}, noise {found.noise:.4f}, over it {found.over_noise:.3f}; light on the target "
            f"{found.on_target:.5f}, by bstcad {found.on_target_ours:.5f}; {found.seconds:.0f} s",
            end="",
        )
        assert all(check.passed for check in found.checks)
