"""The versions of a learned twin, for people and for machines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from fantwin.pipeline.learning.versions import Check, Drop, Version, VersionList
from fantwin.pipeline.recordings.dates import format_local

NO_REFERENCE = (
    "no version was learned from 24 h of healthy running yet: there is no reference to check the fans against"
)


def list_lines(listed: VersionList) -> list[str]:
    """A line for each version, more for the newest and for the one in force; an offer beside the one in force; faulty
    time spans; and the last check."""
    lines: list[str] = []
    for version in listed.versions:
        of_version = version_lines(version, listed)
        lines += of_version if version in (listed.current, listed.versions[-1]) else of_version[:1]
    marked = (f"marked as faulty: {format_local(first)} to {format_local(last)}" for first, last in listed.faulty)
    return [*lines, *offer_lines(listed), *marked, *([check_line(listed.check)] if listed.check else [])]


def list_as_json(listed: VersionList) -> dict[str, Any]:
    """The list. What has no reference yet names none."""
    return {
        **listed.model_dump(),
        "versions": [version_as_json(version, listed) for version in listed.versions],
        "check": listed.check and check_as_json(listed.check),
    }


def version_as_json(version: Version, listed: VersionList) -> dict[str, Any]:
    """One version of the list."""
    reference = listed.reference_of(version)
    return {**version.model_dump(), "reference": reference and reference.name}


def check_as_json(check: Check) -> dict[str, Any]:
    """A check of the fans."""
    return {**check.model_dump(), "reference": check.reference or None}


def check_line(check: Check) -> str:
    """What the last check of the fans found."""
    if not check.reference:
        return NO_REFERENCE
    changes = _percents(check.change)
    missing = _not_compared(check.change, check.reference)
    return f"checked up to {format_local(check.t_ns)}: speed of the fans since {check.reference}: {changes}{missing}"


def version_lines(version: Version, listed: VersionList) -> list[str]:
    """Lines about one version of the list."""
    not_used = "was offered" if version.outcome == "offered" else "not in force"
    not_used = "offered" if version == listed.waiting else not_used
    state = "IN FORCE" if version.name == listed.in_force else not_used
    unit = version.speed_unit
    return [
        f"{version.name}: {state}: {version.how}; {_limits_from(version)}",
        f"  why: {version.why}",
        f"  error {version.error:.3g} {unit}; {version.rate_text}",
        *(f"  found at {drop.speed:,.0f} {unit}: {_found(drop, unit)}" for drop in version.drops),
        f"  speed of the fans relative to the prediction of {version.reference}: {_percents(version.change)}",
    ]


def _limits_from(version: Version) -> str:
    return f"limits from {version.hours:.3g} h up to {format_local(version.made_t_ns)}"


def offer_lines(listed: VersionList) -> list[str]:
    """The version in force beside one that is offered, if there is one: which fits the fans as they are now?"""
    now, offered = listed.current, listed.waiting
    if now is None or offered is None:
        return []
    unit = offered.speed_unit
    error_before = "unknown" if offered.error_before is None else f"{offered.error_before:.3g} {unit}"
    rows = [
        ("", f"{now.name}, in force", f"{offered.name}, offered"),
        ("learned up to", format_local(now.made_t_ns), format_local(offered.made_t_ns)),
        ("error over the newest recording", error_before, f"{offered.error:.3g} {unit}"),
        ("limits from", f"{now.hours:.3g} h", f"{offered.hours:.3g} h"),
        *(_drops_beside(before, after, unit) for before, after in zip(now.drops, offered.drops, strict=False)),
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    return ["", *("  " + "   ".join(map(str.ljust, row, widths)).rstrip() for row in rows), ""]


def _drops_beside(before: Drop, after: Drop, unit: str) -> tuple[str, str, str]:
    return "drop found within a minute", _drop_of(before, unit), _drop_of(after, unit)


def _drop_of(drop: Drop, unit: str) -> str:
    found = "none" if drop.within_a_minute is None else f"{drop.within_a_minute:,.0f}"
    return f"{found} of {drop.speed:,.0f} {unit}"


def _percents(change: Iterable[float | None]) -> str:
    return ", ".join("not comparable" if each is None else f"{100 * each:+.1f} %" for each in change)


def _not_compared(change: Sequence[float | None], reference: str) -> str:
    """Which fans a check says nothing about, and why; empty if none."""
    fans = [fan for fan, each in enumerate(change) if each is None]
    if not fans:
        return ""
    named = f"fan{'s' * (len(fans) > 1)} {', '.join(map(str, fans))}"
    return f"; {named}: too few readings at commands that {reference} was trained on"


def _found(drop: Drop, unit: str) -> str:
    if drop.within_a_minute is None:
        return "no drop, not even standstill"
    within = f"a drop of {drop.within_a_minute:,.0f} {unit} within a minute"
    return within if drop.at_once is None else f"a drop of {drop.at_once:,.0f} {unit} at once, {within[10:]}"
