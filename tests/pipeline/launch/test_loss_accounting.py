"""Losses over all sessions, computed from the last health of each."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

from pipeline.launch.loss_accounting import losses
from schemas.enums import StageStatus
from schemas.header import Header
from schemas.health import Counter, Health, Input, Output

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


def line(producer: str, first: int, until: int, missing: int = 0, key: str = KEY, **counts: int) -> Input:
    return Input(
        key=key,
        producer=producer,
        received=until - first - missing,
        missing=missing,
        duplicated=0,
        next_sequence=until,
        **counts,
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


def test_only_the_shard_that_has_a_tray_is_due_its_messages():
    ours, other = (replace(health(name, "recorder", 9), trays=trays) for name, trays in (("w1", "t,u"), ("w2", "x")))
    launched = {("recorder/1-of-2", 1), ("recorder/2-of-2", 2), ("acquisition/t", 1)}
    shards = [replace(each, instance=f"{number}-of-2") for number, each in enumerate((ours, other), start=1)]
    found = losses([SENT, *shards], launched)
    assert found == {"acquisition/t": 0, "recorder/1-of-2": 90, "recorder/2-of-2": 0}


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


def test_a_stage_is_due_nothing_of_a_topic_that_it_leaves_out_on_purpose():
    recorder = health("w1", "recorder", 9)
    assert losses([SENT, recorder], LAUNCHED, {"recorder": ("grid", "alarm")})["recorder"] == 0
    assert losses([SENT, recorder], LAUNCHED, {"recorder": ("raw", "alarm")})["recorder"] == 90


def test_counting_losses_imports_no_stage():
    """Its imports take seconds, in which no health is heard: `fantwin status` would call all stages silent."""
    look = (
        "import sys; from tests.pipeline.launch.test_loss_accounting import health, losses;"
        "losses([health('s1', 'scorer', 1), health('v1', 'viewer', 1)]);"
        "print([name for name in sys.modules if name == 'scipy' or name.startswith('stages.')])"
    )
    assert subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout == "[]\n"


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


def test_row_18_what_a_killed_recorder_had_not_flushed_and_a_killed_producer_cannot_send_again_is_lost():
    before = health("w1", "recorder", 1, OK, inputs=(line("a1", 0, 90, unsaved=12),))
    after = health("w2", "recorder", 9, inputs=(line("a2", 0, 50),))
    assert losses([KILLED, before, FOLLOWER, after], LAUNCHED)["recorder"] == 12


def test_what_a_killed_recorder_had_not_flushed_and_its_successor_received_again_is_not_lost():
    before = health("w1", "recorder", 1, OK, inputs=(line("a1", 0, 80, unsaved=12),))
    after = health("w2", "recorder", 9, inputs=(line("a1", 60, 90),))
    assert losses([before, SENT, after], LAUNCHED)["recorder"] == 0
    assert losses([before, SENT, after])["recorder"] == 0


def test_what_is_published_after_a_stage_of_another_launcher_was_stopped_is_not_lost():
    """As with `fantwin run recorder` beside `up`, which goes on."""
    recorder = health("w9", "recorder", 5, inputs=(line("a1", 0, 40),))
    assert losses([recorder, SENT], {("acquisition/t", 1)}) == {"acquisition/t": 0}


def test_what_a_successor_took_over_is_not_lost_when_its_producer_is_replaced_later():
    before = health("w1", "recorder", 5, inputs=(line("a1", 0, 40),))
    after = health("w2", "recorder", 21, OK, inputs=(line("a1", 40, 90), line("a2", 0, 5)))
    assert losses([before, SENT, after, FOLLOWER])["recorder"] == 0


def test_what_is_published_after_a_stage_was_stopped_is_not_lost_when_its_producer_is_replaced_later():
    recorder = health("w1", "recorder", 5, inputs=(line("a1", 0, 40),))
    assert losses([recorder, SENT, FOLLOWER])["recorder"] == 0


def test_what_a_stage_never_had_of_a_replaced_producer_stays_lost_when_the_stage_is_started_again():
    before = health("w1", "recorder", 5, inputs=(line("a1", 0, 85), line("a2", 0, 10)))
    after = health("w2", "recorder", 21, OK, inputs=(line("a2", 30, 50),))
    assert losses([KILLED, before, FOLLOWER, after])["recorder"] == 5


def test_row_07_messages_of_a_launched_producer_that_a_launched_stage_refused_are_lost():
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 0, 90, refused=28),))
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 28
    stranger = health("w1", "recorder", 9, inputs=(line("a1", 0, 90), line("x9", 0, 90, refused=90)))
    assert losses([SENT, stranger], LAUNCHED)["recorder"] == 0
    assert losses([SENT, recorder])["recorder"] == 0, "whose messages are one's own is not known"


def test_messages_that_the_predecessor_of_a_stage_received_are_not_missing():
    """The producer did not answer the successor, which takes all that it may have kept as missing."""
    before = health("w1", "recorder", 1, OK, inputs=(line("a1", 0, 5000),))
    counts = line("a1", 904, 5100, missing=4096, missing_at_start=4096)
    after = health("w2", "recorder", 9, inputs=(counts,), lost=4096)
    sent = health("a1", "acquisition", 5, published=5100)
    assert losses([before, sent, after], LAUNCHED)["recorder"] == 0
    assert losses([before, sent, after])["recorder"] == 0
    alone = health("w1", "recorder", 9, inputs=(counts,), lost=4096)
    assert losses([alone])["recorder"] == 4096, "without a predecessor they are"


def test_messages_that_a_session_lacked_beyond_those_of_its_predecessor_are_lost():
    before = health("w1", "recorder", 1, OK, inputs=(line("a1", 0, 50, missing=3),), lost=3)
    after = health("w2", "recorder", 9, inputs=(line("a1", 40, 90, missing=7),), lost=7)
    assert losses([before, SENT, after], LAUNCHED)["recorder"] == 3 + 7


def test_what_arrived_at_a_stage_that_had_to_end_does_not_hide_a_gap():
    at_stop = (Counter(name="lost_at_stop", value=10),)
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 8, 90, unsaved=10),), lost=10, counters=at_stop)
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 8 + 10
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 0, 85, unsaved=5),), lost=10, counters=at_stop)
    assert losses([SENT, recorder], LAUNCHED)["recorder"] == 10, "five were received, five were not"


def test_the_sessions_of_other_launchers_do_not_count():
    before = health("w9", "recorder", 0, inputs=(line("a9", 0, 10),), lost=7)
    recorder = health("w1", "recorder", 9, inputs=(line("a1", 0, 90),))
    assert losses([before, SENT, recorder], LAUNCHED)["recorder"] == 0
    assert losses([before, SENT, recorder], ()) == {}, "none of them was ready"
