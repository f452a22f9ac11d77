"""pipeline.learning.healthy_history: what is kept for learning, and what never is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.learning.healthy_history import HealthyHistory, healthy_recordings, recorded_raws
from pipeline.recordings.reading import read_metadata
from schemas.messages import Header, Raw
from schemas.units import NS_PER_S

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


def add(
    history: HealthyHistory, first_s: int, last_s: int, *, has_alarm: bool = False, is_watched: bool = True
) -> None:
    for second in range(first_s, last_s, 10):
        history.add(raw(second), has_alarm=has_alarm, is_watched=is_watched)


def kept_s(folder: Path) -> list[tuple[int, int]]:
    """First and last second of each recording."""
    return [tuple(round(t_ns / NS_PER_S) - START_S for t_ns in each.span) for each in healthy_recordings(folder)]  # type: ignore[misc]


def test_before_the_first_twin_all_is_kept_at_once(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    add(history, 0, 200, is_watched=False)
    assert history.seconds == 199.0
    history.finish()
    assert kept_s(tmp_path) == [(0, 199)]
    assert sum(len(each.host_receive_t_ns) for each in recorded_raws(tmp_path)) == 200
    assert read_metadata(healthy_recordings(tmp_path)[0].path).speed_unit("tray1") == "rpm"


def test_what_came_shortly_before_an_alarm_and_after_it_is_never_kept(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    add(history, 0, 500)
    add(history, 500, 600, has_alarm=True)
    add(history, 600, 1200)
    history.finish()
    (before, after) = kept_s(tmp_path)
    assert before == (0, 399), "100 s before the alarm are left out"
    assert after[0] >= 690, "and 100 s after its end"
    assert after[1] <= 1100


def test_a_short_recording_is_deleted_and_a_pause_begins_a_new_one(tmp_path: Path) -> None:
    history = history_in(tmp_path, hold_back_s=0.0)
    add(history, 0, 30)
    add(history, 1000, 1300)
    history.close()
    assert kept_s(tmp_path) == [(1000, 1299)]


def test_recordings_in_excluded_time_spans_are_left_out(tmp_path: Path) -> None:
    history = history_in(tmp_path, hold_back_s=0.0)
    for first_s in (0, 1000, 2000):
        add(history, first_s, first_s + 300)
    history.close()
    faulty = ((START_S + 1299) * NS_PER_S, (START_S + 1500) * NS_PER_S)
    assert [each.span[0] for each in healthy_recordings(tmp_path, [faulty])] == [
        (START_S + 0) * NS_PER_S,
        (START_S + 2000) * NS_PER_S,
    ]
    assert history.seconds_since((START_S + 500) * NS_PER_S) == 598.0


def test_the_oldest_are_deleted_but_for_the_first(tmp_path: Path) -> None:
    history = history_in(tmp_path, hold_back_s=0.0, kept_s=650.0)
    for first_s in range(0, 5000, 1000):
        add(history, first_s, first_s + 300)
    history.close()
    assert [first for first, _ in kept_s(tmp_path)] == [0, 3000, 4000]


def test_what_a_killed_process_left_is_repaired(tmp_path: Path) -> None:
    killed = history_in(tmp_path, hold_back_s=0.0)
    add(killed, 0, 300)
    killed.flush()
    active = next((tmp_path / "healthy").glob("*.active"))
    content = active.read_bytes()
    killed.close()
    healthy_recordings(tmp_path)[0].path.unlink()
    active.write_bytes(content)
    next_one = history_in(tmp_path)
    assert next_one.problem == ""
    assert kept_s(tmp_path) == [(0, 299)]
