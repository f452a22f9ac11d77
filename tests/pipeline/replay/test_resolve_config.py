"""The site on which a recording is replayed: from the options, the recorded configuration, or the keys."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fantwin.pipeline.config.settings import Config, ConfigError
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.pipeline.replay.resolve_config import attached_config, resolve_config, trays_of
from fantwin.schemas.topics import tray_key
from fantwin.stages.resampler import ResamplerConfig
from tests.support.replay_data import START_NS, raw_of

TOML = """
site = "plant"
[bus]
endpoint = "tcp/127.0.0.1:7001"
[[tray]]
name = "tray1"
fans = 8
"""


def recording(path: Path, metadata: dict[str, str], attachments: dict[str, bytes] | None = None) -> Path:
    with RecordingWriter(path, metadata, attachments, t_ns=START_NS) as writer:
        writer.add_message(tray_key("lab", "tray1", "raw"), raw_of(0, 2), START_NS)
    return path


def place(path: Path, config: Path | None = None, *overrides: str) -> Config:
    return resolve_config(path, RecordingPlayback([path], ("raw",)).first, config, overrides)


def test_a_configuration_that_is_given_goes_before_the_one_in_the_recording(tmp_path):
    path = recording(tmp_path / "r.mcap", {"trays": "tray1"}, {"configuration.toml": TOML.encode()})
    (tmp_path / "other.toml").write_text(TOML.replace("plant", "desk"))
    assert place(path).site == "plant"
    assert place(path, tmp_path / "other.toml").site == "desk"


def test_recorded_overrides_apply_again_and_new_ones_take_precedence(tmp_path):
    recorded = ["bus.endpoint=tcp/127.0.0.1:7002", "site=hall"]
    metadata = {"trays": "tray1", "overrides": json.dumps(recorded)}
    path = recording(tmp_path / "r.mcap", metadata, {"configuration.toml": TOML.encode()})
    found = place(path, None, "bus.endpoint=tcp/127.0.0.1:7003")
    assert (found.site, found.bus.endpoint) == ("hall", "tcp/127.0.0.1:7003")


def test_without_one_site_and_trays_are_those_of_the_recording(tmp_path):
    path = recording(tmp_path / "r.mcap", {"trays": "tray1,tray2"})
    found = place(path, None, "bus.endpoint=tcp/127.0.0.1:7003")
    assert (found.site, [tray.name for tray in found.trays]) == ("lab", ["tray1", "tray2"])
    assert found.bus.endpoint == "tcp/127.0.0.1:7003"
    assert [tray.name for tray in place(recording(tmp_path / "bare.mcap", {})).trays] == ["tray1"]


def test_an_attached_configuration_that_cannot_be_used_is_one_line_that_names_the_file(tmp_path):
    path = recording(tmp_path / "r.mcap", {}, {"configuration.toml": b"site = 3\n"})
    with pytest.raises(ConfigError, match=r"r\.mcap:configuration\.toml"):
        place(path)


def test_trays_are_those_that_any_part_names(tmp_path):
    parts = [recording(tmp_path / "a.mcap", {"trays": "a,b"}), recording(tmp_path / "b.mcap", {"trays": "c"})]
    assert trays_of([*parts, recording(tmp_path / "c.mcap", {})]) == {"a", "b", "c"}


def test_recorded_overrides_apply_where_a_recording_is_scored_again(tmp_path):
    toml = f"{TOML}[resampler]\nrate_hz = 20\n"
    metadata = {"trays": "tray1", "overrides": json.dumps(["resampler.watermark_s=0.7", "resampler.rate_hz=10"])}
    path = recording(tmp_path / "r.mcap", metadata, {"configuration.toml": toml.encode()})
    found = attached_config(path, read_metadata(path), ("resampler",), ["resampler.gap_limit_s=0.2"])
    assert found
    section = found.sections["resampler"]
    assert isinstance(section, ResamplerConfig)
    assert (section.rate_hz, section.watermark_s, section.gap_limit_s) == (10.0, 0.7, 0.2)
