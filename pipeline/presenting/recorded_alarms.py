"""The history of alarms of before a gateway's first start: read once, in the background, from what the recorder has
written on this host.

The alarms are found by the index of each recording, so little of it is read. A part that has none, as after a crash, or
that is still being written, is read as a whole.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

from pipeline.errors import UserError
from pipeline.presenting.site_model import SiteModel
from pipeline.recordings.parts import part_files
from pipeline.recordings.rare_messages import rare_messages
from pipeline.recordings.records import ACTIVE_SUFFIX, CORRUPT_DATA_ERRORS, indexed_reader
from schemas.messages import Alarm
from schemas.topics import tray_key, tray_of

MOST_PARTS = 2000
"""of a recording: the newest ones, 200 GB"""
BATCH = 500
"""transitions that are kept at a time, since the pages wait meanwhile"""
READER = "recordings"


class RecordedAlarms:
    """Reads the recordings in a thread of its own, unless that was done before."""

    def __init__(self, model: SiteModel, recordings: Sequence[Path]) -> None:
        """recordings: the first part of each, NAME.mcap; those of shards are several."""
        self._model = model
        self._recordings = recordings
        self._began_t_ns: dict[Path, int] = {}
        """by recording: when the first part of it began that was read"""
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._read, name="recorded alarms", daemon=True)
        self.problem = ""
        """why alarms of recordings are missing; empty if none are"""

    def start(self) -> None:
        """Begin, unless it has been done, or the history cannot be read, which it says itself."""
        with suppress(UserError):
            if not self._model.has_read(READER):
                self._thread.start()

    def stop(self) -> None:
        """End, even if there is more to read: it is read after the next start."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def is_reading(self) -> bool:
        """Whether earlier alarms may still come."""
        return self._thread.is_alive()

    def _read(self) -> None:
        """Keep the alarms, the newest first, until all are read or the history is full."""
        found = heapq.merge(*map(self._newest_first, self._recordings), key=lambda alarm: -alarm.t_ns)
        try:
            while batch := list(islice(found, BATCH)):
                kept = self._model.add_earlier_alarms(batch)
                if kept < len(batch):
                    self._began_t_ns = {Path(): batch[kept - 1].t_ns} if kept else {}
                    break
            if not self._stopped.is_set():  # of shards, all are complete from where the last one begins
                self._model.finish_reading(READER, max(self._began_t_ns.values(), default=None))
        except UserError as error:
            self.problem = str(error)

    def _newest_first(self, recording: Path) -> Iterator[Alarm]:
        """The alarms of one recording; one part at a time is in memory."""
        endings = (recording.suffix, f"{recording.suffix}{ACTIVE_SUFFIX}")
        parts = [path for _, path in sorted(part_files(recording), reverse=True) if path.name.endswith(endings)]
        for path in parts[:MOST_PARTS]:
            if self._stopped.is_set():
                return
            try:
                alarms = [
                    envelope.message
                    for envelope in reversed(rare_messages(path, "alarm"))
                    if envelope.key == tray_key(self._model.site, tray_of(envelope.key), "alarm")
                ]
                began_t_ns = _began_t_ns(path)
            except (UserError, OSError) as error:
                self.problem = f"the history lacks the alarms of a recording: {error}"
                continue
            yield from (alarm for alarm in alarms if isinstance(alarm, Alarm))
            if began_t_ns:
                self._began_t_ns[recording] = began_t_ns


def _began_t_ns(path: Path) -> int:
    """When a part began, by its index; 0 without one."""
    with suppress(*CORRUPT_DATA_ERRORS), path.open("rb") as file:
        summary = indexed_reader(file).get_summary()
        if summary is not None and summary.statistics is not None:
            return summary.statistics.message_start_time
    return 0
