"""Fans of this computer as a source of samples: the chips of /sys/class/hwmon, read as files.

The chip is found by its name and its device, each time it is connected: hwmonN changes from boot to boot, and when a
driver is loaded again. A file that cannot be read is NaN; a chip that goes away is a LinkDown.

How a pwm was found is kept in a file before it is written for the first time, until it has been given back: after a
process that was killed, the next one finds it manual and would otherwise leave it so.
"""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Sequence

from pydantic import BaseModel, ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import replace_file
from fantwin.pipeline.sources.hwmon.chip_folder import ChipFolder, chip_folders, chip_words
from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.polling import DeviceError, PollingSource
from fantwin.pipeline.sources.source import Reading, Rejected, SourceContext
from fantwin.schemas.channels import CURRENT, SUPPLY_VOLTAGE, TEMPERATURE


class FoundPwm(BaseModel, frozen=True):
    """mode: pwmN_enable, None if there is none. pwm: 0 to 255, None if it could not be read."""

    mode: int | None
    pwm: int | None


class FoundModes(BaseModel, frozen=True):
    """Modes of the pwms of a chip before fantwin wrote them, as a file keeps them for a later process.

    The file is there as long as something has to be given back.
    """

    chip: str
    device: str
    pwms: dict[int, FoundPwm]


MANUAL = 1
"""value of pwmN_enable for commands by a program"""
HIGHEST_PWM = 255
HOTTEST_C = 127
"""a sensor that is not connected reads more (Documentation/hwmon/dell-smm-hwmon.rst)"""


class HwmonSource(PollingSource):
    """A `SampleSource`."""

    def __init__(self, config: HwmonConfig, context: SourceContext) -> None:
        """Raises UserError if the numbers do not fit the fans of the tray."""
        super().__init__(config, config.period_s)
        self._config = config
        self._root = context.folder / config.root
        self._quirks = chip_of(config.chip_name)
        self._units_per_rpm = context.units_per_rpm
        fans = config.fans or tuple(range(1, context.fans + 1))
        if len(fans) != context.fans:
            raise UserError(f"fans = {context.fans}, and source.fans names {len(fans)}: give the same number")
        self._fans = fans
        self._pwms = _of_each_fan("pwms", config.pwms, fans) or fans
        self._temperatures = _of_each_fan("temperatures", config.temperatures, fans)
        self._voltages = _of_each_fan("voltages", config.voltages, fans)
        self._currents = _of_each_fan("currents", config.currents, fans)
        self._chip: ChipFolder | None = None
        self._modes_file = context.run_folder / f"hwmon-{context.tray}.json" if context.run_folder else None
        self._before: dict[int, FoundPwm] = {}
        """mode of each pwm before it was written, also by a process that was killed"""
        self._written = False

    @property
    def name(self) -> str:
        """The chip as the configuration names it."""
        return self._config.chip

    @property
    def settings_to_check(self) -> str:
        """Settings that may be wrong."""
        return f"chip = {self._config.chip!r}"

    def connect(self) -> None:
        """Find the chip."""
        self._chip = chip = self._find()
        # What is not manual any more has been given back, or the driver was loaded again.
        kept = self._kept_modes(chip).items()
        self._before = {number: found for number, found in kept if self._mode(chip, number) in (None, MANUAL)}

    def read(self) -> Reading | Rejected:
        """Speeds, pwm values and what else is asked for."""
        chip = self._connected()
        pwm = {number: self._pwm(chip, number) for number in dict.fromkeys(self._pwms)}
        speed = tuple(self._speed(chip, number) for number in self._fans)
        if self._quirks and self._quirks.pwm_is_known_after_write and not self._written and not any(pwm.values()):
            return Rejected(
                "unknown_command",
                f"pwm of {chip.name} reads 0 until a program has set it: set it once",
                is_sample=True,
                setting="writable",
            )
        return Reading(
            command=tuple(float(pwm[number]) for number in self._pwms),
            speed=speed,
            measured={name: values for name, values in self._measured(chip).items() if values},
        )

    def _measured(self, chip: ChipFolder) -> dict[str, tuple[float, ...]]:
        """Values by name of channel; empty where it has no file."""
        scale = 1e-3 * self._config.voltage_scale
        return {
            SUPPLY_VOLTAGE: tuple(_value(chip, f"in{number}_input", scale) for number in self._voltages),
            CURRENT: tuple(_value(chip, f"curr{number}_input", 1e-3) for number in self._currents),
            TEMPERATURE: tuple(_temperature_c(chip, number) for number in self._temperatures),
        }

    def write(self, command: tuple[float, ...]) -> None:
        """Set pwm values, after `pwmN_enable` is manual."""
        chip = self._connected()
        wanted: dict[int, int] = {}
        for number, value in zip(self._pwms, command, strict=True):
            if math.isnan(value):
                continue
            pwm = min(max(round(value), 0), HIGHEST_PWM)
            if wanted.setdefault(number, pwm) != pwm:
                raise DeviceError(
                    f"pwm{number} moves several fans: give them one command, not {wanted[number]} and {pwm}"
                )
        for number, pwm in wanted.items():
            self._take_over(chip, number)
            _write(chip, f"pwm{number}", pwm)
            self._written = True

    def disconnect(self) -> None:
        """Give the fans that were commanded back to whatever drove them."""
        chip, before = self._chip, self._before
        self._chip, self._before = None, {}
        failures = []
        for number, found in before.items():
            assert chip is not None
            try:
                if found.mode == MANUAL or found.mode is None:
                    _write(chip, f"pwm{number}", HIGHEST_PWM if found.pwm is None else found.pwm)
                if found.mode not in (None, MANUAL):
                    _write(chip, f"pwm{number}_enable", found.mode)
            except DeviceError as error:
                failures.append(str(error))
        if failures:
            raise DeviceError("; ".join(failures))
        if before and self._modes_file:  # kept until all of it was given back
            self._modes_file.unlink(missing_ok=True)

    def check(self) -> list[str]:
        """Problems before the start: what is not there, or may not be read or written."""
        try:
            chip = self._find()
        except DeviceError as error:
            return [str(error)]
        found: list[str] = []
        for kind, suffix, numbers in self._files():
            lacking = [number for number in dict.fromkeys(numbers) if number not in chip.numbers(kind, suffix)]
            found += [f"{chip.name} has no {kind}{number}{suffix}: correct {_SETTING[kind]}" for number in lacking]
        for number in dict.fromkeys(self._pwms) if self._config.writable else ():
            if not os.access(chip.path / f"pwm{number}", os.W_OK):
                found.append(f"{chip.path / f'pwm{number}'}: this user may not write it; {_MAY_WRITE}")
        return found

    def _files(self) -> tuple[tuple[str, str, Sequence[int]], ...]:
        return (
            ("fan", "_input", self._fans),
            ("pwm", "", self._pwms),
            ("temp", "_input", self._temperatures),
            ("in", "_input", self._voltages),
            ("curr", "_input", self._currents),
        )

    def _find(self) -> ChipFolder:
        config = self._config
        try:
            chips = chip_folders(self._root)
        except OSError as error:
            raise DeviceError(f"{self._root}: {error.strerror}; correct root") from error
        found = [chip for chip in chips if chip.is_called(config.chip)]
        if len(found) > 1:
            names = ", ".join(repr(chip_words(chip, chips)) for chip in found)
            raise DeviceError(f"{len(found)} chips are called {config.chip}: name one by chip = {names}")
        if not found:
            there = ", ".join(dict.fromkeys(chip.name for chip in chips)) or "none"
            raise DeviceError(
                f"no chip is called {config.chip} in {self._root}; there are: {there}; load its driver, or "
                "see `fantwin init --hwmon -c NEW.toml`"
            )
        return found[0]

    def _connected(self) -> ChipFolder:
        """The chip, if its folder is still that of this chip: a driver that is loaded again may take another number."""
        chip = self._chip
        assert chip is not None
        try:
            name = (chip.path / "name").read_text(encoding="utf-8", errors="replace").strip()
        except OSError as error:
            raise DeviceError(f"{chip.name} has gone ({error.strerror}); waiting for it", is_lost=True) from error
        if name != chip.name:
            raise DeviceError(f"{chip.path.name} is {name} now, no longer {chip.name}", is_lost=True)
        return chip

    def _pwm(self, chip: ChipFolder, number: int) -> int:
        """Read a command, without which a reading is of no use."""
        try:
            return chip.number(f"pwm{number}")
        except FileNotFoundError as error:
            raise DeviceError(f"{chip.name} has no pwm{number}: correct pwms", is_lost=True) from error
        except OSError as error:
            raise DeviceError(f"pwm{number} of {chip.name} cannot be read: {error.strerror}") from error

    def _speed(self, chip: ChipFolder, number: int) -> float:
        rpm = _value(chip, f"fan{number}_input", 1.0)
        # What the chip itself calls faulty is no measurement, but a fan that stands may well be a fault.
        if rpm > 0.0 and _value(chip, f"fan{number}_fault", 1.0) > 0.0:
            return math.nan
        return rpm * self._units_per_rpm

    def _take_over(self, chip: ChipFolder, number: int) -> None:
        """Make a pwm manual, after it is kept how it was found."""
        enable, mode = chip.path / f"pwm{number}_enable", self._mode(chip, number)
        has_enable = enable.exists()
        if number not in self._before:
            automatic = self._quirks.automatic if self._quirks else None
            try:
                pwm = chip.number(f"pwm{number}")
            except OSError:
                pwm = None
            found = FoundPwm(mode=automatic if has_enable and mode is None else mode, pwm=pwm)
            self._keep_modes(chip, self._before | {number: found})
            self._before[number] = found
        if has_enable and mode != MANUAL:
            _write(chip, enable.name, MANUAL)

    def _kept_modes(self, chip: ChipFolder) -> dict[int, FoundPwm]:
        """Modes that an earlier process has not given back, by the number of the pwm."""
        try:
            found = FoundModes.model_validate_json(self._modes_file.read_bytes()) if self._modes_file else None
        except (OSError, ValidationError):
            return {}
        return found.pwms if found and (found.chip, found.device) == (chip.name, chip.device) else {}

    def _keep_modes(self, chip: ChipFolder, pwms: dict[int, FoundPwm]) -> None:
        if self._modes_file:
            found = FoundModes(chip=chip.name, device=chip.device, pwms=pwms)
            try:
                replace_file(self._modes_file, found.model_dump_json().encode())
            except OSError as error:
                raise DeviceError(f"the modes of pwms cannot be kept in run_folder: {error.strerror}") from error

    def _mode(self, chip: ChipFolder, number: int) -> int | None:
        """Content of pwmN_enable; None if there is no such file, or it cannot be read."""
        try:
            return chip.number(f"pwm{number}_enable")
        except OSError:
            return None


_SETTING = {"fan": "fans", "pwm": "pwms", "temp": "temperatures", "in": "voltages", "curr": "currents"}
_MAY_WRITE = "run as root, or give it this group by a udev rule"


def _of_each_fan(setting: str, numbers: Sequence[int], fans: Sequence[int]) -> tuple[int, ...]:
    if len(numbers) not in (0, 1, len(fans)):
        raise UserError(f"source.{setting} names {len(numbers)}: give one for all fans, or {len(fans)}")
    return tuple(numbers) * (len(fans) if len(numbers) == 1 else 1)


def _value(chip: ChipFolder, file: str, scale: float) -> float:
    """NaN where the driver gives none: ENODATA, EIO, EAGAIN and others say so."""
    try:
        return chip.number(file) * scale
    except OSError:
        return math.nan


def _temperature_c(chip: ChipFolder, number: int) -> float:
    value = _value(chip, f"temp{number}_input", 1e-3)
    return math.nan if value > HOTTEST_C else value


def _write(chip: ChipFolder, file: str, value: int) -> None:
    path = chip.path / file
    try:
        path.write_text(str(value), encoding="ascii")
    except OSError as error:
        remedy = f"; {_MAY_WRITE}" if error.errno in (errno.EACCES, errno.EPERM) else ""
        raise DeviceError(f"{path} cannot be written: {error.strerror}{remedy}") from error
