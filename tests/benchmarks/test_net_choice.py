"""The chosen net held to recorded designs with every net (net_scenes.py): as good as the best, or much quicker."""

import json

import pytest

from bstcad.optics.sides import side
from bstcad.sweep.net_choice import chosen
from tests.benchmarks.net_scenes import CASES, FIGURES, NET, scene_of

KNOWN = json.loads(FIGURES.read_text())
BY_NAME = {case.name: case for case in CASES}
RECORDED = [(size, name) for size, cases in KNOWN.items() for name in cases]


@pytest.mark.bench
@pytest.mark.parametrize(("size", "name"), RECORDED)
def test_it_is_the_best_or_nearly_so(size, name):
    choice = chosen(scene_of(BY_NAME[name], size == "half").changed({NET: None}))
    seconds = {side(each.net): each.seconds for each in choice.possible}
    measured = {int(points): figures["rrmsd"] for points, figures in KNOWN[size][name].items()}
    ours, best = side(choice.net), min(measured, key=measured.get)
    error, time = measured[ours] / measured[best], seconds[ours] / seconds[best]
    assert (error <= 1.25 and time <= 1.5) or (error <= 2 and time <= 1 / 3)
