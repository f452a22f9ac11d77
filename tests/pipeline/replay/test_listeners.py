"""Stages on the bus of a replay: which must not run, which read it, and what they lost."""

from __future__ import annotations

import threading

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.replay.live.listeners import Listeners, Present, conflict, made_by_stages
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.health import Health, Input, Output
from fantwin.schemas.topics import BY_NAME, alive_key, health_key, tray_key
from tests.support.fantwin_command import error_of
from tests.support.made_messages import health
from tests.support.replay_data import write_raw
from tests.support.running_chain import eventually

ALL = ("raw", "grid", "prediction", "score", "alarm", "command", "twin")
GRID = tray_key("s", "a", "grid")
PREDICTION = tray_key("s", "a", "prediction")


def there(*labels: str) -> list[Present]:
    parts = (label.partition("/") for label in labels)
    return [Present(load_stage(name), tray or "all", (tray,) if tray else ()) for name, _, tray in parts]


@pytest.mark.parametrize(
    ("labels", "topics", "expected"),
    [
        ([], ALL, []),
        (["acquisition/a"], ALL, ["acquisition/a", "commands", "not for the fans of today"]),
        (["acquisition/other", "resampler"], ("raw",), []),
        (["acquisition/a", "resampler"], ("raw",), ["acquisition/a", "writes raw itself: stop it"]),
        (["resampler", "scorer", "viewer"], ALL, ["resampler", "writes grid itself", "--from-topic raw, or stop it"]),
        (
            ["twin_integrator", "scorer"],
            ("raw", "grid", "prediction"),
            ["writes prediction itself", "--from-topic grid"],
        ),
        (["scorer", "viewer"], ALL, ["scorer", "writes score itself", "--from-topic prediction"]),
        (["scorer", "viewer"], ("prediction", "twin"), []),
        (["resampler", "scorer"], ("raw", "request"), ["scorer", "recorded requests are not", "leave request out"]),
        (["viewer", "recorder"], (*ALL, "request"), []),
    ],
)
def test_topics_that_a_running_stage_writes_and_past_requests_to_it_are_not_replayed(labels, topics, expected):
    line = conflict(there(*labels), topics, {"a"}, "plant")
    assert bool(line) == bool(expected)
    assert "\n" not in line
    for words in expected:
        assert words in line


def test_recorded_versions_of_a_twin_are_left_to_a_learner_that_is_running_and_refused_if_it_comes_later():
    topics, others = ("raw", "new_twin"), ("resampler", "twin_integrator", "scorer")
    assert made_by_stages(there(*others), topics) == {}
    assert conflict(there(*others), topics, {"a"}, "plant") == ""
    assert made_by_stages(there(*others, "learner"), topics) == {"new_twin": "learner"}
    line = conflict(there(*others, "learner"), topics, {"a"}, "plant")
    assert line == (
        "learner of site 'plant' is running and writes new_twin itself: replay with --from-topic raw, or stop it"
    )
    assert "--from-topic raw" in conflict(there(*others, "learner"), ALL, {"a"}, "plant"), (
        "a learner is no obstacle to that"
    )


class FakeStage:
    """A stage on the bus that reports the health that a test gives it."""

    def __init__(self, bus: Bus, stage: str) -> None:
        self.stage = stage
        self.producer = f"{stage}-1"
        bus.declare_alive(alive_key("s", stage, "all"))
        self.publisher = bus.publisher(
            health_key("s", stage, "all"), BY_NAME["health"], type_name(Health), self.producer
        )

    def say(self, *inputs: Input, published: int = 0, lost: int = 0) -> None:
        out = load_stage(self.stage).writes[:1]
        number, outputs = self.publisher.published, [tray_key("s", "a", name) for name in out]
        said = health(
            self.stage,
            producer=self.producer,
            sequence=number,
            t_ns=number,
            inputs=inputs,
            outputs=tuple(Output(key=key, published=published) for key in outputs),
            lost=lost,
        )
        self.publisher.put(encode(said))


def test_beside_another_replay_none_starts(tmp_path, endpoint, monkeypatch):
    monkeypatch.setattr(Listeners, "wait_for_discovery", lambda _listeners, _stop, _report: None)
    monkeypatch.setattr(Listeners, "is_replaying", lambda _listeners: True)
    recording, config = write_raw(tmp_path / "r.mcap", 20), tmp_path / "c.toml"
    config.write_text(f'site = "hall"\nbus = {{ endpoint = "{endpoint}" }}\n[[tray]]\nname = "tray1"\nfans = 8\n')
    expected = f"a replay is running on site 'hall' at {endpoint}: stop that first"
    assert error_of("replay", recording, "-c", config) == expected


def seen_stages(bus: Bus, listeners: Listeners, *names: str) -> list[FakeStage]:
    """Once the listeners see them: what was said before is lost."""
    stages = [FakeStage(bus, name) for name in names]
    eventually(lambda: len(listeners.present()) == len(names), "their tokens are seen")
    return stages


def line(key: str, producer: str, received: int, first: int = 0, missing: int = 0) -> Input:
    reached = first + received + missing
    return Input(key=key, producer=producer, received=received, missing=missing, duplicated=0, next_sequence=reached)


@pytest.fixture
def sites(endpoint):
    """Stages on a bus, and the view that a replay has of them."""
    config = BusConfig(endpoint=endpoint)
    with Bus(config) as stages, Bus(config) as ours:
        yield stages, Listeners(ours, "s")


def settled(listeners: Listeners, stop: threading.Event, say) -> list[str]:
    return listeners.wait_until_drained("replay-1", {GRID: 100}, stop, say)


def test_the_replay_is_drained_when_the_whole_chain_has_consumed_everything(sites):
    bus, listeners = sites
    twin, scorer = seen_stages(bus, listeners, "twin_integrator", "scorer")
    steps = [
        lambda: twin.say(line(GRID, "replay-1", 60), published=60),
        lambda: twin.say(line(GRID, "replay-1", 100), published=100),
        lambda: scorer.say(line(PREDICTION, twin.producer, 60)),
        lambda: scorer.say(line(PREDICTION, twin.producer, 100)),
    ]
    behind_after: list[list[str]] = []
    known = listeners._behind

    def beat() -> None:
        behind_after.append(known("replay-1", {GRID: 100}, {}))
        if steps:
            steps.pop(0)()

    twin.say()
    scorer.say()
    eventually(lambda: len(listeners._views()) == 2, "both are known")
    assert settled(listeners, threading.Event(), beat) == []
    assert not steps, "drained only after the last stage reported that it has consumed everything"


def test_whoever_stops_changing_and_is_behind_is_named(sites, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.replay.live.listeners._STALLED_S", 0.2)
    bus, listeners = sites
    (twin,) = seen_stages(bus, listeners, "twin_integrator")
    twin.say(line(GRID, "replay-1", 99))
    eventually(listeners._views, "it is known")
    assert settled(listeners, threading.Event(), lambda: twin.say(line(GRID, "replay-1", 99))) == ["twin_integrator"]


def test_what_stages_that_are_there_from_the_start_have_lost_since_then_counts_also_before_their_first_message(sites):
    bus, listeners = sites
    (twin,) = seen_stages(bus, listeners, "twin_integrator")
    twin.say(lost=7)
    listeners.wait_for_discovery(threading.Event(), pytest.fail)
    assert listeners.readers(("grid",)) == listeners.readers(("grid", "score")) == ["twin_integrator"]
    assert listeners.lost("replay-1", {}) == {}, "what was lost before is not this replay's"
    twin.say(line(GRID, "replay-1", 90, first=7, missing=3), lost=10)
    recorder, late = FakeStage(bus, "recorder"), line(GRID, "replay-1", 50, first=50)
    eventually(lambda: recorder.say(late) or len(listeners._views()) == 2, "both are known")
    eventually(lambda: listeners.lost("replay-1", {GRID: 100}) == {"twin_integrator": 10}, "7 early, 3 missing")
