"""Healthy recordings that are gone through several times: what is kept between the passes, and what takes memory."""

from __future__ import annotations

import errno
import os
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.replay.offline import healthy_runs, kept_bins
from fantwin.pipeline.replay.offline.healthy_runs import DecidedRun, HealthyPart, HealthyRuns, LearnedRun, Limit
from fantwin.pipeline.replay.offline.kept_bins import KeptBins
from fantwin.scoring.model.priors import Priors
from tests.support.healthy_site import recorded, start_ns
from tests.support.twin_files import write_twin

SECONDS = 10.0
ROOM_BYTES = 10_000_000
LIMIT = Limit(Priors(), 60.0)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("healthy")
    return [
        recorded(folder / f"{seed}.mcap", seed, SECONDS, has_fault=seed == 2, fault_s=(5, 10)) for seed in range(1, 3)
    ]


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> HealthyPart:
    return HealthyPart(write_twin(tmp_path_factory.mktemp("twin") / "twin.onnx", fans=2))


def kept_in(folder: Path, room_bytes: int = ROOM_BYTES) -> KeptBins:
    folder.mkdir()
    return KeptBins(folder, room_bytes)


def told(run: LearnedRun | DecidedRun) -> Any:
    """What a run tells, to be compared."""
    if isinstance(run, DecidedRun):
        return run
    return run.tray, [values.tolist() for values in vars(run.sums).values()]


def learned(runs: HealthyRuns) -> list[Any]:
    return [told(run) for run in runs.learned()]


def of_both_passes(runs: HealthyRuns) -> list[Any]:
    return [*learned(runs), *map(told, runs.decided(LIMIT))]


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
    size, bins_of_fans = sum(file.stat().st_size for file in kept.folder.iterdir()), 2 * 2 * 10 * SECONDS
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
    assert whole == pytest.approx(2 * SECONDS / 3600.0, rel=0.2)
    first_half = HealthyPart(part.twin, to_s=SECONDS / 2)
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
