"""What the rate of alarms rests on is kept: stretches of judged time, and alarms that were raised within them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.pipeline.site import alarm_rates
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.alarm_rates import AlarmRates, JudgedStretch, JudgedTime
from fantwin.schemas.enums import Transition
from fantwin.schemas.units import NS_PER_S
from tests.support.made_messages import alarm
from tests.support.site_messages import score

HOUR_NS = 3600 * NS_PER_S
FIRST = JudgedStretch("tray1", "twin", NS_PER_S, NS_PER_S + HOUR_NS, 8 * HOUR_NS, 0.1)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[AlarmHistory]:
    with closing(AlarmHistory(tmp_path / "alarms.sqlite")) as store:
        yield store


def test_a_stretch_that_grows_for_long_does_not_push_out_the_ones_before_it(store, monkeypatch) -> None:
    monkeypatch.setattr(alarm_rates, "MOST_KEPT", 10)
    rates = AlarmRates(store)
    store.add(alarm(0, FIRST.last_t_ns, sequence=1, transition=Transition.RAISED))
    rates.catch_up([FIRST])
    growing = replace(FIRST, first_t_ns=FIRST.last_t_ns + HOUR_NS)
    for saves in range(20):
        rates.catch_up([replace(growing, last_t_ns=growing.first_t_ns + saves * NS_PER_S, fan_ns=saves)])
    observed = rates.observed()["tray1"]
    assert observed.since_t_ns == FIRST.first_t_ns and observed.fan_hours == pytest.approx(8.0)
    assert observed.unmarked == 1


def test_alarms_count_from_the_first_to_the_last_score_of_the_twin_in_force(store) -> None:
    rates = AlarmRates(store)
    other = replace(FIRST, twin="former", first_t_ns=FIRST.last_t_ns + HOUR_NS, last_t_ns=FIRST.last_t_ns + 2 * HOUR_NS)
    last = replace(FIRST, first_t_ns=other.last_t_ns + HOUR_NS, last_t_ns=other.last_t_ns + 2 * HOUR_NS)
    within = [FIRST.first_t_ns, FIRST.last_t_ns, last.first_t_ns, last.last_t_ns]
    outside = [FIRST.first_t_ns - 1, FIRST.last_t_ns + 1, other.first_t_ns, last.first_t_ns - 1, last.last_t_ns + 1]
    for number, t_ns in enumerate([*within, *outside]):
        store.add(alarm(0, t_ns, sequence=number, transition=Transition.RAISED))
    rates.catch_up([FIRST, other, last])
    assert rates.observed()["tray1"].unmarked == len(within)


def test_the_time_of_fans_that_are_sampled_slowly_counts() -> None:
    judged, period_ns = JudgedTime(), 10 * NS_PER_S
    for number in range(7):
        one = replace(score(number * 10.0, samples=1), period_ns=period_ns)
        judged.add(one, "twin", None)
    (growing,) = judged.growing()
    assert growing.fan_ns == 6 * period_ns * int(score().valid[-1].sum())
    judged.add(replace(score(60.0 + 31.0, samples=1), period_ns=period_ns), "twin", None)
    assert judged.growing()[0].fan_ns == 0, "a longer pause ends it"
