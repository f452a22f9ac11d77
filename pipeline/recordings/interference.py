"""What other programs did to the files of a recording while they were written: counted, and said for a minute."""

from __future__ import annotations

from collections import Counter

from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.units import NS_PER_S

NEWS_SHOWN_NS = 60 * NS_PER_S
"""how long health reports it"""


class Interference:
    """Watches one part after the other."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        """files that were restored, and messages lost with their file"""
        self._news = ""
        self._news_ns = 0

    def check(self, part: RecordingWriter, now_ns: int) -> None:
        """Report what was done to a part since it was last asked. `lost` it has only once it has ended."""
        done = ""
        if part.restored:
            self.counts["files_restored"] += part.restored
            part.restored = 0
            done = "deleted, moved or replaced the file while it was written; it was restored with all messages"
        if part.lost:
            self.counts["lost_deleted"] += part.lost
            done = f"deleted or cut the file while it was written; messages lost with it: {part.lost}"
        if done:
            self._news_ns = now_ns
            self._news = f"{part.path}: another program {done}; keep other programs away from it"

    def clock_set_back(self, now_ns: int) -> None:
        """The host's clock was set back to `now_ns`."""
        self._news_ns = min(self._news_ns, now_ns)

    def problem(self, now_ns: int) -> str:
        """What happened last, while it is recent; empty if nothing."""
        return self._news if now_ns - self._news_ns < NEWS_SHOWN_NS else ""
