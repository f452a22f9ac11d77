"""Halls that measure speeds and no command: a fan is compared with the others, or with a channel, by a word."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.acquisition.acquisition_core import limits_of
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.sources.source import Reading
from fantwin.pipeline.sources.stand_in import OTHERS, stand_in, with_stand_in
from fantwin.schemas.units import RAD_S_PER_UNIT
from tests.support.fantwin_command import fantwin, usage_error_of
from tests.support.made_once import MadeOnce

FANS, PERIOD_S, HOUR_S = 6, 15.0, 3600.0
SPEEDS = [word for fan in range(FANS) for word in ("--speed", f"rpm{fan}:rpm")]


def hall(path: Path, hours: float, seed: int, slower: dict[int, float] | None = None, from_s: float = HOUR_S) -> Path:
    """A table of six fans on one command that nobody measures, and the temperature that it follows. slower: fans that
    lose a share of their speed from then on."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, hours * HOUR_S, PERIOD_S)
    load = rng.uniform(0.3, 1.0, len(t_s))[np.cumsum(rng.random(len(t_s)) < 0.03)]
    speed = 800.0 + 2100.0 * load
    temperature = 30.0 + 30.0 * load + rng.normal(0.0, 0.5, len(t_s))
    of_fan = 1.0 + 0.02 * np.random.default_rng(99).normal(size=FANS)
    rpm = speed[:, np.newaxis] * of_fan * (1.0 + 0.003 * rng.normal(size=(len(t_s), FANS)))
    for fan, share in (slower or {}).items():
        rpm[t_s >= from_s, fan] *= 1.0 - share
    head = "t,temp," + ",".join(f"rpm{fan}" for fan in range(FANS))
    np.savetxt(path, np.column_stack((t_s, temperature, rpm)), delimiter=",", header=head, comments="", fmt="%.6g")
    return path


def imported(table: Path, *more: object) -> Path:
    output = table.with_suffix(".mcap")
    result = fantwin("import", table, "--time", "t:s", *SPEEDS, *more, "-o", output)
    assert result.exit_code == 0, result.output
    assert "no command is known" in result.stdout
    return output


@pytest.fixture(scope="module")
def folder(made_once: MadeOnce) -> Path:
    """A twin of four hours of the fans by one another, and other recordings."""

    def make(path: Path) -> None:
        for name, hours, seed, slower in (
            ("healthy", 4.0, 1, None),
            ("other", 6.0, 2, None),
            ("faulty", 2.0, 3, {1: 0.05, 4: 1.0}),
        ):
            imported(hall(path / f"{name}.csv", hours, seed, slower), "--command-from", "others")
        result = fantwin("train", path / "healthy.mcap", "--command-unit", "rpm", "-o", path / "twin.onnx")
        assert result.exit_code == 0, result.output

    return made_once("no-command", make)


def alarms_of(folder: Path, name: str) -> list[dict]:
    result = fantwin("replay", folder / f"{name}.mcap", "--offline", "--twin", folder / "twin.onnx", "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)["alarms"]


def test_one_that_is_five_per_cent_slower_and_one_that_stands_are_found_and_no_other(folder: Path) -> None:
    assert alarms_of(folder, "other") == []
    alarms = alarms_of(folder, "faulty")
    found = {alarm["fan"]: alarm["raised_ns"] / 1e9 - HOUR_S for alarm in reversed(alarms)}
    assert set(found) == {1, 4}
    assert all(0.0 <= after_s <= 300.0 for after_s in found.values()), found
    stands = next(alarm["message"] for alarm in alarms if alarm["fan"] == 4)
    assert "does not turn although commanded to " in stands and "e+" not in stands
    assert "ran on" not in stands, "how it fell lies between two samples"


def test_an_import_without_a_command_offers_what_stands_for_it_by_its_error_and_says_what_is_not_found(
    tmp_path: Path,
) -> None:
    table = hall(tmp_path / "hall.csv", 1.0, 4)
    said = usage_error_of(
        "import", table, "--time", "t:s", *SPEEDS, "--channel", "temperature_c=temp", "-o", tmp_path / "x.mcap"
    )
    first, by_others, by_temperature = said.split("; or ")
    assert first.endswith("an import needs --command")
    assert by_others.startswith("--command-from others, speeds within 0.")
    assert "not found: what slows most of the fans at once, and drag under a controller" in by_others
    assert by_temperature.startswith("--command-from temperature, speeds within ")
    assert "other air looks like a fault" in by_temperature
    assert imported(table, "--channel", "temperature_c=temp", "--command-from", "temperature").is_file()


def test_a_tray_has_the_same_stand_in_live_and_its_readings_need_no_command(tmp_path: Path) -> None:
    config = tmp_path / "fantwin.toml"
    config.write_text('[[tray]]\nname = "hall"\nfans = 3\nspeed_unit = "rpm"\ncommand_from = "others"\nport = "x"\n')
    (tray,) = load_config(config).trays
    nothing = (float("nan"),) * 3
    reading = Reading(command=nothing, speed=(1000.0, float("nan"), 1300.0))
    assert limits_of(tray).why_refused(reading) is None
    live = with_stand_in(reading, tray.command_from, RAD_S_PER_UNIT["rpm"])
    rows = stand_in(OTHERS, np.array([reading.speed]) * RAD_S_PER_UNIT["rpm"], {})
    assert live.command == pytest.approx((1300.0, 1150.0, 1000.0)) == tuple(rows[0])
