"""A design on a GPU mixes no tensors of two devices and finds the lens that the CPU finds (a GPU that is none: see
fake_device).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bstcad.designs import pipeline
from bstcad.designs.pipeline import DesignOptions, design
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.surfaces import bspline
from bstcad.optics.trace import tubes
from bstcad.runs import checkpoint
from bstcad.scene.scene import load
from bstcad.tailoring.driver import Hooks
from bstcad.tailoring.merit import Merit
from bstcad.tailoring.stage2 import Problem
from tests import suite
from tests.conftest import pixels_of_all
from tests.efforts import LITTLE
from tests.fake_device import SECOND, SecondDevice, on_second

TEMPLATES = sorted((Path(__file__).parent.parent / "templates").glob("*.toml"))
TINY = {
    "lens.back.control_points": 33,
    "tailoring.rays": 48,
    "tailoring.transport_grid": 32,
    "tailoring.rounds": 1,
    "tailoring.source_points": 4,
}
PIXELS = 25  # odd, as the tubes are even: in a symmetric lens no edge of a tube runs along a pixel border
QUALITIES = {
    "draft": {"tailoring.stage2_iterations": 1},
    "standard": {"tailoring.stage2_iterations": 31},  # three rounds
    "fine": {"tailoring.stage2_iterations": 2, "lens.back.control_points": 65},  # two levels
    "paper": {"tailoring.levels": [17, 33], "tailoring.stage1_iterations": 4, "tailoring.stage2_iterations": 3},
}
# Largest difference as a fraction of the relief: by the ends of stage 1's solvers; by a few steps of Adam in float32.
SAME = {"draft": 1e-6, "paper": 1e-4}

# A design besides the mirror and the paper's procedure below; the others are run by `make bench`.
QUICK = ("beam_shaper", "draft")


# Each design compares float32 with float64: by one evaluation here, which takes the way of all.
OPTIONS = DesignOptions(effort=replace(LITTLE, compared_evaluations=1))
BOUNDED = ("machinable_letters", "paper")  # the paper's procedure knows no bounds on the back


def scene(template, quality):
    return load(template, TINY | pixels_of_all(template, PIXELS) | {"tailoring.quality": quality} | QUALITIES[quality])


@pytest.mark.parametrize(
    ("template", "quality"),
    [
        pytest.param(
            template, quality, id=f"{template.stem}-{quality}",
            marks=() if (template.stem, quality) == QUICK else pytest.mark.bench,
        )
        for template in TEMPLATES
        for quality in QUALITIES
        if quality in SAME or template.stem in ("disk", "thu", "mirror")  # these differ from draft in numbers
        if (template.stem, quality) != BOUNDED  # which is refused
    ],
)  # fmt: skip
def test_a_design_mixes_no_devices_and_finds_the_lens_of_the_cpu(template, quality):
    held_to_the_cpu(scene(template, quality), quality)


@suite.in_turn(0, 4)
def test_so_does_one_for_a_tilted_target_that_loses_light_on_the_way():
    metal = {"kind": "fresnel", "metal": "Al", "polarisation": "s"}
    wanted = scene(TEMPLATES[0].with_name("mirror.toml"), "draft")
    wanted = wanted.changed({"target.tilt": [20.0, -35.0], "effects": [metal]})
    held_to_the_cpu(wanted, "draft")
    same_merit_and_gradient(wanted)


def held_to_the_cpu(wanted, quality):
    with SecondDevice() as second:
        found = design(wanted, device="cuda", options=OPTIONS)
    assert second.marked > 1000
    assert not second.mixed
    assert found.device == "cuda"
    assert not any(on_second(net.heights) or net.heights.dtype != torch.float64 for net in found.lens.nets)
    assert found.lens.front.is_net or isinstance(getattr(found.lens.front, "curvature", 0.0), float)
    searched = quality == "paper" and wanted.source.extent  # by stage 3, in single precision; see the test below
    if quality in SAME and not searched:  # the plain form there, compiled kernels here
        for net, plain in zip(design(wanted, device="cpu", options=OPTIONS).lens.nets, found.lens.nets, strict=True):
            off, relief = float((plain.heights - net.heights).abs().max()), float(np.ptp(net.heights.numpy()))
            assert off <= SAME[quality] * relief


OF_A_KIND = ("led", "white_logo")  # a source of some size and a spectrum; beams and a mirror are designed above


@pytest.mark.parametrize(
    "template",
    [
        pytest.param(template, id=template.stem, marks=() if template.stem in OF_A_KIND else pytest.mark.bench)
        for template in TEMPLATES
    ],
)
def test_merit_and_gradient_are_those_of_the_cpu(template):
    """Merits are compared, since line searches of stage 2 make more of a last bit than a design can be compared by."""
    same_merit_and_gradient(scene(template, "draft"))


def same_merit_and_gradient(wanted):
    # off the axis: an edge of a tube that runs along the border of two pixels has no gradient of its own
    line = torch.linspace(-1, 1, 33, dtype=torch.float64)
    bowl = (line[:, None] - 0.031) ** 2 + (line + 0.017) ** 2 + 0.1 * line[:, None] * line
    here = evaluated(wanted, bowl)
    with SecondDevice() as second:
        there = evaluated(wanted, bowl.to("cuda"))
    assert not second.mixed and second.marked > 100
    assert there[0] == pytest.approx(here[0], rel=1e-10)
    # 1e-13 but where a round beam is tailored: at its rim are thin triangles, which make more of a last bit
    assert float((there[1].cpu() - here[1]).norm() / here[1].norm()) < 1e-8


def evaluated(wanted, heights):
    """(merit, gradient) of a shallow bowl as the back face."""
    lens = wanted.flat_lens(33).to(heights.dtype, heights.device)
    lens = lens.with_back(replace(lens.back, heights=heights * 1e-3 * wanted.lens.outline.half_extent[0]))
    merit = Merit.of(wanted.channels(), lens, 48, wanted.goals, 0.03)
    value, gradients, _ = Problem(lens, merit)([net.heights for net in lens.nets])
    return value, torch.cat([gradient.reshape(-1) for gradient in gradients])


@suite.in_turn(1, 2)
@pytest.mark.parametrize("quality", [pytest.param("standard", marks=pytest.mark.bench), "paper"])
def test_resume_brings_everything_back_to_the_device(quality, tmp_path):
    """States of every stage are read as from a file."""
    wanted, kept = scene(TEMPLATES[0].with_name("portrait.toml"), quality), []

    def save(state):
        kept.append(tmp_path / str(len(kept)))
        checkpoint.write(kept[-1], {}, state)

    with SecondDevice():
        whole = design(wanted, device="cuda", options=OPTIONS, hooks=Hooks(save=save))
    for place in sorted({len(kept) // 3, len(kept) - 1}):
        with SecondDevice() as second:
            again = design(
                wanted,
                device="cuda",
                options=OPTIONS,
                start=checkpoint.read(kept[place], pipeline.DesignState, "cuda")[1],
            )
        assert second.marked > 0 and not second.mixed
        assert torch.equal(again.lens.back.heights, whole.lens.back.heights)


def test_auto_is_the_cpu_also_where_there_is_a_gpu(monkeypatch):
    """A GPU is not faster for every scene (docs/explanation/decisions/no-gpu-by-default.md)."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    wanted = scene(TEMPLATES[0], "draft")
    with SecondDevice() as second:
        found = design(wanted, device="auto", options=OPTIONS)
    assert found.device == "cpu" and second.marked == 0
    assert pipeline.purpose(wanted, "auto")["device"] == "cpu" and pipeline.purpose(wanted, "cuda")["device"] == "cuda"


def test_the_compiled_kernels_serve_no_tensor_of_the_gpu():
    wanted = scene(TEMPLATES[0], "draft")
    with SecondDevice() as second:
        lens = wanted.flat_lens(33).to(torch.float64, "cuda")
        u = torch.ones(3, dtype=torch.float64, device="cuda")
        assert not any(kernel_choice.kernel(name, lens.back.heights, u) for name in kernel_choice.KERNELS)
        assert not kernel_choice.whole_kernel("trace.simulate", lens.interfaces)
    assert not second.mixed


def test_a_kernel_of_the_gpu_is_an_entry_of_the_table(monkeypatch):
    """Entered for "cuda", it takes the tensors there and no others: merit and gradient are the CPU's."""
    calls = dict.fromkeys(("bspline.evaluate", "tubes.collect"), 0)

    def enter(name, plain):
        def kernel(*given):
            assert on_second(given[0])
            calls[name] += 1
            return plain(*given)

        monkeypatch.setitem(kernel_choice.KERNELS[name], "cuda", kernel)

    monkeypatch.setattr(kernel_choice, "_compiles_for_gpu", lambda: True)
    monkeypatch.delitem(kernel_choice.KERNELS["trace.through bspline"], "cuda")  # Warp compiles it for no second device
    enter("bspline.evaluate", bspline.evaluate_plain)
    enter("tubes.collect", lambda corner, flux, picture, thinnest: tubes.collect_plain(corner, flux, *picture))
    same_merit_and_gradient(scene(TEMPLATES[0].with_name("mirror.toml"), "draft"))
    assert all(calls.values())


MIXES = {  # operations on mixed devices that CUDA refuses
    "a sum": lambda gpu, cpu: gpu + cpu,
    "a CPU tensor made of a number of the GPU": lambda gpu, cpu: torch.ones_like(cpu) * gpu[0],
    "a mask": lambda gpu, cpu: torch.where(cpu > 0, gpu, gpu),
    "a stack": lambda gpu, cpu: torch.stack([gpu, cpu]),
    "an index": lambda gpu, cpu: cpu[gpu > 0],
    "an assignment to places": lambda gpu, cpu: gpu.__setitem__(gpu > 0, cpu),
    "numpy": lambda gpu, cpu: gpu.numpy(),
    "numpy's own functions": lambda gpu, cpu: np.asarray(gpu),
    "a product in place": lambda gpu, cpu: cpu.mul_(gpu),
    "a gradient": lambda gpu, cpu: torch.autograd.grad((gpu.requires_grad_() ** 2).sum(), gpu)[0] + cpu,
}
PERMITTED = {
    "a number of Python": lambda gpu, cpu: gpu + 1.0,
    "a number that is on the CPU": lambda gpu, cpu: gpu * cpu.sum(),
    "what is made like it": lambda gpu, cpu: gpu + torch.zeros_like(gpu) + gpu.new_ones(3),
    "moved": lambda gpu, cpu: (gpu + cpu.to(gpu) + cpu.to("cuda"), cpu + gpu.cpu() + gpu.to(cpu)),
    "an index of the CPU": lambda gpu, cpu: gpu[cpu > 0],
    "a copy": lambda gpu, cpu: cpu.copy_(gpu),
    "a read": lambda gpu, cpu: (float(gpu.sum()), gpu.tolist(), bool((gpu > 0).any()), gpu.cpu().numpy()),
}


@pytest.mark.parametrize("name", [*MIXES, *PERMITTED])
def test_the_second_device_refuses_what_cuda_refuses(name):
    with SecondDevice() as second:
        gpu = torch.ones(3, device="cuda")
        assert gpu.device == SECOND and gpu.is_cuda and torch.ones(3).device.type == "cpu"
        (MIXES | PERMITTED)[name](gpu, torch.ones(3))
    assert len(second.mixed) == (name in MIXES) and second.marked > 0
