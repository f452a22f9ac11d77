"""Acquisition: bytes of a tray's serial line in, raw samples out; commands back down the same line.

Reads: topic `command` (fan commands in the tray's command unit, set-points in rad/s), and the serial line in the
protocol of docs/reference/wire-protocol.md (speed in the tray's speed unit).
Writes: topic `raw`: device clock (us, wraps), device sequence (wraps), host's time of receipt (ns), command,
speed (rad/s).
Timing: a message of `block_size` samples as soon as they are there; an incomplete block waits `block_wait_s` at most.
A sample's time of receipt is when the bytes that completed it arrived: samples that arrive in one piece share it.

One process and one core for each tray. Whatever the line brings is either a sample or counted by kind.
"""

from __future__ import annotations

import math
import os
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from pydantic import Field

from pipeline.config.models import TrayConfig
from pipeline.devices.byte_link import ByteLink, LinkDown, LinkUp, Received
from pipeline.devices.serial_port import SerialPort
from pipeline.runtime.stage import Context, Core, Parts, Stage, StageConfig, StageError
from schemas import wire
from schemas.messages import Command, Raw
from schemas.units import RAD_S_PER_UNIT

LARGEST_GAP = 1 << 24  # samples; 46 h at 100 Hz. A larger step of the sequence is a device that began anew.
_REPEATS_KNOWN = 64  # how far back a repeated sample is recognised
_RECENT = 100  # frames by which the line's quality is judged
_NS_PER_S = 1_000_000_000


class AcquisitionConfig(StageConfig):
    """Section `[acquisition]`. The line itself is described by the tray."""

    block_size: int = Field(default=1, ge=1, le=4096, description="samples a message; 1 has the lowest latency")
    block_wait_s: float = Field(default=0.5, gt=0, description="how long an incomplete block waits for its last sample")
    silence_s: float = Field(default=2.0, gt=0, description="after how long without a valid frame health says so")


@dataclass(frozen=True, slots=True)
class _Kept:
    """A sample that will be published, and when it came."""

    sample: wire.Sample
    t_ns: int

    @property
    def has(self) -> tuple[bool, bool]:
        """Whether it has a clock and a sequence: the samples of one message must agree in that."""
        return self.sample.clock_us is not None, self.sample.sequence is not None


class SequenceWatch:
    """Follows the device's 32-bit sequence: what was lost, what came twice, when the device began anew."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._known: deque[tuple[int, int | None]] = deque(maxlen=_REPEATS_KNOWN)

    def line_interrupted(self) -> None:
        """The device may have been restarted: what looks like a repeat from now on may be a new sample."""
        self._known.clear()

    def note(self, sample: wire.Sample, counts: Counter[str]) -> bool:
        """Whether `sample` is new; counts `lost_on_line`, `repeated` and `device_restarts`."""
        if sample.sequence is None:
            return True
        if self._last is not None:
            step = (sample.sequence - self._last) % wire.UINT32
            if step != 1:
                if (sample.sequence, sample.clock_us) in self._known:
                    counts["repeated"] += 1
                    return False
                if 1 < step <= LARGEST_GAP:
                    counts["lost_on_line"] += step - 1
                else:
                    counts["device_restarts"] += 1
        self._last = sample.sequence
        self._known.append((sample.sequence, sample.clock_us))
        return True


def within(value: float, low: float, high: float) -> bool:
    """Whether a float32 off the line lies in a range written in decimals: 0.1 as float32 is not beyond 0.1."""
    slack = 1e-6 * max(abs(low), abs(high))
    return low - slack <= value <= high + slack


def raw_of(block: Sequence[_Kept], tray: TrayConfig) -> Raw:
    """One message of samples that agree in what they have."""
    has_clock, has_sequence = block[0].has
    samples = [kept.sample for kept in block]
    return Raw(
        fans=tray.fans,
        host_receive_t_ns=np.array([kept.t_ns for kept in block], np.int64),
        device_clock_us=np.array([s.clock_us for s in samples] if has_clock else [], np.uint32),
        device_sequence=np.array([s.sequence for s in samples] if has_sequence else [], np.uint32),
        command=np.array([s.command for s in samples], np.float64),
        speed_rad_s=np.array([s.speed for s in samples], np.float64) * RAD_S_PER_UNIT[tray.speed_unit],
    )


Item: TypeAlias = Received | LinkUp | LinkDown | Command


class AcquisitionCore(Core):
    """One tray's line. Counts every piece of the stream that is not a sample, and never raises on any bytes."""

    def __init__(self, tray: TrayConfig, config: AcquisitionConfig, line: ByteLink, started_t_ns: int) -> None:
        self._tray = tray
        self._config = config
        self._line = line
        self._decoder = wire.Decoder(tray.protocol, tray.fans)
        self._sequence = SequenceWatch()
        self._block: list[_Kept] = []
        self._counts: Counter[str] = Counter()
        self._down_because: str | None = None
        self._now_ns = self._last_valid_t_ns = self._last_byte_t_ns = started_t_ns
        self._last_fault = ""
        self._recent: deque[bool] = deque(maxlen=_RECENT)  # of each frame: was it good

    def step(self, item: Item) -> list[Raw]:
        """Take bytes, news of the line, or a command to send."""
        if isinstance(item, Received):
            return self._receive(item)
        if isinstance(item, Command):
            self._send(item)
            return []
        if isinstance(item, LinkUp):
            self._counts["line_up"] += 1
            self._down_because = None
            self._last_valid_t_ns = self._last_byte_t_ns = self._now_ns
        else:
            self._counts["line_down"] += self._down_because is None  # the reason may change while it is down
            self._down_because = item.reason
        self._decoder.reset()
        self._sequence.line_interrupted()
        self._recent.clear()
        self._last_fault = ""
        return self._flush()

    def tick(self, now_ns: int) -> list[Raw]:
        """Note the time, and hand out a block that has waited long enough."""
        self._now_ns = now_ns
        if self._block and now_ns - self._block[0].t_ns >= self._config.block_wait_s * _NS_PER_S:
            return self._flush()
        return []

    def close(self) -> list[Raw]:
        """Hand out what is left of a block."""
        return self._flush()

    def counters(self) -> Mapping[str, int]:
        """What came of the line's bytes, by kind; docs/reference/wire-protocol.md explains each."""
        return dict(self._counts)

    def problem(self) -> str:
        """What is wrong with the line now."""
        port, silence_s = self._tray.port, self._config.silence_s
        if self._down_because is not None:
            return f"{port}: {self._down_because}"
        if self._now_ns - self._last_byte_t_ns > silence_s * _NS_PER_S:
            return f"{port}: nothing received for {silence_s:g} s; is the device powered, connected and sending?"
        fault = f" (last fault: {self._last_fault})" if self._last_fault else ""
        if self._now_ns - self._last_valid_t_ns > silence_s * _NS_PER_S:
            return (
                f"no valid frame for {silence_s:g} s on {port}{fault}: "
                f"are baud = {self._tray.baud}, protocol = {self._tray.protocol!r} and fans = {self._tray.fans} "
                "of the [[tray]] right?"
            )
        if len(self._recent) >= _RECENT // 5 and 2 * sum(self._recent) < len(self._recent):
            return f"{port}: most frames are faulty{fault}; check the wiring and [[tray]] baud"
        return ""

    def _receive(self, received: Received) -> list[Raw]:
        self._counts["bytes"] += len(received.data)
        self._last_byte_t_ns = received.t_ns
        self._now_ns = max(self._now_ns, received.t_ns)
        messages: list[Raw] = []
        for found in self._decoder.feed(received.data):
            sample = self._plausible(found)
            if sample is None or not self._sequence.note(sample, self._counts):
                continue
            self._counts["samples"] += 1
            kept = _Kept(sample, received.t_ns)
            if self._block and kept.has != self._block[0].has:
                messages += self._flush()
            self._block.append(kept)
            if len(self._block) >= self._config.block_size:
                messages += self._flush()
        return messages

    def _plausible(self, found: wire.Frame | wire.Fault) -> wire.Sample | None:
        """The sample, with absurd speeds taken out; None, and counted, if there is no sample in it that can be used."""
        if isinstance(found, wire.Sample):
            tray = self._tray
            absurd = [c for c in found.command if not within(c, tray.command_min, tray.command_max)]
            if not absurd:
                self._recent.append(True)
                return self._with_plausible_speeds(found)
            # Nothing can be judged under a command that was not given, and none may be made up.
            kind = "absurd_command"
            detail = f"command {absurd[0]:g} is outside {tray.command_min:g} to {tray.command_max:g} of the [[tray]]"
        else:
            assert isinstance(found, wire.Fault), "a host's decoder gives samples and faults only"
            kind, detail = found.kind.value, found.detail
        self._counts[kind] += 1
        if kind != wire.FaultKind.RESYNC.value:
            self._recent.append(False)
            self._last_fault = f"{kind}, {detail}"
        return None

    def _with_plausible_speeds(self, sample: wire.Sample) -> wire.Sample:
        self._last_valid_t_ns = self._last_byte_t_ns
        largest = self._tray.speed_max
        self._counts["no_speed"] += sum(map(math.isnan, sample.speed))
        absurd = sum(abs(speed) > largest for speed in sample.speed)
        if not absurd:
            return sample
        self._counts["absurd_speed"] += absurd
        speed = tuple(math.nan if abs(speed) > largest else speed for speed in sample.speed)
        return wire.Sample(sample.clock_us, sample.sequence, sample.command, speed)

    def _flush(self) -> list[Raw]:
        block, self._block = self._block, []
        return [raw_of(block, self._tray)] if block else []

    def _send(self, wanted: Command) -> None:
        """Send a command down the line; one that this tray cannot carry out is refused as a whole."""
        tray = self._tray
        command = tuple(map(float, wanted.command))
        set_point = tuple(float(value) / RAD_S_PER_UNIT[tray.speed_unit] for value in wanted.set_point_rad_s)
        if (
            any(len(values) not in (0, tray.fans) for values in (command, set_point))
            or not all(math.isnan(c) or within(c, tray.command_min, tray.command_max) for c in command)
            or not all(math.isnan(s) or within(s, -tray.speed_max, tray.speed_max) for s in set_point)
        ):
            self._counts["refused_commands"] += 1
            return
        data = b"".join(
            wire.encode(tray.protocol, frame)
            for values, frame in ((command, wire.CommandFrame(command)), (set_point, wire.SetPointFrame(set_point)))
            if not all(map(math.isnan, values))
        )
        if not data:
            return
        self._counts["sent_commands" if self._line.write(data) else "lost_commands"] += 1


def build(context: Context) -> Parts:
    """The core of one tray and its serial port.

    Raises:
        StageError: the tray names no port.
    """
    tray = context.tray
    if not tray.port:
        raise StageError(f'[[tray]] {tray.name}: port is missing; add for example port = "/dev/ttyUSB0"')
    line = SerialPort(str(context.resolve(Path(tray.port))), tray.baud)
    return Parts(AcquisitionCore(tray, context.config, line, context.started_t_ns), line)


def check(context: Context) -> list[str]:
    """What would keep the line from being opened."""
    tray = context.tray
    if not tray.port:
        return [f'[[tray]] {tray.name}: port is missing; add for example port = "/dev/ttyUSB0"']
    port = context.resolve(Path(tray.port))
    if not port.exists():
        return [f"{port}: no such port; connect the device, or correct [[tray]] port"]
    if not os.access(port, os.R_OK | os.W_OK):
        return [f"{port}: may not be read and written by this user; join the group that owns it (often dialout)"]
    return []


STAGE = Stage(
    name="acquisition",
    about="serial line to raw samples, and commands back down",
    reads=("command",),
    writes=("raw",),
    config=AcquisitionConfig,
    build=build,
    process_per_tray=True,
    check=check,
)
