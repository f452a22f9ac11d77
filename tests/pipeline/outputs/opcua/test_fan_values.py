"""Values of fans and their quality: never an old value as good."""

from __future__ import annotations

import numpy as np
import pytest

from fantwin.pipeline.outputs.opcua.fan_values import NO_VALUE, NONE_YET, OLD, SILENT_TRAY, FanValues
from fantwin.pipeline.site.fleet import Fan, FanNow
from fantwin.pipeline.site.site_model import TrayNow
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.units import RAD_S_PER_UNIT

RPM = RAD_S_PER_UNIT["rpm"]
NAN = float("nan")
FAN = Fan("tray1", 0)
NUMBERS = ("Speed", "PredictedSpeed", "BandHalfWidth", "Score")


def values(
    *curves: float, judged: bool = True, reason: InvalidReason = InvalidReason.NONE, is_heard: bool = True
) -> FanValues:
    tray = TrayNow(
        "tray1",
        1_000,
        np.array([curves], np.float32),
        np.array([judged]),
        np.array([int(reason)], np.uint8),
        is_heard,
    )
    return FanValues([tray], [FanNow(FAN, "normal", 0.5, 900, False)])


def test_a_judged_fan_has_good_values_of_the_time_of_its_sample():
    now = values(1000 * RPM, 1010 * RPM, 20 * RPM, 0.01, 0.5)
    found = [now.of(FAN, name) for name in NUMBERS]
    assert [each.value for each in found] == [pytest.approx(x, rel=1e-6) for x in (1000.0, 1010.0, 20.0, 0.5)]
    assert {(each.status, each.t_ns) for each in found} == {("Good", 1_000)}
    assert now.of(FAN, "State") == ("normal", "Good", 900)
    assert now.of(FAN, "Judged") == (True, "Good", 900)


def test_of_a_silent_tray_every_number_is_uncertain_and_no_fan_is_judged():
    now = values(1000 * RPM, 1010 * RPM, 20 * RPM, 0.01, 0.5, is_heard=False)
    assert {now.of(FAN, name).status for name in NUMBERS} == {SILENT_TRAY}
    assert now.of(FAN, "Judged").value is False


def test_where_a_fan_is_not_judged_there_is_no_score_and_a_held_speed_is_uncertain():
    held = values(1000 * RPM, NAN, NAN, NAN, NAN, judged=False, reason=InvalidReason.STALE)
    assert [held.of(FAN, name).status for name in NUMBERS] == [OLD, NO_VALUE, NO_VALUE, NO_VALUE]
    measured = values(1000 * RPM, NAN, NAN, NAN, NAN, judged=False, reason=InvalidReason.OUT_OF_RANGE)
    assert measured.of(FAN, "Speed").status == "Good", "the speed itself is measured"
    assert measured.of(FAN, "Judged").value is False


def test_before_the_first_sample_there_is_nothing():
    now = FanValues()
    assert {now.of(FAN, name) for name in NUMBERS} == {(None, NONE_YET, 0)}
    assert now.of(FAN, "State").value == "silent"
