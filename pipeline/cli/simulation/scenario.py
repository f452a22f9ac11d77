"""The scenario of `fantwin simulate`: what is simulated, as a TOML file, and the tray or the played file that it
describes."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from fantwin.pipeline.config.loading import checked_section, set_key
from fantwin.pipeline.config.settings import Section
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.imported_file import read_file
from fantwin.pipeline.sources.simulated.table import TableDevice
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas import wire
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, Tachos
from fantwin.schemas.units import SpeedUnit

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray

UNNAMED = Path("scenario")
"""what errors call a scenario of options alone"""


class ClockScenario(Section):
    """The clock of the device, 32 bits of microseconds."""

    drift_ppm: float = Field(default=40.0, description="drift; positive: fast")
    start_us: int = Field(default=0, description="first reading; the clock wraps at 2^32")


class SurroundingsScenario(Section):
    """Supply and air."""

    measured: tuple[Literal["supply_voltage_v", "current_a", "temperature_c"], ...] = Field(
        default=(), description="columns that are sent beside command and speed"
    )
    supply_wander: float = Field(default=0.0, description="relative standard deviation of the supply voltage")
    supply_held: float = Field(
        default=1.0, description="4-pin fans: 1 if they hold their speed against the supply, 0 if it is proportional"
    )
    temperature_c: float = Field(default=20.0, description="mean temperature of the air, °C")
    temperature_swing_c: float = Field(default=0.0, description="its amplitude, °C; the period is 10 minutes")


class FileScenario(Section):
    """A measured file that is played at its own times instead of a simulation."""

    path: Path = Field(description="a table, or what else `fantwin import` reads")
    time: str | None = Field(default=None, description="time column[:unit], or DATE+TIME; without it, found")
    period: str | None = Field(default=None, description="time between rows without a time column, such as 10ms")
    command: tuple[str, ...] = Field(min_length=1, description="command columns: one for all fans, or one for each")
    speed: tuple[str, ...] = Field(
        min_length=1, description="speed columns[:unit], one for each fan; rpm, hz, deg/s, rad/s (default)"
    )
    channels: dict[str, tuple[str, ...]] = Field(
        default={},
        description=f"columns of {', '.join(column.name for column in CHANNELS)}: one for all fans, or one for each",
    )
    dates: str = Field(default="", description="order of dates that the table leaves open: dmy, mdy, ymd")
    zone: str = Field(default="", description="time zone of dates without one; without it, UTC")
    decimal: str = Field(default="", description="decimal mark that the table leaves open: . or ,")
    from_s: float = Field(default=0.0, ge=0.0, description="start, since the first row")
    to_s: float | None = Field(default=None, description="end, since the first row; without it, the last row")


class Scenario(Section):
    """What is simulated."""

    fans: int = Field(default=8, description="1 to 64")
    fan: Literal["dc", "4-pin"] = Field(default="dc", description="on a bridge, or with a PWM input of its own")
    rate_hz: float | None = Field(
        default=None, description="samples per second, or how often the files of `--hwmon` are written; 100, or 20"
    )
    profile: str = Field(
        default="manual", description="commands: staircase, prbs, multisine, chirp, manual, thermostat"
    )
    seed: int = Field(default=1, description="of commands, noise, jitter and losses")
    duration_s: float | None = Field(default=None, description="without it, until Ctrl-C")
    faults: tuple[str, ...] = Field(default=(), description="such as `inlet:fan=2,start=10,stop=18,size=1.6`")
    fan_variation: float = Field(default=0.03, description="between fans, relative standard deviation")
    fans_seed: int = Field(default=1, description="of the variation between fans")
    tacho: Tachos = Field(default=INSTANTANEOUS, description="one for all fans, or a list with one for each")
    noise_rad_s: float = Field(default=4.0, description="standard deviation of an instantaneous reading")
    missing_edges: float = Field(default=0.0, description="share of pulses that are not seen")
    double_edges: float = Field(default=0.0, description="share of pulses that are seen twice")
    missing_readings: float = Field(default=0.0, description="share of readings that are missing")
    lost: float = Field(default=0.0, description="share of samples that are lost")
    jitter_us: float = Field(default=100.0, description="standard deviation of the time of sampling")
    clock: ClockScenario = ClockScenario()
    surroundings: SurroundingsScenario = SurroundingsScenario()
    protocol: wire.Protocol = Field(default="binary", description="form of the wire protocol on the line")
    speed_unit: SpeedUnit = Field(default="rad/s", description="unit of speed on the line")
    chip: str = Field(default="nct6798", description="chip of `--hwmon`: it determines how its driver measures speeds")
    epoch_ns: int | None = Field(default=None, description="start of a recording, ns since 1970; without it, now")
    file: FileScenario | None = None

    def table(self) -> TableDevice | None:
        """The file that is played, if one is.

        Raises:
            UserError: it cannot be read.
        """
        if (file := self.file) is None:
            return None
        names = [column.name for column in CHANNELS]
        if unknown := [name for name in file.channels if name not in names]:
            raise UsageError(f"file.channels.{unknown[0]}: known are {', '.join(names)}")
        channels = {name: list(columns) for name, columns in file.channels.items()}
        how = (file.dates, file.zone, file.decimal)
        wanted = Wanted(file.command, file.speed, file.time, file.period, channels, *how)
        table = read_file(file.path, wanted)
        return TableDevice(table, file.from_s, math.inf if file.to_s is None else file.to_s)

    def tray(self, tachos: tuple[Tacho, ...], rate_hz: float) -> SimulatedTray:
        """The simulated tray, with these tachos at this rate.

        Raises:
            UsageError: a setting is out of range, or a fault cannot be parsed.
        """
        from fantwin.simulation.errors import SimulationError  # noqa: PLC0415  loaded only by the commands that need it
        from fantwin.simulation.faults import parse_fault  # noqa: PLC0415
        from fantwin.simulation.plant import DeviceClock, Surroundings  # noqa: PLC0415
        from fantwin.simulation.tacho import NoisyTacho, TachoSettings  # noqa: PLC0415
        from fantwin.simulation.tray import SimulatedTray, TraySettings  # noqa: PLC0415

        given = self.model_dump()
        shares = {name: given[name] for name in ("missing_edges", "double_edges", "missing_readings")}
        same = ("fans", "fan", "profile", "seed", "fans_seed", "fan_variation", "lost", "jitter_us")
        try:
            return SimulatedTray(
                TraySettings(
                    **{name: given[name] for name in same},
                    rate_hz=rate_hz,
                    duration_s=math.inf if self.duration_s is None else self.duration_s,
                    faults=tuple(map(parse_fault, self.faults)),
                    tacho=TachoSettings(tachos, NoisyTacho(self.noise_rad_s), **shares),
                    clock=DeviceClock(**given["clock"]),
                    surroundings=Surroundings(**given["surroundings"]),
                )
            )
        except SimulationError as error:
            raise UsageError(str(error)) from error


def read_scenario(path: Path | None, overrides: Sequence[str], options: dict[str, Any]) -> Scenario:
    """The scenario of a file, changed by `--set` and by options, of which None is not given.

    The path of a measured file starts at the folder of the scenario.

    Raises:
        UserError: the file cannot be read, or a key or value is wrong.
    """
    table: dict[str, Any] = {}
    if path:
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise UserError(f"{path}: cannot read the scenario: {error.strerror}") from error
        except ValueError as error:
            raise UserError(f"{path}: not valid TOML: {error}") from error
    for override in overrides:
        set_key(table, override)
    table |= {key: value for key, value in options.items() if value is not None}
    found = checked_section(Scenario, table, path or UNNAMED, "", overrides)
    if path is None or found.file is None:
        return found
    return found.model_copy(update={"file": found.file.model_copy(update={"path": path.parent / found.file.path})})
