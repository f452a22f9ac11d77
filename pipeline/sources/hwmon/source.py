"""Fans of this computer as a source of samples: the chips of /sys/class/hwmon, read as files.

The chip is found by its name and its device, each time it is connected: hwmonN changes from boot to boot, and when a
driver is loaded again. A file that cannot be read is NaN; a chip that goes away is a LinkDown.

How a drive was found is kept in a file before it is written for the first time, until it has been given back: after a
process that was killed, the next one finds it manual and would otherwise leave it so.

Firmware and other programs take fans back, for example when the computer wakes up. The mode is checked at each poll,
which only says so, as the firmware may have done it against heat; and at each command, which makes it manual again.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import replace_file
from fantwin.pipeline.sources.hwmon.chip_folder import ChipFolder, chip_folders, chip_words
from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.hwmon.drive import HIGHEST_PWM, MANUAL, MAY_WRITE, Drive, drive_of, lacking, write_number
from fantwin.pipeline.sources.polling import DeviceError, PollingSource
from fantwin.pipeline.sources.source import Reading, Rejected, SourceContext
from fantwin.schemas.channels import CURRENT, SUPPLY_VOLTAGE, TEMPERATURE

_Each = TypeVar("_Each")


class FoundDrive(BaseModel, frozen=True):
    """How a drive was found. mode: None if it has none. value: None if it could not be read."""

    chip: str
    device: str
    file: str
    mode: int | None
    value: int | None

    def is_of(self, drive: Drive) -> bool:
        """Whether it is of this drive."""
        return (self.chip, self.device, self.file) == (drive.chip.name, drive.chip.device, drive.file)


class FoundDrives(BaseModel, frozen=True):
    """Drives before fantwin wrote them, as a file keeps them for a later process.

    The file is there as long as something has to be given back.
    """

    drives: tuple[FoundDrive, ...]


class _Commanded:
    """What was written to a drive, and what it has shown since."""

    def __init__(self, value: int) -> None:
        self.value = value
        self.settled: int | None = None
        """what two polls have shown one after the other"""
        self.last: int | None = None
        self.is_taken_back = False


NO_MEASUREMENT_RPM = 0xFFFF
"""all bits of a register: drivers pass it on where the chip has not measured (thinkpad)"""
LARGEST_ROUNDING = 43
"""of a pwm, by a chip with four levels"""
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
        pwms = _of_each_fan("pwms", config.pwms, fans) or fans
        self._drive_names = tuple(f"pwm{each}" if isinstance(each, int) else each for each in pwms)
        self._drives: tuple[Drive, ...] = ()
        self._scales = _of_each_fan("speed_scales", config.speed_scales, fans) or (1.0,) * len(fans)
        self._temperatures = _of_each_fan("temperatures", config.temperatures, fans)
        self._voltages = _of_each_fan("voltages", config.voltages, fans)
        self._currents = _of_each_fan("currents", config.currents, fans)
        self._chip: ChipFolder | None = None
        self._drives_file = context.run_folder / f"hwmon-{context.tray}.json" if context.run_folder else None
        self._before: dict[Drive, FoundDrive] = {}
        """each drive before it was written, also by a process that was killed"""
        self._commanded: dict[Drive, _Commanded] = {}

    @property
    def name(self) -> str:
        """The chip as the configuration names it."""
        return self._config.chip

    @property
    def settings_to_check(self) -> str:
        """Settings that may be wrong."""
        return f"chip = {self._config.chip!r}"

    def connect(self) -> None:
        """Find the chip, and the drives of its fans."""
        self._chip, self._drives = self._find()
        # What is not manual any more has been given back, or the driver was loaded again.
        kept = self._kept_drives()
        self._before = {
            drive: found
            for drive in dict.fromkeys(self._drives)
            for found in kept
            if found.is_of(drive) and drive.mode() in (None, MANUAL)
        }
        self._commanded = {}

    def read(self) -> Reading | Rejected:
        """Speeds, commands and what else is asked for."""
        chip = self._connected()
        speed = tuple(self._speed(chip, fan, scale) for fan, scale in zip(self._fans, self._scales, strict=True))
        whys: list[str] = []
        values = {drive: self._command(drive, whys) for drive in dict.fromkeys(self._drives)}
        if self._quirks and self._quirks.pwm_is_known_after_write and not self._commanded and not any(values.values()):
            whys = [f"pwm of {chip.name} reads 0 until a program has set it: set it once"]
            values = dict.fromkeys(values, math.nan)
        if whys and all(map(math.isnan, values.values())):
            return Rejected("unknown_command", whys[0], is_sample=True, setting="source.pwms and writable")
        for why in whys:
            self.note("unknown_drives", why)
        return Reading(
            command=tuple(values[drive] for drive in self._drives),
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
        """Command drives, each after it is manual."""
        self._connected()
        wanted: dict[Drive, int] = {}
        for drive, value in zip(self._drives, command, strict=True):
            if math.isnan(value):
                continue
            rounded = round(value)
            if wanted.setdefault(drive, rounded) != rounded:
                raise DeviceError(
                    f"{drive.file} moves several fans: give them one command, not {wanted[drive]} and {rounded}"
                )
        for drive, value in wanted.items():
            self._take_over(drive)
            drive.write(value)
            self._commanded[drive] = _Commanded(value)

    def disconnect(self) -> None:
        """Give the fans that were commanded back to whatever drove them."""
        before, self._before, self._chip, self._commanded = self._before, {}, None, {}
        failures = []
        for drive, found in before.items():
            try:
                if found.mode not in (MANUAL, None):
                    write_number(drive.chip, drive.mode_file, found.mode)
                elif found.value is not None or drive.is_pwm:
                    drive.write(HIGHEST_PWM if found.value is None else found.value)
            except DeviceError as error:
                failures.append(str(error))
        if failures:
            raise DeviceError("; ".join(failures))
        if before and self._drives_file:  # kept until all of it was given back
            self._drives_file.unlink(missing_ok=True)

    def check(self) -> list[str]:
        """Problems before the start: what is not there, or may not be read or written."""
        try:
            chip, drives = self._find()
        except DeviceError as error:
            return [str(error)]
        found: list[str] = []
        for kind, suffix, numbers in self._files():
            there = chip.numbers(kind, suffix)
            found += [
                f"{chip.name} has no {kind}{number}{suffix}: correct {_SETTING[kind]}"
                for number in dict.fromkeys(numbers)
                if number not in there
            ]
        for drive in dict.fromkeys(drives):
            path = drive.chip.path / drive.file
            if not path.exists():
                found.append(lacking(drive))
            elif self._config.writable and not os.access(path, os.W_OK):
                found.append(f"{path}: this user may not write it; {MAY_WRITE}")
        return found

    def _files(self) -> tuple[tuple[str, str, Sequence[int]], ...]:
        return (
            ("fan", "_input", self._fans),
            ("temp", "_input", self._temperatures),
            ("in", "_input", self._voltages),
            ("curr", "_input", self._currents),
        )

    def _find(self) -> tuple[ChipFolder, tuple[Drive, ...]]:
        """The chip, and the drive of each fan, which may not be there."""
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
        return found[0], tuple(drive_of(name, found[0], chips) for name in self._drive_names)

    def _connected(self) -> ChipFolder:
        """The chip, if the folders are still those of these chips: a driver that is loaded again may take another
        number."""
        chip = self._chip
        assert chip is not None
        for each in dict.fromkeys((chip, *(drive.chip for drive in self._drives))):
            try:
                name = (each.path / "name").read_text(encoding="utf-8", errors="replace").strip()
            except OSError as error:
                raise DeviceError(f"{each.name} has gone ({error.strerror}); waiting for it", is_lost=True) from error
            if name != each.name:
                raise DeviceError(f"{each.path.name} is {name} now, no longer {each.name}", is_lost=True)
        return chip

    def _command(self, drive: Drive, whys: list[str]) -> float:
        """The command in force; NaN where it is not known, for the reason that is added to whys."""
        try:
            value = drive.value()
        except FileNotFoundError as error:
            raise DeviceError(lacking(drive), is_lost=True) from error
        except OSError as error:
            whys.append(f"{drive.name} cannot be read: {error.strerror}")
            return math.nan
        self._follow(drive, value)
        if why := drive.why_no_command():
            whys.append(why)
            return math.nan
        return float(value)

    def _follow(self, drive: Drive, value: int) -> None:
        """Say what something else has done to a drive since its last command."""
        commanded = self._commanded.get(drive)
        if commanded is None:
            return
        if (mode := drive.mode()) not in (None, MANUAL):
            if not commanded.is_taken_back:
                self.note("taken_back", f"{drive.name}: mode {mode} instead of manual; the next command sets it again")
            commanded.is_taken_back = True
        elif value == commanded.last and value != commanded.settled:  # a chip may need a poll to show what it was told
            was = commanded.value if commanded.settled is None else commanded.settled
            if commanded.settled is not None or (drive.is_pwm and abs(value - was) > LARGEST_ROUNDING):
                self.note("changed_by_others", f"{drive.name} shows {value} after the command {commanded.value}")
            commanded.settled = value
        commanded.last = value

    def _speed(self, chip: ChipFolder, number: int, scale: float) -> float:
        rpm = _value(chip, f"fan{number}_input", 1.0)
        if rpm >= NO_MEASUREMENT_RPM:
            self.note("no_measurement", f"fan{number}_input is {rpm:.0f}, which is no measurement")
            return math.nan
        # What the chip itself calls faulty is no measurement, but a fan that stands may well be a fault.
        if rpm > 0.0 and _value(chip, f"fan{number}_fault", 1.0) > 0.0:
            return math.nan
        return rpm * scale * self._units_per_rpm

    def _take_over(self, drive: Drive) -> None:
        """Make a drive manual, after it is kept how it was found."""
        mode = drive.mode()
        if drive not in self._before:
            automatic = self._quirks.automatic if self._quirks else None
            try:
                value = drive.value()
            except OSError:
                value = None
            found = FoundDrive(
                chip=drive.chip.name,
                device=drive.chip.device,
                file=drive.file,
                mode=automatic if drive.mode_file and mode is None else mode,
                value=value,
            )
            self._keep_drives((*self._before.values(), found))
            self._before[drive] = found
        elif mode not in (None, MANUAL) and not self._is_known_to_be_taken_back(drive):
            self.note("taken_back", f"{drive.name}: mode {mode} instead of manual, set to manual again")
        drive.take_over()

    def _is_known_to_be_taken_back(self, drive: Drive) -> bool:
        commanded = self._commanded.get(drive)
        return commanded is not None and commanded.is_taken_back

    def _kept_drives(self) -> tuple[FoundDrive, ...]:
        """Drives that an earlier process has not given back."""
        try:
            return FoundDrives.model_validate_json(self._drives_file.read_bytes()).drives if self._drives_file else ()
        except (OSError, ValidationError):
            return ()

    def _keep_drives(self, drives: tuple[FoundDrive, ...]) -> None:
        if self._drives_file:
            try:
                replace_file(self._drives_file, FoundDrives(drives=drives).model_dump_json().encode())
            except OSError as error:
                raise DeviceError(f"the modes of pwms cannot be kept in run_folder: {error.strerror}") from error


_SETTING = {"fan": "fans", "temp": "temperatures", "in": "voltages", "curr": "currents"}


def _of_each_fan(setting: str, numbers: Sequence[_Each], fans: Sequence[int]) -> tuple[_Each, ...]:
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
