"""The summary of the demo: the truth of the tray against the recording."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.cli.watch.demo_report import SETTLING_NS, summarise
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.fields import columns
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Message, Raw, Score
from fantwin.schemas.topics import tray_key

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
SAMPLES = 300
S = 1_000_000_000
INLET = {"fan": 2, "kind": "inlet", "start_ns": START_NS + 8 * S, "stop_ns": START_NS + 14 * S}
ROTOR = {"fan": 5, "kind": "rotor", "start_ns": START_NS + 18 * S, "stop_ns": START_NS + 24 * S}
RIGHT = [(2, True, 9.0), (2, False, 15.5), (5, True, 19.0), (5, False, 25.0)]


@dataclass
class Run:
    """A made-up run of the demo."""

    folder: Path
    alarms: list[tuple[int, bool, float]] = field(default_factory=lambda: list(RIGHT))
    sent: int = SAMPLES
    recorded: int = SAMPLES
    scored: int = SAMPLES
    lost: dict[str, int] = field(default_factory=dict)
    late_ns: int = 3_000_000
    first: int = 0
    twice: int = 0
    """How many of the last scores were recorded a second time, and with them all of raw."""

    def summary(self) -> Any:
        truth = self.folder / "truth.json"
        truth.write_text(
            json.dumps({"faults": [INLET, ROTOR], "samples_sent": self.sent, "fans": 8, "start_ns": START_NS})
        )
        recording = self.folder / "recording.mcap"
        with RecordingWriter(recording, {}, overwrite=True) as writer:
            for topic, message, log_t_ns in self._messages():
                writer.add_message(tray_key("demo", "tray1", topic), message, log_t_ns)
        return summarise(truth, [recording], self.lost)

    def _messages(self) -> list[tuple[str, Message, int]]:
        def times(count: int) -> Any:
            return START_NS + (self.first + np.arange(count)) * STEP_NS

        def block(count: int) -> dict[str, Any]:
            return {"fans": 1, "period_ns": STEP_NS, "t_ns": times(count)}

        sequence = (self.first + np.arange(self.recorded)).astype(np.uint32)
        raw = Raw(
            fans=1,
            host_receive_t_ns=times(self.recorded),
            device_sequence=sequence,
            **one_fan(Raw, self.recorded),
        )
        found: list[tuple[str, Message, int]] = [
            ("raw", raw, START_NS),
            ("grid", Grid(**block(SAMPLES), **one_fan(Grid, SAMPLES)), START_NS),
        ]
        for k in range(self.scored):
            t_ns = START_NS + (self.first + k) * STEP_NS
            score = Score(fans=1, period_ns=STEP_NS, t_ns=np.array([t_ns]), **one_fan(Score, 1))
            found.append(("score", score, t_ns + self.late_ns))
        found += [*found[:1], *found[len(found) - self.twice :]] if self.twice else []
        for number, (fan, active, at_s) in enumerate(self.alarms):
            t_ns = START_NS + round(at_s * S)
            found.append(("alarm", alarm(number, fan, active, t_ns), t_ns))
        return found


def one_fan(message: type[Message], count: int) -> dict[str, Any]:
    """The columns of samples by fans, all zero."""
    found = columns(message).items()
    return {name: np.zeros((count, 1), column.dtype) for name, column in found if column.shape == "samples x fans"}


def alarm(number: int, fan: int, active: bool, t_ns: int) -> Alarm:
    return Alarm(
        header=Header("scorer", number, "tray1"),
        fan=fan,
        active=active,
        severity=Severity.ALARM,
        t_ns=t_ns,
        onset_t_ns=t_ns,
        residual_rad_s=0.0,
        residual_std_rad_s=0.0,
        message="",
        transition=Transition.RAISED if active else Transition.CLEARED,
    )


def test_a_run_as_it_must_be_has_no_problems_and_json_fields_that_others_rely_on(tmp_path):
    summary = Run(tmp_path).summary()
    assert summary.problems == []
    inlet, rotor = summary.faults
    assert (inlet.fan, inlet.kind, inlet.delay_s, inlet.cleared_ns) == (2, "inlet", 1.0, START_NS + 15.5 * S)
    assert (rotor.fan, rotor.kind, rotor.delay_s) == (5, "rotor", 1.0)
    assert (summary.samples_sent, summary.samples_recorded, summary.lost) == (SAMPLES, SAMPLES, 0)
    assert summary.false_alarms == 0
    assert summary.latency_ms == {"p50": 3.0, "p99": 3.0}
    reported = json.loads(summary.to_json())
    assert {"faults", "false_alarms", "samples_sent", "samples_recorded", "lost", "latency_ms"} <= set(reported)
    assert {"fan", "kind", "start_ns", "alarm_ns", "cleared_ns"} <= set(reported["faults"][0])


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"alarms": RIGHT[2:]}, "the inlet fault of fan 2 was missed"),
        ({"alarms": [(2, True, 14.5), *RIGHT[1:]]}, "the inlet fault of fan 2 was missed"),
        ({"alarms": [(2, True, 7.0), *RIGHT[1:]]}, "1 alarms of healthy fans"),
        ({"alarms": [RIGHT[0], *RIGHT[2:]]}, "the alarm of fan 2 was never cleared"),
        ({"alarms": [*RIGHT, (3, True, 20.0), (3, False, 21.0)]}, "1 alarms of healthy fans"),
        ({"alarms": [*RIGHT, (2, True, 14 + SETTLING_NS / S + 0.1)]}, "1 alarms of healthy fans"),
        ({"sent": SAMPLES + 4}, "4 samples or messages were lost"),
        ({"scored": SAMPLES - 1}, "1 samples or messages were lost"),
        ({"lost": {"viewer": 0, "resampler": 2}}, "2 samples or messages were lost"),
        ({"recorded": 0, "sent": 0}, "nothing was recorded"),
        ({"sent": SAMPLES + 4, "twice": 9}, "4 samples or messages were lost"),
        ({"scored": SAMPLES - 1, "twice": 9}, "1 samples or messages were lost"),
    ],
)
def test_each_failure_is_a_problem_of_the_summary(tmp_path, changes, problem):
    assert problem in Run(tmp_path, **changes).summary().problems


def test_an_alarm_while_the_fan_runs_back_is_that_faults_and_not_false(tmp_path):
    summary = Run(tmp_path, alarms=[*RIGHT, (2, True, 16.0), (2, False, 17.0)]).summary()
    assert summary.false_alarms == 0


def test_without_the_report_of_the_simulated_tray_there_is_no_summary(tmp_path):
    with pytest.raises(UserError, match="no report of the simulated tray"):
        summarise(tmp_path / "truth.json", [], {})
