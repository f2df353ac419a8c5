"""Points that stand alone are left out and counted; a defect that covers an area is form, and stays."""

from pathlib import Path

import numpy as np
import pytest

from bstcad.designs import folder as folders
from bstcad.manufacture.measured import cloud as clouds
from bstcad.manufacture.measured import made_part
from bstcad.manufacture.measured.alignment import BackFace, align, first_pose
from bstcad.manufacture.measured.form_error import deviation, fit_form_error
from bstcad.optics.trace.measure import Effort
from bstcad.report.record import with_part
from bstcad.report.units import environment
from tests import suite
from tests.manufacture.measured.synthetic import cloud, dirty, with_form_error
from tests.report.test_report import CONTENTS

NOISE = 2e-5  # mm
DUST, SLIPS = (1.0,), (-1.0, 1.0)


@pytest.fixture(scope="module")
def nominal(small_design):
    return folders.read_nominal(small_design.folder)


@pytest.fixture(scope="module")
def clean(nominal):
    """The cloud of a part with 0.2 \u00b5m of form error, as an instrument sees it."""
    return cloud(with_form_error(nominal.lens, 2e-4, 1.5), 4000, NOISE)


def on_face(lens, found):
    face = BackFace.of(lens)
    return face, align(face, found, first_pose(face, found)[0])


def figures(lens, found):
    face, placed = on_face(lens, found)
    return deviation(lens, placed, fit_form_error(face, placed)), placed


@pytest.fixture(scope="module")
def wanted(nominal, clean):
    return figures(nominal.lens, clean)[0]


@pytest.mark.parametrize(("share", "sides"), [(0.001, DUST), (0.05, SLIPS)], ids=["dust", "slips"])
def test_the_form_is_that_without_outliers(nominal, clean, wanted, share, sides):
    given, off = dirty(clean, share, sides)
    found, placed = figures(nominal.lens, given)
    assert found.form_rms == pytest.approx(wanted.form_rms, rel=0.01)
    assert (found.rms, found.pvr, found.noise) == pytest.approx((wanted.rms, wanted.pvr, wanted.noise), rel=0.05)
    assert found.pv <= 1.01 * wanted.pv and off.sum() - len(placed.outliers) <= 0.02 * off.sum() + 1  # the rim's


def test_outliers_of_one_height_or_within_the_noise_change_the_form_little(nominal, clean, wanted):
    alike, small = (figures(nominal.lens, dirty(clean, 0.05, DUST, heights)[0])[0] for heights in ("alike", "small"))
    assert alike.form_rms == pytest.approx(wanted.form_rms, rel=0.05) == small.form_rms


DEFECTS = {
    "bump": lambda x, y: 5e-3 * np.exp(-(((x - 1.0) ** 2 + y**2) / 0.4**2)),
    "pit at the edge": lambda x, y: np.where(np.hypot(x - 3.9, y - 1.0) < 0.5, -5e-3, 0.0),  # its walls are steps
    "scratch": lambda x, y: np.where((np.abs(y) < 0.12) & (np.abs(x) < 1.5), -2e-3, 0.0),
}


@pytest.mark.parametrize("defect", suite.in_turns(DEFECTS, 2))
def test_a_defect_that_covers_an_area_is_form(nominal, clean, defect):
    """Some fifty points in all, under dust: the dust goes, at least 97 of 100 points of the defect stay."""
    lens = nominal.lens
    given = cloud(lens, 16_000, NOISE, (0.0,) * 3, (0.0,) * 3)
    off = DEFECTS[defect](given[:, 0], given[:, 1])
    given[:, 2] += off
    dusty, dust = dirty(given, 0.01, DUST)
    _, placed = on_face(lens, dusty)
    out = {tuple(point) for point in np.round(placed.outliers[:, :2], 3)}
    hit = np.array([tuple(point) in out for point in np.round(placed.pose.to_design(dusty)[:, :2], 3)])
    deep = (np.abs(off) > 1e-4) & ~dust
    assert deep.sum() > 40 and hit[deep].mean() <= 0.03 and hit[~deep & ~dust].mean() < 1e-3
    assert hit[dust].mean() > 0.95


@suite.in_turn(0, 2)
def test_outliers_are_counted_and_remarked_and_too_many_fail(nominal, clean, monkeypatch):
    """The light of the first part is that of all three: points are what is judged here."""
    light, known = made_part._light, []

    def once(*given, **more):
        known.extend([] if known else [light(*given, **more)])
        return known[0]

    monkeypatch.setattr(made_part, "_light", once)

    def judged(share):
        given = clouds.Cloud(dirty(clean, share, DUST)[0], "mm", Path("cloud.csv"))
        return made_part.judge(given, nominal.lens, nominal, Effort(64))

    few, some, many = map(judged, (0.001, 0.03, 0.2))
    assert few.facts["passed"] and some.facts["passed"]
    assert [check.id for check in many.checks if not check.passed] == ["made-outliers"]
    assert some.facts["outliers"] == {
        "points": len(some.outliers), "share": pytest.approx(0.03, rel=0.03), "above": len(some.outliers),
        "farthest": pytest.approx(0.5, rel=0.05),
    }  # fmt: skip
    assert with_part(CONTENTS, some).remarks == ("outliers",) and not with_part(CONTENTS, few).remarks
    told = {"report": {"measured": few.facts | {"deviation_map": []}}, "pictures_on": lambda *given: ""}
    page = " ".join(environment().get_template("made_part.html.j2").render(told).split())
    assert "4 points (0.10 % of the points near the face)" in page
