"""Recordings of the firmware in its simulator, faster than real time, for training: what it sends is imported."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fantwin.schemas.channels import SUPPLY_VOLTAGE
from fantwin.simulation.excitation import Excitation
from tests.support.fan_board import FANS, FanBoard
from tests.support.fantwin_command import fantwin
from tests.support.firmware_build import firmware_file, simulator_file

COMMANDS_HZ = 10
SUPPLY_KEPT_S = 5
COLUMNS = ("t", *(f"{column}{fan}" for column in ("duty", "rpm") for fan in range(FANS)), "supply")


def run_board(
    table: Path, profiles: Sequence[Excitation], seconds_each: int, supply_v: tuple[float, float] | None = None
) -> None:
    """Let a board run under profiles, one after another, and write what it sent as CSV.

    supply_v: least and largest voltage of a supply that steps every five seconds; None: it is a steady one.
    """
    chance = np.random.default_rng(seconds_each)
    board = FanBoard(simulator_file(), firmware_file())
    board.run(0.2)
    for profile in profiles:
        for number in range(seconds_each * COMMANDS_HZ):
            if supply_v and number % (SUPPLY_KEPT_S * COMMANDS_HZ) == 0:
                board.order("supply", chance.uniform(*supply_v))
            board.command(*profile.command(number / COMMANDS_HZ).tolist())
            board.run(1 / COMMANDS_HZ)
    board.close()
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for sample in board.samples[1:]:
            assert sample.clock_us is not None
            values = (*sample.command, *sample.speed, sample.measured[SUPPLY_VOLTAGE][0])
            writer.writerow([sample.clock_us / 1e6, *map(repr, values)])


def import_board(table: Path, recording: Path, *, with_supply: bool) -> Path:
    """Import what a board sent, with the column of its supply or without; returns the recording."""
    columns = [word for fan in range(FANS) for word in ("--command", f"duty{fan}", "--speed", f"rpm{fan}:rpm")]
    supply = ("--channel", "supply_voltage_v=supply") if with_supply else ()
    succeed("import", table, "--time", "t:s", *columns, *supply, "--tacho", "period", "-o", recording)
    return recording


def succeed(command: str, *words: object) -> str:
    """Run a command of fantwin, and show what it says; returns that."""
    done = fantwin(command, *words)
    print(done.stdout, end="", flush=True)
    assert done.exit_code == 0, done.output
    return done.stdout
