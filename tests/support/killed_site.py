"""A site without processes or a bus: sources and stage cores stepped as the runner does, killed and restarted at will.

Its recordings show the input of each session like those of a real site, but take no time and are the same at every run.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.runtime.publishing import ConsumedReports
from fantwin.pipeline.runtime.stage import Context, Core, load_stage
from fantwin.schemas.blocks import join
from fantwin.schemas.enums import Action
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.messages import Array, Consumed, Message, NewTwin, Raw, Request
from fantwin.schemas.topics import BY_NAME, tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.twin.models.hybrid import Hybrid
from tests.support.made_messages import TOPIC_OF
from tests.support.twin_files import small_hybrid, write_twin

SITE, TRAY, FANS = "plant", "tray1", 3
CHAIN = ("resampler", "twin_integrator", "scorer")
CALIBRATION = {
    "false_alarms_per_day": 24.0,
    "fan_hours": 10.0,
    "runs": 1,
    "found": 0,
    "interval_95": (0.0, 9.0),
}
EPOCH_NS = 1_800_000_000_000_000_000
TICK_NS = 50_000_000
AHEAD = 50
"""samples whose healthy speeds are computed at once"""
declaration_of = cache(load_stage)

CONFIGURATION = f"""
site = "{SITE}"
[[tray]]
name = "{TRAY}"
fans = {FANS}
command_max = 100.0
twin = "twin.onnx"
[twin_integrator]
warm_up_s = 0.5
[scorer]
"""


def balanced_hybrid() -> Hybrid:
    """A model whose network moves it so little that the torque balance of its card agrees with it."""
    network = small_hybrid().network
    return Hybrid(network.with_theta(0.02 * network.theta))


@dataclass
class Session:
    """One life of a stage: its core, and what it keeps for those who missed it."""

    producer: str
    core: Core | None
    published: dict[str, int] = field(default_factory=dict)
    kept: deque[tuple[str, Message]] = field(default_factory=lambda: deque(maxlen=200))
    position: InputPosition | None = None
    consumed: ConsumedReports = field(default_factory=ConsumedReports)


class Stages:
    """Three stages of one tray, and a recording of all messages between them."""

    def __init__(
        self, config: Config, path: Path, started_t_ns: int, *, remembers: bool = True, is_replayed: bool = False
    ) -> None:
        """is_replayed: a replay presents the site instead of acquisition, with samples of an hour ago."""
        (tray,) = config.trays
        self.config = config
        self.remembers = remembers
        self.is_replayed = is_replayed
        self.tray = tray.name
        self.now_ns = started_t_ns
        metadata = {
            "site": config.site,
            "trays": tray.name,
            "started_t_ns": str(started_t_ns),
            f"speed_unit.{tray.name}": tray.speed_unit,
        }
        attachments = {"configuration.toml": config.text.encode()}
        if tray.twin:
            attachments[f"{tray.name}.onnx"] = (config.folder / tray.twin).read_bytes()
        self.writer = RecordingWriter(path, metadata, attachments, t_ns=started_t_ns, overwrite=True)
        self.records = True
        self.lost_on_the_bus = 0
        """raw messages that will be recorded and never reach the resampler"""
        self._lives = 0
        self._ticked_ns = started_t_ns
        self.source = Session("replay-0" if is_replayed else "acquisition-0", None)
        self.operator = Session("operator-0", None)
        self.learner = Session("learner-0", None)
        self.stages = {stage: self._begin(stage) for stage in CHAIN}

    def take(self, raw: Raw) -> None:
        """Publish this message as acquisition would."""
        self._publish(self.source, raw, None)

    def ask(self, action: Action, fan: int = -1, duration_s: float = 0.0) -> None:
        """Publish a request of an operator."""
        name = f"{action.name.lower()} by Ann"
        self._publish(
            self.operator,
            Request(t_ns=self.now_ns, action=action, fan=fan, duration_s=duration_s, operator_name=name),
            None,
        )

    def put_in_force(self, name: str, content: bytes) -> None:
        """Publish a learned twin as the learner would."""
        sha256 = hashlib.sha256(content).hexdigest()
        self._publish(self.learner, NewTwin(t_ns=self.now_ns, twin=name, sha256=sha256, content=content), None)

    def tick(self) -> None:
        """Let time pass for the stages, up to `now_ns`."""
        while self.now_ns - self._ticked_ns >= TICK_NS:
            self._ticked_ns += TICK_NS
            for stage in CHAIN:
                self._put_out(stage, self._core(stage).tick(self._ticked_ns), from_timer=True)

    def kill(self, stage: str) -> None:
        """kill -9: the state of the core is lost; its successor takes the messages still kept again, topic by topic."""
        store = getattr(self._core(stage), "_snapshot_store", None) or getattr(self._core(stage), "_store", None)
        if store:
            store.unlock()  # as the system does for a killed process
        self.stages[stage] = self._begin(stage)
        feeding = self.source if stage == "resampler" else self.stages[CHAIN[CHAIN.index(stage) - 1]]
        kept = (*feeding.kept, *self.operator.kept, *self.learner.kept)
        for read in sorted(declaration_of(stage).reads, key=lambda name: (not BY_NAME[name].is_needed_first, name)):
            for topic, message in kept:
                if topic == read:
                    self._step(stage, topic, message)

    def set_clock_back(self, by_s: float) -> None:
        """Set the host clock back."""
        self.now_ns -= round(by_s * NS_PER_S)
        self._ticked_ns -= round(by_s * NS_PER_S)

    def loses(self, messages: int) -> None:
        """The next raw messages never reach the resampler."""
        self.lost_on_the_bus = messages

    def restart_source(self) -> None:
        """Acquisition is killed, and its successor begins with nothing."""
        self._lives += 1
        self.source = Session(f"acquisition-{self._lives}", None)

    def end(self) -> None:
        """Stop cleanly."""
        for stage in CHAIN:
            self._put_out(stage, self._core(stage).close(), from_timer=True)
            self._report(self.stages[stage], self.stages[stage].consumed.last())
        self.writer.finish()

    def _begin(self, stage: str) -> Session:
        self._lives += 1
        context = Context(
            site=self.config.site,
            trays=self.config.trays,
            config=self.config.sections[stage],
            folder=self.config.folder,
            run_folder=self.config.folder,
            started_t_ns=self.now_ns + 3600 * NS_PER_S * self.is_replayed,
            snapshot_folder=self.config.folder if self.remembers else None,
            is_replayed=lambda: self.is_replayed,
        )
        return Session(f"{stage}-{self._lives}", declaration_of(stage).build(context).core)

    def _core(self, stage: str) -> Core:
        core = self.stages[stage].core
        assert core
        return core

    def _step(self, stage: str, topic: str, message: Message) -> None:
        session = self.stages[stage]
        if topic == declaration_of(stage).reads[0]:
            session.position = InputPosition.after(session.position, topic, message.header)
        self._put_out(stage, self._core(stage).step(message), from_timer=False)

    def _put_out(self, stage: str, messages: Sequence[Message], from_timer: bool) -> None:
        session = self.stages[stage]
        position = replace(session.position, from_timer=from_timer) if session.position else None
        for message in messages:
            self._publish(session, message, position)

    def _publish(self, session: Session, message: Message, position: InputPosition | None) -> None:
        topic = TOPIC_OF[type(message)]
        sequence = session.published.get(topic, 0)
        session.published[topic] = sequence + 1
        stamped: Any = replace(message, header=Header(session.producer, sequence, self.tray, position))
        session.kept.append((topic, stamped))
        self._record(topic, stamped)
        self._report(session, session.consumed.after(topic, stamped))
        if topic == "raw" and self.lost_on_the_bus:
            self.lost_on_the_bus -= 1
            return
        reader = next((name for name in CHAIN if topic in declaration_of(name).reads), None)
        if reader:
            self._step(reader, topic, stamped)

    def _report(self, session: Session, due: Iterable[Consumed]) -> None:
        for report in due:
            sequence = session.published.get("consumed", 0)
            session.published["consumed"] = sequence + 1
            self._record("consumed", replace(report, header=replace(report.header, sequence=sequence)))

    def _record(self, topic: str, message: Message) -> None:
        if self.records and BY_NAME[topic].recorded:
            self.writer.add_message(tray_key(self.config.site, self.tray, topic), message, self.now_ns)


class Site(Stages):
    """A tray of three fans and its stages."""

    def __init__(
        self,
        folder: Path,
        seed: int,
        raw_samples: int = 1,
        *,
        calibrated: bool = False,
        remembers: bool = True,
        is_replayed: bool = False,
        learns: bool = False,
    ) -> None:
        """raw_samples: in a message of acquisition. remembers: whether a restarted scorer finds the snapshot of the one
        before it. learns: the configuration names no twin."""
        card = {"calibration": CALIBRATION} if calibrated else {}
        write_twin(folder / "twin.onnx", balanced_hybrid(), fans=FANS, **card)
        text = CONFIGURATION
        (folder / "site.toml").write_text(text.replace('twin = "twin.onnx"\n', "") if learns else text)
        self.path = folder / "recording.mcap"
        config = load_config(folder / "site.toml")
        super().__init__(config, self.path, EPOCH_NS, remembers=remembers, is_replayed=is_replayed)
        self.rng = np.random.default_rng(seed)
        self._raw_samples = raw_samples
        self._block: list[Raw] = []
        self._device_us = 0
        self._device_sequence = 0
        self._healthy = TwinFile.load(folder / "twin.onnx", FANS)
        self._state = self._healthy.initial_state(np.full(FANS, 100.0), np.full(FANS, 50.0))
        self._next: deque[tuple[Array, Array]] = deque()
        """commands and healthy speeds of the next samples"""

    def run(self, samples: int) -> None:
        """Raw samples as they come: with jitter, without some readings, now and then two in one piece."""
        waiting: list[Raw] = []
        for _ in range(samples):
            self.now_ns += int(self.rng.integers(8_000_000, 12_000_000))
            waiting.append(self._raw())
            if self.rng.random() < 0.03:
                continue  # held back; it comes together with the next one
            self._take_raw(waiting)
            waiting = []
            self.tick()

    def fall_silent(self, seconds: float) -> None:
        """No samples for a while; then half of those measured arrive, too late for part of the grid."""
        late: list[Raw] = []
        for _ in range(int(seconds * 100)):
            self.now_ns += 10_000_000
            late.append(self._raw())
            self.tick()
        self._take_raw(late[len(late) // 2 :])

    def finished(self) -> Path:
        """Stop cleanly; returns the recording."""
        if self._block:
            self.take(join(self._block))
        self.end()
        return self.path

    def _take_raw(self, samples: Iterable[Raw]) -> None:
        for raw in samples:
            self._block.append(raw)
            if len(self._block) == self._raw_samples:
                self.take(join(self._block))
                self._block = []

    def _raw(self) -> Raw:
        self._device_us += 10_000
        self._device_sequence += 1
        if not self._next:
            samples = np.arange(self._device_sequence, self._device_sequence + AHEAD)
            commands = 50.0 + 40.0 * np.sin(samples[:, np.newaxis] / 150.0 + np.arange(FANS))
            speeds, self._state = self._healthy.advance(self._state, commands, np.full(AHEAD, 0.01))
            self._next.extend(zip(commands, speeds, strict=True))
        command, healthy = self._next.popleft()
        speed = healthy + self.rng.normal(0.0, 3.0, FANS)
        speed[0] += 20.0 * (150 < self._device_sequence % 400 < 220)  # a fault that comes and goes
        speed[self.rng.random(FANS) < 0.01] = np.nan
        return Raw(
            fans=FANS,
            host_receive_t_ns=np.array([self.now_ns], np.int64),
            device_clock_us=np.array([self._device_us % 2**32], np.uint32),
            device_sequence=np.array([self._device_sequence], np.uint32),
            command=command[np.newaxis],
            speed_rad_s=speed[np.newaxis],
        )
