"""Healthy recordings as the scorer would receive them: what `fantwin calibrate` calibrates on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.recordings.length import longest_s
from pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.codec import CodecError
from schemas.units import NS_PER_S, SpeedUnit
from scoring.baseline.shared_offset import LEAST_FANS
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.limits import Timing, default_timing
from scoring.samples import Samples, samples_of

MAX_KEPT_SAMPLES = 10_000_000
"""of fans, about 80 bytes each: so many are kept between passes; with more, recordings are read again"""

REPORTED_EVERY_S = 5.0
"""of the time that the work takes"""
CLOCK_MARGIN = 1.01
"""by which the clock of a device may be faster than that of the host"""


@dataclass(frozen=True)
class RecordedTray:
    """One tray of one recording."""

    path: Path
    tray: str
    fans: int


class HealthyRuns:
    """Recordings or parts of them, processed like a live tray; they can be gone through several times."""

    def __init__(
        self,
        paths: Sequence[Path],
        twin: Path,
        overrides: Sequence[str],
        progress: Callable[[str], None],
        from_s: float = 0.0,
        to_s: float = math.inf,
        tray: str | None = None,
    ) -> None:
        """from_s, to_s: the part of each recording, in seconds since the first sample of the tray. tray: the only one
        of each recording that is used; without it all are."""
        self._from_s, self._to_s = from_s, to_s
        self._tray = tray
        self._paths = paths
        self._twin = twin
        self._overrides = overrides
        self._progress = progress
        loaded = load_tray_twin(twin)
        self._knows_fans = loaded.fans > 1
        self._tachos = loaded.card.tacho
        self._unseen_error = loaded.unseen_error
        self._pass = 0
        self._kept: list[HealthyRun] | None = None
        self.trays: list[RecordedTray] = []
        """of each run of the last pass"""

    def __call__(self) -> Iterator[HealthyRun]:
        """All runs from the beginning.

        Raises:
            UserError: a recording cannot be used.
        """
        self._pass += 1
        if self._kept is not None:
            for run in self._kept:
                yield run._replace(blocks=self._reported(run.name, run.blocks))
            return
        self.trays = []
        kept = _KeptRuns()
        for path in self._paths:
            try:
                for tray, blocks in self._of(path):
                    self.trays.append(tray)
                    known_as = range(tray.fans) if self._knows_fans else None
                    run = kept.recording(HealthyRun(str(path), tray.fans, blocks, known_as, self._tachos, tray.tray))
                    yield run._replace(blocks=self._reported(str(path), run.blocks))
            except CodecError as error:
                raise UserError(f"{path}: a message cannot be decoded: {error}; see `fantwin info`") from error
        self._kept = kept.complete

    def _reported(self, name: str, blocks: Iterable[Samples]) -> Iterator[Samples]:
        where, scored_s, shown_s = f"pass {self._pass}: {name}", 0.0, time.monotonic()
        self._progress(where)
        for block in blocks:
            yield block
            scored_s += len(block.t_ns) * block.period_ns / NS_PER_S
            if time.monotonic() - shown_s > REPORTED_EVERY_S:
                shown_s = time.monotonic()
                self._progress(f"{where}, {scored_s / 3600.0:.1f} h")

    def timing(self) -> Timing:
        """The times of the scorer in the configuration of the recordings, with the overrides applied.

        Raises:
            UserError: a recording cannot be used; the times are not the same in all; or some trays have one fan and
                others several.
        """
        scorers: dict[Path, Any] = {}
        trays: list[RecordedTray] = []
        for path in self._paths:
            with self._opened(path) as replay_input:
                scorers[path] = replay_input.config.sections["scorer"]
                trays += [RecordedTray(path, tray.name, tray.fans) for tray in replay_input.trays]
        _refuse_one_fan_among_several(trays)
        found: dict[Timing, Path] = {}
        for path, scorer in scorers.items():
            found.setdefault(scorer.timing(default_timing(trays[0].fans)), path)
        first, *others = found
        for other in others:
            names = [name for name in Timing.model_fields if getattr(first, name) != getattr(other, name)]
            raise UserError(
                f"{found[first]} and {found[other]} differ in scorer.{names[0]}, which limits depend on: "
                "choose one with --set"
            )
        return first

    def longest_fan_s(self) -> float:
        """An upper bound of the time that can be scored, s, summed over fans: without scoring anything.

        Raises:
            UserError: a recording cannot be used, or ends before the part of it that is wanted.
        """
        total_s = 0.0
        for path in self._paths:
            with self._opened(path) as replay_input:
                fans = sum(tray.fans for tray in replay_input.trays)
                recorded_s = CLOCK_MARGIN * longest_s(path, replay_input.first_sample_t_ns) + 1.0
            part_s = min(recorded_s, self._to_s) - self._from_s
            if part_s <= 0.0:
                raise UserError(f"{path}: no samples from {self._from_s:g} s to {self._to_s:g} s; see --from and --to")
            total_s += fans * part_s
        return total_s

    @property
    def speed_unit(self) -> SpeedUnit:
        """The unit in which people are shown the speeds of the first recording.

        Raises:
            UserError: it cannot be used.
        """
        with self._opened(self._paths[0]) as replay_input:
            return replay_input.trays[0].speed_unit

    def _of(self, path: Path) -> Iterator[tuple[RecordedTray, Iterator[Samples]]]:
        with self._opened(path, self._from_s, self._to_s) as replay_input:
            for tray in replay_input.trays:
                name = tray.name
                predictions = replay_input.pipeline(name).predictions()
                samples = (samples_of(block, self._unseen_error) for block in predictions)
                yield RecordedTray(path, name, tray.fans), samples

    def _opened(self, path: Path, from_s: float = 0.0, to_s: float = math.inf) -> AbstractContextManager[ReplayInput]:
        return open_replay_input([path], None, self._overrides, self._twin, from_s, to_s, self._tray)


def _refuse_one_fan_among_several(trays: Sequence[RecordedTray]) -> None:
    """What fans of a tray share is followed apart, and their baselines follow slowly: limits hold with it or without.

    Raises:
        UserError: some trays have one fan and others several.
    """
    alone = next((tray for tray in trays if tray.fans < LEAST_FANS), None)
    beside_others = next((tray for tray in trays if tray.fans >= LEAST_FANS), None)
    if alone and beside_others:
        raise UserError(
            f"{alone.path} has a tray of one fan and {beside_others.path} one of {beside_others.fans}, and limits hold "
            "for one kind of tray, since fans beside others are compared with them: calibrate twice, and write one of "
            "the twins to another file with -o; --tray chooses a tray of recordings with several"
        )


class _KeptRuns:
    """The blocks of all runs, kept while they are gone through for the first time, if they are not too many."""

    def __init__(self) -> None:
        self._runs: list[HealthyRun] | None = []
        self._room = MAX_KEPT_SAMPLES
        self._unfinished = 0

    @property
    def complete(self) -> list[HealthyRun] | None:
        """The runs; None if they were too many, or one was not read to its end."""
        return None if self._unfinished else self._runs

    def recording(self, run: HealthyRun) -> HealthyRun:
        """The same run, whose blocks are kept as they are read."""
        kept: list[Samples] = []
        if self._runs is not None:
            self._runs.append(run._replace(blocks=kept))
        return run._replace(blocks=self._recorded(run.blocks, kept))

    def _recorded(self, blocks: Iterable[Samples], kept: list[Samples]) -> Iterator[Samples]:
        self._unfinished += 1
        for block in blocks:
            self._room -= block.speed_rad_s.size
            if self._room < 0:
                self._runs = None
                kept.clear()
            else:
                kept.append(block)
            yield block
        self._unfinished -= 1
