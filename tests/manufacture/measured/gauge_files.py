"""Files of gauges, written after the published formats: a height map in mm (rows y upwards, columns x) and its pitch.

Heights that are NaN were not measured.
"""

import io
import struct

import numpy as np
import sdfio
import x3pio


def grid_points(heights, pitch):
    """Points (rows x columns, 3) of a height map with x = y = 0 in its middle, NaN where it was not measured."""
    rows, columns = heights.shape
    y, x = np.meshgrid(*(pitch * (np.arange(n) - (n - 1) / 2) for n in (rows, columns)), indexing="ij")
    return np.stack([x, y, heights], axis=-1).reshape(-1, 3)


def csv(heights, pitch):
    found = grid_points(heights, pitch)
    return "\n".join(["x,y,z", *(",".join(f"{value:.9g}" for value in row) for row in found)]).encode()


def zygo(heights, pitch):
    header = ["Zygo XYZ Data File - Format 1", '0 8 1 5 "Mon"', "0 0 9 9 1 255", "0 0 9 9", '""', '""', '""']
    header += [f"0 0.5 6.328e-07 0 1 0 {1e-3 * pitch:.9g} 1500000000", "640 480 0 0 0 0", "#"]
    rows = [
        f"{x} {y} " + ("No Data" if np.isnan(height) else f"{1e3 * height:.7f}")
        for y, row in enumerate(heights[::-1])
        for x, height in enumerate(row)
    ]
    return "\n".join([*header, *rows, "#"]).encode()


def ply(heights, pitch):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {heights.size}\n"
    head += "property double x\nproperty double y\nproperty double z\nend_header\n"
    return head.encode() + grid_points(heights, pitch).astype("<f8").tobytes()


def stl(heights, pitch):
    """Each point as a triangle without an area: its corners are the point."""
    triangles = np.zeros(heights.size, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]))
    triangles["corners"] = grid_points(heights, pitch)[:, None]
    return bytes(80) + struct.pack("<I", heights.size) + triangles.tobytes()


def x3p(heights, pitch):
    stream = io.BytesIO()
    x3pio.write(stream, 1e-3 * heights, x_scale=1e-3 * pitch, y_scale=1e-3 * pitch)
    return stream.getvalue()


def sdf(heights, pitch, form=sdfio.FileFormat.BINARY):
    stream = io.BytesIO()
    sdfio.write(stream, 1e-3 * heights, x_scale=1e-3 * pitch, y_scale=1e-3 * pitch, format=form)
    return stream.getvalue()


def sdf_text(heights, pitch):
    return sdf(heights, pitch, sdfio.FileFormat.ASCII)


def opd(heights, pitch):
    """Blocks of Wyko's Vision: heights in wavelengths (nm) as float32, columns first, rows from the top."""
    raster = np.where(np.isnan(heights), 3e38, heights / 632.8e-6).astype("<f4")
    blocks = [
        ("RAW_DATA", 3, struct.pack("<3H", *heights.T.shape, 4) + np.ascontiguousarray(raster[::-1].T).tobytes()),
        ("Wavelength", 7, struct.pack("<f", 632.8)),
        ("Mult", 6, struct.pack("<h", 1)),
        ("Aspect", 7, struct.pack("<f", 1.0)),
        ("Pixel_size", 7, struct.pack("<f", pitch)),
    ]
    entries = [("Directory", 1, bytes(24 * (len(blocks) + 1))), *blocks]
    head = b"".join(struct.pack("<16shlH", name.encode(), kind, len(data), 1) for name, kind, data in entries)
    return b"\x01\x00" + head + b"".join(data for _, _, data in blocks)


def sur(heights, pitch):
    """Header of 512 bytes of Digital Surf, then int32 multiples of a step; the smallest value minus 2 is no data."""
    step = float(np.float32(np.nanmax(np.abs(heights)) / 2e9))
    values = np.round(np.where(np.isnan(heights), np.nanmin(heights), heights) / step).astype("<i4")
    low, high = values.min(), values.max()
    values[np.isnan(heights)] = low - 2
    head = struct.pack("<12sHHHH30s30sHHHHH8x", b"DIGITAL SURF", 0, 1, 1, 2, b"map", b"gauge", 0, 0, 0, 1, 0)
    head += struct.pack("<HiiiiIfff", 32, low, high, *heights.T.shape, heights.size, pitch, pitch, step)
    head += struct.pack("<16s16s16s", b"X", b"Y", b"Z") + struct.pack("<16s", b"mm") * 6
    head += struct.pack(
        "<3f3H12x7Hf10xHH128s3f34x", 1, 1, 1, 0, 0, 0, *(0, 0, 12, 1, 1, 2031, 1), 0.0, 0, 0, b"", 0, 0, 0
    )
    return head + values.tobytes()


def opdx(heights, pitch):
    """Nested items of Bruker's Vision64: name, type and contents."""

    def text(words):
        return struct.pack("<I", len(words)) + words.encode()

    def long(data):
        return b"\x04" + struct.pack("<I", len(data)) + data

    def item(name, kind, data):
        return text(name) + bytes([kind]) + data

    def box(name, *items):
        return item(name, 0x7D, long(b"".join(items) + item("", 0x7F, b"") + b"\xff\xff"))

    def quantity(name, value):
        return item(name, 0x13, long(struct.pack("<d", value) + text("Millimeter") + text("mm")))

    rows, columns = heights.shape
    matrix = struct.pack("<2I", rows, columns) + heights.astype("<f4").tobytes()
    channel = box(
        "Raw",
        item("Matrix", 0x00, text("Matrix") + struct.pack("<I", 0) + text("float") + long(matrix)),
        item("Dimension1Points", 0x07, struct.pack("<I", rows)),
        item("Dimension2Points", 0x07, struct.pack("<I", columns)),
        quantity("Dimension1Extent", pitch * (rows - 1)),
        quantity("Dimension2Extent", pitch * (columns - 1)),
        quantity("DataScale", 1.0),
        item("DataKind", 0x12, long(b"Height")),
    )
    names = box("2D_Channels", item("Height", 0x42, text("List") + long(text("Raw"))))
    meta = box("MetaData", item("DataKind", 0x12, long(b"Surface Height")), names)
    return b"VCA DATA\x01\x00\x00\x55" + box("2D_Data", channel) + meta + item("", 0x7F, b"")


def datx(heights, pitch, shape=None):
    """A surface of Zygo's Mx in HDF5; shape: (rows, columns) that are declared without data, None: the heights."""
    import h5py

    stream, path = io.BytesIO(), b"/Measurement/Surface"
    with h5py.File(stream, "w") as file:
        entries = [(b"Root", b"Measurement", b"{1}"), (b"{1}", b"Surface", b"{2}"), (b"{2}", b"Path", path)]
        file["MetaData"] = np.array(entries, dtype=[("Source", "S64"), ("Link", "S64"), ("Destination", "S64")])
        if shape is None:
            data = file.create_dataset(path, data=np.where(np.isnan(heights), 1e30, 1e6 * heights))
        else:
            data = file.create_dataset(path, shape, "f8", chunks=(64, 64))
        kind = np.dtype([("Category", h5py.string_dtype()), ("Unit", h5py.string_dtype()), ("Parameters", "f8", 4)])
        data.attrs["No Data"], data.attrs["Unit"] = (
            np.array([1e30]),
            np.array(["NanoMeters"], dtype=h5py.string_dtype()),
        )
        for axis in "XY":
            converter = [(b"LateralCat", b"Pixels", (0.0, 1e-3 * pitch, 0.0, 0.0))]
            data.attrs[f"{axis} Converter"] = np.array(converter, dtype=kind)
        data.attrs["Z Converter"] = np.array([(b"HeightCat", b"NanoMeters", (0.0, 0.0, 0.0, 0.0))], dtype=kind)
    return stream.getvalue()


WRITERS = {  # functions by (ending of the name of a file, note)
    "csv": csv, "xyz": zygo, "ply": ply, "stl": stl, "x3p": x3p, "sdf": sdf, "text.sdf": sdf_text, "opd": opd,
    "sur": sur, "opdx": opdx, "datx": datx,
}  # fmt: skip
BY_SURFACE_TOPOGRAPHY = ("opd", "sur", "opdx", "datx")
