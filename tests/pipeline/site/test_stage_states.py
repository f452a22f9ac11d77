"""The states of the stages of a site: none is shown as well that does not do its work."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fantwin.pipeline.config.shards import Shard, StageProcess
from fantwin.pipeline.site.site_watcher import StageView
from fantwin.pipeline.site.stage_states import StageState, Word, stage_states
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import AwaitedInput
from fantwin.schemas.units import NS_PER_S
from tests.support.stage_views import CONSUMER, GRID, NOW_NS, PRODUCER, view

WAITS = replace(CONSUMER, waiting_for=(AwaitedInput(key=GRID, since_t_ns=NOW_NS - 12 * NS_PER_S),))
WHOLE = Shard("all", ("tray1", "tray2"))
ROWS = [StageProcess("resampler", WHOLE), StageProcess("twin_integrator", WHOLE)]


def states(*views: StageView, alive: set[tuple[str, str]] | None = None) -> dict[str, StageState]:
    seen = {(each.health.stage, each.health.instance) for each in views if each.alive} if alive is None else alive
    return {state.label: state for state in stage_states(views, seen, ROWS)}


def behind(seconds: float, *, processed: int) -> StageView:
    """The consumer with a full inbox, and what it has processed since the health before."""
    health = replace(CONSUMER, newest_input_t_ns=NOW_NS - round(seconds * NS_PER_S))
    other = replace(health.inputs[0], key="fantwin/s/health/resampler/all", received=90)
    now = replace(health, inputs=(*health.inputs, other))
    before = replace(health.inputs[0], received=health.inputs[0].received - processed)
    return StageView(now, replace(health, inputs=(before,), t_ns=NOW_NS - NS_PER_S), alive=True, age_s=0.5)


SENDS, IDLE = view(PRODUCER, published_before=850), view(PRODUCER, published_before=800)
assert SENDS.previous
HAS_JUST_BEGUN = replace(SENDS, previous=replace(SENDS.previous, t_ns=WAITS.t_ns + 1))
OLD = replace(CONSUMER, latency_p50_ms=47_000.0)
STARTING = replace(CONSUMER, status=StageStatus.STARTING)
BOTH = {("resampler", "all"), ("twin_integrator", "all")}


@pytest.mark.parametrize(
    ("views", "word", "detail"),
    [
        pytest.param((IDLE, view(CONSUMER)), Word.OK, "", id="at work"),
        pytest.param((SENDS,), Word.MISSING, "", id="never heard"),
        pytest.param((view(CONSUMER, age_s=6.0),), Word.SILENT, "no health for 6 s: it hangs", id="no health any more"),
        pytest.param((SENDS, view(WAITS)), Word.STARVED, "no grid of tray1 for 12 s, although", id="no input"),
        pytest.param((HAS_JUST_BEGUN, view(WAITS)), Word.WAITING, "", id="its producer has just begun"),
        pytest.param((IDLE, view(WAITS)), Word.WAITING, "waits for grid of tray1, for 12 s", id="its producer is idle"),
        pytest.param((view(OLD),), Word.LATE, "its outputs are 47 s old", id="late"),
        pytest.param(
            (view(replace(OLD, status=StageStatus.STARTING)),), Word.STARTING, "", id="works off what it missed"
        ),
        pytest.param((SENDS, behind(19.0, processed=25)), Word.LATE, "it is 19 s behind", id="behind, not starved"),
        pytest.param((SENDS, behind(4.0, processed=25)), Word.OK, "", id="a little behind"),
        pytest.param((IDLE, behind(19.0, processed=0)), Word.OK, "", id="the health of others is no input"),
        pytest.param((view(CONSUMER, alive=False, age_s=3.0),), Word.GONE, "last heard 3 s ago", id="left the bus"),
        pytest.param((view(STARTING, alive=False, age_s=20.0),), Word.STARTING, "", id="starts for long"),
        pytest.param((view(STARTING, alive=False, age_s=100.0),), Word.SILENT, "", id="starts for too long"),
    ],
)
def test_row_01_the_state_of_a_stage_is_what_it_does(views, word, detail):
    state = states(*views)["twin_integrator"]
    assert (state.word, state.is_fault) == (word, word not in (Word.OK, Word.WAITING, Word.STARTING))
    assert detail in state.detail


def test_row_01_a_stage_that_is_on_the_bus_and_was_never_heard_is_silent():
    state = states(SENDS, alive=BOTH)["twin_integrator"]
    assert (state.word, state.is_fault, state.view) == (Word.SILENT, True, None)


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
