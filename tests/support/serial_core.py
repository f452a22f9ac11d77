"""An acquisition core behind a serial source, fed with the bytes of the line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fantwin.pipeline.acquisition.acquisition_core import AcquisitionCore, Item
from fantwin.pipeline.acquisition.sample_blocks import SampleBlocks
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.pipeline.sources.serial.port import ReceivedBytes
from fantwin.pipeline.sources.serial.source import ByteLink, SerialSource
from fantwin.pipeline.sources.source import LinkDown, LinkUp, ReadingBatch, SourceContext
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK, HostClock
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.acquisition import AcquisitionConfig


class FakeLink:
    """Stores the bytes written, and accepts none while it is not `up`."""

    def __init__(self) -> None:
        self.up = True
        self.written = b""

    def start(self, deliver: Callable[[LinkUp | LinkDown | ReceivedBytes], None]) -> None:
        raise AssertionError("tests hand the bytes to the core themselves")

    def stop(self) -> None:
        raise AssertionError("never started")

    def write(self, data: bytes) -> bool:
        self.written += data if self.up else b""
        return self.up


class SerialCore(AcquisitionCore):
    """Decodes bytes and puts readings into blocks, as is done before the core gets them."""

    def __init__(
        self,
        tray: TrayConfig,
        config: AcquisitionConfig,
        link: ByteLink,
        started_t_ns: int = 0,
        host_clock: HostClock = HOST_CLOCK,
    ) -> None:
        assert isinstance(tray.source, SerialConfig)
        self.source = SerialSource(tray.source, SourceContext(tray.fans, tray.speed_unit, Path()), link)
        self.blocks = SampleBlocks(self.source, round(config.block_s * NS_PER_S))
        super().__init__(tray, self.source, self.blocks, started_t_ns, host_clock)

    def step(self, item: Item | ReadingBatch | ReceivedBytes) -> list[Raw]:
        if isinstance(item, ReceivedBytes | LinkUp | LinkDown):
            item = self.source.decode(item)
        if isinstance(item, ReadingBatch | LinkUp | LinkDown):
            return [raw for event in self.blocks.add(item) for raw in super(SerialCore, self).step(event)]
        return super().step(item)
