"""The first month of racks without a twin under `fantwin up`: what is learned, promised, found and falsely raised.

The cores of the stages are fed with the lines of the racks, as fast as they go; the learner makes its versions in
between, by the function of `fantwin learn`. Fans wear; their filter clogs and is changed; their firmware changes their
speeds; and they have faults, which are repaired after some hours.

    python -m bench.detection.first_month --racks 5 --days 30 --keep FOLDER
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.detection.plant import START_NS
from bench.detection.rack_scoring import Episode, episodes
from bench.detection.racks import (
    DAY_S,
    FAULT_KINDS,
    ON_AFTER_S,
    ON_BEFORE_S,
    RACK_FANS,
    SIZES,
    TACHOS,
    Racks,
    racks,
    reports,
)
from pipeline.cli.twins.next_version import make_next_version
from pipeline.config.loading import parse_config
from pipeline.config.models import Config
from pipeline.errors import UserError
from pipeline.learning.healthy_history import HealthyHistory
from pipeline.learning.ordinary_operation import OrdinaryOperation
from pipeline.learning.versions import TwinVersions, learning_folder
from pipeline.recordings.metadata import recording_metadata
from pipeline.runtime.stage import Context, Core, load_stage
from schemas.messages import Action, Alarm, Array, Header, Raw, Request, Score
from schemas.units import NS_PER_S
from simulation.faults import Fault
from stages.learner import LearnerCore

FAULTS_PER_WEEK = 2.0
"""of all racks together"""
REPAIRED_AFTER_S = 8 * 3600.0
FIRST_FAULT_DAY = 2.0
FILTER_PER_DAY, FILTER_CHANGED = 0.001, 0.4
"""share of the speed of all fans that a clogging filter takes a day, until it is changed: share of the time"""
WEAR_PER_DAY = 0.001
"""the same of the first fan of each second rack"""
FIRMWARE, FIRMWARE_FACTOR = 2.0 / 3.0, 1.04
"""from that share of the time on, all fans turn faster by this factor"""
NOTED_AFTER_D = 0.1
"""so many days after filter and firmware were changed, operators commission the fans again"""
USED_AFTER_D = 1.0
"""and so many days after a version was offered for it, they put it in force"""
AFTER_FAULT_S = 1800.0
"""an alarm that begins so soon after a fault of its fan belongs to it"""
DAY_NS = round(DAY_S * NS_PER_S)


def ageing(columns: int, days: float) -> Any:
    """The slow changes of the fans; see racks.Ageing."""
    wears = (np.arange(columns) % (2 * RACK_FANS)) == 0

    def factor(t_s: float) -> Array:
        day = t_s / DAY_S
        filter_days = day if day < FILTER_CHANGED * days else day - FILTER_CHANGED * days
        all_fans = (1.0 - FILTER_PER_DAY * filter_days) * (FIRMWARE_FACTOR if day >= FIRMWARE * days else 1.0)
        return all_fans * np.where(wears, 1.0 - WEAR_PER_DAY * day, 1.0)

    return factor


def month_faults(of: Racks) -> list[Fault]:
    """Kinds in turn, on fans and at times by chance; each begins while its fan is on, and no two of a rack together."""
    rng = np.random.default_rng([of.seed, 5])
    days = of.seconds / DAY_S
    count = round(FAULTS_PER_WEEK * max(0.0, days - FIRST_FAULT_DAY) / 7.0)
    starts_d = np.linspace(FIRST_FAULT_DAY, days - 0.5, count + 1)[:-1] if count else []
    found = []
    for number, start_d in enumerate(starts_d):
        column = int(rng.integers(of.columns))
        candidates_s = (start_d + rng.uniform(0.0, 0.5)) * DAY_S + np.arange(0.0, 7200.0)
        around_s = np.arange(-ON_BEFORE_S, ON_AFTER_S, 1.0)
        on = of.thermostat.is_on(candidates_s[:, np.newaxis] + around_s, column).all(axis=1)
        start_s = float(rng.choice(candidates_s[on]))
        kind = list(FAULT_KINDS)[number % len(FAULT_KINDS)]
        found.append(Fault(kind, column, start_s, start_s + REPAIRED_AFTER_S, SIZES.get(kind)))
    return found


class LearningAtOnce:
    """`fantwin learn` in this process: a version is there as soon as it is due."""

    def __init__(self, folder: Path, tray: str, per_day: float) -> None:
        self._of = folder, tray, per_day
        self._ended: str | None = None
        self.took_s: list[float] = []

    seconds = None
    is_free = True

    def start(self) -> str:
        """Make the next version."""
        began_s = time.process_time()
        try:
            make_next_version(*self._of, lambda _line: None)
            self._ended = ""
        except UserError as error:
            self._ended = str(error)
        self.took_s.append(time.process_time() - began_s)
        return ""

    def poll(self) -> str | None:
        """What went wrong, once."""
        ended, self._ended = self._ended, None
        return ended

    def stop(self) -> None:
        """It has ended already."""


@dataclass
class _Site:
    """One rack under `fantwin up`."""

    versions: TwinVersions
    learning: LearningAtOnce
    learner: LearnerCore
    stages: list[Core]
    sent: int = 0
    alarms: list[Alarm] = field(default_factory=list)
    judged_fan_s: Counter[int] = field(default_factory=Counter)
    """by day"""
    in_force: dict[int, str] = field(default_factory=dict)
    """the version at the end of each day"""
    problems: dict[str, int] = field(default_factory=dict)
    """what the learner reported, and the first day"""
    noted: list[float] = field(default_factory=list[float])
    """the days of changes that operators have not noted yet"""

    @classmethod
    def new(cls, folder: Path, name: str, days: float) -> _Site:
        config = _config(folder, name)
        contexts = {stage: _context(config, stage) for stage in ("resampler", "twin_integrator", "scorer", "learner")}
        of, tray = contexts["learner"], config.trays[0]
        place = learning_folder(config.run_folder, name)
        metadata, attachments = recording_metadata(of)
        hold_back_s, kept_s = 60.0 * of.config.hold_back_minutes, 3600.0 * of.config.kept_hours
        history = HealthyHistory(
            place, config.site, name, metadata, attachments, hold_back_s=hold_back_s, kept_s=kept_s
        )
        versions = TwinVersions(place, name)
        learning = LearningAtOnce(place, name, of.config.false_alarms_per_day)
        learner = LearnerCore(RACK_FANS, of.config, history, versions, OrdinaryOperation(tray), learning)
        chain = [load_stage(stage).build(contexts[stage]).core for stage in ("resampler", "twin_integrator", "scorer")]
        return cls(versions, learning, learner, chain, noted=[FILTER_CHANGED * days, FIRMWARE * days])

    def take(self, raw: Raw, tray: str) -> None:
        """The next lines."""
        if not len(raw.host_receive_t_ns):
            return
        now_ns = int(raw.host_receive_t_ns[-1])
        day = (now_ns - START_NS) // DAY_NS
        raw = replace(raw, header=Header("acquisition", self.sent, tray))
        self.sent += 1
        resampler, integrator, scorer = self.stages
        self.learner.step(raw)
        for grid in resampler.step(raw):
            for made in integrator.step(grid):
                for message in scorer.step(made):
                    self._see(message, day)
        for card in self.learner.tick(now_ns):
            integrator.step(card)
        self._operate((now_ns - START_NS) / DAY_NS, now_ns)
        in_force = self.versions.in_force()
        self.in_force[day] = in_force.name if in_force else ""
        if problem := self.learner.problem():
            self.problems.setdefault(problem, day)

    def _operate(self, day: float, now_ns: int) -> None:
        """What operators do about the changes that they made themselves."""
        if self.noted and day >= self.noted[0] + NOTED_AFTER_D:
            self.noted.pop(0)
            request = Request(t_ns=now_ns, action=Action.COMMISSION, header=Header("operator", len(self.noted), ""))
            self.learner.step(request)
            for message in self.stages[-1].step(request):
                self._see(message, int(day))
        offered = [each for each in self.versions.all()[-1:] if each.outcome == "offered"]
        for last in offered:
            is_old = last.made_t_ns < now_ns - USED_AFTER_D * DAY_NS
            if is_old and last.why.startswith("all fans") and last.since_t_ns != _since(self.versions):
                self.versions.use(last.name)

    def _see(self, message: object, day: int) -> None:
        if isinstance(message, Score):
            self.learner.step(message)
            self.judged_fan_s[day] += int(message.valid.sum()) * message.period_ns
        elif isinstance(message, Alarm):
            self.alarms.append(message)


def _since(versions: TwinVersions) -> int:
    in_force = versions.in_force()
    return in_force.since_t_ns if in_force else 0


def _config(folder: Path, tray: str) -> Config:
    windows = ", ".join(f'{{ kind = "count", window_s = {tacho.window_s} }}' for tacho in TACHOS)
    text = (
        f'site = "bench"\nrun_folder = "{folder / "runs"}"\n'
        f'[[tray]]\nname = "{tray}"\nfans = {RACK_FANS}\nspeed_unit = "rpm"\ntacho = [{windows}]\n'
        "[resampler]\nblock_size = 60\n"
    )
    return parse_config(text, folder / "fantwin.toml", (), ("resampler", "twin_integrator", "scorer", "learner"))


def _context(config: Config, stage: str) -> Context:
    return Context(
        site=config.site,
        trays=config.trays,
        config=config.sections[stage],
        folder=config.folder,
        run_folder=config.run_folder,
        started_t_ns=START_NS,
        configuration_text=config.text,
    )


def run(count: int, days: float, seed: int, rate_hz: float, folder: Path, console: Console) -> dict[str, Any]:
    """The month of so many racks."""
    of = racks(count, days * DAY_S, seed, fans_seed=seed)
    faults = month_faults(of)
    names = [f"rack{rack + 1}" for rack in range(count)]
    sites = [_Site.new(folder, name, days) for name in names]
    shown_day, began_s = -1, time.monotonic()
    for blocks in reports(of, rate_hz, faults, ageing=ageing(of.columns, days)):
        for site, name, raw in zip(sites, names, blocks, strict=True):
            site.take(raw, name)
        day = max(site.sent for site in sites) * 500 / rate_hz / DAY_S
        if int(day) > shown_day:
            shown_day = int(day)
            console.print(
                f"day {shown_day}, {time.monotonic() - began_s:.0f} s: {[s.in_force.get(shown_day) for s in sites]}"
            )
    return _found(sites, faults, days, time.monotonic() - began_s)


def _found(sites: Sequence[_Site], faults: Sequence[Fault], days: float, seconds: float) -> dict[str, Any]:
    by_day: list[dict[str, Any]] = []
    of_sites = [episodes(site.alarms) for site in sites]
    caught = {number: _caught(fault, of_sites) for number, fault in enumerate(faults)}
    own = {id(alarm) for alarms in caught.values() for alarm in alarms}
    for day in range(int(np.ceil(days))):
        first_ns, last_ns = START_NS + day * DAY_NS, START_NS + (day + 1) * DAY_NS
        raised = [each for alarms in of_sites for each in alarms if first_ns <= each.raised_ns < last_ns]
        promised, names = [], []
        for site in sites:
            version = next((v for v in site.versions.all() if v.name == site.in_force.get(day)), None)
            names.append(version.name if version else "")
            promised.append("none" if version is None else "target" if version.is_target else "declared")
        by_day.append(
            {
                "day": day,
                "fan_days_judged": sum(site.judged_fan_s[day] for site in sites) / NS_PER_S / DAY_S,
                "promised": Counter(promised),
                "in_force": names,
                "false_alarms": sum(id(each) not in own for each in raised),
                "alarms": len(raised),
            }
        )
    return {
        "by_day": by_day,
        "faults": [
            {
                "kind": fault.kind,
                "rack": fault.fan // RACK_FANS,
                "fan": fault.fan % RACK_FANS,
                "day": fault.start_s / DAY_S,
                "found_after_s": (caught[number][0].raised_ns - START_NS) / NS_PER_S - fault.start_s
                if caught[number]
                else None,
                "alarms": len(caught[number]),
            }
            for number, fault in enumerate(faults)
        ],
        "versions": [[version.model_dump() for version in site.versions.all()] for site in sites],
        "learned_from_faults": sum(_is_learned(fault, sites) for fault in faults),
        "false": [
            {"rack": rack, "day": (each.raised_ns - START_NS) / DAY_NS, **vars(each)}
            for rack, alarms in enumerate(of_sites)
            for each in alarms
            if id(each) not in own
        ],
        "learning_s": [site.learning.took_s for site in sites],
        "problems": [site.problems for site in sites],
        "seconds": seconds,
    }


def _caught(fault: Fault, of_sites: Sequence[list[Episode]]) -> list[Episode]:
    first_ns = START_NS + round(fault.start_s * NS_PER_S)
    last_ns = START_NS + round((fault.stop_s + AFTER_FAULT_S) * NS_PER_S)
    return [
        each
        for each in of_sites[fault.fan // RACK_FANS]
        if each.fan == fault.fan % RACK_FANS and first_ns <= each.raised_ns < last_ns
    ]


def _is_learned(fault: Fault, sites: Sequence[_Site]) -> bool:
    """Whether a version that took over was learned from more than a minute of a fault."""
    first_ns = START_NS + round((fault.start_s + 60.0) * NS_PER_S)
    last_ns = START_NS + round(fault.stop_s * NS_PER_S)
    taken = [v for v in sites[fault.fan // RACK_FANS].versions.all() if v.outcome == "taken"]
    return any(since < last_ns and until > first_ns for version in taken for since, until in version.periods)


def tables(found: dict[str, Any], console: Console) -> None:
    """Print what was found."""
    table = Table("day", "fan-days judged", "promise: none, target, declared", "false alarms", "all alarms", box=None)
    for row in found["by_day"]:
        promised = ", ".join(str(row["promised"].get(word, 0)) for word in ("none", "target", "declared"))
        table.add_row(
            str(row["day"]), f"{row['fan_days_judged']:.2f}", promised, str(row["false_alarms"]), str(row["alarms"])
        )
    console.print(table)
    faults = Table("fault", "rack, fan", "day", "found after", "alarms", box=None)
    for each in found["faults"]:
        after = each["found_after_s"]
        faults.add_row(
            each["kind"],
            f"{each['rack'] + 1}, {each['fan']}",
            f"{each['day']:.1f}",
            "not found" if after is None else f"{after:.1f} s",
            str(each["alarms"]),
        )
    console.print(faults)
    outcomes = Counter(f"{v['how']}, {v['outcome']}" for versions in found["versions"] for v in versions)
    console.print(f"versions: {dict(outcomes)}; faults that were learned: {found['learned_from_faults']}")
    took = [each for site in found["learning_s"] for each in site]
    if took:
        console.print(f"learning: {len(took)} times, {sum(took):.0f} s of one core, the longest {max(took):.0f} s")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--racks", type=int, default=5)
    parser.add_argument("--days", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=50)
    parser.add_argument("--report-hz", type=float, default=2.0)
    parser.add_argument("--keep", type=Path, required=True, help="folder for what is learned and the figures")
    given = parser.parse_args()
    console = Console(soft_wrap=True, highlight=False)
    given.keep.mkdir(parents=True, exist_ok=True)
    found = run(given.racks, given.days, given.seed, given.report_hz, given.keep, console)
    (given.keep / "found.json").write_text(json.dumps(found, indent=1))
    tables(found, console)


if __name__ == "__main__":
    main()
