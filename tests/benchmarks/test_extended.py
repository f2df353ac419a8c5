"""Gain of tailoring for an extended source: against doing nothing, and against feedback in the same time.

Classic feedback corrects the target of a point-source design by the ratio of what is wanted to what the real source
makes, round after round: T_k+1 = T_k (T / E_k)^p (van Cittert's iteration in logarithms).  Time is that of the
processor, so that a busy machine does not count.  Figures are printed; what is asserted are ratios.
"""

import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import fftconvolve

from bstcad.analysis.light import blur
from bstcad.optics.trace.measure import measure, side_factor, tubes_picture
from bstcad.optics.trace.source_images import images
from bstcad.scene.scene import load
from bstcad.tailoring import stage1, stage2
from bstcad.tailoring.driver import Driver, Task
from bstcad.tailoring.source_image import ExtendedSource
from tests.benchmarks.cold import TEMPLATES

pytestmark = pytest.mark.bench
LED = TEMPLATES / "led.toml"
SMALL = {
    "lens.back.control_points": 49, "target.pixels": [72, 48], "tailoring.rays": 160, "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 60,
}  # fmt: skip
POWERS = (0.5, 1.0)  # p
ROUND = 30  # evaluations of stage 2 a round of feedback, from the lens of the round before


def task_of(scene):
    """The task of a scene as `pipeline.design` has it, and the blank."""
    settings = scene.tailoring.resolved(scene.lens.back.control_points)
    scaled = [scene.with_source_scaled(share) for share, _ in stage2.SOURCE_SIZES]
    light, least = scene.with_source_scaled(0.0).channels(), scene.lens.min_thickness
    task = Task(
        light, scene.goals, settings, least, sampled_sources=tuple(each.channels() for each in scaled),
        extended_sources=tuple(ExtendedSource(each.source, light, each.sampler) for each in scaled),
    )  # fmt: skip
    return task, scene.flat_lens(settings.levels[0])


def driven(task, steps):
    return Driver().run(steps, task, lambda state: state, lambda: "").lens


def judge(scene, lens):
    """(RRMSD, its standard error) by points of the source that nobody tailored with."""
    target = scene.target
    light = measure(lens, scene.verification_channels(), target.screen, target.irradiance(), sampler=scene.sampler)
    return light.rrmsd, light.standard_error


def feedback(task, lens, power, seconds):
    """Lenses of the rounds that fit into so many seconds of the processor."""
    [goal], began, whole = task.goals, time.process_time(), task.at_full_size
    target = wanted = goal.picture
    few = replace(task.settings, stage2_iterations=ROUND)
    while time.process_time() - began < seconds:
        tubes = round(2 * side_factor(whole.channels) * task.settings.rays)
        made = tubes_picture(lens, whole.channels, goal.screen, tubes)
        made = made.numpy() * (wanted.sum() / float(made.sum()))
        target = target * np.clip(wanted / np.maximum(made, 1e-6 * wanted.max()), 0.2, 5.0) ** power
        target = target / target.sum()
        corrected = replace(task, goals=(replace(goal, picture=target),), settings=few, sampled_sources=())
        lens = driven(corrected, stage2.steps(corrected, lens))
        yield lens


def floor_of(image, target, steps=1500):
    """RRMSD that is left where every image is the mean one and no light may be wasted: the merit's own lower bound.

    min |k * f - T|² over f >= 0, Σ f = 1, by projected gradients with momentum (FISTA); T the target of sum 1 with dark
    around it, the error counted on the target alone.
    """
    around = max(image.shape)
    wanted = np.pad(target / target.sum(), around)
    seen = np.pad(np.ones(target.shape, dtype=bool), around)
    light = ahead = wanted
    pace = 1.0
    for _ in range(steps):
        off = np.where(seen, fftconvolve(ahead, image, mode="same") - wanted, 0.0)
        after = on_simplex(ahead - fftconvolve(off, image[::-1, ::-1], mode="same"))
        faster = (1 + math.sqrt(1 + 4 * pace**2)) / 2
        ahead, light, pace = after + (pace - 1) / faster * (after - light), after, faster
    made = fftconvolve(light, image, mode="same")[seen]
    return float(np.linalg.norm(made / made.sum() - wanted[seen]) / np.linalg.norm(wanted))


def on_simplex(values):
    """The nearest point with all values >= 0 and of sum 1."""
    falling = np.sort(values.ravel())[::-1]
    excess = (np.cumsum(falling) - 1) / np.arange(1, falling.size + 1)
    return np.maximum(values - excess[np.nonzero(falling > excess)[0][-1]], 0)


@pytest.mark.parametrize("diameter", [0.5, 1.0])
def test_direct_optimisation_against_doing_nothing_and_against_feedback(diameter):
    scene = load(LED, SMALL | {"source.diameter": diameter})
    task, lens = task_of(scene)
    point = driven(task, stage2.steps(task, driven(task, stage1.steps(task, lens))))
    target = scene.target
    points = scene.verification_channels()
    image = blur(points, point, target.screen, target.irradiance())
    least = floor_of(images(points, point, target.screen).mean(), target.irradiance())
    alone = task.rrmsd(point)
    before, floor = judge(scene, point)
    began = time.process_time()
    rounds = stage2.stage3_rounds(task, point)
    direct = driven(task.at_full_size, stage2.run_rounds(rounds, point))
    seconds = time.process_time() - began
    after, noise = judge(scene, direct)
    print(
        f"\nsource of {diameter} mm: image {image.width:.3g} mm, {image.pixels:.3g} pixels; target blurred "
        f"by it {image.rrmsd:.4f}, "
        f"floor where every image is the mean one {least:.4f}"
        f"\npoint source {alone:.4f}; the same lens with the real source {before:.4f} (noise {floor:.4f})"
        f"\ndirect: {after:.4f} (noise {noise:.4f}) in {seconds:.0f} s of the processor; {after / alone:.2f} times the "
        f"point source's"
    )
    best = np.inf
    for power in POWERS:
        found = [judge(scene, each)[0] for each in feedback(task, point, power, seconds)]
        best = min(best, *found)
        print(f"feedback, p = {power}: " + ", ".join(f"{value:.4f}" for value in itertools.islice(found, 12)))
    print(f"best of feedback {best:.4f}: {best / after:.2f} times the error of the direct way")
    assert after < 2 / 3 * before
    assert after < 1.4 * max(alone, least)  # as long as the blur allows
    assert after < 1.1 * best  # where both are near that floor, none can be far ahead of the other
