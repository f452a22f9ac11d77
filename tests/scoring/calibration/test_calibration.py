"""scoring.calibration.calibration: which rate may be promised, how far a limit is raised, and the real rate."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from fantwin.scoring.calibration.calibration import (
    SHOWN_BY,
    Calibration,
    Excursions,
    ObservedRate,
    is_exceeded,
    least_per_day,
    needed_fan_hours,
    raised_limit,
    supports,
    together,
)
from fantwin.scoring.model.population import Priors

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


@pytest.mark.parametrize(
    ("hours", "false", "declared", "enough"),
    [
        (0.29, 0, 8.0, False),  # 0 to 310 per day: nothing is said
        (9.0, 0, 8.0, True),  # three were to be expected
        (240.0, 0, 0.05, True),  # at most 0.37 per day, and less than ten times 0.05
        (240.0, 2, 0.05, False),
        (23.0, 0, None, False),
        (24.0, 0, None, True),
        (0.0, 0, 8.0, False),
    ],
)
def test_a_rate_says_nothing_before_it_can_be_compared(hours, false, declared, enough) -> None:
    assert rate(false, hours=hours, declared=declared).as_json()["enough"] is enough


def test_a_few_minutes_are_too_few_to_tell_a_rate() -> None:
    found = rate(1, unmarked=1, hours=0.083, declared=1.0)
    assert found.text == (
        "1 false alarm in 0.083 judged fan-hours, too few to tell a rate; 1 more is not marked; declared 1"
    )


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


ENTRY: dict[str, Any] = {
    "false_alarms_per_day": 1.0, "fan_hours": 72.0, "runs": 3, "found": 2, "interval_95": (0.08, 2.4)
}  # fmt: skip


def test_the_card_has_only_priors_that_differ_from_those_of_a_population() -> None:
    learned = Calibration(**ENTRY, priors=Priors(air=0.02, wander=Priors().wander))
    stored = learned.model_dump_json()
    assert '"priors":{"air":0.02}' in stored
    assert Calibration.model_validate_json(stored) == learned
    assert Calibration(**ENTRY).model_dump()["priors"] == {}


@pytest.mark.parametrize(
    "wrong",
    [
        {"priors": {"airs": 0.01}},
        {"priors": {"air": 0.0}},
        {"priors": {"air": math.nan}},
        {"limit_factor": 0.9},
        {"false_alarms_per_day": 0.0},
        {"detectors": {}},
    ],
)
def test_an_entry_that_a_scorer_could_not_use_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Calibration.model_validate(ENTRY | wrong)


@given(st.floats(1e-4, 1e6))
def test_a_rate_that_is_suggested_is_shown_by_the_same_hours_and_is_hardly_higher_than_needed(fan_hours: float) -> None:
    rate = least_per_day(fan_hours)
    assert supports(fan_hours, rate)
    assert rate < 1.11 * needed_fan_hours(fan_hours)


def test_a_rate_is_a_target_below_the_hours_in_which_no_alarm_would_show_it() -> None:
    assert math.exp(-SHOWN_BY) < 0.05, "of a rate as high as declared, none is found in less than one of twenty"
    assert not Calibration(**ENTRY).is_target
    assert Calibration.model_validate(ENTRY | {"fan_hours": 71.9}).is_target


def test_a_rate_is_exceeded_only_by_more_alarms_than_chance_explains() -> None:
    assert [is_exceeded(found, 100.0, 1.0) for found in (0, 7, 9, 10)] == [False, False, False, True]


def test_an_excursion_has_one_peak_however_often_it_falls_below_the_limit_within_it() -> None:
    excursions = Excursions(2)
    for score in ([0.2, 0.9], [1.2, 0.9], [0.8, 0.2], [1.5, 0.3], [0.4, 0.2], [0.1, 1.1], [2.0, 1.3], [0.3, 0.9]):
        excursions.take(np.array(score))
    assert sorted(excursions.peaks) == [1.3, 1.5, 2.0], "that of the other fan has not ended"


@given(st.lists(st.floats(0.0, 50.0), max_size=20), st.integers(0, 5))
def test_a_limit_is_raised_only_as_far_as_the_allowed_number_of_peaks_needs(peaks: list[float], allowed: int) -> None:
    factor = raised_limit(peaks, allowed)
    assert sum(peak > factor for peak in peaks) <= allowed
    if factor > 1.0:
        assert sum(peak > 0.999 * factor for peak in peaks) > allowed
