"""Sources that are asked: a thread that reads a device at a period of its own, and everything that can go wrong in it.

A poll is due each `period_s` from the first one on, by the monotonic clock. The time of a reading is the middle of its
request: it is given as the device clock (the host's monotonic clock, us), so that readings keep their distances however
long each request takes; docs/explanation/time.md says how times of samples follow from that. The sequence counts the
polls that were due while the device was connected: one that failed or was left out is a gap, so that acquisition counts
it as lost. Failures and late polls are counted by kind, too (`failed_polls`, `skipped_polls`).

Nothing ends this thread but `stop`: an error of the device, or in the code that asks it, is a LinkDown with one line,
and the device is connected again, at growing intervals.
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from pydantic import Field

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.source import (
    LinkDown,
    LinkUp,
    Noted,
    Reading,
    ReadingBatch,
    Rejected,
    SourceConfig,
    SourceEvent,
)
from fantwin.pipeline.timebase.device_clock import UINT32
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK

SLOWEST_S = 60.0
"""longest time between two samples that can be scored: the slowest grid (pipeline.timebase.grid_timing)"""
MOST_FAILURES = 3
"""failures in a row after which the device is taken for lost"""
RECONNECT_DELAY_S, RECONNECT_DELAY_MAX_S = 0.5, 10.0
"""the first delay doubles with every attempt, up to the second, and starts again after a connection of that length"""
STOP_LIMIT_S = 5.0
"""a request that takes longer does not delay the end"""
WRITE_WAIT_S = 0.05
"""longest wait for the outcome of a write; a device that is being read takes it afterwards"""


class PolledConfig(SourceConfig, frozen=True):
    """Base of the settings of a source that is asked."""

    period_s: float = Field(default=0.5, gt=0, le=SLOWEST_S, description="time between two readings")


Polled: TypeAlias = Reading | Rejected | Sequence[ReadingBatch]


class DeviceError(UserError):
    """A request that failed: one line that says why, and what to do.

    is_lost: there is no connection any more. retry_s: time before the next attempt, at least.
    """

    def __init__(self, reason: str, *, is_lost: bool = False, retry_s: float = 0.0) -> None:
        super().__init__(reason)
        self.is_lost = is_lost
        self.retry_s = retry_s


class Doubt(NamedTuple):
    """A speed that a fan hardly has. read: what was read, and where. remedy: the setting with which it is one; empty if
    none is known."""

    read: str
    remedy: str = ""


class _Write:
    """A command on its way to the thread, and what came of it."""

    def __init__(self, command: tuple[float, ...]) -> None:
        self.command = command
        self.is_done = threading.Event()
        self.failure = ""
        """why the command could not be written; empty if it was"""
        self.is_awaited = True
        """its sender still waits for the outcome"""


class PollingSource(ABC):
    """A `SampleSource` that asks a device. A kind says how to connect, read and write, all called in one thread."""

    def __init__(self, config: SourceConfig, period_s: float) -> None:
        """period_s: time between two readings; 0 if `read` waits for the next one itself."""
        self._period_s = period_s
        self._why_no_commands = config.why_no_commands
        self._deliver: Callable[[SourceEvent], None] = lambda _event: None
        self._stopping = False
        self._wake = threading.Condition()
        self._writes: list[_Write] = []
        self._is_connected = False
        self._thread: threading.Thread | None = None
        self._sequence = 0
        self.fans_called: tuple[tuple[str, str], ...] = ()
        """name and place of each fan, where the device says so"""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the device, for people."""

    @property
    @abstractmethod
    def settings_to_check(self) -> str:
        """See SampleSource."""

    @abstractmethod
    def connect(self) -> None:
        """Find the device, or open a connection. Raises DeviceError."""

    @abstractmethod
    def read(self) -> Polled:
        """Read once, NaN for a value that cannot be read; what cannot be used is `Rejected`, with the reason.

        A device that says when it measured gives what is new, maybe nothing, with those times.

        Raises DeviceError where nothing can be read.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Leave the device as it was found. Raises DeviceError, or nothing."""

    def write(self, command: tuple[float, ...]) -> None:
        """Write commands, NaN where a fan keeps its own. Only where the settings let it. Raises DeviceError."""
        raise NotImplementedError

    def note(self, kind: str, detail: str) -> None:
        """Let health say what was seen of the device, while it is read or written."""
        self._deliver(ReadingBatch(HOST_CLOCK.now_ns(), (Noted(kind, detail),)))

    def check(self) -> list[str]:
        """Problems that would keep it from being read now, one line each."""
        return []

    def doubts(self, fastest_rpm: float) -> Mapping[int, Doubt]:
        """Last speeds that are none, 0, too small or too large, by fan, where the source can say why."""
        return {}

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        """Poll in a thread; wait for a device that is not there yet."""
        self._deliver = deliver
        self._thread = threading.Thread(target=self._run, name=f"poll {self.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End after the request that is under way, and leave the device as it was found."""
        with self._wake:
            self._stopping = True
            self._wake.notify_all()
        if self._thread:
            self._thread.join(STOP_LIMIT_S)

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Pass a command to the thread. Returns why the device did not take it.

        A write that fails after WRITE_WAIT_S is counted as `failed_writes`.
        """
        if self._why_no_commands:
            return self._why_no_commands
        if not all(map(math.isnan, set_point)):
            return f"{self.name} takes commands, no set-points"
        write = _Write(command)
        with self._wake:
            if not self._is_connected or self._stopping:
                return f"{self.name} is not connected"
            self._writes.append(write)
            self._wake.notify_all()
        write.is_done.wait(WRITE_WAIT_S)
        with self._wake:
            write.is_awaited = False
            return write.failure

    def _run(self) -> None:
        delay_s, reported = RECONNECT_DELAY_S, ""
        while not self._stopping:
            least_s = 0.0
            try:
                self.connect()
                first = self._read()  # connected is what can be read
            except Exception as error:  # noqa: BLE001  a library may raise anything, and no thread may end silently
                reason, least_s = _reason(error), getattr(error, "retry_s", 0.0)
                self._disconnect()
            else:
                began_s, reported = time.monotonic(), ""
                reason = self._poll_until_lost(first)
                self._disconnect()
                if time.monotonic() - began_s > RECONNECT_DELAY_MAX_S:
                    delay_s = RECONNECT_DELAY_S
            if self._stopping:
                return
            if reason != reported:
                self._deliver(LinkDown(reason))
                reported = reason
            with self._wake:
                self._wake.wait_for(lambda: self._stopping, max(delay_s, least_s))
            delay_s = min(2.0 * delay_s, RECONNECT_DELAY_MAX_S)

    def _disconnect(self) -> None:
        with self._wake:
            self._is_connected = False
            writes, self._writes = self._writes, []
        for write in writes:
            self._finish(write, "the connection was lost before it was written")
        try:
            self.disconnect()
        except Exception as error:  # noqa: BLE001
            self._count("failed_writes", f"it could not be left as it was found: {_reason(error)}")

    def _read(self) -> Polled:
        """A reading with the time of the middle of its request."""
        began_s = time.monotonic()
        reading = self.read()
        if not isinstance(reading, Reading):
            return reading
        return replace(reading, clock_us=round((began_s + time.monotonic()) / 2.0 * 1e6) % UINT32)

    def _poll_until_lost(self, first: Polled) -> str:
        """Deliver readings until the device is lost, or `stop` is called; returns why it is lost."""
        with self._wake:
            self._is_connected = True
        self._deliver(LinkUp())
        due_s = self._began_s()
        self._deliver_reading(first)
        failures = 0
        while True:
            due_s = self._next_due_s(due_s)
            if not self._wait_until(due_s):
                return ""
            try:
                reading = self._read()
            except Exception as error:  # noqa: BLE001
                failures += 1
                self._sequence += 1
                if failures == MOST_FAILURES or not isinstance(error, DeviceError) or error.is_lost:
                    return _reason(error)
                self._count("failed_polls", _reason(error))
            else:
                failures = 0
                self._deliver_reading(reading)

    def _began_s(self) -> float:
        """The time from which polls are due each period, not later than now."""
        return time.monotonic()

    def _next_due_s(self, due_s: float) -> float:
        """Time of the poll after the one at due_s. Polls whose time is over are left out, and counted."""
        late_s = time.monotonic() - due_s
        if not self._period_s:
            return due_s + late_s
        skipped = max(0, math.ceil(late_s / self._period_s) - 1)
        self._sequence += skipped
        if skipped:
            took = (
                f"{late_s:.2g} s passed since the last one was due, period_s = {self._period_s:g}: choose a longer one"
            )
            self._count("skipped_polls", took, skipped)
        return due_s + (skipped + 1) * self._period_s

    def _wait_until(self, due_s: float) -> bool:
        """Write what is sent until a poll is due; returns whether to go on."""
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._stopping or self._writes, max(0.0, due_s - time.monotonic()))
                if self._stopping:
                    return False
                if not self._writes:
                    return True
                write = self._writes.pop(0)
            try:
                self.write(write.command)
            except Exception as error:  # noqa: BLE001
                self._finish(write, _reason(error))
            else:
                self._finish(write, "")

    def _finish(self, write: _Write, failure: str) -> None:
        with self._wake:
            write.failure = failure
            write.is_done.set()
            is_known = write.is_awaited
        if failure and not is_known:
            self._count("failed_writes", failure)

    def _deliver_reading(self, reading: Polled) -> None:
        if isinstance(reading, Sequence):
            for batch in reading:
                self._deliver(batch)
            return
        item = replace(reading, sequence=self._sequence % UINT32) if isinstance(reading, Reading) else reading
        self._sequence += 1
        self._deliver(ReadingBatch(HOST_CLOCK.now_ns(), (item,)))

    def _count(self, kind: str, detail: str, times: int = 1) -> None:
        settings = "period_s" if kind == "skipped_polls" else ""
        rejected = Rejected(kind, detail, setting=settings)
        self._deliver(ReadingBatch(HOST_CLOCK.now_ns(), (rejected,) * times))


def _reason(error: Exception) -> str:
    """Reason of an error in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, UserError) else f"unexpected {type(error).__name__}: {text}; waiting for it"
