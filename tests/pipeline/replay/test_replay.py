"""`fantwin replay` as a command: what it refuses before anything is on a bus, and the line it shows."""

from __future__ import annotations

import pytest

from fantwin.pipeline.replay.live.listeners import Listeners
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support.fantwin_command import error_of, usage_error_of
from tests.support.replay_data import START_NS, STEP_NS, write_raw


@pytest.fixture
def recording(tmp_path):
    return write_raw(tmp_path / "r.mcap", 20)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--rate 0", "--rate 0: give a number above 0, to 1e+06, or max"),
        ("--start 1e300", "--start"),
        ("--rate nan", "give a number above 0"),
        ("--topics health", "--topics health: is not one of raw, grid"),
        ("--from score", "--from score: is not one of raw, grid, prediction"),
        ("--from raw --topics raw", "not both"),
        ("--start 5 --end 5", "--start < --end"),
        ("--start -1", "--start < --end"),
        ("--pause", "needs a terminal"),
        ("--verify", "can only be used with --offline"),
        ("--offline --rate 2", "--rate cannot be used with --offline"),
        ("--offline --topics raw", "--topics cannot be used with --offline"),
    ],
)
def test_contradictory_options_are_wrong_usage(recording, words, expected):
    assert expected in usage_error_of("replay", recording, *words.split())


def test_a_tray_that_the_configuration_lacks_is_one_line(recording, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('[[tray]]\nname = "rig"\nfans = 8\n')
    assert error_of("replay", recording, "-c", config) == f"{config}: no tray called 'tray1'; known: rig"


def test_beside_another_replay_it_is_refused(recording, tmp_path, endpoint, monkeypatch):
    monkeypatch.setattr(Listeners, "wait_for_discovery", lambda _listeners, _stop, _report: None)
    monkeypatch.setattr(Listeners, "is_replaying", lambda _listeners: True)
    config = tmp_path / "c.toml"
    config.write_text(f'site = "hall"\nbus = {{ endpoint = "{endpoint}" }}\n[[tray]]\nname = "tray1"\nfans = 8\n')
    expected = f"a replay is running on site 'hall' at {endpoint}: stop that first"
    assert error_of("replay", recording, "-c", config) == expected


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
