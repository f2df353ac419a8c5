"""Numbers as text, in a unit that suits their size or with all digits, and the templates that show them."""

from __future__ import annotations

import contextlib
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bstcad.verify.verdict import Check

if TYPE_CHECKING:
    from jinja2 import BytecodeCache, Environment

Rows = list[tuple[str, str]]  # name, value
DIGITS = 12  # significant digits to which `quantity` first rounds a number
LADDERS = {  # unit: (smallest size in this unit, factor to the written unit, written unit), in descending order
    "mm": ((0.1, 1.0, "mm"), (1e-3, 1e3, "µm"), (1e-8, 1e6, "nm"), (0.0, 1e9, "pm")),
    "deg": ((0.01, 1.0, "°"), (0.0, 3600.0, "″")),
    "rad": ((0.1, 1.0, "rad"), (1e-4, 1e3, "mrad"), (0.0, 1e6, "µrad")),
}
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | bool | None) -> str:
    """Return text such as 6 512 (integer), 0.0284 (three digits), 3.2 × 10⁻⁷ (others < 1e-3 or ≥ 1e6), yes, none."""
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
    """Round an estimate to two significant digits."""
    return float(f"{value:.2g}")


def about(value: float, unit: str = "") -> str:
    """Return an estimate with two digits and its unit."""
    return quantity(two_digits(value), unit)


def quantity(value: float | bool | None, unit: str) -> str:
    """Return a value in a unit that suits its size (3e-7 mm: 0.3 nm), or "< 0.001 pm" if it is too small for any."""
    unit = {"°": "deg", "degrees": "deg", "1": ""}.get(unit, unit)
    if value is None or isinstance(value, bool | np.bool_) or not unit:
        return number(value)
    rungs = LADDERS.get(unit, ((0.0, 1.0, unit),))
    rung = next(rung for rung in rungs if abs(value) >= rung[0]) if value else rungs[0]
    scaled = float(f"{value * rung[1]:.{DIGITS}g}")  # 1e-6 mm is 1 nm, not 0.9999999999999999 nm
    if rung is rungs[-1] and len(rungs) > 1 and 0 < abs(scaled) < 1e-3:
        return f"< {quantity(1e-3 / rung[1], unit)}"
    return f"{number(scaled)}{'' if rung[2] in '°″' else ' '}{rung[2]}"


def percent(part: float) -> str:
    """Return a fraction in percent; 0 % and 100 % only if it is exactly 0 or 1."""
    if part in (0.0, 1.0):
        return f"{100 * part:g} %"
    distance = min(abs(part), abs(1.0 - part)) * 100.0
    if distance < 0.0005:
        return "< 0.001 %" if part < 0.5 else "> 99.999 %"
    return f"{100 * part:.{min(3, max(1, 1 - math.floor(math.log10(distance))))}f} %"


def duration(seconds: float) -> str:
    """Return a time such as 8.6 s, 1 min 11 s or 1 h 2 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def bound(check: Check) -> str:
    """Return the limit of a check, with ≤ if a value below the limit passes, with ≥ if it fails; "" without a limit."""
    value, limit, unit = check.value, check.limit, check.unit
    if limit is None:
        return ""
    text = quantity(limit, unit)
    if value is None or isinstance(limit, bool) or (value == limit and check.passed):
        return text
    return ("≤ " if (value <= limit) == check.passed else "≥ ") + text


def amount(value: float, unit: str, signed: bool = False) -> str:
    """Return an amount with its unit; "mm", "mm RMS" and "deg" become a unit that suits it; signed: + if positive."""
    length, _, kind = unit.partition(" ")
    text = quantity(value, length) if length in ("mm", "deg") else f"{number(value)} {unit}".strip()
    text = f"{text} {kind}".strip() if length == "mm" else text
    return f"+{text}" if signed and value > 0 else text


def exact(value: float) -> str:
    """Return a number with all digits of its float64 value, an integer without a decimal point."""
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(float(value))


def mm(value: float) -> str:
    """Return a length (mm) rounded to 0.001 mm: 6.040 for 6.0402, but without zeros at the end (0.5) if it is exact."""
    text = f"{value:.3f}" if abs(value) >= 5e-4 else "0"
    text = text.rstrip("0").rstrip(".") if "." in text and abs(value - float(text)) < 1e-6 else text
    return text.replace("-", "−")


def interval(ends: Sequence[float]) -> str:
    """Return an interval (mm): ±12 if it is symmetric about 0, else 15 to 20."""
    low, high = ends
    return f"±{mm(high)}" if mm(-low) == mm(high) else f"{mm(low)} to {mm(high)}"


def rounded_up(value: float) -> str:
    """Return a positive number rounded up to three digits, without an exponent."""
    if not value > 0:
        return "0"
    last = math.floor(math.log10(value)) - 2
    units = math.ceil(value / 10**last * (1 - 1e-12))
    return f"{units * 10**last:.{max(0, -last)}f}"


def tilt_words(tilt: Sequence[float], number: Callable[[float], str] = number) -> str:
    """Return a tilt in words: angles in degrees, which `number` formats, about x, then about y."""
    turns = (f"{number(angle)} degrees about {axis}" for angle, axis in zip(tilt, "xy", strict=True) if angle)
    return ", then ".join(turns) or "none"


def scene_value(value: Any) -> str:
    """Return a value of a scene in one line: yes or no, a number with all digits, a list, a table with its keys."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return exact(value)
    if isinstance(value, Mapping):
        sizes = (f"{key} {scene_value(part)}" for key, part in value.items() if key != "shape")
        return ", ".join([value["shape"], *sizes] if "shape" in value else sizes)
    return ", ".join(map(scene_value, value)) if isinstance(value, list | tuple) else str(value).replace("\n", " ")


# --- templates --------------------------------------------------------------------------------------------------------


@cache
def environment() -> Environment:
    """Return the templates of this folder; they escape all text for HTML, since titles and scenes come from users."""
    import jinja2

    folder = jinja2.FileSystemLoader(Path(__file__).parent)
    found = jinja2.Environment(loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    found.bytecode_cache = _kept("escaped")
    found.undefined = jinja2.StrictUndefined
    filters = (about, amount, bound, duration, exact, interval, mm, number, percent, quantity, rounded_up)
    found.filters |= {f.__name__: f for f in (*filters, scene_value, tilt_words)}
    found.globals["exact"] = exact
    return found


@cache
def _plain_text() -> Environment:
    """Return the templates of this folder for plain text, without escapes."""
    return environment().overlay(autoescape=False, bytecode_cache=_kept("plain"))


def _kept(escapes: str) -> BytecodeCache:
    """Return the cache of compiled templates, in __pycache__ as that of modules; compiling takes 0.6 to 0.9 s.

    escapes: part of the names of its files, since a template that escapes text is another program than one that does
    not.  Nothing is written where Python may not write, or is told not to.
    """
    from jinja2.bccache import Bucket, FileSystemBytecodeCache

    class Kept(FileSystemBytecodeCache):
        def dump_bytecode(self, bucket: Bucket) -> None:
            if not sys.dont_write_bytecode:
                with contextlib.suppress(OSError):
                    Path(self.directory).mkdir(exist_ok=True)
                    super().dump_bytecode(bucket)

    return Kept(str(Path(__file__).parent / "__pycache__"), f"{escapes}-%s.j2c")


def prepare() -> None:
    """Compile all templates before they are needed; called in a thread of its own, during verification."""
    for name in environment().list_templates(extensions=["j2"]):
        templates = _plain_text() if name.endswith(".txt.j2") else environment()
        templates.get_template(name)


def tables(template: str, **values: Any) -> dict[str, Rows]:
    """Return the tables of a template by their headings.

    A template writes a line "# heading", then rows "name | value"; a row without a value is omitted.
    """
    found: dict[str, Rows] = {}
    for line in _plain_text().get_template(template).render(**values).splitlines():
        name, _, value = (part.strip() for part in line.partition(" | "))
        if line.startswith("# "):
            rows = found[line[2:]] = []
        elif value:
            rows.append((name, value))
    return found


def paragraphs(template: str, macro: str, **values: Any) -> list[str]:
    """Return the paragraphs that a macro of a template writes, one string each."""
    text = str(getattr(_plain_text().get_template(template).module, macro)(**values))
    return [line for part in text.split("\n\n") if (line := re.sub("[ \n]+", " ", part).strip(" "))]


class Remark(NamedTuple):
    """A remark of a report."""

    id: str  # label of its section in remarks.md without "remark-", such as "dark"; empty in older reports
    text: str

    @property
    def topic(self) -> str:
        """Name of the section for `bstcad docs`; empty: there is none."""
        return self.id and f"remark-{self.id}"


def remarks(template: str, macro: str, **values: Any) -> list[Remark]:
    """Return the remarks that a macro of a template writes as paragraphs that begin with an id: "(dark) A part …"."""
    return [Remark(*text.removeprefix("(").split(") ", 1)) for text in paragraphs(template, macro, **values)]
