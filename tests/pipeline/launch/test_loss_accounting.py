"""Losses over all sessions, computed from the last health of each."""

from __future__ import annotations

from dataclasses import replace

from pipeline.launch.loss_accounting import losses
from pipeline.launch.refused_messages import refused, refused_lines
from schemas.messages import Counter, Header, Health, Input, Output, StageStatus

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
    counters: tuple[Counter, ...] = (),
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
        counters=counters,
        process_id=int(producer[1:] or 0),
    )


def line(producer: str, first: int, until: int, missing: int = 0, key: str = KEY) -> Input:
    return Input(
        key=key,
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
    resampler = health("r1", "resampler", 10, inputs=(line("a1", 0, 97), line("a2", 0, 50)))
    recorder = health("w1", "recorder", 11, inputs=(line("a1", 0, 95), line("a2", 0, 50)))
    assert losses([KILLED, FOLLOWER, resampler, recorder]) == {"acquisition/t": 0, "resampler": 0, "recorder": 2}


def test_a_message_that_a_killed_producer_reported_and_that_was_never_received_is_lost():
    recorder = health("w1", "recorder", 11, inputs=(line("a1", 0, 88), line("a2", 0, 50)))
    assert losses([KILLED, FOLLOWER, recorder])["recorder"] == 2


def test_messages_that_may_still_be_on_the_way_are_not_lost():
    recorder = health("w1", "recorder", 11, OK, inputs=(line("a1", 0, 88), line("a2", 0, 20)))
    assert losses([KILLED, FOLLOWER, recorder])["recorder"] == 0


def test_messages_published_after_a_consumer_stopped_are_not_lost():
    recorder = health("w1", "recorder", 5, inputs=(line("a1", 0, 40),))
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


LAUNCHED = {
    *(("acquisition/t", number) for number in (1, 2)),
    *((stage, number) for stage in ("resampler", "recorder", "viewer") for number in (1, 2)),
}
SENT = health("a1", "acquisition", 5, published=90)


def test_row_18_the_first_messages_that_the_only_session_of_a_stage_never_had_are_lost():
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 8, 90),))
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 8
    running = health("w1", "recorder", 4, OK, inputs=(line("a1", 8, 40),))
    assert losses([running], {("recorder", 1)})["recorder"] == 0, "nothing of its producer has been heard"
    assert losses([health("a1", "acquisition", 4, OK, published=60), running], LAUNCHED)["recorder"] == 8


def test_row_18_a_stream_that_a_stage_never_heard_is_lost():
    recorder = health("w1", "recorder", 9)
    assert losses([SENT, recorder], LAUNCHED) == {"acquisition/t": 0, "recorder": 90}


def test_row_18_what_a_producer_published_after_a_stage_had_stopped_is_lost():
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 0, 85),))
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 5
    assert losses([recorder, SENT], LAUNCHED)["recorder"] == 5, "whichever of the two was heard last"


def test_what_a_running_stage_has_not_received_yet_is_not_lost():
    recorder = health("w1", "recorder", 4, OK)
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 0


def test_what_other_launchers_and_commands_published_before_is_history():
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 40, 85),))
    assert losses([SENT, recorder], {("recorder", 1)})["recorder"] == 0
    assert losses([SENT, recorder])["recorder"] == 0
    command = line("c1", 3, 4, key="fantwin/s/t/command")
    assert losses([health("w1", "recorder", 9, inputs=(command,))], LAUNCHED)["recorder"] == 0


def test_a_stage_is_due_only_what_it_reads():
    scorer, elsewhere = (health("s1", "scorer", 9), replace(health("a2", "acquisition", 9), instance="other"))
    found = losses([SENT, scorer, elsewhere], {*LAUNCHED, ("scorer", 1), ("acquisition/other", 2)})
    assert not any(found.values())


def test_a_stage_that_may_drop_is_due_nothing():
    assert losses([SENT, health("v1", "viewer", 9)], LAUNCHED)["viewer"] == 0


def test_messages_between_two_sessions_of_one_launcher_are_lost_however_the_first_ended():
    sessions = [
        health("w1", "recorder", 1, STOPPED, inputs=(line("a1", 0, 40),)),
        health("w2", "recorder", 9, inputs=(line("a1", 45, 90),)),
    ]
    assert losses([SENT, *sessions], LAUNCHED)["recorder"] == 5


def test_what_any_session_of_a_stage_had_is_not_lost():
    """Of the killed producer the second session never heard."""
    sessions = [
        health("w1", "recorder", 1, OK, inputs=(line("a1", 0, 90),)),
        health("w2", "recorder", 9, inputs=(line("a2", 0, 50),)),
    ]
    assert losses([KILLED, FOLLOWER, *sessions], LAUNCHED)["recorder"] == 0


def test_what_a_stage_had_no_time_to_process_at_its_end_counts_once():
    at_stop = (Counter(name="lost_at_stop", value=10),)
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 0, 80),), lost=10, counters=at_stop)
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 10


def test_missing_messages_count_once():
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 0, 90, missing=7),), lost=7)
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 7


def test_what_a_stage_publishes_to_one_that_stops_before_it_need_not_arrive():
    """As a controller's commands to acquisition: the last ones are published when acquisition has stopped."""
    key = "fantwin/s/t/command"
    output = (Output(key=key, published=9),)
    controller = replace(health("r1", "resampler", 9), outputs=output)
    acquisition = health("a1", "acquisition", 5, inputs=(line("r1", 0, 7, key=key),))
    assert losses([acquisition, controller], LAUNCHED)["acquisition/t"] == 0
    acquisition = health("a1", "acquisition", 5, inputs=(line("r1", 2, 7, key=key),))
    assert losses([acquisition, controller], LAUNCHED)["acquisition/t"] == 2


def test_a_stream_that_was_forgotten_in_a_flood_of_names_is_not_judged():
    forgotten = Input(key=KEY, producer="", received=90, missing=0, duplicated=0, next_sequence=0)
    recorder = health("w1", "recorder", 9, inputs=(forgotten,))
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 0


def test_row_13_a_host_clock_that_was_set_back_does_not_change_the_order_of_sessions():
    before = health("w1", "recorder", 500, OK, inputs=(line("a1", 0, 40),))
    after = health("w2", "recorder", 9, inputs=(line("a1", 45, 85), line("a2", 0, 50)))
    assert losses([KILLED, FOLLOWER, before, after])["recorder"] == 5 + 5


def test_row_07_what_sessions_have_refused_is_added_up():
    counted = (Counter(name="refused_of_second", value=5), Counter(name="refused_clocks", value=0))
    sessions = [health(name, "recorder", 1, counters=counted) for name in ("w1", "w2")]
    assert refused([*sessions, FOLLOWER]) == {"recorder": {"refused_of_second": 10}}
    assert refused_lines(refused(sessions)) == ["recorder: messages refused: 10 from a second process of a stage"]
