"""The published experiment, redone on the simulated tray: manual modulation, a covered inlet, a disturbed rotor.

Peng and Chen show a band of two healthy standard deviations around their twin, green while the fan stays inside and red
where it leaves. Here are the same three runs with the demo's twin, which knew none of them, and beside the band alarms
and causes. Writes the pictures of docs/explanation/experiment.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.printing import JsonOption, show

ROOT = Path(__file__).parents[2]
TWIN = ROOT / "pipeline" / "demo" / "twin.onnx"
FAN = 2
RUNS = {
    "modulation": (),
    "inlet": (f"inlet:fan={FAN},start=15,stop=30,size=1.6",),
    "rotor": (f"rotor:fan={FAN},start=15,stop=30,size=0.8",),
}


NO_ALARM = {"run": "", "fan": "none of 8", "raised": None, "cleared": None, "severity": "", "cause": ""}


def main(
    folder: Annotated[Path, typer.Option(help="Where the pictures go.")] = ROOT / "docs",
    seed: Annotated[int, typer.Option(help="Seed of commands and noise.")] = 7,
    json_output: JsonOption = False,
) -> None:
    """Simulate, score and draw the three runs."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as work:
        for name, faults in RUNS.items():
            recording, scored = Path(work) / f"{name}.mcap", Path(work) / f"{name}-judged.mcap"
            truth = Path(work) / f"{name}.json"
            options = [word for fault in faults for word in ("--fault", fault)]
            settings = ("--fans", 8, "--profile", "manual", "--seed", seed, "--duration", 45, "--set", "speed_unit=rpm")
            _fantwin("simulate", *settings, *options, "--recording", recording, "--truth", truth)
            reported = json.loads(
                _fantwin("replay", recording, "--offline", "--twin", TWIN, "-o", scored, "--json", accept=(0, 3))
            )
            picture = folder / f"experiment-{name}.png"
            _fantwin("view", scored, "--fans", FAN, "--unit", "rpm", "--truth", truth, "-o", picture)
            start_ns = json.loads(truth.read_text(encoding="utf-8"))["start_ns"]
            rows += _rows(name, reported["alarms"], start_ns) or [NO_ALARM | {"run": name}]
    show({"alarms of the three runs, s since the first sample": rows}, [], as_json=json_output)


def _rows(name: str, alarms: list[dict[str, Any]], start_ns: int) -> list[dict[str, Any]]:
    return [
        {
            "run": name,
            "fan": str(one["fan"]),
            "raised": (one["raised_ns"] - start_ns) / 1e9,
            "cleared": None if one["cleared_ns"] is None else (one["cleared_ns"] - start_ns) / 1e9,
            "severity": one["severity"],
            "cause": f"{one['causes'][0]['cause']} {one['causes'][0]['probability']:.0%}" if one["causes"] else "",
        }
        for one in alarms
    ]


def _fantwin(*words: object, accept: tuple[int, ...] = (0,)) -> str:
    done = subprocess.run(
        [sys.executable, "-P", "-m", "fantwin", *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode not in accept:
        raise SystemExit(f"fantwin {' '.join(map(str, words))}: {done.stderr.strip()}")
    return done.stdout


if __name__ == "__main__":
    typer.run(main)
