"""The graph of stages is derived from what they read and write; nothing lists it a second time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.replay.stage_chain import derive_chain, derive_starts, replay_starts
from fantwin.pipeline.runtime.stage import Stage, load_stage
from fantwin.schemas.topics import BY_NAME

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
