"""Files of gauges: each format is read back with the truth it was written from, and each fault is one sentence."""

import io
import os
import re
import time
import tracemalloc
import zipfile

import h5py
import numpy as np
import pytest
import x3pio
from scipy.spatial import cKDTree

from bstcad.designs import folder as folders
from bstcad.manufacture.measured import cloud as clouds
from bstcad.manufacture.measured import grid_process, hdf5_structure, made_part, point_grid
from bstcad.manufacture.measured.alignment import BackFace
from bstcad.optics.surfaces.outlines import Circle
from bstcad.optics.surfaces.surfaces import sag
from tests import suite
from tests.manufacture.measured import gauge_files
from tests.manufacture.measured.gauge_files import BY_SURFACE_TOPOGRAPHY, WRITERS, grid_points
from tests.manufacture.measured.synthetic import with_form_error

PITCH = 0.1  # mm; a map of the small lens of 8 mm x 6 mm then has 81 x 61 points, nearly 5 000
ROUND = Circle(4.0)
MAPS = ("x3p", "sdf", "text.sdf", *BY_SURFACE_TOPOGRAPHY)


@pytest.fixture(scope="module")
def lens(small_design):
    """The small lens with a relief that has no symmetry: its own light is a disc."""
    return with_form_error(folders.read_nominal(small_design.folder).lens, 0.01, 1.0)


@pytest.fixture(scope="module")
def heights(lens):
    """Heights (rows y, columns x) of the back, mm."""
    x, y = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(-3, 3, 61))
    return sag(lens.back, x.ravel(), y.ravel()).reshape(x.shape)


def with_gaps(heights):
    return np.where(np.random.default_rng(1).random(heights.shape) < 0.3, np.nan, heights)


# A fault of a file: the height map with it, its pitch / PITCH, the checks that fail, and words of the sentence.
FAULTS = {
    "none": (lambda heights: heights, 1, [], ""),
    "30 % missing": (with_gaps, 1, [], ""),
    "mirrored": (lambda heights: heights[::-1], 1, ["made-axes"], "y is -y"),
    "turned by 90 degrees": (lambda heights: np.rot90(heights), 1, [], ""),
    "mm as metres": (lambda heights: 1e3 * heights, 1e3, None, "its points seem to be in micrometres"),
    "mm as inches": (lambda heights: heights / 25.4, 1 / 25.4, ["made-unit"], "inches"),
}


@pytest.fixture(autouse=True)
def reader(monkeypatch):
    """The reader of height maps, which this process calls itself: a child for each damaged file would take minutes."""
    limited = grid_process.read_limited
    monkeypatch.setattr(grid_process, "read_limited", point_grid.read_grid)
    return limited


def written(form, *given):
    """The bytes of a file; the test is skipped without the package that reads its format."""
    if form in BY_SURFACE_TOPOGRAPHY:
        pytest.importorskip("SurfaceTopography")
    return WRITERS[form](*given)


def loaded(folder, form, data, outline=ROUND):
    path = folder / f"cloud.{form}"
    path.write_bytes(data)
    return clouds.load(path, outline)


@pytest.mark.parametrize("fault", suite.in_turns(FAULTS, 3))
@pytest.mark.parametrize("form", WRITERS)
def test_a_file_is_read_back_with_its_truth(tmp_path, lens, heights, form, fault):
    """A cloud that reads as the truth has the truth's checks, which the next test names."""
    change, scale, checks, words = FAULTS[fault]
    truth, pitch = change(heights), scale * PITCH
    data = written(form, truth, pitch)
    if checks is None:
        with pytest.raises(ValueError, match=words) as error:
            loaded(tmp_path, form, data, lens.outline)
        assert "\n" not in str(error.value)
        return
    found, known = loaded(tmp_path, form, data, lens.outline), grid_points(truth, pitch)
    measured = known[~np.isnan(known[:, 2])]
    assert found.unit == ("inches" if "made-unit" in checks else "mm")
    assert len(found.points) == len(measured) and found.without_data == np.isnan(truth).sum() * (
        3 if form == "stl" else 1
    )
    mm = 25.4 if found.unit == "inches" else 1.0
    distance, which = cKDTree(measured * mm).query(found.points)
    assert distance.max() < 3e-6 * mm and len(set(which)) == len(measured)  # half a step of float32 at 25 mm is 1e-6 mm


@pytest.mark.parametrize(
    "fault", suite.in_turns([fault for fault, (*_, checks, _) in FAULTS.items() if checks is not None], 2)
)
def test_a_fault_of_a_height_map_is_said(tmp_path, lens, heights, fault):
    change, scale, checks, words = FAULTS[fault]
    coarse = change(heights[::2, ::2])
    found = loaded(tmp_path, "x3p", WRITERS["x3p"](coarse, 2 * scale * PITCH), lens.outline)
    made = made_part.aligned(found, BackFace.of(lens), 0.01).checks
    failed = {check.id: check.where for check in made if not check.passed}
    assert list(failed) == checks and words in "".join(failed.values())


# ---- origin, unit and kind ------------------------------------------------------------------------------------------


def map_of(count=20):
    return np.random.default_rng(2).normal(0, 0.1, (count, count))


def test_a_stated_origin_is_kept_and_a_point_cloud_is_read(tmp_path):
    """Without an origin, the middle of the map is zero."""
    heights, stream = map_of(), io.BytesIO()
    place = x3pio.Placement.translation(1e-3, -2e-3, 5e-3)
    options = {"placement": place, "coordinate_system": x3pio.CoordinateSystem.VIEW}
    x3pio.write(stream, 1e-3 * heights, x_scale=3e-4, y_scale=4e-4, **options)
    found = loaded(tmp_path, "x3p", stream.getvalue()).points
    assert found[0] == pytest.approx([1.0, -2.0, 5.0 + heights[0, 0]])
    assert found[-1] == pytest.approx([1.0 + 19 * 0.3, -2.0 + 19 * 0.4, 5.0 + heights[-1, -1]])
    stream = io.BytesIO()
    x3pio.write_points(stream, 1e-3 * found)
    assert loaded(tmp_path, "x3p", stream.getvalue()).points == pytest.approx(found)
    middle = loaded(tmp_path, "sdf", WRITERS["sdf"](heights, 0.3))
    assert middle.points[:, :2].min(0) == pytest.approx([-2.85, -2.85]) == -middle.points[:, :2].max(0)
    assert middle.columns == "map of 20 x 20 points, 0.3 mm x 0.3 mm apart"


def test_the_format_is_known_by_the_contents(tmp_path):
    heights = map_of()
    for form in ("x3p", "sdf", "text.sdf"):
        assert len(loaded(tmp_path, "csv", WRITERS[form](heights, 0.3)).points) == 400
    for ending in point_grid.ENDINGS:
        with pytest.raises(
            ValueError, match=f"its name ends in {ending}, but it begins like none of the formats X3P, SD"
        ):
            loaded(tmp_path, ending[1:], b"1,2,3\n" * 200)


def test_a_missing_package_is_named_with_its_command(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "SurfaceTopography.IO", None)
    for form in ("opd", "sur", "opdx"):
        with pytest.raises(ValueError, match=r"pip install 'bstcad\[metrology\]'") as error:
            loaded(tmp_path, form, WRITERS[form](map_of(), 0.3))
        assert "SurfaceTopography" in str(error.value) and "\n" not in str(error.value)


# ---- damaged files ---------------------------------------------------------------------------------------------------


def claimed(form):
    """A small file whose header declares about 10^9 points."""
    heights, n = map_of(), 31_623
    if form == "datx":
        return gauge_files.datx(heights, 0.3, (n, n))
    data = WRITERS[form](heights, 0.3)
    if form == "x3p":
        stream = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as given, zipfile.ZipFile(stream, "w") as archive:
            for name in given.namelist():
                content = given.read(name)
                archive.writestr(name, content if name != "main.xml" else enlarged(content, n))
        return stream.getvalue()
    count, large = (20).to_bytes(4, "little"), n.to_bytes(4, "little")
    if form == "sdf":
        return data.replace(count * 2, large * 2, 1)
    if form == "text.sdf":
        return data.replace(b"= 20", f"= {n}".encode())
    if form == "opd":
        return data.replace((20).to_bytes(2, "little") * 2, n.to_bytes(2, "little") * 2, 1)
    if form == "sur":
        return data.replace(count * 2 + (400).to_bytes(4, "little"), large * 2 + (n * n).to_bytes(4, "little"), 1)
    return data.replace(count, large)


def enlarged(main, n):
    for axis in (b"X", b"Y"):
        main = main.replace(b"<Size" + axis + b">20<", b"<Size" + axis + b">%d<" % n)
    return main


def one_sentence(folder, form, data):
    """The error of a file, without a huge memory; None if it is read."""
    tracemalloc.start()
    try:
        loaded(folder, form, data)
        return None
    except ValueError as error:
        assert "\n" not in str(error) and len(str(error)) < 600
        return str(error)
    finally:
        assert tracemalloc.get_traced_memory()[1] < 2e7
        tracemalloc.stop()


@pytest.mark.parametrize("form", MAPS)
def test_a_damaged_file_is_one_sentence_without_a_huge_memory(tmp_path, form):
    heights, random = map_of(), np.random.default_rng(3)
    data = written(form, heights, 0.3)
    assert one_sentence(tmp_path, form, data) is None  # imports the packages, too
    assert claimed(form) != data
    assert "export" in one_sentence(tmp_path, form, claimed(form))
    for share in (0.01, 0.3, 0.9):
        assert one_sentence(tmp_path, form, data[: int(share * len(data))])
    for _ in range(20):
        spoilt = bytearray(data)
        spoilt[random.integers(len(data))] ^= int(random.integers(1, 256))
        one_sentence(tmp_path, form, bytes(spoilt))


def test_a_profile_a_layer_too_many_and_a_bomb_are_refused(tmp_path):
    stream = io.BytesIO()
    x3pio.write(stream, np.zeros(500), x_scale=1e-5)
    assert "has a profile of 500 points; measure the area" in one_sentence(tmp_path, "x3p", stream.getvalue())
    stream = io.BytesIO()
    x3pio.write(stream, np.zeros((2, 20, 20)), x_scale=1e-4, y_scale=1e-4)
    assert "has 2 layers; export only the layer" in one_sentence(tmp_path, "x3p", stream.getvalue())
    assert "has a profile of 400 points" in one_sentence(tmp_path, "sdf", WRITERS["sdf"](map_of().reshape(1, 400), 0.3))
    bomb = bytearray(WRITERS["x3p"](map_of(), 0.3))
    entry = bomb.index(b"PK\x01\x02")  # of main.xml in the directory of the archive
    bomb[entry + 24 : entry + 28] = (4 * 10**9).to_bytes(4, "little")
    assert "bytes after decompression, and 1000000000 are possible" in one_sentence(tmp_path, "x3p", bytes(bomb))


def with_xml(change):
    """An X3P file whose main.xml is changed."""
    stream, data = io.BytesIO(), WRITERS["x3p"](map_of(), 0.3)
    with (
        zipfile.ZipFile(io.BytesIO(data)) as given,
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name in given.namelist():
            content = given.read(name)
            archive.writestr(name, change(content) if name == "main.xml" else content)
    return stream.getvalue()


@suite.in_turn(0, 2)
def test_xml_without_bounds_is_refused_before_it_is_read(tmp_path):
    """40 MB of elements took a minute and 1 GB; here are 10.4 MB, just above the limit."""
    begun = time.perf_counter()
    outside = with_xml(lambda xml: xml.replace(b"</Record2>", b"<a/>" * 2_600_000 + b"</Record2>"))
    assert "has more than 10000000 bytes of XML besides its points" in one_sentence(tmp_path, "x3p", outside)
    within = with_xml(
        lambda xml: xml.replace(b"<DataLink>", b"<DataList>" + b"<D/>" * 2_000_001 + b"</DataList><DataLink>")
    )
    assert "lists more than 2000000 values as XML; export them in binary" in one_sentence(tmp_path, "x3p", within)
    assert time.perf_counter() - begun < 60
    declared = b'<!DOCTYPE a [<!ENTITY b "c">]><p:ISO'
    bomb = with_xml(lambda xml: xml.replace(b"<p:ISO", declared, 1))
    assert "declares entities in its main.xml" in one_sentence(tmp_path, "x3p", bomb)


def test_a_list_of_data_may_be_longer_than_other_xml(tmp_path, monkeypatch):
    """The bytes of the list do not count among those of other XML."""
    heights, stream = map_of(40), io.BytesIO()
    x3pio.Surface.from_array(1e-3 * heights, x_scale=1e-4, y_scale=1e-4).save(stream, storage=x3pio.DataStorage.XML)
    monkeypatch.setattr(point_grid, "MAX_XML_SIZE", 8_000)
    monkeypatch.setattr(point_grid, "XML_BLOCK", 500)
    found = loaded(tmp_path, "x3p", stream.getvalue())
    assert found.points[:, 2] == pytest.approx(heights.ravel())
    monkeypatch.setattr(point_grid, "MAX_XML_SIZE", 800)
    assert "has more than 800 bytes of XML" in one_sentence(tmp_path, "x3p", stream.getvalue())


# ---- limits of the child process -------------------------------------------------------------------------------------

READERS = {  # reader of a child, and words of the sentence
    "sleep(60)": "was not read within 1 s",
    "abort()": "ended the process that reads X3P files (ended by SIGABRT)",
    "_exit(3)": "ended the process that reads X3P files (exit code 3)",
    "bytes(grid_process.MAX_READER_MEMORY)": "needs more than 8 GB of memory",
    "1 / 0": "ended the process that reads X3P files (exit code 1)",
}


@pytest.mark.parametrize("statement", READERS)
def test_a_reader_without_bounds_ends_in_a_sentence(tmp_path, monkeypatch, reader, statement):
    """The child runs a module that puts another function in the place of the reader."""
    (tmp_path / "hostile_reader.py").write_text(
        "from os import _exit, abort\nfrom time import sleep\n"
        "from bstcad.manufacture.measured import grid_process, point_grid\n"
        f"point_grid.read_grid = lambda data, name: {statement}\ngrid_process.main()\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(grid_process, "MODULE", "hostile_reader")
    if "sleep" in statement:
        monkeypatch.setattr(grid_process, "MAX_READER_TIME", 1.0)
    with pytest.raises(ValueError, match=re.escape(READERS[statement])) as error:
        reader(WRITERS["x3p"](map_of(), 0.3), "X3P")
    assert "; export the file again" in str(error.value) and "\n" not in str(error.value)


def test_the_child_gives_the_points_and_the_sentence_of_the_reader(tmp_path, reader):
    heights = with_gaps(map_of())
    data = WRITERS["x3p"](heights, 0.3)
    found, known = reader(data, "X3P"), point_grid.read_grid(data, "X3P")
    assert np.array_equal(found.positions, known.positions)
    assert (found.without_data, found.columns) == (np.isnan(heights).sum(), known.columns)
    with pytest.raises(ValueError) as error:
        reader(data[:300], "X3P")
    with pytest.raises(ValueError, match=re.escape(str(error.value))):
        point_grid.read_grid(data[:300], "X3P")


# ---- structures of HDF5 that a height map does not need -------------------------------------------------------------

SURFACE = "/Measurement/Surface"
ROW = [("Source", "S64"), ("Link", "S64"), ("Destination", "S64")]


def replaced(make):
    """A change of an HDF5 file that makes its surface anew, by `make`."""

    def change(file, folder):
        del file[SURFACE]
        make(file, folder)

    return change


def external(file, folder):
    (folder / "secret").write_bytes(bytes(8 * 400))
    file.create_dataset(SURFACE, (20, 20), "f8", external=[(str(folder / "secret"), 0, 8 * 400)])


def pipe(file, folder):
    os.mkfifo(folder / "pipe")
    file.create_dataset(SURFACE, (20, 20), "f8", external=[(str(folder / "pipe"), 0, 8 * 400)])


def virtual(file, folder):
    layout = h5py.VirtualLayout((20, 20), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "heights", (20, 20))
    file.create_virtual_dataset(SURFACE, layout)


def huge_chunks(file, folder):
    file.create_dataset(SURFACE, (20_000, 20_000), "f8", chunks=(20_000, 20_000))


def plugin(file, folder):
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((20, 20))
    properties.set_filter(32_015, h5py.h5z.FLAG_OPTIONAL)  # Zstandard, which HDF5 loads from a folder of plugins
    space = h5py.h5s.create_simple((20, 20))
    h5py.h5d.create(file.id, SURFACE.encode(), h5py.h5t.NATIVE_DOUBLE, space, properties)


def linked(make):
    def link(file, folder):
        file[SURFACE] = make(h5py, folder)

    return link


def described(*rows, shape=None):
    """A change of the table of metadata."""

    def change(file, folder):
        del file["MetaData"]
        if shape:
            file.create_dataset("MetaData", shape, ROW, chunks=(64,))
        else:
            file["MetaData"] = np.array([*rows], dtype=ROW)

    return change


def attribute(file, folder):
    file.create_group("notes").attrs.create("note", np.zeros(2_000_000), dtype="f8")


def many_links(file, folder):
    group = file.create_group("many")
    for index in range(10_001):
        group[f"{index}"] = file[SURFACE]


DOUBLING = [(b"Root", b"a", b"{0}"), *(
    (b"{%d}" % index, key, b"{%d}" % (index + 1)) for index in range(40) for key in (b"a", b"b")
)]  # fmt: skip
CIRCLE = [(b"Root", b"a", b"{0}"), (b"{0}", b"a", b"{0}")]
HOSTILE = {  # change of a readable file, and words of the sentence
    "external storage": (replaced(external), "whose data are in another place or file"),
    "a pipe": (replaced(pipe), "whose data are in another place or file"),
    "a virtual dataset": (replaced(virtual), "whose data are in another place or file"),
    "a soft link": (replaced(linked(lambda h5py, _: h5py.SoftLink("/elsewhere"))), "contains the link 'Surface'"),
    "an external link": (
        replaced(linked(lambda h5py, folder: h5py.ExternalLink(str(folder / "other.h5"), "/heights"))),
        "contains the link 'Surface' to another place or file",
    ),
    "huge chunks": (replaced(huge_chunks), "in chunks of 3200000000 bytes, and 160000000 are possible"),
    "a plugin": (replaced(plugin), "which needs the plugin 32015 of HDF5"),
    "many rows": (described(shape=(10**12,)), "declares 1000000000000 rows of metadata"),
    "doubling references": (described(*DOUBLING), "has metadata of more than 10000 entries"),
    "references in a circle": (described(*CIRCLE), "has metadata of more than 10000 entries"),
    "a huge attribute": (attribute, "declares 16000000 bytes in its attribute 'note', and 10000000 are possible"),
    "many links": (many_links, "contains more than 10000 links"),
}


@pytest.mark.parametrize("change", HOSTILE)
def test_an_hdf5_file_with_more_than_a_height_map_is_refused_before_it_is_read(tmp_path, monkeypatch, change):
    """The structure is checked by h5py alone; HDF5 would open the other file, wait for the pipe, or fill the memory."""
    opened = []
    monkeypatch.setattr(point_grid, "_surface_topography", lambda name: lambda *given, **more: opened.append(given))
    stream = io.BytesIO(gauge_files.datx(map_of(), 0.3))
    hdf5_structure.check_structure(stream.getvalue())
    make, words = HOSTILE[change]
    with h5py.File(stream, "r+", libver="latest") as file:
        make(file, tmp_path)
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        point_grid.read_grid(stream.getvalue(), "DATX")
    assert "; export the file again" in str(error.value) and "\n" not in str(error.value) and not opened


def test_other_files_are_no_height_maps():
    assert point_grid.grid_format(b"x,y,z") == "" and point_grid.grid_format(b"") == ""
    assert {name for *_, name in point_grid.FORMATS} == {"X3P", "SDF", "DATX", "OPDx", "OPD", "SUR"}
