"""Recordings written for tests: messages whose numbers do not compress, and what is read back of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Array, Raw
from fantwin.schemas.tacho import INSTANTANEOUS, tachos_to_json
from fantwin.schemas.topics import tray_key
from fantwin.twin.runs import Run
from tests.support import made_messages

RAW_KEY = tray_key("plant", "tray1", "raw")
ALARM_KEY = tray_key("plant", "tray1", "alarm")


def noise(shape: tuple[int, ...], seed: int) -> Array:
    """Numbers that do not compress, so that sizes are as on a real disk."""
    return np.random.default_rng(seed).normal(size=shape)


def raw(sequence: int, samples: int = 10, fans: int = 2) -> Raw:
    return Raw(
        header=Header("acquisition-1", sequence, "tray1"),
        fans=fans,
        host_receive_t_ns=np.arange(samples) + sequence * samples,
        command=noise((samples, fans), sequence),
        speed_rad_s=noise((samples, fans), sequence + 1),
    )


def alarm(sequence: int) -> Alarm:
    return made_messages.alarm(1, 7, sequence=sequence, onset_t_ns=5, message="fan 1 is slower than its twin")


def write(path: Path, messages: int, **options: Any) -> Path:
    with RecordingWriter(path, {"site": "plant"}, {"configuration.toml": b"site = 'plant'"}, **options) as writer:
        for sequence in range(messages):
            writer.add_message(RAW_KEY, raw(sequence), 1000 + sequence)
        writer.add_message(ALARM_KEY, alarm(0), 5000)
    return writer.path


def write_run(path: Path, run: Run, unit: str = "rad/s", **more: str) -> Path:
    """A recording of a run, as `fantwin import` makes one of a table. unit: of speed, for people. more: metadata."""
    t_ns = np.rint(run.t_s * 1e9).astype(np.int64)
    metadata = {"site": "plant", "trays": "tray1", "source": run.name, "speed_unit": unit, **more}
    metadata |= {"tacho.tray1": tachos_to_json(run.tacho)} if run.tacho != INSTANTANEOUS else {}
    with RecordingWriter(path, metadata) as writer:
        for sequence, first in enumerate(range(0, run.samples, 100)):
            rows = slice(first, first + 100)
            auxiliary: dict[str, Any] = {name: of[rows].astype(np.float32) for name, of in run.auxiliary.items()}
            message = Raw(
                header=Header("imported", sequence, "tray1"),
                fans=run.fans,
                host_receive_t_ns=t_ns[rows],
                command=run.command[rows],
                speed_rad_s=run.speed_rad_s[rows],
                **auxiliary,
            )
            writer.add_message(RAW_KEY, message, int(t_ns[rows][-1]))
    return path


def raw_columns(path: Path) -> tuple[Array, Array, Array]:
    """Times of receipt, commands and speeds, rad/s, of all raw samples."""
    raws = [envelope.message for envelope in read_recording(path, ("raw",))]
    names = ("host_receive_t_ns", "command", "speed_rad_s")
    t_ns, command, speed_rad_s = (np.concatenate([getattr(raw, name) for raw in raws]) for name in names)
    return t_ns, command, speed_rad_s


def sequences(path: Path) -> list[int]:
    return [envelope.message.header.sequence for envelope in read_recording(path, topics=("raw",))]


STREAM = (RAW_KEY, "acquisition-1")


def small(path: Path) -> Path:
    """A recording of many small chunks, an attachment and two topics."""
    with RecordingWriter(path, {"site": "plant"}, {"tray1.onnx": os.urandom(300)}) as writer:
        for sequence in range(40):
            writer.add_message(RAW_KEY, raw(sequence, samples=2), 1000 + sequence)
            if sequence == 20:
                writer.add_message(ALARM_KEY, alarm(0), 1000 + sequence)
            if sequence % 5 == 4:
                writer.flush()
    return path


def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """The end of each chunk, and the number of messages up to it."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        raw_only = [5 * (number + 1) + (number >= 4) for number in range(len(summary.chunk_indexes))]
        ends = [chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes]
        return list(zip(ends, raw_only, strict=True))


def read_by_others(path: Path) -> list[tuple[str, int]]:
    """All messages, read by the reader of the library, which must find an index and correct checksums."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        found = [(channel.topic, message.sequence) for _, channel, message in reader.iter_messages()]
        assert summary.statistics.message_count == len(found)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        assert summary.statistics.attachment_count == len(list(reader.iter_attachments()))
        assert summary.statistics.metadata_count == len(list(reader.iter_metadata()))
    with path.open("rb") as file:  # and one after the other, without the index
        assert len([r for r in StreamReader(file, validate_crcs=True).records if type(r).__name__ == "Message"]) == len(
            found
        )
    return found


def parts_in(folder: Path, session: str = "s1") -> RecordingParts:
    return RecordingParts(folder / "r.mcap", {"site": "plant"}, {"configuration.toml": b"site = 'plant'"}, session)


def part(parts_in: RecordingParts, numbers=(), ledger: SequenceLedger | None = None) -> RecordingWriter:
    writer = parts_in.begin(5_000_000_000, ledger or SequenceLedger(parts_in.before), {})
    for sequence in numbers:
        writer.add_message(RAW_KEY, raw(sequence), sequence)
    return writer
