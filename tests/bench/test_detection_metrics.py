"""The figures of bench/detection, and the simulated campaigns they are taken from."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bench.detection import severities
from bench.detection.competitors import FilteredBalance, fitted_balance, textbook_cusum_limit
from bench.detection.knobs import BY_HAND, Knob, Knobs
from bench.detection.measured import events
from bench.detection.methods import Calibration, Limited, Log
from bench.detection.metrics import (
    NONE,
    Event,
    RaisedAlarm,
    confusion,
    false_alarms,
    outcomes,
    rate,
    share,
    vus_pr,
)
from bench.detection.plant import RATE_HZ, START_NS, STEP_NS, TRAY_FANS, Faults, Plant
from bench.detection.residuals import Moving
from schemas.messages import Array, Prediction
from simulation.plant import FanParameters, tray_of_fans

S = 1_000_000_000


def test_the_interval_of_a_rate_is_that_of_garwood() -> None:
    found = rate(3, 2.0)
    assert found.value == 1.5
    assert found.low == pytest.approx(0.6187 / 2, abs=1e-3)  # of three events: 0.6187 .. 8.7673, the published table
    assert found.high == pytest.approx(8.7673 / 2, abs=1e-3)
    none = rate(0, 1.0)
    assert (none.low, none.high) == (0.0, pytest.approx(3.6889, abs=1e-3))


def test_the_interval_of_a_rate_holds_the_truth_as_often_as_it_says() -> None:
    counts = np.random.default_rng(0).poisson(5.0, size=2000)
    held = np.mean([found.low <= 5.0 <= found.high for found in (rate(int(n), 1.0) for n in counts)])
    assert 0.95 <= held < 0.99


def test_the_interval_of_a_share_is_that_of_clopper_and_pearson() -> None:
    found = share(9, 10)
    assert (found.low, found.high) == (pytest.approx(0.5550, abs=1e-4), pytest.approx(0.9975, abs=1e-4))


def test_an_event_is_found_by_an_alarm_that_is_raised_in_it_and_by_no_other() -> None:
    event = Event("run", 2, 10 * S, 20 * S, "inlet", "drag_up")
    before, other_fan, other_run = (
        RaisedAlarm("run", 2, 9 * S, None),
        RaisedAlarm("run", 3, 12 * S),
        RaisedAlarm("another", 2, 12 * S),
    )
    late = RaisedAlarm("run", 2, 21 * S)
    (missed,) = outcomes([event], [before, other_fan, other_run, late])
    assert not missed.is_found
    first = RaisedAlarm("run", 2, 11 * S, 12 * S, ("drag_up", "cannot_tell"))
    (found,) = outcomes([event], [RaisedAlarm("run", 2, 15 * S), first, before])
    assert (found.delay_s, found.cause) == (1.0, "drag_up")


def test_an_alarm_that_no_event_explains_is_a_false_alarm() -> None:
    event = Event("run", 2, 10 * S, 20 * S, "inlet")
    within, recovering = RaisedAlarm("run", 2, 15 * S), RaisedAlarm("run", 2, 23 * S)
    false = [RaisedAlarm("run", 2, 9 * S), RaisedAlarm("run", 2, 26 * S), RaisedAlarm("run", 1, 15 * S)]
    assert false_alarms([within, recovering, *false], [event]) == false


def test_the_confusion_matrix_counts_named_causes_and_alarms_without_one() -> None:
    made = [Event("run", fan, 0, 10 * S, "inlet", "drag_up") for fan in range(4)]
    alarms = [
        RaisedAlarm("run", 0, S, causes=("drag_up", "gain_down")),
        RaisedAlarm("run", 1, S, causes=("gain_down",)),
        RaisedAlarm("run", 2, S),
    ]
    assert confusion(outcomes(made, alarms)) == {"drag_up": {"drag_up": 1, "gain_down": 1, NONE: 1}}


def test_the_volume_is_that_of_the_authors_package() -> None:
    """Figures of vus 0.0.6, RangeAUC_volume_opt(labels, score, L, 250)."""
    labels = np.zeros(12, np.bool_)
    labels[4:7] = True
    score = np.array([0, 1, 0, 3, 5, 6, 2, 4, 0, 1, 0, 0.5])
    assert vus_pr(labels, score, range(5)) == pytest.approx(0.9301534404420335, rel=1e-12)
    rng = np.random.default_rng(0)
    labels = np.zeros(600, np.bool_)
    for start in rng.integers(30, 540, 3):
        labels[start : start + rng.integers(5, 40)] = True
    score = rng.normal(size=600) + 1.5 * labels
    assert vus_pr(labels, score, range(21)) == pytest.approx(0.3806508240339007, rel=1e-12)


def test_without_a_buffer_a_perfect_score_has_all_of_the_volume_and_one_of_nothing_its_share() -> None:
    labels = np.zeros(1000, np.bool_)
    labels[300:400] = True
    assert vus_pr(labels, labels.astype(np.float64), [0]) == pytest.approx(1.0)
    assert vus_pr(labels, np.full(1000, np.nan), [0]) == pytest.approx(0.1)
    with pytest.raises(ValueError, match="no sample is anomalous"):
        vus_pr(np.zeros(10, np.bool_), np.zeros(10), [0])


class _Given:
    """Recorded scores."""

    def __init__(self, score: Array) -> None:
        self._score = score

    def take(self, block: Prediction) -> Array:
        first = int(block.t_ns[0]) // STEP_NS
        return self._score[first : first + len(block.t_ns)]


def _block(first: int, last: int, fans: int = 1, **columns: Array) -> Prediction:
    zero, rows = np.zeros((last - first, fans)), np.arange(first, last)
    return replace(
        Prediction(
            fans=fans,
            period_ns=STEP_NS,
            t_ns=STEP_NS * rows,
            command=zero,
            measured_speed_rad_s=zero,
            predicted_speed_rad_s=zero,
            sigma_rad_s=np.ones(fans),
            valid=np.ones((last - first, fans), np.bool_),
            invalid_reason=np.zeros((last - first, fans), np.uint8),
            torque_balance_command=zero,
            torque_balance_sigma_command=np.ones(fans),
        ),
        **columns,
    )


@pytest.mark.parametrize("cut", [1, 7, 500])
def test_alarms_of_a_limit_do_not_depend_on_how_samples_are_cut(cut: int) -> None:
    score = np.zeros((500, 2))
    score[100:150, 0] = 3.0
    score[220, 0] = 3.0  # within the off-delay: still the same alarm
    score[400, 0] = np.nan
    detector, log = Limited(_Given(score), 2, 2.0), Log()
    for first in range(0, 500, cut):
        log.take("run", detector.take(_block(first, min(first + cut, 500), 2)).changes)
    (alarm,) = log.alarms
    assert (alarm.fan, alarm.raised_ns, alarm.cleared_ns) == (0, 100 * STEP_NS, 321 * STEP_NS)


def test_a_limit_gives_no_more_false_alarms_than_the_budget_allows() -> None:
    score = np.random.default_rng(1).exponential(size=(360_000, 1))  # one hour, sixty windows
    calibration = Calibration(alarms_per_hour=5.0)
    nothing_allowed = Calibration(alarms_per_hour=0.5)
    for first in range(0, len(score), 1000):
        for one in (calibration, nothing_allowed):
            one.take("run", _block(first, first + 1000), score[first : first + 1000])
    assert calibration.allowed == 5
    limit = calibration.limit()
    windows = score.reshape(60, -1).max(axis=1)
    assert np.sum(windows > limit) == 5
    assert nothing_allowed.limit() == score.max()


def test_the_textbook_limit_is_that_of_the_tables() -> None:
    assert textbook_cusum_limit(465.0) == pytest.approx(5.0, abs=0.02)  # k = 0.5, two-sided: ARL0 465 at h = 5


@pytest.mark.parametrize("cut", [1, 64])
def test_moving_means_continue_from_block_to_block(cut: int) -> None:
    values = np.random.default_rng(2).normal(size=(200, 3))
    values[50, 1] = np.nan
    moving = Moving(10)
    means = np.concatenate([moving.means(values[first : first + cut]) for first in range(0, 200, cut)])
    assert np.isnan(means[3]).all()
    assert means[120] == pytest.approx(values[111:121].mean(axis=0))
    assert means[55, 1] == pytest.approx(np.nanmean(values[46:56, 1]))


def test_the_filtered_balance_is_learned_and_shows_a_load() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(3000) / RATE_HZ
    speed = (20.0 + 8.0 * np.sin(0.9 * seconds) + 4.0 * np.sin(2.3 * seconds))[:, np.newaxis]
    effort = 3.0 + 0.5 * speed + 0.8 * np.gradient(speed, 1.0 / RATE_HZ, axis=0)
    healthy = _block(0, 3000, command=effort, measured_speed_rad_s=speed + 0.01 * rng.normal(size=speed.shape))
    coefficients = fitted_balance([[healthy]])
    healthy_balance = FilteredBalance(coefficients).take(healthy)
    loaded = _block(0, 3000, command=effort + 2.0 * (seconds > 15.0)[:, np.newaxis], measured_speed_rad_s=speed)
    shown = FilteredBalance(coefficients).take(loaded)
    assert np.nanmax(healthy_balance) < 0.3
    assert shown[2000:].mean() == pytest.approx(2.0, rel=0.05)


def test_anomalous_rows_less_than_a_second_apart_are_one_event() -> None:
    t_ns = np.arange(0, 10 * S, S // 10)
    anomalous = np.zeros(100, np.bool_)
    anomalous[[10, 11, 15, 40, 41]] = True
    found = events("lateral_1", "lateral", t_ns, anomalous)
    assert [(one.start_ns / S, one.end_ns / S) for one in found] == [(1.0, 1.5), (4.0, 4.1)]
    assert events("healthy_1", "healthy", t_ns, np.zeros(100, np.bool_)) == ()


def test_a_knob_stays_within_its_levels_and_turns_at_its_pace() -> None:
    knobs = Knobs([BY_HAND, Knob(0.3, 0.3, (1e9, 1e9))], seed=4)
    values = np.array([knobs.at(row / RATE_HZ) for row in range(6000)])
    assert BY_HAND.low <= values[:, 0].min() < 0.3
    assert 0.7 < values[:, 0].max() <= BY_HAND.high
    steps = np.abs(np.diff(values[:, 0]))
    assert 0.0 < steps.max() <= (BY_HAND.high - BY_HAND.low) / BY_HAND.turn_s[0] / RATE_HZ + 1e-12
    assert np.all(values[:, 1] == 0.3)


def _at_level(
    level: float, *, is_looped: bool, kind: str = "", size: Array | None = None, seed: int = 5
) -> tuple[Array, Array]:
    """Steady command and reading of a tray, each (fans,), the means of the last ten of thirty seconds."""
    fans = _tray()
    faults = Faults(
        kind=np.full(TRAY_FANS, kind),
        size=np.ones(TRAY_FANS) if size is None else size,
        start_s=np.full(TRAY_FANS, 10.0),
        stop_s=np.full(TRAY_FANS, 1e9),
    )
    knob = Knob(level, level, (1e9, 1e9), is_looped=is_looped)
    plant = Plant(fans, 1, Knobs([knob] * TRAY_FANS, seed), seed, faults if kind else None, days=False)
    blocks = [tray for (tray,) in plant.blocks(30.0)]
    command = np.concatenate([block.command for block in blocks])[2000:].mean(axis=0)
    return command, np.concatenate([block.speed_rad_s for block in blocks])[2000:].mean(axis=0)


@cache
def _healthy_at_level(level: float, *, is_looped: bool) -> tuple[Array, Array]:
    return _at_level(level, is_looped=is_looped)


def _tray() -> FanParameters:
    return tray_of_fans(TRAY_FANS, 7)


@pytest.mark.parametrize("kind", ["inlet", "blade", "rotor", "supply", "tacho-scaling"])
def test_a_fault_in_open_loop_moves_the_speed_by_the_requested_amount(kind: str) -> None:
    fans, nothing = _tray(), np.zeros(TRAY_FANS)
    healthy = severities.held_speed_rad_s(severities.given_v(np.full(TRAY_FANS, 0.6), fans), fans)
    size = severities.size(kind, healthy, fans, np.full(TRAY_FANS, 20.0), nothing)
    _, before = _healthy_at_level(0.6, is_looped=False)
    _, after = _at_level(0.6, is_looped=False, kind=kind, size=size)
    assert before == pytest.approx(healthy, abs=1.0)
    assert after - before == pytest.approx(np.full(TRAY_FANS, 20.0 if kind == "blade" else -20.0), abs=1.0)


@pytest.mark.parametrize("kind", ["inlet", "blade", "rotor", "supply", "tacho-scaling"])
def test_a_fault_in_closed_loop_moves_the_command_by_the_requested_amount(kind: str) -> None:
    fans, nothing = _tray(), np.zeros(TRAY_FANS)
    speed = np.full(TRAY_FANS, 450.0)
    size = severities.size(kind, speed, fans, nothing, np.full(TRAY_FANS, 0.04))
    before, _ = _healthy_at_level(450.0, is_looped=True)
    after, reading = _at_level(450.0, is_looped=True, kind=kind, size=size)
    assert reading == pytest.approx(speed, abs=1.0)
    assert after - before == pytest.approx(np.full(TRAY_FANS, -0.04 if kind == "blade" else 0.04), abs=0.004)


def test_tachos_stick_and_fall_silent_from_the_moment_that_was_drawn() -> None:
    faults = Faults(
        kind=np.resize(["tacho-stuck", "tacho-dropout"], TRAY_FANS),
        size=np.ones(TRAY_FANS),
        start_s=np.full(TRAY_FANS, 5.0),
        stop_s=np.full(TRAY_FANS, 6.0),
    )
    plant = Plant(_tray(), 1, Knobs([BY_HAND] * TRAY_FANS, 6), 6, faults)
    speed = np.concatenate([tray.speed_rad_s for (tray,) in plant.blocks(8.0)])
    silent = np.isnan(speed[:, 1::2])
    assert silent[500:600].all() and not silent[:500].any() and not silent[600:].any()
    assert np.all(speed[500:600, ::2] == speed[499, ::2])
    assert np.all(np.ptp(speed[600:, ::2], axis=0) > 0)


def test_the_same_seed_gives_the_same_runs_and_days_differ() -> None:
    def made(seed: int) -> list[Array]:
        plant = Plant(_tray(), 2, Knobs([Knob(0.6, 0.6, (1e9, 1e9))] * (2 * TRAY_FANS), 8), seed)
        blocks = list(plant.blocks(30.0))
        assert blocks[0][0].host_receive_t_ns[0] == START_NS
        return [np.concatenate([block[run].speed_rad_s for block in blocks]) for run in (0, 1)]

    first, again, other = made(9), made(9), made(10)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    shift = (first[0] - first[1])[1000:].mean(axis=0)
    assert abs(shift.mean()) > 5.0 * shift.std() / np.sqrt(TRAY_FANS)  # all fans feel the day alike
