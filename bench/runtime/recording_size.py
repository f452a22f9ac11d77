"""How many bytes of a recording a fan-sample takes, by topics that are recorded, fans of a tray, and messages.

Rough fans under random stairs, all healthy, watched by a calibrated twin: speeds with all their digits, which do not
compress. The cores of the stages make what a site sends, in this process; health, which does not grow with the fans, is
not in it. The recorder's own writer writes it, flushed once a second.

    python -m bench.runtime.recording_size
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Collection, Iterable
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
from schemas.messages import Raw
from schemas.topics import tray_key
from schemas.units import NS_PER_S
from simulation.published_fan import RATE_HZ, rough_run
from tests.support.killed_site import CHAIN, Stages
from twin.runs import Run

BLOCKS_S = (0.05, 0.1, 1.0)
TRAYS = {1: 120.0, 8: 120.0, 64: 120.0, 1024: 20.0}
"""fans of a tray, and the seconds that are recorded"""


def main(json_output: JsonOption = False) -> None:
    """Print bytes of the file for each fan-sample."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        progress("training and calibrating the twin")
        twin = calibrated_twin(folder)
        for fans, seconds in TRAYS.items():
            progress(f"{fans} fans")
            run = rough_run(3, seconds, fans, fan_variation=0.0).run
            for block_s in BLOCKS_S:
                whole = list(read_recording(site_recording(run, block_s, twin, folder)))
                raw = size([each for each in whole if each.topic == "raw"], folder)
                rare = size([each for each in whole if each.topic not in SAMPLES], folder)
                rows.append(
                    {
                        "fans": fans,
                        "rate, Hz": RATE_HZ,
                        "message, s": block_s,
                        "raw": raw / (run.samples * fans),
                        "all topics": size(whole, folder) / (run.samples * fans),
                        "rare, a fan and minute": rare / fans / seconds * 60.0,
                    }
                )
            slow = size(raw_envelopes(slow_raws(run)), folder) / (seconds * fans)
            rows.append({**dict.fromkeys(rows[-1]), "fans": fans, "rate, Hz": 1.0, "message, s": 1.0, "raw": slow})
    show({"bytes of a recording for each fan-sample": rows}, [], as_json=json_output)


def raw_envelopes(messages: Iterable[Raw]) -> list[Envelope]:
    """As they are recorded right after they were measured."""
    key = tray_key(SITE, TRAY, "raw")
    return [Envelope.of(key, raw, int(raw.host_receive_t_ns[-1])) for raw in messages]


def slow_raws(run: Run) -> Iterable[Raw]:
    """The samples of a run once a second, each in a message."""
    step = round(RATE_HZ)
    rows = np.arange(0, run.samples, step)
    slow = replace(run, t_s=run.t_s[rows], command=run.command[rows], speed_rad_s=run.speed_rad_s[rows])
    for raw in raws(slow, 1.0 / RATE_HZ):
        since_ns = (raw.host_receive_t_ns - START_NS) * step
        yield replace(raw, host_receive_t_ns=START_NS + since_ns, device_clock_us=(since_ns // 1000).astype(np.uint32))


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
