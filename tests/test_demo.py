"""`make demo`, as a newcomer runs it."""

from __future__ import annotations

import json

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image

from tests.chain import fantwin


@pytest.mark.slow
def test_the_demo_finds_both_faults_and_loses_nothing(tmp_path):
    out = tmp_path / "demo"
    done = fantwin("demo", "-o", out, timeout_s=200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr

    summary = json.loads((out / "summary.json").read_text())
    assert [(fault["fan"], fault["kind"]) for fault in summary["faults"]] == [(2, "inlet"), (5, "rotor")]
    for fault in summary["faults"]:
        assert fault["start_ns"] < fault["alarm_ns"] < fault["stop_ns"] < fault["cleared_ns"]
    assert summary["samples_sent"] == summary["samples_recorded"] == 3200
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


def test_a_folder_that_cannot_be_used_is_one_line(tmp_path):
    (tmp_path / "file").write_text("in the way")
    done = fantwin("demo", "-o", tmp_path / "file" / "demo")
    assert done.returncode == 1
    assert "cannot be used for the demo's files" in done.stderr
    assert "Traceback" not in done.stderr
