"""The bench of the racks: what a tacho can show at all, how alarms are counted, and one small rack from end to end."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bench.detection import rack_recordings, rack_scoring
from bench.detection.metrics import Event
from bench.detection.ours import NAME
from bench.detection.rack_campaign import RackResult, one_rack
from bench.detection.rack_limits import Facts, facts_of_rack, information_limit_s
from bench.detection.rack_recordings import FAULTY, HEALTHY, LEARNING, RackData
from bench.detection.rack_scoring import Episode, Judged, episodes
from bench.detection.rack_tables import AFTER_S, beside, found_faults
from bench.detection.racks import events, run_of
from pipeline.cli.twins.train import train
from schemas.enums import Severity
from schemas.messages import Alarm, Array, Diagnosis
from schemas.tacho import Tacho

COUNT = Tacho(kind="count", window_s=1.0)
SECOND = 1_000_000_000


def readings(drop_rad_s: float) -> tuple[Array, Array, Array]:
    """Reports at 10 Hz of a fan at 100 rad/s, whose counts end at 0.4 s, 1.4 s and so on; from then on it is slower."""
    t_s = np.round(np.arange(1, 41) * 0.1, 6)
    healthy = np.full(len(t_s), 100.0)
    return t_s, healthy, np.where(t_s >= 0.4, healthy - drop_rad_s, healthy)


@pytest.mark.parametrize(("drop_rad_s", "expected_s"), [(6.0, 0.4), (5.0, 1.4), (2.0, 3.4), (0.1, math.nan)])
def test_the_limit_of_a_count_is_as_worked_by_hand(drop_rad_s: float, expected_s: float) -> None:
    # Variance of the sum of n counts: (2 pi / 2)^2 / 6 + n (0.003 * 100)^2 = 1.645 + 0.09 n. 86,400 counts a day: 4.39
    # sigma, squared 19.2. One count of 6 rad/s: 20.7; of 5 rad/s: 14.4, two 54.8; of 2 rad/s three 18.8, four 31.9.
    limit_s = information_limit_s(*readings(drop_rad_s), COUNT)
    assert limit_s == pytest.approx(expected_s, nan_ok=True)


def test_the_limit_of_missing_readings_is_as_worked_by_hand() -> None:
    # ln(0.35 / 0.002) = 5.16 for each that is missing, ln(0.65 / 0.998) = -0.43 for each other; ln(86,400) = 11.4.
    t_s, healthy, _ = readings(0.0)
    pattern = np.where(np.isin(np.arange(len(t_s)), [2, 5, 8, 9, 10]), np.nan, healthy)
    assert information_limit_s(t_s, healthy, pattern, COUNT, 0.35) == t_s[8]
    assert math.isnan(information_limit_s(t_s, healthy, healthy, COUNT, 0.35))


def alarm(fan: int, t_s: float, *, active: bool = True, causes: dict[str, float] | None = None) -> Alarm:
    return Alarm(
        fan=fan,
        active=active,
        severity=Severity.WARNING,
        t_ns=round(t_s * SECOND),
        onset_t_ns=0,
        residual_rad_s=0.0,
        limit_rad_s=0.0,
        message="",
        causes=tuple(Diagnosis(cause=cause, probability=probability) for cause, probability in (causes or {}).items()),
    )


def test_an_alarm_is_one_from_raised_to_cleared_with_its_first_named_and_its_last_cause() -> None:
    found = episodes(
        [
            alarm(1, 10.0, causes={"cannot_tell": 0.5}),
            alarm(1, 11.0, causes={"drag_up": 0.6, "blocked": 0.4}),
            alarm(1, 12.0, causes={"drag_up": 0.2, "blocked": 0.8}),
            alarm(1, 20.0, active=False),
            alarm(0, 15.0),
        ]
    )
    assert [(one.fan, one.raised_ns // SECOND, one.first_cause, one.last_cause) for one in found] == [
        (1, 10, "drag_up", "blocked"),
        (0, 15, "", ""),
    ]
    assert [one.cleared_ns for one in found] == [20 * SECOND, None]


def test_alarms_are_matched_with_faults_and_false_only_where_no_fault_explains_them() -> None:
    fault = Event("rack1", 2, 100 * SECOND, 200 * SECOND, "blade", "external_torque")
    raised_s = (50, 104, 150, 205, 200 + AFTER_S + 1)
    alarms = [Episode(2, round(t_s) * SECOND, round(t_s + 5) * SECOND, "", "", "a", "b") for t_s in raised_s]
    result = RackResult(0, "15 minutes", Judged(ours=[*alarms, replace(alarms[1], fan=3)]), None)
    (found,) = found_faults(result, [fault], [Facts(limit_s=1.0, moved_after_s=8.0)])
    assert (found.delay_s, found.alarms, found.is_moved) == (4.0, 2, True)  # it moved before the first alarm was over
    assert beside(result.faulty, "rack1", NAME, [fault]) == (3, 1)  # two of fan 2, one of fan 3; one at the end


def test_a_small_rack_learns_and_is_judged_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rack_recordings, "SHORT_S", 60.0)
    monkeypatch.setattr(rack_scoring, "train", partial(train, iterations=3))
    monkeypatch.setitem(LEARNING, "15 minutes", ("minutes", 60.0, 2))
    data = RackData(tmp_path, 1, 2.0, test_s=600.0, seed=2)
    data.make(["15 minutes"], lambda _: None)
    truth = events(data.faults())
    assert {one.run for one in truth} == {run_of(0)}
    facts = facts_of_rack(data.test(HEALTHY, 0), data.test(FAULTY, 0), truth)
    limits = {one.kind: fact.limit_s for one, fact in zip(truth, facts, strict=True)}
    assert 0.0 < limits["blocked"] < 2.6  # a window of 1 s that began before it, the next report, and a lost line
    (result,) = one_rack(data, 0, ["15 minutes"], False)
    found = {one.event.kind: one for one in found_faults(result, truth, facts)}
    assert limits["blocked"] <= found["blocked"].delay_s
    assert 0.3 < result.faulty.fan_hours < 0.67  # of 4 fans for ten minutes, less starts and stops
    assert one_rack(data, 0, ["15 minutes"], False) == [result]  # kept
