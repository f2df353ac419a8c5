"""Absolute values and test points in the report, the terminal, JUnit and the scale of the picture of the light."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from lxml import etree
from rich.console import Console

from bstcad.figures.light_figures import View
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import Plane
from bstcad.optics.trace.measure import Light
from bstcad.planning.effect_estimates import simulated
from bstcad.report import report as reports
from bstcad.report.goal_figures import photometry
from bstcad.report.record import of_json, plain
from bstcad.scene.scene import load
from bstcad.verify.light_limits import LightValue
from tests.lenses import net
from tests.report.test_report import REPORT

LUMENS, ON_TARGET, LEAVING = 500.0, 0.4, 0.44


@pytest.fixture(scope="module")
def disk():
    return load("templates/disk.toml", {"target.pixels": 40, "source.lumens": LUMENS})


def absolute(scene):
    """Absolute figures of light that has the picture of the target."""
    flux = {"on target": ON_TARGET, "off target": LEAVING - ON_TARGET, "missed the lens": 1 - LEAVING}
    picture = scene.target.irradiance()
    peak = float((picture / scene.target.screen.cell_sizes).max() / picture.sum())
    light = Light(picture, 0.1, 0.0, rays=1, flux=flux, on_screen=ON_TARGET, peak=peak)
    lens = Lens.between(Plane(15.0), net(z=20.0), Circle(8.0), 1.5)
    lumens, reflection = scene.source.luminous_flux, scene.loses_reflections
    [found] = photometry(scene.goals, SimpleNamespace(lights=(light,), lens=lens), lumens, reflection=reflection)
    return found


def test_a_disc_has_the_lux_of_its_lumens(disk):
    found = absolute(disk)
    area, whole = np.pi * 0.18**2, 0.4**2  # m²
    assert found.peak == pytest.approx(LUMENS * ON_TARGET / area, rel=1e-3) and found.unit == "lx"
    assert found.mean == pytest.approx(LUMENS * ON_TARGET / whole) and found.lumens == LUMENS * ON_TARGET
    assert found.output_ratio == LEAVING and found.reflection and found.luminance is None
    assert list(photometry(disk.goals, SimpleNamespace(lights=(None,)), None, reflection=False)) == []
    assert not absolute(disk.changed({"effects": []})).reflection


def test_a_cone_has_the_candela_of_its_lumens(disk):
    """1000 lm evenly over a cone of half angle 20 degrees, and the luminance of a disc of 8 mm."""
    outline = {"shape": "circle", "radius": 20.0}
    cone = {"kind": "intensity", "x": [-24, 24], "y": [-24, 24], "pixels": 96, "uniform": True, "outline": outline}
    found = absolute(disk.changed({"target": cone}))
    assert found.peak == pytest.approx(LUMENS * ON_TARGET / (2 * np.pi * (1 - np.cos(np.radians(20)))), rel=2e-3)
    assert found.unit == "cd" and found.peak < found.luminance * np.pi * 0.008**2 < found.peak / np.cos(np.radians(20))


def test_the_default_names_the_flux_that_brings_it(disk):
    assert dict(simulated(disk))["Fresnel reflection at both faces"] == "source.lumens"
    stated = disk.changed({"effects": [{"kind": "fresnel"}]})
    assert dict(simulated(stated))["Fresnel reflection at both faces"] == "effects[0].kind"


def test_the_scale_of_the_picture_states_lux(disk):
    target = disk.target.irradiance()
    lux = LUMENS * ON_TARGET / (np.pi * 0.18**2)
    words = View.of(disk).with_flux(target, ON_TARGET).mean_lit
    assert words.startswith("irradiance / mean of lit pixels\n(") and words.endswith(" lx)")
    assert float(words.partition("(")[2].removesuffix(" lx)").replace("\u202f", "")) == pytest.approx(
        lux, rel=0.07
    )  # pixels at the rim
    unknown = View.of(disk.changed({"source.lumens": None})).with_flux(target, ON_TARGET)
    assert unknown.mean_lit == "irradiance / mean of lit pixels"


# ---- what the user reads ---------------------------------------------------------------------------------------------

VALUES = (
    LightValue("test point B50L at (1, 2) mm", "point", 612.0, 1.5, least=500.0, most=600.0, unit="lx", margin=-12.0),
    LightValue("uniformity, smallest / mean", "uniformity", 0.6, 0.01, least=0.4, most=None, unit="", margin=0.2),
    LightValue("sharpness of the cut-off", "cut-off", None, None, least=0.1, most=None, unit="", margin=None),
)


@pytest.fixture(scope="module")
def report(disk):
    checks = [plain(check) for value in VALUES for check in value.checks()]
    more = {"values": list(map(plain, VALUES)), "photometry": [plain(absolute(disk))]}
    return of_json(
        json.dumps(REPORT | more | {"checks": REPORT["checks"] + checks, "passed": False, "verdict": "failed"})
    )


def test_the_terminal_states_values_errors_and_margins(report):
    console = Console(file=io.StringIO(), width=300)
    console.print(reports.summary(report, verbose=True))
    text = console.file.getvalue().replace("\u202f", " ")
    for words in (
        "200 lm (of 500 lm of the source)", "1250 lx (mean over the target; 19", "Light output ratio",
        "44.0 % (flux behind the lens / flux of the source; with the losses by reflection",
        "612 lx (standard error 1.5; limit ≥ 500, limit ≤ 600; missed by 12)",
        "0.6 (standard error 0.01; limit ≥ 0.4; margin 0.2)",
        "not measured (limit ≥ 0.1)",
        "FAIL test point B50L at (1, 2) mm, at most: 612 lx, limit ≤ 600 lx [check-point]",
        "pass test point B50L at (1, 2) mm, at least: 612 lx, limit ≥ 500 lx [check-point]",
    ):  # fmt: skip
        assert words in text, words


def test_the_page_and_junit_state_them(report):
    page = reports.html(report, {}).decode()
    assert "612 lx" in page and "missed by 12" in page and "test point B50L at (1, 2) mm, at most" in page
    cases = etree.fromstring(reports.junit(report)).findall(".//testcase")
    failed = [case.get("name") for case in cases if case.find("failure") is not None]
    assert failed == ["test point B50L at (1, 2) mm, at most", "sharpness of the cut-off"]


def test_the_record_is_read_back(report):
    assert of_json(json.dumps(report.facts())) == report
