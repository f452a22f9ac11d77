"""What a client has published and acquisition has not confirmed: in a queue, or sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.topics import CATCH_UP_MESSAGES

MOST_SAMPLES, MOST_FAN_SAMPLES = 1024, 1024 * 32
"""of one message; what waits is joined up to this"""
MOST_SENT_MESSAGES = CATCH_UP_MESSAGES // 2
MOST_SENT_BYTES = 8 << 20
"""sent and not confirmed: a publisher keeps twice as much, so whatever acquisition has missed can be asked for"""


@dataclass(frozen=True, eq=False, slots=True)
class Block:
    """Samples of one call of `publish`. Arrays: (n,), (n, fans), (n, fans); speed in rad/s.

    first_number: of the first sample. line: blocks of one line have increasing times. others: what else was measured,
    (n, fans), by the name of its column.
    """

    t_ns: NDArray[np.int64]
    command: NDArray[np.float64]
    speed_rad_s: NDArray[np.float64]
    first_number: int
    line: int
    others: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    def rows(self, first: int, end: int) -> Block:
        """The samples `first` to `end - 1`."""
        return Block(
            self.t_ns[first:end],
            self.command[first:end],
            self.speed_rad_s[first:end],
            self.first_number + first,
            self.line,
            {name: values[first:end] for name, values in self.others.items()},
        )

    def goes_on_with(self, other: Block) -> bool:
        """Whether both can be in one message."""
        return self.line == other.line and self.others.keys() == other.others.keys()


def most_samples_joined(fans: int) -> int:
    """The most samples in one message of `fans` fans; fewer than the bus accepts (`schemas.topics.most_samples`)."""
    return max(1, min(MOST_SAMPLES, MOST_FAN_SAMPLES // fans))


def join_blocks(blocks: Sequence[Block]) -> Block:
    """One block of blocks that follow each other and go on with each other."""
    first = blocks[0]
    if len(blocks) == 1:
        return first
    return Block(
        np.concatenate([block.t_ns for block in blocks]),
        np.concatenate([block.command for block in blocks]),
        np.concatenate([block.speed_rad_s for block in blocks]),
        first.first_number,
        first.line,
        {name: np.concatenate([block.others[name] for block in blocks]) for name in first.others},
    )


class Outbox:
    """Blocks that wait, and the messages that were sent. Not safe for several threads by itself."""

    def __init__(self) -> None:
        self._blocks: deque[Block] = deque()
        self._sent: deque[tuple[int, int, int]] = deque()
        """of each message: sequence number, samples, bytes"""
        self._sent_bytes = 0
        self.waiting = 0
        """samples in the queue"""
        self.sent = 0
        """samples that were sent and are not confirmed"""
        self.received = 0
        """samples that were confirmed"""

    @property
    def samples(self) -> int:
        """Those that are not confirmed."""
        return self.waiting + self.sent

    @property
    def may_send(self) -> bool:
        """Whether another message may be sent before one is confirmed."""
        return len(self._sent) < MOST_SENT_MESSAGES and self._sent_bytes < MOST_SENT_BYTES

    def add(self, block: Block) -> None:
        """Add a block behind the others, in pieces that fit into a message."""
        samples, fans = block.command.shape
        most = most_samples_joined(fans)
        self._blocks += [block.rows(first, first + most) for first in range(0, samples, most)]
        self.waiting += samples

    def take(self) -> tuple[Block, int]:
        """The samples of the next message, and the time of the newest one that waits behind them on their line, ns.
        There must be some."""
        first = self._blocks.popleft()
        taken, samples, fans = [first], len(first.t_ns), first.command.shape[1]
        most = most_samples_joined(fans)
        while self._blocks and first.goes_on_with(self._blocks[0]) and samples + len(self._blocks[0].t_ns) <= most:
            taken.append(self._blocks.popleft())
            samples += len(taken[-1].t_ns)
        self.waiting -= samples
        behind = next((block for block in reversed(self._blocks) if block.line == first.line), taken[-1])
        return join_blocks(taken), int(behind.t_ns[-1])

    def add_sent(self, sequence: int, samples: int, size: int) -> None:
        """A message has been sent: its sequence number, samples and bytes."""
        self._sent.append((sequence, samples, size))
        self._sent_bytes += size
        self.sent += samples

    def confirm(self, before: int) -> bool:
        """All messages with sequence numbers below `before` have been received; whether any of them was not confirmed
        yet."""
        is_news = bool(self._sent) and self._sent[0][0] < before
        while self._sent and self._sent[0][0] < before:
            _, samples, size = self._sent.popleft()
            self._sent_bytes -= size
            self.sent -= samples
            self.received += samples
        return is_news
