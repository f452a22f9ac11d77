"""`fantwin replay` as a command: what it refuses before anything is on a bus, and the line it shows."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import ModuleType

import pytest

from pipeline.cli.recordings.replay import status_line
from pipeline.cli.recordings.score_again import Again
from pipeline.replay.live.player import Progress
from pipeline.replay.live.recording_playback import RecordingPlayback
from stages.resampler import ResamplerConfig, ResamplerCore
from tests.support.fantwin_command import error_of, fantwin, usage_error_of
from tests.support.replay_data import START_NS, STEP_NS, write_raw


@pytest.fixture
def recording(tmp_path):
    return write_raw(tmp_path / "r.mcap", 20)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--rate 0", "--rate 0: give a number above 0, to 1e+06, or max"),
        ("--rate 1e308", "give a number above 0"),
        ("--start 1e300", "--start"),
        ("--end 1e300", "--start"),
        ("--rate -1", "give a number above 0"),
        ("--rate inf", "give a number above 0"),
        ("--rate nan", "give a number above 0"),
        ("--rate quick", "give a number above 0"),
        ("--topics health", "--topics health: is not one of raw, grid"),
        ("--topics clock", "--topics clock: is not one of"),
        ("--from score", "--from score: is not one of raw, grid, prediction"),
        ("--from raw --topics raw", "not both"),
        ("--start 5 --end 5", "--start < --end"),
        ("--start -1", "--start < --end"),
        ("--pause", "needs a terminal"),
        ("--verify", "can only be used with --offline"),
        ("--twin t.onnx", "can only be used with --offline"),
        ("-o out.mcap", "can only be used with --offline"),
        ("--offline --rate 2", "--rate cannot be used with --offline"),
        ("--offline --loop", "--loop cannot be used with --offline"),
        ("--offline --pause", "--pause cannot be used with --offline"),
        ("--offline --topics raw", "--topics cannot be used with --offline"),
        ("--offline --from raw", "--from cannot be used with --offline"),
    ],
)
def test_contradictory_options_are_wrong_usage(recording, words, expected):
    assert expected in usage_error_of("replay", recording, *words.split())


def test_a_tray_that_the_configuration_lacks_is_one_line(recording, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('[[tray]]\nname = "rig"\nfans = 8\n')
    assert error_of("replay", recording, "-c", config) == f"{config}: no tray called 'tray1'; known: rig"


def test_deciding_again_is_handed_over_as_it_was_asked_for(recording, tmp_path, monkeypatch):
    asked: dict[str, object] = {}
    stand_in = ModuleType("pipeline.cli.recordings.replay_offline")
    vars(stand_in)["run_offline"] = lambda files, again, output, _pool, *, json_output: asked.update(
        files=files, again=again, output=output, json_output=json_output
    )
    monkeypatch.setitem(sys.modules, "pipeline.cli.recordings.replay_offline", stand_in)
    words = ["--offline", "--verify", "--twin", "t.onnx", "-o", "out.mcap", "--start", 1, "--set", "site=x", "--json"]
    assert fantwin("replay", recording, *words).exit_code == 0
    assert (asked["files"], asked["output"], asked["json_output"]) == ([recording], Path("out.mcap"), True)
    assert asked["again"] == Again(None, ("site=x",), Path("t.onnx"), verify=True, start_s=1.0, end_s=math.inf)


def test_the_status_line_shows_time_position_rate_and_messages():
    progress = Progress(START_NS + 12_500_000_000, 4.0, paused=False, round=0, messages=12345)
    line = status_line(progress, 12.5, 60.0)
    for words in ("2023-11-14T22:13:32.500Z", "12.50 s of 60.00 s", "x 4 ", "12,345 sent", "space"):
        assert words in line
    later = Progress(START_NS, math.inf, paused=True, round=2, messages=0)
    assert "round 3" in status_line(later, 12.5, 60.0)
    assert "paused, as fast as possible" in status_line(later, 12.5, None)


def test_round_after_round_a_resampler_sees_a_device_that_restarts_with_a_short_gap_and_no_loss(tmp_path):
    core = ResamplerCore(8, ResamplerConfig(rate_hz=100.0))
    playback = RecordingPlayback([write_raw(tmp_path / "long.mcap", 300)], ("raw",))
    times: list[int] = []
    for number, entry in playback.rounds():
        if number == 3:
            break
        times += [int(t_ns) for grid in core.step(entry.message) for t_ns in grid.t_ns]  # pyright: ignore[reportArgumentType]
    counters = core.counters()
    assert counters["clock_restarts"] == 2
    assert not {name: count for name, count in counters.items() if name.startswith("lost_") and count}
    assert counters["gaps"] == 2
    assert counters["grid_samples_in_gaps"] == counters["dropped_after_clock_restart"] == 2 * 10  # gap_limit_s each
    assert times == list(range(START_NS, START_NS + len(times) * STEP_NS, STEP_NS))
    assert len(times) >= 3 * 300 - 2
