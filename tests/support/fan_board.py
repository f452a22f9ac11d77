"""The firmware in its simulator, in lock-step: time passes only where a test runs it, faster than it really does."""

from __future__ import annotations

import json
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

from fantwin.schemas.wire import (
    DEVICE_COUNTERS,
    CommandFrame,
    Decoder,
    DeviceCounters,
    Fault,
    Sample,
    SetPointFrame,
    encode,
)

FANS = 4


@dataclass(frozen=True)
class FanTruth:
    """One fan as the simulator has it.

    Attributes:
        duty, pwm_hz: by the registers of its timer. pulses: of its tacho since the start.
        pwm_periods: on its pin since the start; the simulator does not move the pins of timer 1 (fans 0 and 1) rightly.
    """

    speed_rad_s: float
    duty: float
    pulses: int
    pwm_hz: float
    pwm_periods: int


@dataclass(frozen=True)
class BoardTruth:
    """The board as the simulator has it; supply_v is that at the fans."""

    t_s: float
    restarts: int
    supply_v: float
    fans: tuple[FanTruth, ...]
    counters: dict[str, int]


class FanBoard:
    """A board that has just been switched on."""

    def __init__(self, simulator: Path, firmware: Path) -> None:
        self._process = subprocess.Popen(
            [str(simulator), str(firmware)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._decoder = Decoder("binary", FANS)
        self.faults: list[Fault] = []
        self.samples: list[Sample] = []
        self.counters: list[DeviceCounters] = []
        """as the firmware has sent them"""

    def order(self, *words: object) -> str:
        """Send a line to the simulator; returns what it answers beside `ok` and the bytes of the firmware."""
        line = " ".join(map(str, words))
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        answer = ""
        while (said := self._process.stdout.readline().rstrip("\n")) != "ok":
            assert said, f"the simulator ended at {line!r}"
            assert not said.startswith("error"), said
            if said.startswith("sent "):
                self._take(bytes.fromhex(said.removeprefix("sent ")))
            else:
                answer = said
        return answer

    def run(self, seconds: float) -> list[Sample]:
        """Let time pass; returns the samples sent meanwhile."""
        before = len(self.samples)
        self.order("run", seconds)
        return self.samples[before:]

    def send(self, frame: CommandFrame | SetPointFrame) -> None:
        """Put a frame on the line; it arrives as time passes."""
        self.order("send", encode("binary", frame).hex())

    def command(self, *duty: float) -> None:
        """One duty for all fans, or one for each."""
        self.send(CommandFrame(duty * FANS if len(duty) == 1 else duty))

    def truth(self) -> BoardTruth:
        """The board now."""
        found = json.loads(self.order("state"))
        counters = struct.unpack(f"<{len(DEVICE_COUNTERS)}H", bytes.fromhex(found["counters"]))
        return BoardTruth(
            found["t_s"],
            found["restarts"],
            found["supply_v"],
            tuple(FanTruth(**fan) for fan in found["fans"]),
            dict(zip(DEVICE_COUNTERS, counters, strict=True)),
        )

    def close(self) -> None:
        """Switch off."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()

    def _take(self, data: bytes) -> None:
        for found in self._decoder.feed(data):
            if isinstance(found, Sample):
                self.samples.append(found)
            elif isinstance(found, DeviceCounters):
                self.counters.append(found)
            else:
                assert isinstance(found, Fault)
                self.faults.append(found)
