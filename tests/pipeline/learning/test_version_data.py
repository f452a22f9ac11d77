"""What a version is trained, validated, compared and checked on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.healthy_history import healthy_recordings
from fantwin.pipeline.learning.history_recordings import HistoryRecording
from fantwin.pipeline.learning.version_data import (
    CHECKED_PART_S,
    CHECKED_PARTS,
    Excerpt,
    every_of,
    read_excerpts,
    split,
    spread_parts,
    windows_of,
)
from fantwin.schemas.units import NS_PER_S
from tests.support.commanded_fans import HELD, RATE_HZ, held, moving, recorded

HOUR_S = 3600.0


def overlapping(some: Sequence[Excerpt], others: Sequence[Excerpt]) -> bool:
    return any(a.path == b.path and a.from_s < b.to_s and b.from_s < a.to_s for a in some for b in others)


def spans(seconds: Sequence[float]) -> list[HistoryRecording]:
    ends = np.cumsum(seconds)
    return [
        HistoryRecording(Path(f"{k}.mcap"), (round((end - each) * NS_PER_S), round(end * NS_PER_S)))
        for k, (each, end) in enumerate(zip(seconds, ends, strict=True))
    ]


@pytest.mark.parametrize("seconds", [[60.0] * 1440, [60.0], [7 * HOUR_S, 61.0, 90.0, 5 * HOUR_S]])
def test_the_checked_parts_are_never_too_many_and_lie_in_their_recordings(seconds: list[float]) -> None:
    recordings = spans(seconds)
    parts = spread_parts(recordings)
    assert 1 <= len(parts) <= CHECKED_PARTS
    length_of = {each.path: each.seconds for each in recordings}
    assert all(-1e-6 <= part.from_s < part.to_s <= length_of[part.path] + 1e-6 for part in parts)
    assert all(part.to_s - part.from_s <= CHECKED_PART_S + 1e-6 for part in parts)
    assert not any(overlapping([part], parts[k + 1 :]) for k, part in enumerate(parts))
    if sum(seconds) >= CHECKED_PARTS * CHECKED_PART_S:
        assert len(parts) == CHECKED_PARTS


def test_of_long_recordings_only_the_last_hours_are_checked() -> None:
    recordings = spans([8 * HOUR_S, 8 * HOUR_S, 1 * HOUR_S])
    parts = spread_parts(recordings, 4 * HOUR_S)
    assert len(parts) == CHECKED_PARTS
    before = [part for part in parts if part.path == recordings[1].path]
    assert min(part.from_s for part in before) >= 5 * HOUR_S
    assert 0.7 < len(before) / len(parts) < 0.8, "three of the four hours"
    assert not any(part.path == recordings[0].path for part in parts)


def test_training_finds_the_movement_in_the_middle_of_a_recording(tmp_path: Path) -> None:
    recorded(tmp_path, 0.0, np.concatenate((held(1.5 * HOUR_S), moving(600.0), held(1.5 * HOUR_S))))
    recorded(tmp_path, 20_000.0, np.concatenate((held(HOUR_S), moving(600.0, seed=2), held(HOUR_S))))
    parts = split(healthy_recordings(tmp_path), RATE_HZ, 2)
    for excerpts in (parts.training, parts.validation, parts.comparison):
        data = read_excerpts(excerpts)
        commands = np.concatenate([run.command for run in data.runs])
        assert len(np.unique(commands)) > 20, "levels of both fans"
        assert np.ptp(commands) > 70.0
        assert np.mean(commands == HELD) > 0.25, "and ordinary running"
    assert {each.path for each in parts.training}.isdisjoint(each.path for each in parts.validation)
    assert not overlapping(parts.validation, parts.comparison)


def test_movement_in_the_newest_recording_only_is_trained_on_and_held_out(tmp_path: Path) -> None:
    recorded(tmp_path, 0.0, held(2 * HOUR_S))
    recorded(tmp_path, 10_000.0, moving(1800.0))
    recordings = healthy_recordings(tmp_path)
    parts = split(recordings, RATE_HZ, 2)
    newest = [each for each in parts.training if each.path == recordings[-1].path]
    assert sum(each.to_s - each.from_s for each in newest) > 600.0
    assert not overlapping(parts.training, [*parts.validation, *parts.comparison])
    assert not overlapping(parts.validation, parts.comparison)
    for excerpts in (parts.training, parts.validation, parts.comparison):
        assert np.ptp(np.concatenate([run.command for run in read_excerpts(excerpts).runs])) > 50.0


def test_of_a_short_only_recording_every_fifth_part_is_held_out(tmp_path: Path) -> None:
    recorded(tmp_path, 0.0, moving(600.0))
    (only,) = healthy_recordings(tmp_path)
    parts = split([only], RATE_HZ, 2)
    in_tenths = [10.0 * at_s / only.seconds for each in parts.training for at_s in (each.from_s, each.to_s)]
    assert in_tenths == pytest.approx([0.0, 4.0, 5.0, 9.0])
    assert parts.validation == parts.comparison
    assert not overlapping(parts.training, parts.validation)


def test_windows_that_lack_most_of_their_samples_are_not_used(tmp_path: Path) -> None:
    recorded(tmp_path, 0.0, moving(300.0))
    (path,) = [each.path for each in healthy_recordings(tmp_path)]
    longer = HistoryRecording(path, (0, 900 * NS_PER_S))
    assert [each.from_s for each in windows_of([longer], 60.0).excerpts] == [0.0, 60.0, 120.0, 180.0, 240.0]


def test_recordings_of_different_numbers_of_fans_are_an_error(tmp_path: Path) -> None:
    recorded(tmp_path, 0.0, moving(120.0))
    recorded(tmp_path, 1000.0, moving(120.0, fans=3))
    with pytest.raises(UserError, match="recordings of 2 and 3 fans"):
        split(healthy_recordings(tmp_path), RATE_HZ, 2)


def test_fast_lines_are_thinned_to_the_rate_of_the_grid_and_slow_ones_are_not(tmp_path: Path) -> None:
    assert [every_of(rate_hz) for rate_hz in (1.0, 100.0, 104.0, 150.0, 1000.0)] == [1, 1, 1, 2, 10]
    recorded(tmp_path, 0.0, np.repeat(moving(70.0), 200, axis=0), rate_hz=1000.0)
    (recording,) = healthy_recordings(tmp_path)
    data = read_excerpts([Excerpt(recording.path, 10.0, 20.0)])
    assert data.runs[0].samples == data.sources[0].samples == pytest.approx(1000, abs=1)
