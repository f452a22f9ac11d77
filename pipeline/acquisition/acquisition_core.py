"""The acquisition of one tray: readings in, raw samples out; commands back to the device.

What is done here is the same for all sources: check ranges, count lost and repeated samples, convert units, make
messages of samples.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

from fantwin.pipeline.acquisition.device_commands import DeviceCommands
from fantwin.pipeline.acquisition.input_quality import InputQuality, Plausibility
from fantwin.pipeline.acquisition.sample_blocks import (
    BlockEvent,
    DeviceSequence,
    ReadingBlock,
    ReceivedReading,
    SampleBlocks,
    raw_message,
)
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.runtime.stage import Core
from fantwin.pipeline.sources.push.source import PushSource
from fantwin.pipeline.sources.source import (
    LinkUp,
    Noted,
    Reading,
    ReadingBatch,
    ReadingLimits,
    SampleSource,
)
from fantwin.pipeline.sources.stand_in import with_stand_in
from fantwin.pipeline.timebase.host_clock import HostClock
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.health import AcceptedSamples, NamedFan
from fantwin.schemas.messages import Command, PushedSamples, Raw, StatedTacho
from fantwin.schemas.topics import most_samples
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT

STEP_SHOWN_NS = 60 * NS_PER_S  # how long health says that the host clock was set


def limits_of(tray: TrayConfig) -> ReadingLimits:
    """Limits for the accepted readings of a tray."""
    return ReadingLimits(tray.fans, tray.command_min, tray.command_max, tray.speed_max, bool(tray.command_from))


Item: TypeAlias = BlockEvent | Command | PushedSamples


class AcquisitionCore(Core):
    """Acquisition of one tray. Everything that arrives is either published or counted by kind; no input raises an
    exception."""

    def __init__(
        self,
        tray: TrayConfig,
        source: SampleSource,
        blocks: SampleBlocks,
        started_t_ns: int,
        host_clock: HostClock,
    ) -> None:
        """source: takes commands. blocks: its readings. host_clock: gives the times of receipt and of ticks; its steps
        are reported."""
        self._tray = tray
        self._host_clock = host_clock
        self._seen_step = host_clock.last_step
        self._source = source
        self._blocks = blocks
        self._processed: BlockEvent | None = None
        """the last event of the blocks"""
        self._sequence = DeviceSequence()
        self._most_samples = most_samples(tray.fans)
        """samples in a message, however fast a line is"""
        self._stated_tachos = tuple(map(StatedTacho.of, tray.stated_tachos))
        self._commands = DeviceCommands(tray, source)
        self._counts: Counter[str] = Counter()
        self._down_reason: str | None = None
        self._now_ns = started_t_ns
        self._quality = InputQuality(started_t_ns, getattr(tray.source, "period_s", 0.0))
        self._plausibility = Plausibility(limits_of(tray), tray.speed_unit, self._counts, self._quality, self._sequence)

    def step(self, item: Item) -> list[Raw]:
        """Handle input from the source, a change of its connection, or a command to send."""
        if isinstance(item, Command):
            self._commands.send(item, self._down_reason)
            return []
        if isinstance(item, PushedSamples):
            return self._take_pushed(item)
        return self._take(item)

    def _take_pushed(self, item: PushedSamples) -> list[Raw]:
        """Handle samples of a client as those of any source."""
        if not isinstance(self._source, PushSource):
            self._counts["refused_readings"] += len(item.t_ns)
            return []
        events = self._source.events(item, self._host_clock.now_ns())
        return [raw for event in events for block in self._blocks.add(event) for raw in self._take(block)]

    def _take(self, item: BlockEvent) -> list[Raw]:
        self._processed = item
        if isinstance(item, ReadingBlock):
            return self._receive(item)
        if isinstance(item, LinkUp):
            self._counts["line_up"] += 1
            self._down_reason = None
            self._quality.start_waiting(self._now_ns)
        else:
            self._counts["line_down"] += self._down_reason is None  # the reason may change while it is down
            self._down_reason = item.reason
        self._sequence.connection_interrupted()
        self._quality.connection_changed()
        return []

    def tick(self, now_ns: int) -> list[Raw]:
        """Publish what has waited long enough for more."""
        self._follow_host_clock()
        self._now_ns = now_ns
        waiting = self._blocks.take_waiting(now_ns, self._processed)
        return self._receive(waiting) if waiting else []

    def close(self) -> list[Raw]:
        """Publish what a source that has not ended in time has kept."""
        rest = self._blocks.take_rest()
        return self._receive(rest) if rest else []

    def counters(self) -> Mapping[str, int]:
        """Input by kind; docs/reference/wire-protocol.md explains each counter."""
        steps = {"host_clock_steps": self._host_clock.steps} if self._host_clock.steps else {}
        lost_refused = self._counts["lost_refused"] + self._sequence.refused
        return {
            **self._counts,
            **self._commands.counts,
            **({"lost_refused": lost_refused} if lost_refused else {}),
            **steps,
        }

    def notes(self) -> list[str]:
        """Notes on what the source measures beside command and speed, and on refused or lost input and commands."""
        also = ", ".join(column.title for column in CHANNELS if column in self._plausibility.measured)
        found = [f"the source also measures {also}"] if also else []
        found += [
            f"refused input: {kind} {self._counts[kind]}, the first of them: {detail}"
            for kind, detail in self._plausibility.first_refused.items()
        ]
        found += [f"{detail} ({kind} {self._counts[kind]})" for kind, detail in self._plausibility.last_noted.items()]
        return [*found, *self._commands.notes()]

    def samples_in(self, item: Item) -> int:
        """The readings in a block."""
        batches = item.batches if isinstance(item, ReadingBlock) else ()
        return sum(isinstance(each, Reading) for batch in batches for each in batch.items)

    def problem(self) -> str:
        """Problem of the connection now, and for a minute that the host clock was set."""
        of_clients = self._source.problem(self._now_ns) if isinstance(self._source, PushSource) else ""
        return "; ".join(filter(None, (of_clients, self._problem_of_line(), self._problem_of_host_clock())))

    def accepts(self) -> AcceptedSamples | None:
        """The ranges of the tray, where its samples are pushed."""
        tray = self._tray
        if not tray.source.takes_pushed:
            return None
        speed_max_rad_s = tray.speed_max * RAD_S_PER_UNIT[tray.speed_unit]
        return AcceptedSamples(
            tray=tray.name,
            fans=tray.fans,
            command_min=tray.command_min,
            command_max=tray.command_max,
            speed_max_rad_s=speed_max_rad_s,
            named=tuple(NamedFan(name=fan.name, place=fan.place) for fan in tray.fan) if any(tray.names.names) else (),
        )

    def _problem_of_host_clock(self) -> str:
        step = self._host_clock.last_step
        if step is None or self._now_ns - step.at_ns > STEP_SHOWN_NS:
            return ""
        way = "back" if step.step_ns < 0 else "forward"
        was_set = f"the host clock was set {way} by {abs(step.step_ns) / NS_PER_S:.0f} s"
        if step.ahead_ns:
            ahead = f"{step.ahead_ns / NS_PER_S:.0f} s ahead of it"
            return f"{was_set}: sample times continue without a step, {ahead}, until the site is restarted"
        return f"{was_set}, or the host was suspended: sample times follow it"

    def _problem_of_line(self) -> str:
        if self._down_reason is not None:
            return f"{self._source.name}: {self._down_reason}"
        settings = ", ".join(filter(None, (self._source.settings_to_check, f"fans = {self._tray.fans}")))
        problem = self._quality.problem(self._now_ns, settings)
        return f"{self._source.name}: {problem}" if problem else ""

    def _follow_host_clock(self) -> None:
        """A clock that was set forward is no silence."""
        step = self._host_clock.last_step
        if step is not self._seen_step:
            self._seen_step = step
            if step and not step.ahead_ns:
                self._quality.wait_no_longer_than_since(step.at_ns)

    def _receive(self, block: ReadingBlock) -> list[Raw]:
        """A message of the samples of the block; several if these are many or differ in their columns."""
        messages: list[Raw] = []
        samples: list[ReceivedReading] = []
        for batch in block.batches:
            for received in self._samples(batch):
                if samples and (len(samples) == self._most_samples or received.columns != samples[0].columns):
                    messages += self._message(samples)
                    samples = []
                samples.append(received)
        return [*messages, *self._message(samples)]

    def _message(self, samples: Sequence[ReceivedReading]) -> list[Raw]:
        return [raw_message(samples, self._tray, self._stated_tachos)] if samples else []

    def _samples(self, batch: ReadingBatch) -> Iterator[ReceivedReading]:
        """The samples that are new and plausible; all others are counted."""
        if batch.byte_count:
            self._counts["bytes"] += batch.byte_count
        for name, count in batch.device_counts.items():
            self._counts[f"device_{name}"] += count
        is_note = len(batch.items) > 0 and all(isinstance(item, Noted) for item in batch.items)
        if not is_note:  # several come with one reading, and would make a slow source seem fast
            self._quality.add_input(batch.received_t_ns)
        self._now_ns = max(self._now_ns, batch.received_t_ns)
        for item in batch.items:
            reading = self._plausibility.plausible(item)
            if reading is not None and self._sequence.is_new(reading, self._counts):
                self._counts["samples"] += 1
                reading = self._plausibility.with_plausible_columns(reading)
                if self._tray.command_from:
                    reading = with_stand_in(reading, self._tray.command_from, RAD_S_PER_UNIT[self._tray.speed_unit])
                    self._plausibility.count_unknown(reading, f"command_from = {self._tray.command_from}")
                yield ReceivedReading(reading, batch.received_t_ns)
