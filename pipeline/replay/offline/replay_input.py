"""The input of an offline replay: a recording's raw samples, with its own configuration and twins or with others."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.recordings.clips.clip import CLIP_SNAPSHOT_KEY
from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.pipeline.recordings.metadata import CONFIGURATION
from fantwin.pipeline.recordings.parts import in_order
from fantwin.pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata, read_recording
from fantwin.pipeline.recordings.records import whole_number
from fantwin.pipeline.recordings.run_recordings import deciding_overrides, run_metadata
from fantwin.pipeline.replay.offline.offline_pipeline import OfflinePipeline
from fantwin.pipeline.replay.offline.plan import TrayPlan, undisturbed_plan
from fantwin.pipeline.replay.offline.plan_reader import NOT_VERIFIED, PlanReader, plan_from_snapshot
from fantwin.pipeline.replay.offline.raw_blocks import RawBlocks
from fantwin.pipeline.replay.resolve_config import attached_config, default_config, first_raw
from fantwin.pipeline.replay.stage_chain import StageChain, decision_chain
from fantwin.pipeline.runtime.publishing import CONSUMED
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.timebase.stage_clock import is_of_replay
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm, Message, ModelCard
from fantwin.schemas.topics import tray_of

NAME_ONE = "name one with `fantwin replay --offline --twin TWIN.onnx -o WHOLE.mcap`"


class ReadPlan(NamedTuple):
    """Plan of how to decide a tray again, as its recording tells it."""

    plan: TrayPlan
    """one session of each stage, if the recording does not tell, or if another grid or only a part is replayed"""
    alarms: list[Alarm]
    """those recorded, each once"""
    why_not_verified: str = ""
    """why what this plan makes cannot be compared with the recording; empty if it can"""


@dataclass
class ReplayInput:
    """A recording of one or several parts, ready to be replayed."""

    paths: tuple[Path, ...]
    metadata: RecordingMetadata
    config: Config
    twins: dict[str, Path | None]
    """by tray; None: those that were learned while it was recorded"""
    is_as_recorded: bool
    """configuration and twins are those of the recording"""
    is_same_grid: bool
    """at least the resampler's settings are"""
    started_t_ns: int
    """when the recording began"""
    first_sample_t_ns: int
    """of all trays: when it was received"""
    stages: StageChain
    was_replayed: bool = False
    """a replay presented the site while it was recorded"""
    start_s: float = 0.0
    end_s: float = math.inf
    """the part that is replayed, in seconds since the tray's first raw sample"""
    damage: dict[Path, str] = field(default_factory=dict)
    """what could not be read of a file, one line"""
    trays_of: dict[Path, tuple[str, ...]] = field(default_factory=dict)
    """what the files say that they have; none: they do not say it"""

    @property
    def is_part(self) -> bool:
        """Whether only a part of the recording is replayed."""
        return self.start_s > 0 or self.end_s < math.inf

    @property
    def trays(self) -> tuple[TrayConfig, ...]:
        """The trays that are replayed."""
        return self.config.trays

    def envelopes(self, tray: str, topics: Iterable[str]) -> Iterator[Envelope]:
        """The undecoded messages of a tray, in the order they were recorded."""
        for path in self.paths:
            if tray not in (self.trays_of.get(path) or (tray,)):
                continue
            reading = read_recording(path, tuple(topics), tray)
            yield from reading.undecoded()
            if reading.damage:
                self.damage[path] = reading.damage

    def read_plan(self, tray: str) -> ReadPlan:
        """What each session of a tray's stages consumed, and the recorded alarms."""
        left_out = self.metadata.left_out
        recorded = [topic for topic in self.stages.outputs if topic not in left_out]
        reader = PlanReader(self.stages, left_out)
        for envelope in self.envelopes(tray, (*recorded, *self.stages.side_topics, CONSUMED)):
            reader.add(envelope)
        if reader.undecodable:
            line = f"{self.paths[0]}: messages left out that cannot be decoded: {reader.undecodable}"
            self.damage[self.paths[0]] = line
        alarms, snapshot = list(reader.alarms.values()), reader.first_snapshot
        twins = reader.twins if self.twins[tray] is None else []
        if CLIP_SNAPSHOT_KEY in self.metadata.metadata and snapshot:
            plan = plan_from_snapshot(self.stages, snapshot, twins, reader.answered_requests)
            return ReadPlan(plan, alarms, NOT_VERIFIED)
        plan = reader.plan() if self.is_same_grid and not self.is_part else None
        if plan is None:
            return ReadPlan(undisturbed_plan(self.stages, twins), alarms, reader.no_plan_reason)
        plan.uses_recorded_snapshots = self.is_as_recorded
        if self.twins[tray] is not None:
            plan.without_learned_twins()
        return ReadPlan(plan, alarms)

    def pipeline(
        self, tray: str, plan: TrayPlan | None = None, observe: Callable[[Message], None] = lambda _message: None
    ) -> OfflinePipeline:
        """The stages of a tray, ready to run. Without a plan, one session of each processes all, with its twin."""
        raw = RawBlocks(lambda: self.envelopes(tray, ("raw",)), observe, (self.start_s, self.end_s))
        contexts = self.contexts(self.config.tray(tray))
        return OfflinePipeline(self.stages, contexts, raw, plan or undisturbed_plan(self.stages), observe)

    def contexts(self, tray: TrayConfig) -> list[Context]:
        """What each stage of a tray is built from, in the order of the chain."""
        twin = self.twins[tray.name]
        with_twin = tray.model_copy(update={"twin": twin.resolve() if twin else None})
        return [
            Context(
                site=self.config.site,
                trays=(with_twin,),
                config=self.config.sections[stage.name],
                folder=self.config.folder,
                run_folder=self.config.run_folder,
                started_t_ns=self.started_t_ns,
                is_replayed=lambda: self.was_replayed,
                configuration_text=self.config.text,
                overrides=self.config.overrides,
            )
            for stage in self.stages.stages
        ]


@contextmanager
def open_replay_input(
    paths: Sequence[Path],
    config: Path | None,
    overrides: Sequence[str],
    twin: Path | None,
    start_s: float = 0.0,
    end_s: float = math.inf,
    tray: str | None = None,
) -> Iterator[ReplayInput]:
    """Open the parts of a recording, to be replayed with its own configuration and twins, or with others.

    config: another configuration. overrides: keys set on top, as `key=value`. twin: for all trays that are replayed.
    tray: only this one is replayed.

    Raises:
        RecordingError: a part cannot be read, there are no raw samples, or there is no twin and none is given.
        ConfigError: the configuration cannot be used, or does not have a tray of the recording.
        StageError: a twin cannot be used.
    """
    if twin is not None and not twin.is_file():
        raise RecordingError(f"{twin}: there is no such twin; correct --twin")
    ordered = tuple(in_order(paths))
    each = {path: read_metadata(path) for path in ordered}
    for path in ordered[1:]:
        _refuse_another_run(ordered[0], each[ordered[0]], path, each[path])
    metadata = run_metadata(ordered)
    first = first_raw(ordered, metadata)
    if tray is not None and tray not in first:
        raise RecordingError(f"{ordered[0]}: no raw samples of tray {tray!r}; it has {', '.join(first)}")
    first_sample_t_ns = min(int(messages[0].host_receive_t_ns[0]) for messages in first.values())
    stages = decision_chain()
    with tempfile.TemporaryDirectory() as folder:
        recorded = _recorded_twins(metadata, Path(folder), first)
        attached = attached_config(ordered[0], metadata, stages.names)
        if config is not None:
            base = load_config(config, overrides, stages.names)
        elif attached is not None:
            base = attached_config(ordered[0], metadata, stages.names, overrides) or attached
        elif metadata.is_damaged:
            raise RecordingError(f"{ordered[0]}: its configuration is missing, and may be damaged: name one with -c")
        else:
            any_twin = twin or next(iter(recorded.values()), None)
            if any_twin is None:
                raise RecordingError(f"{ordered[0]}: no twin in this recording: {NAME_ONE}")
            base = default_config(ordered[0], metadata, first, any_twin, overrides, stages.names)
        trays = tuple(base.tray(name) for name in first if tray in (None, name))
        is_as_recorded = attached is not None and config is None and not overrides and twin is None
        yield ReplayInput(
            paths=ordered,
            metadata=metadata,
            config=replace(base, trays=trays),
            twins={each.name: _twin_of(each, base, attached, recorded, twin, ordered) for each in trays},
            started_t_ns=whole_number(metadata.metadata.get("started_t_ns", "")) or first_sample_t_ns,
            first_sample_t_ns=first_sample_t_ns,
            is_as_recorded=is_as_recorded,
            is_same_grid=attached is not None and base.sections["resampler"] == attached.sections["resampler"],
            stages=stages,
            was_replayed=any(is_of_replay(raws[0].header.producer) for raws in first.values()),
            start_s=start_s,
            end_s=end_s,
            trays_of={path: found.trays for path, found in each.items()},
        )


def _refuse_another_run(first: Path, metadata: RecordingMetadata, path: Path, other: RecordingMetadata) -> None:
    """The parts of one recording, and the recordings of the shards of one run, have one site, one configuration and one
    twin for each tray."""
    differ = ["site"] if metadata.metadata.get("site") != other.metadata.get("site") else []
    if deciding_overrides(metadata) != deciding_overrides(other):
        differ.append("keys set on the command line")
    names = {*metadata.attachments, *other.attachments}
    if metadata.trays and other.trays:
        names = {CONFIGURATION, *(f"{tray}.onnx" for tray in {*metadata.trays} & {*other.trays})}
    if any(metadata.attachments.get(name) != other.attachments.get(name) for name in names):
        differ.append("configuration or twin")
    if differ:
        raise RecordingError(
            f"{first} and {path} belong to two runs: they differ in {differ[0]}; replay them one by one"
        )


def _recorded_twins(metadata: RecordingMetadata, folder: Path, trays: Iterable[str]) -> dict[str, Path]:
    """The attached twins of the trays, written to files that can be loaded."""
    twins = {}
    for number, tray in enumerate(trays):
        content = metadata.attachments.get(f"{tray}.onnx")
        if content is not None:
            twins[tray] = folder / f"{number}.onnx"
            twins[tray].write_bytes(content)
    return twins


def _twin_of(
    tray: TrayConfig,
    base: Config,
    attached: Config | None,
    recorded: dict[str, Path],
    twin: Path | None,
    paths: Sequence[Path],
) -> Path | None:
    """The twin that was given, else that of another configuration or of a key, else the recorded one. None: the
    recording has learned twins."""
    if twin is not None:
        return twin
    as_recorded = attached is not None and base.path == attached.path and tray.twin == attached.tray(tray.name).twin
    if not as_recorded and tray.twin is not None:
        return tray.twin if tray.twin.is_absolute() else base.folder / tray.twin
    if tray.name in recorded:
        return recorded[tray.name]
    cards = (each.message for path in paths for each in rare_messages(path, "twin") if tray_of(each.key) == tray.name)
    if any(isinstance(card, ModelCard) and card.content for card in cards):  # learned while it was recorded
        return None
    raise RecordingError(f"{paths[0]}: no twin of {tray.name} in this recording: {NAME_ONE}")
