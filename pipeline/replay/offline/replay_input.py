"""What a recording is judged by again: its raw samples, the configuration and the twins, its own or others."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.config.loading import load_config
from pipeline.config.models import Config, TrayConfig
from pipeline.recordings.order import in_order
from pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata, read_recording
from pipeline.replay.default_config import default_config, first_raw
from pipeline.replay.offline.plan import CHAIN, SIDE_TOPICS, Planner, SideInputs, TrayPlan, UnplannedError
from pipeline.replay.resolve_config import attached_config
from pipeline.runtime.stage import Context
from schemas.codec import CodecError
from schemas.envelope import Envelope
from schemas.messages import Alarm, Raw


@dataclass
class ReplayInput:
    """A recording of one or several parts, ready to be judged."""

    paths: tuple[Path, ...]
    head: RecordingMetadata
    config: Config
    twins: dict[str, Path]
    """of each tray"""
    is_as_recorded: bool
    """configuration and twins are those of the recording"""
    is_same_grid: bool
    """at least the grid of time is"""
    started_t_ns: int
    """when its recording began"""
    from_s: float = 0.0
    to_s: float = math.inf
    """the part of the recording that is judged, since its first raw sample"""
    damage: dict[Path, str] = field(default_factory=dict)

    @property
    def is_part(self) -> bool:
        """Not all of the recording is judged."""
        return self.from_s > 0 or self.to_s < math.inf

    @property
    def trays(self) -> tuple[TrayConfig, ...]:
        """The trays that are judged."""
        return self.config.trays

    def packets(self, tray: str, topics: Iterable[str]) -> Iterator[Envelope]:
        """The packets of a tray, in the order they were recorded."""
        for path in self.paths:
            reading = read_recording(path, tuple(topics), tray)
            yield from reading.undecoded()
            if reading.damage:
                self.damage[path] = reading.damage

    def raw(self, tray: str) -> Iterator[Envelope]:
        """Its raw packets."""
        return self.packets(tray, ("raw",))

    def survey(self, tray: str) -> tuple[TrayPlan | None, list[Alarm]]:
        """What the sessions of a tray were fed, and the alarms that are recorded, each once.

        The plan is None where the recording does not say, or where another grid or a part only is wanted.
        """
        alarms: dict[tuple[str, int], Alarm] = {}
        undecodable = 0
        planner: Planner | None = Planner()
        side = SideInputs()
        for packet in self.packets(tray, (*CHAIN.values(), *SIDE_TOPICS)):
            try:
                if packet.topic in SIDE_TOPICS:
                    message = packet.message
                    side.note(message)
                    if isinstance(message, Alarm):
                        alarms.setdefault((message.header.producer, message.header.sequence), message)
                elif planner:
                    planner.note(packet)
            except UnplannedError:
                planner = None
            except CodecError:
                undecodable += 1
        if undecodable:
            self.damage[self.paths[0]] = f"{self.paths[0]}: messages left out that cannot be decoded: {undecodable}"
        usable = planner is not None and self.is_same_grid and not self.is_part
        plan = planner.plan() if planner and usable else None
        if plan:
            side.add_to(plan, is_as_recorded=self.is_as_recorded)
        return plan, list(alarms.values())

    def contexts(self, tray: TrayConfig) -> dict[str, Context]:
        """What the stages of a tray are built from."""
        with_twin = tray.model_copy(update={"twin": self.twins[tray.name].resolve()})
        return {
            stage: Context(
                site=self.config.site,
                trays=(with_twin,),
                config=self.config.sections[stage],
                folder=self.config.folder,
                run_folder=self.config.run_folder,
                started_t_ns=self.started_t_ns,
                configuration_text=self.config.text,
                overrides=self.config.overrides,
            )
            for stage in CHAIN
        }


@contextmanager
def open_replay_input(
    paths: Sequence[Path],
    config: Path | None,
    overrides: Sequence[str],
    twin: Path | None,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> Iterator[ReplayInput]:
    """Open the parts of a recording, to be judged by its own configuration and twins, or by others.

    config: another configuration. overrides: keys set on top, as `key=value`. twin: of all trays.

    Raises:
        RecordingError: a part cannot be read, or holds no raw samples, or no twin and none is given.
        ConfigError: the configuration cannot be used, or does not know a tray of the recording.
        StageError: a twin cannot be used.
    """
    if twin is not None and not twin.is_file():
        raise RecordingError(f"{twin}: there is no such twin; correct --twin")
    ordered = tuple(in_order(paths))
    head = read_metadata(ordered[0])
    for path in ordered[1:]:
        _refuse_another_run(ordered[0], head, path)
    first = first_raw(ordered, head)
    with tempfile.TemporaryDirectory() as folder:
        recorded = _recorded_twins(head, Path(folder), first)
        own = attached_config(ordered[0], head, CHAIN)
        if config is not None:
            base = load_config(config, overrides, CHAIN)
        elif own is not None:
            base = attached_config(ordered[0], head, CHAIN, overrides) or own
        else:
            any_twin = twin or next(iter(recorded.values()), None)
            if any_twin is None:
                raise RecordingError(f"{ordered[0]}: no twin in this recording: name one with --twin FILE.onnx")
            base = default_config(ordered[0], head, first, any_twin, overrides, CHAIN)
        trays = tuple(base.tray(name) for name in first)
        yield ReplayInput(
            paths=ordered,
            head=head,
            config=replace(base, trays=trays),
            twins={tray.name: _twin_of(tray, base, own, recorded, twin, ordered[0]) for tray in trays},
            started_t_ns=_started_t_ns(ordered[0], head, first),
            is_as_recorded=own is not None and config is None and not overrides and twin is None,
            is_same_grid=own is not None and base.sections["resampler"] == own.sections["resampler"],
            from_s=from_s,
            to_s=to_s,
        )


def _refuse_another_run(first: Path, head: RecordingMetadata, path: Path) -> None:
    """Parts of one recording have one site, one configuration and one twin."""
    other = read_metadata(path)
    for what, key in (("site", "site"), ("keys set on the command line", "overrides")):
        if head.metadata.get(key) != other.metadata.get(key):
            raise RecordingError(f"{first} and {path} are of two runs: they differ in {what}; judge them one by one")
    if dict(head.attachments) != dict(other.attachments):
        raise RecordingError(
            f"{first} and {path} are of two runs: configuration or twin are not the same; judge them one by one"
        )


def _recorded_twins(head: RecordingMetadata, folder: Path, trays: Iterable[str]) -> dict[str, Path]:
    """The twins of the trays that are judged, written where they can be loaded from."""
    twins = {}
    for number, tray in enumerate(trays):
        content = head.attachments.get(f"{tray}.onnx")
        if content is not None:
            twins[tray] = folder / f"{number}.onnx"
            twins[tray].write_bytes(content)
    return twins


def _twin_of(
    tray: TrayConfig, base: Config, own: Config | None, recorded: dict[str, Path], twin: Path | None, path: Path
) -> Path:
    """The twin that was named, else that of another configuration or a key, else the recording's own."""
    if twin is not None:
        return twin
    as_recorded = own is not None and base.path == own.path and tray.twin == own.tray(tray.name).twin
    if not as_recorded and tray.twin is not None:
        return tray.twin if tray.twin.is_absolute() else base.folder / tray.twin
    if tray.name in recorded:
        return recorded[tray.name]
    raise RecordingError(f"{path}: no twin of {tray.name} in this recording: name one with --twin FILE.onnx")


def _started_t_ns(path: Path, head: RecordingMetadata, first: Mapping[str, Sequence[Raw]]) -> int:
    started = head.metadata.get("started_t_ns")
    if started is None:
        return min(int(message.host_receive_t_ns[0]) for messages in first.values() for message in messages[:1])
    try:
        return int(started)
    except ValueError as error:
        raise RecordingError(f"{path}: its metadata are damaged: started_t_ns is no number") from error
