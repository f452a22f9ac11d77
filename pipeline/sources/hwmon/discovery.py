"""Discovery of the hwmon chips of this computer that have fans, each as a [[tray]]."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fantwin.pipeline.sources.found import Found, free_name
from fantwin.pipeline.sources.hwmon.chip_folder import ChipFolder, chip_folders, chip_words
from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.hwmon.config import ROOT
from fantwin.pipeline.sources.hwmon.drive import Drive, set_point_of
from fantwin.schemas.fan_names import is_fan_name

HIGHEST_RPM = 20_000


def discover_hwmon(root: Path = ROOT, *, writable: bool = False) -> Iterator[Found]:
    """The chips with fans, one by one: a read may take long. writable: their trays take commands.

    A tree that is not there has none, and says so.
    """
    try:
        chips = chip_folders(root)
    except OSError as error:
        what = "no such folder" if isinstance(error, FileNotFoundError) else error.strerror
        yield Found("hwmon", f"{root}", {}, missing=(f"{what}: this system has no hwmon, or it is hidden (container)",))
        return
    names: set[str] = set()
    for chip in chips:
        if chip.fans:
            yield _of_chip(chip, chips, root, names, writable=writable)
    if not any(chip.fans for chip in chips):
        there = ", ".join(dict.fromkeys(chip.name for chip in chips)) or "none"
        hint = "load the driver of the board's chip (sensors-detect of lm-sensors finds it)"
        yield Found("hwmon", f"{root}", {}, missing=(f"no chip with a fan; chips: {there}; {hint}",))


def _of_chip(chip: ChipFolder, chips: Sequence[ChipFolder], root: Path, names: set[str], *, writable: bool) -> Found:
    readings = {fan: _number(chip, f"fan{fan}_input") for fan in chip.fans}
    drives = {fan: Drive(chip, f"pwm{fan}") for fan in chip.fans if fan in chip.pwms}
    in_rpm = not drives
    if in_rpm:
        drives = {fan: Drive(chip, file) for fan in chip.fans if (file := set_point_of(chip, fan))}
    turning = [fan for fan in drives if readings[fan] is not None and readings[fan] != 0]
    missing = _without_drive(chip, chips, [fan for fan in chip.fans if fan not in drives])
    missing += [f"fan{fan} cannot be read" for fan, rpm in readings.items() if rpm is None]
    missing += [
        f"fan{fan}_input is {rpm}, which is no measurement: its speed is missing until there is one"
        for fan, rpm in readings.items()
        if rpm is not None and rpm > HIGHEST_RPM
    ]
    standing = [fan for fan in drives if readings[fan] == 0]
    stopped = [fan for fan in standing if _number(chip, drives[fan].file) == 0]
    if turning and (unconnected := [fan for fan in standing if fan not in stopped]):
        numbers = ", ".join(f"fan{fan}" for fan in unconnected)
        missing.append(f"{numbers} at 0 rpm although commanded to turn, left out: not connected?")
    fans = sorted([*turning, *stopped]) if turning else standing
    missing += filter(None, (drives[fan].why_no_command() for fan in fans))
    if fans and (closed := [fan for fan in fans if not os.access(chip.path / drives[fan].file, os.W_OK)]):
        numbers = ", ".join(drives[fan].file for fan in closed)
        missing.append(f"this user may not write {numbers}, which only commands need: run as root, or add a udev rule")
    row = chip_of(chip.name)
    notes = [
        f"fan {number} is fan{fan}_input{_label(chip, fan)}: {readings[fan]} rpm" for number, fan in enumerate(fans)
    ]
    notes.append(f"measures {row.tacho} ({row.source})" if row and row.tacho else _unknown(chip.name))
    if row and row.lowest_rpm and not any(0 < (rpm or 0) < row.lowest_rpm for rpm in readings.values()):
        notes.append(f"reads 0 below {row.lowest_rpm} rpm")
    if row and row.note:
        notes.append(row.note)
    source: dict[str, Any] = {"kind": "hwmon", "chip": chip_words(chip, chips)}
    source["fans"] = fans
    command_max = 255
    if in_rpm:
        source["pwms"] = [drives[fan].file for fan in fans]
        command_max = max([HIGHEST_RPM, *(_number(chip, f"fan{fan}_max") or 0 for fan in fans)])
        notes.append("the command is the speed that is wanted, in rpm")
    if writable:
        source["writable"] = True
    if root != ROOT:
        source["root"] = str(root)
    keys = {
        "name": free_name(chip.name, names),
        "fans": _names(chip, fans),
        "speed_unit": "rpm",
        "speed_max": HIGHEST_RPM,
        "command_max": command_max,
        "source": source,
    }
    title = f"{chip.name} ({chip.path.name}{', ' + chip.device.rsplit('/', 1)[-1] if chip.device else ''})"
    return Found("hwmon", title, keys if fans else {}, tuple(notes), tuple(missing))


def _without_drive(chip: ChipFolder, chips: Sequence[ChipFolder], fans: Sequence[int]) -> list[str]:
    """A line for fans whose command is not known, with what could be named."""
    if not fans:
        return []
    lacks = "no pwm and no set-point" if len(fans) == len(chip.fans) else ", ".join(f"no pwm{fan}" for fan in fans)
    others = [f'"{chip_words(each, chips)}/pwm{n}"' for each in chips if each is not chip for n in each.pwms]
    there = [*map(str, chip.pwms), *others]
    named = (
        f"if one of these drives them, name it in pwms: {', '.join(there)}"
        if there
        else "no chip has a pwm; a program that knows their command can push it (source push)"
    )
    which = "its fans" if len(fans) == len(chip.fans) else ", ".join(f"fan{fan}" for fan in fans)
    return [f"{chip.name} has {lacks}, so the command of {which} is not known, without which no fan is judged; {named}"]


def _unknown(name: str) -> str:
    return f"how {name} measures speeds is not known: readings count as instantaneous unless tacho says otherwise"


def _number(chip: ChipFolder, file: str) -> int | None:
    try:
        return chip.number(file)
    except OSError:
        return None


def _label(chip: ChipFolder, fan: int) -> str:
    label = chip.label("fan", fan)
    return f" ({label})" if label else ""


def _names(chip: ChipFolder, fans: Sequence[int]) -> list[str]:
    """What the kernel calls them, as the board says; else the chip's own `fan2`, by which a technician finds them."""
    own = [f"fan{fan}" for fan in fans]
    labels = [chip.label("fan", fan) for fan in fans]
    names = [label if is_fan_name(label) else name for label, name in zip(labels, own, strict=True)]
    return names if len({name.casefold() for name in names}) == len(names) else own
