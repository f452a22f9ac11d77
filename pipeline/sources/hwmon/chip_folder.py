"""The chips of a tree such as /sys/class/hwmon, by what Linux does not number at each boot: name and device."""

from __future__ import annotations

import errno
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

_NUMBERED = re.compile(r"hwmon(\d+)")


@dataclass(frozen=True)
class ChipFolder:
    """A folder hwmonN.

    path: where its files are. name: content of `name`. device: path of its device, the number hwmonN not being in it;
    empty for a chip that belongs to none.
    """

    path: Path
    name: str
    device: str

    def is_called(self, words: str) -> bool:
        """Whether it is the chip of a configuration: NAME, or NAME@END with the end of the path of its device."""
        name, _, device = words.partition("@")
        return self.name == name and (not device or f"/{self.device}".endswith(f"/{device.strip('/')}"))

    @cached_property
    def fans(self) -> tuple[int, ...]:
        """N of each fanN_input."""
        return self.numbers("fan", "_input")

    @cached_property
    def pwms(self) -> tuple[int, ...]:
        """N of each pwmN."""
        return self.numbers("pwm", "")

    def numbers(self, kind: str, suffix: str) -> tuple[int, ...]:
        """N of each file of this kind, such as fanN_input."""
        pattern = re.compile(rf"{kind}(\d+){suffix}")
        found = (pattern.fullmatch(file.name) for file in self.path.iterdir())
        return tuple(sorted(int(match[1]) for match in found if match))

    def number(self, file: str) -> int:
        """The number in a file. Raises OSError; EIO where it holds none, as drivers say of a broken measurement."""
        text = (self.path / file).read_text(encoding="ascii", errors="replace").strip()
        try:
            return int(text)
        except ValueError as error:
            raise OSError(errno.EIO, f"holds {text[:20]!r}, no number") from error

    def label(self, kind: str, number: int) -> str:
        """Content of kindN_label; empty if there is none."""
        try:
            return (self.path / f"{kind}{number}_label").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""


def chip_folders(root: Path) -> list[ChipFolder]:
    """All chips, by name and device. A folder that goes away meanwhile is left out.

    Raises:
        OSError: there is no such tree, or it may not be read.
    """
    found = []
    for link in root.iterdir():
        if not _NUMBERED.fullmatch(link.name):
            continue
        device = link / "device"
        for path in (link, device):  # older drivers have their files in the folder of the device
            try:
                name = (path / "name").read_text(encoding="utf-8", errors="replace").strip()
            except OSError:
                continue
            found.append(ChipFolder(path, name, str(device.resolve()).strip("/") if device.exists() else ""))
            break
    return sorted(found, key=lambda chip: (chip.name, chip.device, chip.path.name))


def chip_words(chip: ChipFolder, all_chips: Sequence[ChipFolder]) -> str:
    """Its name, and where others have the same one, the end of the path of its device that none of them has."""
    others = [other for other in all_chips if other.name == chip.name and other is not chip]
    if not others or not chip.device:
        return chip.name
    parts = chip.device.split("/")
    for count in range(1, len(parts) + 1):
        words = f"{chip.name}@{'/'.join(parts[-count:])}"
        if not any(other.is_called(words) for other in others):
            return words
    return f"{chip.name}@{chip.device}"
