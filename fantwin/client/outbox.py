"""What a client has published and acquisition has not confirmed: in a queue, or sent."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from fantwin.schemas.blocks import can_join, cut, join
from fantwin.schemas.messages import PushedSamples
from fantwin.schemas.topics import CATCH_UP_MESSAGES

MOST_SAMPLES, MOST_FAN_SAMPLES = 1024, 1024 * 32
"""of one message; what waits is joined up to this"""
MOST_SENT_MESSAGES = CATCH_UP_MESSAGES // 2
MOST_SENT_BYTES = 8 << 20
"""sent and not confirmed: a publisher keeps twice as much, so whatever acquisition has missed can be asked for"""


def most_samples_joined(fans: int) -> int:
    """The most samples in one message of `fans` fans; fewer than the bus accepts (`schemas.topics.most_samples`)."""
    return max(1, min(MOST_SAMPLES, MOST_FAN_SAMPLES // fans))


class Outbox:
    """Blocks that wait, and the messages that were sent. Not safe for several threads by itself."""

    def __init__(self) -> None:
        self._blocks: deque[tuple[int, PushedSamples]] = deque()
        """with the line of each: samples of one line have increasing times"""
        self._taken = 0
        """samples that have left the queue"""
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

    def add(self, samples: PushedSamples, line: int) -> None:
        """Add samples behind the others, in pieces that fit into a message."""
        count, most = len(samples.t_ns), most_samples_joined(samples.fans)
        for first in range(0, count, most):
            self._blocks.append((line, cut(samples, first, min(first + most, count))))
        self.waiting += count

    def take(self) -> PushedSamples:
        """The samples of the next message, with their number and the time of the newest one that waits behind them on
        their line. There must be some."""
        line, first = self._blocks.popleft()
        taken, count, most = [first], len(first.t_ns), most_samples_joined(first.fans)
        while self._blocks:
            next_line, block = self._blocks[0]
            if next_line != line or not can_join(first, block) or count + len(block.t_ns) > most:
                break
            taken.append(self._blocks.popleft()[1])
            count += len(block.t_ns)
        behind = next((block for of, block in reversed(self._blocks) if of == line), taken[-1])
        message = replace(join(taken), first_number=self._taken, newest_t_ns=int(behind.t_ns[-1]))
        self.waiting -= count
        self._taken += count
        return message

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
