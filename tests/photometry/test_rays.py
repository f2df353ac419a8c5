"""Ray files: the bytes of each format, total fluxes, unbiased subsets and parts, and damaged files."""

from __future__ import annotations

import random
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from bstcad.photometry import ray_files, ray_table, tm25, zemax_rays
from bstcad.photometry.intensity import Luminaire, PhotometricError
from bstcad.photometry.ray_set import RaySet

LAMP = Luminaire("lamp α", "maker", laboratory="laboratory", date="2026-11-28")
HALVES, TENTHS = (0.0, 0.6, 0.8), (0.8, 0.0, 0.6)  # unit vectors


def disc(n, seed=1, unit="lm", wavelength=None, flux=100.0):
    """A Lambertian disc of radius 2 mm: random points, and cosine-weighted random directions."""
    chance = np.random.default_rng(seed)
    r, a = 2 * np.sqrt(chance.random(n)), 2 * np.pi * chance.random(n)
    sine, b = np.sqrt(chance.random(n)), 2 * np.pi * chance.random(n)
    position = np.stack([r * np.cos(a), r * np.sin(a), np.full(n, 0.25)], axis=1)
    direction = np.stack([sine * np.cos(b), sine * np.sin(b), np.sqrt(1 - sine**2)], axis=1)
    power = chance.random(n) + 0.5
    power *= flux / power.sum()
    return RaySet(*(each.astype(np.float32) for each in (position, direction, power)), unit, wavelength)


def same_bits(a, b):
    return all((getattr(a, key) == getattr(b, key)).all() for key in ("position", "direction", "power"))


@pytest.mark.parametrize("unit", ["lm", "W"])
@pytest.mark.parametrize("wavelength", [None, 550.0, "per ray"])
@pytest.mark.parametrize("form", [tm25, zemax_rays])
def test_a_set_that_is_written_is_read_again(form, wavelength, unit, tmp_path):
    """Every bit of positions, directions and powers; flux, unit and wavelength; from a path as from bytes."""
    own = np.linspace(400, 700, 300, dtype=np.float32) if wavelength == "per ray" else wavelength
    given = disc(300, unit=unit, wavelength=own)
    path = tmp_path / "a.tm25ray"
    path.write_bytes(form.write(given, LAMP))
    for source in (path, path.read_bytes()):
        found = ray_files.read(path.name, source)
        assert same_bits(found, given) and found.unit == unit and found.remarks == ()
        assert found.flux == pytest.approx(given.flux, rel=1e-12) and found.stated == pytest.approx(
            given.flux, rel=1e-7
        )
        if wavelength == "per ray" and unit == "lm":  # a file has either luminous flux or wavelengths of single rays
            assert found.wavelength is None
        elif wavelength == "per ray":
            assert found.wavelength == pytest.approx(own, rel=2e-7)
            assert found.main_wavelength == pytest.approx((own * given.power).sum() / given.power.sum(), rel=1e-6)
        else:
            assert found.main_wavelength == (wavelength and pytest.approx(wavelength, rel=1e-7))
    assert form.write(given, LAMP) == form.write(given, LAMP)


def test_the_bytes_of_a_tm25_file():
    """Each field at its byte, as IES TM-25-13 has it."""
    rays = RaySet(*(np.array(each, np.float32) for each in ([[1, 2, 3]], [HALVES], [5])), "W", wavelength=633.0)
    expected = bytearray(36288 + 28)
    for at, form, value in (
        (4, "i", 2013), (16, "f", 5.0), (20, "Q", 1), (60, "i", 1), (64, "f", 633.0),
        (256, "i", 1), (260, "i", 1), (264, "i", 1),
    ):  # fmt: skip
        struct.pack_into("<" + form, expected, at, value)
    for at in (12, 68, 72):  # luminous flux, smallest and largest wavelength: signalling NaN
        struct.pack_into("<I", expected, at, 0x7F800001)
    expected[0:4], expected[28:38] = b"TM25", b"2026-11-28"
    texts = "lamp α", "maker", "laboratory", "laboratory", "bstcad", "none", "LED", "two words", "none"
    for k, text in enumerate(texts):
        for j, letter in enumerate(text):
            struct.pack_into("<I", expected, 288 + 4000 * k + 4 * j, ord(letter))
    struct.pack_into("<7f", expected, 36288, *(1, 2, 3), *HALVES, 5)
    assert tm25.write(rays, LAMP, details="two\nwords") == bytes(expected)


def tm25_of(flags, rows, spectra=(), **numbers):
    """A file by its flags, rays and spectra; numbers by their byte."""
    head = bytearray(36288)
    struct.pack_into("<4si", head, 0, b"TM25", 2013)
    struct.pack_into("<Q", head, 20, len(rows))
    struct.pack_into("<8i", head, 256, *flags)
    struct.pack_into("<i", head, 76, len(spectra))
    for key, value in numbers.items():
        struct.pack_into("<f" if isinstance(value, float) else "<i", head, int(key[1:]), value)
    tables = b"".join(struct.pack("<i", len(each)) + np.array(each, "<f4").tobytes() for each in spectra)
    tables += bytes(-len(tables) % 32)
    return bytes(head) + tables + bytes(512 * numbers.get("_80", 0) + numbers.get("_84", 0)) + rows.tobytes()


def test_a_tm25_file_with_everything():
    """All columns, in their order: Φ, λ, Φv, six of polarisation, X and Z; columns and text behind them."""
    rows = np.zeros((3, 19), "<f4")
    rows[:, 3:6], rows[:, 6], rows[:, 7], rows[:, 8], rows[:, 9:] = HALVES, 7.0, [500, 600, 700], [1, 2, 0], np.nan
    rows[:, 0] = [1, 2, 3]
    found = tm25.read(tm25_of([1, 1, 1, 1, 1, 1, 1, 0], rows, _80=2, _84=64, _12=3.0, _16=21.0))
    assert found.power.tolist() == [1, 2] and (found.unit, found.stated, found.stated_lumens) == ("lm", 3, 3)
    assert found.wavelength.tolist() == [500, 600] and found.position[:, 0].tolist() == [1, 2]
    assert found.main_wavelength == pytest.approx((500 + 2 * 600) / 3)
    radiant = tm25.read(tm25_of([1, 1, 1, 1, 1, 1, 1, 0], rows, _80=2, _84=64, _16=21.0))
    assert (radiant.unit, radiant.flux, radiant.stated_lumens) == ("W", 21, None)


def test_spectra_of_a_tm25_file_are_read_as_their_mean_wavelength():
    """One for all rays, or one per ray by its number from 1; ∫ λ s dλ / ∫ s dλ of a triangle, and of a single line."""
    triangle, line = [(400, 0), (500, 1), (600, 0)], [(633, 1)]
    rows = np.zeros((2, 8), "<f4")
    rows[:, 3:6], rows[:, 6], rows[:, 7] = HALVES, 1, [2, 1]
    each = tm25.read(tm25_of([1, 1, 1, 0, 0, 0, 0, 1], rows, [triangle, line], _60=4))
    assert each.wavelength.tolist() == [633, 500] and each.stated is None and each.flux == 2
    shared = tm25.read(tm25_of([1, 1, 1, 0, 0, 0, 0, 0], rows[:, :7], [triangle], _60=3))
    assert shared.wavelength == 500
    rows[1, 7] = 3
    with pytest.raises(PhotometricError, match="spectrum that the file does not have in ray 2"):
        tm25.read(tm25_of([1, 1, 1, 0, 0, 0, 0, 1], rows, [triangle, line], _60=4))


def zemax(rows, unit=4, fluxes=(0.0, 0.0), form=0, flux_type=0, place=0.0):
    """A binary file by its bytes."""
    head = bytearray(208)
    struct.pack_into("<2I", head, 0, 8675309, len(rows))
    struct.pack_into("<3f", head, 108, *fluxes, float("nan"))
    struct.pack_into("<I3f", head, 136, unit, place, 0, 0)
    struct.pack_into("<2I", head, 192, form, flux_type)
    return bytes(head) + np.array(rows, "<f4").tobytes()


def test_units_and_totals_of_a_zemax_file():
    """Lengths in m, inch, cm, foot and mm; a flux of the source or of the set with which the rays agree is theirs."""
    rows = [[1, 2, 3, *HALVES, 2.0], [0, 0, 0, *TENTHS, 3.0]]
    for unit, length in enumerate((1000.0, 25.4, 10.0, 304.8, 1.0)):
        assert zemax_rays.read(zemax(rows, unit)).position[0].tolist() == pytest.approx(
            [length, 2 * length, 3 * length]
        )
    near = zemax_rays.read(zemax(rows, fluxes=(9.0, 5.004), flux_type=1))
    assert near.power.tolist() == [2, 3] and near.stated == pytest.approx(5.004) and near.unit == "lm"
    assert zemax_rays.read(zemax(rows, fluxes=(5.0, 9.0))).power.tolist() == [2, 3]
    other = zemax_rays.read(zemax(rows, fluxes=(1.0, 10.0), place=1.0))
    assert other.power.tolist() == [4, 6] and other.flux == other.stated == 10
    assert [("location" in each, "sum to 5 W" in each) for each in other.remarks] == [(True, False), (False, True)]
    spectral = zemax_rays.read(zemax([[*row, 0.55] for row in rows], form=2))
    assert spectral.wavelength.tolist() == [550, 550] and spectral.stated is None and spectral.flux == 5


TEXT = b"""# LightTools
lt_rdf_version: 2.0\r
dataname: lamp
lt_datatype: luminous_flux
lt_far_field_data: no
lt_color_info: wavelength
lt_length_units: inches
lt_data_origin: 0 0 1
lt_radiant_flux: 6
lt_startofdata
 1 2 3 0 .6 .8  1.5 550
 0 0 0 .8 0 .6  0.5 650
lt_endofdata"""


def test_formats_are_recognised_by_their_content():
    """Powers of Speos and LightTools are relative: the header has the flux."""
    rows = np.array([[1, 2, 3, *HALVES, 1.5, 550], [0, 0, 0, *TENTHS, 0.5, 650]], "<f4")
    binary = struct.pack("<4s6I4f", *(b"LTRF", 2, 0, 1, 0, 2, 4), *(0, 0, 1, 6)) + rows.tobytes() + b"LTRFEND"
    for data in (binary, TEXT, TEXT.replace(b"\n", b"\r\n")):
        found = ray_files.read("a.RAY", data)
        assert found.power.tolist() == [4.5, 1.5] and (found.unit, found.stated, found.stated_lumens) == ("lm", 6, 6)
        assert found.position[0].tolist() == pytest.approx([25.4, 50.8, 76.2]) and found.wavelength.tolist() == [
            550,
            650,
        ]
        assert found.direction[1].tolist() == pytest.approx(TENTHS) and "origin" in found.remarks[0]
    speos = struct.pack("<7f", *(6, 2, 2, 2, 2, 2, 700)) + rows[:, [0, 1, 2, 3, 4, 5, 7, 6]].tobytes()
    found = ray_files.read("a.ray", speos)
    assert found.power.tolist() == [4.5, 1.5] and (found.unit, found.stated_lumens) == ("W", 700)
    assert found.wavelength.tolist() == [550, 650] and found.remarks == ()
    text = b"2 2\n1 2 3 0 .6 .8 1.5 .55\n\n0 0 0 .8 0 .6 0.5 .65\n"
    found = ray_files.read("a.dat", text)
    assert found.position[0].tolist() == [10, 20, 30] and found.wavelength.tolist() == pytest.approx([550, 650])
    with pytest.raises(PhotometricError, match="is no ray file"):
        ray_files.read("a.ies", text)


def test_a_lambertian_disc_has_its_moments():
    """E cos γ = 2/3, E cos² γ = 1/2, E r² = R²/2, E x = 0, weighted by power, within four standard errors."""
    rays = tm25.read(tm25.write(disc(20_000), LAMP))
    weight = rays.power / rays.flux
    effective = 1 / (weight.astype(np.float64) ** 2).sum()
    cosine, square = rays.direction[:, 2], (rays.position[:, :2] ** 2).sum(1)
    for values, mean in ((cosine, 2 / 3), (cosine**2, 1 / 2), (square, 2.0), (rays.position[:, 0], 0.0)):
        assert abs((weight * values).sum() - mean) < 4 * values.std() / np.sqrt(effective)


def sorted_set(n=2000):
    """Rays sorted by x, with powers that grow with x: the first rays are a poor sample."""
    rays = disc(n)
    order = np.argsort(rays.position[:, 0])
    x = np.linspace(0, 1, n, dtype=np.float32)
    return replace(rays, position=rays.position[order], power=x + np.float32(0.01), unit="W", wavelength=500 + x)


def test_a_draw_is_unbiased_and_has_no_ray_twice():
    """Means over seeds of the flux and of the mean of x are those of the set, within four standard errors."""
    rays = sorted_set()
    x = rays.position[:, 0].astype(np.float64)
    seeds = [rays.drawn(50, seed) for seed in range(200)]
    assert all(len(each) == len(np.unique(each.position, axis=0)) == 50 for each in seeds)
    assert all((np.diff(each.position[:, 0]) >= 0).all() for each in seeds)
    for whole, sums in (
        (rays.flux, [each.flux for each in seeds]),
        ((rays.power * x).sum(), [(each.power * each.position[:, 0]).sum() for each in seeds]),
    ):
        assert abs(np.mean(sums) - whole) < 4 * np.std(sums) / np.sqrt(len(sums))
        assert np.std(sums) > 0
    one = seeds[0]
    at = np.searchsorted(rays.wavelength, one.wavelength)
    assert one.power == pytest.approx(rays.power[at] * 40) and (one.direction == rays.direction[at]).all()
    assert rays.drawn(2000) is rays
    with pytest.raises(ValueError, match="above 0"):
        rays.drawn(0)


def test_each_ray_is_in_one_part():
    rays = sorted_set()
    parts = rays.parts(5, seed=3)
    assert sum(len(each) for each in parts) == len(rays) and sum(p.flux for p in parts) == pytest.approx(rays.flux)
    assert sorted(np.concatenate([each.position[:, 0] for each in parts])) == rays.position[:, 0].tolist()
    # 400 of 2000 rays: standard deviation 18; of uniform powers 0.6 / 20 of a part's flux
    assert all(abs(len(each) - 400) < 5 * 18 and abs(each.flux - rays.flux / 5) < 5 * 12 for each in parts)


def test_of_a_large_file_a_random_subset_is_read(monkeypatch):
    """About MAX_RAYS rays from the whole file, with an unbiased flux; the header's flux is that of all rays."""
    rays = sorted_set(20_000)
    monkeypatch.setattr(ray_table, "MAX_RAYS", 500)
    found = tm25.read(tm25.write(rays, LAMP))
    assert abs(len(found) - 500) < 5 * np.sqrt(500) and found.stated == pytest.approx(rays.flux)
    assert abs(found.flux / rays.flux - 1) < 4 * 0.6 / np.sqrt(500)
    assert np.histogram(found.position[:, 0], bins=4, range=(-2, 2))[0].min() > 50
    assert "20000 rays" in found.remarks[0]
    scaled = zemax_rays.read(zemax(np.hstack([rays.position, rays.direction, rays.power[:, None]]), fluxes=(1.0, 1.0)))
    assert abs(scaled.flux - 1) < 4 * 0.6 / np.sqrt(500) and len(scaled.remarks) == 2


def test_faults_are_refused_and_small_ones_set_right():
    """Lengths of directions within 1e-3 of 1 become 1; rays without power are dropped."""
    good = [[1, 2, 3, *HALVES, 2.0], [0, 0, 0, *TENTHS, 3.0], [0, 0, 0, *TENTHS, 0.0]]
    long = np.array(good)
    long[1, 3:6] *= 1.0009
    found = zemax_rays.read(zemax(long))
    assert len(found) == 2 and np.linalg.norm(found.direction, axis=1) == pytest.approx(1, abs=1e-7)
    for column, value, clause in (
        (3, 0.1, "no unit vector in ray 2"), (4, np.nan, "no unit vector in ray 2"),
        (6, -1.0, "negative power in ray 2"), (6, np.inf, "power that is not finite in ray 2"),
        (1, np.nan, "position that is not finite in ray 2"), (0, 1e20, r"1e\+06 mm from the origin in ray 2"),
    ):  # fmt: skip
        bad = np.array(good)
        bad[1, column] = value
        with pytest.raises(PhotometricError, match=clause):
            zemax_rays.read(zemax(bad))
    with pytest.raises(PhotometricError, match="no light"):
        zemax_rays.read(zemax(good[2:]))
    with pytest.raises(PhotometricError, match="no rays"):
        zemax_rays.read(zemax([]))


NUMBERS = [struct.pack("<I", 0x7F800001), struct.pack("<f", 1e30), struct.pack("<f", -1.0), b"\xff" * 4, b"\0\0\0\x7f"]


def damaged(data, header, chance):
    """The file cut short or made longer, with a changed magic, numbers of its header or its rays replaced, or noise."""
    how = chance.randrange(6)
    changed = bytearray(data)
    if how == 0:
        return data[: chance.randrange(len(data))]
    if how == 1:
        return data + bytes(chance.randrange(1, 40))
    if how == 2:
        changed[chance.randrange(4)] ^= 1 << chance.randrange(8)
    elif how == 3:
        at = 4 * chance.randrange(header // 4)
        changed[at : at + 4] = chance.choice(NUMBERS)
    elif how == 4:
        at = header + 4 * chance.randrange((len(data) - header) // 4)
        changed[at : at + 4] = chance.choice(NUMBERS)
    else:
        for _ in range(20):
            changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


LTRF = struct.pack("<4s6I4f", *(b"LTRF", 2, 0, 0, 0, 2, 1), *(0, 0, 0, 1))  # header of a LightTools file


def text_of(rows):
    return b"\n".join(b" ".join(b"%.6f" % value for value in row) for row in rows)


@pytest.mark.parametrize("kind", ["tm25", "zemax", "zemax text", "speos", "lighttools", "lighttools text"])
def test_damaged_files_are_refused_in_a_clause_or_are_files(kind, tmp_path):
    rays = disc(40, unit="W", wavelength=np.full(40, 550, np.float32))
    rows = np.hstack([rays.position, rays.direction, rays.power[:, None], rays.wavelength[:, None]])
    data, header = {
        "tm25": (tm25.write(rays, LAMP), 288),
        "zemax": (zemax_rays.write(rays, LAMP), 208),
        "zemax text": (b"40 4\n" + text_of(rows), 8),
        "speos": (struct.pack("<7f", *(1, 2, 2, 2, 2, 2, 700)) + rows[:, [0, 1, 2, 3, 4, 5, 7, 6]].tobytes(), 28),
        "lighttools": (LTRF + rows.tobytes() + b"LTRFEND", 44),
        "lighttools text": (TEXT[: TEXT.index(b" 1 2 3")] + text_of(rows) + b"\nlt_endofdata\n", 200),
    }[kind]  # fmt: skip
    assert len(ray_files.read("a.ray", data)) == 40
    chance, refused, path = random.Random(5), 0, tmp_path / "a.ray"
    tracemalloc.start()
    for k in range(150):
        bad = damaged(data, header, chance)
        path.write_bytes(bad)
        try:
            found = ray_files.read("a.ray", bad if k % 2 else path)
        except PhotometricError as fault:
            refused += 1
            assert str(fault).isprintable() and len(str(fault)) < 120
        else:
            assert 0 < found.flux < np.inf and np.isfinite(found.position).all() and (found.power >= 0).all()
            assert np.linalg.norm(found.direction, axis=1) == pytest.approx(1, abs=1e-5)
            assert all(each.isprintable() for each in (found.name, *found.remarks))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert refused >= 50 and most < 20e6


@pytest.mark.parametrize("count", [2**63 + 1, 10**12, 41])
def test_a_huge_number_of_rays_is_not_believed(count):
    """Memory follows the bytes of the file, not the number that its header states."""
    data = bytearray(tm25.write(disc(40), LAMP))
    struct.pack_into("<Q", data, 20, count)
    with pytest.raises(PhotometricError, match=f"states {count} rays of 28 bytes and has 1120 bytes"):
        tm25.read(bytes(data))
