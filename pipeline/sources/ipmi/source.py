"""Fans of a server by IPMI: `ipmitool sdr type Fan`, run for each reading.

The descriptions of the sensors are read once, when it connects, and kept in a file, because reading them takes most of
the time of a request. Only a reading in rpm is a speed and only one in per cent a command. The password is in a file
that ipmitool reads, and never on a command line. Nothing is written.
"""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from fantwin.pipeline.errors import refusals
from fantwin.pipeline.sources.ipmi.config import HERE, IpmiConfig
from fantwin.pipeline.sources.named_values import COMMAND, SPEED, NamedValuesSource
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.channels import CURRENT, SUPPLY_VOLTAGE, TEMPERATURE

PROGRAM = "ipmitool"
TIMEOUT_S = 20.0
"""longest wait for a reading; the descriptions of a slow controller take ten times as long"""
RPM = "RPM"
_KINDS = {
    SPEED: ("Fan", RPM),
    COMMAND: ("Fan", "percent"),
    SUPPLY_VOLTAGE: ("Voltage", "Volts"),
    CURRENT: ("Current", "Amps"),
    TEMPERATURE: ("Temperature", "degrees C"),
}
"""type of the sensor, as ipmitool calls it, and its unit"""
_NO_DRIVER = "Could not open device"


class Sensor(NamedTuple):
    """A line of `ipmitool sdr type`. value: NaN without a reading, which has no unit, either."""

    name: str
    number: str
    value: float
    unit: str


class IpmiSource(NamedValuesSource):
    """A `SampleSource`."""

    def __init__(self, config: IpmiConfig, context: SourceContext) -> None:
        """Read nothing yet."""
        super().__init__(config, context)
        self._config = config
        self._kept: TemporaryDirectory[str] | None = None

    @property
    def name(self) -> str:
        """The controller."""
        return f"ipmi {self._config.host}"

    def connect(self) -> None:
        """Keep the descriptions of the sensors."""
        self._config.password(self._folder)
        self._kept = TemporaryDirectory(prefix="fantwin-ipmi-")
        self._ran("sdr", "dump", str(self._descriptions), timeout_s=10.0 * TIMEOUT_S)

    def read(self) -> Reading:
        """Speeds, commands and channels of the fans."""
        wanted = {column: self.names(column) for column in _KINDS}
        kinds = dict.fromkeys(kind for column, (kind, _) in _KINDS.items() if wanted[column])
        sensors = [each for kind in kinds for each in self.sensors(kind)]
        values: dict[str, float] = {}
        for column, names in wanted.items():
            for name in names:
                found = _found(sensors, name)
                if found.unit not in ("", unit := _KINDS[column][1]):
                    raise DeviceError(f"sensor {name!r} is in {found.unit}, not in {unit}: correct source.fan")
                values[name] = found.value
        return self.reading(values)

    def disconnect(self) -> None:
        """Remove what was kept."""
        kept, self._kept = self._kept, None
        if kept:
            kept.cleanup()

    def check(self) -> list[str]:
        """Problems before the start: there is no ipmitool, or the password cannot be read."""
        found = refusals(lambda: self._config.password(self._folder))
        return found if shutil.which(PROGRAM) else [*found, _NO_PROGRAM]

    @property
    def _descriptions(self) -> Path:
        assert self._kept
        return Path(self._kept.name) / "sdr"

    def sensors(self, kind: str) -> list[Sensor]:
        """The sensors of a kind. Raises DeviceError."""
        return sensors_of(self._ran("sdr", "type", kind, timeout_s=TIMEOUT_S))

    def _ran(self, *words: str, timeout_s: float) -> str:
        """What ipmitool prints. Raises DeviceError."""
        config = self._config
        line = [PROGRAM, "-I", "open"]
        if config.url != HERE:
            line = [PROGRAM, "-I", "lanplus", "-H", config.host, "-p", str(config.port), "-U", config.username]
            line += ["-N", "1", "-R", "2", "-f", str(config.password_path(self._folder)), "-L", "USER"]
            line += ["-C", str(config.cipher)] if config.cipher is not None else []
        line += ["-S", str(self._descriptions)] if self._descriptions.exists() else []
        try:
            done = subprocess.run(
                [*line, *words], stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s, check=False
            )
        except FileNotFoundError as error:
            raise DeviceError(_NO_PROGRAM, is_lost=True) from error
        except (OSError, subprocess.TimeoutExpired) as error:
            why = f"does not answer within {timeout_s:g} s" if isinstance(error, subprocess.TimeoutExpired) else error
            raise DeviceError(f"it {why}; waiting for it", is_lost=True) from error
        said = done.stderr.decode(errors="replace").strip().splitlines()
        if done.returncode and not done.stdout.strip():
            reason = said[-1] if said else f"exit code {done.returncode}"
            if any(_NO_DRIVER in each for each in said):
                reason += "; load the driver (modprobe ipmi_devintf ipmi_si), run as root"
            raise DeviceError(f"{reason}; check source.url, user and password", is_lost=True)
        return done.stdout.decode(errors="replace")


_NO_PROGRAM = "source ipmi needs the program ipmitool: install the package ipmitool of the system"


def sensors_of(text: str) -> list[Sensor]:
    """The sensors that `ipmitool sdr type` prints: `FAN1 | 41h | ok | 29.1 | 3400 RPM`."""
    found: list[Sensor] = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) < 5:
            continue
        number, _, unit = cells[-1].partition(" ")
        try:
            found.append(Sensor(cells[0], cells[1], float(number), unit))
        except ValueError:  # "No Reading", "Disabled", the words of a state
            found.append(Sensor(cells[0], cells[1], math.nan, ""))
    return found


def _found(sensors: Sequence[Sensor], name: str) -> Sensor:
    """The sensor of a name or id. Raises DeviceError: there is none, or more than one."""
    found = [each for each in sensors if name in (each.number, each.name)]
    if len(found) == 1:
        return found[0]
    there = ", ".join(f"{each.name} ({each.number})" for each in found or sensors) or "none"
    raise DeviceError(f"{'several sensors' if found else 'no sensor'} {name!r}: {there}; write the id of one")
