"""The summary of the demo: the truth of the tray against the recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.cli.watch.demo_report import SETTLING_NS, Summary, summarise
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import Transition
from fantwin.schemas.topics import tray_key
from tests.support import made_messages
from tests.support.replay_data import START_NS, raw_of
from tests.support.score_data import one_sample

SAMPLES = 300
S = 1_000_000_000
INLET = {"fan": 2, "kind": "inlet", "start_ns": START_NS + 8 * S, "stop_ns": START_NS + 14 * S}
ROTOR = {"fan": 5, "kind": "rotor", "start_ns": START_NS + 18 * S, "stop_ns": START_NS + 24 * S}
RIGHT = [(2, True, 9.0), (2, False, 15.5), (5, True, 19.0), (5, False, 25.0)]
"""fan, whether its alarm is raised then, seconds"""


def summary_of(
    folder: Path,
    alarms: list[tuple[int, bool, float]] = RIGHT,
    sent: int = SAMPLES,
    recorded: int = SAMPLES,
    lost: dict[str, int] | None = None,
    times_recorded: int = 1,
) -> Summary:
    """The summary of a made-up run. times_recorded: how often its samples are in the recording."""
    truth, recording = folder / "truth.json", folder / "recording.mcap"
    truth.write_text(json.dumps({"faults": [INLET, ROTOR], "samples_sent": sent, "fans": 8, "start_ns": START_NS}))
    score = replace(one_sample(1), t_ns=np.array([START_NS]))
    with RecordingWriter(recording, {}) as writer:
        for _ in range(times_recorded):
            writer.add_message(tray_key("demo", "tray1", "raw"), raw_of(0, 1, samples=recorded), START_NS)
        writer.add_message(tray_key("demo", "tray1", "score"), score, START_NS + 3_000_000)
        for number, (fan, active, at_s) in enumerate(alarms):
            t_ns, transition = START_NS + round(at_s * S), Transition.RAISED if active else Transition.CLEARED
            alarm = made_messages.alarm(fan, t_ns, sequence=number, active=active, transition=transition)
            writer.add_message(tray_key("demo", "tray1", "alarm"), alarm, t_ns)
    return summarise(truth, [recording], lost or {})


def test_a_good_run_has_no_problems_and_the_json_fields_that_others_rely_on(tmp_path: Path) -> None:
    summary = summary_of(tmp_path, alarms=[*RIGHT, (2, True, 16.0), (2, False, 17.0)])
    assert summary.problems == []
    assert summary.false_alarms == 0, "an alarm while the fan runs back is that fault's"
    inlet, rotor = summary.faults
    assert (inlet.fan, inlet.kind, inlet.delay_s, inlet.cleared_ns) == (2, "inlet", 1.0, START_NS + 15.5 * S)
    assert (rotor.fan, rotor.kind, rotor.delay_s) == (5, "rotor", 1.0)
    assert (summary.samples_sent, summary.samples_recorded, summary.lost) == (SAMPLES, SAMPLES, 0)
    assert summary.latency_ms == {"p50": 3.0, "p99": 3.0}
    reported = json.loads(summary.to_json())
    assert {"faults", "false_alarms", "samples_sent", "samples_recorded", "lost", "latency_ms"} <= set(reported)
    assert {"fan", "kind", "start_ns", "alarm_ns", "cleared_ns"} <= set(reported["faults"][0])


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"alarms": RIGHT[2:]}, "the inlet fault of fan 2 was missed"),
        ({"alarms": [(2, True, 7.0), *RIGHT[1:]]}, "1 alarms of healthy fans"),
        ({"alarms": [RIGHT[0], *RIGHT[2:]]}, "the alarm of fan 2 was never cleared"),
        ({"alarms": [*RIGHT, (3, True, 20.0), (3, False, 21.0)]}, "1 alarms of healthy fans"),
        ({"alarms": [*RIGHT, (2, True, 14 + SETTLING_NS / S + 0.1)]}, "1 alarms of healthy fans"),
        ({"sent": SAMPLES + 4}, "4 samples or messages were lost"),
        ({"sent": SAMPLES + 4, "times_recorded": 2}, "4 samples or messages were lost"),
        ({"lost": {"viewer": 0, "resampler": 2}}, "2 samples or messages were lost"),
        ({"recorded": 0, "sent": 0}, "nothing was recorded"),
    ],
)
def test_each_failure_is_a_problem_of_the_summary(tmp_path: Path, changes: dict[str, Any], problem: str) -> None:
    assert problem in summary_of(tmp_path, **changes).problems


def test_without_the_report_of_the_simulated_tray_there_is_no_summary(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no report of the simulated tray"):
        summarise(tmp_path / "truth.json", [], {})
