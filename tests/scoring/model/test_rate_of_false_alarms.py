"""Rate of false alarms: the statistic of a healthy fan grows by one a bin, so its limit is the declared time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import poisson

from fantwin.pipeline.tray_scoring.healthy_twin import HealthyTwin
from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.scoring.model.bins import Bin
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.model.operation import Fans
from tests.support.made_bins import PRIORS, MadeFans, plays, with_reading
from tests.support.scored_blocks import twin_of

DECLARED_S, LASTS_S = 100.0, 150.0
WINDOW_S = 0.5
FANS = 20
SURE = 0.999
NO_ALARM_S = 1e12


def moved(time_s: float) -> float:
    return 300.0 + 60.0 * np.sin(time_s / 10.0) if time_s < LASTS_S / 2 else 300.0


@dataclass(frozen=True)
class Statistics:
    """Statistics of fans up to their first false alarm, or the end."""

    alarms: int
    fan_s: float
    statistic: Array
    bins: Array


def statistics(fans: Fans, bin_s: float, seeds: range) -> Statistics:
    alarms, statistic, bins = 0, list[float](), list[int]()
    for seed in seeds:
        made = MadeFans(fans, bin_s, moved, seed=seed)
        log_limit = made.decision(DECLARED_S).log_limit
        decision = made.decision(NO_ALARM_S)  # so that the statistic goes on beyond the limit, and can be read
        is_free = np.ones(made.count, np.bool_)
        while made.time_s < LASTS_S:
            decision.take(made.next())
            found = is_free & (decision.log_statistic > log_limit)
            ends = is_free if made.time_s >= LASTS_S else found
            alarms += int(found.sum())
            statistic += np.exp(decision.log_statistic[ends]).tolist()
            bins += [made.number] * int(ends.sum())
            is_free &= ~found
    return Statistics(alarms, bin_s * sum(bins), np.array(statistic), np.array(bins))


def counting(fans: Fans) -> Fans:
    """The same with a tacho that counts pulses for half a second."""
    count = len(fans.top_rad_s)
    return replace(fans, pulse_rad_s=np.full(count, 6.3), held_s=np.full(count, 0.5), noise_rad_s=np.full(count, 0.8))


@pytest.mark.parametrize("of_tacho", [lambda fans: fans, counting], ids=["at once", "counting"])
def test_healthy_fans_of_a_population_have_at_most_the_declared_false_alarms_and_the_statistic_keeps_to_the_time(
    of_tacho,
) -> None:
    found = statistics(of_tacho(twin_of(FANS).fans), 0.5, range(2))
    declared = found.fan_s / DECLARED_S
    assert found.alarms <= poisson.ppf(SURE, declared)
    assert found.alarms > 0.05 * declared, "a limit that nothing reaches would be no promise"
    surplus = found.statistic - found.bins
    assert surplus.mean() < 3.0 * surplus.std() / np.sqrt(len(surplus)), "R - t is no more than a martingale"
    assert found.statistic.mean() > 0.2 * found.bins.mean()


def test_one_wrong_reading_in_fifty_of_any_kind_raises_nothing() -> None:
    made = MadeFans(twin_of(FANS).fans, 0.1, moved, seed=5)
    rng, kinds = np.random.default_rng(5), np.array([0.0, 0.5, 2.0, 4.0])
    numbers = itertools.count()

    def with_wrong(one: Bin) -> Bin:
        is_wrong = (next(numbers) + 7 * np.arange(FANS)) % 50 == 49
        measured = one.measured_rad_s * np.where(is_wrong, rng.choice(kinds, FANS), 1.0)
        return with_reading(one, measured - one.predicted_rad_s)

    assert plays(made, made.decision(), 60.0, with_wrong) == []


def test_a_tray_whose_wrong_readings_come_in_pairs_teaches_its_board_and_a_fault_is_still_found() -> None:
    made = MadeFans(counting(twin_of(FANS).fans), 0.5, moved, seed=5)
    decision, numbers = made.decision(86_400.0), itertools.count()

    def in_pairs(one: Bin) -> Bin:
        at = (next(numbers) + 11 * np.arange(FANS)) % 200
        share = np.where(at == 50, 0.5, np.where(at == 51, 2.0 / 3.0, 1.0))
        wrong = with_reading(one, one.measured_rad_s * share - one.predicted_rad_s)
        return replace(wrong, another=one.another | (share < 1.0))

    def slow(one: Bin) -> Bin:
        return replace(with_reading(one, one.measured_rad_s * 0.5 - one.predicted_rad_s), another=one.another)

    first = [fan for _, fan, is_raised in plays(made, decision, 100.0, in_pairs) if is_raised]
    assert len(first) <= 2, "nobody knew that two may be wrong"
    assert not any(is_raised for _, _, is_raised in plays(made, decision, 300.0, in_pairs))
    began_s = made.time_s
    raised = {fan: time_s - began_s for time_s, fan, is_raised in plays(made, decision, 10.0, slow) if is_raised}
    assert len(raised) == FANS
    assert max(raised.values()) <= 3.0


@pytest.mark.parametrize(("shares", "raised_s"), [((0.4, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.0), 1.5), ((0.0, 0.0), None)])
def test_far_readings_of_a_counting_tacho_agree_where_they_differ_or_last_longer_than_one_may_be_shown(
    shares: tuple[float, ...], raised_s: float | None
) -> None:
    made = MadeFans(counting(twin_of(1).fans), 0.5, moved, seed=5)
    decision, shown = made.decision(86_400.0), iter(zip((1.0, *shares), shares, strict=False))
    assert plays(made, decision, 30.0) == []

    def with_far(one: Bin) -> Bin:
        before, share = next(shown, (None, None))
        if share is None:
            return one
        return replace(with_reading(one, (share - 1.0) * one.predicted_rad_s), another=np.array([[share != before]]))

    raised = [time_s - 30.0 for time_s, _, is_raised in plays(made, decision, 3.0, with_far) if is_raised]
    assert raised == ([] if raised_s is None else [raised_s])


def skipping() -> HealthyTwin:
    """Fans whose tachos count for WINDOW_S, twice a sample."""
    return twin_of(FANS, tachos=(Tacho(kind="count", window_s=WINDOW_S),))


def test_where_samples_leave_out_windows_a_count_weighs_as_much_as_it_is_frequent() -> None:
    made = MadeFans(skipping().fans, 1.0, lambda _time_s: 100.0, seed=1)
    decision, pulse_rad_s = made.decision(86400.0), np.pi / WINDOW_S  # two pulses a turn
    for number in range(200):
        is_other = np.full(FANS, number % 5 == 0)
        one = with_reading(made.next(), np.where(is_other, -0.8, 0.2) * pulse_rad_s)
        decision.take(replace(one, another=np.full((1, FANS), number % 5 < 2)))
    assert np.abs(decision.model.expected_rad_s).max() < 0.05 * pulse_rad_s


@pytest.mark.parametrize("rpm", [2250.0, 450.0])
def test_counts_that_err_alike_because_samples_leave_out_windows_raise_nothing_and_a_fault_is_found(rpm: float) -> None:
    """At these speeds a fan makes whole pulses in a second: each window of half a second begins at the same phase."""
    speed, window_s, fans = rpm * RAD_S_PER_UNIT["rpm"], WINDOW_S, skipping().fans
    nothing, phase = np.zeros(FANS), np.random.default_rng(1).uniform(size=FANS)
    turning = replace(fans, pulse_rad_s=nothing, noise_rad_s=nothing + 1e-3, timing_s=nothing)
    made = MadeFans(turning, 1.0, lambda _time_s: speed, seed=1, own=0.0)
    decision = Decision(fans, made.bin_ns, 1.0, 86400.0, PRIORS)
    before = nothing

    def counted(one: Bin) -> Bin:
        nonlocal phase, before
        pulses_hz = (speed * (1.0 - lost) + 0.3 * one.deviation_rad_s) / np.pi  # two a turn
        phase = phase + pulses_hz
        shown = (np.floor(phase) - np.floor(phase - window_s * pulses_hz)) * np.pi / window_s
        before, another = shown, shown != before
        return replace(with_reading(one, shown - speed), another=another[np.newaxis])

    lost = 0.0
    assert plays(made, decision, 300.0, counted) == []
    lost = 0.25
    assert {fan for _, fan, _ in plays(made, decision, 60.0, counted)} == set(range(FANS))
