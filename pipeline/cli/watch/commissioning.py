"""The steps of `fantwin commission`: what is recorded for each tray, and the twin that is made of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from fantwin.pipeline.cli.watch.child_commands import Commands, RecordingSite, Stopped
from fantwin.pipeline.cli.watch.commission_state import LOG, RECORDING_ONLY, TraySoFar, Unfinished
from fantwin.pipeline.config.loading import write_twin
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.training_data import Part, read_training_data
from fantwin.pipeline.replay.offline.healthy_runs import in_this_process

SHOWN_EVERY_S = 60.0
AT_MOST_S = 86_400.0
"""how long to wait for the plant to move the fans"""
TRAINING, VALIDATION, CALIBRATION = "training", "validation", "calibration"
"""purposes of recordings: validation sets the band, and with calibration, in ordinary operation, the limits"""


@dataclass(frozen=True)
class Plan:
    """How the fans of all trays are moved, and for how long they are recorded."""

    sweep: list[str] | None
    """the options of each sweep but for tray and rounds; None: the plant moves the fans"""
    rounds: int
    """of the first sweep of each tray"""
    operation_s: float
    """length of a recording of ordinary operation"""
    false_alarms_per_day: float


@dataclass
class TrayWork:
    """A tray, and what has been done for it."""

    tray: TrayConfig
    twin: Path
    """to write"""
    so_far: TraySoFar = field(default_factory=TraySoFar)
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
        self,
        settings: Config,
        configured: list[str],
        commands: Commands,
        works: Sequence[TrayWork],
        plan: Plan,
        unfinished: Unfinished,
    ) -> None:
        """configured: the words that give a command this configuration. works: one for each tray that gets a twin."""
        self._settings = settings
        self._configured = configured
        self._commands = commands
        self._works = works
        self._plan = plan
        self._unfinished = unfinished
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
    def how_to_go_on(self) -> str:
        """That recordings are used by the next one, if any are."""
        kept = any(self._unfinished.has(work.name) for work in self._works)
        return "; the same command goes on after the recordings that are complete" if kept else ""

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
        for work in self._works:
            self._take_up(work)
        self._commands.run("doctor", *self._configured, *RECORDING_ONLY, *lines, as_messages=True)
        if self._plan.sweep is None:
            self._record_ordinary_operation()
        else:
            self._record_sweeps(self._plan.sweep)
        for work in self.left:
            with self._failing(work):
                self._learn(work)

    def _take_up(self, work: TrayWork) -> None:
        """Go on with what an earlier one has recorded of a tray by the same settings and options."""
        plan = self._plan
        work.so_far = self._unfinished.of(work.name, f"{work.tray!r} {plan.sweep} {plan.rounds} {plan.operation_s}")
        self.recordings += [path for path in work.so_far.files if path not in self.recordings]
        if work.so_far.recorded:
            self._commands.say(
                f"tray {work.name}: {', '.join(work.so_far.recorded)} data were recorded in the last day and are used: "
                f"{', '.join(map(str, work.so_far.files))} (to record again, delete {self._unfinished.file})"
            )

    def _record_ordinary_operation(self) -> None:
        """The plant moves the fans of all trays."""
        first, later = ({work.name: OrdinaryOperation(work.tray) for work in self.left} for _ in range(2))
        if self._lacks(TRAINING):
            self._record(self.left, TRAINING, lambda site: self._operate(site, first, AT_MOST_S))
            for work in self.left:
                with self._failing(work):
                    self._check_tachos(work)
        if self._lacks(CALIBRATION):
            for purpose in (VALIDATION, CALIBRATION):
                self._record(self.left, purpose, lambda site: self._operate(site, later))
            for work in self.left:
                work.so_far.held = later[work.name].held()
                self._unfinished.keep(work.name, work.so_far)

    def _record_sweeps(self, options: list[str]) -> None:
        """Two sweeps of each tray, one tray after the other; then ordinary operation of all.

        Each sweep has a recording of its own, so that a twin is not trained on the time when other trays were swept.
        The limits need other speeds than those that the plant happens to have in some minutes: hence the second sweep.
        """
        rounds, minutes = self._plan.rounds, self._plan.operation_s / 60.0
        of_rounds = f"{rounds} round{'s' * (rounds > 1)}"
        self._commands.say(
            f"plan: of each tray a sweep of {of_rounds} to train on and one of 1 round to validate; then "
            f"{minutes:.3g} min of ordinary operation of all, and training"
        )
        self._commands.say("a round takes 75 time constants of the slowest fan, which each sweep measures first")
        for work in self.left:
            with self._failing(work):
                if TRAINING not in work.so_far.recorded:
                    self._sweep(work, TRAINING, options, self._plan.rounds)
                    self._check_tachos(work)
                if VALIDATION not in work.so_far.recorded:
                    self._commands.say(f"tray {work.name}: the second sweep, 1 round, to validate")
                    self._sweep(work, VALIDATION, options, 1)
        if self._lacks(CALIBRATION):
            seen = {work.name: OrdinaryOperation(work.tray) for work in self.left}
            self._record(self.left, CALIBRATION, lambda site: self._operate(site, seen))

    def _lacks(self, purpose: str) -> bool:
        return not all(purpose in work.so_far.recorded for work in self.left)

    def _sweep(self, work: TrayWork, purpose: str, options: list[str], rounds: int) -> None:
        words = ["command", "--sweep", *self._configured, *self._tray_words(work), *options, "--rounds", rounds]
        self._record([work], purpose, lambda site: self._commands.run(*words, site=site))

    def _record(self, works: Sequence[TrayWork], purpose: str, during: Callable[[RecordingSite], None]) -> None:
        """Make one recording of trays while something is done."""
        self._unfinished.show(f"records {purpose} data of tray {', '.join(work.name for work in works)}")
        trays = [work.tray for work in works]
        site = RecordingSite(self._commands, self._settings, self._configured, self._settings.run_folder / LOG, trays)
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
        for work in works:
            if not work.failure:
                work.so_far.recorded[purpose] = site.recordings
                self._unfinished.keep(work.name, work.so_far)

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
                few = f"in {waited_s / 3600:.3g} h its fans have not moved enough ({'; '.join(lacks)})"
                self._fail(work, f"{few}: move them ({move})")

    def _learn(self, work: TrayWork) -> None:
        run, tray, twin, recorded = self._commands.run, self._tray_words(work), work.twin, work.so_far.recorded
        rate = f"{self._plan.false_alarms_per_day:g}"
        self._unfinished.show(f"makes the twin of tray {work.name}")
        try:
            with self._making_use(work):
                run("train", *recorded[TRAINING], "--validate", *recorded[VALIDATION], *tray, "-o", twin)
                healthy = [*recorded[VALIDATION], *recorded[CALIBRATION]]
                run("calibrate", twin, *healthy, *tray, "--false-alarms-per-day", rate, "--extrapolate")
        except (Stopped, UserError):
            twin.unlink(missing_ok=True)
            raise
        work.entry = write_twin(self._settings, work.name, twin)
        self._unfinished.forget(work.name)
        self._commands.say(f'{self._settings.path}: tray {work.name} has twin = "{work.entry}" now')

    def _check_tachos(self, work: TrayWork) -> None:
        """Raises UserError if the readings for training are not those of the declared tachos."""
        recordings = work.so_far.recorded[TRAINING]
        with self._making_use(work):
            if hints := read_training_data(recordings, Part(work.name), in_this_process).hints:
                raise UserError(f"{hints[0]}: declare the tacho that was found, then start again")

    @contextmanager
    def _making_use(self, work: TrayWork) -> Iterator[None]:
        """Forget the recordings of a tray if what uses them fails: it would fail with them again."""
        try:
            yield
        except UserError:
            self._unfinished.forget(work.name)
            raise

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
