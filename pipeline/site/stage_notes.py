"""What stages say that they work with and have done: the rate of a grid, gaps, what was not judged and why."""

from __future__ import annotations

from collections.abc import Iterable

from fantwin.pipeline.site.loss_accounting import label
from fantwin.schemas.health import Health


def note_lines(healths: Iterable[Health]) -> list[str]:
    """A line for each note, for people."""
    return [
        f"{', '.join(filter(None, (label(health), note.tray)))}: {note.text}"
        for health in healths
        for note in health.notes
    ]


def notes_as_json(health: Health) -> list[dict[str, str]]:
    """The same of one stage, for machines."""
    return [{"tray": note.tray, "text": note.text} for note in health.notes]
