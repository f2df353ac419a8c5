"""Errors of a dome: distances after motions, wedge against tilt and decentre, form errors on a sphere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bstcad.manufacture.tolerance.perturbations import Setup, form_error, inside_outline, kinds, random_field, ripple
from bstcad.optics.surfaces.motion import Motion
from bstcad.scene.scene import load
from tests.scenes import DISK, DOME

CENTRE = 2.0  # mm, z of the centre of the dome and of the lamp


def setup_of(**changes):
    """The dome before tailoring, with a wavy back of 33 control points."""
    back = {"kind": "radial", "centre": [0.0, 0.0, CENTRE], "radius": 15.0, "half_angle": 60.0, "control_points": 33}
    lens = {"material": "PMMA", "front": {"kind": "sphere", "z": 8.0 + CENTRE, "curvature": -0.125}, "back": back}
    source = {"kind": "point", "profile": "lambertian", "position": [0.0, 0.0, CENTRE]}
    scene = load(DISK, DOME | {"lens": lens, "source": source} | changes)
    flat = scene.flat_lens(33)
    x, y = (torch.linspace(*ends, 33, dtype=torch.float64) for ends in (flat.back.x, flat.back.y))
    waves = 0.2 * torch.sin(x / 4 + 0.3)[:, None] * torch.cos(y / 5)
    return Setup(flat.with_back(replace(flat.back, heights=waves)), scene.channels(), scene.target.screen)


def test_a_moved_dome_goes_through_the_moved_points():
    """Distances in the directions of moved points, against the distances of these points: 1 % of the motion's error."""
    dome = setup_of().lens.back
    motion = Motion.of(turn=(0.3, 0.2, 0.1), shift=(0.03, -0.02, 0.02), about=(0.0, 0.0, dome.vertex_z))
    line = torch.linspace(-12.0, 12.0, 31, dtype=torch.float64)
    x, y = (p.reshape(-1) for p in torch.meshgrid(line, line, indexing="ij"))
    points = (motion.point((p, q, r + dome.z)) for p, q, r in dome.at(x, y).position.T.tolist())
    moved = torch.tensor([(p, q, r - dome.z) for p, q, r in points], dtype=torch.float64).T.contiguous()
    distance = torch.sqrt((moved * moved).sum(0))
    before, after = (float((face._below(moved)[2] - distance).abs().max()) for face in (dome, dome.carried(motion)))
    assert after < 2e-4 < 0.05 < before
    scaled = dome.scaled(1.01, 3.0).control_points() - (0.0, 0.0, 3.0)
    assert np.allclose(scaled, 1.01 * (dome.control_points() - (0.0, 0.0, 3.0)), atol=1e-12, rtol=0)


def moments(setup):
    """Means of x and y (pixels), and of their squares and product over 10, of the light on the target."""
    picture = setup.picture(129)
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in picture.shape), indexing="ij")
    return np.array([(picture * p).sum() / picture.sum() for p in (x, -y, x * x / 10, y * y / 10, -x * y / 10)])


@pytest.mark.parametrize("axis", [0, 1])
def test_a_wedge_is_a_tilt_of_the_lens_without_the_decentre_of_its_front(axis):
    """About the vertex of the back: the front, a sphere about the lamp, then only shifts, and is shifted back.

    The light does not meet the rim, which moves with the front.
    """
    source = {"kind": "point", "profile": "gaussian", "half_angle_1e2": 25.0, "position": [0.0, 0.0, CENTRE]}
    setup, angle = setup_of(source=source), 0.4
    errors = kinds(setup)
    turn = (angle, 0.0, 0.0) if axis == 0 else (0.0, angle, 0.0)
    tilted = setup.moved("lens", Motion.of(turn=turn, about=(0.0, 0.0, setup.lens.back.vertex_z)))
    across = (setup.lens.back.vertex_z - CENTRE) * np.sin(np.radians(angle)) * (1 if axis else -1)
    wanted = moments(errors[f"front.decentre_{'yx'[axis]}"].apply(tilted, across))
    found = moments(errors[f"lens.wedge_{'xy'[axis]}"].apply(setup, angle))
    assert np.linalg.norm(found - wanted) < 0.02 * min(
        np.linalg.norm(found - moments(each)) for each in (setup, tilted)
    )


def test_what_a_dome_can_have():
    """Every error of a lens but the sag of a front that is vertical at its rim; a wider cone and a larger chip too."""
    source = {"kind": "point", "profile": "lambertian", "position": [0.0, 0.0, CENTRE]}
    errors, heights = kinds(setup_of(), "PMMA"), kinds(setup_of(source=source | {"width": 1.0, "height": 0.5}), "PMMA")
    assert {"lens.thickness", "lens.index", "lens.scale", "temperature", "wavelength", "lens.clocking"} <= set(errors)
    assert "lens.front_power" not in errors and "source.size" in heights and "source.size" not in errors
    cone = kinds(setup_of(source=source | {"profile": "uniform", "half_angle": 30.0}))
    assert "source.angle" in cone


def test_a_form_error_of_a_dome_is_as_rough_at_the_rim_as_at_the_vertex():
    """Covariance exp(-(r / length)²) of 60 fields, r the chord, by mean square differences near the axis and the rim.

    The differences do not depend on the mean, which each field lacks.
    """
    lens, length = setup_of().lens, 8.0
    where = inside_outline(lens.outline, lens.back)
    fields = np.stack([random_field(lens.back, length, seed, where) for seed in range(60)])
    assert np.allclose((fields[:, where] ** 2).mean(1), 1.0) and np.allclose(fields[:, where].mean(1), 0.0)
    points = 15.0 * lens.back.directions.numpy()
    fields, ratios = np.concatenate([np.rot90(fields, k, (1, 2)) for k in range(4)]), []
    for rows in (slice(12, 21), slice(2, 6)):  # the same patch in four quarters, near the axis and at the rim
        for step in (3, 6):
            a, b = (slice(None), rows, slice(10, 17)), (slice(None), rows, slice(10 + step, 17 + step))
            chord = np.sqrt(((points[a] - points[b]) ** 2).sum(0))
            ratios.append(((fields[a] - fields[b]) ** 2).mean() / (1 - np.exp(-((chord / length) ** 2))).mean())
    assert np.allclose(ratios, np.mean(ratios), rtol=0.15)  # in the chart's own lengths: 1.8 times as large at the rim


def test_form_and_ripple_are_added_to_the_distances():
    """A form error of 1 µm RMS; tool marks of a spiral are round, also at the rim."""
    setup = setup_of()
    changed = form_error(setup.lens, 8.0, 0).apply(setup, 1e-3).lens.back
    added = (changed.heights - setup.lens.back.heights).numpy()[inside_outline(setup.lens.outline, changed)]
    assert np.sqrt((added**2).mean()) == pytest.approx(1e-3)
    marks = (ripple(setup.lens, 8.0, "spiral").apply(setup, 1e-3).lens.back.heights - setup.lens.back.heights).numpy()
    assert np.allclose(marks, marks.T) and np.allclose(marks, marks[::-1])
    arc = 15.0 * np.arccos(setup.lens.back.directions.numpy()[2])
    fit = np.polyfit(np.sin(2 * np.pi * arc / 8.0).ravel(), marks.ravel(), 1)
    assert np.allclose(np.polyval(fit, np.sin(2 * np.pi * arc / 8.0)), marks, atol=1e-9)
