"""How many bytes of a recording a fan-sample takes, by topics that are recorded, fans of a tray, and messages.

Rough fans under random stairs, all healthy, watched by a calibrated twin: speeds with all their digits, which do not
compress. The cores of the stages make what a site sends, in this process, without health. The recorder's own writer
writes it, flushed once a second.

    python -m bench.runtime.recording_size
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import typer

from bench.detection.plant import START_NS
from bench.fleet.stage_cost import SITE, TRAY, calibrated_twin, raws
from bench.printing import JsonOption, progress, show

sys.path.insert(0, str(Path(__file__).parents[2]))

from pipeline.config.loading import parse_config
from pipeline.recordings.reading import read_recording
from pipeline.recordings.recorder_config import SAMPLES
from pipeline.recordings.writing import RecordingWriter
from schemas.envelope import Envelope
from schemas.messages import ScorerSnapshot
from schemas.topics import tray_key
from schemas.units import NS_PER_S
from scoring.wear.trend import CAPACITY, NS_PER_DAY
from simulation.published_fan import RATE_HZ, rough_run
from tests.support.killed_site import CHAIN, Stages
from twin.runs import Run

BLOCKS_S = (0.05, 0.1, 1.0)
TRAYS = {1: 120.0, 8: 120.0, 64: 120.0, 1024: 20.0}
"""fans of a tray, and the seconds that are recorded"""
SLOW_RATES_HZ, SLOW_SAMPLES = (10.0, 1.0), 20
SNAPSHOT_FANS, SNAPSHOTS = 64, 4


def main(json_output: JsonOption = False) -> None:
    """Print bytes of the file for each fan-sample, and for each fan of a snapshot."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        progress("training and calibrating the twin")
        twin = calibrated_twin(folder)
        tables = {
            f"one tray at {RATE_HZ:g} Hz: bytes for each fan-sample by topics": fast_rows(twin, folder),
            f"{max(TRAYS):,} fans, each sample a message: bytes for each fan-sample": slow_rows(folder),
            "a snapshot with the full history of wear: bytes for each fan": [
                {"snapshot": snapshot_bytes(twin, folder)}
            ],
        }
    show(tables, [], as_json=json_output)


def fast_rows(twin: Path, folder: Path) -> list[dict[str, Any]]:
    """By fans of a tray and length of a message."""
    rows: list[dict[str, Any]] = []
    recorded = {"raw": ("raw",), "all four": SAMPLES}
    for fans, seconds in TRAYS.items():
        progress(f"a tray of {fans} fans")
        run = rough_run(3, seconds, fans, fan_variation=0.0).run
        for block_s in BLOCKS_S:
            whole = list(read_recording(site_recording(run, block_s, twin, folder)))
            sizes = {
                name: bytes_of_each([each for each in whole if each.topic in topics], run.samples * fans, folder)
                for name, topics in recorded.items()
            }
            rows.append({"fans": fans, "message, s": block_s, **sizes})
    return rows


def slow_rows(folder: Path) -> list[dict[str, Any]]:
    """Of raw samples, by rate and fans of a tray."""
    rows: list[dict[str, Any]] = []
    run = rough_run(3, SLOW_SAMPLES / min(SLOW_RATES_HZ), max(TRAYS), fan_variation=0.0).run
    for rate_hz in SLOW_RATES_HZ:
        progress(f"{run.fans} fans at {rate_hz:g} Hz")
        site = slowed(run, rate_hz)
        for fans in TRAYS:
            messages = sorted(
                (each for first in range(0, site.fans, fans) for each in tray_of(site, first, fans, rate_hz)),
                key=lambda envelope: envelope.received_t_ns,
            )
            each = bytes_of_each(messages, site.samples * site.fans, folder)
            rows.append({"rate, Hz": rate_hz, "fans of a tray": fans, "trays": site.fans // fans, "raw": each})
    return rows


def snapshot_bytes(twin: Path, folder: Path) -> float:
    """Of a fan of a tray of SNAPSHOT_FANS."""
    progress("snapshots")
    run = rough_run(3, 10.0, SNAPSHOT_FANS, fan_variation=0.0).run
    snapshots = snapshots_with_full_wear(list(read_recording(site_recording(run, 1.0, twin, folder))))
    return bytes_of_each(snapshots, len(snapshots) * SNAPSHOT_FANS, folder)


def slowed(run: Run, rate_hz: float) -> Run:
    """SLOW_SAMPLES of the samples of a run, as far apart as at a slower rate."""
    rows = np.arange(SLOW_SAMPLES) * round(RATE_HZ / rate_hz)
    return replace(run, t_s=run.t_s[rows], command=run.command[rows], speed_rad_s=run.speed_rad_s[rows])


def tray_of(run: Run, first: int, fans: int, rate_hz: float) -> Iterator[Envelope]:
    """The raw messages of a tray with some fans of a run, one for each sample."""
    of_tray = slice(first, first + fans)
    tray = replace(run, command=run.command[:, of_tray], speed_rad_s=run.speed_rad_s[:, of_tray], tacho=run.tacho[:1])
    for number, raw in enumerate(raws(tray, 1.0 / RATE_HZ)):
        t_ns = START_NS + np.array([round(number * NS_PER_S / rate_hz) + first])
        clock_us = np.array([round(number * 1e6 / rate_hz) + first], np.uint32)
        timed = replace(raw, host_receive_t_ns=t_ns, device_clock_us=clock_us)
        yield Envelope.of(tray_key(SITE, f"tray{first}", "raw"), timed, int(t_ns[0]))


def snapshots_with_full_wear(recorded: Sequence[Envelope]) -> list[Envelope]:
    """The last recorded snapshot several times, as after a day: the history of wear of each fan is full."""
    last = next(each for each in reversed(recorded) if each.topic == "snapshot")
    snapshot = last.message
    assert isinstance(snapshot, ScorerSnapshot)
    state = json.loads(snapshot.state_json)
    rng = np.random.default_rng(1)
    found: list[Envelope] = []
    for number in range(SNAPSHOTS):
        for fan in state["wear"]["fans"]:
            for parameter in fan["parameters"].values():
                parameter["series"] = {
                    "t_ns": (START_NS + np.sort(rng.integers(0, NS_PER_DAY, CAPACITY))).tolist(),
                    "value": rng.normal(size=CAPACITY).tolist(),
                    "std_error": rng.uniform(size=CAPACITY).tolist(),
                    "count": [1, 1],
                }
        message = replace(snapshot, state_json=json.dumps(state))
        found.append(Envelope.of(last.key, message, START_NS + 60 * number * NS_PER_S))
    return found


def bytes_of_each(envelopes: Sequence[Envelope], things: int, folder: Path) -> float:
    """Bytes of a file for each of the things in these messages, by what the second half of the messages adds to it."""
    half = len(envelopes) // 2
    added = size(envelopes, folder) - size(envelopes[:half], folder)
    return added / (things * (1.0 - half / len(envelopes)))


def size(envelopes: Sequence[Envelope], folder: Path) -> int:
    """Bytes of a file with these messages."""
    path = folder / "size.mcap"
    flushed_ns = START_NS
    with RecordingWriter(path, {}, overwrite=True) as writer:
        for envelope in envelopes:
            writer.add(envelope)
            if envelope.received_t_ns - flushed_ns >= NS_PER_S:
                writer.flush()
                flushed_ns = envelope.received_t_ns
    return path.stat().st_size


def site_recording(run: Run, block_s: float, twin: Path, folder: Path) -> Path:
    """What the stages of a site send of the samples of a run."""
    text = (
        f'site = "{SITE}"\nrun_folder = "{folder / "runs"}"\n'
        f'[[tray]]\nname = "{TRAY}"\nfans = {run.fans}\ntwin = "{twin}"\n'
    )
    config = parse_config(text, folder / "fantwin.toml", (), CHAIN)
    site = Stages(config, folder / "site.mcap", START_NS, remembers=False)
    for raw in raws(run, block_s):
        site.now_ns = int(raw.host_receive_t_ns[-1])
        site.take(raw)
    site.end()
    return folder / "site.mcap"


if __name__ == "__main__":
    typer.run(main)
