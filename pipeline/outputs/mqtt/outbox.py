"""What has to be sent to the broker: the newest text of each retained topic, and answers, each once.

It holds one text a topic, however long the broker is away or slow.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from pydantic_core import to_json

MOST_ANSWERS = 256
"""that wait; of more, the oldest are dropped: whoever asked has long given up"""
REMOVED = ""
"""a retained topic with this text is deleted by the broker"""


class Outgoing(NamedTuple):
    """A message to the broker."""

    topic: str
    text: str
    is_retained: bool


class Outbox:
    """Urgent topics are sent first, each kind in the order in which its topics changed."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        """of all retained topics"""
        self._urgent: dict[str, None] = {}
        self._ordinary: dict[str, None] = {}
        """topics whose text has not been sent"""
        self._answers: deque[tuple[str, str]] = deque(maxlen=MOST_ANSWERS)

    def __len__(self) -> int:
        return len(self._urgent) + len(self._ordinary) + len(self._answers)

    def retain(self, topic: str, text: str, *, is_urgent: bool = False) -> None:
        """Send a text if the topic has another one now."""
        if self._texts.get(topic) == text:
            return
        self._texts[topic] = text
        if is_urgent:
            self._ordinary.pop(topic, None)
            self._urgent[topic] = None
        elif topic not in self._urgent:
            self._ordinary[topic] = None

    def answer(self, topic: str, text: str) -> None:
        """Send a text once, which nobody keeps."""
        self._answers.append((topic, text))

    def renew(self) -> None:
        """Send all retained topics again: the broker may have lost them."""
        for topic in self._texts:
            if topic not in self._urgent:
                self._ordinary[topic] = None

    def take(self, most: int) -> list[Outgoing]:
        """What is to be sent now; it is taken for sent."""
        taken: list[Outgoing] = []
        while len(taken) < most and self._urgent:
            taken.append(self._retained(self._urgent))
        while len(taken) < most and self._answers:
            taken.append(Outgoing(*self._answers.popleft(), is_retained=False))
        while len(taken) < most and self._ordinary:
            taken.append(self._retained(self._ordinary))
        return taken

    def _retained(self, waiting: dict[str, None]) -> Outgoing:
        topic = next(iter(waiting))
        del waiting[topic]
        return Outgoing(topic, self._texts[topic], is_retained=True)


def text_of(value: Any) -> str:
    """JSON that any program reads: NaN and infinity, which JSON does not have, become null."""
    return to_json(value, inf_nan_mode="null").decode()
