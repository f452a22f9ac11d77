"""What a source has delivered."""

from __future__ import annotations

from fantwin.pipeline.sources.source import LinkDown, LinkUp, Noted, Reading, ReadingBatch, Rejected, SourceEvent


class Delivered(list[SourceEvent]):
    """Events in their order; `append` takes the next one."""

    @property
    def items(self) -> list[Reading | Rejected | Noted]:
        return [item for event in self if isinstance(event, ReadingBatch) for item in event.items]

    @property
    def readings(self) -> list[Reading]:
        return [item for item in self.items if isinstance(item, Reading)]

    @property
    def refused(self) -> list[Rejected]:
        return [item for item in self.items if isinstance(item, Rejected)]

    @property
    def noted(self) -> list[str]:
        """Kind and words of what the source has said of its device."""
        return [f"{item.kind}: {item.detail}" for item in self.items if isinstance(item, Noted)]

    @property
    def links(self) -> list[LinkUp | LinkDown]:
        return [event for event in self if not isinstance(event, ReadingBatch)]
