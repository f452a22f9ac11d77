"""Modes of the pwms of a chip before fantwin wrote them, in a file that outlives the process that writes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from fantwin.pipeline.files import replace_file
from fantwin.pipeline.sources.hwmon.tree import ChipFolder


@dataclass(frozen=True)
class FoundPwm:
    """mode: pwmN_enable, None if there is none. pwm: 0 to 255, None if it could not be read."""

    mode: int | None
    pwm: int | None


@dataclass(frozen=True)
class _Found:
    """Content of the file. chip, device: whose pwms they are."""

    chip: str
    device: str
    pwms: dict[int, FoundPwm]


_FOUND = TypeAdapter(_Found)


class FoundModes:
    """The file, which is there as long as something has to be given back. Without a path nothing is kept."""

    def __init__(self, path: Path | None) -> None:
        self._path = path

    def kept(self, chip: ChipFolder) -> dict[int, FoundPwm]:
        """Modes that an earlier process has not given back, by the number of the pwm."""
        try:
            found = _FOUND.validate_json(self._path.read_bytes()) if self._path else None
        except (OSError, ValidationError):
            return {}
        return found.pwms if found and (found.chip, found.device) == (chip.name, chip.device) else {}

    def keep(self, chip: ChipFolder, pwms: Mapping[int, FoundPwm]) -> None:
        """Replace what is kept. Raises OSError."""
        if self._path is None:
            return
        replace_file(self._path, json.dumps(_FOUND.dump_python(_Found(chip.name, chip.device, dict(pwms)))).encode())

    def forget(self) -> None:
        """Note that all was given back. Raises OSError."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
