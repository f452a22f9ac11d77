"""The port of one device, by what stays when it is plugged in again: the USB device, not the number of ttyUSBN."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from serial.tools.list_ports_common import ListPortInfo

BY_ID = Path("/dev/serial/by-id")
"""links of Linux, named after the USB device"""

_Device: TypeAlias = tuple[int, int, str]
"""maker, product, and serial number or, of a device without one, the socket it is plugged into"""


def listed_ports() -> list[ListPortInfo]:
    """The ports of this computer that the system knows."""
    from serial.tools import list_ports  # noqa: PLC0415  slow to import

    return sorted(list_ports.comports())


def lasting_name(port: str) -> str:
    """The link by the id of the device at a port; the port itself if there is none."""
    try:
        links = sorted(BY_ID.iterdir())
    except OSError:
        return port
    return next((str(link) for link in links if os.path.realpath(link) == os.path.realpath(port)), port)


def ports_there(port: str) -> str:
    """The end of the line about a port that is not there: the ports that are, or that there is none."""
    path = Path(port)
    kind = re.sub(r"\d+$", "", path.name)
    try:
        alike = [each for each in path.parent.iterdir() if re.fullmatch(rf"{re.escape(kind)}\d+", each.name)]
    except OSError:
        alike = []
    usb = [each.device for each in listed_ports() if each.vid is not None]
    there = dict.fromkeys(lasting_name(each) for each in sorted({*map(str, alike), *usb}))
    return f"ports there: {', '.join(there) or 'none'}"


class SamePort:
    """Finds a device again that has another port since it was plugged in again."""

    def __init__(self, port: str) -> None:
        self._port = port
        self._device: _Device | None = None
        """device at the port when it was opened last; None: not known"""

    def path(self) -> str:
        """The port to open: the one that was named, unless the device is known and at another one."""
        if self._device is None:
            return self._port
        found = {each.device: device for each in listed_ports() if (device := _device(each)) is not None}
        if found.get(os.path.realpath(self._port)) == self._device:
            return self._port
        others = [port for port, device in found.items() if device == self._device]
        return others[0] if len(others) == 1 else self._port

    def opened(self, path: str) -> str:
        """Remember the device at a port; a line if it is not the named port, or no longer the same device."""
        real = os.path.realpath(path)
        device = next((_device(each) for each in listed_ports() if each.device == real), None)
        before, self._device = self._device, device or self._device
        if path != self._port:
            return f'{self._port} is {path} since it was plugged in again: write port = "{lasting_name(path)}"'
        if before is not None and device not in (None, before):
            return f"another device than before is at {path}"
        return ""


def _device(port: ListPortInfo) -> _Device | None:
    if port.vid is None or port.pid is None or not (which := port.serial_number or port.location):
        return None
    return port.vid, port.pid, which
