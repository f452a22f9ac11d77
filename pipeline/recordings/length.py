"""How long a recording can be at most, from its index: without reading its samples."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS, indexed_reader
from fantwin.schemas.topics import topic_of
from fantwin.schemas.units import NS_PER_S


def longest_s(path: Path, first_sample_t_ns: int) -> float:
    """An upper bound of the time from the first raw sample of a recording to its last, s; infinite without an index.

    A host clock that was set back shortens it by the pause between two chunks at most: they show by how much it was.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        try:
            reader = indexed_reader(file)
            summary = reader.get_summary()
            if summary is None:
                return math.inf
            raw = [channel.topic for channel in summary.channels.values() if _is_raw(channel.topic)]
            _, _, last = next(reader.iter_messages(raw, reverse=True))
        except (StopIteration, *CORRUPT_DATA_ERRORS):
            return math.inf
    chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
    back_ns = sum(max(0, one.message_end_time - next_.message_start_time) for one, next_ in pairwise(chunks))
    newest_t_ns = last.publish_time  # the writer puts the time of the newest sample there
    return max(0, newest_t_ns - first_sample_t_ns + back_ns) / NS_PER_S


def _is_raw(key: str) -> bool:
    try:
        return topic_of(key).name == "raw"
    except KeyError:
        return False
