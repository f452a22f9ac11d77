"""How long a recording can be at most, from its index: without reading its samples."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS
from fantwin.schemas.units import NS_PER_S


def longest_s(path: Path, first_sample_t_ns: int) -> float:
    """An upper bound of the time from the first raw sample of a recording to its last, s; infinite without an index.

    A host clock that was set back shortens it by the pause between two chunks at most: they show by how much it was.

    Raises:
        OSError: the file cannot be read.
    """
    indexed = IndexedRecording.of(path, ("raw",))
    if indexed is None or not indexed.chunks:
        return math.inf
    try:
        newest = indexed.envelopes(max(indexed.chunks, key=lambda chunk: chunk.message_end_time))
    except CORRUPT_DATA_ERRORS:
        return math.inf
    last = max(newest, key=lambda envelope: envelope.received_t_ns)
    back_ns = sum(max(0, one.message_end_time - next_.message_start_time) for one, next_ in pairwise(indexed.chunks))
    return max(0, last.newest_t_ns - first_sample_t_ns + back_ns) / NS_PER_S
