"""Runs the scenarios of a self-test on scratch sites, and checks how each site stops and what it has recorded."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.selftest.scenarios import SMALL_DISK_BYTES, Scenario
from fantwin.pipeline.selftest.scratch_site import NotKept, ScratchSite
from fantwin.pipeline.sources.simulated.device import Device

LOST = 3
"""exit code where all is in order but what was lost, as the last messages of a killed acquisition may be"""
VERIFY_LIMIT_S = 1800.0
"""a soak of half an hour takes two minutes of CPU"""


@dataclass(frozen=True)
class Row:
    """One row of the result; `kept` is None where the scenario cannot run here."""

    name: str
    promise: str
    seen: str
    kept: bool | None


def run_scenarios(folder: Path, scenarios: Sequence[Scenario], device: Callable[[], Device]) -> Iterator[Row]:
    """Run them in order, those first that share a site; yields each row when it is known. device: makes the tray of a
    site."""
    shared = [scenario for scenario in scenarios if not scenario.needs_own_site]
    groups = [*([shared] if shared else []), *([each] for each in scenarios if each.needs_own_site)]
    for number, group in enumerate(groups, start=1):
        place = folder / f"site-{number}"
        (place / "runs").mkdir(parents=True)
        with small_disk(place / "runs", any(scenario.needs_small_disk for scenario in group)) as is_there:
            if not is_there:
                yield Row(group[0].name, group[0].promise, "not run: only root may mount a small disk", kept=None)
                continue
            with ScratchSite(place, device()) as site:
                for scenario in group:
                    yield run_scenario(site, scenario)
                yield account(site, ", ".join(scenario.name for scenario in group))


@contextmanager
def small_disk(place: Path, is_needed: bool) -> Iterator[bool]:
    """Mount a small disk at `place` if it is needed; yields False if it is needed and cannot be mounted."""
    if not is_needed:
        yield True
        return
    words = ["mount", "-t", "tmpfs", "-o", f"size={SMALL_DISK_BYTES}", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(words, capture_output=True, check=False).returncode:
        yield False
        return
    try:
        yield True
    finally:
        subprocess.run(["umount", "-l", str(place)], capture_output=True, check=False)


def run_scenario(site: ScratchSite, scenario: Scenario) -> Row:
    """Run one scenario on a running site; afterwards all fans must be judged again, without a new alarm."""

    def seen() -> str:
        alarms = len(site.raised)
        found = scenario.run(site)
        try:
            site.seconds_until_judged()
        except NotKept as result:
            raise NotKept(f"{found}; but {result}") from result
        if len(site.raised) > alarms:
            raise NotKept(f"{found}; but {len(site.raised) - alarms} healthy fans raised an alarm")
        return found

    return _row(scenario.name, scenario.promise, seen)


def account(site: ScratchSite, names: str) -> Row:
    """Stop the site and verify its recording. names: of the scenarios that ran on it."""
    promise = "it stops in order, and its recording replays to the same decisions"
    return _row(f"shutdown after {names}", promise, lambda: _accounted(site))


def _row(name: str, promise: str, seen: Callable[[], str]) -> Row:
    try:
        return Row(name, promise, seen(), kept=True)
    except NotKept as result:
        return Row(name, promise, str(result), kept=False)


def _accounted(site: ScratchSite) -> str:
    status, outcome = site.stop()
    if status not in (0, LOST):
        raise NotKept(f"exit code {status}: {site.last_line()}")
    try:
        verified = site.command("replay", "--offline", "--verify", *site.recordings(), limit_s=VERIFY_LIMIT_S)
    except subprocess.TimeoutExpired as error:
        raise NotKept(f"the recording was not verified within {VERIFY_LIMIT_S:.0f} s") from error
    lines = (verified.stdout.strip() or verified.stderr.strip()).splitlines()
    compared = [line.strip() for line in lines if line.startswith(("equal:", "not comparable:"))] or lines[-1:]
    lost = ", ".join(f"{stage} {count}" for stage, count in outcome["lost"].items() if count)
    seen = f"lost: {lost or 'nothing'}; {' '.join(compared)}"
    if verified.returncode not in (0, LOST):
        raise NotKept(seen)
    return seen
