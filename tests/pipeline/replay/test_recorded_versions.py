"""Learned twins in a live replay: which are published when, and that stages change to them at the recorded samples."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.live.player import Pace, Player
from fantwin.pipeline.replay.live.publishing import publish
from fantwin.pipeline.replay.live.recording_playback import ComingVersions, RecordingPlayback, read_versions
from fantwin.pipeline.runtime.stage import Context, load_stage
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, ModelCard, NewTwin, Prediction, Raw
from fantwin.schemas.topics import alive_key, tray_key
from tests.support.killed_site import FANS, SITE, TRAY, Site
from tests.support.offline_replay import recorded
from tests.support.played_messages import FakeTime, Sent
from tests.support.replay_data import START_NS, STEP_NS, raw_of
from tests.support.twin_files import small_hybrid, write_twin

TOPICS = {"raw": ("raw", "new_twin"), "grid": ("grid", "new_twin")}


@dataclass(frozen=True)
class Learned:
    """A recording in which two twins took over."""

    path: Path
    cards: list[ModelCard]

    @property
    def firsts(self) -> list[tuple[str, int]]:
        return [(card.twin, card.t_ns) for card in self.cards]

    def seconds_until(self, t_ns: int) -> float:
        """Seconds of the recording, from its first message on."""
        return (t_ns - RecordingPlayback([self.path], ("raw",)).first.received_t_ns) / 1e9

    def stage(self, name: str) -> Any:
        """The core of a stage whose configuration names no twin."""
        config = load_config(self.path.parent / "site.toml")
        return (
            load_stage(name)
            .build(
                Context(
                    site=SITE,
                    trays=config.trays,
                    config=config.sections[name],
                    folder=config.folder,
                    run_folder=config.folder,
                    started_t_ns=0,
                    snapshot_folder=None,
                )
            )
            .core
        )


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Learned:
    """No twin for 3 s, then two of them, in blocks of four samples."""
    folder = tmp_path_factory.mktemp("learned")
    site = Site(folder, 7, raw_samples=4, learns=True)
    site.run(300)
    for number in (1, 2):
        twin = write_twin(folder / f"{number}.onnx", small_hybrid(number), fans=FANS, name=f"tray1-{number}")
        site.put_in_force(f"tray1-{number}", twin.read_bytes())
        site.run(200)
    path = site.finished()
    return Learned(path, recorded(path, "twin"))


class Stages(Sent):
    """What a player sends, given to an integrator, by way of a resampler if it is raw."""

    def __init__(self, learned: Learned) -> None:
        super().__init__(FakeTime())
        self.entries: list[Envelope] = []
        self.predictions: list[Prediction] = []
        self._resampler, self._integrator = learned.stage("resampler"), learned.stage("twin_integrator")

    def send(self, entry: Envelope) -> None:
        super().send(entry)
        self.entries.append(entry)
        message = entry.message
        self._integrate(self._resampler.step(message) if isinstance(message, Raw) else [message])

    def close(self) -> None:
        """Hand over the rest, as stages do that stop."""
        self._integrate(self._resampler.close())

    def _integrate(self, messages: Iterable[Any]) -> None:
        made = (each for message in messages for each in self._integrator.step(message))
        self.predictions += [each for each in made if isinstance(each, Prediction)]

    @property
    def new_twins(self) -> list[NewTwin]:
        return [entry.message for entry in self.entries if isinstance(entry.message, NewTwin)]


def player_of(stages: Stages) -> Player:
    return Player(cast(Any, stages), Pace(1.0), stages.time.wait, now_s=stages.time.now_s)


def played(learned: Learned, start: str, start_s: float = 0.0, end_s: float = math.inf, rounds: int = 1) -> Stages:
    stages = Stages(learned)
    playback = RecordingPlayback([learned.path], TOPICS[start], start_s, end_s)
    player_of(stages).play(takewhile(lambda each: each[0] < rounds, playback.rounds()))
    stages.close()
    return stages


def changes(predictions: Iterable[Prediction]) -> list[tuple[str, int]]:
    """Each twin and its first sample."""
    found: list[tuple[str, int]] = []
    for prediction in predictions:
        if prediction.twin != (found[-1][0] if found else ""):
            found.append((prediction.twin, int(prediction.t_ns[0])))
    return found


@pytest.mark.parametrize("start", TOPICS)
def test_stages_get_their_twins_and_predict_in_a_replay_as_when_it_was_recorded(learned, start):
    stages = played(learned, start)
    before: list[Prediction] = recorded(learned.path, "prediction")
    assert changes(before) == learned.firsts == changes(stages.predictions)
    columns = ("t_ns", "predicted_speed_rad_s", "torque_balance_command", "invalid_reason")
    for name in columns:
        then, now = (np.concatenate([getattr(each, name) for each in found]) for found in (before, stages.predictions))
        np.testing.assert_array_equal(then, now, name)
    assert [(twin.twin, twin.first_sample_t_ns) for twin in stages.new_twins] == learned.firsts
    assert [twin.content for twin in stages.new_twins] == [card.content for card in learned.cards]
    first, second = (place for place, entry in enumerate(stages.entries) if entry.topic == "new_twin")
    assert first == 0, "each is published as soon as the one before takes over"
    message: Any = stages.entries[second + 1].message
    newest_t_ns = int((message.t_ns if isinstance(message, Grid) else message.host_receive_t_ns)[-1])
    assert newest_t_ns - 4 * STEP_NS < learned.firsts[0][1] <= newest_t_ns, "the block with the first one's sample"


@pytest.mark.parametrize(("start", "number"), [("grid", 0), ("raw", 1)])
def test_a_stretch_begins_with_the_twin_then_in_force(learned, start, number):
    at_s = learned.seconds_until(learned.firsts[number][1]) + 0.5
    stages = played(learned, start, at_s)
    assert [twin.twin for twin in stages.new_twins] == [f"tray1-{each + 1}" for each in range(number, 2)]
    assert stages.entries[0].topic == "new_twin"
    assert stages.predictions[0].twin == f"tray1-{number + 1}", "from the first sample on"
    assert changes(stages.predictions)[1:] == learned.firsts[number + 1 :]


def test_a_twin_that_takes_over_after_the_stretch_is_not_published(learned):
    stages = played(learned, "raw", 0.0, learned.seconds_until(learned.firsts[1][1]) - 0.5)
    assert [twin.twin for twin in stages.new_twins] == ["tray1-1"]


def test_each_round_of_a_loop_changes_the_twins_at_the_same_samples(learned):
    at_s = learned.seconds_until(learned.firsts[0][1]) + 0.5
    stages = played(learned, "raw", at_s, rounds=3)
    assert [twin.twin for twin in stages.new_twins] == ["tray1-1", "tray1-2"] * 3
    found = changes(stages.predictions)
    assert [twin for twin, _ in found] == ["tray1-1", "tray1-2"] * 3
    seconds = [t_ns for twin, t_ns in found if twin == "tray1-2"]
    assert seconds[0] == learned.firsts[1][1]
    assert seconds[1] - seconds[0] == seconds[2] - seconds[1] > 2 * 10**9
    begins = [twin.t_ns for twin in stages.new_twins if twin.twin == "tray1-1"]
    named = [twin.first_sample_t_ns for twin in stages.new_twins if twin.twin == "tray1-1"]
    assert named[1:] == begins[1:], "not a sample of the round before, which stages may still have to predict"
    late_ns = [t_ns - begin for (_, t_ns), begin in zip(found[2::2], begins[1:], strict=True)]
    assert late_ns == pytest.approx([0, 0], abs=4 * STEP_NS), "with the first message of its round"


def test_the_clock_does_not_pass_the_samples_that_follow_a_twin(learned):
    stages = Stages(learned)
    stages.cost_s = 0.2  # a beat is due before each message
    block = Envelope.of(tray_key(SITE, TRAY, "raw"), raw_of(0, FANS, samples=400), START_NS + 400 * STEP_NS)
    versions = ComingVersions({TRAY: read_versions([learned.path])[TRAY]})
    entries = [*versions.before(block), block]
    assert [entry.topic for entry in entries] == ["new_twin", "raw"]
    player_of(stages).play((0, entry) for entry in entries)
    before = [t_ns for at_s, t_ns, _ in stages.clocks if at_s <= stages.messages[1][0]]
    assert before
    assert max(before) <= 0


def test_a_learner_that_is_running_is_the_only_one_to_publish_new_twins(learned, endpoint, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.replay.live.listeners._ALL_STAGES_S", 0.0)  # this one has no health
    config = load_config(learned.path.parent / "site.toml", [f"bus.endpoint={endpoint}"], stages=())
    lines: list[str] = []
    with Bus(config.bus) as stages:
        stages.declare_alive(alive_key(SITE, "learner", "all"))
        outcome = publish(
            RecordingPlayback([learned.path], TOPICS["raw"]),
            Pace(math.inf),
            config,
            threading.Event(),
            loop=False,
            keys=tuple,
            show=lambda _progress: None,
            report=lines.append,
        )
    assert "learner of site 'plant' is running and writes new_twin itself: recorded versions are left out" in lines
    assert outcome.messages == {"raw": 700 // 4}


def card_of(producer: str, sequence: int, twin: str, t_ns: int) -> ModelCard:
    return ModelCard(
        header=Header(producer, sequence, TRAY), t_ns=t_ns, twin=twin, kind="hybrid", sha256=twin, content=twin.encode()
    )


def versions_of(path: Path, *cards: tuple[ModelCard, float]) -> list[tuple[str, float]]:
    """The versions in a recording of cards, each received at a time in seconds: their first samples, in seconds."""
    with RecordingWriter(path, {"trays": TRAY}) as writer:
        for card, received_s in cards:
            writer.add_message(tray_key(SITE, TRAY, "twin"), card, round(received_s * 1e9))
    found = read_versions([path, path])[TRAY]
    return [(version.card.twin, version.first_t_ns / 1e9) for version in found]


def test_an_integrator_that_was_restarted_with_the_same_twin_is_no_new_version(tmp_path):
    first, again = card_of("i-1", 0, "tray1-1", 10 * 10**9), card_of("i-2", 0, "tray1-1", 5 * 10**9)
    assert versions_of(tmp_path / "r.mcap", (first, 10.1), (again, 30.0)) == [("tray1-1", 10.0)]


def test_a_version_of_an_integrator_that_was_restarted_holds_from_its_start_and_not_for_samples_predicted_before(
    tmp_path,
):
    """It takes the samples again that the resampler still keeps."""
    first, second = card_of("i-1", 0, "tray1-1", 10 * 10**9), card_of("i-2", 0, "tray1-2", 5 * 10**9)
    third = card_of("i-2", 1, "tray1-3", 50 * 10**9)
    found = versions_of(tmp_path / "r.mcap", (first, 10.1), (second, 30.0), (third, 50.1))
    assert found == [("tray1-1", 10.0), ("tray1-2", 30.0), ("tray1-3", 50.0)]


def test_a_twin_of_the_configuration_is_no_version(tmp_path):
    card = replace(card_of("i-1", 0, "own", 10 * 10**9), content=b"")
    with RecordingWriter(tmp_path / "r.mcap", {"trays": TRAY}) as writer:
        writer.add_message(tray_key(SITE, TRAY, "twin"), card, START_NS)
        writer.add_message(tray_key(SITE, TRAY, "raw"), raw_of(0, FANS), START_NS)
    playback = RecordingPlayback([tmp_path / "r.mcap"], TOPICS["raw"])
    assert playback.topics == ("raw",)
    assert [entry.topic for entry in playback] == ["raw"]
