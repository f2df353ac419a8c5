"""Neglected effects: estimates against closed forms, on plates and prisms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bstcad.analysis import neglected_effects
from bstcad.analysis.neglected_effects import Reference, Spline, blur_by_gaussian, difference, to_pixels
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.losses import AbsorptionLoss, FresnelLoss, Losses
from bstcad.optics.light.channels import Channel
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.surfaces import Plane
from tests.lenses import tilted

INDEX, THICKNESS = 1.5, 4.0
SMOOTH = 100.0  # pixels that a control cell lights
BEAM = CollimatedSource(Rectangle(11.0, 11.0), z=-5.0)
LAMP = PointSource((0.0, 0.0, -50.0), profile="uniform", half_angle=4.0)
SCREEN = Screen(1000.0, (-8.0, 8.0), (-6.0, 6.0), (64, 48))


def plate(slope=0.0):
    """Two planes, of which the back rises by `slope` along x: a prism, which sends light towards +x."""
    return Lens.between(Plane(0.0), tilted(slope, THICKNESS, 6.0), Rectangle(12.0, 12.0), INDEX)


def checks(period=8):
    """Smooth stripes both ways, dark towards the borders."""
    rows, columns = np.mgrid[:48, :64]
    waves = 1 + 0.5 * np.sin(2 * np.pi * columns / period) * np.cos(2 * np.pi * rows / period)
    return waves * np.exp(-(((columns - 31.5) / 9) ** 2) - ((rows - 23.5) / 7) ** 2)


def moved(picture, by_column, by_row):
    """A picture of 48 x 64 pixels whose light is moved along columns and rows, in cells of 2 x 2 pixels."""
    shift = np.stack([np.broadcast_to(by, (24, 32)) for by in (by_column, by_row)])
    return Spline.through(picture, SMOOTH).moved(shift)


def reference(lens=None, source=BEAM, screen=SCREEN, picture=None):
    channel = Channel(source, INDEX)
    return Reference.of(lens or plate(), channel, screen, checks() if picture is None else picture)


def test_a_plate_reflects_four_percent_a_face_and_changes_no_picture():
    found = reference().change([Channel(BEAM, INDEX, losses=Losses(FresnelLoss(587.6)))])
    assert found.flux == pytest.approx(0.96**2 - 1, abs=1e-12)
    assert found.rrmsd == pytest.approx(0, abs=1e-12) and found.blur == 0


def test_glass_absorbs_by_its_thickness_and_a_wedge_of_it_changes_the_picture():
    def found(lens):
        return reference(lens).change([Channel(BEAM, INDEX, losses=Losses(absorption=AbsorptionLoss(0.01)))])

    assert found(plate()).flux == pytest.approx(math.exp(-0.01 * THICKNESS) - 1, abs=1e-12)
    assert found(plate()).rrmsd < 1e-12
    deviation = math.asin(INDEX * math.sin(math.atan(0.004))) - math.atan(0.004)
    moved_by = 996 * math.tan(deviation)
    screen = replace(SCREEN, x=(moved_by - 8.0, moved_by + 8.0))
    lens = plate(0.004)
    found = reference(lens, screen=screen).change([Channel(BEAM, INDEX, losses=Losses(absorption=AbsorptionLoss(1.0)))])
    # exp(-a s x) over the picture, x by 0.25 mm a pixel: its relative deviation weighted by E²
    x = (np.arange(64) - 31.5) * 0.25
    wanted = difference(checks() * np.exp(-0.004 * x), checks())
    assert found.rrmsd == pytest.approx(wanted, rel=0.1)


def test_dispersion_spreads_light_by_the_change_of_deviation():
    slope, spread = 0.05, 1e-3
    shifts = [math.tan(math.asin((INDEX + dn) * math.sin(math.atan(slope))) - math.atan(slope)) * (1000 - THICKNESS)
              for dn in (-spread, spread)]  # fmt: skip
    middle = sum(shifts) / 2
    screen = replace(SCREEN, x=(middle - 8.0, middle + 8.0))
    two = [Channel(BEAM, INDEX + dn, 0.5) for dn in (-spread, spread)]
    found = reference(plate(slope), screen=screen).change(two)
    half = (shifts[1] - shifts[0]) / 2 / 0.25  # pixels
    assert found.blur == pytest.approx(2 * math.sqrt(2) * half, rel=0.01)
    waves = sum(np.roll(checks(), n, axis=1) for n in (-1, 1)) / 2  # by a pixel each way, to compare with
    assert 0.1 < half < 1
    assert found.rrmsd == pytest.approx(difference(waves, checks()) * half**2, rel=0.15)  # second order in it
    assert found.flux == pytest.approx(0, abs=1e-4)


def test_a_wide_source_is_imaged_through_every_place_of_a_plate():
    """Seen from the back at 50 + 4 / n mm, the lamp's image is as much larger as the screen is further off."""
    wide = replace(LAMP, diameter=0.1)
    six = [(math.cos(a), math.sin(a)) for a in np.arange(6) * math.pi / 3]
    radius = wide.extent.radius * 2**-0.5  # a ring of the same second moment as the disc
    channels = [Channel(wide.element(radius * x, radius * y), INDEX, 1 / 6) for x, y in six]
    screen = Screen(1000.0, (-80.0, 80.0), (-80.0, 80.0), (64, 48))
    found = reference(source=LAMP, screen=screen).change(channels)
    image = 0.1 * (1000 - THICKNESS) / (50 + THICKNESS / INDEX)
    pixels = math.sqrt(((image / 160) ** 2) * (64**2 + 48**2) / 2)
    assert found.blur == pytest.approx(pixels, rel=0.02)
    assert found.rrmsd > 1e-3


@pytest.mark.parametrize("tilt", [0.0, 60.0])  # degrees about y: a beam is wider by 1 / cos on the screen
def test_a_ghost_of_a_plate_is_its_two_reflections(tilt):
    half = 8.0 / math.cos(math.radians(tilt))
    screen = replace(SCREEN, x=(-half, half), y=(-8.0, 8.0), pixels=48, tilt=(0.0, tilt) if tilt else None)
    even = np.zeros((48, 48))
    even[8:40, 8:40] = 1.0  # the beam, straight through
    found = reference(screen=screen, picture=even).ghost(Channel(BEAM, INDEX, losses=Losses(FresnelLoss(587.6))))
    assert found.flux == pytest.approx(0.04**2, rel=1e-6)
    assert found.rrmsd < 0.3 * found.flux  # it lies on the light that goes straight through, but for its cells


def test_diffraction_is_as_wide_as_wavelength_times_way_over_aperture():
    found = reference().diffraction()
    assert found.blur == pytest.approx(587.6e-6 * (1000 - THICKNESS) / 11 / 0.25, rel=0.05)
    assert found.flux == 0 and 0 < found.rrmsd < 0.1


class TestPictures:
    def test_a_field_of_cells_is_linear_between_their_middles(self):
        """The field is linear outside the outermost middles, too."""
        found = to_pixels(np.arange(3.0) + 10 * np.arange(2.0)[:, None], (4, 12))
        np.testing.assert_allclose(found[:, 1], [-0.0, 2.5, 7.5, 10.0], atol=1e-12)
        np.testing.assert_allclose(np.diff(found[0]), [0, *[0.125, *[0.25] * 7, 0.125], 0], atol=1e-12)

    def test_light_moves_by_whole_pixels_exactly(self):
        np.testing.assert_allclose(moved(checks(), 2.0, -1.0)[:-1, 2:], checks()[1:, :-2], atol=1e-9)

    def test_light_that_spreads_is_kept_and_thins_and_light_beyond_the_picture_is_lost(self):
        wide = moved(checks(), 0.05 * (2 * np.arange(32) + 0.5 - 31.5), 0.0)
        assert wide.sum() == pytest.approx(checks().sum(), rel=5e-3)
        assert wide[23, 31] == pytest.approx(checks()[23, 31] / 1.05, rel=0.02)
        assert moved(np.ones((48, 64)), 4.0, 0.0).sum() == pytest.approx(48 * 60, rel=0.01)

    def test_of_a_large_picture_some_rows_tell(self, monkeypatch):
        whole = difference(moved(checks(), 0.5, 0.5), checks())
        monkeypatch.setattr(neglected_effects, "MAX_SAMPLED_PIXELS", 48 * 64 // 3)
        some = Spline.through(checks(), SMOOTH).rows(checks())
        assert some.shape == (16, 64)
        assert difference(moved(checks(), 0.5, 0.5), some) == pytest.approx(whole, rel=0.05)

    def test_a_blur_keeps_the_light_and_adds_its_variance(self):
        wide = blur_by_gaussian(checks(), 1.5)
        rows, columns = np.indices((48, 64))
        variance = [((columns - 31.5) ** 2 * p).sum() / p.sum() for p in (checks(), wide)]
        assert wide.sum() == pytest.approx(checks().sum()) and variance[1] - variance[0] == pytest.approx(
            2.25, rel=1e-3
        )
        np.testing.assert_allclose(blur_by_gaussian(checks(), 0.0), checks(), atol=1e-12)

    def test_a_difference_is_that_of_pictures_of_one_sum(self):
        assert difference(3 * checks(), checks()) == pytest.approx(0, abs=1e-12)
        assert difference(np.zeros((48, 64)), checks()) == 1.0


def test_a_narrow_beam_on_a_wide_lens_is_followed_where_it_is():
    source = CollimatedSource(Circle(1.0), z=-5.0)
    found = reference(source=source)
    assert (found.flux > 0).mean() > 0.4
