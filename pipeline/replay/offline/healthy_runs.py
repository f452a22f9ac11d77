"""Healthy recordings as the scorer would receive them: what `fantwin calibrate` learns from and counts alarms in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Protocol, TypeVar

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.checksum import sha256_of
from fantwin.pipeline.replay.offline.alarm_episodes import LeftOut, concerning, without
from fantwin.pipeline.replay.offline.kept_bins import KeptBins, RecordedTray, TrayRun
from fantwin.pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from fantwin.pipeline.tray_scoring.healthy_twin import modelled_fans
from fantwin.schemas.codec import CodecError
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.calibration.calibration import Excursions
from fantwin.scoring.model.bins import Bin, Bins, bin_ns_of
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.model.learned import HealthyRun, RunSums
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.model.population import Priors

REPORTED_EVERY_S = 5.0
"""of the time that the work takes"""
NEVER = 1e6
"""factor of a limit that no statistic reaches"""

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


@dataclass(frozen=True)
class LearnedRun:
    """What a run of a tray tells of the priors."""

    tray: RecordedTray
    sums: RunSums

    @property
    def fan_hours(self) -> float:
        """Time in which fans were compared with the twin."""
        return math.fsum(self.sums.judged_s) / 3600.0


@dataclass(frozen=True)
class DecidedRun:
    """Alarms in a run of a tray."""

    tray: RecordedTray
    alarms: tuple[int, ...]
    """number for each fan"""
    peaks: tuple[float, ...]
    """peaks of the score, one for each time that it exceeds the limit by theory; with alarms only up to them"""


@dataclass(frozen=True)
class Limit:
    """What a run is decided with. declared_s: mean time between two false alarms of a fan.

    factor: of the limit by theory. is_free: no alarm is raised, so that statistics go on beyond the limit; their score
    times `factor` is then relative to the limit by theory, by which also wrong readings of a tacho are found.
    """

    priors: Priors
    declared_s: float
    factor: float = 1.0
    is_free: bool = False

    def decision(self, fans: Fans, bin_ns: int, period_ns: int) -> Decision:
        """A new decision on fans."""

        def by(factor: float) -> Decision:
            return Decision(fans, bin_ns, period_ns / NS_PER_S, self.declared_s, self.priors, factor)

        if not self.is_free:
            return by(self.factor)
        by_theory, never = by(1.0), by(self.factor)
        by_theory.log_limit, by_theory.missing = never.log_limit, never.missing
        return by_theory

    def free(self) -> Limit:
        """The limit by theory, at which no alarm is raised."""
        return replace(self, factor=NEVER, is_free=True)


class HealthyRuns:
    """Recordings or parts of them, processed like a live tray; they can be gone through several times."""

    def __init__(
        self,
        paths: Sequence[Path],
        part: HealthyPart,
        each: MapRecordings = in_this_process,
        kept: KeptBins | None = None,
        progress: Callable[[str], None] = lambda _: None,
    ) -> None:
        """each: does the work. kept: where bins are kept between passes. progress: takes how far a recording is."""
        self._paths = paths
        self._each = each
        self._source = _Source(part, kept, progress)

    def learned(self) -> list[LearnedRun]:
        """What each run tells of the priors.

        Raises:
            UserError: a recording cannot be used, or nothing of it can be compared with the twin.
        """
        learn = partial(_learn, source=self._source)
        return [*chain.from_iterable(self._each(learn, self._paths, "learning from healthy recordings"))]

    def decided(self, limit: Limit) -> list[DecidedRun]:
        """The alarms of each run, all of which are false. Raises as `learned`."""
        decide = partial(_decide, source=self._source, limit=limit)
        return [*chain.from_iterable(self._each(decide, self._paths, "counting false alarms"))]

    def sha256(self) -> dict[Path, str]:
        """SHA-256 of the recordings that were used."""
        return dict(self._each(_path_and_sha256, self._paths, "naming the recordings in the card"))


@dataclass(frozen=True)
class _Source:
    """Runs of recordings, computed as the stages do unless they are kept."""

    part: HealthyPart
    kept: KeptBins | None
    progress: Callable[[str], None]

    def runs(self, path: Path) -> Iterator[TrayRun]:
        """Those of a recording."""
        runs = self.kept and self.kept.of(path)
        if not runs:
            runs = _computed(path, self.part)
            runs = self.kept.keep(path, runs) if self.kept else runs
        try:
            for run in runs:
                what = f"{path.name} {run.tray.tray}"
                yield replace(run, bins=_reported(run.bins, run.bin_ns, what, self.progress))
        except CodecError as error:
            raise UserError(f"{path}: a message cannot be decoded: {error}; see `fantwin info`") from error

    def fans(self, tray: RecordedTray) -> Fans:
        """What the twin tells of the fans of a tray."""
        return modelled_fans(load_tray_twin(self.part.twin, tray.fans))


def _learn(path: Path, source: _Source) -> list[LearnedRun]:
    found = [learn(run, source.fans(run.tray)) for run in source.runs(path)]
    if not any(run.fan_hours for run in found):
        raise UserError(f"{path}: nothing in it could be compared with the twin; `fantwin info` shows what is missing")
    return found


def _decide(path: Path, source: _Source, limit: Limit) -> list[DecidedRun]:
    return [decide(run, source.fans(run.tray), limit) for run in source.runs(path)]


def learn(run: TrayRun, fans: Fans) -> LearnedRun:
    """What a run of these fans tells of the priors."""
    healthy = HealthyRun(fans, run.bin_ns)
    for one in run.bins:
        healthy.take(one)
    return LearnedRun(run.tray, healthy.sums)


def decide(run: TrayRun, fans: Fans, limit: Limit) -> DecidedRun:
    """The alarms of a run of these fans."""
    decision = limit.decision(fans, run.bin_ns, run.period_ns)
    alarms, excursions = [0] * run.tray.fans, Excursions(run.tray.fans)
    for one in run.bins:
        for change in decision.take(one):
            alarms[change.fan] += change.raised
        excursions.take(decision.score * limit.factor)
    return DecidedRun(run.tray, tuple(alarms), tuple(excursions.peaks))


def _path_and_sha256(path: Path) -> tuple[Path, str]:
    return path, sha256_of(path)


def _computed(path: Path, part: HealthyPart) -> Iterator[TrayRun]:
    with part.opened(path) as replay_input:
        for tray in replay_input.trays:
            spans = concerning(part.left_out, path, replay_input.config.site, tray.name)
            blocks = (without(block, spans) for block in replay_input.pipeline(tray.name).predictions())
            first = next(blocks, None)
            if first is None:
                wanted = f"from {part.from_s:g} s to {part.to_s:g} s; see --from and --to"
                raise UserError(f"{path}: {tray.name}: no samples {wanted}")
            twin = load_tray_twin(part.twin, tray.fans)
            fans = modelled_fans(twin)
            bin_ns = bin_ns_of(first.period_ns, float(fans.held_s.min()))
            bins = Bins(bin_ns, fans.top_rad_s, fans.reads_balance, twin.unseen_error)
            recorded = RecordedTray(path, tray.name, tray.fans, tray.speed_unit, tray.names)
            binned = chain.from_iterable(map(bins.take, chain([first], blocks)))
            yield TrayRun(recorded, bin_ns, first.period_ns, binned)


def _reported(bins: Iterable[Bin], bin_ns: int, what: str, progress: Callable[[str], None]) -> Iterator[Bin]:
    done, shown_s = 0, time.monotonic()
    for done, one in enumerate(bins, start=1):
        yield one
        if done % 1000 == 0 and time.monotonic() - shown_s > REPORTED_EVERY_S:
            shown_s = time.monotonic()
            progress(f"{what}, {done * bin_ns / NS_PER_S / 3600.0:.1f} h")


def _require_that_all_fit(twin: Path, path: Path, trays: Sequence[TrayConfig]) -> None:
    """Refuse trays of which the twin fits some only."""
    fans = load_tray_twin(twin).fans
    if fans > 1 and len({tray.fans == fans for tray in trays}) > 1:
        found = ", ".join(f"{tray.name} of {_fans(tray.fans)}" for tray in trays)
        raise UserError(f"{path}: several trays, {found}, and a twin of {_fans(fans)}: choose one with --tray")


def _fans(count: int) -> str:
    return f"{count} fan{'s' * (count != 1)}"
