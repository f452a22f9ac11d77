"""One rack under `fantwin up` without a twin: the cores of its stages, what it learns, and what its operators do.

The learner makes its versions by the function of `fantwin twins learn`, while no sample comes. After each day all is
kept, so that a month that was interrupted goes on from there: for the rack it is a restart of its site.
"""

from __future__ import annotations

import pickle
import shutil
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from bench.detection.plant import START_NS
from bench.detection.rack_scoring import Episode, episodes
from bench.detection.racks import DAY_S, RACK_FANS, TACHOS
from bench.stage_context import stage_context
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.healthy_history import HealthyHistory
from fantwin.pipeline.learning.learner_core import LearnerCore
from fantwin.pipeline.learning.learning_schedule import LearningProcess
from fantwin.pipeline.learning.next_version import make_next_version
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.versions import DECLARED_PER_DAY, TwinVersions, Version, learning_folder
from fantwin.pipeline.recordings.metadata import recording_metadata
from fantwin.pipeline.runtime.stage import Core, load_stage
from fantwin.schemas.blocks import select
from fantwin.schemas.enums import Action
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Raw, Request, Score
from fantwin.schemas.units import NS_PER_S

NOTED_AFTER_D = 0.1
"""so many days after a change that they made themselves, operators commission the fans again"""
USED_AFTER_D = 1.0
"""and so many days after a version was offered for it, they put it in force"""
DAY_NS = round(DAY_S * NS_PER_S)
SEEN = "seen.pickle"
PIECE = 120
"""lines that the stages take at a time: scores must not lag behind the lines by minutes"""


@dataclass
class RackMonth:
    """What became of one rack, up to the end of a day."""

    days: int = 0
    alarms: list[Episode] = field(default_factory=list[Episode])
    judged_fan_days: dict[int, float] = field(default_factory=dict[int, float])
    """by day"""
    in_force: dict[int, str] = field(default_factory=dict[int, str])
    """the version at the end of each day"""
    versions: list[Version] = field(default_factory=list[Version])
    problems: dict[str, int] = field(default_factory=dict[str, int])
    """what the learner reported, and the first day"""
    learning_s: list[float] = field(default_factory=list[float])
    """of the processor, for each version and check"""

    def write(self, path: Path) -> None:
        """Write it to a file."""
        unfinished = path.with_suffix(".part")
        unfinished.write_bytes(_MONTH.dump_json(self))
        unfinished.replace(path)

    @classmethod
    def read(cls, path: Path) -> RackMonth:
        """Read what `write` wrote."""
        return _MONTH.validate_json(path.read_bytes())


_MONTH = TypeAdapter(RackMonth)


class LearningAtOnce(LearningProcess):
    """`fantwin twins learn` in this process: a version is there as soon as it is due."""

    def __init__(self, folder: Path, tray: str, per_day: float, took_s: list[float]) -> None:
        """took_s: what each version takes is added to it."""
        self._of = folder, tray, per_day
        self._ended: str | None = None
        self._took_s = took_s

    @property
    def seconds(self) -> float | None:
        """None: nothing is under way."""
        return None

    @property
    def is_free(self) -> bool:
        """Always."""
        return True

    def start(self, *, only_if_changed: bool) -> str:
        """Make the next version."""
        began_s = time.process_time()
        try:
            make_next_version(*self._of, lambda _line: None, only_if_changed=only_if_changed)
            self._ended = ""
        except UserError as error:
            self._ended = str(error)
        self._took_s.append(time.process_time() - began_s)
        return ""

    def poll(self) -> str | None:
        """What went wrong, once."""
        ended, self._ended = self._ended, None
        return ended

    def stop(self) -> None:
        """It has ended already."""


@dataclass
class _Seen:
    """What was seen of a rack so far."""

    not_noted: list[float]
    """days of changes that operators have not noted yet"""
    days: int = 0
    """that are over"""
    sent: int = 0
    alarms: list[Alarm] = field(default_factory=list[Alarm])
    judged_fan_ns: Counter[int] = field(default_factory=Counter[int])
    in_force: dict[int, str] = field(default_factory=dict[int, str])
    problems: dict[str, int] = field(default_factory=dict[str, int])
    learning_s: list[float] = field(default_factory=list[float])


class RackSite:
    """The stages of one rack."""

    def __init__(self, folder: Path, name: str, changed_days: Sequence[float]) -> None:
        """changed_days: when operators change all fans, as a filter or firmware does."""
        place = folder / name
        shutil.rmtree(place, ignore_errors=True)
        if (kept := folder / f"{name}.kept").exists():
            shutil.copytree(kept, place)
        config = _config(place, name)
        contexts = {
            stage: stage_context(config, stage) for stage in ("resampler", "twin_integrator", "scorer", "learner")
        }
        of, tray = contexts["learner"], config.trays[0]
        learned = learning_folder(config.run_folder, name)
        metadata, attachments = recording_metadata(of)
        history = HealthyHistory(learned, config.site, name, metadata, attachments)
        self._name = name
        self._versions = TwinVersions(learned, name)
        self._seen = pickle.loads((place / SEEN).read_bytes()) if kept.exists() else _Seen(list(changed_days))
        learning = LearningAtOnce(learned, name, DECLARED_PER_DAY, self._seen.learning_s)
        self._learner = LearnerCore(RACK_FANS, history, self._versions, OrdinaryOperation(tray), learning)
        self._stages: list[Core] = [
            load_stage(stage).build(contexts[stage]).core for stage in ("resampler", "twin_integrator", "scorer")
        ]

    def live(self, blocks: Iterable[Raw], folder: Path) -> None:
        """Take the lines of the days that are not there yet; keep the site and what became of it after each."""
        for raw in blocks:
            if not len(raw.host_receive_t_ns):
                continue
            day = (int(raw.host_receive_t_ns[-1]) - START_NS) // DAY_NS
            if day > self._seen.days:
                self._keep(day, folder)
            if day == self._seen.days:
                for first in range(0, len(raw.host_receive_t_ns), PIECE):
                    self._take(select(raw, np.arange(first, min(first + PIECE, len(raw.host_receive_t_ns)))), day)
        self._keep(self._seen.days + 1, folder)

    def _keep(self, days: int, folder: Path) -> None:
        self._seen.days = days
        self._month().write(folder / f"{self._name}.json")
        unfinished = folder / f"{self._name}.part"
        shutil.rmtree(unfinished, ignore_errors=True)
        shutil.copytree(folder / self._name, unfinished)
        (unfinished / SEEN).write_bytes(pickle.dumps(self._seen))
        shutil.rmtree(kept := folder / f"{self._name}.kept", ignore_errors=True)
        unfinished.rename(kept)

    def _month(self) -> RackMonth:
        seen = self._seen
        return RackMonth(
            days=seen.days,
            alarms=episodes(seen.alarms),
            judged_fan_days={day: ns / DAY_NS for day, ns in seen.judged_fan_ns.items()},
            in_force=seen.in_force,
            versions=list(self._versions.all()),
            problems=seen.problems,
            learning_s=seen.learning_s,
        )

    def _take(self, raw: Raw, day: int) -> None:
        """The next lines."""
        now_ns = int(raw.host_receive_t_ns[-1])
        raw = replace(raw, header=Header("acquisition", self._seen.sent, self._name))
        self._seen.sent += 1
        resampler, integrator, scorer = self._stages
        self._learner.step(raw)
        for grid in resampler.step(raw):
            for made in integrator.step(grid):
                for message in scorer.step(made):
                    self._see(message, day)
        for card in self._learner.tick(now_ns):
            integrator.step(card)
        self._operate((now_ns - START_NS) / DAY_NS, now_ns)
        in_force = self._versions.in_force()
        self._seen.in_force[day] = in_force.name if in_force else ""
        if problem := self._learner.problem():
            self._seen.problems.setdefault(problem, day)

    def _operate(self, day: float, now_ns: int) -> None:
        """What operators do about the changes that they made themselves."""
        if self._seen.not_noted and day >= self._seen.not_noted[0] + NOTED_AFTER_D:
            self._seen.not_noted.pop(0)
            header = Header("operator", self._seen.sent, "")  # rising: a scorer ignores a request that comes again
            request = Request(t_ns=now_ns, action=Action.COMMISSION, header=header)
            self._learner.step(request)
            for message in self._stages[-1].step(request):
                self._see(message, int(day))
        offered = [each for each in self._versions.all()[-1:] if each.outcome == "offered"]
        in_force = self._versions.in_force()
        for last in offered:
            is_old = last.made_t_ns < now_ns - USED_AFTER_D * DAY_NS
            is_used = in_force is not None and last.since_t_ns == in_force.since_t_ns
            if is_old and "if maintenance" in last.why and not is_used:
                self._versions.use(last.name)

    def _see(self, message: object, day: int) -> None:
        if isinstance(message, Score):
            self._learner.step(message)
            self._seen.judged_fan_ns[day] += int(message.valid.sum()) * message.period_ns
        elif isinstance(message, Alarm):
            self._seen.alarms.append(message)


def _config(folder: Path, tray: str) -> Config:
    windows = ", ".join(f'{{ kind = "count", window_s = {tacho.window_s} }}' for tacho in TACHOS)
    text = (
        f'site = "bench"\nrun_folder = "{folder / "runs"}"\n'
        f'[[tray]]\nname = "{tray}"\nfans = {RACK_FANS}\nspeed_unit = "rpm"\ntacho = [{windows}]\n'
    )
    return parse_config(text, folder / "fantwin.toml", (), ("resampler", "twin_integrator", "scorer", "learner"))
