"""Photometric files: fluxes by closed forms, symmetries, both formats by packages of others, and damaged files."""

from __future__ import annotations

import math
import random
import tracemalloc

import numpy as np
import photompy
import pyldt
import pytest

from bstcad.photometry import eulumdat, ies, intensity_files
from bstcad.photometry.intensity import SYMMETRIES, Intensity, Luminaire, PhotometricError, checked, symmetry

GAMMA = np.linspace(0.0, 90.0, 37)
STEP = 15.0
PLANES = np.arange(0.0, 360.0, STEP)


def table(kind="none", planes=PLANES, along=GAMMA):
    """A downlight whose hot spot lies to a side, by its symmetry."""
    c, g = np.radians(planes)[:, None], np.radians(along)[None]
    own = {
        "rotational": 0 * c,
        "quadrant": np.cos(2 * c),
        "C0-C180": np.cos(c),
        "C90-C270": np.sin(c),
        "none": np.cos(c) + 0.5 * np.sin(c) + 0.3 * np.sin(2 * c),
    }[kind]
    candela = 300 * np.cos(g) * (1 + 0.4 * np.sin(g) ** 2 * own)
    return checked("C", planes, along, np.maximum(candela, 0.0), None)


def test_the_flux_is_the_integral_of_the_intensity():
    """Exact for a piecewise linear intensity; π cd for a Lambertian but for its interpolation."""
    fine = np.linspace(0.0, 90.0, 9001)
    lambertian = Intensity("C", np.zeros(1), fine, np.cos(np.radians(fine))[None])
    assert lambertian.lumens == pytest.approx(math.pi, rel=1e-7)
    even = Intensity("C", np.zeros(1), np.array([0.0, 60.0]), np.ones((1, 2)))
    assert even.lumens == pytest.approx(2 * math.pi * (1 - 0.5), rel=1e-14)
    coarse = table(planes=PLANES[::3], along=GAMMA[::6])
    c, g = (np.arange(1200) + 0.5) * 0.3, (np.arange(1200) + 0.5) * 0.075
    summed = (coarse.between(c[:, None], g[None]) * np.sin(np.radians(g))).sum() * np.radians(0.3) * np.radians(0.075)
    assert coarse.lumens == pytest.approx(summed, rel=1e-6)


@pytest.mark.parametrize("kind", ["A", "B"])
def test_the_flux_and_the_directions_of_types_a_and_b(kind):
    """Coordinates of one beam: right is -x for who looks along the light, with y upwards."""
    h, v = np.linspace(-40.0, 40.0, 161), np.linspace(-30.0, 30.0, 121)

    def beam(x, y, z):
        return 1000 * np.exp(-((x + 0.2) ** 2 + (y - 0.1) ** 2) / 0.02) * (z > 0)

    a, b = np.radians(h)[:, None], np.radians(v)[None]
    if kind == "A":
        x, y, z = -np.cos(b) * np.sin(a), np.sin(b) + 0 * a, np.cos(b) * np.cos(a)
    else:
        x, y, z = -np.sin(a) + 0 * b, np.cos(a) * np.sin(b), np.cos(a) * np.cos(b)
    found = checked(kind, h, v, beam(x, y, z), None)
    at = np.array([0.2, 0.0]), np.array([-0.1, 0.3])
    z = np.sqrt(1 - at[0] ** 2 - at[1] ** 2)
    assert found.at(*at, z) == pytest.approx(beam(*at, z), rel=0.01, abs=1.0)
    fine = Intensity("C", np.arange(0.0, 360.0), np.linspace(0, 60, 241), np.zeros((360, 241)))
    c, g = np.radians(fine.around)[:, None], np.radians(fine.along)[None]
    values = beam(np.sin(g) * np.cos(c), -np.sin(g) * np.sin(c), np.cos(g) + 0 * c)
    assert found.lumens == pytest.approx(Intensity("C", fine.around, fine.along, values).lumens, rel=1e-3)


@pytest.mark.parametrize("kind", SYMMETRIES)
@pytest.mark.parametrize("form", ["2002", "2019", "ldt"])
def test_a_table_that_is_written_is_read_again(kind, form):
    """The planes of its symmetry alone are stated; flux and orientation stay."""
    given = table(kind)
    assert symmetry(given) == kind
    luminaire = Luminaire("lens α", "maker", date="2026-11-28", size=(30.0, 20.0, 5.0))
    if form == "ldt":
        found = eulumdat.read(eulumdat.write(given, luminaire, lamp_lumens=800.0))
        assert found.rated_lumens == 800.0
        assert eulumdat.read(eulumdat.write(given, luminaire)).rated_lumens is None
    else:
        found = ies.read(ies.write(given, luminaire, form))
        assert found.rated_lumens is None
    assert found.lumens == pytest.approx(given.lumens, rel=1e-5)
    c, g = np.meshgrid(np.arange(0.0, 360.0, 5.0), np.arange(0.0, 90.0, 2.5), indexing="ij")
    # at the rim of a tolerance a table counts as symmetric
    assert found.between(c, g) == pytest.approx(given.between(c, g), abs=0.4)


def test_packages_of_others_read_what_is_written(tmp_path):
    """A hot spot at C = 30, γ = 40 degrees, in the same place by three readers; lumens by one's own integral."""
    given = table("none")
    luminaire = Luminaire("lens", "maker", date="2026-11-28")
    for version in ("2002", "2019"):
        (tmp_path / "a.ies").write_bytes(ies.write(given, luminaire, version))
        theirs = photompy.IESFile.read(tmp_path / "a.ies").photometry
        expanded = theirs.expanded() if callable(getattr(theirs, "expanded", None)) else theirs
        assert np.asarray(expanded.values)[2, 16] == pytest.approx(given.candela[2, 16], rel=1e-6)
        assert theirs.total_optical_power() == pytest.approx(given.lumens, rel=0.01)
    (tmp_path / "a.ldt").write_bytes(eulumdat.write(given, luminaire, lamp_lumens=1000.0))
    theirs = pyldt.LdtReader.read(tmp_path / "a.ldt")
    assert np.array(theirs.intensities) == pytest.approx(given.candela, rel=1e-6)
    assert (theirs.header.isym, theirs.header.mc, theirs.header.lorl) == (
        0,
        24,
        pytest.approx(given.lumens / 10, rel=1e-5),
    )


@pytest.mark.parametrize("kind", SYMMETRIES)
def test_another_package_expands_each_symmetry_as_we_do(kind, tmp_path):
    given = table(kind)
    (tmp_path / "a.ldt").write_bytes(eulumdat.write(given, Luminaire(), lamp_lumens=1000.0))
    theirs = np.array(pyldt.LdtReader.read(tmp_path / "a.ldt").intensities)
    ours = given.candela[:1] if kind == "rotational" else given.candela
    assert theirs == pytest.approx(ours, abs=0.31)


FACTORS = """IESNA:LM-63-1991
[TEST] x
TILT=INCLUDE
1
3
0 45 90
1 .9 .8
2 500 1.5 3 1 1 1 0 0 0
.9 .8 20
0 45 90
0
100 70 0
"""


def test_factors_multiply_and_minus_one_is_absolute():
    """Multiplier 1.5, ballast factor 0.9, and the ballast-lamp factor 0.8, which files since 1995 do not have."""
    old = ies.read(FACTORS.encode())
    assert old.candela[0].tolist() == pytest.approx([108.0, 75.6, 0.0]) and old.rated_lumens == 2 * 500 * 0.9
    new = ies.read(FACTORS.replace("1991", "2002").encode())
    assert new.candela[0].tolist() == pytest.approx([135.0, 94.5, 0.0])
    made = ies.read(FACTORS.replace("IESNA:LM-63-1991", "IES:LM-63-2019").replace(".9 .8 20", ".9 1.11001 20").encode())
    assert made.candela[0].tolist() == pytest.approx([135.0, 94.5, 0.0])
    assert ies.read(FACTORS.replace("2 500", "2 -1").encode()).rated_lumens is None


def test_a_table_of_numbers_has_c_in_its_first_row():
    found = intensity_files.read("a.csv", b"g,0,90,180,270\n0,5,5,5,5\n30,4,3,2,1\n60,0,0,0,0\n")
    assert found.between(np.array([90.0, 315.0]), np.array([30.0, 30.0])).tolist() == [3.0, 2.5]


INFINITE = {
    "a multiplier": (".ies", FACTORS.replace("1.5", "1e308")),
    "a product of factors": (".ies", FACTORS.replace("1.5", "1e308").replace(".9 .8 20", "1e10 .8 20")),
    "a number": (".ies", FACTORS.replace("100 70", "1e400 70")),
    "an intensity": (".ies", FACTORS.replace("100 70", "1e308 1e308")),
    "a flux of lamps": (".ies", FACTORS.replace("2 500", "1e200 1e200")),
    "a table": (".csv", "g,0,90,180,270\n0,1e308,5,5,5\n30,1e308,3,2,1\n"),
    "too many rows": (".csv", "1\n" * 5_000_000),
    "too many numbers": (".ies", FACTORS + "1 " * 20_000_000),
}


@pytest.mark.parametrize("case", INFINITE)
def test_infinite_light_and_endless_tables_are_refused(case):
    suffix, text = INFINITE[case]
    tracemalloc.start()
    try:
        if case == "too many numbers":  # those after the table are not read
            assert intensity_files.read(f"a{suffix}", text.encode()).lumens > 0
        else:
            with pytest.raises(PhotometricError, match=r"finite|maximum|more than \d+ values"):
                intensity_files.read(f"a{suffix}", text.encode())
        assert tracemalloc.get_traced_memory()[1] < 1e9
    finally:
        tracemalloc.stop()


def test_an_infinite_flux_of_lamps_in_an_eulumdat_file_is_refused():
    lines = eulumdat.write(table("none"), Luminaire("lens"), 1000.0).split(b"\r\n")
    assert lines[28] == b"1000"
    lines[28] = b"1e308"
    with pytest.raises(PhotometricError, match="finite|maximum"):
        eulumdat.read(b"\r\n".join(lines))


def damaged(data, chance):
    """The file cut short, with bytes changed, lines lost, or numbers replaced."""
    how = chance.randrange(5)
    if how == 0:
        return data[: chance.randrange(len(data))]
    if how == 1:
        changed = bytearray(data)
        for _ in range(20):
            changed[chance.randrange(len(data))] = chance.randrange(256)
        return bytes(changed)
    lines = data.split(b"\n")
    at = chance.randrange(len(lines))
    if how == 2:
        del lines[at : at + chance.randrange(1, 4)]
    elif how == 3:
        lines[at] = chance.choice(
            [b"nan", b"1e999", b"-5", b"99999999 99999999", b"", b"\xff\xfe", b"1 -1 1 40000 40000 1"]
        )
    else:
        numbers = lines[at].split()
        lines[at] = b" ".join(chance.choice([b"1e30", b"-1", b"x", each]) for each in numbers)
    return b"\n".join(lines)


@pytest.mark.parametrize("suffix", [".ies", ".ldt", ".csv"])
def test_damaged_files_are_refused_in_a_clause_or_are_files(suffix):
    given, luminaire = table("none"), Luminaire("lens")
    rows = [[0.0, *PLANES], *np.column_stack([GAMMA, given.candela.T])]
    data = {
        ".ies": ies.write(given, luminaire), ".ldt": eulumdat.write(given, luminaire),
        ".csv": "\n".join(",".join(map(str, row)) for row in rows).encode(),
    }[suffix]  # fmt: skip
    chance, refused = random.Random(7), 0
    tracemalloc.start()
    for _ in range(200):
        try:
            found = intensity_files.read(f"a{suffix}", damaged(data, chance))
        except PhotometricError as fault:
            refused += 1
            assert str(fault).isprintable() and len(str(fault)) < 120
        else:
            assert found.lumens > 0 and np.isfinite(found.candela).all()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert refused >= 50 and most < 100e6


def test_a_table_of_commas_returns_as_it_was_written():
    given = table("none")
    found = intensity_files.of_csv(intensity_files.csv_text(given).encode())
    for part in ("around", "along", "candela"):
        assert getattr(found, part) == pytest.approx(getattr(given, part), rel=1e-9)
    assert intensity_files.csv_text(found) == intensity_files.csv_text(given)
