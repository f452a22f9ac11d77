"""scoring.model.learned: healthy runs widen and narrow the priors of what they show, in any order."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from fantwin.scoring.model.bins import Bin, Bins, bin_ns_of
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.model.learned import HealthyRun, RunSums, learned_priors
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.model.population import Priors
from tests.support.healthy_running import made_fans, running

FANS = 24
BIN_NS = bin_ns_of(running(1, 1.0, 0).period_ns, 0.0)
RUN_S = 180.0
"""long enough for what the air does"""


def bins_of(seconds: float, seed: int, **varies: float) -> list[Bin]:
    fans = made_fans(FANS)
    bins = Bins(BIN_NS, fans.top_rad_s, fans.reads_balance, None)
    return list(bins.take(running(FANS, seconds, seed, **varies)))


def sums_of(bins: Sequence[Bin], fans: Fans | None = None) -> RunSums:
    run = HealthyRun(fans or made_fans(FANS), BIN_NS)
    for one in bins:
        run.take(one)
    return run.sums


def priors_of(seconds: float = RUN_S, **varies: float) -> Priors:
    return learned_priors([sums_of(bins_of(seconds, seed, **varies)) for seed in range(2)])


def alarms(priors: Priors, seeds: range, **varies: float) -> int:
    """Those of other runs of half a minute, of which 0.8 are declared."""
    found = 0
    for seed in seeds:
        decision = Decision(made_fans(FANS), BIN_NS, 0.1, 3600.0, priors)
        found += sum(change.raised for one in bins_of(30.0, seed, **varies) for change in decision.take(one))
    return found


def test_fans_that_differ_from_run_to_run_widen_the_prior_and_then_keep_the_rate_in_other_runs() -> None:
    priors = priors_of(60.0, mean=0.06)
    assert 0.03 < priors.twin_share < 0.07
    others = range(100, 104)
    assert alarms(Priors(), others, mean=0.06) > 4, "or there was nothing to learn"
    assert alarms(priors, others, mean=0.06) <= 2


def test_each_prior_follows_what_was_planted_and_narrows_where_there_is_less() -> None:
    quiet, windy, wandering = priors_of(), priors_of(air=0.05), priors_of(wander=0.006)
    of_population = Priors()
    assert quiet.twin_share < of_population.twin_share and quiet.wander < of_population.wander
    assert 0.025 < windy.air < 0.1
    assert wandering.wander == pytest.approx(0.006, rel=0.2)
    learned_ones = {"twin_share", "air", "wander"}
    assert {name for name, value in vars(windy).items() if value != vars(of_population)[name]} == learned_ones


def test_what_noise_hides_widens_no_prior_so_that_a_fan_that_is_slow_from_its_first_sample_has_an_alarm() -> None:
    """A tray read once a second, whose readings scatter by a per cent: the air is not seen, and was taken for six."""
    pairs, noise = np.array([600.0, 300.0, 75.0]), 0.01
    priors = learned_priors([RunSums(np.full(3, 7200.0), np.zeros(3), pairs, 2.0 * pairs * noise**2)])
    assert priors.air < 0.025
    whole = running(FANS, 20.0, 0)
    slow = replace(whole, measured_speed_rad_s=0.82 * whole.measured_speed_rad_s)
    fans = made_fans(FANS)
    decision = Decision(fans, BIN_NS, 0.1, 86_400.0, priors)
    for one in Bins(BIN_NS, fans.top_rad_s, fans.reads_balance, None).take(slow):
        decision.take(one)
    assert decision.active.all()


def test_the_order_of_runs_and_where_they_were_added_up_change_no_bit() -> None:
    runs = [sums_of(bins_of(30.0, seed, mean=0.05)) for seed in range(4)]
    shuffled = runs.copy()
    random.Random(1).shuffle(shuffled)
    assert learned_priors(runs) == learned_priors(shuffled) != Priors()


def test_of_tachos_that_count_only_the_means_are_learned_and_of_nothing_nothing() -> None:
    counting = replace(made_fans(FANS), pulse_rad_s=np.full(FANS, 3.0))
    runs = [sums_of(bins_of(60.0, seed, mean=0.06), counting) for seed in range(2)]
    priors = learned_priors(runs)
    assert priors.twin_share > Priors().twin_share
    assert (priors.air, priors.wander) == (Priors().air, Priors().wander)
    assert learned_priors([]) == learned_priors([sums_of([])]) == Priors()
