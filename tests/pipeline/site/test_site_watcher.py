"""What is seen of a site from outside."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fantwin.pipeline.config.roles import roles_of_stages
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.one_line import LONGEST_TEXT
from fantwin.pipeline.site.site_watcher import MOST_WATCHED_SESSIONS, SiteWatcher
from fantwin.schemas.codec import encode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Output
from fantwin.schemas.topics import alive_key, tray_key
from tests.support.stub_bus import KEY, SCORER, STRANGER, StubBus, health, of, session

TRAYS = [TrayConfig(name="tray", fans=8)]


@pytest.fixture
def bus() -> Any:
    return StubBus()


@pytest.fixture
def watcher(bus: Any) -> SiteWatcher:
    """A watcher of a site on which a scorer is at work."""
    watcher = SiteWatcher(bus, "s", trays=TRAYS)
    bus.show(SCORER)
    bus.say(health(SCORER, outputs=(Output(key=KEY, published=0),)))
    return watcher


def fans(watcher: SiteWatcher) -> list[int]:
    return [current.newest.fan for current in watcher.current_alarms()]


@pytest.mark.parametrize(
    ("stage", "claimed"),
    [("viewer", KEY), ("acquisition", KEY), ("resampler", tray_key("s", "other", "grid"))],
    ids=["of a stage that writes nothing", "of another stage", "of another tray"],
)
def test_row_17_a_health_is_not_believed_about_what_its_stage_may_not_write(bus, stage, claimed):
    """Otherwise a session of a viewer could make the alarms of the scorer those of a stranger."""
    limited = {"resampler.all": replace(roles_of_stages()["resampler"], trays=("tray",))}
    watcher = SiteWatcher(bus, "s", roles_of_stages() | limited, TRAYS)
    thief = session(stage, 7)
    bus.show(thief)
    own = tuple(Output(key=tray_key("s", "tray", topic), published=5) for topic in roles_of_stages()[stage].writes)
    bus.say(health(thief, outputs=(*own, Output(key=claimed, published=4000))))
    (view,) = watcher.stages()
    assert view.health.outputs == own
    assert watcher.losses() == {stage: 0}
    assert not watcher._sessions.is_stranger(claimed, STRANGER)
    bus.raise_alarm(of(STRANGER))
    assert fans(watcher) == [0], "no session publishes there"


def test_row_11_an_alarm_of_a_stranger_is_not_shown_once_the_scorer_is_heard(bus):
    watcher = SiteWatcher(bus, "s", trays=TRAYS)
    bus.raise_alarm(of(STRANGER))
    assert fans(watcher) == [0], "a replay, say: nobody else publishes there"
    bus.show(SCORER)
    bus.say(health(SCORER, outputs=(Output(key=KEY, published=0),)))
    assert fans(watcher) == []
    bus.raise_alarm(of(STRANGER))
    assert fans(watcher) == []
    bus.raise_alarm(of(SCORER.producer, fan=3))
    assert fans(watcher) == [3]


def test_the_alarm_of_a_scorer_that_was_killed_is_shown_beside_its_successor(bus, watcher):
    bus.raise_alarm(of(SCORER.producer))
    bus.show(SCORER, alive=False)
    follower = session("scorer", 2)
    bus.show(follower)
    bus.say(health(follower, outputs=(Output(key=KEY, published=0),)))
    assert fans(watcher) == [0]


def test_row_11_alarms_of_fans_that_the_site_does_not_have_are_not_kept_and_long_texts_are_cut(bus, watcher):
    for number in range(100):
        bus.raise_alarm(of(SCORER.producer, number, fan=number, message="x" * (1 << 19)))
    assert fans(watcher) == list(range(8))
    assert {len(each.message) for each in watcher.current_alarms()} == {LONGEST_TEXT}


def test_row_11_healths_of_strangers_hide_no_stage_and_few_are_kept(bus, watcher):
    assert watcher.is_ready(SCORER.process_id)
    bus.say(replace(health(SCORER, 4 * 10**18), header=Header(STRANGER, 0, ""), process_id=77))
    assert watcher.is_ready(SCORER.process_id)
    assert [view.health.header.producer for view in watcher.stages()] == [SCORER.producer]
    for number in range(100, 100 + 2 * MOST_WATCHED_SESSIONS):
        bus.say(health(session("scorer", number)))
    assert len(watcher._healths) == MOST_WATCHED_SESSIONS
    assert watcher.is_ready(SCORER.process_id)


@pytest.mark.parametrize("stage", ["scorer", "viewer"])
def test_row_11_what_a_stranger_says_to_have_lost_is_no_loss_during_the_run_and_after_it(bus, watcher, stage):
    bus.say(replace(health(session(stage, 9), lost=5), process_id=SCORER.process_id))
    assert watcher.losses({("scorer", SCORER.process_id)}) == {"scorer": 0}
    bus.say(health(SCORER, status=StageStatus.STOPPED))
    bus.show(SCORER, alive=False)
    assert watcher.losses() == {"scorer": 0}


def test_the_health_of_a_session_counts_whether_it_comes_before_its_token_or_after_the_token_has_gone(bus, watcher):
    early, late = session("recorder", 3), session("resampler", 4)
    bus.say(health(early, lost=1))
    bus.show(early)
    bus.show(late)
    bus.show(late, alive=False)
    bus.say(health(late, lost=2, status=StageStatus.STOPPED))
    assert watcher.losses() == {"recorder": 1, "resampler": 2, "scorer": 0}
    assert watcher.last_health(("resampler", 4)) is not None


def test_the_session_whose_token_is_there_is_shown_also_if_its_predecessor_is_heard_later(bus, watcher):
    follower = session("scorer", 2)
    bus.show(SCORER, alive=False)
    bus.show(follower)
    bus.say(health(follower))
    bus.say(health(SCORER, status=StageStatus.STOPPED))
    assert watcher.is_ready(follower.process_id)


def test_what_shows_no_token_of_a_session_such_as_a_replay_is_seen_where_no_session_does(bus, watcher):
    replay = session("replay", 5)
    bus.watched[alive_key("s", "*", "*")](alive_key("s", "replay", "all"), True)
    bus.say(health(replay))
    assert [view.health.stage for view in watcher.stages()] == ["replay", "scorer"]


def test_row_18_bytes_of_a_stranger_are_no_alarm_and_one_that_is_recovered_is_known(bus):
    watcher = SiteWatcher(bus, "s", trays=TRAYS)
    receive = bus.subscribers[tray_key("s", "*", "alarm")]
    receive(KEY, b"")  # all fields at their defaults: it decodes
    for name in ("", "other", "tray/../x", "*"):
        receive(KEY, encode(replace(of("peer"), header=Header("peer", 0, name))))
    bus.kept = [(KEY, b"")]
    watcher.ask_for_past_alarms()
    assert fans(watcher) == []
    known = of("peer", 3)
    bus.kept = [(KEY, encode(known))]
    watcher.ask_for_past_alarms()
    assert [each.newest.header for each in watcher.current_alarms()] == [known.header]


def test_row_11_what_a_launched_session_has_lost_is_not_forgotten_in_a_flood_of_others(bus):
    watcher = SiteWatcher(bus, "s", trays=TRAYS)
    watcher.add_launched(("recorder", 1))
    for number in range(1, MOST_WATCHED_SESSIONS + 3):
        bus.show(session("recorder", number))
        bus.say(health(session("recorder", number), number, lost=int(number == 1)))
        bus.show(session("recorder", number), alive=False)
    assert watcher.losses() == {"recorder": 1}
    assert watcher.last_health(("recorder", 1)) is not None
    assert watcher.last_health(("recorder", 2)) is None


def test_row_13_a_stage_that_is_restarted_after_its_clock_was_set_back_is_the_latest_session(bus):
    watcher = SiteWatcher(bus, "s", trays=TRAYS)
    for each, t_ns in ((session("recorder", 1), 7200), (session("recorder", 2), 3600)):
        bus.show(each)
        bus.say(health(each, t_ns))
        bus.show(each, alive=False)
    assert [view.health.process_id for view in watcher.stages()] == [2]
