"""Fans whose command answers their speed in recordings of ordinary operation: a sweep has opened their loop.

The first minutes of each recording are read, and no fit is made.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fantwin.pipeline.learning.training_data import training_data_of
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.training_runs import recorded_tray
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

if TYPE_CHECKING:
    from fantwin.schemas.twin_card import TwinCard

LOOKED_AT_NS = 1200 * NS_PER_S
"""time of each recording that is looked at: a controller shows within minutes"""


def closed_loops(card: TwinCard, healthy: Iterable[Path], tray: str | None) -> tuple[bool, ...]:
    """Find whether the command of each fan of a twin answers its speed: in training, or in one of the recordings.

    tray: of those of the recordings, all without it.
    """
    numbers = set().union(*(_fans_in_loops(path, tray) for path in healthy))
    before = card.closed_loop or (False,) * card.fans
    if card.fans == 1:
        return (before[0] or bool(numbers),)
    return tuple(closed or fan in numbers for fan, closed in zip(card.fan_numbers, before, strict=True))


def _fans_in_loops(path: Path, tray: str | None) -> set[int]:
    from fantwin.twin.fitting.identifiability import feedback_share  # noqa: PLC0415  loads twin only when it is needed

    raws: dict[str, list[Raw]] = {}
    first_t_ns: int | None = None
    for envelope in read_recording(path, ("raw",), tray):
        raw = envelope.message
        if not isinstance(raw, Raw) or not len(raw.host_receive_t_ns):
            continue
        first_t_ns = int(raw.host_receive_t_ns[0]) if first_t_ns is None else first_t_ns
        if raw.host_receive_t_ns[0] > first_t_ns + LOOKED_AT_NS:
            break
        raws.setdefault(raw.header.tray, []).append(raw)
    found: set[int] = set()
    for name, messages in raws.items():
        runs = training_data_of(recorded_tray(path, name, messages, "")).runs
        pieces = [piece for run in runs for piece in run.split_at_gaps()]
        found |= {fan for fan in range(messages[0].fans) if feedback_share(pieces, fan)}
    return found
