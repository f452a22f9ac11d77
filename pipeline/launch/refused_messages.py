"""Messages of others that stages have refused, over all their sessions. They are not losses, and are shown apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from pipeline.launch.loss_accounting import label
from schemas.messages import Health

WORDS = {
    "refused_of_second": "from a second process of a stage",
    "refused_of_replay": "commands of a replay",
    "refused_clocks": "clock messages from others than the replay",
    "refused_numbers": "with impossible numbers",
    "refused_producers": "from unknown or too many producers",
    "refused_too_large": "too large",
}
"""by the counter of the runner"""


def refused(healths: Iterable[Health]) -> dict[str, dict[str, int]]:
    """How many messages each stage has refused, by its label and by counter; only those that are not 0.

    healths: the last of every session.
    """
    found: dict[str, Counter[str]] = {}
    for health in healths:
        counts = {each.name: each.value for each in health.counters if each.name in WORDS and each.value}
        if counts:
            found.setdefault(label(health), Counter()).update(counts)
    return {name: dict(counts) for name, counts in sorted(found.items())}


def refused_lines(found: Mapping[str, Mapping[str, int]]) -> list[str]:
    """A line for each stage."""
    return [
        f"{name}: messages refused: {', '.join(f'{count} {WORDS[counter]}' for counter, count in counts.items())}"
        for name, counts in found.items()
    ]
