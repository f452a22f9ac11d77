"""Commands over many recordings, with one job, with two, and with two Dask workers: times, and whether results are the
same.

Rough fans at 100 Hz under random stairs, all healthy, one recording for each of them. Each command runs as a process of
its own, as a user starts it, so its start counts, and that of its workers; the Dask workers run before.

    python -m bench.fleet.many_recordings
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from distributed import LocalCluster

from bench.printing import JsonOption, progress, show
from bench.training.published_fan import rough_run
from tests.support.but_for_times import but_for_times, content_of
from tests.support.written_recordings import write_run

FANS = 2
MODEL = ("--model", "physical")
TWO_WORKERS: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}


def main(
    recordings: Annotated[int, typer.Option(help="How many.")] = 64,
    seconds: Annotated[float, typer.Option(help="Length of each.")] = 120.0,
    json_output: JsonOption = False,
) -> None:
    """Print the time of each command, s, and that with one job relative to it."""
    rows: list[dict[str, Any]] = []
    with (
        tempfile.TemporaryDirectory() as place,
        LocalCluster(**TWO_WORKERS) as local,
    ):
        cluster: Any = local  # its types are those of asynchronous use
        folder = Path(place)
        progress(f"simulating {recordings} recordings of {FANS} fans")
        paths = [
            write_run(folder / f"{seed}.mcap", rough_run(seed, seconds, FANS, fan_variation=0.0).run)
            for seed in range(recordings)
        ]
        twin = folder / "twin.onnx"
        run(["train", paths[0], *MODEL, "-o", twin])
        ways = {"1 job": ("-j", 1), "2 jobs": ("-j", 2), "2 workers": ("-j", cluster.scheduler_address)}
        for command in ("train", "calibrate", "evaluate", "replay"):
            found: dict[str, tuple[float, str, bytes]] = {}
            for way, options in ways.items():
                progress(f"{command}, {way}")
                output = folder / f"{command}-{len(found)}.onnx"
                began_s = time.monotonic()
                printed = run([*words_of(command, paths, twin, output), *options])
                took_s = time.monotonic() - began_s
                found[way] = (took_s, printed.replace(str(output), ""), content_of(output) if output.exists() else b"")
            alone_s, *result = found["1 job"]
            for way, (took_s, *other) in found.items():
                faster = alone_s / took_s
                same = "yes" if other == result else "no"
                rows.append({"command": command, "with": way, "s": took_s, "times": faster, "same": same})
    show({f"{recordings} recordings of {FANS} fans, {seconds:g} s each": rows}, [], as_json=json_output)


def words_of(command: str, recordings: Sequence[Path], twin: Path, output: Path) -> list[object]:
    """The words of a command; `output` is the twin that it writes, if it writes one."""
    return {
        "train": ["train", *recordings, *MODEL, "--name", "fleet", "-o", output],
        "calibrate": ["calibrate", twin, *recordings, "--false-alarms-per-day", 1500, "-o", output],
        "evaluate": ["evaluate", twin, *recordings],
        "replay": ["replay", "--offline", *recordings, "--twin", twin],
    }[command]


def run(words: Sequence[object]) -> str:
    """What a command prints as JSON, but for times."""
    command = [sys.executable, "-m", "fantwin", *map(str, words), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command[2:4])}: {done.stderr}")
    return json.dumps(but_for_times(json.loads(done.stdout)))


if __name__ == "__main__":
    typer.run(main)
