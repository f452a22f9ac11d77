"""A driver of simulated fans behind a tree of files such as /sys/class/hwmon.

As drivers do, it reads `pwmN` where `pwmN_enable` is 1, drives the fan at full speed where it is 0, and where it is 2
drives it by itself and shows in `pwmN` what it does. `fanN_input` changes when the tacho of the simulation has a new
reading. What the kernel refuses by an error is an empty file here.
"""

from __future__ import annotations

import math
import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.simulated.device import Device, PlaybackCounts
from fantwin.schemas.units import RAD_S_PER_UNIT

FULL_SPEED, MANUAL, AUTOMATIC = 0, 1, 2
HIGHEST_PWM = 255
FAULT_FILE = "fault"
_CHIPS_OF_ONE_FAN = ("pwmfan",)
_MARK = ".simulated-hwmon"


class SimulatedFans(Device, Protocol):
    """A device whose fans can be given back to its own profile."""

    def release(self, fans: NDArray[np.bool_]) -> None:
        """Let the profile command these fans, (fans,), again."""
        ...


@dataclass
class _Channel:
    """A fan and its pwm, as numbered files of a chip."""

    folder: Path
    number: int
    last_pwm: int = HIGHEST_PWM

    def write(self, file: str, value: float) -> None:
        """Replace the file, so that no reader finds half of it; NaN: it is empty.

        Raises:
            UserError: the folder cannot be written any more.
        """
        new = self.folder / "new"
        try:
            new.write_text("\n" if math.isnan(value) else f"{round(value)}\n", encoding="ascii")
            new.replace(self.folder / file)
        except OSError as error:
            hint = "give each simulation a folder of its own"
            raise UserError(f"{self.folder}: cannot be written any more: {error.strerror}: {hint}") from error

    def read(self, file: str, otherwise: int) -> int:
        """The number that somebody wrote; `otherwise` while that is being written, or is none."""
        try:
            return int((self.folder / file).read_text(encoding="ascii", errors="replace"))
        except (OSError, ValueError):
            return otherwise


class HwmonTree:
    """Files of a chip with its fans; for a driver of single fans, a chip for each."""

    def __init__(self, root: Path, chip: str, fans: int) -> None:
        """Write the tree. A tree that an earlier simulation left is replaced.

        Raises:
            UserError: the folder holds something else, or cannot be written.
        """
        self.root = root
        try:
            if root.exists() and any(root.iterdir()) and not (root / _MARK).exists():
                raise UserError(f"{root}: holds something else than a simulated tree; name another folder")
            shutil.rmtree(root, ignore_errors=True)
            root.mkdir(parents=True)
            (root / _MARK).touch()
            (root / FAULT_FILE).touch()
            of_one = chip in _CHIPS_OF_ONE_FAN
            chips = [self._chip(number, chip) for number in range(fans if of_one else 1)]
        except OSError as error:
            raise UserError(f"{root}: cannot be written: {error.strerror}; name another folder") from error
        self._channels = [_Channel(chips[fan if of_one else 0], 1 if of_one else fan + 1) for fan in range(fans)]
        for channel in self._channels:
            channel.write(f"fan{channel.number}_input", 0)
            channel.write(f"pwm{channel.number}", channel.last_pwm)
            channel.write(f"pwm{channel.number}_enable", AUTOMATIC)

    def commands(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(fans,) duty of each fan, NaN where it is automatic; and (fans,) where it is."""
        modes = [*map(self._mode, self._channels)]
        automatic = np.array([mode >= AUTOMATIC for mode in modes])
        duty = np.array([self._duty(*each) for each in zip(self._channels, modes, strict=True)])
        return np.where(automatic, np.nan, duty), automatic

    def show(self, rpm: NDArray[np.float64], duty: NDArray[np.float64], automatic: NDArray[np.bool_]) -> None:
        """(fans,) each: write what has changed. duty: shown where the driver commands."""
        for fan, channel in enumerate(self._channels):
            channel.write(f"fan{channel.number}_input", rpm[fan])
            # a command that has come since `commands` is not written over
            if automatic[fan] and self._mode(channel) >= AUTOMATIC:
                channel.last_pwm = round(HIGHEST_PWM * duty[fan])
                channel.write(f"pwm{channel.number}", channel.last_pwm)

    def close(self) -> None:
        """Remove the tree, as a driver that is unloaded does."""
        shutil.rmtree(self.root, ignore_errors=True)

    def _chip(self, number: int, name: str) -> Path:
        folder, device = self.root / f"hwmon{number}", self.root / "devices" / "platform" / f"{name}.{number}"
        device.mkdir(parents=True)
        folder.mkdir()
        (folder / "device").symlink_to(os.path.relpath(device, folder))
        (folder / "name").write_text(f"{name}\n", encoding="utf-8")
        return folder

    def _mode(self, channel: _Channel) -> int:
        return channel.read(f"pwm{channel.number}_enable", AUTOMATIC)

    def _duty(self, channel: _Channel, mode: int) -> float:
        if mode == FULL_SPEED:
            return 1.0
        channel.last_pwm = min(max(channel.read(f"pwm{channel.number}", channel.last_pwm), 0), HIGHEST_PWM)
        return channel.last_pwm / HIGHEST_PWM


def play_hwmon(
    device: SimulatedFans,
    tree: HwmonTree,
    stop: threading.Event,
    before_sample: Callable[[], None] = lambda: None,
    on_late: Callable[[float], Any] = lambda _lateness_s: None,
) -> PlaybackCounts:
    """Run the fans in real time until the last sample or until `stop` is set.

    before_sample: called before each. on_late: as of `play`.
    """
    played = PlaybackCounts(start_ns=time.time_ns())
    start_s = time.monotonic()
    while (due_s := device.due_s()) is not None and not stop.wait(max(0.0, start_s + due_s - time.monotonic())):
        played.note_lateness(time.monotonic() - start_s - due_s, on_late)
        before_sample()
        duty, automatic = tree.commands()
        device.release(automatic)
        device.command(duty)
        sample = device.take()
        tree.show(sample.speed_rad_s / RAD_S_PER_UNIT["rpm"], sample.command, automatic)
        played.samples_sent += 1
    return played
