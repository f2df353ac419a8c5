"""STL at full size, as fine as 0.1 µm: run by `make bench`; figures are printed, seconds not asserted."""

import time

import pytest

from bstcad import folder as folders
from bstcad.cad import mesh
from tests.benchmarks.cold import generate
from tests.cad.facets import deviation

pytestmark = pytest.mark.bench
PLACES = 20_000_000


@pytest.mark.parametrize("name", ["thu", "portrait", "mirror", "caustic_portrait"])
def test_facets_lie_as_near_as_asked(name, tmp_path):
    generate(name, tmp_path / name, "tailoring.quality=draft").report()
    lens = folders.read_nominal(tmp_path / name)[1].lens
    for asked in (1e-2, 1e-3, 1e-4):  # mm
        began = time.perf_counter()
        cells, made = mesh.fitting(lens, asked, mesh.ASKED)
        mesh.write_stl(made, path := tmp_path / "lens.stl")
        seconds = time.perf_counter() - began
        again = mesh.read_stl(path)
        found = deviation(again, lens, PLACES)
        print(
            f"\n{name}, {1e3 * asked:g} µm asked: {1e3 * found:.4f} µm, {cells} cells a side, "
            f"{len(made.faces) / 1e6:.2f} M triangles, {path.stat().st_size / 1e6:.0f} MB, {seconds:.1f} s"
        )
        assert found <= asked and mesh.is_closed(again)
