"""Replay on the bus at full speed, ten times: what real stages took, what they lost, and how fast that went.

Eight fans at 100 Hz for a minute, one sample a message: resampler, twin_integrator, scorer and recorder run as
processes of their own and score all of it again. Printed are multiples of real time: for the publishing
alone, and until the recorder had the last score; and how many messages of the whole chain are not in the recording.
"""

from __future__ import annotations

import json
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

import typer

from bench.printing import JsonOption, progress, show

sys.path.insert(0, str(Path(__file__).parents[2]))

from fantwin.pipeline.recordings.reading import read_recording
from tests.support.replay_data import START_NS, STEP_NS, write_raw
from tests.support.running_chain import Chain, eventually, fantwin

STAGES = ("resampler", "twin_integrator", "scorer", "recorder")
SAMPLES = 6000
DECIDED = ("grid", "prediction", "score")


def main(runs: int = 10, json_output: JsonOption = False) -> None:
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        source = write_raw(Path(folder) / "source.mcap", SAMPLES)
        for run in range(1, runs + 1):
            progress(f"run {run} of {runs}")
            where = Path(folder) / str(run)
            where.mkdir()
            rows.append({"run": run, **measured(source, where)})
    lost = sum(row["lost"] + row["not recorded"] for row in rows)
    notes = [f"{lost} of {runs * SAMPLES * 4:,} messages lost in {runs} runs"]
    show({"replay on the bus, --rate max --from-topic raw": rows}, notes, as_json=json_output)
    if lost:
        raise typer.Exit(3)


def measured(source: Path, folder: Path) -> dict[str, Any]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    chain = Chain(folder, endpoint, stages=STAGES)
    try:
        up = chain.start_up()
        with chain.watcher() as watcher:
            eventually(lambda: {v.health.stage for v in watcher.stages() if v.alive} == set(STAGES), "all are there")
            done = fantwin("replay", source, "--rate", "max", "--from-topic", "raw", "--json", *chain.words("")[1:])
        status, account = up.end(), up.output()
    finally:
        chain.close()
    summary = json.loads(done.stdout)
    wanted = {"raw": set(range(SAMPLES))} | {topic: set(range(SAMPLES)) for topic in DECIDED}
    first_ns = last_ns = 0
    for entry in read_recording(folder / "recording.mcap", topics=tuple(wanted)):
        message: Any = entry.message
        times = message.host_receive_t_ns if entry.topic == "raw" else message.t_ns
        new = wanted[entry.topic] & {int(t_ns - START_NS) // STEP_NS for t_ns in times}
        wanted[entry.topic] -= new
        first_ns = first_ns or entry.received_t_ns
        last_ns = entry.received_t_ns if new and entry.topic == "score" else last_ns
    return {
        "messages": summary["messages"]["raw"],
        "published, x real time": summary["rate"],
        "scored and recorded, x real time": SAMPLES * STEP_NS / (last_ns - first_ns),
        "lost": sum(summary["lost"].values()) + sum(account["lost"].values()),
        "not recorded": sum(map(len, wanted.values())),
        "exit codes": f"{done.returncode} {status}",
    }


if __name__ == "__main__":
    typer.run(main)
