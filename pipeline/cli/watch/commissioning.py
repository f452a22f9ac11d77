"""The steps of `fantwin commission`: what is recorded for each tray, and the twin that is made of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from fantwin.pipeline.cli.watch.child_commands import RECORDING_ONLY, Commands, RecordingSite, Stopped
from fantwin.pipeline.config.loading import write_twin
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.training_data import Part, read_training_data
from fantwin.pipeline.replay.offline.healthy_runs import in_this_process

SHOWN_EVERY_S = 60.0


@dataclass(frozen=True)
class Plan:
    """How the fans of all trays are moved, and for how long they are recorded."""

    sweep: list[str] | None
    """the options of each sweep but for tray and rounds; None: the plant moves the fans"""
    rounds: int
    """of the first sweep of each tray"""
    operation_s: float
    """length of a recording of ordinary operation"""
    at_most_s: float
    """how long to wait at most for the plant to move the fans"""
    false_alarms_per_day: float


@dataclass
class TrayWork:
    """A tray, and what has been done for it."""

    tray: TrayConfig
    twin: Path
    """to write"""
    training: list[Path] = field(default_factory=list)
    """the parts of a recording"""
    validation: list[Path] = field(default_factory=list)
    """the same; it sets the band, and with `operation` the limits"""
    operation: list[Path] = field(default_factory=list)
    held: list[str] = field(default_factory=list)
    """fans that hardly moved while the data for their limits were recorded"""
    entry: str = ""
    """the twin, as the configuration names it now; empty: it does not yet"""
    failure: str = ""
    """why it gets no twin"""

    @property
    def name(self) -> str:
        """The name of the tray."""
        return self.tray.name


class Commissioning:
    """The steps, and what was recorded in them."""

    def __init__(
        self, settings: Config, configured: list[str], commands: Commands, works: Sequence[TrayWork], plan: Plan
    ) -> None:
        """configured: the words that give a command this configuration. works: one for each tray that gets a twin."""
        self._settings = settings
        self._configured = configured
        self._commands = commands
        self._works = works
        self._plan = plan
        self.recordings: list[Path] = []
        self.lost: dict[str, int] = {}
        """while recording, by stage"""

    @property
    def left(self) -> list[TrayWork]:
        """Those that have not failed."""
        return [work for work in self._works if not work.failure]

    @property
    def recorded(self) -> str:
        """The recordings, for people; empty if there is none."""
        return ", ".join(map(str, self.recordings))

    @property
    def failures(self) -> str:
        """The trays that have failed, and why, in one line; empty if none has."""
        return "; ".join(f"tray {work.name} failed: {work.failure}" for work in self._works if work.failure)

    def run(self) -> None:
        """Make a calibrated twin for each tray, and write it into the configuration.

        A tray that fails is left out of the later steps.

        Raises:
            Stopped: the user wants to stop.
            UserError: recording failed, or every tray has.
        """
        some = self._works if len(self._works) < len(self._settings.trays) else ()
        lines = [word for work in some for word in self._tray_words(work)]
        self._commands.run("doctor", *self._configured, *RECORDING_ONLY, *lines, as_messages=True)
        if self._plan.sweep is None:
            self._record_ordinary_operation()
        else:
            self._record_sweeps(self._plan.sweep)
        for work in self.left:
            with self._failing(work):
                self._learn(work)

    def _record_ordinary_operation(self) -> None:
        """The plant moves the fans of all trays."""
        plan = self._plan
        first, later = ({work.name: OrdinaryOperation(work.tray) for work in self.left} for _ in range(2))
        training = self._recorded(self.left, lambda site: self._operate(site, first, plan.at_most_s))
        for work in self.left:
            work.training = training
            with self._failing(work):
                _check_tachos(work)
        validation, operation = (self._recorded(self.left, lambda site: self._operate(site, later)) for _ in range(2))
        for work in self.left:
            work.validation, work.operation = validation, operation
            work.held = later[work.name].held()

    def _record_sweeps(self, options: list[str]) -> None:
        """Two sweeps of each tray, one tray after the other; then ordinary operation of all.

        Each sweep has a recording of its own, so that a twin is not trained on the time when other trays were swept.
        The limits need other speeds than those that the plant happens to have in some minutes: hence the second sweep.
        """
        for work in self.left:
            with self._failing(work):
                work.training = self._swept(work, options, self._plan.rounds)
                _check_tachos(work)
                work.validation = self._swept(work, options, 1)
        seen = {work.name: OrdinaryOperation(work.tray) for work in self.left}
        operation = self._recorded(self.left, lambda site: self._operate(site, seen))
        for work in self.left:
            work.operation = operation

    def _swept(self, work: TrayWork, options: list[str], rounds: int) -> list[Path]:
        words = ["command", "--sweep", *self._configured, *self._tray_words(work), *options, "--rounds", rounds]
        return self._recorded([work], lambda site: self._commands.run(*words, site=site))

    def _recorded(self, works: Sequence[TrayWork], during: Callable[[RecordingSite], None]) -> list[Path]:
        """The parts of one recording, while something is done. works: the trays whose samples that takes."""
        folder, trays = self._settings.run_folder, [work.tray for work in works]
        folder.mkdir(parents=True, exist_ok=True)
        site = RecordingSite(self._commands, self._settings, self._configured, folder / "commission.log", trays)
        try:
            with site:
                site.wait_for_samples()
                during(site)
        finally:
            self.recordings += site.recordings
            for name, count in site.lost.items():
                self.lost[name] = self.lost.get(name, 0) + count
        lost = ", ".join(f"{name} {count}" for name, count in site.lost.items())
        self._commands.say(f"recorded {', '.join(map(str, site.recordings))}; lost: {lost or 'nothing'}")
        return site.recordings

    def _operate(self, site: RecordingSite, seen: dict[str, OrdinaryOperation], at_most_s: float | None = None) -> None:
        """Record ordinary operation. seen: is given the samples, by tray. at_most_s: wait so long for all fans to have
        moved enough; None: they need not."""
        at_least_s = self._plan.operation_s
        until = "" if at_most_s is None else ", and until the fans have moved enough"
        self._commands.say(f"recording ordinary operation for {at_least_s / 60:.3g} min{until}")
        began_s, shown_s, recorded_s, missing = time.monotonic(), 0.0, 0.0, dict[str, list[str]]()
        while recorded_s < at_least_s or missing:
            for raw in site.wait(1.0):
                seen[raw.header.tray].take(raw)
            for work in self.left:
                if silence := site.silence_of(work.name):
                    self._fail(work, silence)
            recorded_s = time.monotonic() - began_s
            if at_most_s is not None:
                missing = {work.name: lacks for work in self.left if (lacks := seen[work.name].missing())}
                if missing and recorded_s > at_most_s:
                    self._drop_unmoved(missing, at_most_s)
                    missing = {}
            if recorded_s - shown_s >= SHOWN_EVERY_S:
                shown_s = recorded_s
                lacks = "; ".join(f"tray {tray}, {line}" for tray, lines in missing.items() for line in lines)
                still = f"; still missing: {lacks}" if lacks else ""
                self._commands.say(f"{recorded_s / 60:.0f} min of at least {at_least_s / 60:.3g}{still}")

    def _drop_unmoved(self, missing: dict[str, list[str]], waited_s: float) -> None:
        for work in self.left:
            if lacks := missing.get(work.name):
                move = "let their own controller vary the commands" if work.tray.source.why_no_commands else "--sweep"
                self._fail(
                    work,
                    f"in {waited_s / 3600:.3g} h its fans have not moved enough ({'; '.join(lacks)}): move them "
                    f"({move}), or wait longer with --at-most-hours",
                )

    def _learn(self, work: TrayWork) -> None:
        run, tray, twin = self._commands.run, self._tray_words(work), work.twin
        rate = f"{self._plan.false_alarms_per_day:g}"
        try:
            run("train", *work.training, "--validate", *work.validation, *tray, "-o", twin)
            healthy = [*work.validation, *work.operation]
            run("calibrate", twin, *healthy, *tray, "--false-alarms-per-day", rate, "--extrapolate")
        except (Stopped, UserError):
            twin.unlink(missing_ok=True)
            raise
        work.entry = write_twin(self._settings, work.name, twin)
        self._commands.say(f'{self._settings.path}: tray {work.name} has twin = "{work.entry}" now')

    def _tray_words(self, work: TrayWork) -> list[str]:
        """The option of a command that names the tray, where there are several."""
        return ["--tray", work.name] if len(self._settings.trays) > 1 else []

    @contextmanager
    def _failing(self, work: TrayWork) -> Iterator[None]:
        """Around a step of one tray: if it fails, the others go on."""
        try:
            yield
        except UserError as error:
            self._fail(work, str(error))

    def _fail(self, work: TrayWork, reason: str) -> None:
        work.failure = reason
        if not self.left:
            raise UserError(self.failures)
        self._commands.say(f"tray {work.name} failed: {reason}; going on without it")


def _check_tachos(work: TrayWork) -> None:
    """Raises UserError if the readings for training are not those of the declared tachos."""
    if hints := read_training_data(work.training, Part(work.name), in_this_process).hints:
        raise UserError(f"{hints[0]}: declare the tacho that was found, then start again")
