"""`make demo`, run as by a new user, and its summary: the truth of the tray against the recording."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image
from rich.console import Console

from fantwin.pipeline.cli.watch.demo import DEMO_FOLDER, _clear, _run, demo
from fantwin.pipeline.cli.watch.demo_report import SETTLING_NS, Summary, summarise
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.schemas.enums import Transition
from fantwin.schemas.topics import tray_key
from tests.support import made_messages
from tests.support.replay_data import START_NS, raw_of
from tests.support.running_chain import DEADLINE_S, fantwin, is_running
from tests.support.score_data import one_sample


@pytest.mark.slow
@pytest.mark.real_time
def test_the_demo_finds_both_faults_and_loses_nothing(tmp_path):
    out = tmp_path / "demo"
    done = fantwin("demo", "-o", out, timeout_s=2 * DEADLINE_S)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert "operators' page, while the demo runs: http://127.0.0.1:" in done.stdout

    summary = json.loads((out / "summary.json").read_text())
    assert [(fault["fan"], fault["kind"]) for fault in summary["faults"]] == [(2, "inlet"), (5, "rotor")]
    for fault in summary["faults"]:
        assert fault["start_ns"] < fault["alarm_ns"] < fault["stop_ns"] < fault["cleared_ns"]
    assert summary["samples_sent"] == summary["samples_recorded"] == 3600
    assert (summary["false_alarms"], summary["lost"], summary["problems"]) == (0, 0, [])
    assert 0 < summary["latency_ms"]["p50"] <= summary["latency_ms"]["p99"]

    with (out / "recording.mcap").open("rb") as file:  # by the library's own reader, without our code
        topics = {
            channel.topic
            for _, channel, _, _ in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        }
    assert {
        f"fantwin/demo/tray1/{topic}" for topic in ("raw", "grid", "prediction", "score", "alarm", "twin")
    } <= topics
    assert {f"fantwin/demo/health/{stage}/all" for stage in ("resampler", "scorer", "recorder", "viewer")} <= topics
    with Image.open(out / "bands.png") as picture:
        assert picture.width > 1000
    assert (out / "view.rrd").stat().st_size > 100_000


def test_a_folder_with_an_apostrophe_is_a_folder_like_any_other(tmp_path, monkeypatch):
    seen: list[Config] = []

    def note(config: Config, *_: object) -> dict[str, int]:
        seen.append(config)
        raise UserError("far enough")

    monkeypatch.setattr("fantwin.pipeline.cli.watch.demo._run", note)
    out = tmp_path / 'o\'clock "demo"'
    with pytest.raises(UserError, match="far enough"):
        demo(out)
    assert (seen[0].run_folder, seen[0].trays[0].source) == (out, SerialConfig(port=str(out / "tray")))


STUBBORN = """
import os, signal, sys, time
from pathlib import Path
here = Path(sys.argv[1])
if sys.argv[2] == "simulate":
    while not (here / "up").exists():
        time.sleep(0.01)
else:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    (here / "new").write_text(str(os.getpid()))
    (here / "new").rename(here / "up")
    while True:
        time.sleep(1.0)
"""


@pytest.fixture
def run_demo(tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Runs the demo, whose commands are those of a program instead of fantwin's. argument: of the program."""

    def run(program: str, argument: str) -> None:
        words = (sys.executable, "-c", program, argument)
        monkeypatch.setattr("fantwin.pipeline.selftest.scratch_site.FANTWIN", words)
        overrides = [f"bus.endpoint='{endpoint}'", f"tray.0.port='{tmp_path / 'tray'}'"]
        _run(load_config(DEMO_FOLDER / "demo.toml", overrides), overrides, tmp_path, Console(file=io.StringIO()))

    return run


def test_a_pipeline_that_does_not_stop_is_one_line_and_is_killed(tmp_path, run_demo, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.cli.watch.demo._STOP_TIMEOUT_S", 0.2)
    with pytest.raises(UserError, match=r"did not stop within 0\.2 s.*up\.log"):
        run_demo(STUBBORN, str(tmp_path))
    assert not is_running(int((tmp_path / "up").read_text()))


FAILING = """
import sys, time
if sys.argv[2] == "simulate":
    time.sleep(60)
sys.stderr.write(sys.argv[1])
sys.exit(1)
"""


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        (
            "scorer: started\nfantwin: no room [here]\nrecorded: nothing\n",
            "no room",
        ),
        ("", "no output"),
    ],
)
def test_the_reason_of_a_failure_is_in_the_terminal(run_demo, log, reason):
    with pytest.raises(UserError, match=f"^the pipeline did not run to its end: {reason}.*full log: .*up.log"):
        run_demo(FAILING, log)


def test_a_demo_ignores_the_state_of_an_earlier_one_and_does_not_touch_other_files(tmp_path):
    for name in ("recording.mcap", "scorer-tray1.snapshot", "notes.txt"):
        (tmp_path / name).touch()
    _clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


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
