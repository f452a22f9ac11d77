"""Which fans are judged now, and why others are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.judging import JudgedChanges, Unjudged, as_judged, at_rest, unjudged
from fantwin.pipeline.site.site_model import SILENT_AFTER_S
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import StageState, Word
from fantwin.schemas.codec import encode
from fantwin.schemas.enums import FanState, InvalidReason
from fantwin.schemas.header import Header
from fantwin.schemas.health import Output
from fantwin.schemas.topics import tray_key
from fantwin.scoring.alarms.alarm_text import RETURNING
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from tests.support import made_messages
from tests.support.score_data import one_sample
from tests.support.stub_bus import SCORER, STRANGER, StubBus, health

FANS = 4
TRAYS = [TrayConfig(name="a", fans=FANS), TrayConfig(name="b", fans=FANS)]


class Listener:
    """Fans of two trays, and a clock that the test sets."""

    def __init__(self) -> None:
        self.bus: Any = StubBus()
        self.now_s = 100.0
        self.watcher = SiteWatcher(self.bus, "s", trays=TRAYS, has_scores=True)
        self.model = self.watcher.model
        self.model._now_s = lambda: self.now_s

    def score(self, tray: str, *reasons: InvalidReason, producer: str = "") -> None:
        self.hear(tray, encode(replace(one_sample(FANS, *reasons), header=Header(producer, 0, tray))))

    def hear(self, tray: str, payload: bytes) -> None:
        self.now_s += 1.0
        key = tray_key("s", tray, "score")
        self.bus.subscribers[key](key, payload)

    def lines(self, *states: StageState) -> list[str]:
        return [each.line() for each in unjudged(self.model, states)]


@pytest.fixture
def listener() -> Listener:
    return Listener()


def state(label: str, word: Word, detail: str = "") -> StageState:
    tray = label.partition("/")[2]
    return StageState(label, word, detail, None, True, (tray,) if tray else ())


def test_row_01_fans_that_are_not_judged_are_named_with_the_reason_and_one_invalid_sample_is_none(listener):
    listener.score("a")
    listener.score("b")
    listener.score("a", InvalidReason.GAP)
    assert listener.lines() == []
    listener.now_s += SILENT_AFTER_S
    listener.score("a", InvalidReason.STALE, InvalidReason.NONE, InvalidReason.STALE, InvalidReason.NO_SPEED)
    listener.score("b", *[InvalidReason.WARMING_UP] * FANS)
    assert listener.lines() == [
        "a: fans 0, 2 not judged: the line is silent",
        "a: fan 3 not judged: no speed",
        "b: no fan is judged: the twin is warming up",
    ]


def test_what_fans_do_now_is_known_as_long_as_scores_come(listener):
    sample = one_sample(FANS, InvalidReason.NONE, InvalidReason.STOPPED, InvalidReason.NONE, InvalidReason.STARTING)
    states = np.array([[FanState.RETURNING, FanState.RETURNING, FanState.ALARM, FanState.STARTING]], np.uint8)
    listener.hear("a", encode(replace(sample, header=Header("", 0, "a"), state=states)))
    fans = [Fan("a", number) for number in range(FANS)]
    assert listener.model.words_now(fans) == [RETURNING, "stopped by its command", "", "starting"]
    listener.now_s += SILENT_AFTER_S + 1.0
    assert listener.model.words_now(fans) == [""] * FANS


def test_row_11_a_score_of_a_stranger_judges_no_fan_while_the_scorer_is_alive(listener):
    listener.bus.show(SCORER)
    outputs = tuple(Output(key=tray_key("s", tray.name, "score"), published=0) for tray in TRAYS)
    listener.bus.say(health(SCORER, outputs=outputs))
    listener.score("a", producer=STRANGER)
    listener.score("b", producer=SCORER.producer)
    assert listener.lines() == ["a: no fan is judged: no score arrives"]


def test_row_01_without_scores_the_first_stage_that_does_not_work_is_the_reason(listener):
    listener.score("a")
    listener.score("b")
    listener.now_s += SILENT_AFTER_S
    listener.score("b")
    twin = state("twin_integrator", Word.SILENT, "no health for 6 s: it hangs, is blocked or gets no processor time")
    others = [state("acquisition/a", Word.OK), state("acquisition/b", Word.SILENT, "of another tray")]
    after = [state("scorer", Word.STARVED, "later"), state("recorder", Word.SILENT, "not on the way")]
    assert listener.lines(*others, twin, *after) == [
        "a: no fan is judged: twin_integrator: no health for 6 s: it hangs, is blocked or gets no processor time"
    ]
    assert listener.lines(after[1]) == ["a: no fan is judged: no score arrives"]


def test_row_11_scores_that_are_late_judge_nobody_however_many_come(listener):
    """A flood of requests once held up a scorer for a minute, while its scores of before still came."""
    listener.score("a")
    listener.score("b")
    behind = state("scorer/a", Word.LATE, "it is 19 s behind")
    assert listener.lines(state("scorer", Word.OK)) == []
    assert listener.lines(behind) == ["a: no fan is judged: scorer/a: it is 19 s behind"]
    assert listener.lines(state("viewer", Word.LATE, "it is 19 s behind")) == [], "it is not on the way"


@pytest.mark.parametrize("payload", [b"\xff", b"", encode(one_sample(FANS + 1))])
def test_bytes_that_are_no_score_of_the_tray_judge_nothing(listener, payload):
    listener.hear("a", payload)
    assert len(listener.lines()) == 2


def test_a_fan_that_its_command_stops_is_judged_and_said_to_be_stopped(listener):
    listener.score("a", InvalidReason.STOPPED, InvalidReason.NONE, InvalidReason.STOPPED, InvalidReason.STARTING)
    listener.score("b", InvalidReason.STOPPED)
    assert listener.lines() == []
    assert [each.line() for each in at_rest(listener.model)] == [
        "a: fans 0, 2: stopped by their command",
        "a: fan 3: starting",
        "b: fan 0: stopped by its command",
    ]
    assert at_rest(listener.model)[1].as_json() == {"tray": "a", "fans": [3], "state": "starting"}
    listener.now_s += 2 * SILENT_AFTER_S
    assert at_rest(listener.model) == []


def test_changes_are_of_fans_and_reasons_and_not_of_figures():
    changes = JudgedChanges([Unjudged("a", (), "scorer: waits for 3 s"), Unjudged("b", (1,), "no speed")])
    assert changes.lines([Unjudged("a", (), "scorer: waits for 4 s"), Unjudged("b", (1,), "no speed")]) == []
    assert changes.lines([Unjudged("b", (2,), "no speed")]) == [
        "a: every fan is judged now",
        "b: fan 2 not judged: no speed",
    ]
    assert changes.lines([]) == ["b: every fan is judged now"]
    assert changes.lines([]) == []


def test_active_alarms_of_fans_that_are_not_judged_are_not_confirmed_by_data():
    def alarm(tray: str, fan: int, *, active: bool = True) -> CurrentAlarm:
        newest = made_messages.alarm(fan, 1, tray, active=active, message="too slow")
        return CurrentAlarm(newest, newest, (), "")

    alarms = [alarm("a", 0), alarm("a", 1), alarm("b", 2), alarm("b", 3, active=False), alarm("c", 0)]
    found = as_judged(alarms, [Unjudged("a", (1,), "no speed"), Unjudged("b", (), "no score arrives")])
    assert [each.newest.stale for each in found] == [False, True, True, False, False]
