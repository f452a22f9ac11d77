"""Discovery of what this computer could watch: hwmon chips with fans, and serial ports, each as a [[tray]] to paste."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fantwin.pipeline.sources.hwmon.chip_folder import ChipFolder, chip_folders, chip_words
from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.hwmon.config import ROOT

HIGHEST_RPM = 20_000
_UNKNOWN = "n/a"
"""description by pyserial of a port of which the system knows no device"""


@dataclass(frozen=True)
class Found:
    """Possible tray: a chip with fans, or a serial port.

    Attributes:
        kind: of its source.
        title: one line.
        tray: the keys of its [[tray]]; empty if it cannot be one.
        notes: what to know of it.
        missing: what keeps it from being watched, or commanded, and what to do.
    """

    kind: str
    title: str
    tray: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def toml(self) -> str:
        """The [[tray]], with what to know as comments; empty if it cannot be one."""
        if not self.tray:
            return ""
        lines = [f"# {line}" for line in (self.title, *self.notes, *self.missing)]
        return "\n".join(["[[tray]]", *lines, *(f"{key} = {_toml(value)}" for key, value in self.tray.items()), ""])


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


def discover_serial() -> Iterator[Found]:
    """The serial ports with a known device, each with a guessed [[tray]]; then all other ports as one entry."""
    from serial.tools import list_ports  # noqa: PLC0415  slow to import, and needed here only

    listed = sorted(list_ports.comports())
    ports = [port for port in listed if (port.description, port.hwid) != (_UNKNOWN, _UNKNOWN)]
    for number, port in enumerate(ports):
        readable = os.access(port.device, os.R_OK | os.W_OK)
        missing = () if readable else ("this user may not open it: join its group (often dialout)",)
        keys = {
            "name": f"tray{number + 1}",
            "fans": 1,
            "speed_unit": "rpm",
            "source": {"kind": "serial", "port": port.device, "protocol": "text"},
        }
        note = "fans, protocol and unit are a guess: `fantwin doctor` listens and says what does not fit"
        yield Found("serial", f"{port.device}: {port.description}", keys, (note,), missing)
    if unknown := [port.device for port in listed if port not in ports]:
        lacks = "no device is known there; if one is connected, name its port in a [[tray]] yourself"
        yield Found("serial", ", ".join(unknown), {}, missing=(lacks,))
    if not listed:
        yield Found("serial", "serial ports", {}, missing=("none is there: connect the device",))


def _of_chip(chip: ChipFolder, chips: Sequence[ChipFolder], root: Path, names: set[str], *, writable: bool) -> Found:
    readings = {fan: _number(chip, f"fan{fan}_input") for fan in chip.fans}
    with_pwm = [fan for fan in chip.fans if fan in chip.pwms]
    turning = [fan for fan in with_pwm if readings[fan] is not None and readings[fan] != 0]
    missing = [
        f"fan{fan} has no pwm{fan}, so its command is not known: name the pwm that drives it in pwms"
        for fan in chip.fans
        if fan not in chip.pwms
    ]
    missing += [f"fan{fan} cannot be read" for fan, rpm in readings.items() if rpm is None]
    standing = [fan for fan in with_pwm if readings[fan] == 0]
    stopped = [fan for fan in standing if _number(chip, f"pwm{fan}") == 0]
    if turning and (unconnected := [fan for fan in standing if fan not in stopped]):
        numbers = ", ".join(f"fan{fan}" for fan in unconnected)
        missing.append(f"{numbers} at 0 rpm although commanded to turn, left out: not connected?")
    fans = sorted([*turning, *stopped]) if turning else standing
    if fans and (closed := [fan for fan in fans if not os.access(chip.path / f"pwm{fan}", os.W_OK)]):
        numbers = ", ".join(f"pwm{fan}" for fan in closed)
        missing.append(f"this user may not write {numbers}, which only commands need: run as root, or add a udev rule")
    row = chip_of(chip.name)
    notes = [
        f"fan {number} is fan{fan}_input{_label(chip, fan)}: {readings[fan]} rpm" for number, fan in enumerate(fans)
    ]
    notes.append(f"measures {row.tacho} ({row.source})" if row and row.tacho else _unknown(chip.name))
    if row and row.note:
        notes.append(row.note)
    source: dict[str, Any] = {"kind": "hwmon", "chip": chip_words(chip, chips)}
    source["fans"] = fans
    if writable:
        source["writable"] = True
    if root != ROOT:
        source["root"] = str(root)
    keys = {
        "name": _free_name(chip.name, names),
        "fans": len(fans),
        "speed_unit": "rpm",
        "speed_max": HIGHEST_RPM,
        "command_max": 255,
        "source": source,
    }
    title = f"{chip.name} ({chip.path.name}{', ' + chip.device.rsplit('/', 1)[-1] if chip.device else ''})"
    return Found("hwmon", title, keys if fans else {}, tuple(notes), tuple(missing))


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


def _free_name(chip: str, names: set[str]) -> str:
    base = re.sub(r"[^A-Za-z0-9_-]", "-", chip) or "chip"
    name, number = base, 1
    while name in names:
        number += 1
        name = f"{base}-{number}"
    names.add(name)
    return name


def _toml(value: object) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(each)}' for key, each in value.items())} }}"
    return json.dumps(value)  # texts, numbers, booleans and lists of numbers are alike in both
