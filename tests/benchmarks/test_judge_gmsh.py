"""What a program not written here finds in lens.step: gmsh, on OpenCASCADE of its own; run by `make bench`."""

from __future__ import annotations

import numpy as np
import pytest

from bstcad.cad import step_writing
from bstcad.cad.mass_properties import of_lens
from bstcad.pipeline import design
from bstcad.scene.scene import load
from tests.benchmarks.written_lenses import SMALL, TEMPLATES

pytestmark = pytest.mark.bench

EQUAL = 1e-12  # of the volume, where it is summed between the knot lines
ROUGHLY = 1e-4  # as gmsh itself sums it, over each face as one piece


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The letters' lens, a block with a plane front, and its file."""
    scene = load(TEMPLATES / "thu.toml", {**SMALL, "part.surface_profile": 0.005, "part.number": "LE-017"})
    lens, path = design(scene, device="cpu").lens, tmp_path_factory.mktemp("gmsh") / "lens.step"
    step_writing.write_lens(lens, path, scene.name, scene.part.of(scene.lens))
    return lens, path


@pytest.fixture
def gmsh():
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
    yield gmsh
    gmsh.finalize()


def under(model, face, spans, sense):
    """∫∫ z dx dy over the whole of a face, by three Gauss points a span each way of its own parameters."""
    point, weight = np.polynomial.legendre.leggauss(3)
    breaks = np.linspace(*(float(end[0]) for end in model.getParametrizationBounds(2, face)), spans + 1)
    half = np.diff(breaks)[:, None] / 2
    t, w = (breaks[:-1, None] + half * (1 + point)).ravel(), (half * weight).ravel()
    u, v = (grid.ravel() for grid in np.meshgrid(t, t, indexing="ij"))
    places = np.column_stack([u, v]).ravel()
    z = np.array(model.getValue(2, face, places)).reshape(-1, 3)[:, 2]
    tangents = np.array(model.getDerivative(2, face, places)).reshape(-1, 2, 3)
    return sense * float((np.cross(tangents[:, 0], tangents[:, 1])[:, 2] * z * (w[:, None] * w).ravel()).sum())


def test_it_opens_the_file_with_equal_volume(written, gmsh):
    lens, path = written
    gmsh.open(str(path))
    [(_, solid)], faces = gmsh.model.getEntities(3), [tag for _, tag in gmsh.model.getEntities(2)]
    assert gmsh.model.getEntityName(3, solid) == "Shapes/thu" and len(faces) == 6
    assert gmsh.model.getColor(3, solid)[:3] == (0x9E, 0xD3, 0xF5)
    stated, [back] = of_lens(lens), [face for face in faces if gmsh.model.getType(2, face) != "Plane"]
    [front] = [f for f in faces if f != back and np.ptp(np.array(gmsh.model.getBoundingBox(2, f))[[2, 5]]) < 1e-3]
    volume = under(gmsh.model, back, lens.back.m - 2, 1) - lens.front.z * gmsh.model.occ.getMass(2, front)
    rough = gmsh.model.occ.getMass(3, solid)
    centre = np.subtract(gmsh.model.occ.getCenterOfMass(3, solid), stated.centroid)
    print(
        f"\nvolume {stated.volume:.9g} mm³; gmsh's faces {volume / stated.volume - 1:+.1e}, its own sum "
        f"{rough / stated.volume - 1:+.1e}; centroid {np.abs(centre).max():.1e} mm",
        end="",
    )
    assert volume == pytest.approx(stated.volume, rel=EQUAL)
    assert rough == pytest.approx(stated.volume, rel=ROUGHLY)
    assert np.abs(centre).max() < 1e-3  # mm


def test_a_net_of_another_lens_is_seen(written, gmsh, tmp_path):
    lens, path = written
    height = f"{lens.back.control_points()[30, 30, 2]:.14f}"
    text = path.read_text()
    assert text.count(height) == 1
    (tmp_path / "other.step").write_text(text.replace(height, f"{float(height) + 1e-6:.14f}"))  # a nanometre
    gmsh.open(str(tmp_path / "other.step"))
    [back] = [tag for _, tag in gmsh.model.getEntities(2) if gmsh.model.getType(2, tag) != "Plane"]
    volume = under(gmsh.model, back, lens.back.m - 2, 1) - lens.front.z * lens.outline.area
    assert abs(volume / of_lens(lens).volume - 1) > EQUAL
