"""`fantwin alarms --history`: the alarms of recordings and of a gateway, feedback on them, and the rate."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.cli.main import expand_variadic
from fantwin.pipeline.recordings.clips.clip import CLIP_KEY
from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.alarm_rates import AlarmRates, JudgedStretch
from fantwin.schemas.enums import Feedback, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import tray_key
from tests.support.fantwin_command import fantwin
from tests.support.running_chain import DEMO

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"
"""fan 1 has an alarm; its twin declares 24 false alarms per fan and day"""


def golden_alarms() -> list[Alarm]:
    return [alarm for each in rare_messages(GOLDEN, "alarm") if isinstance(alarm := each.message, Alarm)]


def marked(alarm: Alarm, feedback: Feedback, sequence: int, reason: str) -> Alarm:
    transition = Transition.MARKED_TRUE if feedback == Feedback.TRUE_ALARM else Transition.MARKED_FALSE
    given = {"feedback": feedback, "feedback_by": "ann", "feedback_reason": reason}
    return replace(
        alarm,
        header=Header("scorer-later", sequence, alarm.header.tray),
        transition=transition,
        active=False,
        operator_name="ann",
        comment=reason,
        marked_onset_t_ns=alarm.onset_t_ns,
        **given,
    )


@pytest.fixture
def later(tmp_path: Path) -> Path:
    """A recording of the next day, in which an operator changes his mind."""
    (*_, last) = (alarm for alarm in golden_alarms() if alarm.fan == 1)
    path = tmp_path / "later.mcap"
    with RecordingWriter(path, {"site": "golden", "trays": "tray1"}) as writer:
        for number, feedback in enumerate((Feedback.TRUE_ALARM, Feedback.FALSE_ALARM)):
            message = replace(marked(last, feedback, number, "the door was open"), t_ns=last.t_ns + 10**9 * number)
            writer.add_message(tray_key("golden", "tray1", "alarm"), message, message.t_ns)
    return path


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
    assert (alarm["feedback"], alarm["feedback_by"], alarm["feedback_reason"]) == (
        "false_alarm",
        "ann",
        "the door was open",
    )
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


def test_a_gateway_on_this_host_has_kept_the_history(tmp_path: Path) -> None:
    store = AlarmHistory(tmp_path / "alarms.sqlite")
    alarms = [alarm for alarm in golden_alarms() if alarm.fan == 1]
    for alarm in [*alarms, marked(alarms[-1], Feedback.FALSE_ALARM, 0, "the door was open")]:
        store.add(alarm)
    first_t_ns = alarms[0].t_ns - 10**9
    AlarmRates(store).catch_up([JudgedStretch("tray1", "abc", first_t_ns, first_t_ns + 10**13, 3_600 * 10**9, 0.5)])
    found = history("-c", DEMO / "demo.toml", "--set", f"run_folder='{tmp_path}'")
    store.close()
    assert [alarm["feedback"] for alarm in found["alarms"]] == ["false_alarm"]
    rate = found["rate"]
    assert (rate["fan_hours"], rate["false_alarms"], rate["declared_per_day"]) == (1.0, 1, 0.5)


def test_the_clip_of_an_alarm_gives_no_rate_and_is_no_healthy_running(tmp_path):
    path = tmp_path / "tray1-1-20270115T080000Z.mcap"
    with RecordingWriter(path, {"site": "golden", "trays": "tray1", CLIP_KEY: "{}"}) as writer:
        for alarm in golden_alarms():
            writer.add_message(tray_key("golden", "tray1", "alarm"), alarm, alarm.t_ns)
    for command in (
        ("alarms", "--history", "--recordings", path),
        ("calibrate", DEMO / "twin.onnx", path, "--false-alarms-per-day", "24", "-o", tmp_path / "limited.onnx"),
    ):
        result = fantwin(*map(str, command))
        assert result.exit_code == 1
        assert str(result.exception).startswith(f"{path}: this is the clip of an alarm")
