"""What goes into one message: events that come close together, and those of quiet hours."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Self

from fantwin.pipeline.outputs.notify.config import TargetConfig
from fantwin.pipeline.outputs.notify.deciding import Happened, Kind
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.units import NS_PER_S

GATHER_S = 5.0
"""how long a message waits for others that it could be combined with"""
DIGEST_ABOVE = 3
"""messages about more fans than this are combined into one"""
DIGEST_WITHIN_S, LONGEST_S = 30.0, 600.0
"""while more fans keep coming, a combined message waits for up to the first, and each further one twice as long as the
one before, up to the second"""


@dataclass
class Gathered:
    """What goes into the next message. Times are those of the host.

    Attributes:
        in_a_row: how many messages before this one were sent although more fans kept coming.
    """

    opened_ns: int = 0
    newest_ns: int = 0
    in_a_row: int = 0
    fans: dict[Fan, Happened] = field(default_factory=dict)

    def add(self, fan: Fan, happened: Happened, now_ns: int) -> None:
        """Add what has happened to a fan, after what is gathered of it already."""
        if not self.fans:
            self.opened_ns = now_ns
        self.newest_ns = now_ns
        self.fans[fan] = self.fans.get(fan, Happened()).then(happened)

    def to_json(self) -> str:
        """For the outbox."""
        fans = [(*fan, list(each.kinds), each.number) for fan, each in self.fans.items()]
        return json.dumps([self.opened_ns, self.newest_ns, self.in_a_row, fans])

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What `to_json` wrote."""
        opened_ns, newest_ns, in_a_row, fans = json.loads(text)
        happened = {Fan(t, f): Happened(tuple(map(Kind, kinds)), number) for t, f, kinds, number in fans}
        return cls(opened_ns, newest_ns, in_a_row, happened)


def is_due(gathered: Gathered, now_ns: int) -> bool:
    """Whether it becomes a message now. A clock that was set back holds nothing up."""
    if not gathered.fans:
        return False
    waited_ns, silent_ns = abs(now_ns - gathered.opened_ns), abs(now_ns - gathered.newest_ns)
    gather_ns = GATHER_S * NS_PER_S
    if len(gathered.fans) <= DIGEST_ABOVE:
        return waited_ns >= gather_ns
    return silent_ns >= gather_ns or waited_ns >= _longest_ns(gathered)


def next_after(gathered: Gathered, now_ns: int) -> Gathered:
    """What is gathered after a message: nothing. If more fans kept coming, it then waits twice as long for them."""
    is_many = len(gathered.fans) > DIGEST_ABOVE
    keep_coming = is_many and abs(now_ns - gathered.newest_ns) < GATHER_S * NS_PER_S
    return Gathered(in_a_row=gathered.in_a_row + 1 if keep_coming else 0)


def _longest_ns(gathered: Gathered) -> float:
    return min(LONGEST_S, DIGEST_WITHIN_S * 2 ** min(gathered.in_a_row, 10)) * NS_PER_S


def is_quiet(target: TargetConfig, now_ns: int) -> bool:
    """Whether it is a quiet hour of a target, in the time zone of the host."""
    if target.quiet_times is None:
        return False
    now = datetime.fromtimestamp(now_ns / NS_PER_S).time()
    begin, end = target.quiet_times
    return begin <= now < end if begin < end else now >= begin or now < end


def ranges(numbers: Iterable[int]) -> str:
    """Numbers of fans, short: `0-3, 7`."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    return ", ".join("-".join(map(str, part)) for part in parts)
