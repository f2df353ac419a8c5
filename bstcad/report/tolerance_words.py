"""What tolerance.json says, in words: the yield first, then what does the harm and what buys it back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from bstcad.report.units import about, number, percent, quantity

Facts = Mapping[str, Any]
LOOSE = 0.1, 0.03  # 95 % and median of the model against full traces, beyond which the full traces' yield counts
LITTLE = 1e-3  # of what all errors add: those that add less are listed apart
WIDEST = 10.0  # times its width, up to which the search for the loosest tolerances lets an error go
ROUNDING = 1e-9  # of a width
MOST = 3  # errors that are named of a trial
DISTRIBUTIONS = {
    "normal": "normal",
    "uniform": "uniform",
    "field": "random field",
}


def trusted(facts: Facts) -> bool:
    """Do superposed pictures stand up to the full traces?"""
    off = facts["model_off"]
    return off["95 %"] <= LOOSE[0] and off["median"] <= LOOSE[1]


def verdict(facts: Facts) -> str:
    """The yield, in a sentence."""
    by_model = trusted(facts)
    found, count = (facts["yield"], facts["trials"]) if by_model else (facts["yield_full"], facts["full_trials"])
    low, likely, high = (100 * part for part in found)
    return (
        f"{likely:.1f} % of lenses made so keep to an RRMSD of {number(facts['limit'])} (95 % interval: {low:.1f} to "
        f"{high:.1f} %, from {number(count)} trials by {'superposed pictures' if by_model else 'full traces'})."
    )


def outcome(facts: Facts) -> tuple[str, str]:
    """(sign and word, style of the page) beside that sentence; without a yield that is wanted there is none to keep."""
    wanted = facts.get("inverse", {}).get("wanted")
    low, likely, high = facts["yield"] if trusted(facts) else facts["yield_full"]
    if wanted is None:
        return f"YIELD {percent(likely)}", "plain"
    if low <= wanted <= high:
        return f"≈ ABOUT THE {100 * wanted:g} % WANTED", "remarks"
    if low > wanted:
        return f"✓ OVER THE {100 * wanted:g} % WANTED", "pass"
    return f"✗ UNDER THE {100 * wanted:g} % WANTED", "fail"


def spread(facts: Facts) -> str:
    """RRMSD of the design and of the trials."""
    found = facts["rrmsd_trials"]
    return (
        f"RRMSD as designed: {facts['rrmsd']:.4f}; of {facts['trials']} trials: {found['50 %']:.4f} "
        f"({found['5 %']:.4f} to {found['95 %']:.4f} in nine of ten)"
    )


def agreement(facts: Facts) -> str:
    """How well superposed pictures stand up to full traces."""
    off = facts["model_off"]
    return (
        f"Superposed pictures against full traces: within {percent(off['median'])} (median), "
        f"{percent(off['95 %'])} (95 of 100)"
        + ("" if trusted(facts) else "; these errors are too large for them: trust the full traces")
    )


def sentences(facts: Facts) -> list[str]:
    """All of it for a terminal."""
    found = [
        spread(facts),
        f"Yield, RRMSD up to {facts['limit']:g}: {share(facts['yield'])} of {facts['trials']} trials by superposed "
        f"pictures, {share(facts['yield_full'])} of {facts['full_trials']} full traces",
        f"With the screen shifted, focused, tilted and turned to fit: {share(facts['yield_adjusted'])}",
        agreement(facts),
    ]
    if inverse := facts.get("inverse"):
        found.append(f"The loosest tolerances for a yield of {100 * inverse['wanted']:g} %: {share(inverse['yield'])}")
        if count := len(capped(facts)):
            found.append(
                f"≥: {count} of {len(inverse['limits'])} errors hardly matter; the search for their loosest tolerances "
                f"ends at {WIDEST:g} times ±"
            )
    return found


def yields(facts: Facts) -> list[tuple[str, str, str, str]]:
    """(how, of how many trials, yield with its interval, median RRMSD) of each way to come to a yield."""
    trials, full = number(facts["trials"]), number(facts["full_trials"])
    rows = [
        ("As made and mounted, by superposed pictures", trials, facts["yield"], facts["rrmsd_trials"]),
        ("The first of these by full traces", full, facts["yield_full"], facts["rrmsd_full"]),
        (
            "The same with the screen shifted, focused, tilted and turned to fit, by superposed pictures",
            full, facts["yield_adjusted"], facts["rrmsd_adjusted"],
        ),
    ]  # fmt: skip
    found = [(how, count, share(part), f"{rrmsd['50 %']:.4f}") for how, count, part, rrmsd in rows]
    if inverse := facts.get("inverse"):
        how = "With the loosest tolerances below, by superposed pictures, other trials"
        found.append((how, trials, share(inverse["yield"]), ""))
    return found


def errors(facts: Facts) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """(those that matter, the others), each as words, width, distribution, change, share, part, loosest."""
    limits = facts.get("inverse", {}).get("limits", {})
    groups: dict[str, list[Facts]] = {}  # the fields that a form error is mixed of are one error
    for item in facts["sensitivities"]:
        name = item["name"].rpartition("_")[0] if item["distribution"] == "field" else item["name"]
        groups.setdefault(name, []).append(item)
    every = [
        _error(items, [limits[item["name"]] for item in items if item["name"] in limits]) for items in groups.values()
    ]
    every.sort(key=lambda one: -one["part"])
    return [one for one in every if one["part"] >= LITTLE], [one for one in every if one["part"] < LITTLE]


def _error(items: Sequence[Facts], loosest: Sequence[float]) -> dict[str, Any]:
    """One error, of its parts; what they change adds up, and their widths do as squares."""
    first, part = items[0], math.fsum(item["share"] for item in items)
    words, change = first["words"].partition(" (draw")[0], math.fsum(item["rrmsd_change"] for item in items)
    return {
        "words": words[:1].upper() + words[1:],
        "width": amount(math.hypot(*(item["limit"] for item in items)), first["unit"]),
        "distribution": DISTRIBUTIONS[first["distribution"]],
        "change": changed(change),
        "share": part_of(part),
        "part": part,
        "loosest": amount(math.hypot(*loosest), first["unit"]) if loosest else "",
    }


def changed(change: float) -> str:
    """A change of RRMSD, signed, to two significant digits."""
    return f"{'+' if change > 0 else ''}{about(change)}"


def part_of(part: float) -> str:
    """A part of 1 in percent; less than half a millionth is nothing."""
    return percent(round(part, 6)) if part >= 5e-7 else "0 %"


def capped(facts: Facts) -> list[str]:
    """The errors, by name, whose loosest tolerance is the widest that the search tries."""
    widths = {item["name"]: item["limit"] for item in facts["sensitivities"]}
    loosest = facts.get("inverse", {}).get("limits", {})
    return [name for name, limit in loosest.items() if limit >= (1 - ROUNDING) * WIDEST * widths[name]]


def trial(facts: Facts, worst: Facts) -> str:
    """What was most off in a trial, by what it adds to the picture."""
    known = {item["name"]: item for item in facts["sensitivities"]}
    added = {
        name: abs(off / known[name]["sigma"]) * math.sqrt(known[name]["share"])
        for name, off in worst["amounts"].items()
        if name in known
    }
    first = sorted(added, key=added.__getitem__, reverse=True)[:MOST]
    return "; ".join(
        f"{known[name]['words']} {amount(worst['amounts'][name], known[name]['unit'], signed=True)}" for name in first
    )


def share(interval: Sequence[float]) -> str:
    """A yield with its interval."""
    low, likely, high = (100 * part for part in interval)
    return f"{likely:.1f} % ({low:.1f} to {high:.1f} %)"


def amount(value: float, unit: str, signed: bool = False) -> str:
    """So much of an error, in the unit that suits its size: "mm RMS", "deg", "nm" …"""
    length, _, kind = unit.partition(" ")
    said = quantity(value, length) if length in ("mm", "deg") else f"{number(value)} {unit}".strip()
    said = f"{said} {kind}".strip() if length == "mm" else said
    return f"+{said}" if signed and value > 0 else said
