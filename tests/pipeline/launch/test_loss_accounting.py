"""Losses over all sessions, computed from the last health of each."""

from __future__ import annotations

from pipeline.launch.loss_accounting import losses
from schemas.messages import Header, Health, Input, Output, StageStatus

KEY = "fantwin/s/t/raw"
OK, STOPPED = StageStatus.OK, StageStatus.STOPPED


def health(
    producer: str,
    stage: str,
    at: int,
    status: StageStatus = STOPPED,
    inputs: tuple[Input, ...] = (),
    published: int = 0,
    lost: int = 0,
) -> Health:
    return Health(
        header=Header(producer, 0, ""),
        stage=stage,
        instance="t" if stage == "acquisition" else "all",
        status=status,
        t_ns=at,
        uptime_s=0,
        inputs=inputs,
        outputs=(Output(key=KEY, published=published),) if published else (),
        lost=lost,
    )


def line(producer: str, first: int, until: int, missing: int = 0) -> Input:
    return Input(
        key=KEY,
        producer=producer,
        received=until - first - missing,
        missing=missing,
        duplicated=0,
        next_sequence=until,
    )


KILLED = health("a1", "acquisition", 1, OK, published=90)
FOLLOWER = health("a2", "acquisition", 9, published=50)


def test_losses_that_sessions_count_are_summed_over_the_sessions_of_a_stage():
    found = losses([health("r1", "resampler", 1, OK, lost=2), health("r2", "resampler", 2, lost=3), FOLLOWER])
    assert found == {"resampler": 5, "acquisition/t": 0}


def test_a_message_of_a_killed_producer_that_only_another_stage_received_is_lost():
    resampler = health("r", "resampler", 10, inputs=(line("a1", 0, 97), line("a2", 0, 50)))
    recorder = health("w", "recorder", 11, inputs=(line("a1", 0, 95), line("a2", 0, 50)))
    assert losses([KILLED, FOLLOWER, resampler, recorder]) == {"acquisition/t": 0, "resampler": 0, "recorder": 2}


def test_a_message_that_a_killed_producer_reported_and_that_was_never_received_is_lost():
    recorder = health("w", "recorder", 11, inputs=(line("a1", 0, 88), line("a2", 0, 50)))
    assert losses([KILLED, FOLLOWER, recorder])["recorder"] == 2


def test_messages_that_may_still_be_on_the_way_are_not_lost():
    recorder = health("w", "recorder", 11, OK, inputs=(line("a1", 0, 88), line("a2", 0, 20)))
    assert losses([KILLED, FOLLOWER, recorder])["recorder"] == 0


def test_messages_published_after_a_consumer_stopped_are_not_lost():
    recorder = health("w", "recorder", 5, inputs=(line("a1", 0, 40),))
    assert losses([KILLED, recorder])["recorder"] == 0


def test_messages_recovered_by_the_successor_of_a_killed_consumer_are_not_lost():
    before = health("w1", "recorder", 1, OK, inputs=(line("a", 0, 40),))
    after = health("w2", "recorder", 9, inputs=(line("a", 30, 300),))
    assert losses([before, after]) == {"recorder": 0}


def test_messages_no_longer_kept_for_the_successor_of_a_killed_consumer_are_lost():
    before = health("w1", "recorder", 1, OK, inputs=(line("a", 0, 40),))
    after = health("w2", "recorder", 9, inputs=(line("a", 45, 300, missing=7),), lost=7)
    assert losses([before, after]) == {"recorder": 5 + 7}


def test_messages_published_while_a_consumer_was_stopped_in_order_are_not_lost():
    before = health("w1", "recorder", 1, STOPPED, inputs=(line("a", 0, 40),))
    after = health("w2", "recorder", 9, inputs=(line("a", 4500, 5000),))
    assert losses([before, after]) == {"recorder": 0}


def test_a_stage_that_may_drop_loses_nothing_while_it_is_dead():
    before = health("v1", "viewer", 1, OK, inputs=(line("a", 0, 40),))
    after = health("v2", "viewer", 9, inputs=(line("a", 4500, 5000),))
    assert losses([before, after]) == {"viewer": 0}
