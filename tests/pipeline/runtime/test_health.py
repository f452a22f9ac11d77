"""What a stage says of itself besides its counts: what it waits for, and how old what it sends is."""

from __future__ import annotations

import math

import pytest

from fantwin.pipeline.runtime.health import AWAITED_AFTER_NS, LATENCY_WINDOW_S, HealthBuilder
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import AwaitedInput, Health

KEY = "fantwin/s/tray1/grid"
START_NS = 1_800_000_000_000_000_000


@pytest.fixture
def builder() -> HealthBuilder:
    return HealthBuilder("scorer", "all", START_NS, may_drop=False, main_keys=[KEY])


def health(builder: HealthBuilder, now_ns: int) -> Health:
    return builder.build(status=StageStatus.OK, problems=(), inputs=(), outputs=(), counters={}, now_ns=now_ns)


def test_row_01_a_main_input_without_a_message_for_two_seconds_is_waited_for(builder):
    assert health(builder, START_NS + AWAITED_AFTER_NS).waiting_for == ()
    late_ns = START_NS + AWAITED_AFTER_NS + 1
    assert health(builder, late_ns).waiting_for == (AwaitedInput(key=KEY, since_t_ns=START_NS),)
    builder.add_input("fantwin/s/tray1/request", late_ns, late_ns)  # not the main input
    assert health(builder, late_ns).waiting_for != ()
    builder.add_input(KEY, late_ns, late_ns)
    assert health(builder, late_ns).waiting_for == ()


def test_a_stage_that_is_behind_waits_for_nothing(builder):
    now_ns = START_NS + 60 * AWAITED_AFTER_NS
    builder.add_input(KEY, START_NS, now_ns)
    found = health(builder, now_ns)
    assert (found.waiting_for, found.newest_input_t_ns) == ((), START_NS)


def test_row_01_the_times_of_the_newest_input_and_output_are_given(builder):
    empty = health(builder, START_NS)
    assert (empty.newest_input_t_ns, empty.newest_output_t_ns) == (0, 0)
    builder.add_input(KEY, START_NS + 5, START_NS + 5)
    builder.add_output(START_NS, START_NS + 7, None)
    found = health(builder, START_NS + 9)
    assert (found.newest_input_t_ns, found.newest_output_t_ns) == (START_NS + 5, START_NS + 7)
    assert found.latency_p50_ms == 0.0, "the time of a paused replay is not known"


def test_latencies_are_of_the_last_ten_seconds_and_the_histogram_is_of_the_session(builder, monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("fantwin.pipeline.runtime.health.time.monotonic", lambda: now_s[0])
    assert health(builder, START_NS).latencies == ()
    for latency_ms in (-1, 1, 2, 3, 700, 60_000):  # -1: the clock of another host is ahead
        now_s[0] += LATENCY_WINDOW_S + 1
        builder.add_output(START_NS, START_NS, START_NS + latency_ms * 1_000_000)
    found = health(builder, START_NS)
    assert found.latency_p50_ms == 60_000.0, "the only one of the last ten seconds"
    counts = {bucket.upper_s: bucket.count for bucket in found.latencies}
    assert [counts[upper] for upper in (0.002, 0.005, 0.5, 1.0, 30.0, math.inf)] == [3, 4, 4, 5, 5, 6]
    assert found.latency_sum_s == pytest.approx(60.706)
    assert decode(Health, encode(found)).latencies == found.latencies


def test_what_was_sent_while_catching_up_is_no_latency(builder):
    builder.add_output(START_NS, START_NS, START_NS + 60_000_000_000)
    builder.has_caught_up()
    builder.add_output(START_NS, START_NS, START_NS + 1_000_000)
    found = health(builder, START_NS)
    assert found.latency_p99_ms == 1.0
    assert (found.latencies[-1].count, found.latency_sum_s) == (1, 0.001)
