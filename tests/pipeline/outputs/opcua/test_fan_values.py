"""Values of fans and their quality: never an old value as good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.pipeline.outputs.opcua.fan_values import NONE_YET, SILENT_TRAY, FanValues
from fantwin.pipeline.site.fleet import Fan, FanGroup, FanNow
from fantwin.pipeline.site.site_model import TrayNow
from fantwin.schemas.enums import InvalidReason

FAN = Fan("tray1", 0)
NUMBERS = ("Speed", "PredictedSpeed", "BandHalfWidth", "Score")


def test_every_number_of_a_silent_tray_is_uncertain_and_there_is_none_before_the_first_sample():
    curves, reason = np.array([[100.0, 101.0, 2.0, 0.01, 0.5]], np.float32), np.zeros(1, np.uint8)
    heard = TrayNow("tray1", 1_000, curves, np.array([True]), reason, True)
    states = [FanNow(FAN, "normal", FanGroup.NORMAL, 0.5, 900)]
    now = FanValues([replace(heard, is_heard=False)], states)
    assert {now.of(FAN, name).status for name in NUMBERS} == {SILENT_TRAY}
    assert now.of(FAN, "Judged").value is False
    refused = replace(heard, is_judged=np.array([False]), invalid_reason=reason + InvalidReason.OUT_OF_RANGE)
    assert FanValues([refused], states).of(FAN, "Speed").status == "Good", "the speed itself is measured"
    assert {FanValues().of(FAN, name) for name in NUMBERS} == {(None, NONE_YET, 0)}
    assert FanValues().of(FAN, "State").value == "silent"


def test_the_last_numbers_of_a_silent_line_are_shown_with_their_time_as_long_as_it_is_silent():
    """Also once the tray has sent nothing at all: its last samples had no speed."""
    curves, reason = np.array([[100.0, 101.0, 2.0, 0.01, 0.5]], np.float32), np.zeros(1, np.uint8)
    heard = TrayNow("tray1", 1_000, curves, np.array([True]), reason, True)
    missing = replace(heard, t_ns=2_000, values=np.full_like(curves, np.nan), invalid_reason=reason + InvalidReason.GAP)
    stale = replace(missing, t_ns=3_000, invalid_reason=reason + InvalidReason.STALE)
    gap = FanValues([missing], (), FanValues([heard]))
    assert (gap.of(FAN, "Speed").status, gap.of(FAN, "Speed").t_ns) == ("UncertainLastUsableValue", 1_000)
    assert gap.of(FAN, "Score") == (None, "BadNoData", 2_000), "it is not scored"
    silent = FanValues([replace(stale, is_heard=False)], (), FanValues([stale], (), gap))
    assert {silent.of(FAN, name)[1:] for name in NUMBERS} == {(SILENT_TRAY, 1_000)}
    assert silent.of(FAN, "Score").value == 0.5
    assert FanValues([stale]).of(FAN, "Speed").status == "BadNoData", "there has been none"
    unscored = replace(stale, t_ns=4_000, invalid_reason=reason + InvalidReason.OUT_OF_RANGE)
    assert FanValues([unscored], (), silent).of(FAN, "Score").status == "BadNoData"
