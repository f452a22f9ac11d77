"""`fantwin alarms`: the command, over a real bus, with a scorer that raises an alarm on request; and the history."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.main import expand_variadic
from fantwin.pipeline.cli.watch.scorers import wait_for_stages
from fantwin.pipeline.recordings.clips.clip import CLIP_KEY
from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.runtime.stage import Core
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.alarm_rates import AlarmRates, JudgedStretch
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.enums import Feedback, InvalidReason, Severity, StageStatus, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, Message, Request, Score
from fantwin.schemas.topics import BY_NAME, tray_key
from fantwin.scoring.alarms.alarm_state import AlarmState
from fantwin.scoring.alarms.alarms_of_tray import AlarmsOfTray, Decided
from fantwin.scoring.alarms.current_alarms import clock
from tests.support.fantwin_command import error_of, fantwin
from tests.support.made_messages import alarm
from tests.support.running_chain import DEMO, FANTWIN, SITE, TRAY, eventually
from tests.support.running_scorer import RunningScorer
from tests.support.score_data import one_sample
from tests.support.small_recordings import write

FANS = 8
CAUSES = (
    Diagnosis(cause="drag_up", probability=0.83, evidence="drag +50 %"),
    Diagnosis(cause="friction_up", probability=0.1),
)


class AlarmOnRequestScorer(Core):
    """The conditions of a tray whose fans have the alarms that a test says; answers requests as a scorer does."""

    def __init__(self) -> None:
        self.conditions = AlarmsOfTray.begin(FANS)
        self.has_alarm: set[int] = set()
        self._raised_t_ns = np.zeros(FANS, np.int64)
        self.deaf = False
        self.not_judged: tuple[InvalidReason, ...] = ()
        self._now_ns = 0

    def tick(self, now_ns: int) -> Sequence[Message]:
        self._now_ns = now_ns
        active = np.isin(np.arange(FANS), list(self.has_alarm))
        self._raised_t_ns = np.where(active & (self._raised_t_ns > 0), self._raised_t_ns, now_ns * active)
        severity, judged = np.full(FANS, int(Severity.ALARM)), np.ones(FANS, np.bool_)
        events = self.conditions.update(Decided(now_ns, judged, active, severity, self._raised_t_ns, 0))
        alarms = [self._alarm(each.fan, each.transition, each.alarm_state, "too slow") for each in events]
        return [replace(one_sample(FANS, *self.not_judged), t_ns=np.array([now_ns])), *alarms]

    def step(self, item: Any) -> Sequence[Message]:
        if self.deaf or not isinstance(item, Request):
            return []
        fans = range(FANS) if item.fan < 0 else [item.fan]
        said = (item.operator_name, item.comment, item.onset_t_ns)
        asked = (item.action, fans, self._now_ns, item.duration_s * 1e9, *said)
        name = f"{item.header.producer}/{item.header.sequence}"
        return [
            replace(
                self._alarm(fan, transition, self.conditions.alarm_state(fan), _in_words(fan, transition, why)),
                request=name,
                operator_name=item.operator_name,
                comment=item.comment,
                marked_onset_t_ns=self.conditions.onset_meant(fan, item.onset_t_ns),
            )
            for fan, transition, why in self.conditions.request(*asked)
        ]

    def _alarm(self, fan: int, transition: Transition, standing: AlarmState, message: str) -> Alarm:
        state = {each.name: getattr(standing, each.name) for each in fields(AlarmState)}
        state = {name: value for name, value in state.items() if name in Alarm.__dataclass_fields__}
        causes = CAUSES if transition == Transition.RAISED else ()
        return alarm(fan, self._now_ns, message=message, transition=transition, causes=causes, **state)


def _in_words(fan: int, transition: Transition, why: str) -> str:
    return f"fan {fan}: refused: {why}" if why else f"fan {fan}: {transition.name.lower()}"


class Site(RunningScorer):
    """The scorer, and a command that asks it."""

    def __init__(self, endpoint: str) -> None:
        self.core = AlarmOnRequestScorer()
        super().__init__(endpoint, self.core)

    def raise_alarm(self, fan: int) -> None:
        self.core.has_alarm = {*self.core.has_alarm, fan}
        eventually(lambda: self.core.conditions.alarm_state(fan).active, f"fan {fan} has an alarm")

    def ask(self, *words: object) -> str:
        """The output of the command, which must succeed."""
        done = fantwin("alarms", *words, *self.words)
        assert done.exit_code == 0, done.exception
        return done.stdout

    def refused(self, *words: object) -> str:
        return error_of("alarms", *words, *self.words)

    def listed(self, *words: object) -> list[dict[str, Any]]:
        return json.loads(self.ask("--json", *words))["alarms"]


@pytest.fixture
def site(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setattr("fantwin.pipeline.runtime.runner.HEALTH_PERIOD_S", 0.05)  # every command waits for the next one
    site = Site(endpoint)
    yield site
    site.end()


def test_the_list_shows_current_alarms_and_with_all_also_those_that_are_over(site):
    assert site.listed() == []
    assert site.ask() == "no alarms\n"
    site.raise_alarm(3)
    site.raise_alarm(5)
    site.core.has_alarm = site.core.has_alarm - {5}
    eventually(lambda: not site.core.conditions.alarm_state(5).active, "it has cleared")
    before_ns = time.time_ns()
    assert [(a["tray"], a["fan"], a["active"]) for a in site.listed()] == [(TRAY, 3, True), (TRAY, 5, False)]
    site.ask("acknowledge", TRAY, 5)
    (alarm,) = site.listed()
    assert (alarm["fan"], alarm["severity"], alarm["presented"]) == (3, "alarm", True)
    assert alarm["causes"][0] == {"cause": "drag_up", "probability": 0.83, "evidence": "drag +50 %"}
    assert 0 < alarm["onset_t_ns"] < before_ns
    assert [a["fan"] for a in site.listed("--all")] == [3, 5]
    first, cause, message = site.ask().splitlines()
    assert first.startswith(f"{TRAY} fan 3  ALARM    active, unacknowledged  since ")
    assert cause.strip() == "more drag 83 %: drag +50 %"
    assert message.strip() == f"at {clock(alarm['message_t_ns'])}: too slow"


def test_row_01_no_alarms_is_not_said_while_a_fan_is_not_judged(site):
    site.core.not_judged = (InvalidReason.NO_SPEED, InvalidReason.NONE, InvalidReason.STALE)
    done = fantwin("alarms", *site.words)
    assert done.stdout == f"{TRAY}: fan 2 not judged: the line is silent\n{TRAY}: fan 0 not judged: no speed\n"
    assert done.exit_code == 1
    document = json.loads(fantwin("alarms", "--json", *site.words).stdout)
    assert document["not_judged"][1] == {"tray": TRAY, "fans": [0], "why": "no speed"}


def test_an_acknowledgement_names_who_and_a_shelved_alarm_is_listed_and_not_presented(site):
    site.raise_alarm(3)
    output = site.ask("acknowledge", TRAY, 3, "--operator", "Ann", "--comment", "on my way")
    assert output == f"{TRAY}: fan 3: acknowledged\n"
    assert site.core.conditions.alarm_state(3).comment == "on my way"
    (answer,) = json.loads(site.ask("shelve", TRAY, 3, "--for", "30m", "--json"))["answers"]
    assert (answer["transition"], answer["fan"]) == ("shelved", 3)
    assert answer["shelved_until_t_ns"] == pytest.approx(time.time_ns() + 1800e9, abs=60e9)
    (alarm,) = site.listed()
    assert (alarm["acknowledged_by"], alarm["retained"], alarm["presented"]) == ("Ann", True, False)
    assert "acknowledged by Ann, shelved until" in site.ask()
    site.ask("unshelve", TRAY, 3)
    assert site.listed()[0]["presented"]


def test_a_request_for_all_fans_succeeds_if_it_is_granted_for_at_least_one_and_asking_is_no_loss(site):
    site.raise_alarm(3)
    lines = site.ask("acknowledge", TRAY).splitlines()
    assert lines[3] == f"{TRAY}: fan 3: acknowledged"
    assert lines[4] == f"{TRAY}: fan 4: refused: no alarm has been raised"
    assert len(lines) == FANS
    assert site.refused("acknowledge", TRAY) == f"{TRAY}: acknowledge refused for all fans"
    assert site.refused("acknowledge", TRAY, 2) == f"{TRAY}: fan 2: refused: no alarm has been raised"
    for action in ("out-of-service", "in-service"):
        site.ask(action, TRAY, 1)
    site.end()
    last = site.newest
    assert (last.status, last.problem, last.lost) == (StageStatus.STOPPED, "", 0)
    assert [line.received for line in last.inputs] == [1] * 5, "commands that come and go"


def test_watching_prints_what_happens_as_it_happens(site):
    site.raise_alarm(3)
    site.core.not_judged = (InvalidReason.NO_SPEED,) * FANS
    words = [*FANTWIN, "alarms", "--watch", "--json", *map(str, site.words)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watching:
        assert watching.stdout and watching.stderr
        standing = json.loads(watching.stdout.readline())
        site.core.not_judged = ()
        assert watching.stderr.readline().endswith(f"  {TRAY}: every fan is judged now\n")
        site.core.has_alarm = site.core.has_alarm - {3}
        cleared = json.loads(watching.stdout.readline())
        site.ask("acknowledge", TRAY, 3, "--operator", "Ann")
        acknowledged = json.loads(watching.stdout.readline())
        site.end()
        assert f"site '{SITE}': no scorer is alive: alarms are unknown until one is back" in watching.stderr.readline()
        watching.send_signal(signal.SIGINT)
        assert watching.wait(20) == 0
    assert [(a["fan"], a["active"]) for a in standing["alarms"]] == [(3, True)]
    assert standing["not_judged"] == [{"tray": TRAY, "fans": [], "why": "no speed"}], "of all fans"
    assert (cleared["transition"], cleared["fan"], cleared["active"]) == ("cleared", 3, False)
    assert (acknowledged["transition"], acknowledged["acknowledged_by"]) == ("acknowledged", "Ann")


def test_row_10_an_answer_of_a_stranger_is_none_and_a_scorer_that_does_not_answer_is_reported(site, monkeypatch):
    """Somebody who reads the request grants it before the scorer can."""
    key, site.core.deaf = tray_key(SITE, TRAY, "alarm"), True

    def wait_for_both(bus: Bus, *words: Any, **more: Any) -> None:
        wait_for_stages(bus, *words, **more)
        eventually(lambda: len(bus._session.info.peers_zid()) == 2, "it has met the stranger, too")

    monkeypatch.setattr("fantwin.pipeline.cli.watch.alarms.wait_for_stages", wait_for_both)
    with Bus(site.config.bus) as bus:
        stranger = bus.publisher(key, BY_NAME["alarm"], type_name(Alarm), "stranger")
        heard = threading.Event()

        def grant(_key: str, payload: bytes) -> None:
            header = decode(Request, payload).header
            alarm = site.core._alarm(3, Transition.ACKNOWLEDGED, site.core.conditions.alarm_state(3), "granted")
            name = f"{header.producer}/{header.sequence}"
            stranger.put(encode(replace(alarm, header=Header("stranger", 0, TRAY), request=name)))
            heard.set()

        bus.subscribe(tray_key(SITE, TRAY, "request"), grant)
        eventually(site.runner._bus._session.info.peers_zid, "they have met")
        refusal = site.refused("acknowledge", TRAY, 3, "--timeout", 1)
    assert heard.is_set()
    assert refusal == (
        f"tray {TRAY}: no answer for fan 3 within 1 s: perhaps no scorer runs, for example because the tray has no "
        "twin yet: see `fantwin status`"
    )


@pytest.mark.parametrize("words", [(), ("acknowledge", TRAY, 3)], ids=["list", "acknowledge"])
def test_without_a_scorer_one_line_says_that_nothing_is_known(endpoint, words, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.cli.watch.scorers._DISCOVERY_S", 0.3)
    error = error_of("alarms", *words, "-c", DEMO / "demo.toml", "--set", f"bus.endpoint='{endpoint}'")
    assert f"alarms unknown: no scorer of site '{SITE}' answers at {endpoint}" in error


def test_an_operator_says_whether_an_alarm_was_true_while_it_stands_and_after_it(site):
    site.raise_alarm(3)
    assert "a false alarm needs a reason" in site.refused("false-alarm", TRAY, 3)
    said = site.ask("false-alarm", TRAY, 3, "--comment", "the door was open", "--operator", "ann")
    assert said == f"{TRAY}: fan 3: marked_false\n"
    (first,) = site.listed()
    assert (first["feedback"], first["feedback_reason"]) == ("false_alarm", "the door was open")
    assert "marked as a false alarm by ann: the door was open" in site.ask().splitlines()[0]
    site.core.has_alarm = site.core.has_alarm - {3}
    eventually(lambda: not site.core.conditions.alarm_state(3).active, "it has cleared")
    onset = f"{datetime.fromtimestamp(first['onset_t_ns'] / 1e9):%Y-%m-%d %H:%M:%S}"
    (answer,) = json.loads(site.ask("true-alarm", TRAY, 3, "--onset", onset, "--json"))["answers"]
    assert (answer["transition"], answer["marked_onset_t_ns"]) == ("marked_true", first["onset_t_ns"])
    assert "no alarm began then" in site.refused("true-alarm", TRAY, 3, "--onset", "2020-01-01 10:00:00")


GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"
"""fan 1 has an alarm; its twin declares 24 false alarms per fan and day"""


OF_GOLDEN = {"site": "golden", "trays": "tray1"}


def golden_alarms() -> list[Alarm]:
    return [alarm for each in rare_messages(GOLDEN, "alarm") if isinstance(alarm := each.message, Alarm)]


def marked(alarm: Alarm, feedback: Feedback, sequence: int, reason: str) -> Alarm:
    transition = Transition.MARKED_TRUE if feedback == Feedback.TRUE_ALARM else Transition.MARKED_FALSE
    given = {"feedback": feedback, "feedback_by": "ann", "feedback_reason": reason, "transition": transition}
    given |= {"active": False, "operator_name": "ann", "comment": reason, "marked_onset_t_ns": alarm.onset_t_ns}
    return replace(alarm, header=Header("scorer-later", sequence, alarm.header.tray), **given)


@pytest.fixture
def later(tmp_path: Path) -> Path:
    """A recording of the next day, in which an operator changes his mind."""
    (*_, last) = (alarm for alarm in golden_alarms() if alarm.fan == 1)
    said = [
        replace(marked(last, feedback, number, "the door was open"), t_ns=last.t_ns + 10**9 * number)
        for number, feedback in enumerate((Feedback.TRUE_ALARM, Feedback.FALSE_ALARM))
    ]
    return write(tmp_path / "later.mcap", said, OF_GOLDEN, at=attrgetter("t_ns"))


def history(*words: object) -> dict[str, Any]:
    done = fantwin("alarms", *expand_variadic(["alarms", "--history", *map(str, words)])[1:], "--json")
    assert done.exit_code == 0, done.exception
    return json.loads(done.stdout)


def judged_fan_s() -> float:
    scores = [score for each in read_recording(GOLDEN, ("score",)) if isinstance(score := each.message, Score)]
    return sum(int(np.count_nonzero(score.valid)) * score.period_ns / 1e9 for score in scores)


def test_the_alarms_of_recordings_have_the_feedback_of_later_ones_and_the_rate_that_was(later: Path) -> None:
    before = history("--recordings", GOLDEN)
    (alarm,) = before["alarms"]
    assert (alarm["fan"], alarm["feedback"], before["rate"]["unmarked"]) == (1, "none", 1)
    found = history("--recordings", GOLDEN, later)
    (alarm,) = found["alarms"]
    said = [alarm[name] for name in ("feedback", "feedback_by", "feedback_reason")]
    assert said == ["false_alarm", "ann", "the door was open"]
    rate = found["rates"]["tray1"]
    days = judged_fan_s() / 86400
    assert rate["fan_hours"] == pytest.approx(24 * days)
    assert (rate["false_alarms"], rate["unmarked"], rate["declared_per_day"]) == (1, 0, 24.0)
    assert rate["false_alarms_per_day"] == pytest.approx(1 / days)
    assert rate["interval_95"] == pytest.approx([0.02532 / days, 5.5716 / days], rel=1e-3)
    alarm, line = fantwin("alarms", "--history", "--recordings", GOLDEN, "--recordings", later).stdout.splitlines()
    assert "tray1 fan 1" in alarm and alarm.endswith("false alarm by ann: the door was open")
    assert line.startswith("tray1: since ") and line.endswith("; declared 24")
    again = history("--recordings", later, GOLDEN, GOLDEN.parent / ".." / "data" / "golden.mcap")
    assert again["rates"] == found["rates"], "what two recordings have counts once"


def test_the_history_names_both_of_two_causes_that_are_equally_probable(tmp_path: Path) -> None:
    raised = next(each for each in golden_alarms() if each.transition == Transition.RAISED)
    causes = tuple(Diagnosis(cause=cause, probability=0.4) for cause in ("drag_up", "friction_up"))
    about = {"site": "golden", "trays": "tray1"}
    write(tmp_path / "two.mcap", [replace(raised, causes=causes)], about, start=raised.t_ns)
    shown = fantwin("alarms", "--history", "--recordings", tmp_path / "two.mcap").stdout
    assert "  more drag 40 %  more friction 40 %  " in shown


def test_a_gateway_on_this_host_has_kept_the_history(tmp_path: Path) -> None:
    store = AlarmHistory(tmp_path / "alarms.sqlite")
    alarms = [alarm for alarm in golden_alarms() if alarm.fan == 1]
    for each in [*alarms, marked(alarms[-1], Feedback.FALSE_ALARM, 0, "the door was open")]:
        store.add(each)
    first_t_ns = alarms[0].t_ns - 10**9
    AlarmRates(store).catch_up([JudgedStretch("tray1", "abc", first_t_ns, first_t_ns + 10**13, 3_600 * 10**9, 0.5)])
    found = history("-c", DEMO / "demo.toml", "--set", f"run_folder='{tmp_path}'")
    store.close()
    assert [alarm["feedback"] for alarm in found["alarms"]] == ["false_alarm"]
    rate = found["rate"]
    assert (rate["fan_hours"], rate["false_alarms"], rate["declared_per_day"]) == (1.0, 1, 0.5)


def test_the_clip_of_an_alarm_gives_no_rate_and_is_no_healthy_running(tmp_path):
    path = write(tmp_path / "tray1-1.mcap", golden_alarms(), OF_GOLDEN | {CLIP_KEY: "{}"}, at=attrgetter("t_ns"))
    for command in (
        ("alarms", "--history", "--recordings", path),
        ("calibrate", DEMO / "twin.onnx", path, "--false-alarms-per-day", "24", "-o", tmp_path / "limited.onnx"),
    ):
        result = fantwin(*map(str, command))
        assert result.exit_code == 1
        assert str(result.exception).startswith(f"{path}: this is the clip of an alarm")
