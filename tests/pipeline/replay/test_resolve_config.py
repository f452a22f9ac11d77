"""The site on which a recording is replayed, and the chain of stages, derived from what they read and write."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import Config, ConfigError
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.pipeline.replay.resolve_config import attached_config, resolve_config, trays_of
from fantwin.pipeline.replay.stage_chain import derive_chain, derive_starts, replay_starts
from fantwin.pipeline.runtime.stage import Stage, load_stage
from fantwin.schemas.topics import BY_NAME, tray_key
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


REGISTERED = [load_stage(name) for name in STAGES]


def with_row(of: str, **changed: Any) -> Stage:
    stage = load_stage(of)
    return replace(stage, row=replace(stage.row, **changed))


@pytest.fixture
def smoother(monkeypatch):
    """A toy stage with two toy topics."""
    for name in ("smooth_grid", "smoothing"):
        monkeypatch.setitem(BY_NAME, name, replace(BY_NAME["grid"], name=name))
    topics = {"reads": ("grid",), "writes": ("smooth_grid", "smoothing")}
    return with_row("resampler", name="smoother", **topics)


def test_a_new_stage_is_placed_by_what_it_reads_and_writes(smoother):
    integrator = with_row("twin_integrator", reads=("smooth_grid",))
    stages = [smoother, integrator, *(stage for stage in REGISTERED if stage.name != "twin_integrator")]
    chain = derive_chain(stages)
    assert [stage.name for stage in chain.stages] == ["resampler", "smoother", "twin_integrator", "scorer"]
    assert chain.outputs == ("grid", "smooth_grid", "prediction", "score")
    assert derive_starts(stages)["smooth_grid"] == ("smooth_grid", "smoothing")


def test_a_replay_starts_with_all_topics_of_the_stage_that_it_replaces_and_the_twins_of_those_that_follow():
    expected = {"raw": ("raw", "new_twin"), "grid": ("grid", "new_twin"), "prediction": ("prediction", "twin")}
    assert replay_starts() == expected


def test_stages_that_do_not_lead_from_raw_samples_to_scores_are_refused():
    without_integrator = [stage for stage in REGISTERED if stage.name != "twin_integrator"]
    circle = with_row("resampler", reads=("prediction",))
    for stages in (without_integrator, [*REGISTERED, circle]):
        with pytest.raises(ValueError, match="look at what writes 'prediction'"):
            derive_chain(stages)
