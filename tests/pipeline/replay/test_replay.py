"""`fantwin replay` as a command: what it refuses before anything is on a bus, and the line it shows."""

from __future__ import annotations

import pytest

from fantwin.pipeline.replay.live.listeners import Listeners
from tests.support.fantwin_command import error_of, usage_error_of
from tests.support.replay_data import write_raw


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
