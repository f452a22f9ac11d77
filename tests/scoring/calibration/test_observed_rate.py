"""scoring.calibration.calibration: the rate of false alarms that really was, with its exact interval."""

from __future__ import annotations

import pytest

from fantwin.scoring.calibration.calibration import ObservedRate, together

DAYS_100 = 2400.0


def rate(
    false: int, true: int = 0, unmarked: int = 0, *, hours: float = DAYS_100, declared: float | None = 0.03
) -> ObservedRate:
    return ObservedRate(10, hours, false, true, unmarked, declared)


@pytest.mark.parametrize(
    ("alarms", "low", "high"),
    [(0, 0.0, 3.6889), (1, 0.0253, 5.5716), (3, 0.6187, 8.7673), (10, 4.7954, 18.3904)],
    ids=["none", "one", "three", "ten"],
)
def test_the_interval_is_that_of_the_tables_of_garwood(alarms: int, low: float, high: float) -> None:
    found = rate(alarms).interval_95(alarms)
    assert [100 * each for each in found] == pytest.approx([low, high], abs=5e-4)


def test_only_false_alarms_count_and_those_that_nobody_marked_are_counted_apart() -> None:
    found = rate(2, true=5, unmarked=3)
    assert found.text == (
        "2 false alarms in 2,400 judged fan-hours: 0.02 per fan and day (95 %: 0.0024 to 0.072); 3 more are not "
        "marked, with them 0.05 per fan and day (95 %: 0.016 to 0.12); declared 0.03"
    )
    shown = found.as_json()
    assert (shown["false_alarms_per_day"], shown["with_unmarked_per_day"]) == (0.02, 0.05)
    assert (shown["true_alarms"], shown["declared_per_day"]) == (5, 0.03)


def test_where_no_time_is_known_there_is_no_rate() -> None:
    found = rate(1, hours=0.0, declared=None)
    assert found.text == "1 false alarm, and how long fans were judged is not known; no rate is declared"
    assert found.as_json()["false_alarms_per_day"] is None


def test_trays_together_have_the_mean_of_what_they_declare_over_the_judged_time() -> None:
    both = together([rate(1, unmarked=1, hours=300.0, declared=0.1), rate(0, true=2, hours=100.0, declared=0.5)])
    assert (both.false_alarms, both.true_alarms, both.unmarked, both.fan_hours) == (1, 2, 1, 400.0)
    assert both.declared_per_day == pytest.approx(0.2)
    assert together([rate(1), rate(0, declared=None)]).declared_per_day is None
    assert together([rate(1), rate(0, hours=0.0, declared=None)]).declared_per_day == 0.03, "never judged: no matter"
    assert together([]).fan_hours == 0.0
