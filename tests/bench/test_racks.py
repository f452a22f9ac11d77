"""The simulated racks of bench/detection: the same fans, commands and counts whatever is reported, and their faults."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from bench.detection.plant import START_NS
from bench.detection.racks import (
    FAULT_KINDS,
    MISSING_READINGS,
    RACK_FANS,
    TACHOS,
    Racks,
    events,
    fault_schedule,
    racks,
    reports,
    run_of,
)
from schemas.messages import Array

SECONDS = 600.0
COUNT = 2


@cache
def built() -> Racks:
    return racks(COUNT, SECONDS, seed=6)


@cache
def courses(rate_hz: float, *, is_faulty: bool) -> tuple[Array, Array]:
    """(n, columns) command and reading at all reports; NaN where a line was lost."""
    shape = (round(SECONDS * rate_hz), COUNT * RACK_FANS)
    command, speed = np.full(shape, np.nan), np.full(shape, np.nan)
    for blocks in reports(built(), rate_hz, fault_schedule(built()) if is_faulty else None):
        for rack, raw in enumerate(blocks):
            fans = slice(rack * RACK_FANS, (rack + 1) * RACK_FANS)
            late_ns = raw.host_receive_t_ns - START_NS - raw.device_sequence.astype(np.int64) * round(1e9 / rate_hz)
            assert 0 <= late_ns.min() <= late_ns.max() <= 4_000_001
            command[raw.device_sequence, fans], speed[raw.device_sequence, fans] = raw.command, raw.speed_rad_s
    return command, speed


def test_the_same_seed_gives_the_same_lines_and_the_share_of_losses_is_as_set() -> None:
    first, again, other = (
        [raw for blocks in reports(racks(1, 60.0, seed), 10.0) for raw in blocks] for seed in (5, 5, 6)
    )
    assert all(np.array_equal(a.speed_rad_s, b.speed_rad_s, equal_nan=True) for a, b in zip(first, again, strict=True))
    assert all(np.array_equal(a.host_receive_t_ns, b.host_receive_t_ns) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0].command[:100], other[0].command[:100])
    command, speed = courses(10.0, is_faulty=False)
    arrived = np.isfinite(command)
    assert 1.0 - arrived.mean() == pytest.approx(0.003, abs=0.002)
    assert np.isnan(speed[arrived]).mean() == pytest.approx(MISSING_READINGS, abs=0.001)


@pytest.mark.parametrize("rate_hz", [2.0, 100.0])
def test_racks_turn_the_same_whatever_the_rate_of_their_reports(rate_hz: float) -> None:
    (command, speed), (other_command, other) = (courses(rate, is_faulty=True) for rate in (10.0, rate_hz))
    step, other_step = (5, 1) if rate_hz == 2.0 else (1, 10)
    for mine, theirs in ((command[::step], other_command[::other_step]), (speed[::step], other[::other_step])):
        both = np.isfinite(mine) & np.isfinite(theirs)
        assert both.mean() > 0.9
        assert np.array_equal(mine[both], theirs[both])


def test_a_count_is_shown_from_the_report_after_its_window_ended() -> None:
    _, speed = courses(100.0, is_faulty=False)
    phases = set()
    for column in range(COUNT * RACK_FANS):
        window_rows = round(TACHOS[column % RACK_FANS].window_s * 100)
        changes = np.flatnonzero(np.diff(speed[:, column]) != 0.0) + 1
        changes = changes[np.isfinite(speed[changes, column]) & np.isfinite(speed[changes - 1, column])]
        phase = int(np.bincount(changes % window_rows).argmax())
        assert np.isin(changes % window_rows, [(phase - 1) % window_rows, phase, (phase + 1) % window_rows]).all()
        phases.add(phase % 10)
    assert len(phases) > 3  # and not at the steps of the simulation


def test_each_rack_has_each_fault_once_on_a_fan_that_is_on_and_the_truth_says_so() -> None:
    truth = events(fault_schedule(built()))
    command, _ = courses(10.0, is_faulty=True)
    for rack in range(COUNT):
        own = [event for event in truth if event.run == run_of(rack)]
        assert sorted(event.kind for event in own) == sorted(FAULT_KINDS)
        assert {event.fan for event in own} == set(range(RACK_FANS))
        ordered = sorted(own, key=lambda event: event.start_ns)
        assert all(a.end_ns < b.start_ns for a, b in pairwise(ordered))
        for event in own:
            assert event.cause == FAULT_KINDS[event.kind]
            begins = (event.start_ns - START_NS) // 100_000_000
            assert np.nanmin(command[begins - 90 : begins + 580, rack * RACK_FANS + event.fan]) > 0.0


def test_a_fault_shows_in_its_fan_from_its_beginning_on() -> None:
    (_, healthy), (_, faulty) = courses(10.0, is_faulty=False), courses(10.0, is_faulty=True)
    for fault in fault_schedule(built()):
        fan, window_s = fault.fan, TACHOS[fault.fan % RACK_FANS].window_s
        # The first count after it may hold revolutions before it; a rotor stops within 0.2 s.
        shown = slice(int((fault.start_s + 2.0 * window_s + 0.5) * 10), int(fault.stop_s * 10))
        settled = slice(int((fault.stop_s - 12.0) * 10), int(fault.stop_s * 10))
        ratio = float(np.nanmean(faulty[settled, fan]) / np.nanmean(healthy[settled, fan]))
        if fault.kind == "blocked":
            assert np.nanmax(faulty[shown, fan]) == 0.0
            assert np.nanmin(healthy[shown, fan]) > 0.0
        elif fault.kind == "no-power":
            assert np.nanmax(faulty[settled, fan]) == 0.0
        elif fault.kind == "tacho-dropout":
            assert np.isnan(faulty[shown, fan]).mean() == pytest.approx(0.35, abs=0.1)
        elif fault.kind == "blade":
            assert ratio == pytest.approx(0.9, abs=0.02)
        elif fault.kind == "bearing":
            assert ratio == pytest.approx(0.97, abs=0.02)
        else:
            grown = 1.0 - 0.06 * (fault.stop_s - 6.0 - fault.start_s) / 180.0
            assert ratio == pytest.approx(grown, abs=0.01)
    for rack in range(COUNT):
        first_s = min(fault.start_s for fault in fault_schedule(built()) if fault.fan // RACK_FANS == rack)
        before = np.s_[: int(first_s * 10), rack * RACK_FANS : (rack + 1) * RACK_FANS]
        assert np.array_equal(healthy[before], faulty[before], equal_nan=True)
