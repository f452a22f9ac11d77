"""The recorder (core, ledger and file, through to the disk every second) against the bare `mcap` writer.

Both write the same messages, those of a tray of eight fans at 100 Hz or in larger blocks, to the same folder, with the
same chunk size and compression; the bare writer is given ready bytes and times, as the recorder gets them from
the bus. Best of several runs in turns.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from bench.printing import JsonOption, progress, show
from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips
from fantwin.pipeline.recordings.clips.cutting import ClipCutter
from fantwin.pipeline.recordings.clips.tracker import ClipTracker
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.pipeline.recordings.writing import CHUNK_BYTES
from fantwin.schemas.codec import encode, proto_type
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Message, Prediction, Raw, Score, newest_t_ns
from fantwin.schemas.topics import topic_of, tray_key

FANS = 8
STEP_NS = 10_000_000
EPOCH_NS = time.time_ns() - 1_000_000_000_000  # what is received now, not in a future that looks like a clock set back
ASKED = 0.7
TICK_EVERY = 100
"""The runner calls `tick` every 50 ms; looking at the clock that often is enough."""


def main(
    samples: Annotated[int, typer.Option(min=100, help="Samples, of 10 ms.")] = 40_000,
    repeats: Annotated[int, typer.Option(min=1, help="Best of so many runs.")] = 5,
    folder: Annotated[Path | None, typer.Option(help="Where to write; a temporary folder if not given.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print messages per second of both, and the ratio."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        rows = [_race(Path(place), block, samples, repeats) for block in (1, 10, 100)]
    notes = [f"asked of the ratio: at least {ASKED}"]
    show({f"{samples} samples of {FANS} fans, four topics": rows}, notes, as_json=json_output)
    if any(row["ratio"] < ASKED for row in rows):
        raise typer.Exit(1)


def _race(folder: Path, block: int, samples: int, repeats: int) -> dict[str, Any]:
    progress(f"blocks of {block}")
    packets = [packet for first in range(0, samples, block) for packet in _packets(first, block)]
    size = sum(len(packet.payload) for packet in packets)
    ready = [
        (packet.key, packet.received_t_ns, packet.payload, newest_t_ns(packet.message), packet.message.header.sequence)
        for packet in packets
    ]
    ours_s, bare_s = [], []
    for number in range(repeats):
        ours_s.append(_timed(lambda: _ours(folder / f"{block}-ours-{number}.mcap", packets)))  # noqa: B023
        bare_s.append(_timed(lambda: _bare(folder / f"{block}-bare-{number}.mcap", ready)))  # noqa: B023
    return {
        "samples a message": block,
        "messages": len(packets),
        "recorder messages/s": len(packets) / min(ours_s),
        "recorder MB/s": size / min(ours_s) / 1e6,
        "mcap messages/s": len(packets) / min(bare_s),
        "ratio": min(bare_s) / min(ours_s),
    }


def _packets(first: int, block: int) -> list[Envelope]:
    """The messages of a tray about `block` samples."""
    noise = np.random.default_rng(first).normal(100.0, 3.0, (block, FANS))
    t_ns = EPOCH_NS + (first + np.arange(block)) * STEP_NS
    ones, zeros = np.ones((block, FANS), np.bool_), np.zeros((block, FANS), np.uint8)
    common: dict[str, Any] = {"fans": FANS, "period_ns": STEP_NS, "t_ns": t_ns, "command": np.full((block, FANS), 0.6)}
    judged: dict[str, Any] = {**common, "valid": ones, "invalid_reason": zeros, "measured_speed_rad_s": noise}
    sequence = first // block
    messages: dict[str, Callable[[Header], Message]] = {
        "raw": lambda header: Raw(
            header=header,
            fans=FANS,
            host_receive_t_ns=t_ns,
            device_clock_us=(first + np.arange(block)).astype(np.uint32),
            device_sequence=(first + np.arange(block)).astype(np.uint32),
            command=common["command"],
            speed_rad_s=noise,
        ),
        "grid": lambda header: Grid(header=header, **common, speed_rad_s=noise, valid=ones, invalid_reason=zeros),
        "prediction": lambda header: Prediction(
            header=header,
            **judged,
            predicted_speed_rad_s=noise + 1.0,
            sigma_rad_s=np.full(FANS, 3.0),
            torque_balance_command=noise * 1e-4,
            torque_balance_sigma_command=np.full(FANS, 0.01),
        ),
        "score": lambda header: Score(
            header=header,
            **judged,
            predicted_speed_rad_s=noise + 1.0,
            band_variance=np.full((block, FANS), 36.0),
            state=zeros + 1,
            torque_balance_command=noise * 1e-4,
            expected_residual_rad_s=noise * 0.0,
            expected_balance_command=noise * 0.0,
            score=noise * 1e-3,
            statistic=zeros + 1,
        ),
    }
    prepared = {topic: make(Header(f"{topic}-tray1-0a1b2c3d", sequence, "tray1")) for topic, make in messages.items()}
    received_ns = int(t_ns[-1]) + 1_000_000
    return [
        Envelope(tray_key("bench", "tray1", topic), topic, encode(message), received_ns, message)
        for topic, message in prepared.items()
    ]


def _ours(path: Path, packets: list[Envelope]) -> None:
    parts = RecordingParts(path, {}, {}, "bench")
    clips = AlarmClips(ClipTracker((), most_bytes=0), path, ClipCutter(path, parts.free_bytes).cut)
    recorder = Recorder(parts, RecorderConfig(), time.time_ns(), clips)
    for number, packet in enumerate(packets):
        recorder.step(packet)
        if number % TICK_EVERY == 0:
            recorder.tick(time.time_ns())
    recorder.close()
    assert recorder.counters()["lost_unwritten"] == 0


def _bare(path: Path, ready: list[tuple[str, int, bytes, int, int]]) -> None:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES)
        writer.start()
        channels: dict[str, int] = {}
        for key, log_time, data, publish_time, sequence in ready:
            channel = channels.get(key)
            if channel is None:
                schema = register_schema(writer, proto_type(topic_of(key).message))
                channel = channels[key] = writer.register_channel(key, "protobuf", schema)
            writer.add_message(channel, log_time, data, publish_time, sequence)
        writer.finish()


def _timed(work: Callable[[], None]) -> float:
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


if __name__ == "__main__":
    typer.run(main)
