"""Read height maps of gauges: X3P (ISO 25178-72), SDF (ISO 25178-71), and Zygo DATX, Wyko OPD, Dektak OPDx and SUR.

A height map has columns along x, rows along y and a height z over each point, seen from outside the glass: x to the
right, y up, z towards the instrument.  The packages that read the files give lengths in metres or state their unit.
Points without a height are left out and counted.  If a file states no origin, x and y are zero in the middle of the
map.  The number of points that a header declares is compared with the size of the file before memory is allocated.

The format is recognised by the first bytes of a file, so that its name does not matter.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from typing import IO, Any
from xml.parsers import expat

import numpy as np
import x3pio

from bstcad.manufacture.measured.hdf5_structure import check_structure
from bstcad.manufacture.measured.point_text import UNITS_IN_MM, MeasuredPoints, NotAMap, make_points

MAX_MAP_POINTS = 20_000_000  # largest number of points of a height map, for which 1 GB of memory is enough
MAX_UNPACKED_SIZE = 1_000_000_000  # largest size (bytes) of the unpacked contents of a zip archive
MAX_XML_SIZE = 10_000_000  # largest size (bytes) of the XML of an X3P file outside its list of data, as it is text
MAX_XML_POINTS = 2_000_000  # largest number of elements of that list, each of which takes 96 bytes and 2 µs twice
BYTES_PER_XML_POINT = 100  # largest mean size (bytes) of an element of that list
XML_BLOCK = 1 << 16  # number of bytes of XML that are parsed at a time
METRE = 1e3  # length of a metre (mm)
FORMATS = (  # (offset of the first bytes that identify a format, these bytes, its name in sentences)
    (0, b"PK\x03\x04", "X3P"),
    *((0, first + family, "SDF") for first in (b"a", b"b", b"A", b"B") for family in (b"ISO-", b"BCR-")),
    (0, b"\x89HDF\r\n\x1a\n", "DATX"),
    (0, b"VCA DATA", "OPDx"),
    (2, b"Directory", "OPD"),
    (0, b"DIGITAL SURF", "SUR"),
)
# Names of the formats in SurfaceTopography, which reads them.
BY_SURFACE_TOPOGRAPHY = {"DATX": "datx", "OPDx": "opdx", "OPD": "opd", "SUR": "sur"}
ENDINGS = (".x3p", ".sdf", ".datx", ".opdx", ".opd", ".sur")  # endings of the names of such files, in lower case
EXPORT_HINT = "export the file again, or give x, y and z as text"


def grid_format(data: bytes) -> str:
    """Return the name of a height map's format by the first bytes of the file; "" if it is none of FORMATS."""
    return next((name for offset, first, name in FORMATS if data.startswith(first, offset)), "")


def read_grid(data: bytes, name: str) -> MeasuredPoints:
    """Return the points of a height map of the format `name`, mm; raise ValueError, with a sentence, for others."""
    read: Callable[[bytes], MeasuredPoints]
    if name in BY_SURFACE_TOPOGRAPHY:
        open_topography = _surface_topography(name)

        def read(data: bytes) -> MeasuredPoints:
            return _read_topography(data, name, open_topography)
    else:
        read = {"X3P": _read_x3p, "SDF": _read_sdf}[name]
    try:
        return read(data)
    except NotAMap as error:
        raise ValueError(str(error)) from None
    except MemoryError:  # the limit of memory is set and explained by grid_process.py
        raise
    except Exception as error:  # readers of damaged files raise errors of any kind
        reason = " ".join(str(error).split())[:120].rstrip(".") or type(error).__name__
        raise ValueError(f"is not a readable {name} file ({reason}); {EXPORT_HINT}") from None


def _check_count(shape: tuple[int, ...], size: int | None = None) -> None:
    """Raise NotAMap for a shape with too many points, or with more points than an uncompressed file has bytes."""
    count = math.prod(shape)
    if size is not None and count > size:
        raise NotAMap(f"its header declares {count} points, but the file has {size} bytes; {EXPORT_HINT}")
    if count > MAX_MAP_POINTS:
        most = f"{MAX_MAP_POINTS} are possible"
        raise NotAMap(f"its header declares {count} points, and {most}; export every second point")


def _map_points(heights: np.ndarray, x_pitch: float, y_pitch: float) -> MeasuredPoints:
    """Return the points of heights (rows y, columns x), all in mm, with x = y = 0 in the middle."""
    rows, columns = heights.shape
    if min(rows, columns) < 2:
        raise NotAMap(f"has a profile of {heights.size} points; measure the area of the back face")
    if not (0 < x_pitch < math.inf and 0 < y_pitch < math.inf):
        raise NotAMap(f"states the pitches {x_pitch:g} mm in x and {y_pitch:g} mm in y; calibrate, and export again")
    x = (np.arange(columns) - (columns - 1) / 2) * x_pitch
    y = (np.arange(rows) - (rows - 1) / 2) * y_pitch
    positions = np.empty((rows, columns, 3))
    positions[..., 0], positions[..., 1], positions[..., 2] = x, y[:, None], heights
    return _measured(positions, f"map of {columns} x {rows} points, {x_pitch:.4g} mm x {y_pitch:.4g} mm apart")


def _measured(positions: np.ndarray, words: str) -> MeasuredPoints:
    """Return the measured ones among positions (..., 3); words: description of the map for the report."""
    positions = positions.reshape(-1, 3)
    positions[~np.isfinite(positions).all(axis=1)] = np.nan
    return make_points(positions, columns=words)


# ---- X3P and SDF -----------------------------------------------------------------------------------------------------


def _read_x3p(data: bytes) -> MeasuredPoints:
    """Read a surface or point cloud; the checksum of each part in the archive is verified, the MD5 of main.xml is not.

    Some writers state a wrong MD5.  Coordinates are those of the global system, if the file states where it is.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
        if unpacked > MAX_UNPACKED_SIZE:
            raise NotAMap(f"has {unpacked} bytes after decompression, and {MAX_UNPACKED_SIZE} are possible")
        for part in archive.infolist():
            if part.filename.endswith("main.xml"):
                with archive.open(part) as main:
                    _check_xml(main)
    info = x3pio.info(io.BytesIO(data), verify=False)
    _check_count(info.shape)
    if info.layer_count != 1:
        raise NotAMap(f"has {info.layer_count} layers; export only the layer of the back face")
    if info.feature_type is x3pio.FeatureType.PROFILE:
        raise NotAMap(f"has a profile of {math.prod(info.shape)} points; measure the area of the back face")
    file = x3pio.X3pFile.loads(data, verify=False)
    layer: Any = file.layers[0]  # layer of a surface or a point cloud
    states_origin = not file.placement.is_identity or layer.x is not None or layer.y is not None
    if states_origin:
        points = layer.points(coordinate_system=x3pio.CoordinateSystem.GLOBAL)
        return _measured(METRE * points, f"{points.size // 3} points in the coordinates of the file")
    x_pitch, y_pitch = layer.spacing
    return _map_points(METRE * layer.z, METRE * x_pitch, METRE * y_pitch)


def _check_xml(file: IO[bytes]) -> None:
    """Raise NotAMap if main.xml, which x3pio reads into memory as a whole, is too large or declares entities.

    It is parsed in blocks, without a tree, up to the first excess.
    """
    parser, within, elements, listed = (
        expat.ParserCreate(),
        False,
        0,
        0,
    )  # listed: bytes in lists of data; ends add, starts subtract

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal within, elements, listed
        elements += within * (1 + len(attributes))
        if name.rpartition(":")[2] == "DataList" and not within:
            within, listed = True, listed - parser.CurrentByteIndex

    def end(name: str) -> None:
        nonlocal within, listed
        if name.rpartition(":")[2] == "DataList" and within:
            within, listed = False, listed + parser.CurrentByteIndex

    def refuse(*declaration: object) -> None:
        raise NotAMap(f"declares entities in its main.xml; {EXPORT_HINT}")

    parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = begin, end, refuse
    while block := file.read(XML_BLOCK):
        parser.Parse(block)
        outside = -listed if within else parser.CurrentByteIndex - listed
        if outside > MAX_XML_SIZE:
            raise NotAMap(f"has more than {MAX_XML_SIZE} bytes of XML besides its points; {EXPORT_HINT}")
        if elements > MAX_XML_POINTS or parser.CurrentByteIndex > MAX_XML_SIZE + BYTES_PER_XML_POINT * MAX_XML_POINTS:
            raise NotAMap(f"lists more than {MAX_XML_POINTS} values as XML; export them in binary form")


def _read_sdf(data: bytes) -> MeasuredPoints:
    """Read a surface; x and y are multiples of the pitches in the header."""
    import sdfio  # takes 0.1 s to load

    file = sdfio.SdfFile.loads(data)  # compares the declared number of points with the data first
    _check_count(file.data.shape)
    return _map_points(METRE * file.data, METRE * file.header.x_scale, METRE * file.header.y_scale)


# ---- formats that SurfaceTopography reads ----------------------------------------------------------------------------


def _surface_topography(name: str) -> Callable[..., Any]:
    """Return the function of SurfaceTopography that opens a file; ValueError if the package is not installed."""
    try:
        from SurfaceTopography.IO import open_topography
    except ImportError as error:
        package = (error.name or "SurfaceTopography").partition(".")[0]
        raise ValueError(
            f"has the format {name}, and the package {package}, which reads it, is not installed; "
            "install it by pip install 'bstcad[metrology]', or give x, y and z as text"
        ) from None
    return open_topography  # type: ignore[no-any-return]


def _read_topography(data: bytes, name: str, open_topography: Callable[..., Any]) -> MeasuredPoints:
    """Read the first channel of heights; SurfaceTopography gives heights (columns x, rows y)."""
    if name == "DATX":
        check_structure(data)
    with open_topography(io.BytesIO(data), format=BY_SURFACE_TOPOGRAPHY[name]) as file:
        channel = file.default_channel
        if channel.dim != 2:
            raise NotAMap(f"has a profile of {math.prod(channel.nb_grid_pts)} points; measure the area of the face")
        _check_count(tuple(channel.nb_grid_pts), None if name == "DATX" else len(data))
        if channel.physical_sizes is None:
            raise NotAMap("states no pitch of its points in x and y; calibrate the lateral scale, and export again")
        if channel.unit not in UNITS_IN_MM:
            raise NotAMap(f"states its lengths in {channel.unit}; export it with lengths in mm or \u00b5m")
        topography = channel.topography()
    size = UNITS_IN_MM[channel.unit]
    heights = np.ma.filled(np.ma.asarray(topography.heights()).astype(np.float64), np.nan).T
    (rows, columns), (width, height) = heights.shape, channel.physical_sizes
    return _map_points(size * heights, size * width / columns, size * height / rows)
