"""The states of the stages of a site: none is shown as well that does not do its work."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipeline.config.shards import Shard
from pipeline.launch.processes import StageProcess
from pipeline.launch.site_state import StageState, Word, stage_states
from pipeline.launch.site_watcher import StageView
from schemas.enums import StageStatus
from schemas.header import Header
from schemas.health import AwaitedInput, Health, Input, Output
from schemas.units import NS_PER_S

GRID = "fantwin/s/tray1/grid"
NOW_NS = 1_800_000_000 * NS_PER_S
PRODUCER = Health(
    header=Header("resampler-all-1", 0, ""),
    stage="resampler",
    instance="all",
    status=StageStatus.OK,
    t_ns=NOW_NS,
    uptime_s=100.0,
    outputs=(Output(key=GRID, published=900),),
)
CONSUMER = Health(
    header=Header("twin_integrator-all-1", 0, ""),
    stage="twin_integrator",
    instance="all",
    status=StageStatus.OK,
    t_ns=NOW_NS,
    uptime_s=100.0,
    inputs=(Input(key=GRID, producer="resampler-all-1", received=800, missing=0, duplicated=0, next_sequence=800),),
)
WAITS = replace(CONSUMER, waiting_for=(AwaitedInput(key=GRID, since_t_ns=NOW_NS - 12 * NS_PER_S),))
WHOLE = Shard("all", ("tray1", "tray2"))
ROWS = [StageProcess("resampler", WHOLE), StageProcess("twin_integrator", WHOLE)]


def view(health: Health, *, alive: bool = True, age_s: float = 0.5, published_before: int = 0) -> StageView:
    before = tuple(replace(output, published=published_before) for output in health.outputs)
    return StageView(health, replace(health, outputs=before, t_ns=health.t_ns - NS_PER_S), alive, age_s)


def states(*views: StageView, alive: set[tuple[str, str]] | None = None) -> dict[str, StageState]:
    seen = {(each.health.stage, each.health.instance) for each in views if each.alive} if alive is None else alive
    return {state.label: state for state in stage_states(views, seen, ROWS)}


def test_stages_at_work_are_ok():
    found = states(view(PRODUCER, published_before=800), view(CONSUMER))
    assert [(state.word, state.is_fault) for state in found.values()] == [(Word.OK, False)] * 2


def test_row_01_a_stage_that_was_never_heard_is_missing():
    state = states(view(PRODUCER))["twin_integrator"]
    assert (state.word, state.is_fault, state.view) == (Word.MISSING, True, None)


def test_row_01_a_stage_that_is_on_the_bus_and_was_never_heard_is_silent():
    state = states(view(PRODUCER), alive={("resampler", "all"), ("twin_integrator", "all")})["twin_integrator"]
    assert (state.word, state.is_fault) == (Word.SILENT, True)


def test_row_01_a_stage_that_sends_no_health_any_more_is_silent():
    state = states(view(CONSUMER, age_s=6.0))["twin_integrator"]
    assert (state.word, state.detail, state.is_fault) == (
        Word.SILENT,
        "no health for 6 s: it hangs, is blocked or gets no processor time",
        True,
    )


def test_row_01_a_stage_without_input_while_its_producer_sends_is_starved():
    state = states(view(PRODUCER, published_before=850), view(WAITS))["twin_integrator"]
    assert state.word == Word.STARVED
    assert state.detail == "received no grid of tray1 for 12 s, although resampler sends it"
    assert state.is_fault


def test_row_01_a_stage_whose_producer_has_just_begun_to_send_is_not_starved():
    resumed = view(PRODUCER, published_before=850)
    assert resumed.previous
    later = replace(resumed, previous=replace(resumed.previous, t_ns=WAITS.t_ns + 1))
    assert states(later, view(WAITS))["twin_integrator"].word == Word.WAITING


def test_row_01_a_stage_whose_producer_sends_nothing_waits():
    state = states(view(PRODUCER, published_before=800), view(WAITS))["twin_integrator"]
    assert (state.word, state.detail, state.is_fault) == (Word.WAITING, "waits for grid of tray1, for 12 s", False)


def test_row_01_a_stage_with_a_latency_of_many_seconds_is_late():
    state = states(view(replace(CONSUMER, latency_p50_ms=47_000.0)))["twin_integrator"]
    assert (state.word, state.detail) == (Word.LATE, "its outputs are 47 s old when they are sent")
    starting = replace(CONSUMER, latency_p50_ms=47_000.0, status=StageStatus.STARTING)
    assert states(view(starting))["twin_integrator"].word == Word.STARTING, "it works off what it missed"


def behind(seconds: float, *, processed: int) -> StageView:
    """The consumer with a full inbox, and what it has processed since the health before."""
    health = replace(CONSUMER, newest_input_t_ns=NOW_NS - round(seconds * NS_PER_S))
    other = replace(health.inputs[0], key="fantwin/s/health/resampler/all", received=90)
    now = replace(health, inputs=(*health.inputs, other))
    before = replace(health.inputs[0], received=health.inputs[0].received - processed)
    return StageView(now, replace(health, inputs=(before,), t_ns=NOW_NS - NS_PER_S), alive=True, age_s=0.5)


def test_row_01_a_stage_that_works_on_old_input_is_behind_and_not_starved():
    producer = view(PRODUCER, published_before=850)
    found = states(producer, behind(19.0, processed=25))["twin_integrator"]
    assert (found.word, found.detail) == (Word.LATE, "it is 19 s behind: it processes what it received 19 s ago")
    assert states(producer, behind(4.0, processed=25))["twin_integrator"].word == Word.OK
    idle = states(view(PRODUCER, published_before=800), behind(19.0, processed=0))["twin_integrator"]
    assert idle.word == Word.OK, "the health of others is no input that it is behind with"


def test_row_16_a_stage_that_left_the_bus_without_stopping_is_gone():
    found = states(view(CONSUMER, alive=False, age_s=3.0))["twin_integrator"]
    assert (found.word, found.detail) == (Word.GONE, "left the bus without stopping; last heard 3 s ago")


@pytest.mark.parametrize(("age_s", "word"), [(20.0, Word.STARTING), (100.0, Word.SILENT)])
def test_a_stage_that_starts_may_be_silent_for_longer(age_s, word):
    starting = replace(CONSUMER, status=StageStatus.STARTING)
    assert states(view(starting, alive=False, age_s=age_s))["twin_integrator"].word == word


def test_a_stage_that_stopped_in_order_is_a_fault_only_where_the_configuration_asks_for_it():
    stopped = replace(PRODUCER, status=StageStatus.STOPPED)
    other = replace(stopped, stage="recorder")
    found = states(view(stopped, alive=False, age_s=99.0), view(other, alive=False, age_s=99.0))
    assert [(state.label, state.word, state.is_fault) for state in found.values()] == [
        ("resampler", Word.STOPPED, True),
        ("twin_integrator", Word.MISSING, True),
        ("recorder", Word.STOPPED, False),
    ]


def test_a_replay_takes_the_place_of_acquisition():
    rows = [StageProcess("acquisition", Shard("tray1", ("tray1",), ("--trays", "tray1")))]
    assert [state.word for state in stage_states([], [], rows)] == [Word.MISSING]
    assert stage_states([], [("replay", "all")], rows) == []


def test_processes_that_were_started_with_other_shards_are_in_the_place_of_those_that_have_the_same_trays():
    halves = [StageProcess("resampler", Shard(f"{n}-of-2", (f"tray{n}",), ("--shard", f"{n}/2"))) for n in (1, 2)]
    seen = [("resampler", "all")]
    whole = view(PRODUCER, published_before=800)
    assert [(state.label, state.is_expected) for state in stage_states([whole], seen, halves)] == [("resampler", True)]
    one = view(replace(PRODUCER, instance="tray1", trays="tray1"), published_before=800)
    found = stage_states([one], [("resampler", "tray1")], halves)
    assert [(state.label, state.word, state.is_expected) for state in found] == [
        ("resampler/2-of-2", Word.MISSING, True),
        ("resampler/tray1", Word.OK, True),
    ]
    assert [state.trays for state in found] == [("tray2",), ("tray1",)]
    gone = replace(one, alive=False)
    assert [state.label for state in stage_states([gone], [], halves) if state.word == Word.MISSING] == [
        "resampler/1-of-2",
        "resampler/2-of-2",
    ]
