"""Healthy recordings that are gone through several times, and the limit that their alarms give a twin."""

from __future__ import annotations

import errno
import os
import shutil
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.healthy_evidence import outlier_warnings
from fantwin.pipeline.replay.offline import healthy_runs, kept_bins
from fantwin.pipeline.replay.offline.calibration_of_twin import CalibratedTwin, calibrated
from fantwin.pipeline.replay.offline.healthy_runs import (
    DecidedRun,
    HealthyPart,
    HealthyRuns,
    LearnedRun,
    Limit,
    decide,
    learn,
)
from fantwin.pipeline.replay.offline.kept_bins import KeptBins, RecordedTray, TrayRun
from fantwin.schemas.fan_names import FanNames
from fantwin.scoring.calibration.calibration import is_exceeded
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.learned import RunSums
from fantwin.scoring.model.population import Priors
from tests.support.healthy_running import made_fans, running
from tests.support.healthy_site import recorded, start_ns
from tests.support.twin_files import write_twin

LASTS_S = 10.0
ROOM_BYTES = 10_000_000
LIMIT = Limit(Priors(), 60.0)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("healthy")
    return [
        recorded(folder / f"{seed}.mcap", seed, LASTS_S, has_fault=seed == 2, fault_s=(5, 10)) for seed in range(1, 3)
    ]


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> HealthyPart:
    return HealthyPart(write_twin(tmp_path_factory.mktemp("twin") / "twin.onnx", fans=2))


def kept_in(folder: Path, room_bytes: int = ROOM_BYTES) -> KeptBins:
    folder.mkdir()
    return KeptBins(folder, room_bytes)


def values_of(run: LearnedRun | DecidedRun) -> Any:
    """What a run tells, to be compared."""
    if isinstance(run, DecidedRun):
        return run
    return run.tray, [values.tolist() for values in vars(run.sums).values()]


def learned(runs: HealthyRuns) -> list[Any]:
    return [values_of(run) for run in runs.learned()]


def of_both_passes(runs: HealthyRuns) -> list[Any]:
    return [*learned(runs), *map(values_of, runs.decided(LIMIT))]


def counted_openings(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    opened: list[Path] = []
    open_input: Callable[..., Any] = healthy_runs.open_replay_input

    def counted(paths: list[Path], *more: Any) -> Any:
        opened.extend(paths)
        return open_input(paths, *more)

    monkeypatch.setattr(healthy_runs, "open_replay_input", counted)
    return opened


def test_bins_are_computed_once_and_then_read_from_the_folder_where_they_are_compact(
    recordings: list[Path], part: HealthyPart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = of_both_passes(HealthyRuns(recordings, part))
    assert whole[-1].alarms != (0, 0), "or there was nothing to compare"
    monkeypatch.setattr(kept_bins, "AT_ONCE", 17)
    opened, kept = counted_openings(monkeypatch), kept_in(tmp_path / "kept")
    assert of_both_passes(HealthyRuns(recordings, part, kept=kept)) == whole
    assert opened == recordings
    size, bins_of_fans = sum(file.stat().st_size for file in kept.folder.iterdir()), 2 * 2 * 10 * LASTS_S
    assert size / bins_of_fans < 120 + 10 * 30, "of a bin of ten samples, as at MOST_KEPT_BYTES of `calibrate`"


def test_where_room_or_the_disk_is_full_bins_are_computed_again(
    recordings: list[Path], part: HealthyPart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = counted_openings(monkeypatch)
    runs = HealthyRuns(recordings[:1], part, kept=(short := kept_in(tmp_path / "short", 1000)))
    whole = learned(runs)
    assert learned(runs) == whole
    assert opened == recordings[:1] * 2
    assert list(short.folder.iterdir()) == []

    def refused() -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    kept = kept_in(tmp_path / "kept")
    real_open = Path.open
    monkeypatch.setattr(
        Path, "open", lambda path, mode="r", *more: refused() if mode == "ab" else real_open(path, mode)
    )
    assert learned(HealthyRuns(recordings[:1], part, kept=kept)) == whole
    assert list(kept.folder.iterdir()) == []


def test_a_pass_that_ends_early_is_not_taken_for_a_whole_recording(
    recordings: list[Path], part: HealthyPart, tmp_path: Path
) -> None:
    kept = kept_in(tmp_path / "kept")
    for run in healthy_runs._Source(part, kept, lambda _: None).runs(recordings[0]):  # pyright: ignore[reportPrivateUsage]
        next(iter(run.bins))
    assert kept.of(recordings[0]) is None


def test_what_was_left_out_and_what_lies_outside_the_part_is_not_counted(
    recordings: list[Path], part: HealthyPart
) -> None:
    def hours(of: HealthyPart) -> float:
        return sum(run.fan_hours for run in HealthyRuns(recordings[:1], of).learned())

    whole = hours(part)
    assert whole == pytest.approx(2 * LASTS_S / 3600.0, rel=0.2)
    first_half = HealthyPart(part.twin, to_s=LASTS_S / 2)
    assert hours(first_half) == pytest.approx(0.5 * whole, rel=0.25)
    span = healthy_runs.LeftOut("", None, "tray1", 1, start_ns(1), start_ns(2))
    assert hours(HealthyPart(part.twin, left_out=(span,))) == pytest.approx(0.5 * whole, rel=0.01)
    with pytest.raises(UserError, match=r"1.mcap: tray1: no samples from 500 s to inf s; see --from and --to"):
        hours(HealthyPart(part.twin, from_s=500.0))


def test_many_recordings_take_no_more_memory_than_one(
    recordings: list[Path], part: HealthyPart, tmp_path: Path
) -> None:
    copies = [Path(shutil.copy(recordings[0], tmp_path / f"{number}.mcap")) for number in range(3)]

    def peak_of(paths: list[Path]) -> int:
        tracemalloc.start()
        found = HealthyRuns(paths, HealthyPart(part.twin, to_s=3.0)).learned()
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(found) == len(paths)
        return peak

    peak_of(copies[:1])  # what is imported and cached once
    assert peak_of(copies) < 1.3 * peak_of(copies[:1])


FANS, SECONDS = 40, 24.0


class MadeRuns:
    """Runs whose speed varies more than the model of a fan knows: at once, where a rotor needs a second."""

    def __init__(self, seeds: range) -> None:
        block = running(FANS, SECONDS, 0)
        self.fans, self._period_ns = made_fans(FANS), block.period_ns
        self._bin_ns = bin_ns_of(block.period_ns, 0.0)
        self._bins = [
            list(
                Bins(self._bin_ns, self.fans.top_rad_s, self.fans.reads_balance, None).take(
                    running(FANS, SECONDS, seed, wander=0.006)
                )
            )
            for seed in seeds
        ]

    def _runs(self) -> list[TrayRun]:
        tray = RecordedTray(Path("a.mcap"), "tray1", FANS, "rad/s")
        return [TrayRun(tray, self._bin_ns, self._period_ns, bins) for bins in self._bins]

    def learned(self) -> list[LearnedRun]:
        return [learn(run, self.fans) for run in self._runs()]

    def decided(self, limit: Limit) -> list[DecidedRun]:
        return [decide(run, self.fans, limit) for run in self._runs()]


def test_a_limit_that_more_false_alarms_than_declared_have_raised_keeps_the_rate_in_other_runs() -> None:
    per_day = 150.0
    found = calibrated(cast(HealthyRuns, MadeRuns(range(2))), per_day)
    calibration = found.calibration
    assert not calibration.is_target
    by_theory = sum(sum(run.alarms) for run in found.by_theory)
    assert is_exceeded(by_theory, calibration.fan_hours, per_day), "or there was nothing to mend"
    assert calibration.limit_factor > 1.0
    assert calibration.found <= per_day * calibration.fan_hours / 24.0
    limit = Limit(calibration.priors, 86400.0 / per_day, calibration.limit_factor)
    others = sum(sum(run.alarms) for run in MadeRuns(range(10, 12)).decided(limit))
    assert not is_exceeded(others, calibration.fan_hours, per_day)


TRAY = RecordedTray(Path("a.mcap"), "tray1", 2, "rpm", FanNames(("", "", "GPU")))


class ToldRuns:
    """Runs of which is told how high their scores go. An excursion raises two alarms, as one that goes on may."""

    def __init__(self, peaks: Sequence[Sequence[float]], fan_hours: float, mean_share: Sequence[float] = ()) -> None:
        self._peaks, self._hours = peaks, fan_hours
        self._means = mean_share or [0.001] * len(peaks)
        self.factors: list[float] = []

    def learned(self) -> list[LearnedRun]:
        judged_s = np.full(len(self._peaks), 3600.0 * self._hours / len(self._peaks))
        return [LearnedRun(TRAY, RunSums(judged_s, np.array(self._means), np.zeros(3), np.zeros(3)))]

    def decided(self, limit: Limit) -> list[DecidedRun]:
        self.factors.append(limit.factor)
        alarms = tuple(2 * sum(peak > limit.factor for peak in fan) for fan in self._peaks)
        return [DecidedRun(TRAY, alarms, tuple(peak for fan in self._peaks for peak in fan if peak > 1.0))]


def told(runs: ToldRuns, per_day: float, *, alarms_left_out: int = 0, extrapolate: bool = False) -> CalibratedTwin:
    return calibrated(cast(HealthyRuns, runs), per_day, alarms_left_out=alarms_left_out, extrapolate=extrapolate)


def test_the_limit_by_theory_stays_where_chance_explains_what_was_found() -> None:
    runs = ToldRuns([[1.2, 0.5], [1.3]], 72.0)  # three alarms are declared, four were raised
    found = told(runs, 1.0).calibration
    assert (found.limit_factor, found.found, runs.factors) == (1.0, 4, [1.0])
    assert found.interval_95[0] < 1.0 < found.interval_95[1]


def test_a_limit_rises_until_the_alarms_themselves_are_no_more_than_declared() -> None:
    peaks = [[1.1, 1.2, 1.3, 1.4, 1.5], [1.6, 0.9]]
    found = told(ToldRuns(peaks, 72.0), 1.0).calibration
    assert found.limit_factor == pytest.approx(1.5)
    assert found.found == 2, "one peak, and two alarms"


def test_a_fault_raises_no_limit_and_the_rate_is_then_no_promise() -> None:
    found = told(ToldRuns([[1.1, 1.2, 900.0, 1.3, 800.0], [50.0, 700.0]], 72.0), 1.0).calibration
    assert found.limit_factor == pytest.approx(1.3), "for what is not far beyond chance"
    assert found.found == 8
    assert found.is_target


def test_alarms_whose_time_is_not_in_the_recordings_count_as_found() -> None:
    peaks = [[1.1], [1.2, 0.9]]
    assert told(ToldRuns(peaks, 72.0), 1.0).calibration.limit_factor == 1.0
    found = told(ToldRuns(peaks, 72.0), 1.0, alarms_left_out=9).calibration
    assert (found.limit_factor, found.found) == (pytest.approx(1.2), 9)


def test_too_few_hours_are_refused_with_a_rate_that_is_then_taken_or_give_a_target() -> None:
    with pytest.raises(
        UserError, match="10 fan-hours .* cannot show 1 false alarm per fan and day: that takes 72"
    ) as it:
        told(ToldRuns([[0.5]], 10.0), 1.0)
    assert "declare 7.2 or more, or add --extrapolate" in str(it.value)
    assert not told(ToldRuns([[0.5]], 10.0), 7.2).calibration.is_target
    assert told(ToldRuns([[0.5]], 10.0), 1.0, extrapolate=True).calibration.is_target
    with pytest.raises(UserError) as it:
        told(ToldRuns([[0.5]], 0.001), 1.0)
    assert "declare" not in str(it.value), "no rate that the option would refuse"


def test_a_fan_that_differs_from_the_others_or_has_most_of_the_alarms_is_named() -> None:
    alike = told(ToldRuns([[0.5]] * 5, 72.0, [0.01, 0.012, -0.008, 0.02, 0.005]), 1.0)
    assert outlier_warnings(alike) == []
    slower = told(ToldRuns([[0.5]] * 5, 72.0, [0.01, 0.012, -0.12, 0.02, 0.005]), 1.0)
    assert outlier_warnings(slower) == [
        "a.mcap: tray1 GPU (fan 2) is 12 % slower than its twin on average, the median of all fans is 1.2 %: "
        "if something was wrong there, calibrate without this recording"
    ]
    (warning,) = outlier_warnings(told(ToldRuns([[1.2], [1.1] * 9], 72.0), 1.0))
    assert warning.startswith("a.mcap: tray1 fan 1 has 18 of the 20 alarms that the limit by theory raises: ")
