"""The summary of a playback by `fantwin simulate`: the ground truth as JSON, and a line of counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.simulated.device import PlaybackCounts
from fantwin.pipeline.sources.simulated.table import TableDevice

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray

Summary = dict[str, Any]


def _counts(played: PlaybackCounts) -> Summary:
    counts = asdict(played)
    del counts["start_ns"]
    return counts


def summary_of_tray(tray: SimulatedTray, played: PlaybackCounts, *, complete: bool) -> Summary:
    """The ground truth of a simulated tray, and how many of its samples were sent, dropped and lost."""
    from fantwin.simulation.truth import truth  # noqa: PLC0415

    return truth(tray, played.start_ns, complete=complete, counts=_counts(played))


def summary_of_file(path: Path, table: TableDevice, played: PlaybackCounts, *, complete: bool) -> Summary:
    """The same for a played file, whose faults are not known."""
    return {
        "complete": complete,
        "start_ns": played.start_ns,
        **_counts(played),
        "faults": [],
        "fans": table.fans,
        "file": str(path),
    }


def save(path: Path | None, summary: Summary) -> None:
    """Write the summary, where a file is named.

    Raises:
        UserError: it cannot be written.
    """
    from fantwin.simulation.truth import write_truth  # noqa: PLC0415

    if path is None:
        return
    try:
        write_truth(path, summary)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another file with --truth") from error


def save_start(path: Path | None, summary_of: Callable[..., Summary], start_ns: int) -> None:
    """Write the summary with the start of the playback, ns since the epoch, before any sample is counted."""
    save(path, summary_of(PlaybackCounts(start_ns=start_ns), complete=False))


def count_text(played: PlaybackCounts) -> str:
    """How many samples were sent, dropped and lost, in one line."""
    parts = [f"{played.samples_sent} samples sent"]
    if played.samples_dropped:
        parts.append(f"{played.samples_dropped} lost as simulated")
    if played.samples_unsent:
        parts.append(f"{played.samples_unsent} not sent because no program read the port, or too slowly")
    if played.bytes_unread:
        parts.append(f"the last {played.bytes_unread} bytes were not read")
    if played.samples_late:
        parts.append(f"{played.samples_late} sent late, by up to {played.worst_lateness_s * 1e3:.0f} ms")
    return "; ".join(parts)
