"""Samples that a client pushes over the bus, as a source: their times, their numbers, and whose they are.

The clock of the client is treated as that of a device: it may be wrong by any time and drift, and
pipeline/timebase/device_clock.py maps it to host time (pipeline/timebase/receipt_times.py: samples that were kept).

A tray has one client at a time, the last one that appeared. What an earlier one still sends is refused, until the later
one has been silent for a while.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fantwin.pipeline.sources.push.config import PushConfig
from fantwin.pipeline.sources.source import LinkUp, Reading, ReadingBatch, Rejected, SourceContext, SourceEvent
from fantwin.pipeline.timebase.device_clock import NS_PER_US, UINT32
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes
from fantwin.schemas.channels import measured_columns
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS, PushedSamples
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT

SILENT_NS = 10 * NS_PER_S
"""silence after which a client gives its place to an earlier one"""
SHOWN_NS = 60 * NS_PER_S
"""time for which a second client is reported"""
MOST_EARLIER = 64
"""clients that are remembered"""


class PushSource:
    """A `SampleSource` that delivers nothing by itself: acquisition hands it what it reads from the bus."""

    name = "push"
    settings_to_check = ""

    def __init__(self, config: PushConfig, context: SourceContext) -> None:
        self._config = config
        self._rad_s_per_unit = RAD_S_PER_UNIT[context.speed_unit]
        self._client = ""
        self._heard_t_ns = 0
        """time when the present client was last heard"""
        self._receipts = ReceiptTimes()
        self._earlier: dict[str, None] = {}
        """clients that another one has followed"""
        self._second = ""
        self._second_until_t_ns = 0

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        """The bus is there from the start."""
        deliver(LinkUp())

    def stop(self) -> None:
        """Do nothing: no connection is kept here."""

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Send nothing: a program that pushes samples may hear commands on the bus."""
        return self._config.why_no_commands

    def check(self) -> list[str]:
        """Return no problem: a missing client is seen while it runs."""
        return []

    def problem(self, now_ns: int) -> str:
        """Problem for a minute after two clients have pushed samples of one tray; else empty."""
        if now_ns > self._second_until_t_ns:
            return ""
        return f"two clients push samples: {self._second} is ignored, because {self._client} came later; stop one"

    def events(self, message: PushedSamples, received_t_ns: int) -> list[SourceEvent]:
        """The readings of a message that was received at this host time; samples that cannot be used are `Rejected`."""
        samples, client = len(message.t_ns), message.header.producer
        if client != self._client and client in self._earlier and received_t_ns - self._heard_t_ns <= SILENT_NS:
            self._second, self._second_until_t_ns = client, received_t_ns + SHOWN_NS
            refused = Rejected("second_client", f"{client} is ignored, {self._client} came later", harmless=True)
            return [ReadingBatch(received_t_ns, (refused,) * samples)]
        events: list[SourceEvent] = []
        if client != self._client:
            self._begin(client)
            events.append(LinkUp())
        self._heard_t_ns = received_t_ns
        if np.any(np.diff(message.t_ns) <= 0):
            refused = Rejected("time_order", "sample times do not increase", is_sample=True)
            return [*events, ReadingBatch(received_t_ns, (refused,) * samples)]
        newest_t_ns = max(min(message.newest_t_ns, FURTHEST_T_NS), -FURTHEST_T_NS)
        ages_ns = newest_t_ns - message.t_ns
        if samples and not 0 <= int(ages_ns[-1]) <= int(ages_ns[0]) <= LARGEST_PERIOD_NS:
            refused = Rejected("absurd_age", "samples are newer than the newest, or older than a day", is_sample=True)
            return [*events, ReadingBatch(received_t_ns, (refused,) * samples)]
        times = self._receipts.of(received_t_ns, ages_ns.tolist())
        for t_ns, reading in zip(times, self._readings(message), strict=True):
            events.append(ReadingBatch(t_ns, (reading,)))
        return events

    def _begin(self, client: str) -> None:
        if self._client:
            self._earlier[self._client] = None
        self._earlier.pop(client, None)
        if len(self._earlier) > MOST_EARLIER:
            del self._earlier[next(iter(self._earlier))]
        self._client = client

    def _readings(self, message: PushedSamples) -> list[Reading]:
        command = message.command.tolist()
        speed = (message.speed_rad_s / self._rad_s_per_unit).tolist()
        clock_us = ((message.t_ns + NS_PER_US // 2) // NS_PER_US % UINT32).tolist()
        others = {name: values.tolist() for name, values in measured_columns(message).items()}
        return [
            Reading(
                tuple(command[row]),
                tuple(speed[row]),
                clock_us[row],
                (message.first_number + row) % UINT32,
                {name: tuple(values[row]) for name, values in others.items()},
            )
            for row in range(len(clock_us))
        ]
