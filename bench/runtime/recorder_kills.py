"""A recorder killed (kill -9) a hundred times at random under load: what is readable, missing and counted.

Another process feeds it and knows what it has sent. Each load is run twice: with a bus that holds more of each topic
than is sent while no recorder is ready, and with one that holds next to nothing, so that every kill costs messages and
the ledgers must know each of them.
"""

from __future__ import annotations

import socket
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.printing import JsonOption, progress, show

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.runtime.killed_recorder import Kills
from fantwin.pipeline.recordings.recorder_config import FLUSH_S

LOADS = {"8 fans": (1, 8), "200 fans": (4, 50)}
"""Trays, and fans of each; 100 Hz, four topics a tray."""
HISTORIES = (1024, 4)
ALLOWED_S = 1.1
"""A second, and what a message takes from its sending to the recorder."""


def main(
    kills: Annotated[int, typer.Option(min=1, help="Kills of each load.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the times at which it is killed.")] = 1,
    folder: Annotated[Path | None, typer.Option(help="Where to record; a temporary folder if not given.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print a row for each load and history; exit code 1 where something is unreadable, uncounted or too old."""
    rows = [_row(load, history, kills, seed, folder) for load in LOADS for history in HISTORIES]
    notes = [
        "while recording: kills of a recorder that had started and caught up with what the bus held; of these",
        f"  oldest s: age, at its kill, of the oldest message that a kill has cost; it flushes every {FLUSH_S:g} s",
        "  newest s: longest time, at a kill, since the receipt of the newest message in the file",
        "recorded again: messages that are in the parts more than once",
    ]
    show({f"{kills} kills at random within 4 s of the start before": rows}, notes, as_json=json_output)
    if any(
        row["unreadable"] or row["missing"] != row["counted"] or row["oldest s"] > ALLOWED_S or row["recorded again"]
        for row in rows
    ):
        raise typer.Exit(1)


def _row(load: str, history: int, number: int, seed: int, folder: Path | None) -> dict[str, Any]:
    trays, fans = LOADS[load]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with tempfile.TemporaryDirectory(dir=folder) as place:
        kills = Kills(Path(place), endpoint, trays, fans, history)
        try:
            found = kills.run(number, seed, lambda done: progress(f"{load}, history {history}: {done} kills"))
        finally:
            kills.close()
    return {
        "load": load,
        "bus holds": history,
        "parts": found.parts,
        "unreadable": len(found.unreadable),
        "sent": found.sent,
        "recorded": found.recorded,
        "recorded again": found.repeated,
        "missing": found.missing,
        "counted": found.counted_missing,
        "while recording": found.kills_of_recording,
        "oldest s": found.oldest_s,
        "newest s": found.newest_s,
    }


if __name__ == "__main__":
    typer.run(main)
