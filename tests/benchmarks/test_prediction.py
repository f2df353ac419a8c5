"""Predictions beside designs of all templates and scenes of the gallery, each by a cold `bstcad generate`.

    pytest -s -m bench tests/benchmarks/test_prediction.py -k draft

prints for each scene what was predicted, what was found, and the ratio of both.  On a busy machine only the RRMSD and
the memory mean anything.
"""

import math

import pytest

from bstcad.planning.net_choice import with_net
from bstcad.planning.prediction import INTERVAL_FACTORS, predict, run_pilot
from bstcad.scene.scene import load
from tests.benchmarks.cold import ROOT, TEMPLATES, generate
from tests.benchmarks.judged_cells import HALF, stated_by_cell

SCENES = sorted([*TEMPLATES.glob("*.toml"), *(ROOT / "docs" / "gallery-scripts").glob("*.toml")])


@pytest.mark.bench
@pytest.mark.parametrize("quality", ["draft", "standard"])
def test_nine_of_ten_designs_keep_to_the_factors_that_are_stated(quality, tmp_path):
    off = {key: [] for key in INTERVAL_FACTORS}
    for path in SCENES:
        scene = with_net(load(path))[0]
        likely = predict(scene, run_pilot(scene))[quality]
        run = generate(path, tmp_path / path.stem, f"tailoring.quality={quality}")
        report = run.report()
        found = {"seconds": run.seconds, "rrmsd": report["rrmsd"], "memory_gb": report["machine"]["peak_memory_gb"]}
        if half := stated_by_cell(report).get(HALF):
            found["rrmsd_half"] = half[0]
        words = [f"{key} {likely[key][1]:.3g}, {each:.3g}: {likely[key][1] / each:.2f}" for key, each in found.items()]
        print(f"{path.stem:22} {quality:9}", *words, sep="   ", flush=True)
        for key, each in found.items():
            off[key].append(math.exp(abs(math.log(likely[key][1] / each))))
    for key, most in INTERVAL_FACTORS.items():
        assert sorted(off[key])[math.ceil(0.9 * len(off[key])) - 1] <= most, key
