"""Cutting of tubes, edge by edge: sums that two triangles share, and values that must not pass between them."""

import math

import numpy as np
import pytest
import torch

from bstcad.optics.kernels import clip
from bstcad.optics.numerics import reductions
from bstcad.optics.trace import tubes

SHAPE = (11, 13)  # rows, columns
BOTH = (tubes.collect, tubes.collect_plain)


def even(n, m, low=1.0, high=10.0):
    """Corners of n x m tubes, evenly from low to high, in pixels."""
    places = (torch.linspace(low, high, count + 1, dtype=torch.float64) for count in (n, m))
    return torch.stack(torch.meshgrid(*places, indexing="ij"))


def shaken(n, m, seed, by, **ends):
    """An even sheet whose corners are thrown about by so much, and the flux of its tubes."""
    random = torch.Generator().manual_seed(seed)
    corner = even(n, m, **ends)
    corner = corner + by * torch.randn(corner.shape, generator=random, dtype=torch.float64)
    return corner, torch.rand((n, m), generator=random, dtype=torch.float64)


def seed_of(shape=SHAPE):
    return torch.rand(shape, generator=torch.Generator().manual_seed(11), dtype=torch.float64)


def light(form, corner, flux, shape=SHAPE, scale=tubes.PIXELS):
    """(image, outside, gradient in the corners, gradient in the flux)."""
    corner, flux = corner.clone().requires_grad_(), flux.clone().requires_grad_()
    image, outside = form(corner, flux, shape, scale)
    gradients = torch.autograd.grad((image * seed_of(shape)).sum() + 0.3 * outside, (corner, flux))
    return image.detach(), outside.detach(), *gradients


def same(found, wanted, image=1e-12, gradient=1e-9):
    for a, b, bound in zip(found, wanted, (image, image, gradient, gradient), strict=False):
        torch.testing.assert_close(a, b, rtol=bound, atol=bound * float(b.abs().max()))


def crowded(n, m, seed):
    """Some tubes a pixel, some in one pixel whole, none on a border: as in a design."""
    return shaken(n, m, seed, 0.06, low=1.01, high=9.99)


# Each makes some of the tubes of a sheet (2, 13, 15) unlike the others, which share their edges.
def in_one_pixel(corner):
    corner[:, 4:8, 4:8] = 5.3 + 0.04 * corner[:, 4:8, 4:8]


def without_area(corner):
    corner[:, 5:8, 6] = corner[:, 5:8, 5] + 1e-13


def thin(corner):
    corner[:, 5:8, 6] = corner[:, 5:8, 5] + torch.tensor([[1e-4], [-2e-4]], dtype=torch.float64)


def folded(corner):
    corner[:, 5:7] = corner[:, 5:7].flip(1)


def turned(corner):
    corner[:] = corner.flip(1).clone()


def beside_the_screen(corner):
    corner[0, :5] -= 7.0
    corner[1, :, 11:] += 5.0


def far_away(corner):
    corner[0, 6, 6], corner[1, 9, 3] = 3e4, -8e5


def to_the_borders(corner):
    corner[:, 7:] = corner[:, 7:].round() + 1e-3


PLACES = (
    in_one_pixel, without_area, thin, folded, turned, beside_the_screen, far_away, to_the_borders,
)  # fmt: skip


@pytest.mark.parametrize("put", PLACES, ids=lambda put: put.__name__)
def test_a_tube_unlike_its_neighbours_takes_nothing_from_them(put):
    """Picture, light outside and both gradients equal those of triangles that are followed one by one."""
    corner, flux = crowded(12, 14, 1)
    put(corner)
    flux[2, 3:6] = 0.0
    loose = put in (thin, far_away)  # ill-conditioned: a density of 1e4 a pixel², or edges of 1e5 pixels
    same(*(light(form, corner, flux) for form in BOTH), 1e-9 if loose else 1e-12, 1e-5 if loose else 1e-9)


def test_corners_in_another_unit_make_the_same_picture():
    """Half a pixel and, upside down, a quarter; powers of two, so that the pixels are the same to the last bit."""
    corner, flux = crowded(12, 14, 3)
    beside_the_screen(corner)
    corner = (corner * 2**20).round() / 2**20
    factor = torch.tensor([2.0, -4.0], dtype=torch.float64).view(2, 1, 1)
    first = torch.tensor([0.5, 3.0], dtype=torch.float64).view(2, 1, 1)
    for form in BOTH:
        image, outside, in_corner, in_flux = light(form, corner, flux)
        found = light(form, corner / factor + first, flux, scale=(0.5, 3.0, 2.0, -4.0))
        for ours, wanted in zip(found, (image, outside, in_corner * factor, in_flux), strict=True):
            assert torch.equal(ours, wanted)


@pytest.mark.parametrize("far", [math.nan, math.inf, -math.inf, 1e17])
def test_an_invalid_corner_removes_its_triangles_and_no_others(far):
    """Four of the eight around it, here; for the others it is as if those tubes had no flux, gradients included."""
    corner, flux = crowded(12, 14, 2)
    dark = flux.clone()
    dark[5:7, 4:6] = 0.0
    invalid = corner.clone()
    invalid[1, 6, 5] = far
    image, outside, in_corner, _ = light(tubes.collect, invalid, dark)
    same((image, outside, in_corner), light(tubes.collect_plain, corner, dark)[:3])
    left = tubes.collect(invalid, flux - dark, SHAPE)[0]
    assert float(left.min()) > -1e-12
    assert float(left.sum()) == pytest.approx(float((flux - dark).sum()) / 2, rel=1e-12)


def differences(corner):
    """Difference of the areas of the two triangles of each tube, relative to their sum."""
    first, second, third = tubes.triangles(corner)
    (a, b), (c, d) = second - first, third - first
    one, two = (a * d - b * c).chunk(2)
    return (one - two).abs() / (one + two).abs()


@pytest.mark.parametrize("columns", [1, 128, 129, 300])
def test_even_uneven_and_tubes_between_make_one_sheet(columns):
    """Blocks of 128 tubes, one more, and several: densities and integrals pass from each to its neighbours."""
    corner, flux = shaken(40, columns, columns, 0.002 * 9 / 40, low=1.01, high=9.99)
    corner = corner + 0.03 * torch.randn(corner.shape, generator=torch.Generator().manual_seed(5)) * (corner > 7)
    found = differences(corner)
    if columns > 1:
        assert (found < tubes.EVEN_TUBE).any() and (found > tubes.UNEVEN_TUBE).any()
    assert ((found > tubes.EVEN_TUBE) & (found < tubes.UNEVEN_TUBE)).any()
    ours, wanted = (light(form, corner, flux) for form in BOTH)
    same(ours, wanted, 1e-11, 1e-7)
    assert float(ours[0].sum()) == pytest.approx(float(flux.sum()), rel=1e-12)


def waves(n):
    """Corners of a sheet of n x n tubes of unequal areas, all of one sign, and the flux of tubes of even light."""
    x, y = even(n, n, low=1.2, high=9.8)
    corner = torch.stack([x + 0.5 * torch.sin(1.3 * x + 0.6 * y), y + 0.4 * torch.cos(1.1 * x - 0.9 * y)])
    return corner, torch.full((n, n), 1 / n**2, dtype=torch.float64)


@pytest.mark.parametrize("n", [24, 48, 96])
def test_one_density_a_tube_costs_little_accuracy(n, monkeypatch):
    """Beside a sheet of 16 times as many tubes, the error exceeds that of two densities a tube by 16 % or less."""
    wanted, _ = tubes.collect(*waves(16 * n), SHAPE)
    one, _ = tubes.collect(*waves(n), SHAPE)
    monkeypatch.setattr(tubes, "EVEN_TUBE", 1e-12)
    monkeypatch.setattr(tubes, "UNEVEN_TUBE", 2e-12)
    two, _ = tubes.collect(*waves(n), SHAPE)
    monkeypatch.undo()
    assert float((differences(waves(n)[0]) < tubes.EVEN_TUBE).double().mean()) > 0.1
    assert float((one - wanted).norm()) < 1.2 * float((two - wanted).norm())


def on_borders(seed, columns, rows):
    """Corners on the borders of pixels, or within rounding of them, some on the border of the screen or beyond it."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-0.4, columns + 0.4, 31), np.linspace(-0.4, rows + 0.4, 140), indexing="ij")
    corner = np.stack([x, y]) + random.normal(0, (0.1, 0.7)[seed % 2], (2, 31, 140))
    near = np.round(corner * (1, 3)[seed % 3 > 0]) / (1, 3)[seed % 3 > 0]
    near = np.clip(near, 0, np.array([columns, rows]).reshape(2, 1, 1))
    near = np.where(random.random(near.shape) < 0.3, np.nextafter(near, random.choice([-9.0, 99.0], near.shape)), near)
    return np.where(random.random(corner.shape) < 0.9, near, corner)


@pytest.mark.parametrize("seed", range(12))
def test_no_rounding_leads_beyond_the_screen(seed):
    """Around the sums lie numbers that nobody may change, and around the gradient of the picture nobody may read."""
    columns, rows = 9, 13
    corner, flux = on_borders(seed, columns, rows), np.random.default_rng(seed).random((30, 139))
    if seed % 4 == 0:  # all of a part's light in few columns
        corner[0] = corner[0] * 0.3 + 2.0
    tube, scale, rules = (corner, tubes.PIXELS), tubes.PIXELS, (tubes.MIN_TRIANGLE_AREA, tubes.EVEN_TUBE, 0.12)
    ranges, begins, far = np.empty((4, 2), np.int64), np.zeros(5, np.int64), np.zeros(4)
    clip._column_ranges(*tube, columns, ranges)
    begins[1:] = np.cumsum(np.maximum(ranges[:, 1] - ranges[:, 0], 1) * (rows + 1)) + 64 * np.arange(1, 5)
    begins += 64  # untouched numbers before each part and after the last
    sums = np.full(begins[-1] + 64, 7.0)
    ends = begins[:-1] + np.maximum(ranges[:, 1] - ranges[:, 0], 1) * (rows + 1)
    image = np.zeros((columns, rows))
    for part in range(4):  # each by itself, since the kernel clears all between two begins
        first, last = clip._rows_of(part, 4, 30)
        own = np.array([begins[part], ends[part]])
        clip._clip(
            corner[:, first : last + 1],
            scale,
            flux[first:last],
            rules,
            (columns, rows),
            ranges[part : part + 1],
            own,
            sums,
            far[:1],
        )
        clip._running_sums(ranges[part : part + 1], own, sums, image_of := np.empty((columns, rows)))
        image += image_of
    used = np.zeros(sums.size, bool)
    for first, last in zip(begins, ends, strict=False):
        used[first:last] = True
    assert (sums[~used] == 7.0).all()
    plain, _ = tubes.collect_plain(torch.from_numpy(corner), torch.from_numpy(flux), (rows, columns))
    np.testing.assert_allclose(image.T, plain.numpy(), atol=1e-9)
    guarded = np.full(2 * columns * rows + 2 * rows * 4, np.nan)
    both = guarded[4 * rows : -4 * rows].reshape(columns, rows, 2)
    clip._with_sums_below(np.asfortranarray(seed_of((rows, columns)).numpy()), both)
    d_corner, d_flux = np.zeros(corner.shape), np.empty(flux.shape)
    clip.clip_adjoint(corner, scale, flux, rules, both, 0.3, d_corner, d_flux)
    assert np.isfinite(d_corner).all() and np.isfinite(d_flux).all()


def caustic(n, m):
    """A sheet that a wave folds over itself, with folds and cusps where its area goes through zero."""
    x, y = even(n, m, low=1.5, high=9.5)
    return torch.stack([x + 0.8 * torch.sin(2.1 * x + 0.7 * y), y + 0.9 * torch.cos(1.9 * x - 0.4 * y)])


def test_a_caustic_keeps_its_flux_and_its_gradient():
    """Several parts and strips each follow the edges that they share with their neighbours."""
    n, m, shape = 210, 190, (48, 56)
    assert reductions.parts(n * m) > 1 and n > 3 * clip.ROWS_PER_STRIP
    corner = 4.4 * caustic(n, m)
    area = signed_area(corner)
    assert 0.1 < float((area < 0).double().mean()) < 0.9
    flux = torch.rand((n, m), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    found, plain = (light(form, corner, flux, shape) for form in BOTH)
    assert float(found[0].sum()) == pytest.approx(float(flux.sum()), rel=1e-12)
    torch.testing.assert_close(found[0], plain[0], rtol=0, atol=1e-10 * float(plain[0].max()))
    torch.testing.assert_close(found[3], plain[3], rtol=0, atol=1e-8)
    assert float((found[2] - plain[2]).norm() / plain[2].norm()) < 1e-5  # some areas are 1e-6: rounding over area²


def signed_area(corner):
    """Signed area of each quad."""
    (x, y) = corner
    return ((x[1:, 1:] - x[:-1, :-1]) * (y[:-1, 1:] - y[1:, :-1])
            - (x[:-1, 1:] - x[1:, :-1]) * (y[1:, 1:] - y[:-1, :-1])) / 2  # fmt: skip


def test_even_tubes_of_one_density_have_no_edges_inside():
    """Edges between two triangles of the same density add nothing: only the outline counts, to rounding."""
    corner = even(24, 24, low=2.25, high=8.25)
    image, _ = tubes.collect(corner, torch.full((24, 24), 36 / 24**2, dtype=torch.float64), SHAPE)
    line = torch.tensor([0, 0, 0.75, 1, 1, 1, 1, 1, 0.25, 0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(image, line[: SHAPE[0], None] * line[: SHAPE[1]], rtol=0, atol=1e-13)
