"""The fused simulation against the plain torch form: each ray's landing, flux and fate, and the sums over all rays."""

import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from bstcad.optics.kernels import forward
from bstcad.optics.kernels.forward import land
from bstcad.optics.kernels.kernel_arguments import IRRADIANCE_TOLERANCE, MIN_IRRADIANCE
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.light.point import PointSource
from bstcad.optics.light.profiles import Net, Profile
from bstcad.optics.numerics import kernel_choice
from bstcad.optics.receivers import irradiance
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.receivers.receivers import LevelPlane, TiltedPlane
from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded
from bstcad.optics.surfaces.rays import Landed
from bstcad.optics.surfaces.surfaces import Conic, Plane, Sphere
from bstcad.optics.trace import trace
from bstcad.optics.trace.trace import simulate, simulate_plain, whole_kernel, window
from tests.lenses import SQUARE, Measured, lens_of, net, tilted, wavy
from tests.optics.lens.test_mirror import LIGHTS, bumpy, mirror
from tests.tracing import from_first_net_plain, simulated, simulated_plain, stratified


def deep(front=None, outline=SQUARE, m=17, depth=4.0, **more):
    """A lens whose back is so steep at its rim that some rays are totally reflected."""
    return lens_of(wavy(m=m, depth=depth, ripple=0.2, z=22.0, half=11.0), front or Plane(15.0), outline, 1.6, **more)


# A back that falls so much towards its rim that steep rays leave it past the horizontal: those turn back.
DOME = Lens.between(Sphere(1.37, -0.25), net(lambda x, y: -0.025 * (x**2 + y**2), 3.28, 33), Circle(10.0), 1.2)
# A plane so steep that part of it lies before the front: rays that enter there are outside the glass already.
RAMP = Lens.between(Plane(15.0), tilted(2.5, 22.0, 11.0), SQUARE, 1.05)
CLEAR = Rounded(18.0, 20.0, corner_radius=4.0), Rounded(19.0, 18.0, corner_radius=7.0)
CONE = {"profile": "uniform", "half_angle": 33.0}
BEAM, NARROW = (
    CollimatedSource(Circle(12.0)),
    CollimatedSource(Rectangle(22.0, 19.0), profile="gaussian", radius_1e2=8.0),
)
ASIDE = PointSource(position=(1.0, -2.0, 3.0), profile="gaussian", half_angle_1e2=30.0)
LEANING = replace(NARROW, tilt=(-10.0, 25.0), z=-6.0, centre=(-9.0, -3.0))
HOT = Net(np.random.default_rng(3).random((12, 9)), (-10.0, 11.0), (-9.0, 12.0))
TABLE = Net(np.random.default_rng(4).random((14, 11)), (-0.5, 0.4), (-0.45, 0.5))


SCENES = {  # source, lens, the fates of rays through a window larger than the lens
    "collimated, sphere, round": (BEAM, deep(Sphere(15.0, -0.05), Circle(10.0)), {0, 1, 2, 3}),
    "collimated, beyond the equator": (CollimatedSource(SQUARE), deep(Sphere(15.0, 0.12)), {0, 1}),
    "collimated, plane": (BEAM, deep(), {0, 1, 3}),
    "point, plane": (PointSource(), deep(), {0, 1, 2, 3}),
    "point, sphere": (ASIDE, deep(Sphere(15.0, 0.02)), {0, 1, 2, 3}),
    "point, smallest net": (PointSource(**CONE), deep(Sphere(15.0, 0.02), m=5, depth=2.0), {0, 1, 2}),
    "point, ramp": (PointSource((-9.0, 0.0, 10.0)), RAMP, {1, 2}),
    "collimated, tilted, plane": (CollimatedSource(Circle(9.0), tilt=(20.0, 30.0)), deep(), {0, 2, 3}),
    "collimated, tilted, sphere": (LEANING, deep(Sphere(15.0, -0.05), Circle(10.0)), {0, 1, 2, 3}),
    "point, lambertian cone": (PointSource(half_angle=33.0), deep(), {0, 2, 3}),
    "point, lambertian, tilted": (PointSource(tilt=(60.0, 20.0)), deep(), {0, 1, 2, 3}),
    "point, gaussian, tilted": (replace(ASIDE, tilt=(-25.0, 15.0)), deep(), {0, 1, 2, 3}),
    "point, cone, tilted": (PointSource(**CONE, tilt=(0.0, -20.0)), deep(Sphere(15.0, 0.02)), {0, 1, 2, 3}),
    "point, clear apertures": (PointSource(), deep(clear=CLEAR), {0, 1, 2, 3}),
    "point, conic": (ASIDE, deep(Conic(15.0, -0.04, -2.25)), {0, 2, 3}),
    "collimated, elliptical": (replace(NARROW, radius_1e2=(9.0, 4.0), rotate=30.0), deep(), {0, 1, 3}),
    "collimated, annular": (replace(BEAM, profile="annular", inner_radius=3.0), deep(), {0, 1, 3}),
    "collimated, measured, tilted": (
        replace(BEAM, profile=Measured(Profile(net=HOT)), rotate=-20.0, tilt=(20.0, 10.0)),
        deep(),
        {0, 1, 2, 3},
    ),
    "point, elliptical": (replace(ASIDE, half_angle_1e2=(40.0, 15.0), rotate=25.0), deep(), {0, 1, 2, 3}),
    "point, elliptical, tilted": (
        replace(ASIDE, half_angle_1e2=(40.0, 15.0), tilt=(-25.0, 15.0)),
        deep(Sphere(15.0, 0.02)),
        {0, 1, 2, 3},
    ),
    "point, intensity, tilted": (
        PointSource(intensity=Measured(Profile(net=TABLE, stereographic=True, whole=2.0)), tilt=(10.0, 20.0)),
        deep(),
        {0, 1, 2, 3},
    ),
    "mirror, super-gaussian": (
        replace(LIGHTS["parallel, tilted"], profile="super_gaussian", radius_1e2=5.0, order=6.0),
        mirror(bumpy()),
        {0},
    ),
    "mirror, elliptical, tilted": (
        replace(LIGHTS["gaussian, tilted"], half_angle_1e2=(30.0, 12.0), rotate=10.0),
        mirror(bumpy()),
        {0, 1},
    ),
    "mirror, lambertian": (LIGHTS["lambertian"], mirror(bumpy()), {0, 1}),
    "mirror, parallel, tilted": (LIGHTS["parallel, tilted"], replace(mirror(bumpy()), outline=Circle(7.0)), {0, 1}),
    "mirror, gaussian, tilted, steep": (LIGHTS["gaussian, tilted"], mirror(bumpy(10.0)), {0, 1, 4}),
    "point, turned back": (PointSource(), DOME, {0, 4}),
}


@pytest.mark.parametrize(
    "plane", [LevelPlane(400.0), TiltedPlane((3.0, 2.0, 400.0), (20.0, -10.0), 5.0)], ids=["level", "tilted"]
)
@pytest.mark.parametrize("name", SCENES)
def test_each_ray_ends_as_in_the_plain_form(name, plane):
    """Against `to_first_net` and `from_first_net_plain`: not another fused kernel; all fates occur."""
    source, lens, fates = SCENES[name]
    x, y = (p.reshape(-1) for p in stratified(Rectangle(23.0, 23.0), 150, 0))  # not a multiple of a block
    rays = source.rays_through(x, y, lens.entrance.z, 1.0)
    plain = from_first_net_plain(trace.to_first_net(rays, lens), lens, plane)
    found = land(source, lens, plane, x, y)
    rtol = 1e-13 if source.tilted else 1e-14  # exp(-80) of a number whose last digits differ
    rtol = rtol if source.law is None else 1e-12  # powers of such numbers, and quotients
    torch.testing.assert_close(found.flux, plain.flux, rtol=rtol, atol=0)  # zeros are zeros
    lit = plain.flux > 0
    level = plane == LevelPlane(400.0)
    assert lit.sum() > 3000 and (not level or set(plain.status[lit].unique().tolist()) == fates)
    assert torch.equal(found.status[lit], plain.status[lit])
    there = lit & plain.alive
    off_axis = plain.position[:, there].abs()
    # a ray that runs along the screen lands far off, and moves there by 1 / cos² of its angle times any turn
    error = (found.position - plain.position)[:, there].abs() / (1 + off_axis + off_axis**2 / 400.0)
    bound = 1e-12 if level and not lens.reflects else 1e-11  # a plane or a face that leans: more of that
    assert error.numel() == 0 or float(error.max()) < bound


SCREEN = Screen(400.0, (-40.0, 90.0), (-60.0, 50.0), (40, 27))


@pytest.mark.parametrize("name", SCENES)
def test_the_simulation_is_the_plain_one(name):
    """Pictures, ledger and count; the float32 net is the same net in both, only plain arithmetic on it is coarser."""
    source, lens, fates = SCENES[name]
    lens = lens.with_back(lens.back.to(torch.float32))
    found = simulated(source, lens, SCREEN, 300, seed=5)
    plain = simulated_plain(source, lens.with_back(lens.back.to(torch.float64)), SCREEN, 300, seed=5)
    assert found.rays == plain.rays > 3000
    # the same rays in the same pixels: sums of numbers of the order of the whole flux, in another order
    for one, other in ((found.box, plain.box), (found.tent, plain.tent)):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-13)
    assert found.flux == pytest.approx(plain.flux, abs=1e-13) and list(found.flux) == list(plain.flux)
    lands = {0: plain.flux["on target"] > 0.001, 4: plain.flux["off target"] > 0.001}
    assert any(lands.values()) == (0 in fates) and (lands[4] or 4 not in fates)


@pytest.mark.parametrize("name", SCENES)
def test_the_simulation_with_losses_is_the_plain_one(name):
    """Fresnel's losses by tables of 4097 cosines, absorption by the path: 1e-7 of the light of each line."""
    source, lens, _ = SCENES[name]
    metal = 1.2 + 6.0j if lens.reflects else None
    absorption = None if lens.reflects else AbsorptionLoss(0.01)
    lens = replace(lens, losses=Losses(FresnelLoss(550.0, metal=metal), absorption))
    found, plain = simulated(source, lens, SCREEN, 300, seed=5), simulated_plain(source, lens, SCREEN, 300, seed=5)
    assert found.rays == plain.rays and list(found.flux) == list(plain.flux)
    assert found.flux == pytest.approx(plain.flux, abs=1e-7)
    assert sum(found.flux.values()) == pytest.approx(1, abs=1e-12)
    for one, other in ((found.box, plain.box), (found.tent, plain.tent)):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-8)


@dataclass(frozen=True)
class Unknown(Emitter):
    """The light of another emitter, whose closed form no kernel is told."""

    other: Emitter
    wavelength = 587.6

    def irradiance(self, x, y, z):
        return self.other.irradiance(x, y, z)

    def rays_through(self, x, y, z, area):
        return self.other.rays_through(x, y, z, area)

    def window(self, outline, z, sags):
        return self.other.window(outline, z, sags)


SMOOTH = ("point, plane", "point, sphere", "point, conic", "mirror, gaussian, tilted, steep", "mirror, lambertian")


@pytest.mark.parametrize("name", SMOOTH)
def test_light_without_a_closed_form_is_traced_by_a_table(name):
    """Light whose closed form is known has the same rays by a table, within the table's error, and the same RRMSD."""
    known, lens, _ = SCENES[name]
    light = Unknown(known)
    x, y = (p.reshape(-1) for p in stratified(window(known, lens), 150, 0))
    found, plain = (land(source, lens, LevelPlane(400.0), x, y) for source in (light, known))
    lit = plain.flux > MIN_IRRADIANCE * plain.flux.max()
    off = found.flux[lit] / plain.flux[lit] - 1
    assert lit.sum() > 3000 and off.abs().max() < 100 * IRRADIANCE_TOLERANCE
    assert off.square().mean().sqrt() < 1.5 * IRRADIANCE_TOLERANCE
    there = lit & plain.alive & found.alive
    assert (found.status[lit] == plain.status[lit]).double().mean() > 0.999  # a ray on a rim may end on either side
    near = there & (plain.position.abs() < 400.0).all(0)
    assert near.sum() > 1000 and (found.position - plain.position)[:, near].abs().max() < 1e-4  # mm
    assert whole_kernel("trace.simulate", light, lens, SCREEN.receiver) is forward.simulate
    ours, theirs = (simulated(source, lens, SCREEN, 300, seed=5) for source in (light, known))
    assert ours.flux == pytest.approx(theirs.flux, abs=IRRADIANCE_TOLERANCE)
    apart = float((ours.tent - theirs.tent).norm() / theirs.tent.norm())
    assert apart < 3 * IRRADIANCE_TOLERANCE  # added to an RRMSD of 0.003 in quadrature: 5e-5 of it


def test_light_with_an_edge_and_of_few_rays_is_traced_by_the_plain_form():
    known, lens, _ = SCENES["collimated, plane"]
    assert whole_kernel("trace.simulate", Unknown(known), lens, SCREEN.receiver) is None
    known, lens, _ = SCENES["point, sphere"]
    assert whole_kernel("trace.simulate", Unknown(known), lens, SCREEN.receiver, tables=False) is None
    few, plain = (run(Unknown(known), lens, SCREEN, 60, seed=5) for run in (simulated, simulated_plain))
    assert torch.equal(few.box, plain.box)


def test_a_sum_of_lights_is_the_sum_of_their_simulations():
    """Each light has its own weight and seed; one call of the kernel traces all of them."""
    lit = [(0.3, *SCENES["point, plane"][:2], 3), (0.7, *SCENES["point, sphere"][:2], 4)]
    [found], [plain] = simulate(lit, [SCREEN], 120), simulate_plain(lit, [SCREEN], 120)
    parts = [simulated(source, lens, SCREEN, 120, seed) for _, source, lens, seed in lit]
    for one, other in ((found.box, plain.box), (found.tent, plain.tent)):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
    assert found.flux == pytest.approx(plain.flux, abs=1e-12)
    assert sum(found.flux.values()) == pytest.approx(1, abs=1e-12)
    whole = 0.3 * parts[0].box + 0.7 * parts[1].box  # of each the light on its beam's rim is scaled by itself
    torch.testing.assert_close(found.box, whole, rtol=1e-3, atol=1e-6)
    assert found.rays == plain.rays == parts[0].rays + parts[1].rays


@pytest.mark.parametrize("n", (1, 2, 255, 256, 257, 513))
def test_every_cell_is_traced_once(n):
    """Rows shorter than a block, of just one and of a block and a bit."""
    source, lens, _ = SCENES["point, plane"]
    wide = CollimatedSource(Rectangle(15.0, 15.0))
    assert simulated(wide, lens, SCREEN, n, 0).rays == n * n
    found, plain = simulated(source, lens, SCREEN, n, 2), simulated_plain(source, lens, SCREEN, n, 2)
    assert found.rays == plain.rays and found.flux == pytest.approx(plain.flux, abs=1e-13)
    torch.testing.assert_close(found.tent, plain.tent, rtol=0, atol=1e-13)


def test_light_on_the_border_of_the_screen_and_of_pixels():
    """Landings exactly on pixel borders, on the screen's corners and one rounding beyond."""
    screen = Screen(0.0, (0.0, 8.0), (-2.0, 2.0), (4, 8))
    xs = [0.0, 2.0, 4.0, 7.5, 8.0, np.nextafter(8.0, 9.0), -1e-300, -1.0, -0.9, 9.0, np.nan]
    ys = [-2.0, -1.0, 0.0, 1.5, 2.0, np.nextafter(2.0, 3.0), np.nextafter(-2.0, -3.0), 2.4, 2.5, np.nan]
    x, y = (p.reshape(-1) for p in np.meshgrid(xs, ys))
    count = x.size
    work = np.zeros(forward.WORK)
    flux, fate = 1.0 + np.arange(count), np.arange(count) % 6 // 5 * 2.0
    for place, values in zip(["X", "Y", "FLUX", "FATE"], (x, y, flux, fate), strict=True):
        at = getattr(forward, place)
        work[at : at + count] = values
    box, tent, lines = np.zeros((8, 4)), np.zeros((8, 4)), np.zeros(forward.LINES)
    forward.count_rays(forward.kernel_arguments.pixels(screen), count, work, box, tent, lines)
    rays = Landed(*(torch.from_numpy(a) for a in (np.stack([x, y]), flux, fate.astype(np.uint8))))
    assert np.array_equal(box, irradiance.box(rays, screen).numpy())
    plain = irradiance.collect_plain(torch.nan_to_num(rays.position, 99.0), irradiance.landed_flux(rays), screen)[0]
    assert np.allclose(tent, plain.numpy(), rtol=0, atol=1e-12)
    ledger = irradiance.ledger(rays, screen)
    assert lines[[0, 5, 2]].tolist() == [ledger[k] for k in ("on target", "off target", "lost through the sides")]
    assert lines[forward.COUNT] == count


def test_memory_does_not_grow_with_the_rays():
    source, lens, _ = SCENES["point, plane"]
    simulated(source, lens, SCREEN, 10, 0)
    peaks = []
    for n in (100, 1000):  # 1 000 000 rays would be 8 MB a number
        tracemalloc.start()
        simulated(source, lens, SCREEN, n, 0)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0] < 1e6


def test_what_the_kernel_takes(monkeypatch):
    source, lens, _ = SCENES["point, plane"]
    assert kernel_choice.whole_kernel("trace.simulate", lens.interfaces) is forward.simulate
    for other in (lens.back.heights.to(torch.float16), lens.back.heights.to("meta")):
        assert not kernel_choice.whole_kernel("trace.simulate", lens.with_heights([other]).interfaces)
    freeform = lens.with_front(replace(lens.back, z=6.0, heights=lens.back.heights - 10))
    window = replace(lens.interfaces[0], surface=Plane(1.0))
    for unknown in (freeform, replace(lens, before=(window,))):
        assert not kernel_choice.whole_kernel("trace.simulate", unknown.interfaces)
    monkeypatch.setitem(
        kernel_choice.KERNELS["trace.simulate bspline"], "cpu", lambda *given: pytest.fail("the kernel is called")
    )
    assert simulated(source, freeform, SCREEN, 50, 0).rays == 2500  # by the plain form


@dataclass(frozen=True)
class Asphere(Sphere):
    """A sphere and 1e-4 r⁴: a kind of front that no kernel knows."""

    kind: str = "asphere"

    def relative_sag_and_slope(self, x, y):
        h, z_x, z_y = super().relative_sag_and_slope(x, y)
        r2 = x * x + y * y
        return h + 1e-4 * r2 * r2, z_x + 4e-4 * r2 * x, z_y + 4e-4 * r2 * y


def test_a_new_kind_of_front_is_traced_by_its_own_equation():
    """Not by the kernel, to which it would be a conic of the same curvature."""
    lens = SCENES["collimated, plane"][1].with_front(Asphere(10.0, 0.01))
    beam = CollimatedSource(Circle(8.0))
    traced, plain = (run(beam, lens, SCREEN, 40, 0).box for run in (simulated, simulated_plain))
    sphere = simulated(beam, lens.with_front(Sphere(10.0, 0.01)), SCREEN, 40, 0).box
    assert torch.equal(traced, plain) and (traced - sphere).abs().sum() > 0.1 * sphere.sum()


def test_it_is_compiled_once():
    """Whole numbers as lengths, any seed and either precision call the same code: a compilation takes seconds."""
    compiled = forward._rows
    before = None
    for radius, seed in ((12.0, 0), (12, 1), (12, -3), (12.0, 1 << 70)):
        for dtype in (torch.float32, torch.float64):
            back = deep().back.to(dtype)
            for front in (Plane(15), Sphere(15, torch.tensor(0.01, dtype=dtype)), Sphere(15, 0)):
                lens = Lens.between(front, back, Circle(radius), 2)
                for source in (PointSource(position=(0, 0, 0)), CollimatedSource(Circle(radius)), PointSource(**CONE)):
                    simulated(source, lens, Screen(400, (-300, 500), (-400, 350), 40), 4, seed)
                    before = before or len(compiled.signatures)
    assert len(compiled.signatures) == before
