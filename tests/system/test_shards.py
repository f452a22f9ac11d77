"""Two shards of the scorer and a recorder as processes: a shard that is killed goes on elsewhere, as if on one host.

The test publishes the predictions itself, so that the samples are the same in every run and nothing depends on time.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.enums import Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score, ScorerSnapshot
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support.fantwin_command import as_typed
from tests.support.running_chain import DEADLINE_S, RunningCommand, eventually
from tests.support.scored_blocks import EPOCH_NS, STEP_NS, prediction_of
from tests.support.twin_files import write_twin

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

SITE, FANS, FAULTY, BLOCK = "plant", 2, 1, 100
TRAYS = ("a", "b")
FAULT_FROM = 1500
"""number of the first sample of tray b in which fan FAULTY is too fast"""
CONFIGURATION = f"""
site = "{SITE}"
[launcher]
stages = ["scorer", "recorder"]
shards = {{ scorer = 2 }}
"""


class Shards:
    """The processes, and what the test publishes and hears."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.folder = folder
        write_twin(folder / "twin.onnx", fans=FANS)
        trays = "".join(f'[[tray]]\nname = "{name}"\nfans = {FANS}\ntwin = "twin.onnx"\n' for name in TRAYS)
        (folder / "site.toml").write_text(CONFIGURATION + trays)
        self._endpoint = endpoint
        self._running: list[RunningCommand] = []
        self._lock = threading.Lock()
        self.alarms: list[Alarm] = []
        self._scored: dict[str, set[int]] = {name: set() for name in TRAYS}
        self._sent: dict[str, int] = dict.fromkeys(TRAYS, 0)
        self.is_faulty = True
        self.snapshots = 0
        """published so far"""
        self.bus = Bus(BusConfig(endpoint=endpoint))
        self.watcher = SiteWatcher(self.bus, SITE)
        self._publishers = {name: self._publisher(name, "prediction", "twin_integrator-all-1") for name in TRAYS}
        self.bus.subscribe(tray_key(SITE, "*", "alarm"), self._hear_alarm)
        self.bus.subscribe(tray_key(SITE, "*", "score"), self._hear_score)
        self.bus.subscribe(tray_key(SITE, "*", "snapshot"), self._count_snapshot)

    def close(self) -> None:
        for running in self._running:
            running.kill()
        self.bus.close()

    def words(self, run_folder: str) -> list[str]:
        settings = (f"bus.endpoint='{self._endpoint}'", f"run_folder='{self.folder / run_folder}'")
        return ["-c", str(self.folder / "site.toml"), *(word for each in settings for word in ("--set", each))]

    def run(self, *words: str) -> RunningCommand:
        """Start a command, which ends with the test."""
        running = RunningCommand(words)
        self._running.append(running)
        return running

    def start(self, label: str, run_folder: str, *options: str) -> RunningCommand:
        """Start a process of a stage and wait until it is at work."""
        running = self.run("up", "--only", label.partition("/")[0], *self.words(run_folder), *options)

        def is_at_work() -> bool:
            assert running.process.poll() is None, running.lines
            return self.is_at_work(label) and self.watcher.is_ready(running.process.pid)

        eventually(is_at_work, f"{label} is at work")
        return running

    def is_at_work(self, label: str) -> bool:
        stage, _, instance = label.partition("/")
        return (stage, instance or "all") in self.watcher.alive()

    def feed(self, blocks: int) -> None:
        """Publish so many blocks of each tray."""
        for _ in range(blocks):
            for tray, publisher in self._publishers.items():
                first = self._sent[tray]
                numbers = np.arange(first, first + BLOCK)[:, np.newaxis]
                residual = np.tile(1e-3 * (numbers % 7 - 3.0), (1, FANS))
                if tray == "b" and self.is_faulty:
                    residual[:, FAULTY] += 60.0 * (numbers[:, 0] >= FAULT_FROM)
                header = Header("twin_integrator-all-1", publisher.published, tray)
                message = prediction_of(residual.astype(np.float64), first=first)
                publisher.put(encode(replace(message, header=header)))
                self._sent[tray] += BLOCK

    def scored(self, tray: str) -> int:
        with self._lock:
            return len(self._scored[tray])

    def wait_until_scored(self, *trays: str) -> None:
        """Until the last sample of these trays has a score."""
        for tray in trays:
            last = EPOCH_NS + (self._sent[tray] - 1) * STEP_NS
            eventually(lambda tray=tray, last=last: last in self._scored[tray], f"all of {tray} is scored")

    def heard(self, *transitions: Transition) -> list[Alarm]:
        """The alarm messages heard so far, of these transitions or of all."""
        with self._lock:
            return [alarm for alarm in self.alarms if not transitions or alarm.transition in transitions]

    def _publisher(self, tray: str, topic: str, producer: str) -> Publisher:
        message = BY_NAME[topic].message
        return self.bus.publisher(tray_key(SITE, tray, topic), BY_NAME[topic], type_name(message), producer)

    def _hear_alarm(self, _key: str, payload: bytes) -> None:
        with self._lock:
            self.alarms.append(decode(Alarm, payload))

    def _count_snapshot(self, _key: str, _payload: bytes) -> None:
        self.snapshots += 1

    def _hear_score(self, key: str, payload: bytes) -> None:
        with self._lock:
            self._scored[key.split("/")[2]].update(decode(Score, payload).t_ns.tolist())


@pytest.fixture
def shards(tmp_path: Path, endpoint: str) -> Iterator[Shards]:
    with closing(Shards(tmp_path, endpoint)) as shards:
        yield shards


def kill(running: RunningCommand) -> None:
    os.kill(running.process.pid, signal.SIGKILL)
    running.process.wait()


def counter(shards: Shards, stage: str, name: str) -> int:
    healths = (view.health for view in shards.watcher.stages() if view.alive and view.health.stage == stage)
    return sum(each.value for health in healths for each in health.counters if each.name == name)


def alarm_is_raised_and_acknowledged(shards: Shards) -> Alarm:
    shards.feed(20)
    eventually(lambda: shards.heard(Transition.DIAGNOSED), "the fault has an alarm and a cause")
    asked = as_typed("alarms", "acknowledge", "b", FAULTY, "--timeout", DEADLINE_S, *shards.words("here"))
    assert asked.returncode == 0, asked.stderr
    (acknowledged,) = eventually(lambda: shards.heard(Transition.ACKNOWLEDGED), "it is acknowledged")
    assert (acknowledged.header.tray, acknowledged.fan, acknowledged.active) == ("b", FAULTY, True)
    return acknowledged


def goes_on_with_its_alarm(shards: Shards, successor: RunningCommand, before: Alarm) -> None:
    """The alarm is the same one: republished by the successor, neither raised nor cleared."""
    name = "continued from the snapshot that the recorder keeps; there is none here"
    views = (view for view in shards.watcher.stages() if view.health.process_id == successor.process.pid)
    assert name in [note.text for view in views for note in view.health.notes]
    producer = shards.watcher.owner("scorer", "b")
    assert producer
    own = [alarm for alarm in shards.heard() if alarm.header.producer == producer.producer]
    assert own[0].transition == Transition.REPUBLISHED
    assert {alarm.transition for alarm in own} <= {Transition.REPUBLISHED, Transition.DIAGNOSED}
    for attribute in ("fan", "active", "onset_t_ns", "severity", "acknowledged", "statistic"):
        assert getattr(own[0], attribute) == getattr(before, attribute)


def test_row_07_a_shard_that_is_killed_goes_on_in_another_folder_with_its_alarms_and_misses_nothing(shards):
    recorder = shards.start("recorder", "here")
    first = shards.start("scorer/1-of-2", "here", "--shard", "1/2")
    second = shards.start("scorer/2-of-2", "here", "--shard", "2/2")
    before = alarm_is_raised_and_acknowledged(shards)
    shards.wait_until_scored(*TRAYS)

    # its host and that of the recorder fail together: the next recorder finds the snapshot in its recording
    eventually(lambda: counter(shards, "recorder", "recorded_snapshot") == shards.snapshots, "all are on the disk")
    kill(second)
    kill(recorder)
    recorder = shards.start("recorder", "here")
    shards.feed(5)
    third = shards.start("scorer/2-of-2", "elsewhere", "--shard", "2/2")
    shards.wait_until_scored(*TRAYS)
    goes_on_with_its_alarm(shards, third, before)

    shards.is_faulty = False
    shards.feed(14)
    (cleared,) = eventually(lambda: shards.heard(Transition.CLEARED), "the alarm is not forgotten")
    assert (cleared.fan, cleared.onset_t_ns) == (FAULTY, before.onset_t_ns)
    (raised,) = shards.heard(Transition.RAISED)
    assert raised.onset_t_ns == before.onset_t_ns
    shards.wait_until_scored(*TRAYS)
    assert [shards.scored(tray) for tray in TRAYS] == [3900, 3900], "every sample once, whoever was away"
    for running in (first, third, recorder):
        assert running.end() == 0, running.lines
    recorded = [
        entry.message
        for path in sorted((shards.folder / "here").glob("*.mcap"))
        for entry in read_recording(path, ("alarm", "snapshot"))
    ]
    raised_here = [m for m in recorded if isinstance(m, Alarm) and m.transition == Transition.RAISED]
    assert [alarm.onset_t_ns for alarm in raised_here] == [before.onset_t_ns]
    restored = {m.header.producer for m in recorded if isinstance(m, ScorerSnapshot) and m.restored}
    assert len(restored) == 1


def test_up_starts_the_shards_restarts_one_that_dies_and_accounts_for_all(shards):
    labels = [f"{stage}/{number}-of-2" for stage in ("scorer", "recorder") for number in (1, 2)]
    up = shards.run("up", *shards.words("here"), "--set", "launcher.shards={ scorer = 2, recorder = 2 }", "--json")
    eventually(lambda: all(map(shards.is_at_work, labels)), "all are at work")
    shards.feed(3)
    shards.wait_until_scored(*TRAYS)
    started = up.line_with("scorer/2-of-2: started, process ")
    os.kill(int(started.rpartition(" ")[2]), signal.SIGKILL)
    up.line_with("scorer/2-of-2: was ended by signal 9")
    shards.feed(3)
    shards.wait_until_scored(*TRAYS)
    assert up.end() == 0, up.lines
    outcome = up.output()
    assert outcome["restarts"] == {"scorer/2-of-2": 1}
    assert outcome["lost"] == dict.fromkeys(sorted(labels), 0)
    assert [Path(name).name for name in outcome["recordings"]] == ["1-of-2.recording.mcap", "2-of-2.recording.mcap"]
    info = as_typed("info", shards.folder / "here", "--json")
    assert info.returncode == 0, info.stdout
    found = json.loads(info.stdout)
    assert {key.split("/")[2] for key in found["topics"]} == {*TRAYS, "health"}
    for each in found["files"]:
        number = int(Path(each["file"]).name[0])
        data = {key.split("/")[2] for key in each["topics"]} - {"health"}
        assert data == {TRAYS[number - 1]}
        assert f"scorer/{number}-of-2" in each["stages"]
        assert f"scorer/{3 - number}-of-2" not in each["stages"], "it has none of these trays"
