"""Form errors: the spline, the minimum zone against a linear program of all points, PVr, Zernike terms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from bstcad.manufacture.measured.alignment import BackFace, align, identity_pose
from bstcad.manufacture.measured.form_error import (
    deviation,
    fit_form_error,
    map_files,
    minimum_zone,
    robust_pv,
    zernike,
)
from bstcad.manufacture.measured.shrinkage import scale
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane, sag
from tests.lenses import net
from tests.manufacture.measured.synthetic import points, with_form_error


@pytest.fixture(scope="module")
def lens():
    back = net(lambda x, y: 0.02 * x**2 + 0.01 * y**2 + 0.0005 * x**3, 5.0, 33, 6.0)
    return Lens.between(Plane(0.0), back, Circle(5.0), 1.5)


def test_the_minimum_zone_is_that_of_all_points(lens):
    face = BackFace.of(lens)
    found = align(face, points(with_form_error(lens, 5e-4, 2.0), 3000), identity_pose(face))
    width, _ = minimum_zone(face, found)
    columns, one = face.columns(found.points, found.normals), np.ones((len(found.points), 1))
    exact = linprog(
        [0.0] * 6 + [1.0],
        A_ub=np.vstack([np.hstack([columns, -one]), np.hstack([-columns, -one])]),
        b_ub=1e3 * np.concatenate([-found.distances, found.distances]),
        bounds=[(None, None)] * 6 + [(0, None)],
    )
    assert width == pytest.approx(2e-3 * exact.fun, rel=0.01) and width <= np.ptp(found.distances) * 1.001


def test_a_known_error_has_a_known_zone(lens):
    """cos(k φ) at the rim: no motion makes its largest distance smaller."""
    ripple = 1e-3
    given = points(lens, 20_000)
    angle, radius = np.arctan2(given[:, 1], given[:, 0]), np.hypot(given[:, 0], given[:, 1]) / 5
    given[:, 2] += ripple * radius**6 * np.cos(6 * angle)
    face = BackFace.of(lens)
    normal_z = 1 / np.sqrt(1 + 0.2**2)
    width, _ = minimum_zone(face, align(face, given, identity_pose(face)))
    assert 2 * ripple * normal_z * 0.93 < width < 2 * ripple


def test_an_alignment_never_mirrors(lens):
    mirrored = lens.with_back(replace(lens.back, heights=lens.back.heights.flip(0)))
    face = BackFace.of(lens)
    found = align(face, points(mirrored, 3000), identity_pose(face))
    assert np.linalg.det(found.pose.rotation) == pytest.approx(1.0) and found.rms > 0.01


def test_zernike_terms_are_orthogonal_on_the_disc():
    """∫ Z² over the unit disc is π / (n + 1) for m = 0 and π / (2 (n + 1)) else (Noll 1976, without his factors)."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    radius, turn = np.sqrt((nodes + 1) / 2), np.arange(64) * 2 * np.pi / 64  # r dr = d(r²) / 2
    x, y = (np.outer(radius, f(turn)).ravel() for f in (np.cos, np.sin))
    terms = zernike(x, y)
    gram = terms.T @ (terms * np.repeat(weights * np.pi / 128, 64)[:, None])
    orders = [(n, m) for n in range(11) for m in range(n % 2, min(n, 10 - n) + 1, 2) for _ in range(2 if m else 1)]
    wanted = [np.pi / ((n + 1) * (2 if m else 1)) for n, m in orders]
    assert terms.shape[1] == 36 and np.abs(gram - np.diag(wanted)).max() < 1e-12


def test_pvr_of_a_smooth_error_is_its_pv_and_of_noise_three_times_its_rms():
    """A defocus of 1 µm reaches from -1 to 1 µm; a few outliers of noise do not count."""
    random = np.random.default_rng(0)
    points = np.column_stack([*random.uniform(-1, 1, (2, 40_000)), np.zeros(40_000)])
    points = np.vstack([points[np.hypot(points[:, 0], points[:, 1]) < 1], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    r2, noise = points[:, 0] ** 2 + points[:, 1] ** 2, random.normal(0, 1e-5, len(points))
    assert robust_pv(points, 1e-3 * (2 * r2 - 1)) == pytest.approx(2e-3, rel=1e-9)
    assert robust_pv(points, noise) == pytest.approx(3e-5, rel=0.1) and np.ptp(noise) > 7e-5


class TestForm:
    """A cloud in the frame of the design, with 0.5 µm of form error and 10 nm of noise."""

    NOISE = 1e-5  # mm

    @pytest.fixture(scope="class")
    @classmethod
    def made(cls, lens):
        return with_form_error(lens, 5e-4, 3.0)

    @pytest.fixture(scope="class")
    @classmethod
    def placed(cls, lens, made):
        face, given = BackFace.of(lens), points(made, 8000)
        given[:, 2] += np.random.default_rng(3).normal(0.0, cls.NOISE, len(given))
        return face, align(face, given, identity_pose(face))

    def test_the_spline_is_the_form_error_on_any_net(self, lens, made, placed):
        """`on` adds the heights of `at`; a sample of the posterior differs by as much either way."""
        form = fit_form_error(*placed)
        x, y, _ = points(lens, 500, seed=9).T
        with_it, error = form.add_to(lens.back), form.at(x, y)
        assert with_it.m >= max(lens.back.m, form.random_field.m) and form.noise == pytest.approx(self.NOISE, rel=0.1)
        on_net = sag(with_it, x, y) - sag(lens.back, x, y)
        assert np.sqrt(np.mean((on_net - error) ** 2)) < 1e-3 * error.std()
        true = sag(made.back, x, y) - sag(lens.back, x, y)
        assert np.sqrt(np.mean((error - true) ** 2)) < 0.05 * true.std()
        more, less = (form.posterior_sample(np.random.default_rng(0), sign).at(x, y) for sign in (1.0, -1.0))
        np.testing.assert_allclose((more + less) / 2, error, atol=1e-12)
        assert 0 < (more - error).std() < self.NOISE

    def test_bands_are_waves_of_their_periods_and_the_map_holds_the_form(self, lens, placed):
        found = deviation(lens, placed[1], fit_form_error(*placed))
        assert found.bands[0].period is None
        for longer, shorter in zip(found.bands[1:], found.bands[2:], strict=False):
            assert longer.period[1] == shorter.period[0] and longer.period[0] == 2 * longer.period[1]
        npz, csv = map_files(found).values()
        assert npz[:2] == b"PK" and csv.count(b"\n") == found.form.size + 1
        assert found.form_rms == pytest.approx(np.sqrt(np.nanmean(found.form**2)))

    def test_a_scale_is_seen_beside_the_six_motions(self, lens):
        face = BackFace.of(lens)
        grown = (points(lens, 4000) - face.pivot) * 1.0005 + face.pivot
        value, uncertainty = scale(face, align(face, grown, identity_pose(face)))
        assert value == pytest.approx(1.0005, abs=2e-5) and uncertainty < 2e-4
