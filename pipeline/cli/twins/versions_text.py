"""The versions of a learned twin, for people."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.learning.versions import Drop, Period, Version
from pipeline.recordings.dates import format_local


def version_lines(versions: Sequence[Version], in_force: str, faulty: Sequence[Period]) -> list[str]:
    """A line for each version, more for the newest and for the one in force, and one for each faulty period."""
    lines: list[str] = []
    for version in versions:
        of_version = _lines(version, is_in_force=version.name == in_force)
        lines += of_version if version.name == in_force or version is versions[-1] else of_version[:1]
    return [*lines, *(f"marked as faulty: {format_local(first)} to {format_local(last)}" for first, last in faulty)]


def _lines(version: Version, *, is_in_force: bool) -> list[str]:
    state = "IN FORCE" if is_in_force else "offered" if version.outcome == "offered" else "not in force"
    unit = version.speed_unit
    made = f"limits from {version.hours:.3g} h up to {format_local(version.made_t_ns)}"
    rate = f"{version.declared_per_day:g} false alarm{'s' * (version.declared_per_day != 1)} per fan and day"
    declared = f"target {rate}; too little data to support it" if version.is_target else f"declared {rate}"
    change = ", ".join(f"{100 * each:+.1f} %" for each in version.change)
    return [
        f"{version.name}: {state}: {version.how}; {made}",
        f"  why: {version.why}",
        f"  error {version.error:.3g} {unit}; {declared}",
        *(f"  found at {drop.speed:,.0f} {unit}: {_found(drop, unit)}" for drop in version.drops),
        f"  speed of the fans relative to {version.reference}: {change}",
    ]


def _found(drop: Drop, unit: str) -> str:
    if drop.within_a_minute is None:
        return "no drop, not even standstill"
    within = f"a drop of {drop.within_a_minute:,.0f} {unit} within a minute"
    return within if drop.at_once is None else f"a drop of {drop.at_once:,.0f} {unit} at once, {within[10:]}"
