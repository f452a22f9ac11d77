"""What sets the speed of a fan: a pwm, or a wanted speed in rpm, of the chip of its tacho or of another one."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from functools import cached_property

from fantwin.pipeline.sources.hwmon.chip_folder import ChipFolder
from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.polling import DeviceError

MANUAL = 1
"""content of the file of the mode for commands by a program"""
HIGHEST_PWM = 255
MAY_WRITE = "run as root, or give it this group by a udev rule"
DRIVE = r"(.+/)?(pwm\d{1,2}|fan\d{1,2}_(output|target))"
"""CHIP/FILE, or FILE of the chip of the tachos"""


@dataclass(frozen=True)
class Drive:
    """A file that takes commands: pwmN, 0 to 255, or fanN_output or fanN_target, rpm."""

    chip: ChipFolder
    file: str

    @cached_property
    def is_pwm(self) -> bool:
        """False where it is a speed."""
        return self.file.startswith("pwm")

    @cached_property
    def mode_file(self) -> str:
        """The file that says who drives; empty if the chip has none."""
        fan = self.file.partition("_")[0]
        names = (f"{self.file}_enable",) if self.is_pwm else (f"{fan}_manual", f"{fan}_enable")
        return next((name for name in names if (self.chip.path / name).exists()), "")

    @property
    def name(self) -> str:
        """Name for people and files: the chip and its file."""
        return f"{self.chip.name}/{self.file}"

    def value(self) -> int:
        """The command that the chip shows. Raises OSError."""
        return self.chip.number(self.file)

    def mode(self) -> int | None:
        """Content of the file of the mode; None if there is none, or it cannot be read."""
        try:
            return self.chip.number(self.mode_file) if self.mode_file else None
        except OSError:
            return None

    def why_no_command(self) -> str:
        """Why what the chip shows is not the command in force; empty if it is."""
        mode = self.mode()
        if self.file.endswith("_target") and mode == 0 and self.mode_file.endswith("_enable"):
            return f"{self.name} is not in force: {self.mode_file} is 0"
        chip = chip_of(self.chip.name)
        if not (self.is_pwm and chip and chip.pwm_is_command_in) or mode is None or mode in chip.pwm_is_command_in:
            return ""
        return f"in automatic mode ({self.mode_file} is {mode}) {self.name} is not the command ({chip.source})"

    def write(self, value: int) -> None:
        """Command. Raises DeviceError."""
        write_number(self.chip, self.file, min(max(value, 0), HIGHEST_PWM) if self.is_pwm else max(value, 0))

    def take_over(self) -> None:
        """Make it manual. Raises DeviceError, also where the chip then still says otherwise."""
        if not self.mode_file or self.mode() == MANUAL:
            return
        write_number(self.chip, self.mode_file, MANUAL)
        if (mode := self.mode()) not in (None, MANUAL):
            raise DeviceError(
                f"{self.chip.name}/{self.mode_file} remains {mode} after {MANUAL} (manual) was written: the firmware "
                "keeps the fan; switch its fan control off in the setup of the board (BIOS)"
            )


def drive_of(words: str, chip: ChipFolder, chips: list[ChipFolder]) -> Drive:
    """The drive that a configuration names. chip: of the tachos. Raises DeviceError where there is no such chip."""
    wanted, _, file = words.rpartition("/")
    if not wanted:
        return Drive(chip, file)
    there = [each for each in chips if each.is_called(wanted)]
    if len(there) != 1:
        names = ", ".join(dict.fromkeys(each.name for each in chips)) or "none"
        raise DeviceError(f"{len(there) or 'no'} chips are called {wanted}; there are: {names}; correct pwms")
    return Drive(there[0], file)


def set_point_of(chip: ChipFolder, fan: int) -> str:
    """The file with the wanted speed of a fan, rpm; empty if there is none."""
    return next((f for f in (f"fan{fan}_output", f"fan{fan}_target") if (chip.path / f).exists()), "")


def lacking(drive: Drive) -> str:
    """The line for a drive that is not there, with what to name instead."""
    if not drive.is_pwm or drive.chip.pwms:
        return f"{drive.chip.name} has no {drive.file}: correct pwms"
    instead = [file for fan in drive.chip.fans if (file := set_point_of(drive.chip, fan))]
    what = f"its set-points in rpm, pwms = {instead}" if instead else "what drives its fans in pwms (CHIP/pwm1)"
    return f"{drive.chip.name} has no pwm: name {what}"


def write_number(chip: ChipFolder, file: str, value: int) -> None:
    """Write a file of a chip. Raises DeviceError."""
    path = chip.path / file
    try:
        path.write_text(str(value), encoding="ascii")
    except OSError as error:
        remedy = f"; {MAY_WRITE}" if error.errno in (errno.EACCES, errno.EPERM) else ""
        raise DeviceError(f"{path} cannot be written: {error.strerror}{remedy}") from error
