"""pipeline.learning.healthy_history: what is kept for learning, and what never is."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.learning.healthy_history import (
    LONGEST_LAG_NS,
    HealthyHistory,
    healthy_recordings,
    recorded_raws,
    recordings_near_alarms,
)
from fantwin.pipeline.learning.history_recordings import OPEN_NAME
from fantwin.pipeline.recordings.disk import AtomicAppendFile
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

START_S = 1_800_000_000


def history_in(folder: Path, **settings: float) -> HealthyHistory:
    given = {"hold_back_s": 100.0, "kept_s": 1e6, **settings}
    return HealthyHistory(
        folder,
        "site",
        "tray1",
        {"speed_unit.tray1": "rpm"},
        {},
        hold_back_s=given["hold_back_s"],
        kept_s=given["kept_s"],
    )


def raw(second: float) -> Raw:
    """Ten seconds of samples from then on."""
    t_ns = round((START_S + second) * NS_PER_S) + np.arange(10, dtype=np.int64) * NS_PER_S
    return Raw(
        header=Header("acquisition", int(second), "tray1"),
        fans=1,
        host_receive_t_ns=t_ns,
        command=np.full((10, 1), 0.5),
        speed_rad_s=np.full((10, 1), 100.0),
    )


def add(history: HealthyHistory, first_s: int, last_s: int) -> None:
    """Samples before there is a twin."""
    for second in range(first_s, last_s, 10):
        history.add(raw(second), has_alarm=False, is_watched=False)


def watch(history: HealthyHistory, first_s: int, last_s: int, *, has_alarm: bool = False) -> None:
    """Samples that are judged when they come."""
    for second in range(first_s, last_s, 10):
        history.add(raw(second), has_alarm=has_alarm, is_watched=True)
        judge(history, second, second + 10, had_alarm=has_alarm)


def judge(history: HealthyHistory, first_s: int, last_s: int, *, had_alarm: bool = False) -> None:
    """Fans are judged once a second."""
    history.judged((START_S + np.arange(first_s, last_s, dtype=np.int64)) * NS_PER_S, had_alarm=had_alarm)


def kept_s(folder: Path) -> list[tuple[int, int]]:
    """First and last second of each recording."""
    return [tuple(round(t_ns / NS_PER_S) - START_S for t_ns in each.span) for each in healthy_recordings(folder)]  # type: ignore[misc]


def test_before_the_first_twin_all_is_kept_at_once(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    add(history, 0, 200)
    assert history.seconds == 199.0
    history.finish()
    assert kept_s(tmp_path) == [(0, 199)]
    assert sum(len(each.host_receive_t_ns) for each in recorded_raws(tmp_path)) == 200
    assert read_metadata(healthy_recordings(tmp_path)[0].path).speed_unit("tray1") == "rpm"


def near_alarms_s(folder: Path) -> list[tuple[int, int]]:
    """First and last second of each recording of running near alarms."""
    spans = [each.span for each in recordings_near_alarms(folder)]
    return [(round(first / NS_PER_S) - START_S, round(last / NS_PER_S) - START_S) for first, last in spans]


@pytest.mark.parametrize("began_and_ended_in_one_score", [False, True])
def test_what_came_shortly_before_an_alarm_and_after_it_is_never_healthy(
    tmp_path: Path, began_and_ended_in_one_score: bool
) -> None:
    history = history_in(tmp_path)
    watch(history, 0, 500)
    if began_and_ended_in_one_score:
        judge(history, 490, 500, had_alarm=True)
    watch(history, 500, 600, has_alarm=not began_and_ended_in_one_score)
    watch(history, 600, 1200)
    ((first_s, last_s),) = near_alarms_s(tmp_path)
    history.finish()
    (before, after) = kept_s(tmp_path)
    assert before == (10, 399), "100 s before the alarm are left out"
    assert after[0] >= (600 if began_and_ended_in_one_score else 690), "and 100 s after its end"
    assert after[1] <= 1100
    assert (first_s, last_s) == (before[1] + 1, after[0] - 1)
    assert history.seconds_near_alarms_since(0) == last_s - first_s
    assert history.seconds == sum(last - first for first, last in (before, after))


def test_running_near_alarms_is_kept_for_some_time_and_begins_again_when_fans_are_commissioned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.pipeline.learning.healthy_history.NEAR_ALARMS_KEPT_S", 4.5 * 3600)
    history = history_in(tmp_path, hold_back_s=0.0)
    hour_s, day_s = 3600, 24 * 3600
    for first_s in range(0, 2 * day_s, 10 * hour_s):
        watch(history, first_s, first_s + hour_s, has_alarm=True)
        watch(history, first_s + hour_s, first_s + 9 * hour_s)
        watch(history, first_s + 9 * hour_s, first_s + 10 * hour_s, has_alarm=True)
    history.begin_after((START_S + 3 * day_s) * NS_PER_S)
    watch(history, 3 * day_s - hour_s, 3 * day_s + hour_s, has_alarm=True)
    history.close()
    kept = near_alarms_s(tmp_path)
    assert kept[-1][0] > 3 * day_s
    assert kept[-2][1] == 5 * 10 * hour_s - 1
    assert 3 * hour_s < sum(last - first for first, last in kept) <= 4.5 * hour_s


def test_recordings_in_excluded_time_spans_are_left_out(tmp_path: Path) -> None:
    history = history_in(tmp_path, hold_back_s=0.0)
    for first_s in (0, 1000, 2000):  # a pause begins a new one
        add(history, first_s, first_s + 300)
    add(history, 3000, 3030)  # too short to be kept
    history.close()
    faulty = ((START_S + 1299) * NS_PER_S, (START_S + 1500) * NS_PER_S)
    assert [each.span[0] for each in healthy_recordings(tmp_path, [faulty])] == [
        (START_S + 0) * NS_PER_S,
        (START_S + 2000) * NS_PER_S,
    ]
    assert history.seconds_since((START_S + 500) * NS_PER_S) == 598.0
    history.exclude([faulty])
    assert history.seconds_since((START_S + 500) * NS_PER_S) == 299.0
    assert history.seconds == 598.0


@pytest.mark.parametrize(
    ("excluded_s", "kept"),
    [((9000, 9900), [0, 4000, 5000]), ((1900, 4900), [0, 1000, 3000, 4000, 5000])],
)
def test_the_oldest_recordings_but_the_first_are_deleted_and_excluded_ones_displace_no_others(
    tmp_path: Path, excluded_s: tuple[int, int], kept: list[int]
) -> None:
    history = history_in(tmp_path, hold_back_s=0.0, kept_s=650.0)
    first_s, last_s = excluded_s
    history.exclude([((START_S + first_s) * NS_PER_S, (START_S + last_s) * NS_PER_S)])
    for second in range(0, 6000, 1000):
        add(history, second, second + 300)
    history.close()
    assert [first for first, _ in kept_s(tmp_path)] == kept


def test_samples_that_nobody_judged_are_never_kept(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    watch(history, 0, 500)
    for second in range(500, 1000, 10):
        history.add(raw(second), has_alarm=False, is_watched=True)
    judge(history, 1000, 1010)
    watch(history, 1010, 1500)
    history.finish()
    (before, after) = kept_s(tmp_path)
    assert before == (10, 399), "only what was judged for as long as samples are held back"
    assert after[0] >= 1000, "what nobody judged is not kept later either"
    assert after[1] <= 1400


@pytest.mark.parametrize("had_alarm", [False, True])
def test_a_clock_that_is_set_back_discards_what_is_held_and_begins_a_new_recording(
    tmp_path: Path, had_alarm: bool
) -> None:
    history = history_in(tmp_path)
    watch(history, 100_000, 100_500)
    if had_alarm:
        judge(history, 100_490, 100_500, had_alarm=True)
    watch(history, 0, 500)
    judge(history, 100_500, 100_510)  # still from before
    watch(history, 500, 1000)
    assert len(history._waiting) <= 11
    history.finish()
    (after, before) = kept_s(tmp_path)
    assert before == (100_010, 100_399)
    assert after[0] <= 120, "the alarm does not end only at its former time"
    assert 850 <= after[1] <= 900


def refuse_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(AtomicAppendFile, "write", refuse)


def test_what_a_full_disk_has_is_kept_and_said_until_samples_are_on_the_disk_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    history = history_in(tmp_path, hold_back_s=0.0)
    add(history, 0, 300)
    history.flush()
    add(history, 300, 350)
    with monkeypatch.context() as full:
        refuse_writes(full)
        history.flush()
        assert kept_s(tmp_path) == [(0, 299)]
        assert history.seconds == 299.0
        add(history, 350, 400)
    assert "No space left on device" in history.problem
    add(history, 400, 700)
    assert "No space left on device" in history.problem, "nothing is on the disk yet"
    history.flush()
    assert history.problem == ""
    history.finish()
    assert kept_s(tmp_path) == [(0, 299), (400, 699)]
    add(history, 800, 1100)
    history.flush()
    with monkeypatch.context() as full:
        refuse_writes(full)
        history.finish()
    assert kept_s(tmp_path)[2:] == [(800, 1099)], "what the disk refused to finish"
    assert "the history cannot be kept" in history.problem
    add(history, 1200, 1500)
    history.flush()
    assert "the history cannot be kept" in history.problem, "until another one is finished"
    history.finish()
    assert history.problem == ""


def test_what_a_killed_process_left_is_repaired_and_named_at_the_next_start(tmp_path: Path) -> None:
    first = history_in(tmp_path, hold_back_s=0.0)
    add(first, 0, 300)
    add(first, 1000, 1300)
    first.flush()
    place = tmp_path / "healthy"
    active = (place / f"{OPEN_NAME}.active").read_bytes()
    first.close()
    (finished, other) = (each.path for each in healthy_recordings(tmp_path))
    finished.rename(place / OPEN_NAME)
    other.unlink()
    (place / f"{OPEN_NAME}.active").write_bytes(active)
    second = history_in(tmp_path)
    assert second.problem == ""
    assert kept_s(tmp_path) == [(0, 299), (1000, 1299)]
    assert second.seconds == 598.0
    assert sorted(place.iterdir()) == [each.path for each in healthy_recordings(tmp_path)]


def test_where_an_excluded_time_span_ends_a_new_recording_begins(tmp_path: Path) -> None:
    history = history_in(tmp_path, hold_back_s=0.0)
    history.exclude([(START_S * NS_PER_S, (START_S + 300) * NS_PER_S)])
    add(history, 0, 600)
    assert history.seconds == 289.0
    history.exclude([((START_S + 500) * NS_PER_S, (START_S + 5000) * NS_PER_S)])
    assert history.seconds == 309.0, "the open recording does not count either, and the first one does again"
    history.finish()
    assert kept_s(tmp_path) == [(0, 309), (310, 599)]


def test_what_was_not_judged_for_long_is_given_up_so_that_memory_stays_bounded(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    for second in range(0, 20_000, 10):
        history.add(raw(second), has_alarm=False, is_watched=True)
    judge(history, 0, 20_000)
    history.finish()
    assert kept_s(tmp_path)[0][0] >= 20_000 - LONGEST_LAG_NS // NS_PER_S - 110
