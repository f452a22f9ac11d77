"""Healthy recordings that are gone through several times: what is kept between the passes, and what takes memory."""

from __future__ import annotations

import errno
import os
import pickle
import shutil
import tracemalloc
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.recordings.reading import read_metadata
from pipeline.replay.offline import healthy_runs
from pipeline.replay.offline.healthy_runs import HealthyPart, HealthyRuns
from pipeline.replay.offline.kept_samples import KeptSamples
from pipeline.runtime.tray_twin import load_tray_twin
from scoring.calibration.healthy_statistics import HealthyRun, MixedRatesError, statistics_of_run
from scoring.limits import Limits
from scoring.samples import Samples

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"
ROOM = 1_000_000


@pytest.fixture
def part(tmp_path: Path) -> HealthyPart:
    twin = tmp_path / "twin.onnx"
    twin.write_bytes(read_metadata(GOLDEN).attachments["tray1.onnx"])
    return HealthyPart(twin)


def kept_in(folder: Path, room: int) -> KeptSamples:
    folder.mkdir()
    return KeptSamples(folder, room)


def samples_in(runs: HealthyRuns) -> list[Samples]:
    """All blocks of a pass."""
    collect: Any = lambda run: list(run.blocks)  # noqa: E731  stands for the work of calibration
    return [block for blocks in runs(collect) for block in blocks]  # type: ignore[union-attr]


def computed_at_each_opening(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    opened: list[Path] = []
    open_input: Callable[..., Any] = healthy_runs.open_replay_input

    def counted(paths: list[Path], *more: Any) -> Any:
        opened.extend(paths)
        return open_input(paths, *more)

    monkeypatch.setattr(healthy_runs, "open_replay_input", counted)
    return opened


def test_samples_are_computed_once_and_then_read_from_the_folder(
    part: HealthyPart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = computed_at_each_opening(monkeypatch)
    runs = HealthyRuns([GOLDEN], part, kept=kept_in(tmp_path / "kept", ROOM))
    first, again = samples_in(runs), samples_in(runs)
    assert opened == [GOLDEN]
    assert len(first) == len(again) > 0
    for one, other in zip(first, again, strict=True):
        for column in fields(Samples):
            np.testing.assert_array_equal(getattr(one, column.name), getattr(other, column.name))
    assert [(tray.tray, tray.fans) for tray in runs.trays] == [("tray1", 2)]


def test_where_room_or_the_disk_is_full_samples_are_computed_again(
    part: HealthyPart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = computed_at_each_opening(monkeypatch)
    whole = len(samples_in(HealthyRuns([GOLDEN], part)))
    short = kept_in(tmp_path / "short", 100)
    runs = HealthyRuns([GOLDEN], part, kept=short)
    assert len(samples_in(runs)) == len(samples_in(runs)) == whole
    assert opened == [GOLDEN] * 3
    assert sum(file.stat().st_size for file in short.folder.iterdir()) < 100_000
    opened.clear()
    kept = kept_in(tmp_path / "kept", ROOM)
    runs = HealthyRuns([GOLDEN], part, kept=kept)

    def refused_after_some(_content: object, file: BinaryIO) -> NoReturn:
        file.write(bytes(10))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pickle, "dump", refused_after_some)
    assert len(samples_in(runs)) == len(samples_in(runs)) == whole
    assert opened == [GOLDEN] * 2
    assert sum(file.stat().st_size for file in kept.folder.iterdir()) < 100


def test_a_recording_whose_grid_changes_is_a_bad_one(part: HealthyPart) -> None:
    def found_to_change(run: HealthyRun) -> NoReturn:
        raise MixedRatesError((run.name, 10_000_000), (run.name, 20_000_000))

    with pytest.raises(UserError, match="golden.mcap: its grid changes between 100 Hz and 50 Hz"):
        list(HealthyRuns([GOLDEN], part)(found_to_change))


def test_a_pass_that_ends_early_is_not_taken_for_a_whole_recording(part: HealthyPart, tmp_path: Path) -> None:
    runs = HealthyRuns([GOLDEN], part, kept=kept_in(tmp_path / "kept", ROOM))
    first_block: Any = lambda run: next(iter(run.blocks))  # noqa: E731
    list(runs(first_block))
    whole = samples_in(HealthyRuns([GOLDEN], part))
    assert [len(block.t_ns) for block in samples_in(runs)] == [len(block.t_ns) for block in whole]


def test_many_recordings_take_no_more_memory_than_one(part: HealthyPart, tmp_path: Path) -> None:
    limits = Limits.model_validate(load_tray_twin(part.twin).card.calibration)
    copies = [Path(shutil.copy(GOLDEN, tmp_path / f"{number}.mcap")) for number in range(4)]

    def peak_of(recordings: list[Path]) -> int:
        score: Callable[[HealthyRun], Any] = partial(statistics_of_run, limits=limits, top_speed_rad_s=200.0)
        tracemalloc.start()
        found = list(HealthyRuns(recordings, part)(score))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(found) == len(recordings)
        return peak

    peak_of(copies[:1])  # what is imported and cached once
    assert peak_of(copies) < 1.3 * peak_of(copies[:1])
