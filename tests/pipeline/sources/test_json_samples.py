"""Samples as JSON: each form of a sample is read, and whatever else comes is refused with its reason."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.sources.json_samples import (
    LARGEST_BYTES,
    MOST_SAMPLES,
    JsonSamplesError,
    TimedReading,
    batches_of,
    parse_samples,
)
from fantwin.pipeline.sources.own_json import OwnSamples
from fantwin.pipeline.sources.source import Reading, Rejected
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes
from fantwin.schemas.channels import CURRENT, SUPPLY_VOLTAGE, TEMPERATURE
from fantwin.schemas.units import NS_PER_S


def one(text: str) -> TimedReading | Rejected:
    (found,) = parse_samples(text.encode())
    return found


@pytest.mark.parametrize(
    "text",
    [
        '{"t": 1790000000.25, "command": [0.5, 0.25], "speed": [100, null]}',
        '{"t": "2026-09-21T14:13:20.25Z", "command": [0.5, 0.25], "speed": [100, NaN]}',
        '[{"t": 1790000000.25, "fans": [{"command": 0.5, "speed": 100}, {"command": 0.25}]}]',
        '{"samples": [{"t": 1790000000.25, "command": [0.5, 0.25], "speed": [100, null]}]}',
    ],
)
def test_the_forms_of_a_sample_mean_the_same(text: str) -> None:
    found = one(text)
    assert isinstance(found, TimedReading)
    assert found.t_ns == 1_790_000_000_250_000_000
    reading = found.reading
    assert (reading.command, reading.speed[0]) == ((0.5, 0.25), 100.0)
    assert math.isnan(reading.speed[1])
    assert reading.clock_us == 1_790_000_000_250_000 % 2**32


def test_what_else_is_measured_time_and_number_are_optional() -> None:
    found = one('{"command": 1, "speed": 2, "sequence": 4294967297, "supply_voltage_v": 12.1, "temperature_c": [null]}')
    assert isinstance(found, TimedReading)
    reading = found.reading
    assert (reading.command, reading.speed, reading.sequence) == ((1.0,), (2.0,), 1)
    assert (found.t_ns, reading.clock_us) == (None, None)
    assert reading.measured[SUPPLY_VOLTAGE] == (12.1,) and math.isnan(reading.measured[TEMPERATURE][0])
    assert CURRENT not in reading.measured


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"command": [1]}', "'speed' is missing"),
        ('{"command": ["1"], "speed": [1]}', "'command' has '1', which is no number"),
        ('{"command": [true], "speed": [1]}', "no number"),
        ('{"command": [1], "speed": [[1]]}', "no number"),
        (f'{{"command": [1], "speed": [1{"0" * 400}]}}', "too large"),
        ('{"command": [1], "speed": [1], "rpm": 3}', "unknown key 'rpm'"),
        ('{"fans": [{"command": 1, "rpm": 3}]}', "unknown key 'rpm' of a fan"),
        ('{"fans": [1]}', "'fans' is a list"),
        ('{"fans": [], "speed": [1]}', "not both"),
        ('{"t": "yesterday", "command": [1], "speed": [1]}', "is no date"),
        ('{"t": "2026-09-21T14:13:20", "command": [1], "speed": [1]}', "no time zone"),
        ('{"t": NaN, "command": [1], "speed": [1]}', "no time"),
        ('{"t": 1790000000250, "command": [1], "speed": [1]}', "in seconds"),
        ('{"sequence": -1, "command": [1], "speed": [1]}', "whole number"),
        ('{"sequence": 1.5, "command": [1], "speed": [1]}', "whole number"),
    ],
)
def test_a_sample_that_is_wrong_is_refused_with_its_reason(text: str, reason: str) -> None:
    found = one(text)
    assert isinstance(found, Rejected)
    assert reason in found.detail
    assert (found.kind, found.is_sample) == ("malformed", True)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "no JSON"),
        (b"\xff\xfe{", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"3", "a sample is"),
        (b"[[1]]", "a sample is"),
        (b" " * (LARGEST_BYTES + 1), "at most"),
        (json.dumps([{}] * (MOST_SAMPLES + 1)).encode(), f"at most {MOST_SAMPLES}"),
    ],
)
def test_a_text_that_is_no_samples_is_refused_as_a_whole(text: bytes, reason: str) -> None:
    with pytest.raises(JsonSamplesError, match=reason):
        parse_samples(text)


def test_a_time_that_goes_back_within_a_text_refuses_that_sample_only() -> None:
    samples = [{"t": t, "command": [1], "speed": [t]} for t in (1.0, 3.0, 2.0, 4.0)]
    found = parse_samples(json.dumps(samples).encode())
    assert [isinstance(each, Rejected) for each in found] == [False, False, True, False]


def test_samples_that_come_together_count_as_received_one_after_another() -> None:
    samples = [{"t": t, "command": [1], "speed": [1]} for t in (1.0, 1.5, 2.0)]
    receipts = ReceiptTimes()
    batches = batches_of(parse_samples(json.dumps(samples).encode()), 10**10, receipts, 99)
    assert [batch.received_t_ns for batch in batches] == [9 * 10**9, 95 * 10**8, 10**10]
    assert [batch.byte_count for batch in batches] == [99, 0, 0]
    (late,) = batches_of([TimedReading(Reading((1.0,), (1.0,)), None)], 9 * 10**9, receipts, 1)
    assert late.received_t_ns == 10**10, "times of receipt never go back"


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["t", "command", "speed", "fans", "samples", "sequence", "current_a", "x"]),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


@settings(max_examples=30)
@given(JSON)
def test_no_json_raises_anything_else(value: object) -> None:
    try:
        found = parse_samples(json.dumps(value).encode())
    except JsonSamplesError:
        return
    assert all(isinstance(each, TimedReading | Rejected) for each in found)
    batches_of(found, 0, ReceiptTimes(), 0)


TELEGRAF = (
    b'{"metrics": [{"fields": {"rpm": 1206, "pwm": "%s"}, "name": "fan", "tags": {}, "timestamp": 1458229140},'
    b' {"fields": {"rpm": "20 rad/s", "pwm": 50}, "name": "fan", "timestamp": 1458229150},'
    b' {"fields": {"usage_idle": 90}, "name": "cpu", "timestamp": 1458229160}]}'
)


def test_json_of_a_device_is_read_by_pointers() -> None:
    own = OwnSamples(speed_key="/fields/rpm", command_key="/fields/pwm", time_key="/timestamp")
    first, second, other = parse_samples(TELEGRAF % b"40 %", own, 1, "rpm")
    assert isinstance(first, TimedReading) and isinstance(second, TimedReading)
    assert (first.reading.command, first.reading.speed, first.t_ns) == ((40.0,), (1206.0,), 1458229140 * NS_PER_S)
    assert second.reading.speed[0] == pytest.approx(190.99, abs=0.01)
    assert isinstance(other, Rejected) and other.detail == "nothing at /fields/pwm; there is: usage_idle"
    (wrong, *_) = parse_samples(TELEGRAF % b"fast", own, 1, "rpm")
    assert isinstance(wrong, Rejected) and wrong.detail == "/fields/pwm has 'fast', which is no number"
    own = OwnSamples(speed_key="/a/{0}/1", command_key="/a/{0}/0")
    (both,) = parse_samples(b'{"a": [[1, 2], [3, null]]}', own, 2, "rpm")
    assert isinstance(both, TimedReading) and both.reading.command == (1.0, 3.0) and math.isnan(both.reading.speed[1])
