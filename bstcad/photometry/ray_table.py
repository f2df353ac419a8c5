"""Rays as files list them, with the checks and the total flux of every format of ray files.

The total flux that a header states is the flux of the set.  Files whose powers sum to something else have powers that
are only relative (LightTools: their mean is the total); they are scaled to the header's total, and a remark says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bstcad.photometry.intensity import PhotometricError
from bstcad.photometry.ray_set import RAYS_PER_BLOCK, READING, RaySet, chances, scaled

MAX_RAYS = 20_000_000  # largest number of rays in memory; a random subset of so many stands for a larger file
MAX_TEXT_RAYS = 5_000_000  # largest number of rays of a file in the form of text
TEXT_PER_BLOCK = 1 << 22  # bytes of text that are parsed at a time
SAME_TOTAL = 1e-3  # largest difference of a stated total from the sum of the powers, as a fraction of the sum
UNIT_LENGTH = 1e-3  # largest difference of the length of a direction from 1
SAME_LENGTH = 1e-6  # largest difference of the length of a direction from 1 that is rounding, and is kept
MAX_POSITION = 1e6  # largest coordinate of a ray (mm); larger ones are faults of the file or of its unit
SMALLEST_FLUX = 1e-30  # smallest flux of a header; smaller ones, 0 and NaN state that the flux is not known

Source = Path | bytes  # ray file, or the bytes of one


@dataclass(frozen=True, eq=False)
class RayTable:
    """Rays as a file has them, one in a row, and the facts by which they are read."""

    rows: np.ndarray  # (n, columns) float32: position in columns 0 to 2, direction cosines in columns 3 to 5
    unit: str  # unit of the powers: "lm" or "W"
    power: int = 6  # column of the powers
    wavelength: float | None = None  # wavelength of all rays, nm
    wavelengths: int | None = None  # column of the wavelengths, or of the numbers of spectra, counted from 1
    spectra: np.ndarray | None = None  # mean wavelengths of the spectra, nm; None: the column has wavelengths
    millimetres: float = 1.0  # unit of the positions, mm
    nanometres: float = 1.0  # unit of the wavelengths, nm
    totals: tuple[float | None, ...] = ()  # total fluxes by the header, in the unit; the first one has precedence
    lumens: float | None = None  # luminous flux by the header, lm
    is_relative: bool = False  # True for a format in which only the ratios of the powers count
    name: str = ""  # name of the light source
    remarks: tuple[str, ...] = ()  # sentences on the reading

    def checked(self) -> RaySet:
        """Return the rays that have power, after checks that apply to every format; PhotometricError: a clause.

        The flux is the first stated total with which the sum of the powers agrees, or else the first stated total, to
        which the powers are scaled; without a stated total it is the sum.  Of more than MAX_RAYS rays a random subset
        is read, with powers scaled by the number of all rays over those of the subset.
        """
        n = len(self.rows)
        if n == 0:
            raise PhotometricError("has no rays; give a file with rays")
        share = min(1.0, MAX_RAYS / n)
        room = min(n, MAX_RAYS + 6 * math.isqrt(MAX_RAYS))  # six standard deviations of the number drawn
        position, direction = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
        power = np.empty(room, np.float32)
        wavelength = None if self.wavelengths is None else np.empty(room, np.float32)
        total, drawn, filled = 0.0, 0, 0
        for first in range(0, n, RAYS_PER_BLOCK):
            block = self.rows[first : first + RAYS_PER_BLOCK]
            powers = self._powers(block, first)
            total += float(powers.sum(dtype=np.float64))
            kept = powers > 0
            if share < 1:
                chosen = chances(first, n, seed=0, use=READING) < share
                drawn, kept = drawn + int(chosen.sum()), kept & chosen
            new = slice(filled, filled + int(kept.sum()))
            position[new] = self._positions(block, first)[kept]
            direction[new] = self._directions(block, first)[kept]
            power[new] = powers[kept]
            if wavelength is not None:
                wavelength[new] = self._wavelengths(block, first)[kept]
            filled = new.stop
        totals = [each for each in self.totals if each is not None]
        agreeing = [each for each in totals if abs(each - total) <= SAME_TOTAL * total]
        stated = next(iter(agreeing + totals), None)
        remarks, factor = self.remarks, 1.0
        if not total > 0 or filled == 0:
            raise PhotometricError("has no light; give a file with rays of power above 0")
        if stated is not None and (self.is_relative or abs(stated - total) > SAME_TOTAL * total):
            factor = stated / total
            if not self.is_relative:
                remarks = (
                    *remarks,
                    f"The powers of the rays sum to {total:.6g} {self.unit}, and the header states {stated:.6g} "
                    f"{self.unit}; the powers are scaled to the header's total.",
                )
        if share < 1:
            factor *= n / drawn
            remarks = (*remarks, f"The file has {n} rays; a random subset of {drawn} stands for them.")
        rays = RaySet(
            position[:filled], direction[:filled], scaled(power[:filled], factor), self.unit,
            wavelength=self.wavelength if wavelength is None else wavelength[:filled],
            stated=stated, stated_lumens=self.lumens, name=self.name, remarks=remarks,
        )  # fmt: skip
        if not 0 < rays.flux < math.inf:
            raise PhotometricError("states a flux that its rays cannot have; correct the total flux of the header")
        return rays

    def _powers(self, block: np.ndarray, first: int) -> np.ndarray:
        powers = block[:, self.power]
        _refuse(~np.isfinite(powers), first, fault="a power that is not finite")
        _refuse(powers < 0, first, fault="a negative power")
        return powers

    def _positions(self, block: np.ndarray, first: int) -> np.ndarray:
        position = scaled(block[:, :3], self.millimetres)
        _refuse(~np.isfinite(position).all(axis=1), first, fault="a position that is not finite")
        far = (np.abs(position) > MAX_POSITION).any(axis=1)
        _refuse(far, first, fault=f"a position more than {MAX_POSITION:g} mm from the origin")
        return position

    def _directions(self, block: np.ndarray, first: int) -> np.ndarray:
        """Return unit vectors; lengths within UNIT_LENGTH of 1 are set to 1, unless they differ by rounding only."""
        with np.errstate(invalid="ignore"):  # signalling NaN
            direction = block[:, 3:6].astype(np.float64)
        x, y, z = direction.T
        length = np.sqrt(x * x + y * y + z * z)
        _refuse(~(np.abs(length - 1) <= UNIT_LENGTH), first, fault="a direction that is no unit vector")
        other = np.abs(length - 1) > SAME_LENGTH
        direction[other] /= length[other, None]
        return direction.astype(np.float32)

    def _wavelengths(self, block: np.ndarray, first: int) -> np.ndarray:
        found = block[:, self.wavelengths or 0]
        if self.spectra is not None:
            known = (found >= 1) & (found <= len(self.spectra))
            _refuse(~known, first, fault="the number of a spectrum that the file does not have")
            return self.spectra[found.astype(np.int64) - 1]
        found = scaled(found, self.nanometres)
        _refuse(~((found > 0) & np.isfinite(found)), first, fault="a wavelength that is not above 0")
        return found


def _refuse(bad: np.ndarray, first: int, fault: str) -> None:
    """Raise PhotometricError on the first bad ray; first: number of rays before the block."""
    if bad.any():
        raise PhotometricError(f"has {fault} in ray {first + int(bad.argmax()) + 1}; correct it")


def bytes_of(source: Source) -> np.ndarray:
    """Return the bytes of a file, mapped to memory where it is a path; PhotometricError if it is empty."""
    if not (len(source) if isinstance(source, bytes) else source.stat().st_size):
        raise PhotometricError("is empty; give a file with rays")
    if isinstance(source, bytes):
        return np.frombuffer(source, dtype=np.uint8)
    return np.asarray(np.memmap(source, dtype=np.uint8, mode="r"))


def rows_of(data: np.ndarray, start: int, count: int, columns: int) -> np.ndarray:
    """Return the rays (count, columns) of 32-bit numbers, little-endian, that fill the bytes from a start."""
    size = len(data) - start
    if size != 4 * columns * count:
        raise PhotometricError(
            f"states {count} rays of {4 * columns} bytes and has {max(size, 0)} bytes of rays; it is not complete"
        )
    return data[start:].view("<f4").reshape(count, columns)


def rows_of_text(data: np.ndarray, start: int, end: int) -> np.ndarray:
    """Return the rays (n, columns) of lines of as many numbers each; PhotometricError: a clause on the fault."""
    found: list[np.ndarray] = []
    columns, rays = 0, 0
    while start < end:
        text = data[start : min(start + TEXT_PER_BLOCK, end)].tobytes()
        whole = len(text) if start + len(text) >= end else text.rfind(b"\n") + 1
        if whole == 0:
            raise PhotometricError("has a line without an end; it is no list of rays")
        start += whole
        try:
            lines = [line for line in text[:whole].splitlines() if line.strip()]
            numbers = np.array(b" ".join(lines).split(), dtype=np.float32)
        except (ValueError, OverflowError):
            raise PhotometricError("has something other than a number in its list of rays; correct it") from None
        if not lines:
            continue
        columns = columns or len(lines[0].split())
        rays += len(lines)
        if len(numbers) != columns * len(lines) or not 7 <= columns <= 8:
            raise PhotometricError("has a ray without 7 or 8 numbers, as the first ray has; correct it")
        if rays > MAX_TEXT_RAYS:
            raise PhotometricError(f"has more than {MAX_TEXT_RAYS} rays as text; give a binary ray file")
        found.append(numbers.reshape(-1, columns))
    return np.concatenate(found) if found else np.empty((0, 7), np.float32)


def is_stated(flux: float) -> bool:
    """Return True if a flux of a header is known: finite and not 0."""
    return math.isfinite(flux) and flux > SMALLEST_FLUX


def stated_or_none(flux: float) -> float | None:
    """Return a flux of a header; None if it is not known."""
    return float(flux) if is_stated(flux) else None


def plain(text: str) -> str:
    """Return a text of one line of printable characters."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())
