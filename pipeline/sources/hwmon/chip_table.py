"""Particularities of the chips behind /sys/class/hwmon: one row each, with the kernel's document or source.

The rows say what `fanN_input` is of the speed, and what a program has to know to set `pwmN`. A chip that is not here is
read all the same: what its readings are is then not known, and they count as instantaneous unless `tacho` says more.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from fantwin.schemas.tacho import REVOLUTION_S, Tacho


@dataclass(frozen=True)
class Chip:
    """A row of the table.

    Attributes:
        pattern: of `name` in the folder of the chip, a regular expression.
        source: the file of the kernel that says it (Documentation/hwmon, or the driver).
        tacho: what a reading is; None where the source does not say.
        note: what else to know, for `fantwin init`.
        pwm_is_known_after_write: `pwmN` reads 0 until a program has set it.
        automatic: what is written to `pwmN_enable` to give the fan back, where that file cannot be read.
        pwm_is_command_in: contents of `pwmN_enable` with which `pwmN` is the command in force; empty: with all.
        lowest_rpm: below it, `fanN_input` is 0.
    """

    pattern: str
    source: str
    tacho: Tacho | None = None
    note: str = ""
    pwm_is_known_after_write: bool = False
    automatic: int | None = None
    pwm_is_command_in: tuple[int, ...] = ()
    lowest_rpm: int | None = None


def _held(update_s: float) -> Tacho:
    """The time of about one revolution, read again after update_s."""
    return Tacho(kind="average", window_s=REVOLUTION_S, update_s=update_s)


CHIPS: tuple[Chip, ...] = (
    Chip(
        "pwmfan",
        "drivers/hwmon/pwm-fan.c",
        Tacho(kind="count", pulses=2, window_s=1.0),
        "counts pulses for one second; pulses-per-revolution of the device tree is taken as 2",
    ),
    Chip(
        "nct668[367]",
        "drivers/hwmon/nct6683.c",
        _held(1.0),
        "the driver reads the chip every second at most; over how long its firmware averages is not known",
    ),
    Chip("nct6[17][0-9]+", "drivers/hwmon/nct6775-core.c", _held(1.5), "the driver reads the chip every 1.5 s at most"),
    Chip(
        "it87|it87(05|12|16|18|20)|it878[123]|sis950",
        "drivers/hwmon/it87.c",
        _held(1.5),
        "the driver reads the chip every 1.5 s at most; chips without 16-bit counters read no speed below about 2,600 "
        "rpm at a divider of 2; in automatic mode pwm is the last one that was set, not the one in force",
        pwm_is_command_in=(0, 1),
    ),
    Chip(
        "it8[0-9]+",
        "Documentation/hwmon/it87.rst",
        _held(1.5),
        "the driver reads the chip every 1.5 s at most",
    ),
    Chip(
        "emc230[1235]",
        "drivers/hwmon/emc2305.c",
        _held(REVOLUTION_S),
        "with thermal zones the kernel may keep a higher pwm than the one written",
        lowest_rpm=960,
    ),
    Chip(
        "max31790",
        "drivers/hwmon/max31790.c",
        _held(1.0),
        "the driver reads the chip every second at most; a fan that stands reads some hundred rpm, with fan_fault",
    ),
    Chip(
        "nzxtsmart2",
        "Documentation/hwmon/nzxt-smart2.rst",
        _held(1.0),
        "measures every update_interval (1000 ms, at least 250); it gives voltage and current of each fan",
    ),
    Chip(
        "aspeed_pwm_tacho",
        "drivers/hwmon/aspeed-pwm-tacho.c",
        _held(REVOLUTION_S),
        "each read waits for a measurement",
    ),
    Chip(
        "corsaircpro",
        "Documentation/hwmon/corsair-cpro.rst",
        note="pwm reads 0 until a program has set it: set it once, then it is known",
        pwm_is_known_after_write=True,
    ),
    Chip(
        "dell_smm",
        "Documentation/hwmon/dell-smm-hwmon.rst",
        note="the BIOS may set the speed again within seconds; pwm has three or four levels; pwm1_enable is for all "
        "fans and cannot be read; a read may take half a second",
        automatic=2,
    ),
    Chip(
        "thinkpad",
        "Documentation/admin-guide/laptops/thinkpad-acpi.rst",
        note="pwm has eight levels, and is the command in manual mode only; writing needs the module parameter "
        "fan_control=1; readings may go stale for two minutes while the fan goes to full speed",
        pwm_is_command_in=(1,),
    ),
    Chip("amdgpu", "drivers/gpu/drm/amd/pm/amdgpu_pm.c", note="automatic mode may stop the fan"),
    Chip(
        "applesmc",
        "drivers/hwmon/applesmc.c",
        note="fanN_output is the speed that is wanted, set by the computer itself unless fanN_manual is 1; a fan that "
        "is late to follow it is what can be found",
    ),
)


def chip_of(name: str) -> Chip | None:
    """The row of a chip, by its `name`; None if it has none."""
    return next((chip for chip in CHIPS if re.fullmatch(chip.pattern, name)), None)
