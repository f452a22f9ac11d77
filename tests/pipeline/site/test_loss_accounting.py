"""Losses over all sessions, computed from the last health of each: one table of cases."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import pytest

from fantwin.pipeline.site.loss_accounting import losses
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Counter, Health, Input, Output
from tests.support import made_messages

KEY, COMMAND = "fantwin/s/t/raw", "fantwin/s/t/command"
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
    instance, outputs = "t" if stage == "acquisition" else "all", (Output(key=KEY, published=published),)
    about = {"status": status, "t_ns": at, "inputs": inputs, "outputs": outputs if published else ()}
    about |= {"lost": lost, "counters": counters, "process_id": int(producer[1:] or 0)}
    return made_messages.health(stage, instance, producer, **about)


def line(producer: str, first: int, until: int, missing: int = 0, key: str = KEY, **counts: int) -> Input:
    received = until - first - missing
    return Input(
        key=key, producer=producer, received=received, missing=missing, duplicated=0, next_sequence=until, **counts
    )


def recorder(number: int, at: int, *inputs: Input, status: StageStatus = STOPPED, lost: int = 0, at_stop: int = 0):
    counters = (Counter(name="lost_at_stop", value=at_stop),) if at_stop else ()
    return health(f"w{number}", "recorder", at, status, inputs, lost=lost, counters=counters)


KILLED = health("a1", "acquisition", 1, OK, published=90)
FOLLOWER = health("a2", "acquisition", 9, published=50)
SENT = health("a1", "acquisition", 5, published=90)
LAUNCHED = {
    ("acquisition/t", 1),
    ("acquisition/t", 2),
    *((stage, number) for stage in ("resampler", "recorder", "viewer", "scorer") for number in (1, 2)),
}
UP = LAUNCHED
first, second = partial(recorder, 1), partial(recorder, 2)
live = partial(recorder, 1, status=OK)
a0, a1, a2 = partial(line, "a"), partial(line, "a1"), partial(line, "a2")
LACKS_4096 = line("a1", 904, 5100, missing=4096, missing_at_start=4096)
SENT_5100 = health("a1", "acquisition", 5, published=5100)
CONTROLLER = replace(health("r1", "resampler", 9), outputs=(Output(key=COMMAND, published=9),))


def case(claim: str, launched: Collection[tuple[str, int]] | None, lost: int, *sessions: Health):
    """launched: the sessions that the launcher started; None: not known. lost: by the recorder."""
    return pytest.param(launched, lost, sessions, id=claim)


CASES = (
    case("reported, never received", None, 2, KILLED, FOLLOWER, first(11, a1(0, 88), a2(0, 50))),
    case("may still be on the way", None, 0, KILLED, FOLLOWER, live(11, a1(0, 88), a2(0, 20))),
    case("published after the consumer stopped", None, 0, KILLED, first(5, a1(0, 40))),
    case("recovered by the successor", None, 0, live(1, a0(0, 40)), second(9, a0(30, 300))),
    case(
        "no longer kept for the successor", None, 5 + 7, live(1, a0(0, 40)), second(9, a0(45, 300, missing=7), lost=7)
    ),
    case("stopped in order meanwhile", None, 0, first(1, a0(0, 40)), second(9, a0(4500, 5000))),
    case("the first messages never had", UP, 8, SENT, first(9, a1(8, 90))),
    case("nothing of the producer has been heard", {("recorder", 1)}, 0, live(4, a1(8, 40))),
    case("the first messages, running", UP, 8, SENT, live(4, a1(8, 40))),
    case("a stream never heard", UP, 90, SENT, first(9)),
    case("published after the stage had stopped", UP, 5, SENT, first(9, a1(0, 85))),
    case("the same, heard in the other order", UP, 5, first(9, a1(0, 85)), SENT),
    case("not received yet", UP, 0, SENT, live(4)),
    case("of another launcher, from before", {("recorder", 1)}, 0, SENT, first(9, a1(40, 85))),
    case("of another launcher, none known", None, 0, SENT, first(9, a1(40, 85))),
    case("of a command that came before", UP, 0, first(9, line("c1", 3, 4, key=COMMAND))),
    case("between two sessions of one launcher", UP, 5, SENT, first(1, a1(0, 40)), second(9, a1(45, 90))),
    case("had by any session", UP, 0, KILLED, FOLLOWER, live(1, a1(0, 90)), second(9, a2(0, 50))),
    case("no time to process at the end counts once", UP, 10, SENT, first(9, a1(0, 80), lost=10, at_stop=10)),
    case("missing counts once", UP, 7, SENT, first(9, a1(0, 90, missing=7), lost=7)),
    case("forgotten in a flood of names", UP, 0, SENT, first(9, line("", 0, 0))),
    case(
        "row 13: clock set back", None, 5 + 5, KILLED, FOLLOWER, live(500, a1(0, 40)), second(9, a1(45, 85), a2(0, 50))
    ),
    case(
        "unsaved, and the producer killed too",
        UP,
        12,
        KILLED,
        live(1, a1(0, 90, unsaved=12)),
        FOLLOWER,
        second(9, a2(0, 50)),
    ),
    case("unsaved, received again", UP, 0, live(1, a1(0, 80, unsaved=12)), SENT, second(9, a1(60, 90))),
    case("unsaved, received again, none known", None, 0, live(1, a1(0, 80, unsaved=12)), SENT, second(9, a1(60, 90))),
    case(
        "taken over, producer replaced",
        None,
        0,
        first(5, a1(0, 40)),
        SENT,
        second(21, a1(40, 90), a2(0, 5), status=OK),
        FOLLOWER,
    ),
    case("after the stop, producer replaced", None, 0, first(5, a1(0, 40)), SENT, FOLLOWER),
    case(
        "of a replaced producer",
        None,
        5,
        KILLED,
        first(5, a1(0, 85), a2(0, 10)),
        FOLLOWER,
        second(21, a2(30, 50), status=OK),
    ),
    case("had by the predecessor", UP, 0, live(1, a1(0, 5000)), SENT_5100, second(9, LACKS_4096, lost=4096)),
    case("the same, none known", None, 0, live(1, a1(0, 5000)), SENT_5100, second(9, LACKS_4096, lost=4096)),
    case("without a predecessor", None, 4096, first(9, LACKS_4096, lost=4096)),
    case(
        "beyond the predecessor",
        UP,
        3 + 7,
        first(1, a1(0, 50, missing=3), lost=3),
        SENT,
        second(9, a1(40, 90, missing=7), lost=7),
    ),
    case("arrived at the end, and a gap", UP, 8 + 10, SENT, first(9, a1(8, 90, unsaved=10), lost=10, at_stop=10)),
    case("arrived at the end, five did not", UP, 10, SENT, first(9, a1(0, 85, unsaved=5), lost=10, at_stop=10)),
    case("of other launchers", UP, 0, recorder(9, 0, line("a9", 0, 10), lost=7), SENT, first(9, a1(0, 90))),
)


@pytest.mark.parametrize(("launched", "lost", "sessions"), CASES)
def test_row_18_what_the_recorder_has_lost(launched, lost, sessions):
    assert losses(sessions, launched)["recorder"] == lost


def test_losses_are_summed_over_the_sessions_of_a_stage_and_seen_where_only_another_stage_received():
    found = losses([health("r1", "resampler", 1, OK, lost=2), health("r2", "resampler", 2, lost=3), FOLLOWER])
    assert found == {"resampler": 5, "acquisition/t": 0}
    resampler = health("r1", "resampler", 10, inputs=(line("a1", 0, 97), line("a2", 0, 50)))
    of_recorder = recorder(1, 11, line("a1", 0, 95), line("a2", 0, 50))
    assert losses([KILLED, FOLLOWER, resampler, of_recorder]) == {"acquisition/t": 0, "resampler": 0, "recorder": 2}


def test_a_stage_that_may_drop_loses_nothing_while_it_is_dead_and_is_due_nothing():
    before = health("v1", "viewer", 1, OK, inputs=(line("a", 0, 40),))
    after = health("v2", "viewer", 9, inputs=(line("a", 4500, 5000),))
    assert losses([before, after]) == {"viewer": 0}
    assert losses([SENT, health("v1", "viewer", 9)], LAUNCHED)["viewer"] == 0


def test_only_the_shard_that_has_a_tray_is_due_its_messages():
    ours, other = (replace(health(name, "recorder", 9), trays=trays) for name, trays in (("w1", "t,u"), ("w2", "x")))
    launched = {("recorder/1-of-2", 1), ("recorder/2-of-2", 2), ("acquisition/t", 1)}
    shards = [replace(each, instance=f"{number}-of-2") for number, each in enumerate((ours, other), start=1)]
    found = losses([SENT, *shards], launched)
    assert found == {"acquisition/t": 0, "recorder/1-of-2": 90, "recorder/2-of-2": 0}


def test_a_stage_is_due_only_what_it_reads_and_nothing_that_it_leaves_out_on_purpose():
    scorer, elsewhere = (health("s1", "scorer", 9), replace(health("a2", "acquisition", 9), instance="other"))
    assert not any(losses([SENT, scorer, elsewhere], {*LAUNCHED, ("acquisition/other", 2)}).values())
    assert losses([SENT, recorder(1, 9)], LAUNCHED, {"recorder": ("grid", "alarm")})["recorder"] == 0
    assert losses([SENT, recorder(1, 9)], LAUNCHED, {"recorder": ("raw", "alarm")})["recorder"] == 90


def test_what_a_stage_publishes_to_one_that_stops_before_it_need_not_arrive():
    """A controller's commands to acquisition: the last ones are published when acquisition has stopped."""
    for first, lost in ((0, 0), (2, 2)):
        acquisition = health("a1", "acquisition", 5, inputs=(line("r1", first, 7, key=COMMAND),))
        assert losses([acquisition, CONTROLLER], LAUNCHED)["acquisition/t"] == lost


def test_sessions_that_the_launcher_did_not_start_are_not_judged():
    assert losses([recorder(9, 5, line("a1", 0, 40)), SENT], {("acquisition/t", 1)}) == {"acquisition/t": 0}
    assert losses([SENT, recorder(1, 9, line("a1", 0, 90))], ()) == {}, "none of them was ready"
