"""How many bytes of a recording a fan-sample takes, by topics that are recorded, fans of a tray, and messages.

Rough fans under random stairs, all healthy, watched by a calibrated twin: speeds with all their digits, which do not
compress. The cores of the stages make what a site sends, in this process; health, which does not grow with the fans, is
not in it. The recorder's own writer writes it, flushed once a second.

    python -m bench.runtime.recording_size
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Collection, Iterator
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
from schemas.topics import tray_key
from schemas.units import NS_PER_S
from simulation.published_fan import RATE_HZ, rough_run
from tests.support.killed_site import CHAIN, Stages
from twin.runs import Run

BLOCKS_S = (0.05, 0.1, 1.0)
TRAYS = {1: 120.0, 8: 120.0, 64: 120.0, 1024: 20.0}
"""fans of a tray, and the seconds that are recorded"""


def main(json_output: JsonOption = False) -> None:
    """Print bytes of the file for each fan-sample, and for each fan of a snapshot."""
    fast: list[dict[str, Any]] = []
    slow: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        progress("training and calibrating the twin")
        twin = calibrated_twin(folder)
        for fans, seconds in TRAYS.items():
            progress(f"a tray of {fans} fans")
            run = rough_run(3, seconds, fans, fan_variation=0.0).run
            for block_s in BLOCKS_S:
                whole = list(read_recording(site_recording(run, block_s, twin, folder)))
                by_topic = {name: [each for each in whole if each.topic == name] for name in ("raw", "snapshot")}
                of_samples = [each for each in whole if each.topic in SAMPLES]
                fast.append(
                    {
                        "fans": fans,
                        "message, s": block_s,
                        "raw": size(by_topic["raw"], folder) / (run.samples * fans),
                        "all four": size(of_samples, folder) / (run.samples * fans),
                        "a snapshot": size(by_topic["snapshot"], folder) / (len(by_topic["snapshot"]) * fans),
                    }
                )
        whole_site = once_a_second(run)
        for fans in TRAYS:
            messages = [each for tray in trays_of(whole_site, fans) for each in tray]
            messages.sort(key=lambda envelope: envelope.received_t_ns)
            each = size(messages, folder) / (whole_site.samples * whole_site.fans)
            slow.append({"fans of a tray": fans, "trays": whole_site.fans // fans, "raw": each})
    show(
        {
            f"one tray at {RATE_HZ:g} Hz: bytes for each fan-sample by topics; of a snapshot for each fan": fast,
            f"{whole_site.fans:,} fans at 1 Hz, each sample a message: bytes for each fan-sample": slow,
        },
        [],
        as_json=json_output,
    )


def once_a_second(run: Run) -> Run:
    """The samples of a run that are a second apart."""
    rows = np.arange(0, run.samples, round(RATE_HZ))
    return replace(run, t_s=run.t_s[rows], command=run.command[rows], speed_rad_s=run.speed_rad_s[rows])


def trays_of(run: Run, fans: int) -> Iterator[list[Envelope]]:
    """The raw messages of one sample of each tray, if the fans are on trays of so many."""
    for first in range(0, run.fans, fans):
        of_tray = slice(first, first + fans)
        tray = replace(
            run, command=run.command[:, of_tray], speed_rad_s=run.speed_rad_s[:, of_tray], tacho=run.tacho[:1]
        )
        messages: list[Envelope] = []
        for number, raw in enumerate(raws(tray, 1.0 / RATE_HZ)):
            t_ns = START_NS + np.array([number * NS_PER_S + first])
            clock_us = np.array([number * 1_000_000 + first], np.uint32)
            timed = replace(raw, host_receive_t_ns=t_ns, device_clock_us=clock_us)
            messages.append(Envelope.of(tray_key(SITE, f"tray{first}", "raw"), timed, int(t_ns[0])))
        yield messages


def size(envelopes: Collection[Envelope], folder: Path) -> int:
    """Bytes of a file with these messages, without what it has before the first and after the last."""
    sizes = []
    for some in (envelopes, ()):
        path = folder / "size.mcap"
        with RecordingWriter(path, {}, overwrite=True) as writer:
            flushed_ns = START_NS
            for envelope in some:
                writer.add(envelope)
                if envelope.received_t_ns - flushed_ns >= NS_PER_S:
                    writer.flush()
                    flushed_ns = envelope.received_t_ns
        sizes.append(path.stat().st_size)
    return sizes[0] - sizes[1]


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
