"""A fan over any range of time, from the live history and from recordings: nothing odd is lost by decimation."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.recordings import time_range
from fantwin.pipeline.recordings.records import chunk_at
from fantwin.pipeline.recordings.time_range import RecordedRange
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.fan_history import HISTORY_S
from fantwin.pipeline.site.fan_series import FanSeries
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.tray_scoring.overview_rows import OverviewRows
from fantwin.schemas.enums import Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, Overview, Raw, Score, newest_t_ns
from fantwin.schemas.topics import tray_key
from tests.support.made_messages import TOPIC_OF, alarm, filled

TRAY, FANS, SITE = "tray1", 2, "hall"
FAN = Fan(TRAY, 1)
START_NS = 1_790_000_000_000_000_000
STEP_NS = 10_000_000
BLOCK = 100
SPIKE = 7.0
"""V, in one sample of fan 1; otherwise the supply has 12 V"""


def score(number: int, **given: Any) -> Score:
    """A second of samples at 100 Hz; fan 1 runs 3 rad/s below its twin."""
    t_ns = START_NS + (number * BLOCK + np.arange(BLOCK)) * STEP_NS
    values: dict[str, Any] = {"measured_speed_rad_s": 297.0, "predicted_speed_rad_s": 300.0, "band_variance": 16.0}
    values |= {"command": 50.0, "score": 0.5, "torque_balance_command": 0.1, "supply_voltage_v": 12.0, "state": 0}
    header = Header("scorer-1", number, TRAY)
    return filled(Score, BLOCK, FANS, header=header, period_ns=STEP_NS, t_ns=t_ns, **values, **given)


def raw(number: int) -> Raw:
    """The same as a source sent it."""
    made = score(number)
    given = {"command": 50.0, "speed_rad_s": 297.0, "supply_voltage_v": 12.0, "host_receive_t_ns": made.t_ns}
    return filled(Raw, BLOCK, FANS, header=Header("acquisition-1", number, TRAY), **given)


def with_spike(message: Any) -> Any:
    message.supply_voltage_v[57, 1] = SPIKE
    return message


@pytest.fixture
def model(tmp_path: Path) -> SiteModel:
    trays = (TrayConfig(name=TRAY, fans=FANS, speed_unit="rad/s"),)
    return SiteModel(SITE, trays, AlarmHistory(tmp_path / "alarms.sqlite"), keeps_curves=True)


def overview(scores: Iterable[Score]) -> list[Overview]:
    """What the scorer publishes beside these."""
    rows = OverviewRows()
    made = [message for each in scores for message in rows.add(each)]
    header = Header("scorer-1", 0, TRAY)
    return [replace(each, header=header) for each in (*made, *rows.so_far())]


def record(folder: Path, *messages: Raw | Score | Overview, part: int = 1, finish: bool = True) -> RecordedRange:
    """The messages in a part of a recording, flushed every ten; finish: the recorder has ended it."""
    name = "recording.mcap" if part == 1 else f"recording-{part}.mcap"
    writer = RecordingWriter(folder / name, {"site": SITE, "trays": TRAY, "recording": "recording.mcap"})
    for number, message in enumerate(messages):
        topic = TOPIC_OF[type(message)]
        writer.add(Envelope.of(tray_key(SITE, TRAY, topic), message, newest_t_ns(message)))
        if number % 10 == 9:
            writer.flush()
    writer.flush()
    if finish:
        writer.finish()
    return RecordedRange([folder / "recording.mcap"])


def at(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


def test_one_odd_sample_survives_in_the_last_hour_and_a_gap_is_a_gap(model):
    for number in (*range(60), *range(80, 120)):
        made = score(number)
        model.add_decoded_score(TRAY, with_spike(made) if number == 20 else made)
    found = FanSeries(model, None).as_json(FAN, at(0.99), at(120), 20)
    columns, t_s = found["columns"], np.array(found["t_s"]) - START_NS / 1e9
    supply = columns["supply_voltage_v"]
    assert min(value for value in supply["min"] if value is not None) == SPIKE
    (spike,) = [point for point, value in enumerate(supply["min"]) if value == SPIKE]
    assert abs(t_s[spike] - 20.57) <= found["bucket_s"]
    assert (supply["max"][spike], SPIKE < supply["mean"][spike] < 12.0) == (12.0, True)
    assert (columns["deviation"]["mean"][0], columns["half_width"]["max"][0]) == (-3.0, 4.0)
    (hole,) = [point for point, value in enumerate(columns["measured"]["mean"]) if value is None]
    assert 60 <= t_s[hole] <= 80, "no line is drawn where no samples came"
    assert len(t_s) <= 21
    assert found["note"] == ""


def test_recordings_continue_the_past_with_every_odd_sample_also_in_the_part_that_is_being_written(model, tmp_path):
    first = [with_spike(raw(number)) if number == 33 else raw(number) for number in range(100)]
    record(tmp_path, *first)
    recorded = record(tmp_path, *(raw(number) for number in range(150, 200)), part=2, finish=False)
    late = 2 * HISTORY_S
    model.add_decoded_score(TRAY, replace(score(0), t_ns=score(0).t_ns + late * 10**9))
    found = FanSeries(model, recorded).as_json(FAN, at(0), at(late + 10), 400)
    columns, t_s = found["columns"], np.array(found["t_s"]) - START_NS / 1e9
    supply = np.array(columns["supply_voltage_v"]["min"], float)
    assert np.nanmin(supply) == SPIKE
    assert abs(t_s[np.nanargmin(supply)] - 33.57) <= found["bucket_s"]
    holes = t_s[np.isnan(np.array(columns["measured"]["mean"], float))]
    assert [100 <= holes[0] <= 150, 200 <= holes[1] <= late, len(holes)] == [True, True, 2]
    assert columns["deviation"]["mean"][0] is None, "the twin is not recorded"
    assert columns["deviation"]["mean"][-1] == -3.0, "the last hour knows it"
    assert found["note"] == "of recorded times only what was measured: no twin judged it"
    rows = list(csv.DictReader(StringIO(FanSeries(model, recorded).as_csv(FAN, at(33), at(34), 4000))))
    assert len(rows) == 100, "zoomed in, each sample"
    (odd,) = [row for row in rows if float(row["supply_voltage_v_min"]) < 12]
    assert (float(odd["supply_voltage_v_max"]), odd["measured_rad_s_mean"], odd["predicted_rad_s_mean"]) == (
        SPIKE,
        "297",
        "",
    )
    assert odd["time"] == "2026-09-21T14:13:53.570+00:00"


HOLE, SPIKED, UNJUDGED = 20, 32, 40
"""seconds without samples, with odd samples, and in which fan 1 was not judged"""


@pytest.fixture
def of_the_morning(tmp_path: Path) -> RecordedRange:
    """A minute as a recorder keeps it by default. In one sample fan 1 runs 20 rad/s below its twin and reaches a score
    of 1.5, in another 20 above."""
    scores = [score(number) for number in range(60) if number != HOLE]
    of_second = {each.header.sequence: each for each in scores}
    spike = of_second[SPIKED]
    for row, speed in ((57, 280.0), (58, 320.0)):
        spike.measured_speed_rad_s[row, 1] = speed
    spike.score[57, 1] = 1.5
    of_second[UNJUDGED].valid[:, 1] = False
    raws = [replace(raw(each.header.sequence), speed_rad_s=each.measured_speed_rad_s) for each in scores]
    by_time = sorted((*raws, *overview(scores)), key=newest_t_ns)
    return record(tmp_path, *by_time)


def test_twin_band_deviation_and_score_of_hours_ago_are_there_with_every_odd_sample(model, of_the_morning):
    late = score(0)
    model.add_decoded_score(TRAY, replace(late, t_ns=late.t_ns + 3 * HISTORY_S * 10**9))
    found = FanSeries(model, of_the_morning).as_json(FAN, at(0), at(60), 12)
    columns, t_s = found["columns"], np.array(found["t_s"]) - START_NS / 1e9
    assert found["note"] == ""
    assert set(columns["predicted"]["mean"]) == {300.0} and set(columns["half_width"]["max"]) == {4.0}
    (low,), (high,), (near,) = (
        [at for at, value in enumerate(columns[name][kind]) if value == odd]
        for name, kind, odd in (("deviation", "min", -20.0), ("deviation", "max", 20.0), ("score", "max", 1.5))
    )
    assert low == high == near and abs(t_s[low] - SPIKED - 0.5) <= found["bucket_s"]
    assert columns["deviation"]["mean"][low] == pytest.approx(-3.0, abs=0.5)
    assert columns["measured"]["min"][low] == 280.0


def test_zoomed_in_each_sample_has_the_twin_of_its_second_and_gaps_stay_gaps(model, of_the_morning):
    found = FanSeries(model, of_the_morning).as_json(FAN, at(19), at(42), 2300)
    columns, t_s = found["columns"], np.array(found["t_s"]) - START_NS / 1e9
    measured, deviation, predicted = (
        np.array(columns[name]["mean"], float) for name in ("measured", "deviation", "predicted")
    )
    (hole,) = np.flatnonzero(np.isnan(measured))
    assert HOLE <= t_s[hole] <= HOLE + 1 and len(t_s) == 2200 + 1
    unknown = np.flatnonzero(np.isnan(predicted))
    assert set(np.floor(t_s[unknown])) == {HOLE, UNJUDGED} and len(unknown) == 1 + BLOCK
    of_spike = np.flatnonzero(np.floor(t_s) == SPIKED)
    assert set(np.array(columns["deviation"]["min"])[of_spike]) == {-20.0}
    assert np.isfinite(deviation[of_spike]).all() and measured[of_spike].min() == 280.0


def test_an_overview_alone_is_shown_where_no_samples_are_recorded(model, tmp_path):
    recorded = record(tmp_path, *overview(map(score, range(30))))
    found = FanSeries(model, recorded).as_json(FAN, at(0), at(30), 30)
    assert found["columns"]["deviation"]["max"] == [-3.0] * 30
    assert set(found["columns"]["measured"]["mean"]) == {None}


def test_recorded_scores_are_shown_with_their_twin_and_only_chunks_of_the_range_are_opened(
    model, tmp_path, monkeypatch
):
    messages = [each for number in range(100) for each in (raw(number), score(number))]
    recorded = record(tmp_path, *messages)
    opened: list[int] = []
    monkeypatch.setattr(time_range, "chunk_at", lambda *place: opened.append(1) or chunk_at(*place))
    found = FanSeries(model, recorded).as_json(FAN, at(10), at(11), 1000)
    assert (found["columns"]["deviation"]["mean"], found["note"]) == ([-3.0] * 100, "")
    assert len(opened) <= 16, "a message may be received a minute late"
    (tmp_path / "recording.mcap").write_bytes((tmp_path / "recording.mcap").read_bytes()[:-4000])
    assert FanSeries(model, recorded).as_json(FAN, at(10), at(11), 10)["columns"]["measured"]["mean"]


def test_without_recordings_the_answer_says_so(model):
    assert "no recorder" in FanSeries(model, None).as_json(FAN, at(0), at(10), 10)["note"]


def test_marks_are_the_alarm_and_what_operators_did_and_causes_hold_until_the_next_diagnosis(model):
    def add(seconds: float, transition: Transition, *causes: tuple[str, float], **more: Any) -> Alarm:
        diagnoses = tuple(Diagnosis(cause=name, probability=share) for name, share in causes)
        fields = {"t_ns": at(seconds), "onset_t_ns": at(5), "transition": transition, "causes": diagnoses, **more}
        made = alarm(FAN.number, tray=TRAY, sequence=round(seconds), **fields)
        model.add_alarm(made)
        return made

    add(6, Transition.RAISED, ("drag", 0.6), ("drive", 0.4))
    add(20, Transition.DIAGNOSED, ("drag", 0.9))
    add(30, Transition.ACKNOWLEDGED, operator_name="ann", comment="seen")
    add(40, Transition.CLEARED, active=False)
    whole = FanSeries(model, None).as_json(FAN, at(0), at(60), 10)
    assert [mark["transition"] for mark in whole["marks"]] == ["raised", "diagnosed", "acknowledged", "cleared"]
    assert (whole["marks"][2]["operator_name"], whole["marks"][2]["comment"]) == ("ann", "seen")
    steps = [(round(each["t_s"] - START_NS / 1e9), sorted(each["probabilities"].values())) for each in whole["causes"]]
    assert steps == [(6, [0.4, 0.6]), (20, [0.9]), (40, [])]
    inside = FanSeries(model, None).as_json(FAN, at(25), at(35), 10)
    assert [sorted(each["probabilities"].values()) for each in inside["causes"]] == [[0.9]], "it began before the range"
    assert FanSeries(model, None).as_json(Fan(TRAY, 0), at(0), at(60), 10)["marks"] == []


def test_a_range_that_takes_too_long_to_read_is_answered_with_what_was_read_and_says_so(model, tmp_path, monkeypatch):
    recorded = record(tmp_path, *map(raw, range(100)))
    series = FanSeries(model, recorded)
    whole = series.as_json(FAN, at(0), at(100), 100)
    monkeypatch.setattr("fantwin.pipeline.site.fan_series.LONGEST_READ_S", 0.0)
    cut = series.as_json(FAN, at(0), at(100), 100)
    assert 0 < len(cut["t_s"]) < len(whole["t_s"]) == 100
    assert "left out" in cut["note"] and "left out" not in whole["note"]
