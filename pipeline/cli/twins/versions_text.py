"""The versions of a learned twin, for people."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.learning.versions import Drop, Period, Version
from pipeline.recordings.dates import format_local


def version_lines(versions: Sequence[Version], in_force: str, faulty: Sequence[Period]) -> list[str]:
    """Some lines for each version, and one for each period that is called faulty."""
    lines: list[str] = []
    for version in versions:
        lines += _lines(version, is_in_force=version.name == in_force)
    return [*lines, *(f"called faulty: {format_local(first)} to {format_local(last)}" for first, last in faulty)]


def _lines(version: Version, *, is_in_force: bool) -> list[str]:
    state = "IN FORCE" if is_in_force else version.outcome
    unit = version.speed_unit
    made = f"made from {version.hours:.3g} h up to {format_local(version.made_t_ns)}"
    rate = f"{version.declared_per_day:g} false alarm{'s' * (version.declared_per_day != 1)} per fan and day"
    promise = f"target {rate}, which so few data cannot show" if version.is_target else f"declared {rate}"
    change = ", ".join(f"{100 * each:+.1f} %" for each in version.change)
    return [
        f"{version.name}: {state}: {version.how}, {made}",
        f"  why: {version.why}",
        f"  error {version.error:.3g} {unit}; {promise}",
        *(f"  found at {drop.speed:,.0f} {unit}: {_found(drop, unit)}" for drop in version.drops),
        f"  speed of the fans beside {version.reference}: {change}",
    ]


def _found(drop: Drop, unit: str) -> str:
    if drop.within_a_minute is None:
        return "no drop, not even standstill"
    within = f"a drop of {drop.within_a_minute:,.0f} {unit} within a minute"
    return within if drop.at_once is None else f"a drop of {drop.at_once:,.0f} {unit} at once, {within[10:]}"
