"""Healthy recordings as the scorer would receive them: what `fantwin calibrate` calibrates on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol, TypeVar

from pipeline.config.models import TrayConfig
from pipeline.errors import UserError
from pipeline.recordings.checksum import sha256_of
from pipeline.recordings.length import longest_s
from pipeline.replay.offline.kept_samples import KeptSamples, RecordedTray, TrayRuns
from pipeline.replay.offline.marked_alarms import LeftOut, concerning, without
from pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.codec import CodecError
from schemas.units import NS_PER_S, SpeedUnit
from scoring.baseline.shared_offset import LEAST_FANS
from scoring.calibration.healthy_statistics import HealthyRun, HealthyStatistics, MixedRatesError, RunWork
from scoring.limits import Timing, default_timing
from scoring.samples import Samples, samples_of

REPORTED_EVERY_S = 5.0
"""of the time that the work takes"""
CLOCK_MARGIN = 1.01
"""by which the clock of a device may be faster than that of the host"""

Result = TypeVar("Result")


class MapRecordings(Protocol):
    """Work on many recordings."""

    def __call__(self, work: Callable[[Path], Result], recordings: Sequence[Path], doing: str, /) -> Iterator[Result]:
        """Does the work on each recording, in any process; results in their order. doing: for people."""
        ...


def in_this_process(work: Callable[[Path], Result], recordings: Sequence[Path], _doing: str) -> Iterator[Result]:
    """One recording after another."""
    return map(work, recordings)


@dataclass(frozen=True)
class HealthyPart:
    """Which samples of each recording count, and the twin that they are compared with.

    from_s, to_s: in seconds since the first sample of the tray. tray: the only one that is used; without it all are.
    left_out: times of fans that are not learned from.
    """

    twin: Path
    overrides: tuple[str, ...] = ()
    from_s: float = 0.0
    to_s: float = math.inf
    tray: str | None = None
    left_out: tuple[LeftOut, ...] = ()

    @contextmanager
    def opened(self, path: Path) -> Iterator[ReplayInput]:
        """A recording. Raises as `open_replay_input`.

        Raises:
            UserError: no tray is chosen, and the twin fits some of the trays only.
        """
        with open_replay_input(
            [path], None, self.overrides, self.twin, self.from_s, self.to_s, self.tray
        ) as replay_input:
            _require_that_all_fit(self.twin, path, replay_input.trays)
            yield replay_input


def _require_that_all_fit(twin: Path, path: Path, trays: Sequence[TrayConfig]) -> None:
    """Refuse trays of which the twin fits some only: its limits are those of one kind of tray."""
    if len(trays) < 2:
        return
    fans = load_tray_twin(twin).fans
    if fans > 1 and len({tray.fans == fans for tray in trays}) > 1:
        found = ", ".join(f"{tray.name} of {_fans(tray.fans)}" for tray in trays)
        raise UserError(f"{path}: several trays, {found}, and a twin of {_fans(fans)}: choose one with --tray")


def _fans(count: int) -> str:
    return f"{count} fan{'s' * (count != 1)}"


@dataclass(frozen=True)
class _Facts:
    """What is known of a recording without scoring it."""

    path: Path
    trays: tuple[RecordedTray, ...]
    timing: Timing
    longest_fan_s: float
    speed_unit: SpeedUnit


class HealthyRuns:
    """Recordings or parts of them, processed like a live tray; they can be gone through several times."""

    def __init__(
        self,
        paths: Sequence[Path],
        part: HealthyPart,
        each: MapRecordings = in_this_process,
        kept: KeptSamples | None = None,
        progress: Callable[[str], None] = lambda _: None,
    ) -> None:
        """each: does the work. kept: where samples are kept between passes. progress: takes how far a recording is."""
        self._paths = paths
        self._part = part
        self._each = each
        self._kept = kept
        self._progress = progress
        self._pass = 0
        self.trays: list[RecordedTray] = []
        """of each run of the last pass"""

    def __call__(self, work: RunWork) -> Iterator[HealthyStatistics]:
        """What the work returns for each run. Of one recording in each process, a block is in memory at a time.

        Raises:
            UserError: a recording cannot be used.
        """
        self._pass += 1
        of_recording = partial(_work_on, work=work, part=self._part, kept=self._kept, progress=self._progress)
        found = list(self._each(of_recording, self._paths, f"pass {self._pass} over healthy recordings"))
        self.trays = [tray for of_one in found for tray, _ in of_one]
        return (statistics for of_one in found for _, statistics in of_one)

    def sha256(self) -> dict[Path, str]:
        """Of the recordings that were used in the last pass."""
        used = list(dict.fromkeys(tray.path for tray in self.trays))
        return dict(self._each(_path_and_sha256, used, "naming the recordings in the card"))

    def timing(self) -> Timing:
        """The times of the scorer in the configuration of the recordings, with the overrides applied.

        Raises:
            UserError: a recording cannot be used; the times are not the same in all; or some trays have one fan and
                others several.
        """
        _refuse_one_fan_among_several([tray for facts in self._facts.values() for tray in facts.trays])
        found: dict[Timing, Path] = {}
        for facts in self._facts.values():
            found.setdefault(facts.timing, facts.path)
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
        return sum(facts.longest_fan_s for facts in self._facts.values())

    @property
    def speed_unit(self) -> SpeedUnit:
        """The unit in which people are shown the speeds of the first recording.

        Raises:
            UserError: it cannot be used.
        """
        return next(iter(self._facts.values())).speed_unit

    @cached_property
    def _facts(self) -> dict[Path, _Facts]:
        found = self._each(partial(_facts_of, part=self._part), self._paths, "opening healthy recordings")
        return {facts.path: facts for facts in found}


def _facts_of(path: Path, part: HealthyPart) -> _Facts:
    with part.opened(path) as replay_input:
        trays = tuple(RecordedTray(path, tray.name, tray.fans) for tray in replay_input.trays)
        recorded_s = CLOCK_MARGIN * longest_s(path, replay_input.first_sample_t_ns) + 1.0
        scorer = replay_input.config.sections["scorer"]
        timing = scorer.timing(default_timing(trays[0].fans))  # type: ignore[attr-defined]  the scorer's own settings
        speed_unit = replay_input.trays[0].speed_unit
    part_s = min(recorded_s, part.to_s) - part.from_s
    if part_s <= 0.0:
        raise UserError(f"{path}: no samples from {part.from_s:g} s to {part.to_s:g} s; see --from and --to")
    return _Facts(path, trays, timing, part_s * sum(tray.fans for tray in trays), speed_unit)


def _path_and_sha256(path: Path) -> tuple[Path, str]:
    return path, sha256_of(path)


def _work_on(
    path: Path, work: RunWork, part: HealthyPart, kept: KeptSamples | None, progress: Callable[[str], None]
) -> list[tuple[RecordedTray, HealthyStatistics]]:
    twin = load_tray_twin(part.twin)
    found: list[tuple[RecordedTray, HealthyStatistics]] = []
    try:
        for tray, blocks in (kept and kept.of(path)) or _computed(path, part, kept):
            known_as = range(tray.fans) if twin.fans > 1 else None
            reported = _reported(blocks, f"{path.name} {tray.tray}", progress)
            run = HealthyRun(str(path), tray.fans, reported, known_as, twin.card.tacho, tray.tray)
            found.append((tray, work(run)))
    except CodecError as error:
        raise UserError(f"{path}: a message cannot be decoded: {error}; see `fantwin info`") from error
    except MixedRatesError as error:
        rates = f"{NS_PER_S / error.first[1]:g} Hz and {NS_PER_S / error.other[1]:g} Hz"
        raise UserError(
            f"{path}: its grid changes between {rates}, and limits hold for one rate: calibrate without it"
        ) from error
    return found


def _computed(path: Path, part: HealthyPart, kept: KeptSamples | None) -> TrayRuns:
    """The samples of each tray of a recording, computed as the stages do."""
    unseen_error = load_tray_twin(part.twin).unseen_error
    with part.opened(path) as replay_input:

        def blocks_of(tray: str) -> Iterator[Samples]:
            spans = concerning(part.left_out, path, replay_input.config.site, tray)
            for block in replay_input.pipeline(tray).predictions():
                yield samples_of(without(block, spans), unseen_error)

        runs = ((RecordedTray(path, tray.name, tray.fans), blocks_of(tray.name)) for tray in replay_input.trays)
        yield from kept.keep(path, runs) if kept else runs


def _reported(blocks: Iterable[Samples], what: str, progress: Callable[[str], None]) -> Iterator[Samples]:
    scored_s, shown_s = 0.0, time.monotonic()
    for block in blocks:
        yield block
        scored_s += len(block.t_ns) * block.period_ns / NS_PER_S
        if time.monotonic() - shown_s > REPORTED_EVERY_S:
            shown_s = time.monotonic()
            progress(f"{what}, {scored_s / 3600.0:.1f} h")


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
