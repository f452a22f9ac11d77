"""Readings of one message are handed over together, in order, each with its time of receipt; none waits for long."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fantwin.pipeline.acquisition.sample_blocks import BlockEvent, ReadingBlock, SampleBlocks
from fantwin.pipeline.sources.source import LinkDown, LinkUp, Reading, ReadingBatch, SourceEvent

MS = 1_000_000
BLOCK_MS = 50


class FakeSource:
    """Delivers what a test gives it."""

    name = "fake"
    settings_to_check = ""

    def __init__(self) -> None:
        self.deliver: Callable[[SourceEvent], None] = lambda _event: None

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        self.deliver = deliver

    def stop(self) -> None:
        self.deliver(batch(999))

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        return "not connected"

    def check(self) -> list[str]:
        return []


def batch(t_ms: int, *, readings: int = 1) -> ReadingBatch:
    return ReadingBatch(t_ms * MS, (Reading((0.5,), (1.0,)),) * readings, byte_count=1)


def times_ms(event: BlockEvent | None) -> list[int]:
    """When the batches of a block were received."""
    assert isinstance(event, ReadingBlock), event
    return [each.received_t_ns // MS for each in event.batches]


@pytest.fixture
def blocks() -> SampleBlocks:
    blocks = SampleBlocks(FakeSource(), BLOCK_MS * MS)
    assert [times_ms(event) for event in blocks.add(batch(1000))] == [[1000]], "the first reading waits for nothing"
    return blocks


def add_all(blocks: SampleBlocks, batches: list[ReadingBatch]) -> list[tuple[int, list[int]]]:
    """When blocks are due, and what each holds, ms."""
    return [(each.received_t_ns // MS, times_ms(due)) for each in batches for due in blocks.add(each)]


def test_a_block_is_due_with_the_last_reading_that_is_expected_in_it(blocks: SampleBlocks) -> None:
    assert add_all(blocks, [batch(t_ms) for t_ms in range(1010, 1130, 10)]) == [
        (1050, [1010, 1020, 1030, 1040, 1050]),
        (1100, [1060, 1070, 1080, 1090, 1100]),
    ]


def test_readings_of_a_slow_line_wait_for_nothing_also_in_pieces(blocks: SampleBlocks) -> None:
    pieces = [batch(t_ms, readings=t_ms % 2) for t_ms in (1100, 1105, 1200, 1205, 1300, 1305)]
    assert add_all(blocks, pieces) == [(1105, [1100, 1105]), (1205, [1200, 1205]), (1305, [1300, 1305])]


def test_the_stage_takes_what_waits_only_after_the_time_of_a_block(blocks: SampleBlocks) -> None:
    (last,) = blocks.add(LinkUp())
    assert blocks.add(batch(1010)) == blocks.add(batch(1020)) == []
    assert blocks.take_waiting(1059 * MS, last) is None
    assert times_ms(blocks.take_waiting(1060 * MS, last)) == [1010, 1020]
    assert blocks.take_waiting(9999 * MS, last) is None


def test_nothing_overtakes_what_is_on_its_way_to_the_stage(blocks: SampleBlocks) -> None:
    (*_, on_its_way) = [due for t_ms in range(1010, 1060, 10) for due in blocks.add(batch(t_ms))]
    blocks.add(batch(1060))
    assert blocks.take_waiting(9999 * MS, None) is None
    assert times_ms(blocks.take_waiting(9999 * MS, on_its_way)) == [1060]


@pytest.mark.parametrize("change", [LinkUp(), LinkDown("gone")])
def test_a_change_of_the_line_comes_after_what_waits(blocks: SampleBlocks, change: LinkUp | LinkDown) -> None:
    blocks.add(batch(1010))
    block, then = blocks.add(change)
    assert times_ms(block) == [1010] and then is change


def test_what_still_waits_when_the_source_stops_is_delivered_and_none_stays() -> None:
    source = FakeSource()
    blocks, events = SampleBlocks(source, BLOCK_MS * MS), list[BlockEvent]()
    blocks.start(events.append)
    for t_ms in (980, 990):
        source.deliver(batch(t_ms))
    blocks.stop()
    assert [times_ms(event) for event in events] == [[980], [990, 999]]
    assert blocks.take_rest() is None
