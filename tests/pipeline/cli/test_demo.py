"""`make demo`, run as by a new user."""

from __future__ import annotations

import io
import json
import sys

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image
from rich.console import Console

from fantwin.pipeline.cli.watch.demo import DEMO_FOLDER, _clear, _run, demo
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.serial.config import SerialConfig
from tests.support.running_chain import DEADLINE_S, fantwin, is_running


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


def test_a_pipeline_that_does_not_stop_is_one_line_and_is_killed(tmp_path, endpoint, monkeypatch):
    monkeypatch.setattr(
        "fantwin.pipeline.selftest.scratch_site.FANTWIN", (sys.executable, "-c", STUBBORN, str(tmp_path))
    )
    monkeypatch.setattr("fantwin.pipeline.cli.watch.demo._STOP_TIMEOUT_S", 0.2)
    overrides = [f"bus.endpoint='{endpoint}'", f"tray.0.port='{tmp_path / 'tray'}'"]
    config = load_config(DEMO_FOLDER / "demo.toml", overrides)
    with pytest.raises(UserError, match=r"did not stop within 0\.2 s.*up\.log"):
        _run(config, overrides, tmp_path, Console(file=io.StringIO()))
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
            "scorer: started\nfantwin: stage recorder cannot write [here]\nrecorded: nothing\n",
            "stage recorder cannot write",
        ),
        ("", "no output"),
    ],
)
def test_the_reason_of_a_failure_is_in_the_terminal(tmp_path, endpoint, monkeypatch, log, reason):
    monkeypatch.setattr("fantwin.pipeline.selftest.scratch_site.FANTWIN", (sys.executable, "-c", FAILING, log))
    overrides = [f"bus.endpoint='{endpoint}'", f"tray.0.port='{tmp_path / 'tray'}'"]
    config = load_config(DEMO_FOLDER / "demo.toml", overrides)
    with pytest.raises(UserError, match=f"^the pipeline did not run to its end: {reason}.*full log: .*up.log"):
        _run(config, overrides, tmp_path, Console(file=io.StringIO()))


def test_a_demo_ignores_the_state_of_an_earlier_one_and_does_not_touch_other_files(tmp_path):
    for name in ("recording.mcap", "scorer-tray1.snapshot", "notes.txt"):
        (tmp_path / name).touch()
    _clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
