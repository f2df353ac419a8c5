"""What an earlier report of the same folder knows, as far as it is what a report can show.

report.json may have been edited, cut short or made by somebody else: what does not fit is left out, nothing is believed
that the files themselves could tell.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from bstcad import files
from bstcad.report.record import ALL, ROWS, Contents, Judge, Making, Twins
from bstcad.report.vocabulary import LEFT_OUT
from bstcad.verify.verdict import VERDICTS

LARGEST = 20_000_000  # bytes; ten thousand evaluations fill one
LONGEST = 200  # characters of a name or a version

Fits = Callable[[Any], bool]


def making(path: Path) -> Making:
    """How a lens came about, by what fits of the report.json there; nothing of it if that is gone or damaged."""
    found = {key: value for key, value in _entries(path).items() if key in MAKING and MAKING[key](value)}
    return Making(**_records(found))


def contents(path: Path) -> Contents | None:
    """All that fits of the report.json there, if that is what a Report needs; else None."""
    old = _entries(path)
    if not all(fits(old.get(key, ...)) for key, fits in NEEDED.items()):
        return None
    more = {key: old[key] for key in ALL if key not in NEEDED and key in old and MORE[key](old[key])}
    rest = {"title": "", "stages": [], "history": [], "effects": {}, "machine": {}, "versions": {}, "seed": 0}
    return Contents.of({**rest, **more, **{key: old[key] for key in NEEDED}})


def tolerances(path: Path) -> dict[str, Any] | None:
    """The tolerance.json there, if all of it fits; else None."""
    found = _entries(path)
    return (
        found
        if {"inverse": None, "version": "", **found}.keys() == TOLERANCES.keys()
        and all(TOLERANCES[key](value) for key, value in found.items())
        else None
    )


def _entries(path: Path) -> dict[str, Any]:
    """The entries of a report.json; none if there are none to be had."""
    try:
        old = json.loads(files.contents(path, LARGEST).decode("utf-8"), parse_constant=int)  # NaN is no int: ValueError
    except (ValueError, RecursionError):
        return {}
    return old if isinstance(old, dict) else {}


def _records(found: dict[str, Any]) -> dict[str, Any]:
    """The same with rows as records."""
    rows = {key: tuple(kind(**row) for row in found[key]) for key, kind in ROWS.items() if key in found}
    return found | rows | ({"twins": Twins(**found["twins"])} if found.get("twins") else {})


def _number(least: float, most: float) -> Fits:
    return lambda value: isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def _text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST and value.isprintable()


def _record(**fields: Fits) -> Fits:
    def fits(value: Any) -> bool:
        return (
            isinstance(value, dict)
            and value.keys() == fields.keys()
            and all(fit(value[name]) for name, fit in fields.items())
        )

    return fits


def _each(fits: Fits, most: int) -> Fits:
    return lambda values: isinstance(values, list) and len(values) <= most and all(fits(value) for value in values)


def _scalar(value: Any) -> bool:
    return value is None or isinstance(value, bool) or _text(value) or _number(-1e12, 1e12)(value)


def _table(fits: Fits) -> Fits:
    """A short table from names to values that fit."""
    return lambda value: (
        isinstance(value, dict) and len(value) <= 100 and all(_text(key) and fits(part) for key, part in value.items())
    )


def _plain(value: Any) -> bool:
    return _scalar(value) or _table(_scalar)(value) or _each(_scalar, 1000)(value)


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


def _measured(value: Any) -> bool:
    return value is None or _flag(value) or _number(-1e300, 1e300)(value)


_seconds, _rrmsd = _number(0.0, 1e9), _number(1e-9, 1e3)
_older_stage = _record(name=_text, seconds=_seconds, rrmsd=lambda v: v is None or _rrmsd(v))
_stage = _record(
    name=_text, seconds=_seconds, rrmsd=lambda v: v is None or _rrmsd(v), cpu_seconds=lambda v: v is None or _seconds(v)
)
_part = _number(-1e-6, 1 + 1e-6)
NEEDED: dict[str, Fits] = {
    "name": _text,
    "verdict": lambda value: isinstance(value, str) and value in VERDICTS,
    "passed": _flag,
    "rrmsd": _rrmsd,
    "rrmsd_tent": _rrmsd,
    "rrmsd_noise": _number(0.0, 1e3),
    "light_on_target": _part,
    "efficiency": _part,
    "flux": _table(_part),
    "given_up": _each(lambda v: isinstance(v, str) and len(v) <= 1000 and v.isprintable(), 100),
    "checks": _each(_record(name=_text, value=_measured, limit=_measured, unit=_text, passed=_flag, where=_text), 1000),
    "prescription": lambda value: isinstance(value, dict),  # shown to nobody, and read by scripts alone
    "shape": _table(_measured),
    "seconds_total": _seconds,
}
MAKING: dict[str, Fits] = {
    "seconds_total": lambda v: isinstance(v, float) and _seconds(v),
    "stages": _each(lambda v: _stage(v) or _older_stage(v), 100),
    "history": _each(_record(seconds=_seconds, rrmsd=_rrmsd), 1_000_000),
    "machine": lambda v: (
        _table(_scalar)(v) and all(v[key] is None or _seconds(v[key]) for key in v if key.endswith("_gb"))
    ),
    "versions": _table(_text),
    "transport": _table(lambda v: v is not None and _scalar(v)),
    "skipped_steps": lambda v: isinstance(v, int) and _number(0, 1e12)(v),
    "stopped": _text,
    "twins": _record(
        control_points=_number(5, 2049),
        merit=_number(0.0, 1e12),
        gradient=_number(0.0, 1e12),
        evaluations=_number(0, 1e6),
        rrmsd_float64=_rrmsd,
        rrmsd_float32=_rrmsd,
        heights=_number(0.0, 1e9),
    ),
}
_share = _number(0.0, 1 + 1e-6)
_pair = _each(_number(0.0, 1e12), 2)
MORE: dict[str, Fits] = MAKING | {
    "title": _text,
    "effects": _table(_each(_text, 100)),
    "seed": _number(-1e18, 1e18),
    "version": _text,
    "leak": lambda v: v is None or _share(v),
    "contrast": lambda v: v is None or _number(0.0, 1e300)(v),
    "optic": lambda v: v in ("lens", "mirror"),
    "quality": _text,
    "rrmsd_asked": lambda v: v is None or _number(0.0, 1e12)(v),
    "rays_traced": _number(0, 1e15),
    "stability": _table(_measured),
    "estimates": _each(
        _record(
            kind=lambda v: isinstance(v, str) and v in LEFT_OUT,
            **dict.fromkeys(
                ("flux_change", "rrmsd_change", "blur_pixels"), lambda v: v is None or _number(-1e9, 1e9)(v)
            ),
            **dict.fromkeys(("detail", "simulate_by"), _text),
            assumed=_flag,
        ),
        100,
    ),
    "bounds": _record(
        asked=_table(_number(0.0, 1e12)),
        at=_table(_share),
        **dict.fromkeys(("rrmsd", "rrmsd_freed"), lambda v: v is None or _rrmsd(v)),
    ),
    "judges": _each(
        lambda v: isinstance(v, dict) and {"name", "version"} <= v.keys() <= {f.name for f in fields(Judge)}, 100
    ),  # shown to nobody, either
    # shown to nobody, and read by scripts alone
    **dict.fromkeys(("measured", "order"), lambda value: isinstance(value, dict)),
    "blur": _table(_number(0.0, 1e12)),
    "finest_detail": _record(
        **dict.fromkeys(("width", "source_image", "pixel", "distance"), _number(0.0, 1e12)),
        **dict.fromkeys(("nearer_distance", "nearer_width"), lambda v: v is None or _number(0.0, 1e12)(v)),
        of=_text,
        assumed=_flag,
    ),
    "lines": _each(_record(wavelength=_number(0.0, 1e9), share=_share, rrmsd=_rrmsd), 1000),
    "convergence": _table(lambda v: v is None or _number(0.0, 1e12)(v)),
    "remaining_error": _record(
        parts=_each(_record(name=_text, error=_share, pixels=_share), 100),
        octaves=_each(_record(frequency=_pair, period=_pair, error=_share), 100),
        outside=_number(-1e-6, 1 + 1e-6),
    ),
    "limits": _each(
        _record(
            by=_text,
            rrmsd=_share,
            figures=_table(_number(0.0, 1e12)),
            because=lambda v: isinstance(v, str) and len(v) <= 1000 and v.isprintable(),
        ),
        100,
    ),
}
_interval = _each(_share, 3)
_three = _record(**dict.fromkeys(("5 %", "50 %", "95 %"), _number(0.0, 1e6)))
_width = _number(1e-15, 1e6)
TOLERANCES: dict[str, Fits] = {
    "name": _text,
    "version": _text,  # which older ones have not
    "grade": _record(name=_text, words=_text),
    "seed": _number(0, 1e19),
    "tubes": _number(1, 1e6),
    "limit": _rrmsd,
    "rrmsd": _number(0.0, 1e3),
    **dict.fromkeys(("trials", "full_trials"), _number(1, 1e9)),
    **dict.fromkeys(("yield", "yield_full", "yield_adjusted"), lambda v: _interval(v) and len(v) == 3),
    **dict.fromkeys(("rrmsd_trials", "rrmsd_full", "rrmsd_adjusted"), _three),
    "model_off": _record(**dict.fromkeys(("median", "95 %"), _number(0.0, 1e9))),
    "sensitivities": _each(
        _record(
            **dict.fromkeys(("name", "words", "unit"), _text),
            **dict.fromkeys(("limit", "cost", "sigma"), _width),
            distribution=lambda v: v in ("normal", "uniform", "field"),
            rrmsd_change=_number(-1e6, 1e6),
            share=_share,
        ),
        1000,
    ),
    "worst": _each(
        _record(number=_number(0, 1e9), rrmsd=_number(0.0, 1e6), amounts=_table(_number(-1e9, 1e9))),
        100,
    ),
    "inverse": _record(wanted=_share, **{"yield": lambda v: _interval(v) and len(v) == 3}, limits=_table(_width)),
}
