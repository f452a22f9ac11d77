"""Detection of input whose times have gone back for good: it is dropped as repeated, and nothing is judged.

A stage that restarts repeats what its producers have kept, and catches up at once. If the host clock was set back and
the stages before this one were restarted, its input remains older than what it has had.
"""

from __future__ import annotations

from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

REPORTED_AFTER_NS = 10 * NS_PER_S  # of dropped samples one after the other


class OldSamples:
    """The samples dropped since the last new one."""

    def __init__(self) -> None:
        self._dropped_ns = self._behind_ns = 0

    def add(self, t_ns: Array, period_ns: int, last_t_ns: int) -> None:
        """A block, all of it not newer than `last_t_ns`, was dropped."""
        self._dropped_ns += len(t_ns) * period_ns
        self._behind_ns = last_t_ns - int(t_ns[-1])

    def clear(self) -> None:
        """Note a new sample."""
        self._dropped_ns = self._behind_ns = 0

    def problem(self, input_name: str, stages: str) -> str:
        """Advice in one line; empty if nothing is wrong. stages: those to restart."""
        if self._dropped_ns < REPORTED_AFTER_NS:
            return ""
        return (
            f"{input_name} are {self._behind_ns / NS_PER_S:.0f} s older than those before and not judged: the host "
            f"clock was set back, or another recording is replayed; restart {stages}"
        )
