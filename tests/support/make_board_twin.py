"""Makes tests/support/data/fan_board.onnx again: python -m tests.support.make_board_twin

The firmware runs in its simulator, faster than real time, under commands that cover the whole range; what it sends is
imported, and the twin trained and calibrated by the commands that a user has. Some minutes. Make it again only where
the rotors of firmware/sim or what the firmware measures have changed.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from fantwin.simulation.excitation import Excitation, Multisine, Prbs, Staircase
from tests.support.fan_board import FANS, FanBoard
from tests.support.fantwin_command import fantwin
from tests.support.firmware_build import firmware_file, simulator_file

BOARD_TWIN = Path(__file__).parent / "data" / "fan_board.onnx"
LOW, HIGH = 0.15, 1.0
COMMANDS_HZ = 10
COLUMNS = ("t", *(f"{column}{fan}" for column in ("duty", "rpm") for fan in range(FANS)))


def record(path: Path, profiles: Sequence[Excitation], seconds_each: int) -> Path:
    """Let a board run under profiles, one after another; returns the recording, without the supply."""
    board = FanBoard(simulator_file(), firmware_file())
    board.run(0.2)
    for profile in profiles:
        for number in range(seconds_each * COMMANDS_HZ):
            board.command(*profile.command(number / COMMANDS_HZ).tolist())
            board.run(1 / COMMANDS_HZ)
    board.close()
    table = path.with_suffix(".csv")
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for sample in board.samples[1:]:
            assert sample.clock_us is not None
            writer.writerow([sample.clock_us / 1e6, *map(repr, (*sample.command, *sample.speed))])
    columns = [word for fan in range(FANS) for word in ("--command", f"duty{fan}", "--speed", f"rpm{fan}:rpm")]
    succeed("import", table, "--time", "t:s", *columns, "--tacho", "period", "-o", path)
    return path


def succeed(command: str, *words: object) -> None:
    """Run a command of fantwin, and show what it says."""
    done = fantwin(command, *words)
    print(done.stdout, end="", flush=True)
    assert done.exit_code == 0, done.output


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        swept = [Staircase(FANS, 1, LOW, HIGH), Multisine(FANS, 2, LOW, HIGH), Prbs(FANS, 3, 0.3, 0.8)]
        train = record(folder / "train.mcap", swept, 70)
        held_out = record(
            folder / "held-out.mcap", [Multisine(FANS, 12, LOW, HIGH), Staircase(FANS, 11, LOW, HIGH)], 60
        )
        healthy = [
            record(
                folder / f"healthy-{seed}.mcap",
                [
                    Staircase(FANS, 20 + seed, LOW, HIGH),
                    Multisine(FANS, 30 + seed, LOW, HIGH),
                    Prbs(FANS, 40 + seed, 0.2 + 0.05 * seed, 0.9),
                ],
                100,
            )
            for seed in range(1, 5)
        ]
        options = ("--model", "hybrid", "--iterations", 40, "--name", "simulated fan board", "--seed", 1)
        succeed("train", train, *options, "--validate", held_out, "-o", BOARD_TWIN)
        succeed("calibrate", BOARD_TWIN, *healthy, "--false-alarms-per-day", 8, "--extrapolate")


if __name__ == "__main__":
    sys.exit(main())
