"""How many bytes of a recording a fan-sample takes, by topics that are recorded, fans of a tray, and messages.

Rough fans under random stairs, all healthy, watched by a calibrated twin: speeds with all their digits, which do not
compress. The cores of the stages make what a site sends, in this process, without health. The recorder's own writer
writes it, flushed as often as the recorder does by default.

    python -m bench.runtime.recording_size
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer

from bench.detection.plant import START_NS
from bench.fleet.stage_cost import SITE, TRAY, calibrated_twin, raws
from bench.printing import JsonOption, progress, show

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.training.published_fan import RATE_HZ, rough_run
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.recorder_config import FLUSH_BYTES, FLUSH_S, LONGEST_FLUSH_S, SAMPLES
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.wear.trend import WearSeries
from fantwin.twin.runs import Run
from tests.support.killed_site import CHAIN, Stages

BLOCKS_S = (0.05, 0.1, 1.0)
TRAYS = {1: 120.0, 8: 120.0, 64: 120.0, 1024: 20.0}
"""fans of a tray, and the seconds that are recorded"""
SLOW_FANS, SLOW_TRAYS = 512, (1, 8, 64, 512)
"""fans of the site, and of a tray"""
SLOW_RATES_HZ, SLOW_S, HELD_S = (10.0, 1.0), 40.0, 8.0
"""HELD_S: so long a command stays the same; in the run it jumps every 0.5 to 2 s"""
SNAPSHOT_FANS, SNAPSHOTS = 64, 4
WEAR_POINTS, WEAR_EVERY_NS = (0, 128, 1000), 600 * NS_PER_S
"""of each parameter since commissioning: none, as many as are kept, and those of a week, when several are one"""


def main(json_output: JsonOption = False) -> None:
    """Print bytes of the file for each fan-sample, and for each fan of a snapshot."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        progress("training and calibrating the twin")
        twin = calibrated_twin(folder)
        tables = {
            f"one tray at {RATE_HZ:g} Hz: bytes for each fan-sample by topics": fast_rows(twin, folder),
            f"{SLOW_FANS:,} fans, each sample a message: bytes of raw samples for each fan-sample": slow_rows(folder),
            "snapshots: bytes for each fan": snapshot_rows(twin, folder),
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
    """By rate and fans of a tray, with commands that are new in most samples, and with held ones."""
    rows: list[dict[str, Any]] = []
    progress(f"{SLOW_FANS} fans at slow rates")
    run = rough_run(3, SLOW_S, SLOW_FANS, fan_variation=0.0).run
    for rate_hz in SLOW_RATES_HZ:
        sites = {"command jumps": slowed(run, rate_hz, 0.0), "command held": slowed(run, rate_hz, HELD_S)}
        for fans in SLOW_TRAYS:
            found: dict[str, float] = {}
            for name, site in sites.items():
                messages = sorted(
                    (each for first in range(0, site.fans, fans) for each in tray_of(site, first, fans, rate_hz)),
                    key=lambda envelope: envelope.received_t_ns,
                )
                found[name] = bytes_of_each(messages, site.samples * site.fans, folder)
            rows.append({"rate, Hz": rate_hz, "fans of a tray": fans, "trays": SLOW_FANS // fans, **found})
    return rows


def snapshot_rows(twin: Path, folder: Path) -> list[dict[str, Any]]:
    """By points of wear; for each fan of a tray of SNAPSHOT_FANS."""
    progress("snapshots")
    run = rough_run(3, 10.0, SNAPSHOT_FANS, fan_variation=0.0).run
    recorded = list(read_recording(site_recording(run, 1.0, twin, folder)))
    rows: list[dict[str, Any]] = []
    for points in WEAR_POINTS:
        snapshots = snapshots_with_wear(recorded, points)
        rows.append({"points": points, "bytes": bytes_of_each(snapshots, len(snapshots) * SNAPSHOT_FANS, folder)})
    return rows


def slowed(run: Run, rate_hz: float, held_s: float) -> Run:
    """A run at a slower rate. held_s: so long the command of a fan stays the same, of each at other times; 0: as in the
    run."""
    rows = np.arange(0, run.samples, round(RATE_HZ / rate_hz))
    held = max(1, round(held_s * RATE_HZ))
    began = np.arange(run.fans) * held // run.fans
    kept = np.maximum((rows[:, np.newaxis] + began) // held * held - began, 0)
    command = np.take_along_axis(run.command, kept if held_s else np.repeat(rows[:, np.newaxis], run.fans, 1), axis=0)
    return replace(run, t_s=run.t_s[rows], command=command, speed_rad_s=run.speed_rad_s[rows])


def tray_of(run: Run, first: int, fans: int, rate_hz: float) -> Iterator[Envelope]:
    """The raw messages of a tray with some fans of a run, one for each sample."""
    of_tray = slice(first, first + fans)
    tray = replace(run, command=run.command[:, of_tray], speed_rad_s=run.speed_rad_s[:, of_tray], tacho=run.tacho[:1])
    for number, raw in enumerate(raws(tray, 1.0 / RATE_HZ)):
        t_ns = START_NS + np.array([round(number * NS_PER_S / rate_hz) + first])
        clock_us = np.array([round(number * 1e6 / rate_hz) + first], np.uint32)
        timed = replace(raw, host_receive_t_ns=t_ns, device_clock_us=clock_us)
        yield Envelope.of(tray_key(SITE, f"tray{first}", "raw"), timed, int(t_ns[0]))


def snapshots_with_wear(recorded: Sequence[Envelope], points: int) -> list[Envelope]:
    """The last recorded snapshot several times, with so many points of wear of each fan."""
    last = next(each for each in reversed(recorded) if each.topic == "snapshot")
    snapshot = last.message
    assert isinstance(snapshot, ScorerSnapshot)
    state = json.loads(snapshot.state_json)
    rng = np.random.default_rng(1)
    found: list[Envelope] = []
    for number in range(SNAPSHOTS):
        for fan in range(len(state["wear"]["series"])):
            series = WearSeries([], [], [])
            for point in range(points):
                t_ns = START_NS + point * WEAR_EVERY_NS + int(rng.integers(WEAR_EVERY_NS))
                series.add(t_ns, rng.normal(0.0, 0.02), rng.uniform(0.005, 0.02))
            state["wear"]["series"][fan] = asdict(series)
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
    flushed_ns, unflushed_bytes = START_NS, 0
    with RecordingWriter(path, {}, overwrite=True) as writer:
        for envelope in envelopes:
            after_s = FLUSH_S if unflushed_bytes >= FLUSH_BYTES else LONGEST_FLUSH_S
            if envelope.received_t_ns - flushed_ns >= after_s * NS_PER_S:
                writer.flush()
                flushed_ns, unflushed_bytes = envelope.received_t_ns, 0
            writer.add(envelope)
            unflushed_bytes += len(envelope.payload)
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
