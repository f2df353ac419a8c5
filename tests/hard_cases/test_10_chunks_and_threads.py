"""10. Rays divided into other parts, other numbers of threads, compiled or plain.

optiland #739: 1 W became 1.405 W when rays were traced in batches.  And where each thread has a sum of its own, the
last bit depends on the number of threads, which a line search turns into another lens.  Here the number of parts of a
sum depends on the number of rays only (bstcad/optics/numerics/reductions.py), so that image, flux, merit, gradient and
the design itself are the same bits from any number of threads; other strips and the plain form differ by rounding.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from bstcad.designs import pipeline
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.wavefront import SphericalWave
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace import tubes
from bstcad.optics.trace.measure import RayTubes
from bstcad.optics.trace.trace import Simulation, from_first_net, to_first_net
from bstcad.scene.scene import load
from bstcad.tailoring.baselines.paper import TentMerit
from bstcad.tailoring.effort import FULL
from bstcad.tailoring.merit import Merit, SobolevVariable
from bstcad.tailoring.slope_fit import Fit, fit_slopes
from bstcad.transport.density import Density
from tests import suite, two_faces
from tests.efforts import LITTLE, designed_quickly
from tests.scenes import DISK, DOME, SMALL
from tests.tracing import launch, simulated, simulated_plain

ROOT = Path(__file__).parent.parent.parent
SOURCE = PointSource(position=(1.0, -2.0, 0.0), profile="uniform", half_angle=35.0)
GAUSSIAN = {"profile": "gaussian", "half_angle_1e2": 30.0}
SCREEN = Screen(300.0, (-70.0, 90.0), (-80.0, 60.0), 192)  # 36 864 pixels: torch shares sums of more than 32 768
FURTHER = replace(SCREEN, z=600.0, x=(-150.0, 170.0), y=(-160.0, 140.0))
RAYS, TUBES = 300, 260  # each way: four parts


def lens(dtype=torch.float64, m=193) -> Lens:
    """A round lens with a wavy back, no mirror image of itself; all its control points are float32 numbers."""
    line = torch.linspace(-1, 1, m, dtype=torch.float64)
    x, y = line[:, None], line[None, :]
    h = -1.5 * (x**2 + 0.8 * y**2) + 0.02 * torch.sin(9 * x) * torch.cos(7 * y + 0.3)
    back = BSplineSurface(24.0, h.to(torch.float32).to(dtype), (-10.5, 10.5), (-10.5, 10.5))
    return Lens.between(Sphere(15.0, 0.01), back, Circle(10.0), 1.5)


def target() -> torch.Tensor:
    """A picture with dark parts, (pixels, pixels), sum 1."""
    wave = torch.sin(torch.arange(SCREEN.pixels, dtype=torch.float64) / 9) ** 2
    picture = wave[:, None] * wave[None, :] + 0.1
    return picture / picture.sum()


def of_two_faces(dtype) -> dict[str, torch.Tensor]:
    """Merit and gradients of two nets for two pictures of lossy light, and for a wave beside them."""
    back = lens(dtype).back
    front = replace(back, z=15.0, heights=-0.1 * back.heights.flip(0, 1))
    held = Lens.between(front, back, Circle(10.0), 1.5, tailored=(0, 1))
    light = (Channel(SOURCE, held.index, losses=Losses(FresnelLoss(587.6), AbsorptionLoss(0.01))),)
    goals = [Goal("target", screen, target().numpy(), weight) for screen, weight in ((SCREEN, 1.0), (FURTHER, 2.0))]
    found = {}
    for name, wave in (("two faces", None), ("two faces and a wave", SphericalWave((0.0, 0.0, -80.0), 30.0))):
        merit = Merit.of(light, held, TUBES, goals, 0.03, wave=wave)
        leaves = [net.heights.clone().requires_grad_() for net in held.nets]
        value, _ = merit(merit.landing(held.with_heights(leaves)))
        gradients = torch.autograd.grad(value, leaves)
        found |= {f"merit, {name}": value.detach()}
        found |= {f"gradient, {name}, {face}": g for face, g in zip(("front", "back"), gradients, strict=True)}
    return found


def by_rays(found: Simulation) -> dict[str, torch.Tensor]:
    """Return the results of a simulation."""
    flux = torch.tensor([*found.flux.values()], dtype=torch.float64)
    return {"image, box": found.box, "image, tent": found.tent, "flux": flux}


def image_and_gradient(dtype=torch.float64) -> dict[str, torch.Tensor]:
    """All that the kernels stand behind: images by rays and by tubes, merit and gradient by both."""
    held = lens(dtype)
    rays, sheet = launch(SOURCE, held, RAYS, 1), tubes.launch_tubes(SOURCE, held, TUBES)
    light = (Channel(SOURCE, held.index),)
    by_tubes = Merit(RayTubes(light, (sheet,)), (Goal("target", SCREEN, target().numpy()),), 0.03)
    by_tents = TentMerit.of(light, SCREEN, target(), 0.03)
    found = by_rays(simulated(SOURCE, held, SCREEN, RAYS, 0))
    for name, merit in (
        ("tubes", lambda bent: by_tubes(by_tubes.landing(bent))[0]),
        ("rays", lambda bent: by_tents((from_first_net(to_first_net(rays, bent), bent, LevelPlane(SCREEN.z)),))[0]),
    ):
        heights = held.back.heights.clone().requires_grad_()
        value = merit(held.with_heights([heights]))
        found[f"merit, {name}"] = value.detach()
        found[f"gradient, {name}"] = torch.autograd.grad(value, heights)[0]
    return found | {"image, tubes": tubes.picture(SOURCE, held, SCREEN, TUBES)} | of_two_faces(dtype)


def everything() -> dict[str, torch.Tensor]:
    """Return the other results of a design that are shared among threads."""
    back = lens().back
    x, y = sampling.grid(Rectangle(20.0, 20.0), 300)
    flat = (p.reshape(-1) for p in (x, y, 0.3 * torch.sqrt(1.5 + x / 7), 0.001 * x * y, x * x))  # no polynomial
    beam = CollimatedSource(Circle(12.0), profile="gaussian", radius_1e2=9.0)
    rays = tubes.rays_to(SOURCE, lens(), *tubes.corners(Circle(9.0), 300))
    return image_and_gradient() | {
        "a polynomial and a fit": fit_slopes(back, *flat, Fit(degree=3)).heights,
        "rays to the back": torch.stack(rays[:2]),
        "a Gaussian beam": torch.stack([s.irradiance(x, y, 15.0) for s in (beam, replace(SOURCE, **GAUSSIAN))]),
        "corners of a disc": torch.stack(tubes.corners(Circle(9.0), 300)),
        "variable of stage 2": SobolevVariable.of(back, torch.ones((back.m, back.m))).heights(back.heights),
        "a finer net": back.refined(257).heights,
        "a density": torch.from_numpy(Density.from_picture(target().numpy(), 150, width=3.0, height=2.0).values),
    }


def apart(name: str, found: torch.Tensor, wanted: torch.Tensor) -> float:
    """Images: the share of the light that lies elsewhere; other things: norm of the difference over the norm.

    A ray on the border of two pixels of the box goes to one or to the other with all of its light.
    """
    difference, wanted = found.double() - wanted.double(), wanted.double()
    if name.startswith("image"):
        return float(difference.abs().sum() / wanted.sum()) / 2
    return float(difference.norm() / wanted.norm())


def use_threads(n: int) -> None:
    """Set the number of threads of torch and numba."""
    torch.set_num_threads(n)
    numba.set_num_threads(min(n, numba.config.NUMBA_NUM_THREADS))


@pytest.fixture
def threads():
    """Return `use_threads`; the numbers are put back afterwards."""
    before = torch.get_num_threads(), numba.get_num_threads()
    yield use_threads
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])


def said_in_a_process(expression: str, threads: int, **variables: str) -> str:
    """Return what an expression of this module says in a process with so many threads of each library."""
    counts = {f"{library}_NUM_THREADS": str(threads) for library in ("NUMBA", "OMP", "MKL", "OPENBLAS")}
    code = f"import bstcad, {__name__} as m; print(m.{expression})"
    given = os.environ | counts | variables | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def changed_by_threads() -> list[str]:
    """Return the names of results and designs that are other ones on one thread than on several."""
    results, digests = [], []
    for n in (1, 4):
        use_threads(n)
        results.append(everything())
        digests.append({name: digest_of_a_design(name, n) for name in QUICK_DESIGNS})
    changed = [name for name in results[0] if not torch.equal(results[0][name], results[1][name])]
    return changed + [name for name in QUICK_DESIGNS if digests[0][name] != digests[1][name]]


def test_threads_of_one_process_change_no_bit():
    """A process of its own has threads enough; those that run the suite share the cores.

    A picture and a wave have more corners than one thread of torch takes: 32 768.
    """
    assert said_in_a_process("changed_by_threads()", 4) == "[]"


def test_strips_and_bands(holds, monkeypatch):
    """Rays and tubes in other portions: 90 000 roundings of 1.1e-16 at most, of either sign."""
    images = {}
    for portion, rows in ((sampling.POINTS_PER_STRIP, tubes.MAX_BAND_ROWS), (7 * RAYS, 38)):
        monkeypatch.setattr(sampling, "POINTS_PER_STRIP", portion)
        monkeypatch.setattr(tubes, "MAX_BAND_ROWS", rows)
        found = by_rays(simulated_plain(SOURCE, lens(), SCREEN, RAYS, 0))
        found |= {"image, tubes": tubes.picture(SOURCE, lens(), SCREEN, TUBES)}
        for name, image in found.items():
            figure = "tubes in other bands: image" if name == "image, tubes" else f"rays in other strips: {name}"
            holds(figure, apart(name, image, images.setdefault(name, image)), 1e-12)
    whole, again = (float(pictures["image, tubes"].sum()) for pictures in (images, found))
    holds("tubes in other bands: flux", abs(again / whole - 1), 1e-12)


# float64: sums in another order, and a hit found to 1e-13 mm by the one and a step better by the other.
# float32: the kernels compute in float64, the plain form in float32, where a direction is good to a few 6e-8 and a
# landing to 300 mm of that, 2e-4 of a pixel: so much of the light moves to the next one.  The slope of the tent jumps
# where a ray crosses the middle of a pixel, as 4e-4 of them do; their part in the gradient's norm is the root of that.
AGREE = {torch.float64: 1e-12, torch.float32: 1e-3}
JUMPS = {torch.float64: 1e-12, torch.float32: 0.04}


@pytest.mark.parametrize("dtype", suite.in_turns(AGREE, 2), ids=str)
def test_compiled_or_not(holds, monkeypatch, dtype):
    """Half as many rays and tubes each way as have four parts: the two forms do not differ by the number of parts."""
    monkeypatch.setitem(globals(), "RAYS", RAYS // 2)
    monkeypatch.setitem(globals(), "TUBES", TUBES // 2)
    wanted = image_and_gradient(dtype)
    monkeypatch.setattr(kernel_choice, "ENABLED", False)
    for name, found in image_and_gradient(dtype).items():
        bound = (JUMPS if name == "gradient, rays" else AGREE)[dtype]
        holds(f"compiled against plain, {str(dtype)[6:]}: {name}", apart(name, found, wanted[name]), bound)


# --- the design itself ------------------------------------------------------------------------------------------------


def test_one_thread_and_other_strips_make_the_same_design(threads, monkeypatch, small_design, small_scene):
    """The control points to the last bit."""
    monkeypatch.setattr(sampling, "POINTS_PER_STRIP", 5000)
    monkeypatch.setattr(tubes, "MAX_BAND_ROWS", 32)
    threads(1)
    found = pipeline.design(small_scene, device="cpu").lens.back.control_points()
    with np.load(small_design.folder / "design.npz") as wanted:
        assert np.array_equal(found, wanted["control_points"])


PROCESSORS = {  # environment variables by which BLAS, torch and numba take the processor for another one
    "as it is": {}, "MKL_CBWR=COMPATIBLE": {"MKL_CBWR": "COMPATIBLE"}, "MKL_CBWR=AVX2": {"MKL_CBWR": "AVX2"},
    "torch without vector units": {"ATEN_CPU_CAPABILITY": "default"}, "any, to numba": {"NUMBA_CPU_NAME": "generic"},
}  # fmt: skip


LARGER = {"lens.back.control_points": 65, "tailoring.rays": 200, "tailoring.transport_grid": 64}
TAILORED = {  # a front that is searched for; two nets for two pictures, and for a picture and a wave
    "one net": SMALL | {"lens.back.control_points": 129, "tailoring.rays": 300, "lens.front.optimise": True},
    "two nets": two_faces.SMALL | LARGER,
    "two nets and a wave": two_faces.SMALL | two_faces.WITH_WAVE | LARGER,
}


FEW_STEPS = {"rays": 190, "rounds": 1, "stage2_iterations": 4}
QUICK_DESIGNS = {
    "two faces": two_faces.SMALL | two_faces.WITH_WAVE | {"tailoring": two_faces.SMALL["tailoring"] | FEW_STEPS},
    "dome": DOME | {"tailoring": DOME["tailoring"] | FEW_STEPS},
}


def digest_of_a_design(name: str, threads: int) -> str:
    """The control points of a design on so many threads."""
    use_threads(threads)
    scene, effort = load(DISK, (TAILORED | QUICK_DESIGNS)[name]), LITTLE if name in QUICK_DESIGNS else FULL
    nets = designed_quickly(scene, effort).lens.nets
    return hashlib.sha256(b"".join(net.control_points().tobytes() for net in nets)).hexdigest()


@pytest.mark.bench
@pytest.mark.parametrize("processor", PROCESSORS)
@pytest.mark.parametrize("name", TAILORED)
def test_any_processor_and_any_number_of_threads(name, processor):
    """Other processors round otherwise, but each the same on any number of threads; processes of their own."""
    digests = {
        threads: said_in_a_process(f"digest_of_a_design({name!r}, {threads})", threads, **PROCESSORS[processor])
        for threads in (1, 2, 4)
    }
    print(f"{name}, {processor}: {digests}")
    assert len(set(digests.values())) == 1 and all(len(digest) == 64 for digest in digests.values()), digests
