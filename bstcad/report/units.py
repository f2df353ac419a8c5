"""Numbers for people: three digits in the unit that suits their size; and exact ones for a prescription or a shop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from bstcad.verify.verdict import Check

DIGITS = 12  # significant digits that a number is taken to have
LADDERS = {  # unit: (from this size on, times, written) downwards
    "mm": ((0.1, 1.0, "mm"), (1e-3, 1e3, "µm"), (1e-8, 1e6, "nm"), (0.0, 1e9, "pm")),
    "deg": ((0.01, 1.0, "°"), (0.0, 3600.0, "″")),
    "rad": ((0.1, 1.0, "rad"), (1e-4, 1e3, "mrad"), (0.0, 1e6, "µrad")),
}
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | bool | None) -> str:
    """Three significant digits, whole numbers whole: 0.0284, 5.8, 6512, 3.2 × 10⁻⁷; yes or no; none."""
    if value is None:
        return "none"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    size = abs(value)
    sign = "−" if value < 0 else ""
    if size == 0 or (size == int(size) and size < 1e15):
        return sign + f"{int(size):,}".replace(",", "\u202f")
    if not 1e-3 <= size < 1e6:
        digits, power = f"{size:.1e}".split("e")
        digits, power = digits.removesuffix(".0"), str(int(power)).translate(SUPERSCRIPTS)
        return sign + (f"10{power}" if digits == "1" else f"{digits} × 10{power}")
    text = f"{size:.{max(0, 2 - math.floor(math.log10(size)))}f}"
    return sign + (text.rstrip("0").rstrip(".") if "." in text else text)


def two_digits(value: float) -> float:
    """An estimate to the digits that it deserves."""
    return float(f"{value:.2g}")


def about(value: float) -> str:
    """An estimate in two digits."""
    return number(two_digits(value))


def quantity(value: float | bool | None, unit: str) -> str:
    """`value` in the unit that suits its size: 3e-7 mm is 0.3 nm; below a thousandth of the smallest unit only that."""
    unit = {"°": "deg", "degrees": "deg", "1": ""}.get(unit, unit)
    if value is None or isinstance(value, bool | np.bool_) or not unit:
        return number(value)
    rungs = LADDERS.get(unit, ((0.0, 1.0, unit),))
    rung = next(rung for rung in rungs if abs(value) >= rung[0]) if value else rungs[0]
    scaled = float(f"{value * rung[1]:.{DIGITS}g}")  # 1e-6 mm times 1e6 is 1 nm, not 0.9999999999999999 nm
    if rung is rungs[-1] and len(rungs) > 1 and 0 < abs(scaled) < 1e-3:
        return f"< {quantity(1e-3 / rung[1], unit)}"
    return f"{number(scaled)}{'' if rung[2] in '°″' else ' '}{rung[2]}"


def percent(part: float) -> str:
    """A part of 1 in percent; never rounded to 0 % or 100 % unless it is."""
    if part in (0.0, 1.0):
        return f"{100 * part:g} %"
    off = min(abs(part), abs(1.0 - part)) * 100.0
    decimals = min(3, max(1, 1 - math.floor(math.log10(off)))) if off > 0 else 3
    if off < 0.0005:
        return "< 0.001 %" if part < 0.5 else "> 99.999 %"
    return f"{100 * part:.{decimals}f} %"


def duration(seconds: float) -> str:
    """8.6 s, 71 s as 1 min 11 s, 1 h 2 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def bound(check: Check) -> str:
    """A check's limit with its sense, which the outcome tells: passed below it or failed above it is an upper one."""
    value, limit, unit = check.value, check.limit, check.unit
    if limit is None:
        return ""
    text = quantity(limit, unit)
    if value is None or isinstance(limit, bool) or (value == limit and check.passed):
        return text
    return ("≤ " if (value <= limit) == check.passed else "≥ ") + text


def share(part: float) -> str:
    """A part of all in percent; less than half a millionth is nothing."""
    return percent(round(part, 6)) if part >= 5e-7 else "0 %"


def amount(value: float, unit: str, signed: bool = False) -> str:
    """A tolerance or an error in its unit, such as "mm RMS", "deg" or "nm", scaled to suit its size."""
    length, _, kind = unit.partition(" ")
    text = quantity(value, length) if length in ("mm", "deg") else f"{number(value)} {unit}".strip()
    text = f"{text} {kind}".strip() if length == "mm" else text
    return f"+{text}" if signed and value > 0 else text


def exact(value: float) -> str:
    """Every digit that tells this number from its neighbours; a whole number without its point."""
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(float(value))


def mm(value: float) -> str:
    """A length in mm to a micrometre, without trailing zeros: 4.379, −0.5, 0."""
    return f"{value:.3f}".rstrip("0").rstrip(".").replace("-", "−") if abs(value) >= 5e-4 else "0"


def rounded_up(value: float, digits: int = 3) -> str:
    """The next number of so many digits that is not smaller, never in powers of ten."""
    if not value > 0:
        return "0"
    last = math.floor(math.log10(value)) - digits + 1
    units = math.ceil(value / 10**last * (1 - 1e-12))
    return f"{units * 10**last:.{max(0, -last)}f}"


def turned(tilt: Sequence[float], number: Callable[[float], str] = number) -> str:
    """A tilt by angles in degrees about x and then about y."""
    turns = (f"{number(angle)} degrees about {axis}" for angle, axis in zip(tilt, "xy", strict=True) if angle)
    return ", then ".join(turns) or "none"
